"""What lies behind a view's film: the points that it shows, and where it shows none that other views could.

Of a Mitsuba scene that is what rays hit. A radiance field has no surfaces: its expected depth stands for one,
where it is mostly opaque. Inverse depth is linear on the film of a plane: so it is interpolated, and where it
bends there is an outline or a crease.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import ClassVar, Protocol

import drjit as dr
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ..errors import SensorError
from ..measure.field_view import FieldView
from ..measure.measurable import Measurable
from ..render.arrays import download, upload
from ..render.rays import camera_ray, move_ray, opaque_transform
from ..render.view import View
from ..se3 import Array

# Where its Laplacian exceeds this fraction of it per pixel², inverse depth bends.
_BENT = 0.02
# Of a field, what covers less has no depth worth the name.
_SOLID = 0.9


class FilmPoints(Protocol):
    """What lies behind a view's film."""

    @property
    def reach(self) -> int:
        """How far what a pixel shows may lie from its centre [pixel]."""

    @property
    def hidden(self) -> float:
        """A point is hidden if what is before it is nearer by more than this fraction of its depth."""

    def through(self, film: Array) -> Array:
        """Points in the camera's frame (n, 3) behind film positions (n, 2) [pixel]; no number if none."""

    def unsmooth(self) -> NDArray[np.bool_]:
        """(H, W) where there is an outline, a crease, nothing, or what looks different from elsewhere."""


def film_points(view: Measurable) -> FilmPoints:
    """Those of a view.

    Raises:
        SensorError: its camera is no pinhole.
    """
    if isinstance(view, View):
        if view.camera.radius > 0.0:
            raise SensorError(
                f"points need a pinhole, and sensor {view.variable!r} is a {view.sensor.class_name()}: use a "
                "perspective sensor"
            )
        return _Traced(view)
    assert isinstance(view, FieldView)
    return _Expected(view)


@dataclass(frozen=True, eq=False)
class _Traced:
    """What rays hit."""

    view: View
    hidden: ClassVar[float] = 1e-3

    @property
    def reach(self) -> int:
        """The filter's radius."""
        return int(np.ceil(self.view.pixel_filter.radius))

    def through(self, film: Array) -> Array:
        """See `FilmPoints.through`."""
        return self._hits(film)[0]

    def unsmooth(self) -> NDArray[np.bool_]:
        """See `FilmPoints.unsmooth`."""
        import mitsuba as mi

        points, flags = self._hits(_centres(self.view.size))
        shape = self.view.size[::-1]
        matte = flags.reshape(shape) & int(mi.BSDFFlags.All & ~mi.BSDFFlags.Diffuse) == 0
        return np.asarray(~matte | _bent(points[:, 2].reshape(shape)))

    def _hits(self, film: Array) -> tuple[Array, NDArray[np.int64]]:
        """First hits (n, 3), and BSDF flags (n,)."""
        import mitsuba as mi

        view = self.view
        if len(film) == 0:
            return np.empty((0, 3)), np.empty(0, dtype=np.int64)
        position = mi.Point2f(*(upload(mi.Float, film[:, axis]) for axis in range(2)))
        ray, _ = camera_ray(view, position, mi.Point2f(0.5, 0.5))
        hit = view.scene.ray_intersect(move_ray(ray, opaque_transform(view.pose)))
        point = ray.o + dr.select(hit.is_valid(), hit.t, dr.inf) * ray.d
        return download(point).T, np.array(hit.bsdf().flags(), dtype=np.int64)


@dataclass(frozen=True, eq=False)
class _Expected:
    """A field's expected depth."""

    view: FieldView
    hidden: ClassVar[float] = 0.05
    reach: ClassVar[int] = 1

    @functools.cached_property
    def depth(self) -> Array:
        """(H, W), NaN where too little is covered."""
        width, height = self.view.size
        pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2)
        shown = self.view.field.show(self.view.camera, self.view.pose, pixels)
        return np.where(shown.opacity >= _SOLID, shown.depth, np.nan).reshape(height, width)

    def through(self, film: Array) -> Array:
        """See `FilmPoints.through`."""
        place = (film[:, ::-1] - 0.5).T
        inverse = ndimage.map_coordinates(1.0 / self.depth, place, order=1, mode="nearest")
        return np.asarray(self.view.camera.directions(film) / inverse[:, None])

    def unsmooth(self) -> NDArray[np.bool_]:
        """See `FilmPoints.unsmooth`."""
        return _bent(self.depth)


def _centres(size: tuple[int, int]) -> Array:
    """(n, 2) of all pixels, row by row."""
    x, y = np.meshgrid(*(np.arange(n) + 0.5 for n in size))
    return np.stack([x.ravel(), y.ravel()], axis=1)


def _bent(depth: Array) -> NDArray[np.bool_]:
    """(H, W) where depth is that of no smooth surface."""
    inverse = 1.0 / depth
    return np.asarray(~(np.abs(ndimage.laplace(inverse)) < _BENT * inverse))
