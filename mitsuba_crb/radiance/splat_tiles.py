"""Which tile of the film sees which splats, nearest first.

One sort by depth, then one by tile that keeps the order; pairs of splat and tile come from the splats' boxes,
and are kept where the least of (m − v)ᵀ Σ'⁻¹ (m − v) over the tile's pixel centres v lies in the window.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..errors import FieldError
from ..render.arrays import upload, widened
from .splat_projection import NEGLECTED, TILE, Cloud, Lens, Records, project

if TYPE_CHECKING:
    import mitsuba as mi

Floats = NDArray[np.float64]
Places = NDArray[np.uint32]

_CHUNK = 1 << 23
"""Pairs of splat and tile that are tried at once."""
_MOST = 1 << 28
"""Pairs that are held: 4 GB."""


@dataclass(frozen=True, eq=False)
class Tiled:
    """Splats on the film from one pose, by tile."""

    records: Records
    members: mi.UInt32
    """Splats, tile by tile, nearest first."""
    first: Places
    """(tiles + 1,) where each tile's begin in `members`."""

    @property
    def pairs(self) -> int:
        """How many splats all tiles list together."""
        return int(self.first[-1])


def tiled(cloud: Cloud, camera: Camera, pose: Floats, kept: Floats, *, variant: str, near: float) -> Tiled:
    """Splats on the film, by tile.

    Args:
        pose: (4, 4) `world_from_camera`.
        kept: (4, 4) pose that decides which is nearer, and which are nearer than `near`.
        near: depth of a centre up to which a splat is left out [unit of the field].

    Raises:
        FieldError: so many tiles see so many splats that memory would not do.
    """
    import mitsuba as mi

    depth = (cloud.means - kept[:3, 3]) @ kept[:3, 2]
    opacities = np.where(depth > near, cloud.opacities, 0.0)
    relative = (cloud.means - pose[:3, 3]).T
    lens = Lens.of(camera)
    records, box, number = project(
        cloud,
        mi.Vector3f(*(upload(mi.Float, row) for row in relative)),
        upload(mi.Float, opacities),
        upload(mi.Float, pose[:3, :3].T.ravel()),
        lens,
        variant,
    )
    dr.eval(records.film, records.shape, records.colour, records.slopes, records.fading, box, number)
    counts = np.array(number)
    seen = np.flatnonzero(counts)
    seen = seen[np.argsort(depth[seen], kind="stable")]
    members, first = _listed(records, lens, box, seen, counts[seen], camera.size)
    return Tiled(records, members, first)


def _listed(
    records: Records,
    lens: Lens,
    box: mi.UInt32,
    seen: NDArray[np.int64],
    counts: Places,
    size: tuple[int, int],
) -> tuple[mi.UInt32, Places]:
    """`Tiled.members` and `first`, of the splats seen, nearest first, each with so many tiles."""
    import mitsuba as mi

    columns, rows = (-(-side // TILE) for side in size)
    ends = np.cumsum(counts, dtype=np.int64)
    splats, tiles = [np.empty(0, dtype=np.uint32)], [np.empty(0, dtype=np.uint32)]
    held = 0
    for part in np.split(np.arange(len(seen)), np.flatnonzero(np.diff(ends // _CHUNK)) + 1):
        if not len(part):
            continue
        splat = np.repeat(seen[part].astype(np.uint32), counts[part])
        start = np.repeat(ends[part] - counts[part] - (ends[part[0]] - counts[part[0]]), counts[part])
        number = np.arange(len(splat), dtype=np.int64) - start
        which, where = (upload(mi.UInt32, widened(lane)) for lane in (splat, number))
        tile = np.array(_reached(records, lens, box, which, where, columns))[: len(splat)]
        reached = tile < columns * rows
        splats.append(splat[reached])
        tiles.append(tile[reached])
        held += len(splats[-1])
        if held > _MOST:
            raise FieldError(
                f"from this pose tiles of {TILE} x {TILE} pixels list more than {_MOST:.0e} splats together, "
                "beyond memory: move the camera out of the splats, or measure a smaller image (--size)"
            )
    splat, tile = np.concatenate(splats), np.concatenate(tiles)
    # NumPy sorts 16 bits by radix, in a tenth of the time.
    order = np.argsort(tile.astype(np.uint16) if columns * rows <= 1 << 16 else tile, kind="stable")
    first = np.concatenate([[0], np.cumsum(np.bincount(tile, minlength=columns * rows))]).astype(np.uint32)
    members = splat[order] if len(order) else np.zeros(1, dtype=np.uint32)
    return upload(mi.UInt32, members), first


def _reached(
    records: Records, lens: Lens, box: mi.UInt32, splat: mi.UInt32, number: mi.UInt32, columns: int
) -> mi.UInt32:
    """The tile of each pair, the number-th of its splat's box; beyond all if the window ends before."""
    import mitsuba as mi

    x0, y0, across, _ = dr.gather(mi.Vector4u, box, splat)
    across = dr.maximum(across, 1)  # of lanes that only fill up a vector it is 0
    x, y = x0 + number % across, y0 + number // across
    centre = lens.pair(3)
    mx, my, a, b = dr.gather(mi.Vector4f, records.film, splat)
    d, opacity, _, _ = dr.gather(mi.Vector4f, records.shape, splat)
    # From the splat's centre to the tile's first and last pixel centres
    low = mi.Vector2f(x * TILE, y * TILE) + 0.5 - centre - mi.Vector2f(mx, my)
    high = low + (TILE - 1.0)
    near = mi.Vector2f(dr.clip(0.0, low.x, high.x), dr.clip(0.0, low.y, high.y))

    def power(dx: mi.Float, dy: mi.Float) -> mi.Float:
        return 0.5 * (dr.square(a * dx + b * dy) + dr.square(d * dy))

    # Least on the sides that face the centre
    upright = power(near.x, dr.clip(-a * b * near.x / (b * b + d * d), low.y, high.y))
    level = power(dr.clip(-b / a * near.y, low.x, high.x), near.y)
    least = dr.minimum(
        dr.select(near.x != 0.0, upright, dr.inf),
        dr.select(near.y != 0.0, level, dr.inf),
    )
    least = dr.select((near.x == 0.0) & (near.y == 0.0), 0.0, least)
    reached = least <= dr.log(opacity / NEGLECTED)
    return dr.select(reached, y * columns + x, mi.UInt32(0xFFFFFFFF))
