"""The camera: where a point in its frame lands on the film, for a pinhole and for a thin lens.

Seen from a point a of the lens (a = 0: pinhole; a_z = 0), with p' = p − a, a point p in the camera's frame
has the film position

    v = (p'_xy / p'_z + a_xy / focus − offset) / scale = centre + (p'_xy / p'_z + a_xy / focus) / scale

in pixels from the image's upper left corner; the first pixel's centre is at (0.5, 0.5). The camera's axes are
Mitsuba's, x left and y up (`se3`), the image's x right and y down: scale = −1 / focal is negative.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .errors import OptionError
from .se3 import Array


def image_size(size: Any) -> tuple[int, int]:
    """Width and height [pixel] as whole numbers.

    Raises:
        OptionError: they are none, or not positive.
    """
    try:
        width, height = (int(value) for value in size)
    except (TypeError, ValueError, OverflowError) as error:
        raise OptionError(f"size must be two whole numbers, width and height; got {size!r}") from error
    if width <= 0 or height <= 0:
        raise OptionError(f"size must be positive; got {width}x{height}")
    return width, height


@dataclass(frozen=True, eq=False)
class Camera:
    """Intrinsics of a camera without distortion."""

    scale: Array
    """(2,) of x/z and y/z along a ray from the lens' centre, per film coordinate [1/pixel]."""
    offset: Array
    """(2,) x/z and y/z at the film's origin."""
    size: tuple[int, int]
    """Width and height of the image [pixel]."""
    near: float = 0.0
    """Distance of the near plane [scene unit]."""
    radius: float = 0.0
    """Of the aperture [scene unit]; 0: a pinhole."""
    focus: float = np.inf
    """Distance of the plane in focus [scene unit]."""

    @staticmethod
    def pinhole(focal: ArrayLike, centre: ArrayLike, size: tuple[int, int]) -> Camera:
        """From focal lengths along x and y, and the principal point [pixel]."""
        scale = -1.0 / np.broadcast_to(np.asarray(focal, dtype=np.float64), 2)
        return Camera(scale, -scale * np.asarray(centre, dtype=np.float64), size)

    @staticmethod
    def fitted(film: ArrayLike, tangents: ArrayLike, size: tuple[int, int], **lens: float) -> Camera:
        """From film points (n, 2) [pixel] and x/z, y/z (n, 2) of the rays through them from the lens' centre.

        Args:
            lens: `near`, `radius` and `focus`.
        """
        v, d = np.asarray(film, dtype=np.float64), np.asarray(tangents, dtype=np.float64)
        scale, offset = np.array([np.polyfit(v[:, j], d[:, j], 1) for j in range(2)], dtype=np.float64).T
        return Camera(scale, offset, size, **lens)

    @property
    def focal(self) -> Array:
        """(2,) focal lengths along x and y [pixel]."""
        return np.asarray(-1.0 / self.scale)

    @property
    def field_of_view_deg(self) -> list[float]:
        """Angles between the rays through the middles of opposite sides of the image [deg]: across, down."""
        first, last = self.offset, self.offset + self.scale * np.asarray(self.size)
        return [float(angle) for angle in np.degrees(np.abs(np.arctan(first) - np.arctan(last)))]

    @property
    def centre(self) -> Array:
        """(2,) the principal point, where the optical axis meets the film [pixel]."""
        return np.asarray(-self.offset / self.scale)

    @property
    def focal_length(self) -> float:
        """The geometric mean of `focal` [pixel]."""
        return float(np.sqrt(np.prod(self.focal)))

    def angles(self, motion: ArrayLike) -> Array:
        """(..., 3) pitch, yaw and roll [rad] that move the image by `motion` (...) [pixel].

        A roll moves it by so much at the root mean square distance from the image's centre. Translations by
        these angles times a depth move what is there likewise.
        """
        radius = max(float(np.hypot(*self.size)) / np.sqrt(12.0), 1.0)
        lever = [self.focal_length, self.focal_length, radius]
        return np.divide.outer(np.asarray(motion, dtype=np.float64), lever)

    def project(self, points: ArrayLike, lens: ArrayLike = 0.0) -> Array:
        """Film positions (n, 2) [pixel] of p' (n, 3), points in the camera's frame less their lens points.

        Args:
            lens: (n, 3), the lens points a [scene unit]; 0: of a pinhole.
        """
        p, a = np.asarray(points, dtype=np.float64), np.broadcast_to(lens, np.shape(points))
        direction = p[:, :2] / p[:, 2:] + a[:, :2] / self.focus
        return np.asarray((direction - self.offset) / self.scale)

    def velocity(self, points: ArrayLike, moving: ArrayLike) -> Array:
        """Film velocity (n, 2) [pixel] of p' (n, 3) that move by `moving` (n, 3)."""
        p, dp = np.asarray(points, dtype=np.float64), np.asarray(moving, dtype=np.float64)
        return np.asarray((dp[:, :2] - p[:, :2] / p[:, 2:] * dp[:, 2:]) / p[:, 2:] / self.scale)

    def slope(self, points: ArrayLike) -> Array:
        """∂v/∂p' at p' (n, 3): (n, 2, 3) [pixel / scene unit]."""
        p = np.asarray(points, dtype=np.float64)
        axes = np.broadcast_to(np.eye(3), (len(p), 3, 3))
        return np.stack([self.velocity(p, axes[:, k]) for k in range(3)], axis=2)

    def flow(self, points: ArrayLike) -> Array:
        """∂v/∂ξ = ∂v/∂p [−1, [p]×] of points (n, 3) seen from a = 0: (n, 2, 6) [pixel / twist]."""
        p = np.asarray(points, dtype=np.float64)
        slope = self.slope(p)
        # rᵀ[p]× = (r × p)ᵀ
        return np.concatenate([-slope, np.cross(slope, p[:, None])], axis=2)

    def directions(self, film: ArrayLike) -> Array:
        """The points (n, 3) at depth one in the camera's frame that a pinhole sees at (n, 2) [pixel]."""
        xy = self.scale * np.asarray(film, dtype=np.float64) + self.offset
        return np.concatenate([xy, np.ones((len(xy), 1))], axis=1)

    def rim(self) -> Array:
        """(k, 3) points whose convex hull holds the aperture [scene unit]."""
        if self.radius == 0.0:
            return np.zeros((1, 3))
        angle = np.arange(8) * (np.pi / 4.0)
        reach = self.radius / np.cos(np.pi / 8.0)
        return np.asarray(reach * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1))
