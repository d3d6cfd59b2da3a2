"""Where the near or the far plane cuts what is in view, and how fast the cut moves on the film.

In the camera's frame a twist (ρ, φ) moves a point p of what is seen by q = −ρ − φ × p, and the plane z = c
stays. A surface with normal n is cut at p with n·p = 0 mod its offset, so that the cut moves by any d with
d_z = 0 and n·d = n·q: the least is d = (n·q) m / |m|², m = (n_x, n_y, 0). That is slow where the surface
stands upright on the plane; one that faces the camera is crossed at once, and its cut runs over the film
many times as fast as anything that is seen.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..render.arrays import widened
from ..render.rays import coarse_grid, film_rays, move_ray

if TYPE_CHECKING:
    from collections.abc import Callable

    import mitsuba as mi

    from ..render.view import View

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

_GRID = 64
_FAR = 100.0
"""Depth over the median visible depth."""
_FACING = 1.0 / 32.0
"""Least |n_xy| of a unit normal that a speed is told of."""


def cut_speeds(view: View, film: Floats) -> Floats:
    """(n, 6) film motion of cuts' edges by each twist component [pixel / scene unit, pixel / rad].

    Args:
        film: (n, 2) where planes cut what is seen, from `cuts_by_near_plane` and `cuts_by_far_plane`.
    """
    if not len(film):
        return np.empty((0, 6))
    valid, normal, depth = _surface(view, film)
    normal, p = normal[valid], view.camera.directions(film[valid]) * depth[valid, None]
    across = normal * [1.0, 1.0, 0.0]
    least = np.maximum(np.sum(across**2, axis=1), _FACING**2)[:, None]
    # n·q = −n·ρ − (p × n)·φ
    shares = np.concatenate([normal, np.cross(p, normal)], axis=1)
    unit = np.linalg.norm(view.camera.velocity(p, across / least), axis=1)
    return np.asarray(np.abs(shares) * unit[:, None])


def cuts_by_near_plane(view: View) -> Floats:
    """Film points (n, 2) [pixel] beside what is before that plane, which see a surface at it."""
    return _cuts(view, _before_near, lambda depth: depth < 1.02 * view.near_clip)


def cuts_by_far_plane(view: View) -> Floats:
    """Film points (n, 2) [pixel] beside what is beyond that plane, which see a surface at it.

    A cut `_FAR` times as far as what is visible moves as the horizon does, and tells no more than that.
    """
    depth = view.visible_depth
    if view.far_clip > (_FAR * np.median(depth) if depth.size else _farthest(view)):
        return np.empty((0, 2))
    return _cuts(view, _beyond_far, lambda depth: (depth > 0.98 * view.far_clip) & np.isfinite(depth))


def _farthest(view: View) -> float:
    """Depth of the farthest corner of what there is."""
    box = view.scene.bbox()
    if not box.valid():
        return 0.0
    corners = np.array([[float(x) for x in box.corner(k)] for k in range(8)])
    return float(((corners - view.pose[:3, 3]) @ view.pose[:3, 2]).max())


def _cuts(
    view: View,
    probe: Callable[[View, Floats], tuple[Bools, Floats]],
    at_plane: Callable[[Floats], Bools],
) -> Floats:
    """Film points (n, 2) between neighbours that a plane cuts off and does not, which see a surface at it.

    Args:
        probe: which film points (n, 2) [pixel] see something that is cut off, and the depth of what they see.
    """
    # As far beyond the film as pixels at its border reach.
    size, radius = np.array(view.size), view.pixel_filter.radius
    grid = (coarse_grid(view.size, _GRID) + 0.5) * (1.0 + 2.0 * radius / size) - radius
    off = probe(view, grid.reshape(-1, 2))[0].reshape(grid.shape[:2])
    if off.all() or not off.any():
        return np.empty((0, 2))
    across, down = off[:, :-1] != off[:, 1:], off[:-1] != off[1:]
    low = widened(np.concatenate([grid[:, :-1][across], grid[:-1][down]]))
    high = widened(np.concatenate([grid[:, 1:][across], grid[1:][down]]))
    first = probe(view, low)[0]
    for _ in range(12):
        middle = 0.5 * (low + high)
        same = (probe(view, middle)[0] == first)[:, None]
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return np.concatenate([film[at_plane(probe(view, film)[1])] for film in (low, high)])


def _before_near(view: View, film: Floats) -> tuple[Bools, Floats]:
    """Whether anything lies before the near plane at film points (n, 2) [pixel], and the depth behind it."""
    ray, transform = film_rays(view, film)
    return meets_before_near(view, ray, transform), _depth(view, ray, transform)


def _beyond_far(view: View, film: Floats) -> tuple[Bools, Floats]:
    """Whether film points (n, 2) [pixel] see something beyond the far plane only, and the depth before it."""
    ray, transform = film_rays(view, film)
    depth = _depth(view, ray, transform)
    return meets_anything(view, ray, transform) & ~np.isfinite(depth), depth


def meets_before_near(view: View, ray: mi.Ray3f, transform: mi.Transform4f) -> Bools:
    """(n,) whether camera rays of the camera's frame would meet anything before the near plane."""
    import mitsuba as mi

    to_lens = ray.o.z / ray.d.z
    before = mi.Ray3f(mi.Point3f(ray.o - to_lens * ray.d), ray.d, to_lens, 0.0, ray.wavelengths)
    return np.array(view.scene.ray_test(move_ray(before, transform)), dtype=bool)


def meets_anything(view: View, ray: mi.Ray3f, transform: mi.Transform4f) -> Bools:
    """(n,) whether camera rays of the camera's frame would meet anything if no far plane ended them."""
    import drjit as dr
    import mitsuba as mi

    whole = mi.Ray3f(ray.o, ray.d, dr.largest(mi.Float), 0.0, ray.wavelengths)
    return np.array(view.scene.ray_test(move_ray(whole, transform)), dtype=bool)


def _depth(view: View, ray: mi.Ray3f, transform: mi.Transform4f) -> Floats:
    """(n,) of what they see, inf for nothing."""
    import drjit as dr

    hit = view.scene.ray_intersect_preliminary(move_ray(ray, transform))
    return np.array(dr.select(hit.is_valid(), dr.fma(hit.t, ray.d.z, ray.o.z), dr.inf), dtype=np.float64)


def _surface(view: View, film: Floats) -> tuple[Bools, Floats, Floats]:
    """Whether film points (n, 2) [pixel] see a surface; its normal (n, 3), camera frame, and depth."""
    count, film = len(film), widened(film)
    ray, transform = film_rays(view, film)
    hit: Any = view.scene.ray_intersect(move_ray(ray, transform))
    valid = np.array(hit.is_valid(), dtype=bool)[:count]
    normal = np.array(hit.n, dtype=np.float64).T[:count] @ view.pose[:3, :3]
    return valid, normal, np.array(hit.t * ray.d.z + ray.o.z, dtype=np.float64)[:count]
