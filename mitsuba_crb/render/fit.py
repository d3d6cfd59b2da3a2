"""What a measurement wants of a scene, written into its nodes before anything is made of them.

An image of another shape: the film's size is set where the sensor is described, so that a field of view along
another axis than x, or a focal length, keeps its meaning. A child of a batch sensor: a sensor of its own,
with its share of the batch's film. An integrator that Mitsuba 3 does not have: a path tracer.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from .cures import innermost
from .instantiate import kind, reachable

if TYPE_CHECKING:
    import mitsuba as mi

_CROP = ("crop_width", "crop_height", "crop_offset_x", "crop_offset_y")
_KEPT = ("max_depth", "rr_depth", "hide_emitters")
"""Properties that path tracers have in common with others."""


@dataclass(frozen=True)
class Wanted:
    """What of a scene is going to be measured."""

    sensor: int | str = 0
    """Index in the file's order, or id."""
    size: tuple[int, int] | None = None
    """Width and height of the image [pixel]; None: the film's."""
    other_integrator: bool = False
    """The scene's own is not needed."""
    calibrated: bool = False
    """The sensor's lens is not needed."""
    apart: bool = False
    """Every mesh and material is an object of its own, for its parameters have names."""


def fit(state: mi.parser.ParserState, wanted: Wanted) -> list[str]:
    """Change the resolved nodes of a scene; returns what was left out or replaced, each in a sentence."""
    notes = _fit_integrator(state, wanted)
    sensor = _sensor(state, wanted.sensor)
    if sensor is None:
        return notes
    if wanted.size is not None:
        notes += _resize(state, sensor, wanted.size)
    return notes


def find(names: list[str], which: int | str) -> int | None:
    """Index of a sensor by its id or, if none has it, by a whole number; perhaps out of range."""
    if isinstance(which, str):
        if which and which in names:
            return names.index(which)
        return int(which) if re.fullmatch(r"-?\d+", which) else None
    return int(which)


def _children(state: mi.parser.ParserState, index: int, of: str) -> Iterator[tuple[str, int]]:
    """Key and index of each node of a kind that a node holds."""
    import mitsuba as mi

    for key, value in state.nodes[index].props.items():
        if isinstance(value, mi.Properties.ResolvedReference) and kind(state.nodes[value.index()]) == of:
            yield key, value.index()


def _added(state: mi.parser.ParserState, node: mi.parser.SceneNode) -> mi.Properties.ResolvedReference:
    import mitsuba as mi

    state.nodes.append(node)
    return mi.Properties.ResolvedReference(len(state.nodes) - 1)


def _sensor(state: mi.parser.ParserState, which: int | str) -> int | None:
    """The node of a sensor; a child of a batch becomes a sensor of the scene."""
    sensors = [index for _, index in _children(state, 0, "Sensor")]
    names = [state.nodes[index].props.id() for index in sensors]
    place = find(names, which)
    if isinstance(which, str) and which not in names:
        for batch in sensors:
            parts = [index for _, index in _children(state, batch, "Sensor")]
            for number, part in enumerate(parts):
                if which in (state.nodes[part].props.id(), f"{sensors.index(batch)}:{number}"):
                    return _alone(state, batch, part, len(parts), which)
    return sensors[place] if place is not None and 0 <= place < len(sensors) else None


def _alone(state: mi.parser.ParserState, batch: int, part: int, count: int, name: str) -> int:
    """Make a child of a batch a sensor of the scene, as the batch uses it."""
    import mitsuba as mi

    film = next((index for _, index in _children(state, batch, "Film")), None)
    node = mi.parser.SceneNode(state.nodes[part])
    if "fov_axis" in node.props or "focal_length" in node.props:
        # The batch gives its children another film and leaves the horizontal field of view that they had.
        x_fov = _x_fov(state, part)
        for key in ("fov_axis", "focal_length"):
            if key in node.props:
                del node.props[key]
        node.props["fov"] = x_fov
    node.props.set_id(name)
    own = mi.parser.SceneNode(state.nodes[film]) if film is not None else _plain_film(node)
    for key in _CROP:
        if key in own.props:
            del own.props[key]
    own.props["width"] = int(own.props.get("width", 768)) // count
    own.props["height"] = int(own.props.get("height", 576))
    key = next((key for key, _ in _children(state, part, "Film")), "film")
    node.props[key] = _added(state, own)
    reference = _added(state, node)
    state.nodes[0].props[f"part of a batch: {name}"] = reference
    return int(reference.index())


def _x_fov(state: mi.parser.ParserState, sensor: int) -> float:
    """Horizontal field of view [deg] that a sensor's node describes, with the film that it has there."""
    import mitsuba as mi

    own = mi.parser.ParserState(state)
    own.nodes[0] = mi.parser.SceneNode(own.nodes[sensor])
    config = mi.parser.ParserConfig(mi.variant())
    config.unused_properties = mi.LogLevel.Debug
    made = mi.parser.instantiate(config, own)
    made = made[0] if isinstance(made, list) else made
    return float(mi.traverse(made)["x_fov"][0])


def _plain_film(sensor: mi.parser.SceneNode) -> mi.parser.SceneNode:
    """Mitsuba's default film, described where a sensor is."""
    import mitsuba as mi

    node = mi.parser.SceneNode(sensor)
    node.type, node.props = mi.ObjectType.Film, mi.Properties("hdrfilm")
    return node


def _resize(state: mi.parser.ParserState, sensor: int, size: tuple[int, int]) -> list[str]:
    """Give a sensor's film another size, and no crop window."""
    import mitsuba as mi

    key, film = next(_children(state, sensor, "Film"), ("film", None))
    held = [value for _, value in state.nodes[sensor].props.items() if isinstance(value, mi.Object)]
    if any(isinstance(value, mi.Film) for value in held):
        return []
    own = mi.parser.SceneNode(state.nodes[film]) if film is not None else _plain_film(state.nodes[sensor])
    cropped = [name for name in _CROP if name in own.props]
    for name in cropped:
        del own.props[name]
    own.props["width"], own.props["height"] = size
    # Of its own, for other sensors may have this film, too.
    state.nodes[sensor].props[key] = _added(state, own)
    return [CROP_DROPPED] if cropped else []


CROP_DROPPED = "the film's crop window is left out: the size that was asked for is the whole film's"


def _fit_integrator(state: mi.parser.ParserState, wanted: Wanted) -> list[str]:
    import mitsuba as mi

    found = [*_children(state, 0, "Integrator"), *_children(state, 0, "Unknown")]
    found = [(key, index) for key, index in found if _is_integrator(state, key, index)]
    if wanted.other_integrator:
        for key, _ in found:
            del state.nodes[0].props[key]
        return []
    notes = []
    for key, index in found:
        name = state.nodes[index].props.plugin_name()
        if _can_be_made(name):
            continue
        inside = next((child for _, child in _children(state, index, "Integrator")), None)
        if inside is not None:
            state.nodes[0].props[key] = mi.Properties.ResolvedReference(inside)
            other = state.nodes[inside].props.plugin_name()
        else:
            other = "volpath" if any(kind(state.nodes[i]) == "Medium" for i in reachable(state)) else "path"
            _replace(state, index, other)
        notes.append(replaced(name, other))
    return notes


def replaced(name: str, other: str) -> str:
    """The sentence that says that another integrator is used."""
    return f"integrator {name} gives no radiance for a ray here: {other} is used in its place"


def _is_integrator(state: mi.parser.ParserState, key: str, index: int) -> bool:
    """Of what a dictionary names, the kind of an unknown plugin is not known."""
    return kind(state.nodes[index]) == "Integrator" or key == "integrator"


def _can_be_made(name: str) -> bool:
    import mitsuba as mi

    try:
        mi.load_dict({"type": name})
    except Exception as error:  # also what it lacks here, and has in the scene
        return not re.search(r"not found$|polarized", innermost(error)[1])
    return True


def _replace(state: mi.parser.ParserState, index: int, name: str) -> None:
    """Put a path tracer in place of an integrator's node."""
    import mitsuba as mi

    old, new = state.nodes[index].props, mi.Properties(name)
    new.set_id(old.id())
    for key in _KEPT:
        if key in old:
            new[key] = old[key]
    state.nodes[index].props = new
    state.nodes[index].type = mi.ObjectType.Integrator
