"""A team of agents from a TOML file: who looks at which scene, with what noise, and what may be sent.

    [body]                            # the pose that all agents have in common
    name = "formation"                # default "body"
    pose = [0, 0, 2, 0, 0, 0, 1]      # world_from_body; default: the first agent's camera

    [measure]                         # as for `bound`; every agent gets random numbers of its own
    size = [128, 96]                  # width and height in pixels
    spp = 64                          # also seed, batches, method, integrator, drop_invalid

    [tiles]                           # for `select`
    size = 16                         # side, or width and height, in pixels
    precision = "float16"             # of the messages whose size is the cost; also form, rank

    [[agents]]
    name = "front"
    scene = "hall.xml"                # beside this file
    sensor = "left"                   # index or id; default 0
    pose = [1, 0, 2, 0, 0, 0, 1]      # world_from_camera; default: the sensor's own
    body_from_agent = [...]           # default: from the two poses
    noise = 0.01                      # sigma of Gaussian noise, a table as in `noise.schema`, or the name of
                                      # a file beside this one with such a table; default as for `bound`
    budget = 8                        # tiles that it may send; also bytes
    defines = { width = 64 }          # the scene's <default>s

Poses are x y z qx qy qz qw or 4x4 matrices, conventions as in `se3`. Everything is checked here, before
anything is rendered; a key that nobody knows is an error that names the near one.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np

from .. import noise, se3
from ..errors import ConfigError, NoiseError, PoseError
from ..files import read_toml
from ..noise import NoiseModel
from ..se3 import Array

_SECTIONS = {"body": dict, "measure": dict, "tiles": dict, "agents": list}
_BODY = {"name": str, "pose": list}
_MEASURE = {
    "size": list,
    "spp": int,
    "seed": int,
    "batches": int,
    "method": str,
    "integrator": str,
    "drop_invalid": bool,
}
_TILES = {"size": (int, list), "form": str, "precision": str, "rank": int}
_AGENT = {
    "name": str,
    "scene": str,
    "sensor": (int, str),
    "pose": list,
    "body_from_agent": list,
    "noise": (int, float, str, dict),
    "budget": int,
    "bytes": int,
    "defines": dict,
}
_KINDS = {
    int: "a whole number",
    float: "a number",
    str: "a text",
    list: "a list",
    dict: "a table",
    bool: "true or false",
}


@dataclass(frozen=True, eq=False)
class Member:
    """One agent of a team."""

    name: str
    """Unique in the team."""
    scene: Path
    """The scene's file."""
    sensor: int | str
    """Index or id."""
    pose: Array | None
    """(4, 4), world_from_camera; None is the sensor's own."""
    body_from_agent: Array | None
    """(4, 4), where it sits on the body; None follows from its pose and the body's."""
    noise: NoiseModel | None
    """None as for `pose_bound`."""
    tiles: int | None
    """How many tiles it may send; None is no limit."""
    bytes: int | None
    """How many bytes it may send; None is no limit."""
    defines: dict[str, str]
    """The scene's defaults to set."""


@dataclass(frozen=True, eq=False)
class Team:
    """Agents and what they have in common."""

    path: Path
    """The file."""
    body: str
    """Name of the common body."""
    world_from_body: Array | None
    """(4, 4); None: where the first agent puts it."""
    members: tuple[Member, ...]
    """At least one, with different names."""
    measure: dict[str, Any]
    """`MeasurementOptions` of all."""
    tiles: dict[str, Any]
    """`tile_size`, `form`, `precision` and `rank` of `tile_information`."""

    def options(self, member: Member) -> dict[str, Any]:
        """A member's measurement options; its seed depends on its name, not on its place in the file."""
        words = [self.measure.get("seed", 0), *member.name.encode()]
        seed = int(np.random.SeedSequence(words).generate_state(1, np.uint64)[0])
        return {**self.measure, "sensor": member.sensor, "pose": member.pose, "seed": seed}

    def transforms(self, poses: Sequence[Array]) -> list[Array]:
        """(4, 4) each, body_from_agent of all members whose cameras are at these poses in the world."""
        given = [member.body_from_agent for member in self.members]
        world_from_body = self.world_from_body
        if world_from_body is None:
            world_from_body = poses[0] @ se3.inverse(np.eye(4) if given[0] is None else given[0])
        body_from_world = se3.inverse(world_from_body)
        return [body_from_world @ p if g is None else g for p, g in zip(poses, given, strict=True)]


def load_team(path: Path) -> Team:
    """Read a team's file.

    Raises:
        ConfigError: no such file or scene, not TOML, a key that nobody knows, a value of the wrong type, no
            agents, or two of one name.
        PoseError: a pose or transform is no rigid motion.
        NoiseError: an impossible noise.
    """
    document = read_toml(path, ConfigError)
    _check(document, _SECTIONS, str(path))
    sections = {name: document.get(name, {}) for name in ("body", "measure", "tiles")}
    for name, schema in (("body", _BODY), ("measure", _MEASURE), ("tiles", _TILES)):
        _check(sections[name], schema, f"{path}: [{name}]")
    body, measure, tiles = sections.values()
    _check_signs(measure, ("seed",), f"{path}: [measure]")
    members = tuple(_member(table, k, path) for k, table in enumerate(document.get("agents", []), 1))
    if not members:
        raise ConfigError(f"{path} lists no agents: add [[agents]] with a name and a scene")
    names = [member.name for member in members]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ConfigError(f"{path}: agent names must differ, but {', '.join(map(repr, twice))} occurs twice")
    return Team(
        path=path,
        body=body.get("name", "body"),
        world_from_body=_pose(body, "pose", f"{path}: [body]"),
        members=members,
        measure={key: tuple(value) if key == "size" else value for key, value in measure.items()},
        tiles={
            "tile_size" if key == "size" else key: tuple(value) if isinstance(value, list) else value
            for key, value in tiles.items()
        },
    )


def _member(table: Any, number: int, path: Path) -> Member:
    where = f"{path}: agent {number}"
    if not isinstance(table, dict):
        raise ConfigError(f"{where} is {table!r}; write every agent as a table [[agents]]")
    if isinstance(table.get("name"), str):
        where = f"{path}: agent {table['name']!r}"
    _check(table, _AGENT, where)
    missing = [key for key in ("name", "scene") if key not in table]
    if missing:
        raise ConfigError(f"{where} has no {missing[0]}")
    _check_signs(table, ("budget", "bytes"), where)
    scene = path.parent / table["scene"]
    if not os.path.isfile(scene):
        raise ConfigError(f"{where}: no scene file at {scene}")
    return Member(
        name=table["name"],
        scene=scene,
        sensor=table.get("sensor", 0),
        pose=_pose(table, "pose", where),
        body_from_agent=_pose(table, "body_from_agent", where),
        noise=_noise(table.get("noise"), path.parent, where),
        tiles=table.get("budget"),
        bytes=table.get("bytes"),
        defines={key: str(value) for key, value in table.get("defines", {}).items()},
    )


def _noise(value: Any, folder: Path, where: str) -> NoiseModel | None:
    try:
        if isinstance(value, str):
            return noise.load(folder / value)
        if isinstance(value, dict):
            return noise.from_dict(value, folder=folder)
        return None if value is None else noise.Gaussian(value)
    except NoiseError as error:
        raise NoiseError(f"{where}: {error}") from None


def _pose(table: Mapping[str, Any], key: str, where: str) -> Array | None:
    if key not in table:
        return None
    try:
        return se3.pose_from_numbers(table[key])
    except PoseError as error:
        raise PoseError(f"{where}: {key}: {error}") from None


def _check_signs(table: Mapping[str, Any], keys: Sequence[str], where: str) -> None:
    for key in keys:
        if table.get(key, 0) < 0:
            raise ConfigError(f"{where}: {key} is negative: {table[key]}")


def _check(table: Mapping[str, Any], schema: Mapping[str, Any], where: str) -> None:
    """Refuse keys that the schema does not have, and values of other types."""
    for key, value in table.items():
        if key not in schema:
            near = get_close_matches(key, schema, 1)
            hint = f"did you mean {near[0]!r}?" if near else f"known are {', '.join(schema)}"
            raise ConfigError(f"{where} has an unknown key {key!r}; {hint}")
        kinds = schema[key] if isinstance(schema[key], tuple) else (schema[key],)
        if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
            expected = " or ".join(_KINDS[kind] for kind in kinds if not (kind is int and float in kinds))
            raise ConfigError(f"{where}: {key} must be {expected}, not {value!r}")
