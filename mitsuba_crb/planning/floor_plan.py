"""The outlines of a scene cut by level planes, for a floor plan: what stands at a height, and what lower.

Level lines, along both axes of the plan, find where they cross surfaces. Each crossing is drawn as a short
piece of the surface's trace, as long as to the next line; of both families the one that crosses it more
steeply. So any kind of shape has an outline, meshes, spheres and instances alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..measure.opening import as_world
from ..radiance.field import Field
from ..render.lending import in_turn
from ..se3 import Array
from .plan_view import PlanView
from .surface_hits import crossings, hits

_LOWER = 0.25
"""Where the second outline is cut, from what is mostly below to the height."""
_DROPPED = 16
"""Rays down along each axis of the plan, that find what is below."""
_LINES = 360
"""Along each axis of the plan."""
_STEEP = np.sin(np.radians(44.0))
"""Sine of the angle between a line and a trace from which on this family of lines draws it."""
_LONG = 1.2
"""Pieces' length over what would just meet."""


@dataclass(frozen=True, eq=False)
class FloorPlan:
    """Outlines at two heights."""

    heights: tuple[float, ...]
    """Coordinates along the axis that is up [scene unit]."""
    pieces: tuple[Array, ...]
    """Of each, straight pieces (m, 2, 2): ends in the plan's coordinates."""


@in_turn
def floor_plan(world: Any, up: Array, low: Array, high: Array, height: float) -> FloorPlan | None:
    """What of a world stands at a height, and what lower; None of a radiance field, which has no surfaces.

    Args:
        world: any.
        up: (3,) unit vector.
        low, high: (2,) corners of the region, in the plan's coordinates.
        height: along the axis that is up [scene unit].

    Raises:
        MitsubaCRBError: the world cannot be loaded.
    """
    loaded, _ = as_world(world)
    if isinstance(loaded, Field):
        return None
    plan = PlanView.of(up)
    heights = [height]
    steps = (np.arange(_DROPPED) + 0.5) / _DROPPED
    grid = low + np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2) * (high - low)
    starts = plan.points(grid, height)
    drop = hits(loaded, starts, np.broadcast_to(-up, starts.shape)).distance
    if np.isfinite(drop).any():
        floor = height - float(np.median(drop[np.isfinite(drop)])) * np.sign(plan.axes[plan.up_axis] @ up)
        heights.append(floor + _LOWER * (height - floor))
    return FloorPlan(tuple(heights), tuple(_pieces(loaded, plan, low, high, each) for each in heights))


def _pieces(scene: Any, plan: PlanView, low: Array, high: Array, height: float) -> Array:
    """(m, 2, 2) at a height."""
    found = [np.empty((0, 2, 2))]
    size = float(np.linalg.norm(high - low))
    for along in (0, 1):
        across = 1 - along
        apart = (high[across] - low[across]) / _LINES
        starts = np.empty((_LINES, 2))
        starts[:, along] = low[along]
        starts[:, across] = low[across] + apart * (np.arange(_LINES) + 0.5)
        origins = plan.points(starts, height)
        direction = plan.axes[plan.level[along]]
        for rays, met in crossings(scene, origins, np.broadcast_to(direction, origins.shape), size):
            normal = plan.flat(met.normal)
            length = np.linalg.norm(normal, axis=1)
            inside = (met.distance <= high[along] - low[along]) & (length > 1e-6)
            trace = np.stack([-normal[:, 1], normal[:, 0]], axis=1)[inside] / length[inside, None]
            middle = starts[rays[inside]]
            middle[:, along] += met.distance[inside]
            steep = np.abs(trace[:, across]) >= _STEEP
            trace, middle = trace[steep], middle[steep]
            half = (0.5 * _LONG * apart / np.abs(trace[:, across]))[:, None] * trace
            found.append(np.stack([middle - half, middle + half], axis=1))
    return np.concatenate(found)
