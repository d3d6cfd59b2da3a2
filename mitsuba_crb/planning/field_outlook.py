"""The world of a field of views from outside, for pages that show it.

Only a few of the cameras are looked through to find what is around them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..measure.outlook import Looking, Outlook, Sight, outlook
from ..render.lending import in_turn
from .view_field import ViewField

_FEW = 40
_NOMINAL = np.array([[0.577, 0.433, 1.0], [-0.577, 0.433, 1.0], [-0.577, -0.433, 1.0], [0.577, -0.433, 1.0]])
"""Corners of the image of a camera that nobody knows: 60 degrees wide, four to three."""


@in_turn
def field_outlook(field: ViewField, world: Any, options: Mapping[str, Any] | None = None) -> Outlook:
    """What is around a field's cameras, and a few of these.

    Args:
        field: at least one view.
        world: loaded, from `world_at_hand`; None: there is none.
        options: of the measurement; default: what the store says of them, without its camera.
    """
    usable = np.flatnonzero(field.usable)
    views = usable if len(usable) else np.arange(len(field))
    few = views[np.unique(np.linspace(0, len(views) - 1, min(len(views), _FEW)).round().astype(int))]
    poses = [field.poses[view] for view in few]
    names = [f"view {view}" for view in few]
    if world is None:
        nothing = np.zeros((0, 3))
        words = "The world is not at hand, as its file is missing or was changed: cameras are drawn 60° wide"
        sights = tuple(Sight(name, pose, _NOMINAL) for name, pose in zip(names, poses, strict=True))
        return Outlook(nothing, nothing, nothing, words, sights)
    said = field.settings
    if options is None:
        size = said.get("size") if said.get("camera") is None else None
        options = {"sensor": said.get("sensor", 0), "size": None if size is None else tuple(size)}
    return outlook([Looking(world, options, {}, names, poses, images=False)])
