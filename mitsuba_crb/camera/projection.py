"""The camera: where a point in its frame lands on the film, for a pinhole, a lens that distorts, a thin lens.

Seen from a point a of the lens (a = 0: pinhole; a_z = 0), with p' = p − a, a point p in the camera's frame
has the film position

    v = (p'_xy / p'_z + a_xy / focus − offset) / scale = centre + (p'_xy / p'_z + a_xy / focus) / scale

in pixels from the image's upper left corner; the first pixel's centre is at (0.5, 0.5). The camera's axes are
Mitsuba's, x left and y up (`se3`), the image's x right and y down: scale = −1 / focal is negative.

A distorted lens D (`distortion`) moves that point, of the *plain* film where lines are straight, to
centre + focal D((v − centre) / focal).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from ..se3 import Array
from .distortion import Distortion
from .intrinsics import Intrinsics


@dataclass(frozen=True, eq=False)
class Camera:
    """Intrinsics of a camera, ready to project."""

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
    distortion: Distortion | None = None
    """Of the lens; then the aperture is a point."""

    @staticmethod
    def pinhole(focal: ArrayLike, centre: ArrayLike, size: tuple[int, int]) -> Camera:
        """From focal lengths along x and y, and the principal point [pixel]."""
        scale = -1.0 / np.broadcast_to(np.asarray(focal, dtype=np.float64), 2)
        return Camera(scale, -scale * np.asarray(centre, dtype=np.float64), size)

    @staticmethod
    def of(
        intrinsics: Intrinsics,
        margin: float = 0.0,
        *,
        near: float = 0.0,
        radius: float = 0.0,
        focus: float = np.inf,
    ) -> Camera:
        """From a calibration.

        Args:
            margin: how far beyond the image its pixels' filters reach [pixel].

        Raises:
            CameraError: as `Distortion.of`.
        """
        pinhole = Camera.pinhole(intrinsics.focal, intrinsics.centre, intrinsics.size)
        distortion = Distortion.of(intrinsics, margin)
        return replace(pinhole, near=near, radius=radius, focus=focus, distortion=distortion)

    @staticmethod
    def fitted(
        film: ArrayLike,
        tangents: ArrayLike,
        size: tuple[int, int],
        *,
        near: float = 0.0,
        radius: float = 0.0,
        focus: float = np.inf,
    ) -> Camera:
        """From film points (n, 2) [pixel] and x/z, y/z (n, 2) of rays through them from the lens' centre."""
        v, d = np.asarray(film, dtype=np.float64), np.asarray(tangents, dtype=np.float64)
        scale, offset = np.array([np.polyfit(v[:, j], d[:, j], 1) for j in range(2)], dtype=np.float64).T
        return Camera(scale, offset, size, near, radius, focus)

    @property
    def focal(self) -> Array:
        """(2,) focal lengths along x and y [pixel]."""
        return np.asarray(-1.0 / self.scale)

    @property
    def field_of_view_deg(self) -> list[float]:
        """Angles between the rays through the middles of opposite sides of the image [deg]: across, down."""
        first, last = self.offset, self.offset + self.scale * np.asarray(self.size)
        if self.distortion is not None:
            (x, y), (width, height) = self.centre, self.size
            left, right, top, bottom = self.directions([[0.0, y], [width, y], [x, 0.0], [x, height]])[:, :2]
            first, last = np.array([left[0], top[1]]), np.array([right[0], bottom[1]])
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
        return self.distorted((direction - self.offset) / self.scale)

    def velocity(self, points: ArrayLike, moving: ArrayLike) -> Array:
        """Film velocity (n, 2) [pixel] of p' (n, 3) that move by `moving` (n, 3)."""
        p, dp = np.asarray(points, dtype=np.float64), np.asarray(moving, dtype=np.float64)
        plain = np.asarray((dp[:, :2] - p[:, :2] / p[:, 2:] * dp[:, 2:]) / p[:, 2:] / self.scale)
        if self.distortion is None:
            return plain
        return self.distortion.stretched(-p[:, :2] / p[:, 2:], plain / self.focal) * self.focal

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
        xy = self.scale * self.undistorted(np.asarray(film, dtype=np.float64)) + self.offset
        return np.concatenate([xy, np.ones((len(xy), 1))], axis=1)

    @property
    def plain(self) -> Camera:
        """The same without distortion."""
        return self if self.distortion is None else replace(self, distortion=None)

    def distorted(self, plain: Array) -> Array:
        """Film points (..., 2) [pixel] of points of the plain film (..., 2)."""
        if self.distortion is None:
            return plain
        return self.centre + self.focal * self.distortion.distorted((plain - self.centre) / self.focal)

    def undistorted(self, film: Array) -> Array:
        """Points of the plain film (..., 2) [pixel] of film points (..., 2)."""
        if self.distortion is None:
            return film
        return self.centre + self.focal * self.distortion.undistorted((film - self.centre) / self.focal)

    def stretched(self, plain: Array, along: Array) -> Array:
        """Film vectors (..., 2) of vectors (..., 2) of the plain film, at points of it (..., 2)."""
        if self.distortion is None:
            return along
        u = (plain - self.centre) / self.focal
        return self.focal * self.distortion.stretched(u, along / self.focal)

    def pulled(self, points: Array, covectors: Array) -> Array:
        """mᵀ ∂v/∂(plain film point) (n, 2) of covectors m of the film (n, 2), at p' (n, 3)."""
        if self.distortion is None:
            return covectors
        u = -points[:, :2] / points[:, 2:]
        return self.distortion.stretched(u, covectors * self.focal) / self.focal

    def least_stretch(self, points: Array) -> Array:
        """(n,) film length per length of the plain film at p' (n, 3), where it is least."""
        if self.distortion is None:
            return np.ones(len(points))
        return self.distortion.least_stretch(-points[:, :2] / points[:, 2:])

    def plain_boxes(self, boxes: Array) -> Array:
        """Rectangles x0 y0 x1 y1 (n, 4) of the plain film that hold those of the film (n, 4)."""
        if self.distortion is None:
            return boxes
        # Both maps are one to one, so a rectangle's image ends where its border's does.
        t = np.linspace(-1.0, 1.0, 9)
        side = np.stack([t, np.ones_like(t)], axis=1)
        around = np.concatenate([side, -side, side[:, ::-1], -side[:, ::-1]])
        middle, half = 0.5 * (boxes[:, :2] + boxes[:, 2:]), 0.5 * (boxes[:, 2:] - boxes[:, :2])
        border = self.undistorted(middle[:, None] + half[:, None] * around)
        low, high = border.min(axis=1), border.max(axis=1)
        # Between two of its points it bends less than it goes on.
        pad = np.abs(np.diff(border.reshape(-1, 4, 9, 2), n=2, axis=2)).max(axis=(1, 2)) + 0.01
        return np.concatenate([low - pad, high + pad], axis=1)

    def rim(self) -> Array:
        """(k, 3) points whose convex hull holds the aperture [scene unit]."""
        if self.radius == 0.0:
            return np.zeros((1, 3))
        angle = np.arange(8) * (np.pi / 4.0)
        reach = self.radius / np.cos(np.pi / 8.0)
        return np.asarray(reach * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1))
