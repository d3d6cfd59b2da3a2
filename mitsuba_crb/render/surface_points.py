"""A scene's surfaces as coloured points, for those who look at it from outside.

A third of the points are what the cameras see. The others are where random lines through their surroundings
meet a surface: lines that are uniform in a ball meet all surfaces in it in proportion to their area, whatever
kind of shape they are (Crofton), instances and signed distances included.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from .arrays import upload

if TYPE_CHECKING:
    import mitsuba as mi

Floats = NDArray[np.float64]

_THROUGH = 12
"""Surfaces of a line, at most."""
_RIM = 95.0
"""Percentile of what is seen that the ball reaches to: a ground without an end would take all lines."""
_GREY = 0.45
"""Of a surface without a diffuse colour, such as a mirror."""


class SurfacePoints(NamedTuple):
    """Where surfaces are, and what they look like."""

    positions: Floats
    """(n, 3) [scene unit]."""
    colours: Floats
    """(n, 3) diffuse reflectance, or radiance of what shines, linear RGB from 0 to 1."""
    normals: Floats
    """(n, 3) unit vectors, towards the cameras of surfaces that have two sides."""


class _Cone(NamedTuple):
    """A camera, as far as rays go."""

    pose: Floats
    corners: Floats
    """(4, 3) directions of the image's corners at depth one, in the camera's frame."""


def surface_points(
    scene: mi.Scene, cameras: Sequence[tuple[Floats, Floats]], count: int, seed: int = 0
) -> SurfacePoints:
    """Points on a scene's surfaces, near what some cameras see.

    Args:
        scene: an `mi.Scene`.
        cameras: of each the pose (4, 4), and directions of the image's corners (4, 3) at depth one.
        count: of the points, at most.
        seed: of their places.
    """
    rng = np.random.default_rng(seed)
    cones = [_Cone(*camera) for camera in cameras]
    eyes = np.array([cone.pose[:3, 3] for cone in cones])
    seen = _first_hits(scene, *_rays(cones, count, rng), eyes)
    ends = np.concatenate([seen.positions, eyes])
    centre = np.mean([eyes.mean(axis=0), np.median(ends, axis=0)], axis=0)
    distance = np.linalg.norm(ends - centre, axis=1)
    radius = 1.2 * max(float(np.percentile(distance, _RIM)), float(distance[len(seen.positions) :].max()))
    origins, directions = _lines(centre, radius, count, rng)
    met = _all_hits(scene, origins, directions, 2.0 * radius, eyes)
    inside = np.linalg.norm(met.positions - centre, axis=1) <= radius
    near = np.linalg.norm(seen.positions - centre, axis=1) <= 2.0 * radius
    parts = [_some(seen, near, count // 3, rng)]
    parts.append(_some(met, inside, count - len(parts[0].positions), rng))
    return SurfacePoints(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _rays(cones: Sequence[_Cone], count: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Through random places of the images, as many of each."""
    each = -(-count // len(cones))
    origins, directions = [], []
    for cone in cones:
        x, y = rng.random((2, each, 1))
        first, second, third, fourth = cone.corners  # around the image
        local = (1 - y) * ((1 - x) * first + x * second) + y * ((1 - x) * fourth + x * third)
        directions.append(local @ cone.pose[:3, :3].T)
        origins.append(np.broadcast_to(cone.pose[:3, 3], local.shape))
    return np.concatenate(origins), np.concatenate(directions)


def _lines(centre: Floats, radius: float, count: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Uniform in a ball: of a random direction, through a random point of the disc across it."""
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    across = np.cross(directions, rng.normal(size=(count, 3)))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    offset = radius * np.sqrt(rng.random((count, 1))) * across
    return centre + offset - radius * directions, directions


def _first_hits(scene: mi.Scene, origins: Floats, directions: Floats, eyes: Floats) -> SurfacePoints:
    return _hits(scene, _ray(origins, directions), eyes)[0]


def _all_hits(
    scene: mi.Scene, origins: Floats, directions: Floats, length: float, eyes: Floats
) -> SurfacePoints:
    import mitsuba as mi

    ray = _ray(origins, directions)
    found = []
    left = mi.Float(length)
    for _ in range(_THROUGH):
        ray.maxt = left
        points, hit = _hits(scene, ray, eyes)
        found.append(points)
        valid = hit.is_valid()
        if not len(points.positions):
            break
        left = dr.select(valid, left - hit.t, 0.0)
        ray = hit.spawn_ray(ray.d)
        dr.eval(ray, left)
    return SurfacePoints(*(np.concatenate(columns) for columns in zip(*found, strict=True)))


def _ray(origins: Floats, directions: Floats) -> mi.Ray3f:
    import mitsuba as mi

    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return mi.Ray3f(
        mi.Point3f(*(upload(mi.Float, column) for column in origins.T)),
        mi.Vector3f(*(upload(mi.Float, column) for column in unit.T)),
    )


def _hits(scene: mi.Scene, ray: mi.Ray3f, eyes: Floats) -> tuple[SurfacePoints, mi.SurfaceInteraction3f]:
    """Where rays meet a surface first, and those hits themselves."""
    import mitsuba as mi

    hit = scene.ray_intersect(ray)
    valid = hit.is_valid()
    surface = hit.bsdf(ray)
    colour = mi.Color3f(surface.eval_diffuse_reflectance(hit, valid))
    lamp = hit.emitter(scene)
    shines = valid & (lamp != None)  # noqa: E711 — of arrays of pointers
    front = mi.SurfaceInteraction3f(hit)
    front.wi = mi.Vector3f(0.0, 0.0, 1.0)  # lamps shine on one side
    colour = dr.select(shines, mi.Color3f(lamp.eval(front, shines)), colour)
    two_sided = (surface.flags() & mi.BSDFFlags.BackSide.value) != 0
    values = (np.array(v).T for v in (valid, two_sided, mi.Point3f(hit.p), mi.Vector3f(hit.n), colour))
    good, both, positions, normals, colours = values
    good, both = np.broadcast_to(good, len(positions)), np.broadcast_to(both, len(positions))
    positions, normals = positions[good].astype(np.float64), normals[good].astype(np.float64)
    colours, both = np.clip(np.nan_to_num(colours[good].astype(np.float64)), 0.0, 1.0), both[good]
    colours[~colours.any(axis=1)] = _GREY
    nearest = eyes[np.argmin(np.linalg.norm(positions[:, None] - eyes, axis=2), axis=1)]
    away = np.einsum("ij,ij->i", normals, nearest - positions) < 0.0
    normals[both & away] *= -1.0
    return SurfacePoints(positions, colours, normals), hit


def _some(
    points: SurfacePoints, mask: NDArray[np.bool_], count: int, rng: np.random.Generator
) -> SurfacePoints:
    index = np.flatnonzero(mask)
    if len(index) > count:
        index = rng.choice(index, count, replace=False)
    return SurfacePoints(*(column[index] for column in points))
