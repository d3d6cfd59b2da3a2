"""Choosing tiles: greedy and lazy greedy, exchanges, and the baselines to compare with.

Greedy sends the tile of the largest gain, or of the largest gain per byte, again and again, until nothing
fits; ties go to the tile that comes first. Evaluating every tile in every round is not needed:

- A submodular criterion's gains never grow (log det, trace): what a tile gained in an earlier round bounds
  what it gains now, so that only the tiles at the top of a heap are evaluated again (Minoux 1978).
- Any concave criterion's gain is at most the tile's price ⟨Y, F_i⟩ at the present sum (`criteria`): tiles are
  evaluated in the order of their prices, until the best gain exceeds the next price.

λ_min is not submodular, and its greedy choice can be arbitrarily bad: fewer than six informative directions
have λ_min = 0, whichever they are. Ties there go to log det; and since that is not enough, several criteria
between log det and λ_min choose, in small problems chance does so too, and the best choice counts.

Where it does not take long, a choice by any criterion is then improved by exchanging tiles.

References: Minoux, "Accelerated greedy algorithms for maximizing submodular set functions", 1978; Leskovec et
al., "Cost-effective outbreak detection in networks", KDD 2007 (both greedy orders, lazily, the better one).
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..bound.criteria import LAMBDA_MIN, Criterion, KieferMean, LogDet
from ..se3 import Array
from .tiles import Problem

# Criteria between log det and λ_min; any of them may be the only one that avoids a dead end.
_STARTS: tuple[LogDet | KieferMean, ...] = (
    LAMBDA_MIN,
    LogDet(),
    KieferMean(1.0),
    KieferMean(4.0),
    KieferMean(16.0),
)
_SMOOTH = KieferMean(4.0)  # exchanges by it get out of more dead ends than exchanges by λ_min
_RESTARTS = 16  # random choices to improve for λ_min, fewer in larger problems
# Eigenvalues of a sum are wrong by about this fraction of the largest one: smaller differences are ties.
_ROUNDING = 1e-12
_CHUNK = 64  # candidates evaluated at once; one NumPy call costs as much as some twenty evaluations
_SMALLEST_IMPROVEMENT = 1e-6  # of the value: an exchange for less costs more time than it is worth
_EXCHANGES = 20_000  # pairs of tiles whose exchange is tried; a larger problem has none


@dataclass(frozen=True)
class Choice:
    """Tiles in the order in which they were chosen, and how often a tile's gain was evaluated."""

    tiles: tuple[int, ...]
    evaluations: int


def choose(problem: Problem, criterion: Criterion, *, lazy: bool = True) -> Choice:
    """The best of greedy by gain and, under byte limits, greedy by gain per byte; λ_min: see the module.

    Args:
        problem: with a positive definite base unless the criterion is the trace.
        criterion: what to maximise.
        lazy: skip candidates that a bound rules out; the choice is the same either way.
    """
    orders = (False, True) if problem.limits.counts_bytes else (False,)
    starts: Iterable[Criterion] = _STARTS if criterion is LAMBDA_MIN else (criterion,)
    choices = [greedy(problem, start, per_byte=order, lazy=lazy) for start in starts for order in orders]
    if criterion is LAMBDA_MIN:
        generator = np.random.default_rng(0)
        pairs = len(choices[0].tiles) * (len(problem) - len(choices[0].tiles))
        for _ in range(min(_RESTARTS, _EXCHANGES // max(1, pairs))):
            start = Choice(random_choice(problem, generator), 0)
            choices.append(_exchange(problem, _SMOOTH, start))
    choices = [_exchange(problem, criterion, choice) for choice in choices]
    values = [float(criterion.value(problem.information(choice.tiles))) for choice in choices]
    best = choices[int(np.argmax(values))]
    return replace(best, evaluations=sum(choice.evaluations for choice in choices))


def greedy(problem: Problem, criterion: Criterion, *, per_byte: bool = False, lazy: bool = True) -> Choice:
    """Greedy by one criterion, by gain or by gain per byte, until no tile fits."""
    weight = 1.0 / problem.cost if per_byte else np.ones(len(problem))
    if lazy and criterion.submodular:
        return _lazy(problem, criterion, weight)
    return _rounds(problem, criterion, weight, prune=lazy)


def _rounds(problem: Problem, criterion: Criterion, weight: Array, *, prune: bool) -> Choice:
    """Greedy that looks at every tile in every round, though with `prune` it evaluates only some."""
    limits, M = problem.limits, problem.base
    left = np.ones(len(problem), dtype=np.bool_)
    flat = problem.blocks.reshape(-1, 36)
    chosen: list[int] = []
    evaluations = 0
    while True:
        candidates = np.flatnonzero(left & limits.fits(problem.agent, problem.cost))
        if len(candidates) == 0:
            return Choice(tuple(chosen), evaluations)
        bounds = np.full(len(candidates), np.inf)
        if prune:
            bounds = (flat @ criterion.price(M).ravel() * weight)[candidates]
        best, evaluated = _best(problem, criterion, M, candidates, bounds, weight)
        evaluations += evaluated
        chosen.append(best)
        left[best] = False
        M = M + problem.blocks[best]
        limits = limits.after(int(problem.agent[best]), float(problem.cost[best]))


def _best(
    problem: Problem,
    criterion: Criterion,
    M: Array,
    candidates: NDArray[np.intp],
    bounds: Array,
    weight: Array,
) -> tuple[int, int]:
    """The candidate of the largest score, and how many were evaluated: those whose bound may exceed it."""
    tolerance = 0.0 if criterion.submodular else _ROUNDING * float(np.trace(M))
    gains = np.full(len(candidates), -np.inf)
    top, evaluated, size = -np.inf, 0, _CHUNK
    open_ = np.arange(len(candidates))
    while len(open_):
        # The largest bounds first, without sorting them all.
        largest = np.argpartition(-bounds[open_], size)[:size] if len(open_) > size else slice(None)
        chunk = open_[largest]
        gains[chunk] = criterion.gains(M, problem.blocks[candidates[chunk]]) * weight[candidates[chunk]]
        top = max(top, float(gains[chunk].max()))
        evaluated += len(chunk)
        open_ = open_[(bounds[open_] >= top - tolerance) & np.isneginf(gains[open_])]
        size *= 4
    tied = candidates[gains >= top - tolerance]
    if len(tied) > 1 and not criterion.submodular:
        tied = tied[[int(np.argmax(LogDet().gains(M, problem.blocks[tied]) * weight[tied]))]]
    return int(tied[0]), evaluated


def _lazy(problem: Problem, criterion: Criterion, weight: Array) -> Choice:
    """Greedy that evaluates a tile again only when its old score is the largest one left."""
    limits, M = problem.limits, problem.base
    scores = criterion.gains(M, problem.blocks) * weight
    # (−score, tile): among equal scores the first tile comes first, as in `_best`.
    heap = list(zip((-scores).tolist(), range(len(problem)), strict=True))
    heapq.heapify(heap)
    evaluated_in = np.zeros(len(problem), dtype=np.int64)
    fresh = 0
    chosen: list[int] = []
    evaluations = len(problem)
    size = 1
    while heap:
        tile = heap[0][1]
        if not limits.fits(problem.agent[[tile]], problem.cost[[tile]])[0]:
            heapq.heappop(heap)  # limits only shrink: it will not fit later either
        elif evaluated_in[tile] == fresh:
            heapq.heappop(heap)
            chosen.append(tile)
            M = M + problem.blocks[tile]
            limits = limits.after(int(problem.agent[tile]), float(problem.cost[tile]))
            fresh += 1
            size = 1
        else:
            stale = _pop_stale(heap, evaluated_in, fresh, size)
            renewed = criterion.gains(M, problem.blocks[stale]) * weight[stale]
            for score, index in zip(renewed.tolist(), stale, strict=True):
                heapq.heappush(heap, (-score, index))
            evaluated_in[stale] = fresh
            evaluations += len(stale)
            size = min(2 * size, _CHUNK)
    return Choice(tuple(chosen), evaluations)


def _pop_stale(
    heap: list[tuple[float, int]], evaluated_in: NDArray[np.int64], fresh: int, size: int
) -> list[int]:
    stale: list[int] = []
    while heap and len(stale) < size and evaluated_in[heap[0][1]] != fresh:
        stale.append(heapq.heappop(heap)[1])
    return stale


def _exchange(problem: Problem, criterion: Criterion, choice: Choice) -> Choice:
    """Exchange one tile for another as long as f grows, the best exchange first; send what then fits."""
    chosen = list(choice.tiles)
    evaluations = choice.evaluations
    agent, cost = problem.agent, problem.cost
    while True:
        outside = np.setdiff1d(np.arange(len(problem)), chosen)
        if not 0 < len(chosen) * len(outside) <= _EXCHANGES:
            return Choice(tuple(chosen), evaluations)
        inside = np.array(chosen)
        M, limits = problem.information(chosen), problem.limits
        for tile in chosen:
            limits = limits.after(int(agent[tile]), float(cost[tile]))
        fits = limits.fits(agent[outside], cost[outside])
        if fits.any():
            rest = replace(
                problem.restricted(np.isin(np.arange(len(problem)), outside[fits])), base=M, limits=limits
            )
            more = greedy(rest, criterion)
            chosen += outside[fits][list(more.tiles)].tolist()
            evaluations += more.evaluations
            continue
        same, freed = agent[inside][:, None] == agent[outside], cost[inside][:, None]
        out, into = np.nonzero(
            (limits.agent_tiles[agent[outside]] + same >= 1.0)
            & (limits.agent_bytes[agent[outside]] + same * freed >= cost[outside])
            & (limits.bytes + freed >= cost[outside])
        )
        if len(out) == 0:
            return Choice(tuple(chosen), evaluations)
        gains = criterion.gains(M, problem.blocks[outside[into]] - problem.blocks[inside[out]])
        evaluations += len(gains)
        best = int(np.argmax(gains))
        if gains[best] <= _SMALLEST_IMPROVEMENT * abs(float(criterion.value(M))):
            return Choice(tuple(chosen), evaluations)
        chosen[out[best]] = int(outside[into[best]])


def random_choice(problem: Problem, generator: np.random.Generator) -> tuple[int, ...]:
    """Tiles in a random order, each sent if it still fits."""
    return _in_order(problem, generator.permutation(len(problem)))


def top_trace(problem: Problem) -> tuple[int, ...]:
    """Tiles by descending trace, each sent if it still fits."""
    return _in_order(problem, np.argsort(-np.trace(problem.blocks, axis1=1, axis2=2), kind="stable"))


def equal_split(problem: Problem, criterion: Criterion) -> tuple[int, ...]:
    """Every agent spends an equal share of the budget greedily, without knowing what the others send."""
    limits = problem.limits
    agents = len(limits.agent_tiles)
    chosen: list[int] = []
    for agent in range(agents):
        own = problem.agent == agent
        share = replace(
            limits, tiles=_share(limits.tiles, agents, agent), bytes=_share(limits.bytes, agents, agent)
        )
        alone = replace(problem.restricted(own), limits=share)
        indices = np.flatnonzero(own)
        alone_chosen = greedy(alone, criterion, per_byte=share.counts_bytes).tiles
        chosen += indices[list(alone_chosen)].tolist()
    return tuple(chosen)


def _share(total: float, agents: int, agent: int) -> float:
    """A whole share of a total; what does not divide goes to the first agents."""
    if np.isinf(total):
        return total
    return float(total // agents + (agent < total % agents))


def _in_order(problem: Problem, order: NDArray[np.int64]) -> tuple[int, ...]:
    agent, cost = problem.agent.tolist(), problem.cost.tolist()
    limits = problem.limits
    agent_tiles, agent_bytes = limits.agent_tiles.tolist(), limits.agent_bytes.tolist()
    tiles, size = limits.tiles, limits.bytes
    chosen: list[int] = []
    for tile in order.tolist():
        if tiles < 1.0:
            break
        a, c = agent[tile], cost[tile]
        if agent_tiles[a] >= 1.0 and agent_bytes[a] >= c and size >= c:
            chosen.append(tile)
            agent_tiles[a] -= 1.0
            agent_bytes[a] -= c
            tiles -= 1.0
            size -= c
    return tuple(chosen)
