"""Which pixels of a depth camera measure a depth, found on a lattice of rays finer than the pixels.

A pixel measures nothing if within its filter a ray escapes, or meets what is nearer or farther than the
camera's range; nor, by default, if one surface ends in front of another there: a filtered step of two metres
at σ = 1 cm would locate the edge to 0.005 pixels, which no sensor does (design section 12).

An edge lies between two neighbouring points of the lattice where the surfaces through them do not meet. With
inverse depth w, which is linear over the image of a plane, and the tangent planes at both points, the planes
meet between the points if one is in front at one point, and the other at the other. So a corner is no edge,
neither is what is smooth, however slanted. Of what is thinner than the lattice, parts may slip through.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from .arrays import download, upload
from .pixels import first_hit
from .rays import camera_ray, move_ray, opaque_transform

if TYPE_CHECKING:
    from ..noise.measured import DepthPixels
    from .view import View

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

LATTICE = 4
"""Rays across a pixel."""
_OFF = (0.0618, -0.0382)
"""Of the lattice from its even place, over its spacing: there models have seams, and rays slip through."""
STEP = 0.005
"""Of the depth: a smaller step from one surface to the next is no edge."""
_CHUNK = 1 << 20
"""Rays at once, about."""

REASONS = ("escaped", "out of range", "occlusion edge")
"""Why a pixel measures nothing; of several the first."""


@dataclass(frozen=True)
class DepthMap:
    """What becomes of each pixel."""

    reason: NDArray[np.int64]
    """(H, W) index in `REASONS`; −1 where a depth is measured."""

    @property
    def measured(self) -> Bools:
        """(H, W)"""
        return self.reason < 0

    def counts(self) -> dict[str, int]:
        """Pixels that measure, and those that do not by reason."""
        found = {"measured": int(self.measured.sum())}
        return found | {name: int(np.sum(self.reason == k)) for k, name in enumerate(REASONS)}


def depth_map(view: View, pixels: DepthPixels) -> DepthMap:
    """Of a view, at its pose."""
    width, height = view.size
    radius = view.pixel_filter.radius
    rim = int(np.ceil(LATTICE * radius))
    x = (np.arange(-rim, LATTICE * width + rim) + 0.5 + _OFF[0]) / LATTICE
    rows = max(1, _CHUNK // (LATTICE * len(x)))
    reason = np.empty((height, width), dtype=np.int64)
    for start in range(0, height, rows):
        stop = min(height, start + rows)
        y = (np.arange(LATTICE * start - rim, LATTICE * stop + rim) + 0.5 + _OFF[1]) / LATTICE
        reason[start:stop] = _reasons(view, pixels, x, y, radius, (width, stop - start))
    return DepthMap(reason)


def _reasons(
    view: View, pixels: DepthPixels, x: Floats, y: Floats, radius: float, size: tuple[int, int]
) -> NDArray[np.int64]:
    """Of the pixels under a lattice of columns x and rows y, with a rim as wide as the filter's radius."""
    seen, tangent, depth, plane = tangent_planes(view, x, y)
    escaped, broken = ~seen, np.zeros_like(seen)
    for axis in (0, 1):
        here = [slice(None)] * 2
        there = list(here)
        here[axis], there[axis] = slice(None, -1), slice(1, None)
        a, b = tuple(here), tuple(there)
        lost = seen[a] != seen[b]
        apart = seen[a] & seen[b] & _apart(tangent, depth, plane, a, b)
        for side in (a, b):
            escaped[side] |= lost
            broken[side] |= apart
    outside = seen & ~((depth >= pixels.lowest) & (depth <= pixels.highest))
    found = np.full(size[::-1], -1)
    causes = [escaped, outside] if pixels.edges else [escaped, outside, broken]
    for k, cause in reversed(list(enumerate(causes))):
        found[_within(cause, radius, size)] = k
    return found


def tangent_planes(view: View, x: Floats, y: Floats) -> tuple[Bools, Floats, Floats, Floats]:
    """Whether rays through film points (y, x) hit; s = (x/z, y/z, 1), depths z, and planes, plane·s = 1/z.

    Tangent to what is hit, in the camera frame.
    """
    import mitsuba as mi

    shape = (len(y), len(x))
    film = mi.Point2f(*(upload(mi.Float, part.ravel()) for part in np.meshgrid(x, y)))
    ray, _ = camera_ray(view, film, mi.Point2f(0.5, 0.5))
    transform = opaque_transform(view.pose)
    world_ray = move_ray(ray, transform)
    hit = first_hit(view, world_ray)
    distance = ray.o.z / ray.d.z + dr.dot(hit.p - world_ray.o, world_ray.d)
    normal = transform.inverse() @ mi.Vector3f(hit.n)
    parts = [download(part) for part in (ray.d, normal, mi.Vector3f(ray.d * distance))]
    direction, normal_, point = (part.T.reshape(*shape, 3) for part in parts)
    seen = np.array(hit.is_valid()).reshape(shape)
    with np.errstate(all="ignore"):  # a plane through the camera is of no depth
        plane = normal_ / np.sum(normal_ * point, axis=-1, keepdims=True)
    return seen, direction / direction[..., 2:], point[..., 2], plane


def _apart(
    tangent: Floats, depth: Floats, plane: Floats, a: tuple[slice, ...], b: tuple[slice, ...]
) -> Bools:
    """Whether the surfaces through neighbours a and b of a lattice do not meet between them."""
    with np.errstate(all="ignore"):
        at_a = depth[a] * np.sum(plane[b] * tangent[a], axis=-1) - 1.0
        at_b = 1.0 - depth[b] * np.sum(plane[a] * tangent[b], axis=-1)
        meet = (at_a * at_b <= 0.0) | (np.minimum(np.abs(at_a), np.abs(at_b)) < STEP)
    return np.asarray(~meet)


def _within(lattice: Bools, radius: float, size: tuple[int, int]) -> Bools:
    """(H, W) whether any point of a lattice with this rim lies in a pixel's filter."""
    total = np.zeros((lattice.shape[0] + 1, lattice.shape[1] + 1), dtype=np.int64)
    total[1:, 1:] = np.cumsum(np.cumsum(lattice, axis=0), axis=1)
    rim = int(np.ceil(LATTICE * radius))
    # A pixel's middle is half a pixel from its first point, and as far as the rim from the lattice's.
    x, y = (LATTICE * np.arange(n) + LATTICE // 2 for n in size)
    across, down = x + 2 * rim, y + 2 * rim
    counted = total[np.ix_(down, across)] - total[np.ix_(y, across)] - total[np.ix_(down, x)]
    return np.asarray(counted + total[np.ix_(y, x)] > 0)
