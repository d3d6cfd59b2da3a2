"""The bound in other coordinates of the pose. Proposition: it does not depend on them.

Let y be any smooth, locally invertible coordinates of the pose, J_y = ∂y/∂ξ. The same image has the
information F_y = J_y⁻ᵀ F_ξ J_y⁻¹ about y, so that

    C_y = F_y⁻¹ = J_y C_ξ J_yᵀ,

and a function f of the pose has the variance bound ∇fᵀ C ∇f in all coordinates alike. A coordinate is unseen
(infinite) exactly if the row of J_y has a share of the unseen directions. All J_y are closed forms with
respect to the camera-frame twist, R ← R exp([φ]×), c ← c + Rρ; conventions: `se3`.

References: Lehmann and Casella, "Theory of Point Estimation", 2nd ed., equation 2.6.16 (change of
parameters); Diebel, "Representing Attitude", 2006, sections 5 and 6 (rates of Euler angles and quaternions).
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from .. import se3
from ..errors import CoordinatesError
from ..files import Record
from ..information.fisher import FisherInformation
from ..se3 import Array
from .cramer_rao import PoseBound, cramer_rao_bound

NAMES = ("camera", "world", "centre_rotation", "euler", "quaternion", "gtsam", "colmap")
"""Twist in the camera's or the world's frame; camera centre (world axes) with the rotation about the camera's
axes, Euler angles, or the unit quaternion's vector part; the tangents of GTSAM's and COLMAP's poses."""

# Poses come with float32 rounding, 1e-7; closer to a singularity than this the Jacobian is rounding.
_SINGULAR = 1e-6


@dataclass(frozen=True, eq=False)
class Coordinates:
    """Coordinates y of a pose, and their derivative with respect to the camera-frame twist."""

    name: str
    """One of `NAMES`."""
    components: tuple[str, ...]
    """Names of the six."""
    units: tuple[str, ...]
    """`"scene unit"`, `"rad"`, or `"1"` (quaternions, and COLMAP's half angles)."""
    values: Array
    """(6,), y at the pose; zero for those that are deviations from it."""
    jacobian: Array
    """(6, 6), ∂y/∂ξ, ξ the camera-frame twist."""


@dataclass(frozen=True, eq=False)
class CoordinateBound(Record):
    """The Cramér–Rao bound of the six coordinates."""

    coordinates: Coordinates
    """What they are."""
    covariance: Array
    """(6, 6): `inf` on the diagonal of what is unseen, `nan` off it."""
    std: Array
    """(6,), square roots of its diagonal."""
    std_standard_error: Array
    """(6,), their Monte Carlo standard errors; `nan` where the bound is infinite."""
    information: Array
    """(6, 6), F_y, of the image and the prior."""

    def __str__(self) -> str:
        y = self.coordinates
        rows = zip(y.components, y.values, self.std, y.units, strict=True)
        return "\n".join(f"{name:3s} {value:.6g}, std {std:.3g} [{unit}]" for name, value, std, unit in rows)


def to_coordinates(
    bound: PoseBound | FisherInformation, name: str, *, sequence: str = "ZYX"
) -> CoordinateBound:
    """C_y = J_y C_ξ J_yᵀ, infinite for coordinates that move along an unseen direction.

    Args:
        bound: a bound (with its prior, if it had one), or an information, whose bound is then taken.
        name: one of `NAMES`.
        sequence: of `"euler"`, as SciPy spells it: `"ZYX"` about the body's axes in turn, `"zyx"` about the
            world's.

    Raises:
        CoordinatesError: no such coordinates, or they are singular at this pose.
    """
    if isinstance(bound, FisherInformation):
        bound = cramer_rao_bound(bound)
    inverse = bound.inverse
    y = coordinates_of(inverse.total.pose, name, sequence=sequence)
    functionals = y.jacobian * inverse.scale
    covariance = inverse.covariance(functionals)
    with np.errstate(invalid="ignore"):
        std = np.sqrt(np.diagonal(covariance))
    return CoordinateBound(
        coordinates=y,
        covariance=covariance,
        std=std,
        std_standard_error=inverse.standard_error(functionals, std),
        information=se3.move_information(inverse.total.matrix, y.jacobian),
    )


def coordinates_of(pose: ArrayLike, name: str, *, sequence: str = "ZYX") -> Coordinates:
    """The coordinates of a pose (4 x 4, world_from_camera) and their Jacobian; arguments and errors as above.

    Raises:
        CoordinatesError: no such coordinates, or they are singular at this pose.
    """
    g = se3.as_pose(pose)
    if name not in NAMES:
        raise CoordinatesError(f"there are no coordinates {name!r}; there are {', '.join(NAMES)}")
    translation, turn = se3.TWIST_ORDER[:3], se3.TWIST_ORDER[3:]
    if name in ("camera", "world"):
        jacobian = np.eye(6) if name == "camera" else se3.adjoint(g)
        return Coordinates(name, se3.TWIST_ORDER, _units("rad"), np.zeros(6), jacobian)
    if name == "gtsam":
        jacobian = se3.gtsam_from_camera()
        return Coordinates(name, (*turn, *translation), _units("rad")[::-1], np.zeros(6), jacobian)
    if name == "colmap":
        tangent = ("δx", "δy", "δz", "dx", "dy", "dz")
        return Coordinates(name, tangent, _units("1")[::-1], np.zeros(6), se3.colmap_from_camera(g))
    if name == "euler":
        components, angles, block = _euler(g[:3, :3], sequence)
        return _about_centre(g, name, components, angles, block, "rad")
    if name == "quaternion":
        vector, block = _quaternion(g[:3, :3])
        return _about_centre(g, name, ("qx", "qy", "qz"), vector, block, "1")
    return _about_centre(g, name, turn, np.zeros(3), np.eye(3), "rad")


def _about_centre(
    g: Array, name: str, components: tuple[str, ...], values: Array, block: Array, unit: str
) -> Coordinates:
    """Camera centre along the world's axes, δc = Rρ, and three coordinates of the rotation alone."""
    zero = np.zeros((3, 3))
    return Coordinates(
        name=name,
        components=("cx", "cy", "cz", *components),
        units=_units(unit),
        values=np.concatenate([g[:3, 3], values]),
        jacobian=np.block([[g[:3, :3], zero], [zero, block]]),
    )


def _units(second: str) -> tuple[str, ...]:
    return ("scene unit",) * 3 + (second,) * 3


def _euler(rotation: Array, sequence: str) -> tuple[tuple[str, ...], Array, Array]:
    """Angles α of R = R_a(α₁) R_b(α₂) R_c(α₃), and dα/dφ = E⁻¹ with Rᵀ dR = [E dα]×.

    E's columns are the axes seen from the camera: R_cᵀ R_bᵀ e_a, R_cᵀ e_b, e_c. Its determinant, ±cos α₂ or
    (first axis like third) ±sin α₂, vanishes in gimbal lock.
    """
    axes = sequence.lower()
    fits = len(axes) == 3 and set(axes) <= set("xyz") and axes[0] != axes[1] != axes[2]
    if not fits or sequence not in (axes, axes.upper()):
        raise CoordinatesError(
            f"the Euler sequence {sequence!r} is none; give three axes, no neighbours equal, such as 'ZYX' "
            "(about the camera's axes in turn) or 'xyz' (about the world's)"
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # SciPy's own remark on gimbal lock
        angles = Rotation.from_matrix(rotation).as_euler(sequence)
    # Rotations about fixed axes are those about the body's in reverse order.
    order = slice(None) if sequence.isupper() else slice(None, None, -1)
    axis = [np.eye(3)["xyz".index(a)] for a in axes[order]]
    second, third = (
        Rotation.from_rotvec(a * alpha).as_matrix()
        for a, alpha in zip(axis[1:], angles[order][1:], strict=True)
    )
    E = np.column_stack([third.T @ second.T @ axis[0], third.T @ axis[1], axis[2]])[:, order]
    if abs(np.linalg.det(E)) < _SINGULAR:
        raise CoordinatesError(
            f"the Euler angles {sequence} are in gimbal lock at this pose (second angle "
            f"{np.degrees(angles[1]):.6g} degrees); take another sequence, such as "
            f"{'YXZ' if sequence.upper() != 'YXZ' else 'ZYX'}, or another name"
        )
    components = tuple(f"{a}{i + 1}" for i, a in enumerate(sequence))
    return components, np.asarray(angles, dtype=np.float64), np.linalg.inv(E)


def _quaternion(rotation: Array) -> tuple[Array, Array]:
    """Vector part v of q = (w, v), w > 0, and dv/dφ = ½ (w 1 + [v]×), from q ← q ⊗ (1, ½φ)."""
    x, y, z, w = Rotation.from_matrix(rotation).as_quat(canonical=True)
    if w < _SINGULAR:
        raise CoordinatesError(
            f"the quaternion's vector part is singular at this pose (w = {w:.2g}, a half turn): it does not "
            "determine the rotation there; take centre_rotation or euler"
        )
    v = np.array([x, y, z])
    return v, 0.5 * (w * np.eye(3) + se3.skew(v))
