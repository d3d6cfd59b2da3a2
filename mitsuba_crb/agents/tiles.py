"""What agents can send, tile by tile, and under which budgets.

A tile is a rectangle of one agent's image; its information about a pose adds to every other tile's, because
the noise of different pixels is independent. All 6 x 6 blocks are in the body frame of their pose, with
translation in units of a length scale (`se3`). Once they are about the one pose that the agents have in
common (`about_common_body`), they may simply be added.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from numbers import Integral
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import se3
from ..errors import FrameError, SelectionError
from ..files import Record
from ..information.linearisation import Linearised
from ..information.symmetric import symmetrised
from ..se3 import Array
from .fusion import refuse_two_places


@dataclass(frozen=True, eq=False)
class TileInformation(Linearised):
    """One agent's tiles, each with two independent estimates of its information about one pose.

    The pose is the camera's, or that of the body that all agents have in common; the blocks are in its own
    frame, with translation in units of the length scale.
    """

    agent: str
    """The agent's name."""
    tiles: NDArray[np.int64]
    """(T, 4): each tile's left column x, top row y, width and height in the agent's image [pixel]."""
    select: Array
    """(T, 6, 6) from one half of the batches, to choose by; unbiased, so possibly indefinite."""
    report: Array
    """(T, 6, 6) from the other half, to report; unbiased, so possibly indefinite."""
    cost_bytes: NDArray[np.int64]
    """(T,), size of the message that carries the tile [byte]."""
    correlated_noise: bool = False
    """Whether noise is correlated between the pixels of different tiles; such tiles do not add."""

    def __post_init__(self) -> None:
        tiles = _integers(self.tiles, f"the tiles of agent {self.agent!r}")
        if tiles.ndim != 2 or tiles.shape[1] != 4:
            raise SelectionError(
                f"agent {self.agent!r}: tiles must have shape (T, 4), x y width height, not {tiles.shape}"
            )
        if (tiles[:, 2:] < 1).any():
            raise SelectionError(f"agent {self.agent!r}: a tile has no width or no height")
        cost = _integers(self.cost_bytes, f"the costs of agent {self.agent!r}")
        if cost.shape != (len(tiles),) or (cost < 1).any():
            raise SelectionError(
                f"agent {self.agent!r}: cost_bytes must be {len(tiles)} positive numbers, one per tile"
            )
        if self.frame != "camera":
            raise FrameError(
                f"agent {self.agent!r}: tiles are in the camera frame, not in the {self.frame} frame"
            )
        checked: dict[str, NDArray[Any]] = {"tiles": tiles, "cost_bytes": cost}
        checked |= {name: self._blocks(name, len(tiles)) for name in ("select", "report")}
        for name, array in checked.items():
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    def _blocks(self, name: str, count: int) -> Array:
        try:
            blocks = np.array(getattr(self, name), dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise SelectionError(f"agent {self.agent!r}: {name} is no array of numbers: {error}") from None
        if blocks.shape != (count, 6, 6):
            raise SelectionError(
                f"agent {self.agent!r}: {name} must have shape ({count}, 6, 6) for {count} tiles, "
                f"not {blocks.shape}"
            )
        if not np.isfinite(blocks).all():
            bad = int(np.count_nonzero(~np.isfinite(blocks).all(axis=(1, 2))))
            raise SelectionError(f"agent {self.agent!r}: {name} is not finite in {bad} of {count} tiles")
        skewness = np.abs(blocks - blocks.swapaxes(1, 2)).max(axis=(1, 2), initial=0.0)
        if (skewness > 1e-9 * np.abs(blocks).max(axis=(1, 2), initial=0.0)).any():
            raise SelectionError(f"agent {self.agent!r}: {name} has blocks that are not symmetric")
        return symmetrised(blocks)


@dataclass(frozen=True)
class Budget(Record):
    """How much may be sent; None is no limit. A limit per agent is one number for all, or one by name."""

    tiles: int | None = None
    """Tiles in total."""
    tiles_per_agent: int | Mapping[str, int] | None = None
    """Tiles of every agent; agents that a mapping leaves out have no limit."""
    bytes: int | None = None
    """Bytes in total."""
    bytes_per_agent: int | Mapping[str, int] | None = None
    """Bytes of every agent; agents that a mapping leaves out have no limit."""

    def __post_init__(self) -> None:
        for name in ("tiles", "tiles_per_agent", "bytes", "bytes_per_agent"):
            value = getattr(self, name)
            limits = value.values() if isinstance(value, Mapping) else [value]
            for limit in limits:
                if limit is not None and (not isinstance(limit, Integral) or isinstance(limit, bool)):
                    raise SelectionError(f"the budget {name} must be a whole number, not {limit!r}")
                if limit is not None and limit < 0:
                    raise SelectionError(f"the budget {name} is negative: {limit}")


@dataclass(frozen=True, eq=False)
class Limits:
    """What is left of a budget, infinite where there is no limit."""

    agent_tiles: Array
    """(A,), tiles of each agent."""
    agent_bytes: Array
    """(A,), bytes of each agent."""
    tiles: float
    """Tiles in total."""
    bytes: float
    """Bytes in total."""

    def fits(self, agent: NDArray[np.int64], cost: Array) -> NDArray[np.bool_]:
        """Which of some tiles (m,), of these agents and costs, could be sent next."""
        room = np.minimum(self.agent_bytes, self.bytes)
        open_agents = (self.agent_tiles >= 1.0) & (self.tiles >= 1.0)
        fitting: NDArray[np.bool_] = open_agents[agent] & (cost <= room[agent])
        return fitting

    def after(self, agent: int, cost: float) -> Limits:
        """What is left when a tile has been sent."""
        agent_tiles, agent_bytes = self.agent_tiles.copy(), self.agent_bytes.copy()
        agent_tiles[agent] -= 1.0
        agent_bytes[agent] -= cost
        return Limits(agent_tiles, agent_bytes, self.tiles - 1.0, self.bytes - cost)

    @property
    def counts_tiles(self) -> bool:
        """Whether the number of tiles is limited."""
        return bool(np.isfinite(self.tiles) or np.isfinite(self.agent_tiles).any())

    @property
    def counts_bytes(self) -> bool:
        """Whether the number of bytes is limited."""
        return bool(np.isfinite(self.bytes) or np.isfinite(self.agent_bytes).any())


@dataclass(frozen=True, eq=False)
class Problem:
    """Maximise f(base + Σ chosen blocks) within the limits."""

    base: Array
    """(6, 6), F_0."""
    blocks: Array
    """(n, 6, 6), positive semi-definite."""
    agent: NDArray[np.int64]
    """(n,), index of each tile's agent."""
    cost: Array
    """(n,), bytes."""
    limits: Limits

    def __len__(self) -> int:
        return len(self.blocks)

    def information(self, chosen: Sequence[int]) -> Array:
        """(6, 6), base + Σ of the chosen blocks."""
        return np.asarray(self.base + self.blocks[list(chosen)].sum(axis=0), dtype=np.float64)

    def sending(self, tile: int) -> Problem:
        """The problem that is left when a tile has been sent."""
        rest = self.without(tile)
        limits = self.limits.after(int(self.agent[tile]), float(self.cost[tile]))
        return replace(rest, base=self.base + self.blocks[tile], limits=limits)

    def without(self, tile: int) -> Problem:
        """The problem with one tile removed."""
        keep = np.arange(len(self)) != tile
        return self.restricted(keep)

    def restricted(self, keep: NDArray[np.bool_]) -> Problem:
        """The problem with only these tiles."""
        return replace(self, blocks=self.blocks[keep], agent=self.agent[keep], cost=self.cost[keep])

    def simplified(self) -> Problem:
        """The same problem for whole tiles with as few kinds of limits as possible.

        Tiles that do not fit by themselves go, and limits that cannot bind become infinite; a byte limit on
        tiles of equal cost is a limit on their number, for which relaxations are tighter and guarantees hold.
        """
        kept = self.restricted(self.limits.fits(self.agent, self.cost))
        agents = len(self.limits.agent_tiles)
        agent_tiles, agent_bytes = self.limits.agent_tiles.copy(), self.limits.agent_bytes.copy()
        lowest, highest = np.full(agents, np.inf), np.zeros(agents)
        np.minimum.at(lowest, kept.agent, kept.cost)
        np.maximum.at(highest, kept.agent, kept.cost)
        tiles, total = self.limits.tiles, self.limits.bytes
        uniform = lowest == highest
        affordable = np.floor(agent_bytes[uniform] / lowest[uniform])
        agent_tiles[uniform] = np.minimum(agent_tiles[uniform], affordable)
        agent_bytes[uniform] = np.inf
        if len(kept) and lowest.min() == highest.max():
            tiles, total = min(tiles, float(np.floor(total / highest.max()))), np.inf
        # Where the agents' own limits add up to less than the total, the total cannot bind.
        counts = np.bincount(kept.agent, minlength=agents).astype(np.float64)
        sizes = np.bincount(kept.agent, weights=kept.cost, minlength=agents)
        tiles = np.inf if np.minimum(agent_tiles, counts).sum() <= tiles else tiles
        total = np.inf if np.minimum(agent_bytes, sizes).sum() <= total else total
        agent_tiles[agent_tiles >= np.minimum(counts, tiles)] = np.inf
        agent_bytes[agent_bytes >= np.minimum(sizes, total)] = np.inf
        return replace(kept, limits=Limits(agent_tiles, agent_bytes, tiles, total))


def about_common_body(
    agents: Sequence[TileInformation], common_from_agents: Sequence[ArrayLike], *, variable: str = "body"
) -> list[TileInformation]:
    """Tiles about each agent's own pose, made tiles about the pose of the body that they all sit on.

    Every block becomes Aᵀ F A, A = Ad(agent_from_common) (`fusion`), in units of the largest length scale;
    messages name the body in place of the camera. The pose is that of the first agent by name.

    Args:
        agents: as `tile_information` gives them.
        common_from_agents: (4, 4) each, in the agents' order: where they sit on the body.
        variable: the body's name.

    Raises:
        PoseError: a transform is no rigid motion.
        FrameError: the agents put the body in different places.
    """
    transforms = [se3.as_pose(transform) for transform in common_from_agents]
    bodies = {
        agent.agent: agent.pose @ se3.inverse(transform)
        for agent, transform in zip(agents, transforms, strict=True)
    }
    first = min(bodies, default="")
    length = max((agent.length_scale for agent in agents), default=1.0)
    common = []
    for agent, transform in zip(agents, transforms, strict=True):
        reach = float(max(np.abs(agent.pose).max(), np.abs(transform).max()))
        refuse_two_places(agent.agent, bodies[agent.agent], first, bodies[first], reach=reach)
        about = replace(agent.linearisation, variable=variable, pose=bodies[first], length_scale=length)
        A = se3.adjoint(se3.inverse(transform)) * about.scale / agent.scale[:, None]
        common.append(
            replace(
                agent,
                select=A.T @ agent.select @ A,
                report=A.T @ agent.report @ A,
                cost_bytes=agent.cost_bytes + len(variable.encode()) - len(agent.variable.encode()),
                linearisation=about,
            )
        )
    return common


def correlated_refusal(agents: Sequence[str]) -> str:
    """Why tiles of agents with such noise are refused."""
    return (
        f"the noise of {', '.join(map(repr, agents))} is correlated between pixels: Σ⁻¹ couples tiles, so "
        "their information does not add and no sum over tiles is what a receiver would know; select with a "
        "noise model of independent pixels"
    )


def check_agents(agents: Sequence[TileInformation]) -> None:
    """Refuse agents whose tiles cannot be added.

    Raises:
        SelectionError: no agents, two of the same name, or correlated noise.
        FrameError: the agents' blocks are about different poses or in different units.
    """
    if not agents:
        raise SelectionError("there are no agents to choose tiles from")
    names = [agent.agent for agent in agents]
    twice = sorted({name for name in names if names.count(name) > 1}) if len(set(names)) < len(names) else []
    if twice:
        raise SelectionError(f"agent names must differ, but {', '.join(map(repr, twice))} occurs twice")
    correlated = [agent.agent for agent in agents if agent.correlated_noise]
    if correlated:
        raise SelectionError(correlated_refusal(correlated))
    first = agents[0]
    for other in agents[1:]:
        act = f"add the tiles of {first.agent!r} and {other.agent!r}"
        first.linearisation.refuse_to_mix(other.linearisation, act)
        if other.length_scale != first.length_scale:
            raise FrameError(
                f"the tiles of {first.agent!r} have the length scale {first.length_scale:g}, those of "
                f"{other.agent!r} {other.length_scale:g}; scale them alike"
            )


def limits_of(budget: Budget, agents: Sequence[TileInformation]) -> Limits:
    """The budget as numbers, in the agents' order.

    Raises:
        SelectionError: a limit is for an agent that does not exist.
    """
    names = [agent.agent for agent in agents]
    return Limits(
        _per_agent(budget.tiles_per_agent, names, "tiles_per_agent"),
        _per_agent(budget.bytes_per_agent, names, "bytes_per_agent"),
        np.inf if budget.tiles is None else float(budget.tiles),
        np.inf if budget.bytes is None else float(budget.bytes),
    )


def _per_agent(limit: int | Mapping[str, int] | None, names: list[str], what: str) -> Array:
    if not isinstance(limit, Mapping):
        return np.full(len(names), np.inf if limit is None else float(limit))
    unknown = [name for name in limit if name not in names]
    if unknown:
        near = get_close_matches(unknown[0], names, 1)
        hint = f"; did you mean {near[0]!r}?" if near else f"; the agents are {', '.join(names[:8])}"
        raise SelectionError(f"{what} names {unknown[0]!r}, which is no agent{hint}")
    return np.array([limit.get(name, np.inf) for name in names], dtype=np.float64)


def _integers(values: NDArray[np.int64], what: str) -> NDArray[np.int64]:
    try:
        array = np.array(values)
    except ValueError as error:
        raise SelectionError(f"{what} are no array: {error}") from None
    if array.size == 0:
        return array.astype(np.int64)
    if array.dtype.kind not in "iu":
        raise SelectionError(f"{what} must be whole numbers, not {array.dtype}")
    return array.astype(np.int64)
