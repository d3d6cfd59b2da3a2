"""Pose information from points: what bundle adjustment would know of cameras that see the same corners.

A point X appears at u = π(p) + ε, ε ~ N(0, C) [pixel], with p = Rᵀ(X − c) in the camera's frame. The twist
moves p by ṗ = −ρ − φ × p, so that the derivatives of u are

    A = ∂u/∂ξ = ∂π/∂p [−1, [p]×]    (2 x 6),        B = ∂u/∂X = ∂π/∂p Rᵀ    (2 x 3),

with A and B whitened by C below. Points that are known give one camera F = Σ AᵀA, the Gauss–Newton Hessian of
the reprojection errors. Points that are not known leave the joint information of several cameras a, b by the
Schur complement of each point's own 3 x 3 block,

    S_ab = δ_ab Σ A_aᵀA_a − Σ_points (A_aᵀB_a) (Σ_c B_cᵀB_c)⁺ (B_bᵀA_b),

that is, what an orthogonal projection leaves of A beside B. The seven directions of the gauge, a motion of
everything and its scale, are free in it. Nothing here is sampled: information is exact. Conventions: `se3`.

References: Triggs et al., "Bundle adjustment, a modern synthesis", 2000, sections 4 and 6; Muthukkumar 2025,
corollary 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag

from .. import se3
from ..camera import Camera
from ..errors import PointsError
from ..files import Record
from ..information.fisher import FisherInformation
from ..information.linearisation import Linearisation, PixelSelection
from ..information.significance import no_information
from ..noise.covariance import positive_matrix
from ..se3 import Array
from .pose_graph import JointPoseInformation, PoseGraph

FEWEST_POINTS = 3
"""Six numbers of a pose need as many measured coordinates."""

# A direction of a point that its images see by less than this fraction of the best-seen one is rounding.
_UNMEASURED = 1e-12


@dataclass(frozen=True, eq=False)
class PointView(Record):
    """One camera that sees points, and how well."""

    variable: str
    """The camera's name."""
    pose: Array
    """world_from_camera, (4, 4)."""
    camera: Camera
    """Its intrinsics, known; its lens may distort, and its aperture is a point."""
    noise: ArrayLike
    """Standard deviation [pixel], one for all points or (n,), or covariances (n, 2, 2) [pixel²]."""
    seen: NDArray[np.integer] | None = None
    """(n,), which of the points it sees, in the order of `noise`; None: all."""


def point_information(points: ArrayLike, view: PointView) -> FisherInformation:
    """What a camera's images of known points tell of its pose: F = Σ AᵀC⁻¹A, in the camera frame, exact.

    Args:
        points: (N, 3), in the world [scene unit].
        view: the camera.

    Raises:
        PointsError: fewer than three points, a point behind the camera, or noise that is not positive.

    References:
        Muthukkumar 2025, corollary 1.
    """
    images = _Images(points, view)
    rows = images.by_pose.reshape(-1, 6)
    count = len(images.seen)
    return FisherInformation(
        matrix=rows.T @ rows,
        covariance_of_entries=np.zeros((21, 21)),
        linearisation=Linearisation(
            variable=view.variable,
            frame="camera",
            pose=images.pose,
            length_scale=images.depth,
            selection=PixelSelection("only", count, count, f"{count} points"),
        ),
    )


def joint_point_information(points: ArrayLike, views: Sequence[PointView]) -> JointPoseInformation:
    """What several cameras' images of unknown points tell of their poses together: S above, 6A x 6A, exact.

    Args:
        points: (N, 3), where they are in the world [scene unit], the linearisation point.
        views: the cameras, each with a name of its own.

    Raises:
        PointsError: as for `point_information`, in any of the cameras.
        FusionError: two cameras of one name, or none.
    """
    images = [_Images(points, view) for view in views]
    matrix = np.zeros((6 * len(images), 6 * len(images)))
    for point in range(len(np.asarray(points))):
        rows = [(k, view.seen == point) for k, view in enumerate(images)]
        rows = [(k, own) for k, own in rows if own.any()]
        # One image of an unknown point tells nothing: left out, so that nothing is no rounding error either.
        if len(rows) < 2:
            continue
        by_pose = block_diag(*(images[k].by_pose[own][0] for k, own in rows))
        by_point = np.vstack([images[k].by_point[own][0] for k, own in rows])
        directions, sizes, _ = np.linalg.svd(by_point, full_matrices=False)
        known = directions[:, sizes > _UNMEASURED * sizes[0]]
        left = by_pose - known @ (known.T @ by_pose)
        columns = np.concatenate([6 * k + np.arange(6) for k, _ in rows])
        matrix[np.ix_(columns, columns)] += left.T @ left
    return JointPoseInformation(tuple(view.variable for view in views), matrix)


def bundle_adjustment(points: ArrayLike, views: Sequence[PointView]) -> PoseGraph:
    """The cameras' poses, tied by the unknown points that they see.

    Points tell nothing of where everything is, nor of how large it is: `fixed` removes the former, and
    a camera's own information that is added to a `PoseGraph` with `joint_point_information` both.

    Args, Raises: as for `joint_point_information`.
    """
    poses = []
    for view in views:
        images = _Images(points, view)
        poses.append(no_information(variable=view.variable, pose=images.pose, length_scale=images.depth))
    return PoseGraph(poses, joint=[joint_point_information(points, views)])


class _Images:
    """Whitened derivatives of a camera's images of points.

    pose: (4, 4), checked; seen: (n,), indices; depth: their median [scene unit].
    by_pose: A (n, 2, 6); by_point: B (n, 2, 3).
    """

    def __init__(self, points: ArrayLike, view: PointView) -> None:
        world = np.asarray(points, dtype=np.float64)
        if world.ndim != 2 or world.shape[1] != 3 or not np.isfinite(world).all():
            raise PointsError(f"points must be finite numbers of shape (n, 3), not of shape {world.shape}")
        self.pose = se3.as_pose(view.pose)
        self.seen = _indices(view, len(world))
        rotation, centre = self.pose[:3, :3], self.pose[:3, 3]
        p = (world[self.seen] - centre) @ rotation
        behind = np.flatnonzero(p[:, 2] <= 0.0)
        if behind.size:
            raise PointsError(
                f"{behind.size} of {len(p)} points are behind camera {view.variable!r}, the first is number "
                f"{self.seen[behind[0]]}; leave them out of `seen`, or check the pose (z is forward)"
            )
        self.depth = float(np.median(p[:, 2]))
        root = _whitening(view, len(p))
        self.by_pose = np.linalg.solve(root, view.camera.flow(p))
        self.by_point = np.linalg.solve(root, view.camera.slope(p) @ rotation.T)


def _indices(view: PointView, total: int) -> NDArray[np.integer]:
    seen = np.arange(total) if view.seen is None else np.asarray(view.seen)
    if seen.ndim != 1 or not np.issubdtype(seen.dtype, np.integer):
        raise PointsError(f"`seen` of camera {view.variable!r} must be a list of whole numbers")
    if len(seen) < FEWEST_POINTS:
        raise PointsError(
            f"camera {view.variable!r} sees {len(seen)} points, and a pose needs at least {FEWEST_POINTS}"
        )
    if len(np.unique(seen)) < len(seen) or seen.min() < 0 or seen.max() >= total:
        raise PointsError(
            f"`seen` of camera {view.variable!r} must name different points, from 0 to {total - 1}"
        )
    return seen


def _whitening(view: PointView, count: int) -> Array:
    """L (n, 2, 2) with L Lᵀ the covariance of each point's image [pixel²]."""
    noise = np.asarray(view.noise, dtype=np.float64)
    if noise.shape not in ((), (count,), (count, 2, 2)):
        raise PointsError(
            f"the noise of camera {view.variable!r} must be one sigma, {count} of them, or {count} 2 x 2 "
            f"covariances, one for each point that it sees; not of shape {noise.shape}"
        )
    if noise.ndim < 3:
        if not (np.isfinite(noise).all() and (noise > 0.0).all()):
            raise PointsError(
                f"sigma [pixel] of camera {view.variable!r} must be positive and finite, not "
                f"{float(noise.flat[np.argmin(np.where(np.isfinite(noise), noise, -np.inf))])}"
            )
        return np.broadcast_to(noise, count)[:, None, None] * np.eye(2)
    what = f"a point's covariance [pixel²] of camera {view.variable!r}"
    covariances = positive_matrix(noise, what, PointsError, definite=True)
    return np.asarray(np.linalg.cholesky(covariances), dtype=np.float64)
