"""A team of agents from a TOML file: who looks at which scene, with what noise, and what may be sent.

    [body]
    name = "formation"

    [measure]
    size = [128, 96]
    spp = 64

    [tiles]
    size = 16
    precision = "float16"

    [[agents]]
    name = "front"
    scene = "hall.xml"
    sensor = "left"
    pose = [1, 0, 2, 0, 0, 0, 1]
    noise = 0.01
    budget = 8
    defines = { width = 64 }

`TeamTable` and the tables in it say which keys there are, and what they mean.

Poses are x y z qx qy qz qw or 4x4 matrices, conventions as in `se3`. Everything is checked here, before
anything is rendered; a key that nobody knows is an error that names the near one.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, NonNegativeInt

from .. import noise, se3
from ..errors import ConfigError, NoiseError, PoseError
from ..files import Table, checked, expected, read_toml
from ..noise import NoiseModel
from ..se3 import Array
from .quantisation import Form, Precision

Size = Annotated[tuple[int, int], Field(strict=False), expected("width and height in whole pixels")]


class BodyTable(Table):
    """The pose that all agents have in common."""

    name: str = "body"
    pose: list[Any] | None = None
    """world_from_body; default: the first agent's camera."""


class MeasureTable(Table):
    """`MeasurementOptions` of all agents; every agent gets random numbers of its own."""

    size: Size | None = None
    spp: int | None = None
    precision: float | None = None
    max_spp: int | None = None
    seed: NonNegativeInt | None = None
    batches: int | None = None
    method: str | None = None
    integrator: str | None = None
    drop_invalid: bool | None = None
    exposure: Annotated[float | Literal["auto"], expected("a radiance, or 'auto'")] | None = None
    clip: bool | None = None


class TilesTable(Table):
    """What `tile_information` is told, for `select`."""

    size: Annotated[int | Size, expected("a whole number of pixels, or two, width and height")] | None = None
    """Side, or width and height [pixel]."""
    form: Form | None = None
    """Of the messages whose size is the tiles' cost."""
    precision: Precision | None = None
    rank: int | None = None


class AgentTable(Table):
    """One agent."""

    name: str
    scene: str
    """A file beside this one."""
    sensor: int | str = 0
    """Index or id."""
    pose: list[Any] | None = None
    """world_from_camera; default: the sensor's own."""
    body_from_agent: list[Any] | None = None
    """Default: from the two poses."""
    noise: float | str | dict[str, Any] | None = None
    """Sigma of Gaussian noise, a table as in `noise.schema`, or the name of a file beside this one with such
    a table; default as for `bound`."""
    budget: NonNegativeInt | None = None
    """Tiles that it may send."""
    bytes: NonNegativeInt | None = None
    """Bytes that it may send."""
    defines: dict[str, str | int | float | bool] = Field(default={})
    """The scene's `<default>`s."""


class TeamTable(Table):
    """The whole file."""

    body: BodyTable = BodyTable()
    measure: MeasureTable = MeasureTable()
    tiles: TilesTable = TilesTable()
    agents: list[AgentTable] = Field(default=[])


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
    """`tile_size`, `form`, `message_precision` and `rank` of `tile_information`."""

    def options(self, member: Member) -> dict[str, Any]:
        """A member's measurement options; its seed depends on its name, not on its place in the file."""
        words = [self.measure.get("seed", 0), *member.name.encode()]
        seed = int(np.random.SeedSequence(words).generate_state(1, np.uint64)[0])
        options = {**self.measure, "sensor": member.sensor, "pose": member.pose, "seed": seed}
        if member.noise is not None:  # its camera is another than the default one
            options = {name: value for name, value in options.items() if name not in ("exposure", "clip")}
        return options

    def transforms(self, poses: Sequence[Array]) -> list[Array]:
        """(4, 4) each, body_from_agent of all members whose cameras are at these poses in the world."""
        given = [member.body_from_agent for member in self.members]
        world_from_body = self.world_from_body
        if world_from_body is None:
            world_from_body = poses[0] @ se3.inverse(np.eye(4) if given[0] is None else given[0])
        body_from_world = se3.inverse(world_from_body)
        return [body_from_world @ p if g is None else g for p, g in zip(poses, given, strict=True)]


_OF_TILES = {"size": "tile_size", "precision": "message_precision"}
"""What a file's keys are called in `tile_information`."""


def load_team(path: Path) -> Team:
    """Read a team's file.

    Raises:
        ConfigError: no such file or scene, not TOML, a key that nobody knows, a value of the wrong type, no
            agents, or two of one name.
        PoseError: a pose or transform is no rigid motion.
        NoiseError: an impossible noise.
    """
    table = checked(TeamTable, read_toml(path, ConfigError), ConfigError, str(path))
    if not table.agents:
        raise ConfigError(f"{path} lists no agents: add [[agents]] with a name and a scene")
    members = tuple(_member(agent, path) for agent in table.agents)
    names = [member.name for member in members]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ConfigError(f"{path}: agent names must differ, but {', '.join(map(repr, twice))} occurs twice")
    tiles = table.tiles.model_dump(exclude_unset=True)
    return Team(
        path=path,
        body=table.body.name,
        world_from_body=_pose(table.body.pose, f"{path}: [body]: pose"),
        members=members,
        measure=table.measure.model_dump(exclude_unset=True),
        tiles={_OF_TILES.get(key, key): value for key, value in tiles.items()},
    )


def _member(table: AgentTable, path: Path) -> Member:
    where = f"{path}: agent {table.name!r}"
    scene = path.parent / table.scene
    if not os.path.isfile(scene):
        raise ConfigError(f"{where}: no scene file at {scene}")
    return Member(
        name=table.name,
        scene=scene,
        sensor=table.sensor,
        pose=_pose(table.pose, f"{where}: pose"),
        body_from_agent=_pose(table.body_from_agent, f"{where}: body_from_agent"),
        noise=_noise(table.noise, path.parent, where),
        tiles=table.budget,
        bytes=table.bytes,
        defines={key: str(value) for key, value in table.defines.items()},
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


def _pose(numbers: list[Any] | None, where: str) -> Array | None:
    try:
        return None if numbers is None else se3.pose_from_numbers(numbers)
    except PoseError as error:
        raise PoseError(f"{where}: {error}") from None
