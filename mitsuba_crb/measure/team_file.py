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

    [[agents]]
    name = "rear"
    scene = "hall.xml"
    camera = "rig.yaml:cam1"
    measure = "rgbd"
    depth_sigma = "stereo:0.05,0.1"
    range = [0.4, 5]

`TeamTable` and the tables in it say which keys there are, and what they mean.

Poses are x y z qx qy qz qw or 4x4 matrices, conventions as in `se3`. Everything is checked here, before
anything is rendered; a key that nobody knows is an error that names the near one.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, NonNegativeInt

from .. import noise, se3
from ..agents.quantisation import Form, Precision
from ..camera import Intrinsics
from ..datasets.intrinsics import file_and_name, load_camera
from ..errors import CameraError, ConfigError, NoiseError, OptionError, PoseError
from ..files import Table, checked, expected, read_toml
from ..noise import NoiseModel
from ..render.demos import scene_path
from ..se3 import Array
from .options import MeasurementOptions
from .sensing import DEPTH, parse_depth_sigma

Size = Annotated[tuple[int, int], Field(strict=False), expected("width and height in whole pixels")]
Range = Annotated[tuple[float, float], Field(strict=False), expected("the lowest and the highest depth")]


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
    """A file beside this one, or "demo:NAME"."""
    sensor: int | str = 0
    """Index or id."""
    pose: list[Any] | None = None
    """world_from_camera; default: the sensor's own."""
    body_from_agent: list[Any] | None = None
    """Default: from the two poses."""
    noise: float | str | dict[str, Any] | None = None
    """Sigma of Gaussian noise, a table as in `noise.schema`, or the name of a file beside this one with such
    a table; default as for `bound`."""
    camera: str | None = None
    """"FILE" or "FILE:NAME", a calibration beside this file in place of the sensor's, which is scaled to the
    measurement's size."""
    measure: str | None = None
    """colour, depth or rgbd; tiles are of colour or of depth."""
    channels: str | None = None
    """Of colour: rgb, luminance, red, green or blue."""
    depth_sigma: float | str | None = None
    """Standard deviation of depth [scene unit], "stereo:BASELINE,PIXELS", or the name of a file beside this
    one with depths and standard deviations in two columns."""
    range: Range | None = None
    """Depths that are measured [scene unit]."""
    depth_edges: bool | None = None
    """Whether depth is measured at edges, too."""
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
    sensing: dict[str, Any]
    """`MeasurementOptions` of its own: its camera, and what it measures."""
    files: tuple[Path, ...]
    """What it is read from."""

    @property
    def is_metered(self) -> bool:
        """Whether it is the default camera, whose noise follows from its exposure."""
        return self.noise is None and self.sensing.get("measure") != DEPTH


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

    @property
    def files(self) -> list[Path]:
        """What it is read from, which no output may overwrite."""
        return [self.path, *(file for member in self.members for file in member.files)]

    def options(self, member: Member) -> dict[str, Any]:
        """A member's measurement options; its seed depends on its name, not on its place in the file."""
        words = [self.measure.get("seed", 0), *member.name.encode()]
        seed = int(np.random.SeedSequence(words).generate_state(1, np.uint64)[0])
        options = {**self.measure, "sensor": member.sensor, "pose": member.pose, "seed": seed}
        options |= member.sensing
        if not member.is_metered:
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
    """Read a team's file, or that of "demo:NAME".

    Raises:
        SceneError: there is no such demo.
        CameraError: a calibration cannot be used.
        ConfigError: no such file or scene, not TOML, a key that nobody knows, a value of the wrong type, no
            agents, or two of one name.
        OptionError: an agent cannot measure this, or not all of it.
        PoseError: a pose or transform is no rigid motion.
        NoiseError: an impossible noise.
    """
    path = scene_path(path, ".toml")
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
    scene = path.parent / scene_path(table.scene)
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
        sensing=_sensing(table, path.parent, where),
        files=tuple(_files(table, path.parent)),
    )


def _files(table: AgentTable, folder: Path) -> Iterator[Path]:
    """Those that exist of the names in a table."""
    camera = [] if table.camera is None else [file_and_name(table.camera, folder)[0]]
    texts = [text for text in (table.scene, table.noise, table.depth_sigma) if isinstance(text, str)]
    yield from (file for file in [*camera, *(folder / text for text in texts)] if os.path.isfile(file))


def _sensing(table: AgentTable, folder: Path, where: str) -> dict[str, Any]:
    """Those options that the table says."""
    sigma: Any = table.depth_sigma
    try:
        if table.measure == DEPTH and table.noise is not None:
            raise OptionError("noise is of colour, and depth_sigma of depth; leave out noise")
        if isinstance(sigma, str):
            sigma = parse_depth_sigma(sigma, "depth_sigma", folder)
        said: dict[str, Any] = {
            "camera": _camera(table.camera, folder),
            "measure": table.measure,
            "channels": table.channels,
            "depth_sigma": sigma,
            "depth_range": table.range,
            "depth_edges": table.depth_edges,
        }
        sensing = {name: value for name, value in said.items() if value is not None}
        MeasurementOptions(**sensing)
    except (CameraError, NoiseError, OptionError) as error:
        raise type(error)(f"{where}: {error}") from None
    return sensing


def _camera(text: str | None, folder: Path) -> Intrinsics | None:
    try:
        return None if text is None else load_camera(*file_and_name(text, folder))
    except CameraError as error:
        raise CameraError(f"camera: {error}") from None


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
