"""Rigid motions SE(3): the conventions of this library, the exponential, the adjoint, other tools.

Every other module cites this page; docs/reference/conventions.md repeats the table between the markers
(`CONVENTIONS`).

<!-- conventions -->
| what | convention |
|---|---|
| pose | `world_from_camera`, 4 x 4, a rigid motion: Mitsuba's `to_world` |
| names | read right to left: `world_from_camera = world_from_rig @ rig_from_camera` |
| camera axes | Mitsuba's: x left, y up, z forward (the optical axis) |
| twist | `ξ = (ρx, ρy, ρz, φx, φy, φz)`: translation ρ [scene unit] first, rotation φ [rad] second |
| frame `"camera"` | right perturbation, `world_from_camera @ exp(ξ)` |
| frame `"world"` | left perturbation, `exp(ξ) @ world_from_camera` |
| change of frame | `ξ_world = Ad(world_from_camera) ξ_camera`, `Ad(g) = [[R, [t]× R], [0, R]]` |
| information, covariance | `ξ_a = A ξ_b` gives `F_b = Aᵀ F_a A` and `C_a = A C_b Aᵀ`; `ξᵀ F ξ` is invariant |
| storage | computed and kept in the camera frame, the world frame derived on demand |
| reported position | camera centre c along the world's axes [scene unit]; `δc = ρ − [c]× φ`, world frame |
| reported rotation | about the camera's own axes, pitch x, yaw y, roll z [deg] |
| eigenvalues, trace, rank | of F in the camera frame, translation in units of the length scale |
| length scale | the median visible depth [scene unit]; 1 if nothing finite is visible |
| GTSAM | `Pose3` is world_from_camera, right perturbation, rotation first; camera axes x right, y down |
| COLMAP | `cam_from_world`; tangent (δ, d): `R ← Exp(2δ) R`, `t ← t + d`; camera axes x right, y down |
| ROS | `PoseWithCovariance`: translation first, then rotation about the fixed axes |
<!-- /conventions -->

Far from the world's origin the world-frame matrix mixes translation and rotation with a lever arm of
|t| and cancels catastrophically; that is why nothing is stored in it.

References: Barfoot, "State Estimation for Robotics", 2nd ed., chapter 8; Solà, Deray and Atchuthan,
"A micro Lie theory for state estimation in robotics", 2018 (there, too, translation comes first).
"""

from __future__ import annotations

from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from .errors import PoseError

Array: TypeAlias = NDArray[np.float64]
Frame: TypeAlias = Literal["camera", "world"]

CONVENTIONS: str = (
    (__doc__ or "").partition("<!-- conventions -->\n")[2].partition("<!-- /conventions -->")[0]
)
"""The convention table, as Markdown; docs/reference/conventions.md carries it verbatim."""

TWIST_ORDER = ("ρx", "ρy", "ρz", "φx", "φy", "φz")
"""Order of a twist's six components, and of every 6 x 6 matrix's rows and columns."""

# Scene files carry poses as float32 and as text, of three decimals at least; more than this is no rounding.
_RIGID_TOLERANCE = 1e-3
_EXACT_TOLERANCE = 1e-12

# Camera axes of OpenCV, GTSAM and COLMAP (x right, y down) seen from Mitsuba's (x left, y up).
_AXES = np.diag([-1.0, -1.0, 1.0])


def skew(vector: ArrayLike) -> Array:
    """[v]×, the 3 x 3 matrix with [v]× w = v × w."""
    x, y, z = np.asarray(vector, dtype=np.float64)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def exp(twist: ArrayLike) -> Array:
    """The rigid motion exp(ξ).

    Args:
        twist: (..., 6), (ρ [scene unit], φ [rad]).

    Returns:
        (..., 4, 4).
    """
    xi = np.asarray(twist, dtype=np.float64)
    # SciPy's exponential coordinates put the rotation first.
    coordinates = np.concatenate([xi[..., 3:], xi[..., :3]], axis=-1)
    return np.asarray(RigidTransform.from_exp_coords(coordinates).as_matrix(), dtype=np.float64)


def log(pose: ArrayLike) -> Array:
    """The twist ξ = (ρ, φ) with exp(ξ) = pose and |φ| ≤ π; (..., 4, 4) to (..., 6)."""
    coordinates = RigidTransform.from_matrix(np.asarray(pose, dtype=np.float64)).as_exp_coords()
    return np.concatenate([coordinates[..., 3:], coordinates[..., :3]], axis=-1)


def inverse(pose: ArrayLike) -> Array:
    """The inverse of a rigid motion, [Rᵀ, −Rᵀt]."""
    b_from_a = np.asarray(pose, dtype=np.float64)
    a_from_b = np.eye(4)
    a_from_b[:3, :3] = b_from_a[:3, :3].T
    a_from_b[:3, 3] = -b_from_a[:3, :3].T @ b_from_a[:3, 3]
    return a_from_b


def adjoint(pose: ArrayLike) -> Array:
    """Ad(g) = [[R, [t]× R], [0, R]], 6 x 6: `g exp(ξ) g⁻¹ = exp(Ad(g) ξ)`."""
    g = np.asarray(pose, dtype=np.float64)
    rotation = g[:3, :3]
    return np.block([[rotation, skew(g[:3, 3]) @ rotation], [np.zeros((3, 3)), rotation]])


def as_pose(value: ArrayLike | RigidTransform, name: str = "the pose") -> Array:
    """A rigid motion as a 4 x 4 float64 matrix, its rotation made orthogonal to float64.

    Args:
        value: a 4 x 4 matrix, or SciPy's `RigidTransform`. Deviations from rigidity up to 1e-3 count as
            rounding (text, float32) and are removed by the polar decomposition.
        name: what messages call it.

    Raises:
        PoseError: wrong shape or type, NaN, a last row other than (0, 0, 0, 1), reflection, scale, shear.
    """
    if isinstance(value, RigidTransform):
        value = value.as_matrix()
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise PoseError(
            f"{name} must be a 4 x 4 matrix of numbers or a RigidTransform, not {type(value).__name__} "
            f"({error})"
        ) from None
    if matrix.shape != (4, 4):
        raise PoseError(f"{name} must have shape (4, 4), not {matrix.shape}")
    if not np.isfinite(matrix).all():
        raise PoseError(
            f"{name} has entries that are NaN or infinite; give a finite rigid motion (of a look_at: up is "
            "parallel to the view direction, or target is origin: choose another up)"
        )
    if not np.allclose(matrix[3], (0.0, 0.0, 0.0, 1.0), rtol=0.0, atol=_EXACT_TOLERANCE):
        raise PoseError(
            f"{name} has the last row {matrix[3].tolist()}, not (0, 0, 0, 1); is the matrix transposed?"
        )
    left, scales, right = np.linalg.svd(matrix[:3, :3])
    # Of the orthogonal factors: numbers from damaged files overflow in the matrix' own determinant.
    if scales[2] > 0.0 and np.linalg.det(left @ right) < 0.0:
        raise PoseError(f"{name} contains a reflection (determinant < 0); give a rotation and a translation")
    deviation = float(np.abs(scales - 1.0).max())
    if deviation > _RIGID_TOLERANCE:
        kind = (
            "a scale"
            if scales[0] - scales[2] <= _RIGID_TOLERANCE * scales[0]
            else "a shear or unequal scales"
        )
        raise PoseError(
            f"{name} contains {kind} (singular values {', '.join(f'{s:.6g}' for s in scales)}); "
            "give a rotation and a translation"
        )
    if deviation > _EXACT_TOLERANCE:
        matrix[:3, :3] = left @ right
    matrix[3] = (0.0, 0.0, 0.0, 1.0)
    return matrix


def pose_from_vector(vector: str | ArrayLike) -> Array:
    """world_from_camera from (x, y, z, qx, qy, qz, qw), numbers or text separated by blanks or commas.

    The quaternion may be unnormalised by up to 5 % (rounded text); more is taken for a mistake.

    Raises:
        PoseError: not seven finite numbers, or no unit quaternion.
    """
    try:
        numbers = vector.replace(",", " ").split() if isinstance(vector, str) else vector
        values = np.array(numbers, dtype=np.float64)
    except (TypeError, ValueError):
        raise PoseError(
            f"cannot read {vector!r} as a pose; expected seven numbers x y z qx qy qz qw"
        ) from None
    if values.shape != (7,):
        raise PoseError(f"a pose vector has seven numbers, x y z qx qy qz qw, not {values.size}")
    if not np.isfinite(values).all():
        raise PoseError("the pose vector has entries that are NaN or infinite")
    length = float(np.linalg.norm(values[3:]))
    if abs(length - 1.0) > 0.05:
        raise PoseError(
            f"the quaternion (qx, qy, qz, qw) has length {length:.6g}, not 1; is the order x y z w?"
        )
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(values[3:]).as_matrix()
    pose[:3, 3] = values[:3]
    return pose


def vector_from_pose(pose: ArrayLike) -> Array:
    """(x, y, z, qx, qy, qz, qw) of world_from_camera; qw is not negative."""
    matrix = np.asarray(pose, dtype=np.float64)
    return np.concatenate([matrix[:3, 3], Rotation.from_matrix(matrix[:3, :3]).as_quat(canonical=True)])


def pose_from_numbers(values: Any) -> Array:
    """A pose, 4 x 4, from nested lists of 16 numbers, or from the seven x y z qx qy qz qw.

    Raises:
        PoseError: something else, or no rigid motion.
    """
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise PoseError("this is neither a 4x4 matrix nor seven numbers x y z qx qy qz qw") from error
    if array.size == 7:
        return pose_from_vector(array.ravel())
    if array.size == 12:
        raise PoseError("these are the 12 numbers of a 3x4 matrix: append its last row, 0 0 0 1")
    if array.size != 16:
        raise PoseError(f"expected a 4x4 matrix or seven numbers x y z qx qy qz qw, got {array.size} numbers")
    return as_pose(array.reshape(4, 4))


def move_covariance(covariance: ArrayLike, a_from_b: ArrayLike) -> Array:
    """C_a = A C_b Aᵀ, for ξ_a = A ξ_b (n x n, any linear A)."""
    A = np.asarray(a_from_b, dtype=np.float64)
    moved = A @ np.asarray(covariance, dtype=np.float64) @ A.T
    return 0.5 * (moved + moved.T)


def move_information(information: ArrayLike, a_from_b: ArrayLike) -> Array:
    """F_a = A⁻ᵀ F_b A⁻¹, for ξ_a = A ξ_b (A invertible): the information of `move_covariance`'s result."""
    A_inverse = np.linalg.inv(np.asarray(a_from_b, dtype=np.float64))
    return move_covariance(information, A_inverse.T)


def pose_to_gtsam(world_from_camera: ArrayLike) -> Array:
    """The matrix of GTSAM's `Pose3`: world_from_camera with the camera's axes turned to x right, y down."""
    return as_pose(world_from_camera) @ _axes_pose()


def pose_from_gtsam(pose3: ArrayLike) -> Array:
    """world_from_camera in this library's axes from the matrix of GTSAM's `Pose3`."""
    return as_pose(pose3) @ _axes_pose()


def gtsam_from_camera() -> Array:
    """A with ξ_gtsam = A ξ_camera; ξ_gtsam = (φ, ρ) is `Pose3`'s tangent (right, rotation first).

    `move_covariance(C, gtsam_from_camera())` is what GTSAM's `Marginals` call the pose's covariance, and
    `move_information` its Hessian block; the inverse of A brings them back.
    """
    zero = np.zeros((3, 3))
    return np.block([[zero, _AXES], [_AXES, zero]])


def pose_to_colmap(world_from_camera: ArrayLike) -> Array:
    """COLMAP's `cam_from_world`, 4 x 4, with the camera's axes turned to x right, y down."""
    return inverse(pose_to_gtsam(world_from_camera))


def pose_from_colmap(cam_from_world: ArrayLike) -> Array:
    """world_from_camera in this library's axes from COLMAP's `cam_from_world`, 4 x 4."""
    return pose_from_gtsam(inverse(as_pose(cam_from_world)))


def colmap_from_camera(world_from_camera: ArrayLike) -> Array:
    """A with (δ, d) = A ξ_camera: COLMAP's split tangent, `R ← Exp(2δ) R`, `t ← t + d` of cam_from_world.

    From cam_from_world = D (world_from_camera exp(ξ))⁻¹, D = diag(−1, −1, 1) the turned axes:
    2δ = −D φ and d = −D ρ + [t]× D φ.
    """
    translation = pose_to_colmap(world_from_camera)[:3, 3]
    return np.block([[np.zeros((3, 3)), -0.5 * _AXES], [-_AXES, skew(translation) @ _AXES]])


def _axes_pose() -> Array:
    pose = np.eye(4)
    pose[:3, :3] = _AXES
    return pose
