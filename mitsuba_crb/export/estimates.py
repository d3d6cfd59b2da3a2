"""What other tools are told of a result: poses, each with a covariance and an information of six numbers.

Read from the JSON that `bound`, `fuse` and `align` write, of one pose or, in lines, of many. Inside, every
pose is world_from_body with the right perturbation `world_from_body exp(ξ)`, ξ = (ρ, φ), as in `se3`; a
format turns ξ to its own coordinates y = A ξ:

    C_y = A C Aᵀ,    F_y = A⁻ᵀ F A⁻¹,    and in another body's frame ξ_b = Ad(b_from_a) ξ_a.

What the image does not see, N, has an infinite variance and no information: F is the estimate without its
part in N, and a coordinate that moves along N is infinite in C_y. N is that of the result, nothing is decided
here again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from .. import se3
from ..camera import Intrinsics
from ..errors import OptionError
from ..noise.covariance import nearest_semidefinite
from ..se3 import Array
from .names import Axes

AXES: dict[Axes, tuple[tuple[float, float, float], str]] = {
    "mitsuba": ((1.0, 1.0, 1.0), "x left, y up, z forward (Mitsuba's)"),
    "opencv": ((-1.0, -1.0, 1.0), "x right, y down, z forward (OpenCV's, ROS's optical frame)"),
    "opengl": ((-1.0, 1.0, -1.0), "x right, y up, z back (OpenGL's)"),
}
"""Camera axes by name: the diagonal that turns them to Mitsuba's, and words."""

# A share of what is unseen below this is rounding: sign changes and permutations of axes leave it exact.
_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class Estimate:
    """A pose and what is known of it."""

    name: str
    """What the result calls it."""
    pose: Array
    """(4, 4), world_from_body; the body is the camera, or what carries it."""
    covariance: Array
    """(6, 6), of ξ: `inf` on the diagonal of what is unseen, `nan` off it."""
    information: Array
    """(6, 6), of ξ, positive semi-definite, zero along what is unseen."""
    unseen: Array
    """(6, q), N, unit twists ξ that span what the result does not see, or does not resolve."""
    words: tuple[str, ...]
    """The same in words."""
    length_scale: float
    """Length that makes translation comparable with rotation [scene unit]."""
    body: str
    """Whose pose it is, in words, with its axes."""
    camera: Intrinsics | None
    """Of the image; None if the pose is no camera's, or the result does not say."""
    of_camera: bool = True
    """Whether it is the camera's own pose, and not that of a body that carries one."""

    def in_coordinates(self, jacobian: ArrayLike) -> tuple[Array, Array]:
        """C_y and F_y (6, 6) each, for y = A ξ, A (6, 6) invertible."""
        A = np.asarray(jacobian, dtype=np.float64)
        information = se3.move_information(self.information, A)
        if not self.unseen.shape[1]:
            return se3.move_covariance(self.covariance, A), information
        if (np.count_nonzero(A, axis=1) == 1).all():  # every coordinate stays one, with what it is worth
            source = np.argmax(A != 0.0, axis=1)
            factors = A[np.arange(6), source]
            covariance = self.covariance[np.ix_(source, source)] * np.outer(factors, factors)
            return np.asarray(covariance), information
        return self._with_infinities(A), information

    def of_body(self, a_from_b: ArrayLike, body: str, *, of_camera: bool) -> Estimate:
        """The same of another body b, fixed to this one, a: world_from_a a_from_b, ξ_b = Ad(b_from_a) ξ_a."""
        carried = np.asarray(a_from_b, dtype=np.float64)
        A = se3.adjoint(se3.inverse(carried))
        covariance, information = self.in_coordinates(A)
        unseen = A @ self.unseen
        return replace(
            self,
            pose=self.pose @ carried,
            covariance=covariance,
            information=information,
            unseen=unseen / np.linalg.norm(unseen, axis=0),
            body=body,
            of_camera=of_camera,
        )

    def _with_infinities(self, A: Array) -> Array:
        """C_y, infinite for coordinates that move along anything unseen, exact for the others."""
        scale = np.array([self.length_scale] * 3 + [1.0] * 3)
        seen = np.linalg.svd(self.unseen / scale[:, None])[0][:, self.unseen.shape[1] :]
        known = seen.T @ (scale[:, None] * self.information * scale) @ seen
        rows = A * scale
        covariance = rows @ seen @ np.linalg.solve(known, seen.T @ rows.T)
        share = np.linalg.norm(rows - rows @ seen @ seen.T, axis=1)
        infinite = share > _ROUNDING * np.linalg.norm(rows, axis=1)
        covariance[infinite] = covariance[:, infinite] = np.nan
        covariance[infinite, infinite] = np.inf
        return np.asarray(covariance)


def estimate_of(
    *,
    name: str,
    pose: Array,
    frame: str,
    covariance: Array,
    information: Array,
    unseen: Array,
    words: Sequence[str],
    length_scale: float,
    body: str,
    camera: Intrinsics | None,
    of_camera: bool,
) -> Estimate:
    """An estimate from a bound's matrices.

    Args:
        name, pose, words, length_scale, body, camera, of_camera: see `Estimate`.
        frame: of the matrices, "camera" or "world".
        covariance: (6, 6), with `inf` and `nan` as `PoseBound.covariance` has them.
        information: (6, 6), the estimate.
        unseen: (q, 6), an orthonormal basis in the camera frame, translation in length scales.
    """
    scale = np.array([length_scale] * 3 + [1.0] * 3)
    camera_from_frame = se3.adjoint(se3.inverse(pose)) if frame == "world" else np.eye(6)
    F = se3.move_information(information, camera_from_frame) if frame == "world" else information
    N = np.reshape(unseen, (-1, 6)).T
    if N.shape[1]:
        seen = np.eye(6) - N @ N.T
        F = nearest_semidefinite(seen @ (scale[:, None] * F * scale) @ seen) / np.outer(scale, scale)
    directions = scale[:, None] * N
    found = Estimate(
        name=name,
        pose=pose,
        covariance=covariance,
        information=F,
        unseen=directions / np.linalg.norm(directions, axis=0),
        words=tuple(words),
        length_scale=length_scale,
        body=body,
        camera=camera,
        of_camera=of_camera,
    )
    if frame == "camera":
        return found
    if not N.shape[1]:
        return replace(found, covariance=se3.move_covariance(covariance, camera_from_frame))
    return replace(found, covariance=found._with_infinities(np.eye(6)))  # the world's do not say it


def turned(estimate: Estimate, axes: Axes, body_from_camera: ArrayLike | None = None) -> Estimate:
    """The same in other axes, or of the body that carries the camera.

    Args:
        estimate: as it was read.
        axes: one of `AXES`: the camera's, or with a body those that body_from_camera begins from.
        body_from_camera: (4, 4), where the body carries the camera.

    Raises:
        OptionError: of a body, there is no camera to be carried.
    """
    camera = np.diag([*AXES[axes][0], 1.0])
    if not estimate.of_camera:
        if body_from_camera is not None:
            raise OptionError(f"this is the pose of {estimate.body}, already; leave out --body-from-camera")
        return estimate
    if body_from_camera is None:
        return estimate.of_body(camera, f"the camera, {AXES[axes][1]}", of_camera=True)
    carried = camera @ se3.inverse(se3.as_pose(body_from_camera, "--body-from-camera"))
    return estimate.of_body(carried, "the body that carries the camera, its own axes", of_camera=False)
