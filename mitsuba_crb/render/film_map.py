"""A calibrated camera in place of the scene's: its film points are carried over to the sensor's film.

    position on the sensor's film = offset + scale · D⁻¹((v − c) / f)

v is a point of the calibrated film [pixel], c and f its principal point and focal lengths, D its lens. A
perspective sensor's rays are as good beyond its own film as on it, so that another focal length, principal
point, size and distortion are this one map. Kernels take its numbers as input: another calibration needs no
new kernel. D⁻¹ starts from a table made in float64 and ends at the rounding of float32, some 1e-7 f.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from ..camera import Camera, Distortion, Intrinsics, lens
from ..errors import CameraError
from .arrays import upload

if TYPE_CHECKING:
    import mitsuba as mi

_NOTHING = 1e-3
"""A map that moves no film point by more is none [pixel]: the sensor's own is read off float32 rays."""


@dataclass(frozen=True)
class Calibration:
    """What the camera of a view is, in place of the scene's sensor."""

    intrinsics: Intrinsics
    """Of the image that is measured."""
    camera: Camera
    """The same, ready to project."""
    film_map: FilmMap | None
    """To the sensor's film; None if that is the same."""

    @staticmethod
    def of(intrinsics: Intrinsics, sensor: Camera, margin: float, name: str) -> Calibration:
        """Of a sensor that stands in for a camera.

        Args:
            sensor: as its own rays show it, on a film of as many pixels as the camera's.
            margin: how far beyond the image its pixels' filters reach [pixel].
            name: of the sensor.

        Raises:
            CameraError: the lens model cannot be used, or the sensor has an aperture besides.
        """
        if intrinsics.distorts and sensor.radius > 0.0:
            raise CameraError(
                f"lens model {intrinsics.model} distorts, and sensor {name} is a thinlens, of which only a "
                "pinhole's calibration is supported: use a perspective sensor"
            )
        camera = Camera.of(intrinsics, margin, near=sensor.near, radius=sensor.radius, focus=sensor.focus)
        film_map = FilmMap.of(camera, sensor)
        return Calibration(intrinsics, sensor if film_map is None else camera, film_map)


@dataclass(frozen=True)
class Bend:
    """A lens' distortion D as kernel input, see `camera.lens`; in axes x right, y down."""

    model: str
    coefficients: tuple[mi.Float, ...]
    reach: mi.Float
    """Largest |D(u)| that the image shows."""
    start: mi.Float
    """See `Distortion.start`."""

    @staticmethod
    def of(distortion: Distortion) -> Bend:
        """That of a camera."""
        import mitsuba as mi

        return Bend(
            distortion.model,
            tuple(dr.opaque(mi.Float, k) for k in distortion.coefficients),
            dr.opaque(mi.Float, distortion.reach),
            upload(mi.Float, distortion.start),
        )

    def undistorted(self, v: mi.Point2f) -> mi.Point2f:
        """D⁻¹(v); of what the image does not show, a point of its rim."""
        import mitsuba as mi

        rho = dr.sqrt(v.x * v.x + v.y * v.y)
        last = dr.width(self.start) - 1
        place = dr.minimum(rho / self.reach, 1.0) * last
        node = dr.minimum(mi.UInt32(place), last - 1)
        low, high = (dr.gather(mi.Float, self.start, node + k) for k in (0, 1))
        inside = dr.minimum(1.0, self.reach / dr.maximum(rho, 1e-9))
        start = dr.lerp(low, high, place - mi.Float(node))
        u = lens.undistorted(dr, self.model, self.coefficients, inside * v.x, inside * v.y, start)
        return mi.Point2f(*u)

    def stretched(self, u: mi.Point2f, along: mi.Vector2f) -> mi.Vector2f:
        """D'(u) of a vector or covector."""
        import mitsuba as mi

        a, b, c = lens.stretch(dr, self.model, self.coefficients, u.x, u.y)
        return mi.Vector2f(a * along.x + b * along.y, b * along.x + c * along.y)

    def swelling(self, u: mi.Point2f) -> mi.Vector2f:
        """∇ ln det D'(u)."""
        import mitsuba as mi

        return mi.Vector2f(*lens.swelling(dr, self.model, self.coefficients, u.x, u.y))


@dataclass(frozen=True)
class FilmMap:
    """Film points of a calibrated camera to those of the sensor, as kernel input."""

    centre: mi.Vector2f
    """c [pixel]."""
    focal: mi.Vector2f
    """f [pixel]."""
    offset: mi.Vector2f
    """The sensor's principal point, its film being [0, 1]²."""
    scale: mi.Vector2f
    """Its focal lengths, likewise."""
    bend: Bend | None

    @staticmethod
    def of(camera: Camera, sensor: Camera) -> FilmMap | None:
        """From a camera's film to that of a sensor, None if it is the same.

        Args:
            sensor: as its own rays show it, on a film of as many pixels as the camera's.
        """
        import mitsuba as mi

        size = np.asarray(camera.size)
        offset, scale = sensor.centre / size, sensor.focal / size
        corners = np.array([[0.0, 0.0], size])
        moved = (offset + scale * (corners - camera.centre) / camera.focal) * size - corners
        if camera.distortion is None and np.abs(moved).max() < _NOTHING:
            return None
        centre, focal, offset, scale = (
            mi.Vector2f(*(dr.opaque(mi.Float, float(x)) for x in vector))
            for vector in (camera.centre, camera.focal, offset, scale)
        )
        bend = None if camera.distortion is None else Bend.of(camera.distortion)
        return FilmMap(centre, focal, offset, scale, bend)

    def position(self, film: mi.Point2f) -> mi.Point2f:
        """Of a film point [pixel], on the sensor's film in [0, 1]²."""
        import mitsuba as mi

        u = mi.Point2f((film - self.centre) / self.focal)
        if self.bend is not None:
            u = self.bend.undistorted(u)
        return mi.Point2f(self.offset + self.scale * u)
