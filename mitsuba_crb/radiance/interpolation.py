"""Features of a hash grid, and the window of occupied cells, between the corners of a cell; and their slopes.

    value = Σ_corners w value_corner,   w = Π_axes (f or 1 − f)

with f the place within the cell on each axis. The grid is Dr.Jit's: which entry a corner has, its class says;
the derivative in the position is added here, exact but on the faces of cells, where it jumps.
(`smooth_weight_gradients` of that class is not the derivative of what it interpolates.) What is carried back
to the entries is added up by each thread for itself, in half the time that it takes together.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import drjit as dr

if TYPE_CHECKING:
    import mitsuba as mi

Corner = tuple[tuple[int, int, int], Any, tuple[Any, Any, Any]]


def corners(f: mi.Vector3f) -> Iterator[Corner]:
    """The eight corners of a cell: where, the weight at f, and its slopes along the axes of f."""
    near = 1.0 - f
    for k in range(8):
        bits = (k & 1, k >> 1 & 1, k >> 2 & 1)
        x, y, z = (f[axis] if bits[axis] else near[axis] for axis in range(3))
        yz, xz, xy = y * z, x * z, x * y
        slopes = (yz if bits[0] else -yz, xz if bits[1] else -xz, xy if bits[2] else -xy)
        yield bits, x * yz, slopes


def encode(encoding: Any, u: mi.Vector3f, *, slopes: bool = False) -> tuple[list[Any], list[list[Any]]]:
    """Features of all levels at u in the unit cube, and if asked their three derivatives in u.

    Args:
        encoding: a `drjit.nn.HashGridEncoding` of two or four features per level.
    """
    import mitsuba as mi

    count = encoding.n_features_per_level
    kind = {2: mi.Vector2f, 4: mi.Vector4f}[count]
    features: list[Any] = []
    along: list[list[Any]] = [[], [], []]
    for level in range(encoding.n_levels):
        scale = encoding.base_resolution * encoding.per_level_scale**level - 1.0
        place = dr.fma(u, scale, 0.5)
        lower = dr.floor(place)
        cell = mi.Vector3u(lower)
        value, slope = kind(0.0), [kind(0.0) for _ in range(3)]
        for bits, weight, steepness in corners(mi.Vector3f(place - lower)):
            index = encoding.indexing_function(cell + mi.Vector3u(*bits), level)
            entry = dr.gather(kind, encoding.data, index, mode=dr.ReduceMode.Expand)
            value = dr.fma(entry, weight, value)
            if slopes:
                slope = [dr.fma(entry, s, total) for s, total in zip(steepness, slope, strict=True)]
        features += list(value)
        for axis in range(3):
            along[axis] += [scale * entry for entry in slope[axis]]
    return features, along


def window(byte: mi.UInt32, f: mi.Vector3f) -> tuple[mi.Float, mi.Vector3f]:
    """What density is multiplied by at f in a cell, 0 to 1, and its slopes along the axes of f.

    Args:
        byte: a bit for each corner that is occupied, in the order of `corners`.
        f: place in the cell; smoothed by 3f² − 2f³, so that slopes are 0 where cells meet.
    """
    import mitsuba as mi

    smooth = f * f * (3.0 - 2.0 * f)
    value, slope = mi.Float(0.0), mi.Vector3f(0.0)
    for k, (_, weight, steepness) in enumerate(corners(mi.Vector3f(smooth))):
        occupied = (byte & (1 << k)) != 0
        value += dr.select(occupied, weight, 0.0)
        slope += dr.select(occupied, mi.Vector3f(*steepness), 0.0)
    return value, mi.Vector3f(slope * (6.0 * f * (1.0 - f)))
