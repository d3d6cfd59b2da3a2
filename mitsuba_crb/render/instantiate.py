"""Objects of a scene's nodes, and all that keeps Mitsuba from making them.

Mitsuba stops at the first fault. So a node that it cannot make is put aside for a plain one of its kind and
the others made, until it has named everything; then properties that nothing has read are named as well.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .cures import cured, innermost, property_cure
from .scene_file import at

if TYPE_CHECKING:
    import mitsuba as mi

_MOST = 20
"""Nodes that are put aside."""

_PLAIN = {
    "Sensor": "perspective",
    "Film": "hdrfilm",
    "Sampler": "independent",
    "Integrator": "path",
    "Shape": "rectangle",
    "BSDF": "diffuse",
    "Emitter": "point",
    "Texture": "checkerboard",
    "Volume": "constvolume",
    "Medium": "homogeneous",
    "PhaseFunction": "isotropic",
    "ReconstructionFilter": "box",
}
"""A plugin of each kind that needs no properties."""

_NEEDED = {"bitmap": ("filename", "bitmap", "data"), "blendbsdf": ("weight",)}
"""Of plugins that end the process without any of these properties."""

_UNNEEDED = ("Sampler", "Film", "Integrator")
"""Kinds whose unknown properties do not change what is measured."""


def instantiate(
    config: mi.parser.ParserConfig, state: mi.parser.ParserState, file: Path | None
) -> tuple[Any, list[str], list[str]]:
    """The object of the root node, or None; what is wrong; and properties that were left out.

    Args:
        config: of the parser.
        state: all nodes, resolved.
        file: the scene's.
    """
    import mitsuba as mi

    # Which properties are unused is asked of the nodes below, of all of them.
    config.unused_properties = mi.LogLevel.Debug
    found = dict.fromkeys(_lacking(state, file))
    made = None
    for _ in range(_MOST):
        own = mi.parser.ParserState(state)  # whose nodes will hold what is made of them
        for node in own.nodes:
            for key in node.props.keys():  # noqa: SIM118  not a dictionary
                node.props.mark_queried(key, False)
        try:
            made = mi.parser.instantiate(config, own)
            break
        except Exception as error:  # Mitsuba's plugins raise RuntimeError and others
            where, cause = innermost(error)
            found[f"{at(where, file)}{cured(cause)}"] = None
            if not _put_aside(state, where, cause):
                break
    unknown, left_out = _unread(state, own, file)
    faults = [*found, *unknown]
    if isinstance(made, list) and len(made) == 1:
        made = made[0]
    return (None if faults else made), faults, left_out


def _lacking(state: mi.parser.ParserState, file: Path | None) -> Iterator[str]:
    """Name and put aside the nodes that would end the process."""
    import mitsuba as mi

    for index in sorted(reachable(state)):
        node = state.nodes[index]
        name = node.props.plugin_name()
        needed = _NEEDED.get(name, ())
        if needed and not any(key in node.props for key in needed):
            where = mi.parser.file_location(state, node)
            cause = f'{kind(node).lower()} "{name}": property "{needed[0]}" cannot be found'
            yield f"{at(where, file)}{cured(cause)}"
            _put_aside(state, where, cause)


def reachable(state: mi.parser.ParserState) -> Iterator[int]:
    """Indices of the nodes that the root consists of."""
    import mitsuba as mi

    waiting, seen = [0], {0}
    while waiting:
        index = waiting.pop()
        yield index
        props = state.nodes[index].props
        for _, value in props.items():
            if isinstance(value, mi.Properties.ResolvedReference) and value.index() not in seen:
                seen.add(value.index())
                waiting.append(value.index())


def kind(node: mi.parser.SceneNode) -> str:
    """Of object: "Sensor", "Film" and so on."""
    return str(node.type).rpartition(".")[2]


def _put_aside(state: mi.parser.ParserState, where: str, cause: str) -> bool:
    """Put a plain object in place of the one that failed there."""
    import mitsuba as mi

    name = re.search(r'"([^"]*)"', cause)
    for index in reachable(state):
        node = state.nodes[index]
        if mi.parser.file_location(state, node) != where or kind(node) not in _PLAIN:
            continue
        plain = _PLAIN[kind(node)]
        if node.props.plugin_name() == plain or not name or node.props.plugin_name() != name.group(1):
            continue
        if kind(node) in _UNNEEDED and cause.endswith("not found"):  # whose properties may be unknown, too
            node.props.set_plugin_name(plain)
            return True
        kept = mi.Properties("area" if kind(node) == "Emitter" and _in_shape(state, index) else plain)
        kept.set_id(node.props.id())
        if kind(node) in ("Shape", "Sensor"):  # what it holds may have faults of its own
            for key, value in node.props.items():
                if isinstance(value, mi.Properties.ResolvedReference):
                    kept[key] = value
        node.props = kept
        return True
    return False


def _in_shape(state: mi.parser.ParserState, child: int) -> bool:
    import mitsuba as mi

    return any(
        isinstance(value, mi.Properties.ResolvedReference) and value.index() == child
        for index in reachable(state)
        if kind(state.nodes[index]) == "Shape" and state.nodes[index].props.plugin_name() != "merge"
        for _, value in state.nodes[index].props.items()
    )


def _unread(
    state: mi.parser.ParserState, read: mi.parser.ParserState, file: Path | None
) -> tuple[list[str], list[str]]:
    """Properties that no plugin has asked for: faults, and such as do not matter."""
    import mitsuba as mi

    faults, left_out = [], []
    for index in sorted(reachable(state)):
        node = state.nodes[index]
        name, of = node.props.plugin_name(), kind(node)
        for key in read.nodes[index].props.unqueried():
            if of in _UNNEEDED:
                left_out.append(f"{key} of {of.lower()} {name}")
            elif not isinstance(node.props[key], mi.Properties.ResolvedReference):
                place = at(mi.parser.file_location(state, node), file)
                faults.append(f"{place}{of.lower()} {name} has no property {key}; {property_cure(key)}")
    return faults, left_out
