"""What rays meet in a scene: how far off, which shape, which of its faces, and all of it along a line."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..render.arrays import download, upload, widened
from ..se3 import Array

if TYPE_CHECKING:
    import mitsuba as mi

_AT_ONCE = 1 << 20
"""Rays in a launch."""
_APART = 1e-5
"""Of the scene's size: how far beyond a surface a line goes on."""
_MOST = 64
"""Surfaces along a line; what has more is left as far as that."""


@dataclass(frozen=True, eq=False)
class Hits:
    """The first surface along each of n rays."""

    distance: Array
    """(n,) [scene unit]; infinite where there is none."""
    shape: NDArray[np.int64]
    """(n,) number of the shape or the instance, from 1; 0 where there is none."""
    normal: Array
    """(n, 3) of the surface."""
    back: NDArray[np.bool_]
    """(n,) whether its back is met."""
    flags: NDArray[np.int64]
    """(n,) what its material is able to do, `mi.BSDFFlags`."""

    @property
    def met(self) -> NDArray[np.bool_]:
        """(n,) whether there is any."""
        return np.asarray(self.shape > 0)

    @property
    def see_through(self) -> NDArray[np.bool_]:
        """(n,) whether its material is none."""
        import mitsuba as mi

        return np.asarray(self.flags & int(mi.BSDFFlags.All) == int(mi.BSDFFlags.Null)) & self.met

    @property
    def one_sided(self) -> NDArray[np.bool_]:
        """(n,) whether its back is black."""
        import mitsuba as mi

        return np.asarray((self.flags & int(mi.BSDFFlags.BackSide) == 0) & self.met)


def hits(scene: mi.Scene, origins: Array, directions: Array) -> Hits:
    """First surfaces along rays.

    Args:
        scene: whatever is in it.
        origins: (n, 3) [scene unit].
        directions: (n, 3), unit vectors.
    """
    parts = [
        _launch(scene, origins[k : k + _AT_ONCE], directions[k : k + _AT_ONCE])
        for k in range(0, len(origins), _AT_ONCE)
    ]
    names = ("distance", "shape", "normal", "back", "flags")
    return Hits(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def crossings(
    scene: mi.Scene, origins: Array, directions: Array, size: float
) -> list[tuple[NDArray[np.int64], Hits]]:
    """All surfaces along rays, the nearest first: which rays go on to a next one, and that.

    Args:
        scene, origins, directions: as `hits` has them; distances are from the origins.
        size: of the scene; nearer to one another than 1e-5 of it, two surfaces count as one.
    """
    found = []
    rays, travelled = np.arange(len(origins)), np.zeros(len(origins))
    for _ in range(_MOST):
        if not len(rays):
            break
        start = origins[rays] + travelled[:, None] * directions[rays]
        here = hits(scene, start, directions[rays])
        going = np.flatnonzero(here.met)
        rays, travelled = rays[going], travelled[going] + here.distance[going]
        if len(rays):
            found.append(
                (
                    rays,
                    Hits(
                        travelled, here.shape[going], here.normal[going], here.back[going], here.flags[going]
                    ),
                )
            )
        travelled = travelled + _APART * size
    return found


def number_of(shape: mi.Shape) -> int:
    """By which a hit tells a shape of the scene."""
    import mitsuba as mi

    return int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0])


def even_directions(count: int) -> Array:
    """(count, 3) unit vectors, evenly over the sphere: a spiral by the golden angle."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    turn = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    ring = np.sqrt(1.0 - z * z)
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)


def _launch(scene: mi.Scene, origins: Array, directions: Array) -> Hits:
    import mitsuba as mi

    count = len(origins)
    origin, direction = (
        [upload(mi.Float, column) for column in widened(rows).T] for rows in (origins, directions)
    )
    ray = mi.Ray3f(mi.Point3f(*origin), mi.Vector3f(*direction))
    hit = scene.ray_intersect(ray)
    met = hit.is_valid()
    instance, shape = (dr.reinterpret_array(mi.UInt32, pointer) for pointer in (hit.instance, hit.shape))
    number = dr.select(met, dr.select(instance != 0, instance, shape), 0)
    distance = dr.select(met, hit.t, dr.inf)
    facing = dr.dot(hit.n, ray.d)
    flags = dr.select(met, hit.bsdf().flags(), 0)
    dr.eval(distance, number, hit.n, facing, flags)
    return Hits(
        np.array(distance, dtype=np.float64)[:count],
        np.array(number, dtype=np.int64)[:count],
        download(mi.Vector3f(hit.n)).T[:count],
        np.array(facing)[:count] > 0.0,
        np.array(flags, dtype=np.int64)[:count],
    )
