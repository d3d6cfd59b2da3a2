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

from .errors import CameraError, OptionError
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


@dataclass(frozen=True)
class Intrinsics:
    """What a calibration says of a camera.

    A point (X, Y, Z) in axes x right, y down, z forward lands at v = centre + focal · D(X/Z, Y/Z) [pixel]
    from the image's upper left corner, D the lens model's distortion. With r² = x² + y² and θ = arctan r,

        opencv   D = (x, y) (1 + k1 r² + k2 r⁴ + k3 r⁶)/(1 + k4 r² + k5 r⁴ + k6 r⁶)
                     + (2 p1 x y + p2 (r² + 2 x²), p1 (r² + 2 y²) + 2 p2 x y)
        fisheye  D = (x, y)/r θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸)

    as in OpenCV; COLMAP's SIMPLE_RADIAL, RADIAL, OPENCV, FULL_OPENCV and fisheyes are instances.

    Raises:
        CameraError: a value is not finite, a focal length not positive, or the model and its coefficients do
            not fit.
    """

    size: tuple[int, int]
    """Width and height of the image [pixel]."""
    focal: tuple[float, float]
    """fx, fy [pixel]."""
    centre: tuple[float, float]
    """cx, cy [pixel], where the first pixel's centre is at (0.5, 0.5)."""
    model: str = "pinhole"
    """A name in `LENS_MODELS`."""
    distortion: tuple[float, ...] = ()
    """The model's coefficients, in the order of `LENS_MODELS`."""

    def __post_init__(self) -> None:
        if self.model not in LENS_MODELS:
            raise CameraError(f"lens model {self.model!r} is not known; known: {', '.join(LENS_MODELS)}")
        names = LENS_MODELS[self.model]
        if len(self.distortion) != len(names):
            raise CameraError(
                f"lens model {self.model} has {len(names)} coefficients ({', '.join(names)}), not "
                f"{len(self.distortion)}"
            )
        object.__setattr__(self, "size", image_size(self.size))
        for name, length in (("focal", 2), ("centre", 2), ("distortion", len(names))):
            values = tuple(float(value) for value in getattr(self, name))
            if len(values) != length or not np.isfinite(values).all():
                raise CameraError(f"{name} must be {length} finite numbers; got {getattr(self, name)!r}")
            object.__setattr__(self, name, values)
        if min(self.focal) <= 0.0:
            raise CameraError(f"focal lengths must be positive [pixel]; got {self.focal}")


LENS_MODELS: dict[str, tuple[str, ...]] = {
    "pinhole": (),
    "opencv": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}
"""Their coefficients, in OpenCV's order."""


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
