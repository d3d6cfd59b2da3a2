"""Rays of pixels: made in float32 in the camera's frame, then moved by the pose (`view`)."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from .arrays import download, upload

if TYPE_CHECKING:
    import mitsuba as mi

    from .view import View


def camera_ray(view: View, film: mi.Point2f, aperture: mi.Point2f) -> tuple[mi.Ray3f, mi.Color3f]:
    """Ray in the camera frame through a film point [pixel], and the sensor's weight."""
    import mitsuba as mi

    if view.film_map is None:
        width, height = view.size
        position = mi.Point2f(film.x / width, film.y / height)
    else:
        position = view.film_map.position(film)
    ray, weight = view.sensor.sample_ray(0.0, 0.5, position, aperture)
    return ray, mi.Color3f(weight)


def seen_camera(view: View) -> Camera:
    """The sensor's map from directions to the film, read off rays over the whole film."""
    import mitsuba as mi

    grid = np.stack(np.meshgrid(*(np.linspace(0.0, n, 9) for n in view.size)), axis=-1).reshape(-1, 2)
    film = mi.Point2f(*(upload(mi.Float, x) for x in grid.T))
    direction = download(camera_ray(view, film, mi.Point2f(0.5, 0.5))[0].d)
    lens, params = {"near": view.near_clip}, mi.traverse(view.sensor)
    if "aperture_radius" in params:
        # Entry by entry: NumPy's conversion would evaluate literals, and the next view need new kernels.
        lens |= {"radius": float(params["aperture_radius"][0]), "focus": float(params["focus_distance"][0])}
    return Camera.fitted(grid, (direction[:2] / direction[2]).T, view.size, **lens)


def move_ray(ray: mi.Ray3f, transform: mi.Transform4f) -> mi.Ray3f:
    """The ray in the world, its interval kept."""
    import mitsuba as mi

    # Point3f + Vector3f may come back as a vector, whose translation a transform would drop.
    return mi.Ray3f(
        transform @ mi.Point3f(ray.o), transform @ mi.Vector3f(ray.d), ray.maxt, ray.time, ray.wavelengths
    )


def opaque_transform(matrix: NDArray[np.float64]) -> mi.Transform4f:
    """A 4x4 rigid motion as kernel input, so that a new pose needs no new kernel."""
    import mitsuba as mi

    transform = mi.Transform4f(mi.Matrix4f(matrix.astype(np.float32)))
    dr.make_opaque(transform)
    return transform


class Lanes(NamedTuple):
    """The lanes of some pixels and batches; the pixel runs fastest."""

    pixel: mi.UInt32
    """Index in the whole image."""
    batch: mi.UInt32
    width: mi.UInt32
    """Of the image [pixel]."""

    @staticmethod
    def of(view: View, pixels: NDArray[np.int64], batches: int) -> Lanes:
        """Of pixels (n, 2), columns and rows."""
        import mitsuba as mi

        index = pixels[:, 1] * view.size[0] + pixels[:, 0]
        return Lanes(
            upload(mi.UInt32, np.tile(index, batches)),
            upload(mi.UInt32, np.repeat(np.arange(batches), len(pixels))),
            dr.opaque(mi.UInt32, view.size[0]),
        )

    @property
    def row(self) -> mi.UInt32:
        """Of the pixel."""
        return self.pixel // self.width

    @property
    def column(self) -> mi.UInt32:
        """Of the pixel."""
        return self.pixel - self.row * self.width

    @property
    def centre(self) -> mi.Point2f:
        """Of the pixel [pixel]."""
        import mitsuba as mi

        return mi.Point2f(mi.Float(self.column) + 0.5, mi.Float(self.row) + 0.5)


def coarse_grid(size: tuple[int, int], most: int) -> NDArray[np.int64]:
    """At most `most` x `most` pixels, evenly over a width x height image: (rows, columns, 2)."""
    columns, rows = (np.unique(np.linspace(0, n - 1, min(n, most)).astype(np.int64)) for n in size)
    return np.stack(np.meshgrid(columns, rows), axis=-1)


def film_rays(view: View, film: NDArray[np.float64]) -> tuple[mi.Ray3f, mi.Transform4f]:
    """Rays through film points (n, 2) [pixel] from the middle of the lens, camera frame, and the pose."""
    import mitsuba as mi

    x, y = (upload(mi.Float, coordinate) for coordinate in film.T)
    ray, _ = camera_ray(view, mi.Point2f(x, y), mi.Point2f(0.5, 0.5))
    return ray, opaque_transform(view.pose)


def first_hits(view: View, pixels: NDArray[np.int64]) -> tuple[mi.SurfaceInteraction3f, NDArray[np.float64]]:
    """First surface through each pixel's centre, and its depth along the optical axis [scene unit]."""
    import mitsuba as mi

    ray, _ = camera_ray(view, Lanes.of(view, pixels, 1).centre, mi.Point2f(0.5, 0.5))
    hit = view.scene.ray_intersect(move_ray(ray, opaque_transform(view.pose)))
    depth = dr.select(hit.is_valid(), ray.o.z + hit.t * ray.d.z, dr.inf)
    return hit, np.array(depth, dtype=np.float64)
