"""Measures a team's agents in parallel processes, and fuses them or chooses their tiles.

Every agent's random numbers follow from its name, so that the results do not depend on the number of
processes (`processes`).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..agents.fusion import Agent, Fusion, fuse
from ..agents.selection import TileSelection, select_tiles
from ..agents.tiles import Budget, TileInformation, about_common_body
from ..bound.cramer_rao import PoseBound
from ..errors import MitsubaCRBError
from ..files import Record
from ..processes import in_processes
from ..render.backend import same_variant
from ..render.lending import in_turn
from ..render.scene import SceneFile
from .exposure import exposed, start_metering
from .measurement import measurement
from .pose import pose_bound
from .sensing import COLOUR, OF_DEPTH
from .team_file import Member, Team
from .tile_jacobian import TileJacobian
from .tiles import tile_information

T = TypeVar("T")
Progress = Callable[[int, int], None]
"""Called after each agent with the agents done and all of them."""

CURVE_POINTS = 10


@dataclass(frozen=True, eq=False)
class Job:
    """What a process needs to measure one agent."""

    member: Member
    """The agent."""
    options: dict[str, Any]
    """Its `MeasurementOptions`."""
    tiles: dict[str, Any]
    """What else `tile_information` takes."""


@dataclass(frozen=True, eq=False)
class TeamFusion(Record):
    """What a team knows together, and what each agent knows alone."""

    fusion: Fusion
    """About the common body."""
    bounds: tuple[PoseBound, ...]
    """About each agent's own camera, in the team's order."""
    warnings: tuple[str, ...]
    """What happened on the way, the agent or the body named."""


@dataclass(frozen=True, eq=False)
class TeamSelection(Record):
    """Which tiles a team should send."""

    selection: TileSelection
    """Under the budget asked for."""
    curve: tuple[tuple[int, TileSelection], ...]
    """The same for several budgets: tiles or bytes in total, ascending."""
    counts: Literal["tiles", "bytes"]
    """What the curve's budgets count."""
    agents: tuple[TileInformation, ...]
    """All tiles, about the common body, in the team's order."""
    images: tuple[NDArray[np.float32], ...]
    """(H, W, 3) each agent's image [radiance]."""
    warnings: tuple[str, ...]
    """What happened on the way."""


def fuse_team(team: Team, *, workers: int | None = None, on_agent: Progress | None = None) -> TeamFusion:
    """The joint bound of a team's common body.

    Args:
        team: from `load_team`.
        workers: processes; None: one per agent, but no more than there are cores. 1 spawns none.
        on_agent: called after each agent.

    Raises:
        MitsubaCRBError: as `pose_bound` and `fuse`, the agent named.
    """
    bounds, texts = _each(_bound, team, workers, on_agent, _exposures(team, workers))
    transforms = team.transforms([bound.information.pose for bound in bounds])
    agents = [
        Agent(member.name, bound.information, transform)
        for member, bound, transform in zip(team.members, bounds, transforms, strict=True)
    ]
    fusion = fuse(agents, variable=team.body)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        _ = fusion.bound  # which warns when it is first asked for, and is kept
    joint = dict.fromkeys(f"{team.body}: {warning.message}" for warning in caught)
    return TeamFusion(fusion, tuple(bounds), (*texts, *joint))


def select_team(
    team: Team,
    budget: Budget,
    *,
    objective: Literal["logdet", "trace", "lambda_min"] = "logdet",
    workers: int | None = None,
    on_agent: Progress | None = None,
) -> TeamSelection:
    """The tiles that a team should send under a budget, and what other budgets would be worth.

    Args:
        team: from `load_team`; its agents' budgets hold where `budget` has no limit per agent.
        budget: limits on tiles and bytes, in total and per agent.
        objective: as for `select_tiles`.
        workers: as for `fuse_team`.
        on_agent: called after each agent.

    Raises:
        MitsubaCRBError: as `tile_information` and `select_tiles`, the agent named.
    """
    measured, texts = _each(_tiles, team, workers, on_agent, _exposures(team, workers))
    own, images = zip(*measured, strict=True)
    agents = about_common_body(own, team.transforms([tiles.pose for tiles in own]), variable=team.body)
    limits = replace(
        budget,
        tiles_per_agent=_per_agent(budget.tiles_per_agent, {m.name: m.tiles for m in team.members}),
        bytes_per_agent=_per_agent(budget.bytes_per_agent, {m.name: m.bytes for m in team.members}),
    )
    counts: Literal["tiles", "bytes"] = "bytes" if limits.tiles is None and limits.bytes else "tiles"
    exist = sum(int(a.cost_bytes.sum()) if counts == "bytes" else len(a.tiles) for a in agents)
    asked = getattr(limits, counts)
    top = exist if asked is None else min(2 * asked, exist)
    points = np.unique(np.linspace(0, top, CURVE_POINTS + 1).round().astype(int)[1:]).tolist()
    selections = [select_tiles(agents, replace(limits, **{counts: n}), objective=objective) for n in points]
    # What no choice exceeds under a larger budget, none exceeds under a smaller one.
    for smaller, larger in reversed(list(pairwise(range(len(points))))):
        selections[smaller] = selections[smaller].bounded(selections[larger].upper_bound)
    return TeamSelection(
        selection=select_tiles(agents, limits, objective=objective),
        curve=tuple(zip(points, selections, strict=True)),
        counts=counts,
        agents=tuple(agents),
        images=images,
        warnings=texts,
    )


def _per_agent(
    asked: int | Mapping[str, int] | None, own: Mapping[str, int | None]
) -> int | Mapping[str, int] | None:
    """A limit for all agents if one was asked for, otherwise each agent's own."""
    return {name: limit for name, limit in own.items() if limit is not None} if asked is None else asked


def _exposures(team: Team, workers: int | None) -> dict[str, dict[str, Any]]:
    """One exposure for all default cameras but those that say theirs, by name, from their pooled values."""
    metered = tuple(member for member in team.members if member.is_metered)
    if len(metered) < 2 or team.measure.get("exposure") is not None:
        return {}
    found, _ = _each(_metered, replace(team, members=metered), workers, None)
    values = {
        member.name: part.reshape(2, -1)
        for member, part in zip(metered, found, strict=True)
        if part is not None
    }
    exposure = exposed(*np.concatenate(list(values.values()), axis=1)) if len(values) > 1 else None
    # Of one alone, and where all is black, each says for itself.
    return {} if exposure is None else {name: {"exposure": exposure.white} for name in values}


@in_turn
def _metered(job: Job) -> NDArray[np.float64] | None:
    options = {name: value for name, value in job.options.items() if name not in OF_DEPTH}
    options["measure"] = COLOUR
    with measurement(SceneFile(job.member.scene, job.member.defines), **options) as run:
        return None if run.view.white is not None else start_metering(run.view, run.options.seed)()


class _Outcome(NamedTuple):
    """What became of one agent's job, in whichever process; warnings and error name the agent."""

    result: Any
    warnings: list[Warning]
    error: MitsubaCRBError | None


def _each(
    measure: Callable[[Job], T],
    team: Team,
    workers: int | None,
    on_agent: Progress | None,
    further: Mapping[str, dict[str, Any]] | None = None,
) -> tuple[list[T], tuple[str, ...]]:
    """What is measured of every member, in the team's order, and what was warned of, each once.

    Args:
        further: options of some of them, by name.

    Warns:
        If a member fails, of what it has warned before.
    """
    jobs = [
        (measure, Job(member, team.options(member) | (further or {}).get(member.name, {}), team.tiles))
        for member in team.members
    ]
    outcomes: dict[int, _Outcome] = {}
    with closing(in_processes(_outcome, jobs, workers, prepare=same_variant())) as ended:
        for index, outcome in ended:
            if outcome.error is not None:
                for warning in outcome.warnings:
                    warnings.warn(warning, stacklevel=3)
                raise outcome.error
            outcomes[index] = outcome
            if on_agent is not None:
                on_agent(len(outcomes), len(jobs))
    ordered = [outcomes[index] for index in range(len(jobs))]
    texts = dict.fromkeys(str(warning) for outcome in ordered for warning in outcome.warnings)
    return [outcome.result for outcome in ordered], tuple(texts)


def _outcome(work: tuple[Callable[[Job], Any], Job]) -> _Outcome:
    measure, job = work
    result, failure = None, None
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            result = measure(job)
        except MitsubaCRBError as error:
            failure = type(error)(f"agent {job.member.name!r}: {error}")
    named = [warning.category(f"{job.member.name}: {warning.message}") for warning in caught]
    return _Outcome(result, named, failure)


def _bound(job: Job) -> PoseBound:
    member = job.member
    return pose_bound(SceneFile(member.scene, member.defines), member.noise, **job.options)


def _tiles(job: Job) -> tuple[TileInformation, NDArray[np.float32]]:
    member = job.member
    parts: list[tuple[NDArray[np.int64], NDArray[np.float64]]] = []

    def on_tile(part: TileJacobian, done: int, total: int) -> None:
        parts.append((part.pixels, part.mean))

    information = tile_information(
        SceneFile(member.scene, member.defines),
        member.noise,
        agent=member.name,
        on_tile=on_tile,
        **job.tiles,
        **job.options,
    )
    x, y, width, height = information.tiles.T
    image = np.full((int((y + height).max()), int((x + width).max()), 3), np.nan, np.float32)
    for pixels, mean in parts:
        image[pixels[:, 1], pixels[:, 0]] = mean
    return information, image
