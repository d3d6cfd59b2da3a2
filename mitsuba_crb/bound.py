"""The Cramér–Rao bound of a camera's pose: F⁻¹ where the image sees, infinity where it does not.

Every unbiased estimator obeys Cov(ξ̂) ⪰ F⁻¹. The directions that the estimated information does not see are
decided first (`identifiability`): with its eigenvectors split into seen ones U and unseen ones N,

    F_seen = U Λ Uᵀ,    M = (F_seen + P + λ_99 N Nᵀ)⁻¹,    var(aᵀξ) = aᵀ M a,

or infinity if a has a significant share of N that the prior P does not see either. For a small share (a
slightly tilted null direction) the term λ_99 N Nᵀ adds share² / λ_99; for no share M is the inverse of the
seen block. Everything is decided in the camera frame with translation in units of the length scale.
Conventions: `se3`.

F̂⁻¹ is biased upwards by noise in F̂; the standard errors, by the delta method, say by how much it may matter.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, field
from dataclasses import replace as dataclass_replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import se3
from .errors import OptionError, PrecisionWarning
from .identifiability import FLOAT32_FLOOR, Identifiability, UnobservedDirection, identify, readable_basis
from .information import FisherInformation
from .se3 import Array, Frame
from .symmetric import congruence, pack

LARGEST_RELATIVE_ERROR = 0.1
"""A standard deviation whose relative standard error exceeds this raises a `PrecisionWarning`."""

LARGEST_NOISE_FLOOR = 1e-3
"""A noise floor above this fraction of the largest eigenvalue may hide what more samples would show."""

_POSITION_NAMES = ("x", "y", "z")
_ROTATION_NAMES = ("pitch", "yaw", "roll")
# Off-diagonal entries of a symmetric matrix occur twice in a trace but once in `pack`.
_MULTIPLICITY = pack(2.0 - np.eye(6))


@dataclass(frozen=True, eq=False)
class PoseBound:
    """Lower bounds on the errors of every unbiased estimator of a camera's pose."""

    covariance: Array
    """(6, 6) in `frame`: `inf` on the diagonal of what is unseen, `nan` off it."""
    position_std: Array
    """(3,), the camera centre's standard deviation along the world's axes x, y, z [scene unit]."""
    position_std_standard_error: Array
    """(3,), its Monte Carlo standard error [scene unit]; `nan` where the bound is infinite."""
    rotation_std_deg: Array
    """(3,), rotation about the camera's own axes: pitch x, yaw y, roll z [deg]."""
    rotation_std_deg_standard_error: Array
    """(3,), its Monte Carlo standard error [deg]; `nan` where the bound is infinite."""
    rank: int
    """Number of directions that are seen, by the image or the prior."""
    unobserved: tuple[UnobservedDirection, ...]
    """The other 6 − rank directions: an orthonormal basis of what is unseen, in the camera frame."""
    eigenvalues: Array
    """(6,), descending, of the information in the camera frame with translation in length scales."""
    eigenvalues_standard_error: Array
    """(6,), their standard errors."""
    noise_floor: float
    """λ_99: an unseen direction carries less information than this, in the eigenvalues' unit; 0 at rank 6."""
    information: FisherInformation
    """The information used, the prior included."""
    frame: Frame
    """Frame of `covariance` and `seen_covariance`, `"camera"` or `"world"`."""
    length_scale: float
    """Length that makes translation comparable with rotation [scene unit]."""
    position_covariance: Array
    """(3, 3), of the camera centre, world axes [scene unit²], with `inf` and `nan` as in `covariance`."""
    rotation_covariance_deg2: Array
    """(3, 3), about the camera's axes [deg²], with `inf` and `nan` as in `covariance`."""
    seen_covariance: Array
    """(6, 6) in `frame`: the pseudo-inverse on the seen subspace. It says nothing about what is unseen."""
    provenance: dict[str, Any] = field(default_factory=dict)
    """How the information was computed, JSON-able."""
    _ellipsoids: dict[str, tuple[Array, Array]] = field(default_factory=dict, repr=False)

    def ellipsoid(self, which: Literal["position", "rotation"], sigma: float = 1.0) -> tuple[Array, Array]:
        """The uncertainty ellipsoid of position [scene unit, world axes] or rotation [deg, camera axes].

        Args:
            which: `"position"` or `"rotation"`.
            sigma: semi-axes in standard deviations.

        Returns:
            Semi-axes (3,), descending, infinite where unseen, and their directions (3, 3) in columns.

        Raises:
            OptionError: `which` is neither.
        """
        if which not in self._ellipsoids:
            raise OptionError(f"there is no ellipsoid {which!r}; expected 'position' or 'rotation'")
        semi_axes, directions = self._ellipsoids[which]
        return sigma * semi_axes, directions.copy()

    def to_dict(self) -> dict[str, Any]:
        """The bound as JSON-able values: infinities as the string "inf", not-a-number as None."""
        return {
            "frame": self.frame,
            "twist_order": list(se3.TWIST_ORDER),
            "units": {
                "twist": ["scene unit"] * 3 + ["rad"] * 3,
                "position_std": "scene unit",
                "rotation_std_deg": "deg",
                "eigenvalues": "camera frame, translation in units of length_scale",
                "unobserved.direction": "camera frame, translation in units of length_scale",
            },
            "length_scale": self.length_scale,
            "information": _jsonable(self.information.matrix),
            "information_standard_error": _jsonable(self.information.standard_error),
            "covariance": _jsonable(self.covariance),
            "position_std": _jsonable(self.position_std),
            "position_std_standard_error": _jsonable(self.position_std_standard_error),
            "rotation_std_deg": _jsonable(self.rotation_std_deg),
            "rotation_std_deg_standard_error": _jsonable(self.rotation_std_deg_standard_error),
            "eigenvalues": _jsonable(self.eigenvalues),
            "eigenvalues_standard_error": _jsonable(self.eigenvalues_standard_error),
            "noise_floor": self.noise_floor,
            "rank": self.rank,
            "unobserved": [
                {"direction": _jsonable(u.direction), "description": u.description} for u in self.unobserved
            ],
        }

    def __str__(self) -> str:
        position = _with_errors(_POSITION_NAMES, self.position_std, self.position_std_standard_error)
        rotation = _with_errors(_ROTATION_NAMES, self.rotation_std_deg, self.rotation_std_deg_standard_error)
        unseen = "; ".join(u.description for u in self.unobserved) or "nothing"
        eigenvalues = ", ".join(f"{value:.3g}" for value in self.eigenvalues)
        return "\n".join(
            (
                f"position std  {position} [scene unit], world axes",
                f"rotation std  {rotation} [deg], camera axes",
                f"rank          {self.rank} of 6",
                f"unseen        {unseen}",
                f"eigenvalues   {eigenvalues} (camera frame, translation in length scales)",
                f"length scale  {self.length_scale:.4g} [scene unit]; matrices in the {self.frame} frame",
            )
        )


def cramer_rao_bound(
    information: FisherInformation, *, prior: FisherInformation | ArrayLike | None = None
) -> PoseBound:
    """The Cramér–Rao bound F⁻¹ of a pose, or (F + P)⁻¹ with a prior.

    What the image sees is decided without the prior, which is then added as it is: it can lower standard
    deviations and raise the rank, never the other way round.

    Args:
        information: of the pose, in any frame; the bound's matrices come in the same one.
        prior: information known beforehand, exact. A 6 x 6 matrix in `information`'s frame, or an information
            of the same variable, frame and pose, of which the part that it sees itself counts.

    Raises:
        FrameError: the prior belongs to another variable, frame or pose.
        OptionError: the prior is no symmetric positive semi-definite 6 x 6 matrix.

    Warns:
        PrecisionWarning: a standard deviation is uncertain by more than 10 %, or noise hides so much that
            unseen directions may only be unresolved.

    References:
        van Trees, "Detection, Estimation, and Modulation Theory", part I, 1968, sections 2.4.2 and 2.4.3.
    """
    inverse = _Inverse(information, prior)
    rotation = inverse.total.pose[:3, :3]
    zero = np.zeros((3, 3))
    # Rows are linear functionals of the scaled camera-frame twist; the camera centre moves by R ρ.
    position = np.hstack([inverse.length_scale * rotation, zero])
    turn = np.degrees(np.hstack([zero, np.eye(3)]))
    twist = np.diag(inverse.scale)
    if information.frame == "world":
        twist = se3.adjoint(inverse.total.pose) @ twist
    position_covariance, rotation_covariance = inverse.covariance(position), inverse.covariance(turn)
    with np.errstate(invalid="ignore"):
        position_std = np.sqrt(np.diagonal(position_covariance))
        rotation_std = np.sqrt(np.diagonal(rotation_covariance))
    eigenvalues, eigenvalue_errors = inverse.eigenvalues()
    bound = PoseBound(
        covariance=inverse.covariance(twist),
        position_std=position_std,
        position_std_standard_error=inverse.standard_error(position, position_std),
        rotation_std_deg=rotation_std,
        rotation_std_deg_standard_error=inverse.standard_error(turn, rotation_std),
        rank=6 - inverse.open.shape[1],
        unobserved=readable_basis(
            inverse.identifiability, inverse.open, inverse.total.pose, inverse.length_scale
        ),
        eigenvalues=eigenvalues,
        eigenvalues_standard_error=eigenvalue_errors,
        noise_floor=inverse.identifiability.threshold,
        information=inverse.total.to_frame(information.frame),
        frame=information.frame,
        length_scale=inverse.length_scale,
        position_covariance=position_covariance,
        rotation_covariance_deg2=rotation_covariance,
        seen_covariance=inverse.seen_covariance(twist),
        _ellipsoids={"position": inverse.ellipsoid(position), "rotation": inverse.ellipsoid(turn)},
    )
    _warn_of_imprecision(bound)
    return bound


class _Inverse:
    """Variances of linear functionals of the pose, in the camera frame with scaled translation.

    hidden: N, what the information does not see; open: the part of it that the prior does not see either.
    """

    def __init__(self, information: FisherInformation, prior: FisherInformation | ArrayLike | None) -> None:
        camera = information.to_frame("camera")
        self.length_scale = camera.length_scale
        self.scale = camera.scale
        S = np.diag(self.scale)
        self.identifiability = identify(
            S @ camera.matrix @ S, _scaled(camera.covariance_of_entries, self.scale)
        )
        U, N = self.identifiability.seen, self.identifiability.unseen
        F = (U * self.identifiability.eigenvalues[: U.shape[1]]) @ U.T
        self.total, self.open = camera, N
        if prior is not None:
            self.total, P = _with_prior(information, camera, prior)
            self.open = _unseen_by_prior(self.identifiability, P)
            F = F + P
        # Without any information nor noise there is no threshold; then every functional is hidden, and only
        # the scale of what the prior leaves open needs a floor.
        floor = self.identifiability.threshold or FLOAT32_FLOOR * float(np.trace(F)) or 1.0
        self.precision = F
        self.tilted = _inverse_root(F + floor * N @ N.T)
        self.informed = self.tilted if self.open is N else _inverse_root(F + floor * self.open @ self.open.T)
        self.covariance_of_entries = _scaled(self.total.covariance_of_entries, self.scale)

    def kinds(self, functionals: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which functionals (m, 6) the information does not see, and which the prior does not see either."""
        hidden = self.identifiability.has_share(functionals)
        return hidden, hidden & self.identifiability.has_share(functionals, self.open)

    def covariance(self, functionals: Array) -> Array:
        """(m, m), with inf on the diagonal and nan off it for what is unseen."""
        hidden, unseen = self.kinds(functionals)
        tilted, informed = functionals @ self.tilted, functionals @ self.informed
        covariance = tilted @ tilted.T
        informed = informed @ informed.T
        # M of the tilted null directions plus a positive semi-definite block: the whole stays a covariance.
        covariance[np.ix_(hidden, hidden)] = informed[np.ix_(hidden, hidden)]
        covariance = 0.5 * (covariance + covariance.T)
        covariance[unseen] = covariance[:, unseen] = np.nan
        covariance[unseen, unseen] = np.inf
        return covariance

    def standard_error(self, functionals: Array, std: Array) -> Array:
        """(m,), of standard deviations: δ(σ²) = −bᵀ δF b with b = U Uᵀ M a."""
        hidden, _ = self.kinds(functionals)
        U = self.identifiability.seen
        tilted, informed = (functionals @ root @ (root.T @ U) @ U.T for root in (self.tilted, self.informed))
        b = np.where(hidden[:, None], informed, tilted)
        variance_error = _quadratic_error(b, self.covariance_of_entries)
        with np.errstate(invalid="ignore"):
            return np.where(np.isfinite(std), variance_error / (2.0 * std), np.nan)

    def seen_covariance(self, functionals: Array) -> Array:
        """(m, m), of the inverse restricted to everything that is seen."""
        U = np.linalg.svd(self.open, full_matrices=True)[0][:, self.open.shape[1] :]
        root = functionals @ U @ _inverse_root(U.T @ self.precision @ U)
        return np.asarray(root @ root.T, dtype=np.float64)

    def eigenvalues(self) -> tuple[Array, Array]:
        """(6,) and (6,), of the whole information, descending, with first-order standard errors."""
        S = np.diag(self.scale)
        values, vectors = np.linalg.eigh(S @ self.total.matrix @ S)
        return values[::-1].copy(), _quadratic_error(vectors.T[::-1], self.covariance_of_entries)

    def ellipsoid(self, functionals: Array) -> tuple[Array, Array]:
        """Semi-axes (3,), descending, and directions (3, 3) in columns, of three functionals."""
        # Directions sorted by their share of what is unseen, so that whole axes are infinite or finite.
        directions = np.linalg.svd(functionals @ self.open, full_matrices=True)[0]
        _, unseen = self.kinds(directions.T @ functionals)
        finite = directions[:, ~unseen]
        variances, axes = np.linalg.eigh(self.covariance(finite.T @ functionals))
        semi_axes = np.concatenate([np.full(unseen.sum(), np.inf), np.sqrt(np.maximum(variances[::-1], 0.0))])
        return semi_axes, np.hstack([directions[:, unseen], finite @ axes[:, ::-1]])


def _with_prior(
    information: FisherInformation, camera: FisherInformation, prior: FisherInformation | ArrayLike
) -> tuple[FisherInformation, Array]:
    """The sum in the camera frame, and the prior's own scaled positive semi-definite matrix."""
    S = np.diag(camera.scale)
    if isinstance(prior, FisherInformation):
        total = (information + prior).to_frame("camera")
        total = dataclass_replace(total, length_scale=camera.length_scale)
        own = prior.to_frame("camera")
        matrix = S @ own.matrix @ S
        if own.covariance_of_entries.any():
            found = identify(matrix, _scaled(own.covariance_of_entries, camera.scale))
            return total, (found.seen * found.eigenvalues[: found.rank]) @ found.seen.T
        return total, _positive_part(matrix)
    try:
        given = np.array(prior, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise OptionError(f"a prior is a FisherInformation or a 6 x 6 matrix: {error}") from None
    if given.shape != (6, 6) or not np.isfinite(given).all():
        raise OptionError(f"a prior is a finite 6 x 6 matrix, not {given.shape}; an unknown direction is 0")
    if not np.allclose(given, given.T, rtol=0.0, atol=1e-9 * np.abs(given).max()):
        raise OptionError("the prior's information matrix is not symmetric")
    A = se3.adjoint(camera.pose) if information.frame == "world" else np.eye(6)
    own_matrix = A.T @ given @ A
    P = _positive_part(S @ own_matrix @ S)
    plain = None if camera.plain_matrix is None else camera.plain_matrix + own_matrix
    return dataclass_replace(camera, matrix=camera.matrix + own_matrix, plain_matrix=plain), P


def _positive_part(matrix: Array) -> Array:
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    if values[0] < -1e-9 * max(values[-1], 0.0):
        raise OptionError(
            f"the prior's information is not positive semi-definite (smallest eigenvalue {values[0]:.3g})"
        )
    positive: Array = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return positive


def _unseen_by_prior(identifiability: Identifiability, prior: Array) -> Array:
    """The part (6, q) of the unseen subspace N that a prior P does not see.

    An eigenvector of P sees N only if its share of N is significant: a strong prior elsewhere must not seem
    to inform a null direction that noise has tilted towards it.
    """
    N = identifiability.unseen
    values, vectors = np.linalg.eigh(prior)
    informative = values > np.finfo(np.float64).eps * 6 * max(values[-1], 0.0)
    vectors = vectors[:, informative]
    vectors = vectors[:, identifiability.has_share(vectors.T)]
    if N.shape[1] == 0 or vectors.shape[1] == 0:
        return N
    left, singular, _ = np.linalg.svd(N.T @ vectors, full_matrices=True)
    sees = int(np.count_nonzero(singular > 1e-6))
    return np.asarray(N @ left[:, sees:], dtype=np.float64)


def _scaled(covariance_of_entries: Array, scale: Array) -> Array:
    T = congruence(np.diag(scale))
    scaled: Array = T @ covariance_of_entries @ T.T
    return scaled


def _inverse_root(matrix: Array) -> Array:
    """L with L Lᵀ = A⁻¹ for a symmetric positive definite A, by its correlation form against mixed scales.

    A functional a ⟂ N gets ‖Lᵀa‖² exact even where A⁻¹ itself is dominated by a nearly null direction N.
    """
    d = 1.0 / np.sqrt(np.diagonal(matrix))
    values, vectors = np.linalg.eigh(d[:, None] * matrix * d)
    root: Array = d[:, None] * vectors / np.sqrt(values)
    return root


def _quadratic_error(vectors: Array, covariance_of_entries: Array) -> Array:
    """Standard errors (m,) of vᵀ F v for vectors (m, 6)."""
    gradient = pack(vectors[:, :, None] * vectors[:, None, :]) * _MULTIPLICITY
    variance = np.einsum("mi,ij,mj->m", gradient, covariance_of_entries, gradient)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)), dtype=np.float64)


def _warn_of_imprecision(bound: PoseBound) -> None:
    errors = np.concatenate([bound.position_std_standard_error, bound.rotation_std_deg_standard_error])
    relative = np.nan_to_num(errors / np.concatenate([bound.position_std, bound.rotation_std_deg]))
    worst = int(np.argmax(relative))
    if relative[worst] > LARGEST_RELATIVE_ERROR:
        name = (*(f"position {axis}" for axis in _POSITION_NAMES), *_ROTATION_NAMES)[worst]
        factor = math.ceil((relative[worst] / LARGEST_RELATIVE_ERROR) ** 2)
        warnings.warn(
            f"the bound on {name} is uncertain by {relative[worst]:.0%} and may be too large; "
            f"about {factor} times the samples would bring that to {LARGEST_RELATIVE_ERROR:.0%}",
            PrecisionWarning,
            stacklevel=3,
        )
    floor = bound.noise_floor / max(float(bound.eigenvalues[0]), np.finfo(float).tiny)
    if bound.unobserved and LARGEST_NOISE_FLOOR < floor < np.inf and bound.rank > 0:
        warnings.warn(
            f"unseen means less than {floor:.1%} of the best-seen direction's information, which is all that "
            "so few samples tell; what is weaker than that needs more of them",
            PrecisionWarning,
            stacklevel=3,
        )


def _with_errors(names: tuple[str, ...], values: Array, errors: Array) -> str:
    parts = (
        f"{name} {value:.3g} ± {error:.1g}" if np.isfinite(value) else f"{name} inf"
        for name, value, error in zip(names, values, errors, strict=True)
    )
    return ", ".join(parts)


def _jsonable(array: Array) -> Any:
    def entry(value: float) -> float | str | None:
        if math.isnan(value):
            return None
        return value if math.isfinite(value) else ("inf" if value > 0.0 else "-inf")

    if array.ndim == 1:
        return [entry(float(value)) for value in array]
    return [_jsonable(row) for row in array]
