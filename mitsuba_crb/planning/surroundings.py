"""How far a world reaches, where its own camera stands, and what is up there."""

from __future__ import annotations

import itertools
import math
import warnings
from dataclasses import dataclass
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import FieldError, OptionError, PoseError, SceneWarning
from ..measure.field_view import cameras_of
from ..measure.opening import as_world, open_measurable, wanted
from ..measure.options import MeasurementKeywords, MeasurementOptions
from ..radiance.field import Field
from ..render.fit import Wanted
from ..render.lending import turns
from ..se3 import Array

if TYPE_CHECKING:
    import mitsuba as mi

_LEVEL = 1e-3
"""Sine of the angle from level up to which a camera's own x is level, as that of a look_at is."""
_NEAR_ONES = 6
_UPRIGHT = math.cos(math.radians(15.0))


@dataclass(frozen=True, eq=False)
class Surroundings:
    """A world, seen from afar."""

    corners: Array | None
    """(n, 3) points whose box is the world's: a scene's corners, a field's cameras; None: unknown."""
    centre: Array | None
    """(3,) where its own camera stands; None: nowhere."""
    up: Array | None
    """(3,) the world's axis that is up by that camera; of a field, see `candidates_of`."""


def surroundings(world: Any, options: MeasurementKeywords) -> Surroundings:
    """Of anything that can be measured.

    Args:
        world: any, loaded or not.
        options: of the measurement; the sensor's pose is read, not a pose that they give.
    """
    asked: MeasurementKeywords = {**options, "pose": None}
    with turns, warnings.catch_warnings():
        warnings.simplefilter("ignore", SceneWarning)  # said again when it is measured
        loaded, _ = as_world(world, wanted(MeasurementOptions(**asked)))
        try:
            with open_measurable(loaded, MeasurementOptions(**asked)) as view:
                pose = view.pose
        except (PoseError, FieldError):
            pose = None
        if isinstance(loaded, Field):
            return _of_field(loaded, pose)
        corners = box_corners(loaded)
    if pose is None:
        return Surroundings(corners, None, None)
    return Surroundings(corners, pose[:3, 3], _upright(pose))


def box_corners(scene: mi.Scene) -> Array | None:
    """The eight corners of a scene's box; None if nothing is in it."""
    # Not the scene's own, which leaves out merged meshes.
    boxes = np.array([shape_box(shape) for shape in scene.shapes()]).reshape(-1, 2, 3)
    boxes = boxes[np.isfinite(boxes).all(axis=(1, 2))]
    if not len(boxes):
        return None
    low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
    return np.asarray(list(itertools.product(*zip(low, high, strict=True))))


def shape_box(shape: mi.Shape) -> Array:
    """(2, 3) lowest and highest corner of a shape's box; of merged meshes Mitsuba has none."""
    if shape.is_mesh():
        vertices = np.array(shape.vertex_positions_buffer(), dtype=np.float64).reshape(-1, 3)
        return np.array([vertices.min(axis=0), vertices.max(axis=0)])
    box = shape.bbox()
    return np.array([np.array(box.min), np.array(box.max)], dtype=np.float64)


def shape_centre(world: Any, name: str) -> Array:
    """The middle of the box of the shape of this id.

    Raises:
        OptionError: there is none, or the world has no shapes.
    """
    with turns, warnings.catch_warnings():
        warnings.simplefilter("ignore", SceneWarning)
        loaded, label = as_world(world, Wanted(apart=True))
        if isinstance(loaded, Field):
            raise OptionError(f"--poses around: {label} is a field, without shapes; say target=X:Y:Z")
        boxes = {shape.id(): shape_box(shape) for shape in loaded.shapes() if shape.id()}
    if name not in boxes:
        near = get_close_matches(name, boxes, _NEAR_ONES, 0.5) or sorted(boxes)[:_NEAR_ONES]
        known = f"shapes are {', '.join(near)}" if near else "no shape has an id"
        raise OptionError(f"--poses around: no shape of {label} is called {name!r}; {known}")
    return np.asarray(boxes[name].mean(axis=0))


def mean_up(poses: Array) -> Array:
    """(3,) of cameras at poses (n, 4, 4), their mean up; a world's axis if one is within 15 degrees of it."""
    mean = poses[:, :3, 1].mean(axis=0)
    length = float(np.linalg.norm(mean))
    if length < 1e-6:  # they look in all directions: none is up
        return np.array([0.0, 0.0, 1.0])
    mean = mean / length
    which = int(np.argmax(np.abs(mean)))
    if abs(mean[which]) >= _UPRIGHT:
        return np.asarray(np.eye(3)[which] * np.sign(mean[which]))
    return np.asarray(mean)


def _of_field(loaded: Field, pose: Array | None) -> Surroundings:
    try:
        poses = np.array([viewpoint.pose for viewpoint in cameras_of(loaded)[0]])
    except FieldError:
        return Surroundings(None, None, None)
    centres = poses[:, :3, 3]
    corners = centres if np.ptp(centres, axis=0).any() else None
    return Surroundings(corners, None if pose is None else pose[:3, 3], mean_up(poses))


def _upright(pose: Array) -> Array:
    """The world's axis that is most likely up: level cameras have it across their own x."""
    across, own_up = np.abs(pose[:3, 0]), pose[:3, 1]
    likely = np.where(across < _LEVEL, 1.0, 0.0) if (across < _LEVEL).any() else np.ones(3)
    which = int(np.argmax(likely * np.abs(own_up)))
    return np.asarray(np.eye(3)[which] * (-1.0 if own_up[which] < 0.0 else 1.0))
