"""Upper bounds on what any choice of tiles could achieve: prices, submodularity, and branching.

*Prices.* Let tiles be sent in fractions x ∈ P = {0 ≤ x ≤ 1, budgets}. For any price matrix Y,

    max over P of ⟨Y, F_0 + Σ x_i F_i⟩ = s    bounds every criterion by  f ≤ `Criterion.upper_bound(Y, s)`,

and the best Y makes this the relaxed optimum. Buying at prices is a linear program: for limits on tiles, or
on bytes, in total and per agent (a polymatroid) it is solved by sorting; both together by simplex, where the
bound comes from the dual prices and is valid to rounding. The relaxed optimum is a mixture of purchases
M = Σ α_v M_v, whose weights the multiplicative algorithm of optimal design improves monotonically,
α_v ← α_v ⟨Y, M_v⟩^(1/(p+1)) / normalisation with Y = M^−(p+1); p = 0 is log det, and p → ∞ is λ_min.

*Submodularity.* f(T) ≤ f(S) + Σ_{i ∈ T} [f(S + i) − f(S)] for log det and any S: better than prices where few
tiles of low rank are sent, because a fraction of six tiles sees more than one whole tile.

*Branching.* A tile is sent or not: the larger of both cases' bounds is a bound, too. The case with the
largest bound is split until the certificate is good or the work used up; at any time the bound is valid.

References: Pukelsheim, "Optimal Design of Experiments", 2006; Yu, "Monotonic convergence of a general
algorithm for computing optimal designs", Annals of Statistics 38, 2010; Nemhauser, Wolsey and Fisher, "An
analysis of approximations for maximizing submodular set functions I", 1978, proposition 2.1.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog
from scipy.sparse import coo_array

from ..bound.criteria import Criterion, KieferMean, LogDet, Trace
from ..se3 import Array
from .greedy import greedy
from .tiles import Problem

_GAP = 0.02  # of the gain: a certificate this close to 1 is not worth more work
_RELAXATION_GAP = 1e-3  # of the gain: the relaxed optimum is not needed more precisely
_PURCHASES = 60  # in one relaxation
_REWEIGHTINGS = 400  # between two purchases
_NODES = 128
_WORK = 400_000  # tiles in all the nodes together
_SIMPLEX = 10_000  # tiles; for more, limits on tiles and on bytes are bounded one without the other
_POWERS = (1.0, 3.0, 7.0, 15.0, 31.0)  # on the way to λ_min


def upper_bound(problem: Problem, criterion: Criterion, value: float) -> float:
    """A bound on the criterion over all choices within the limits.

    Args:
        problem: with a positive definite base unless the criterion is the trace.
        criterion: log det, trace or λ_min.
        value: what a known choice achieves; the bound is refined until it is close to that.

    References:
        Land and Doig, "An automatic method of solving discrete programming problems", 1960.
    """
    empty = float(criterion.value(problem.base))
    root = _Node.of(problem, criterion, np.inf)
    count = 0
    heap = [(-root.bound, count, root)]
    # λ_min has no second bound: its relaxation is slow, and remains loose after many branchings.
    nodes = min(_NODES, _WORK // max(1, len(problem))) if criterion.submodular else 0
    best = max(value, root.value)
    while count < 2 * nodes:
        node = heap[0][2]
        if node.branch is None or (best - empty) >= (1.0 - _GAP) * (node.bound - empty):
            break
        heapq.heappop(heap)
        for child in (node.problem.sending(node.branch), node.problem.without(node.branch)):
            new = _Node.of(child, criterion, node.bound)
            best = max(best, new.value)
            count += 1
            heapq.heappush(heap, (-new.bound, count, new))
    return max(value, heap[0][2].bound)


@dataclass(frozen=True)
class _Node:
    """A subproblem, a bound on it, a choice's value, and the tile to branch on (None: the bound is exact)."""

    problem: Problem
    bound: float
    value: float
    branch: int | None

    @staticmethod
    def of(problem: Problem, criterion: Criterion, known_bound: float) -> _Node:
        problem = problem.simplified()
        if len(problem) == 0 or not (problem.limits.counts_tiles or problem.limits.counts_bytes):
            value = float(criterion.value(problem.information(range(len(problem)))))
            return _Node(problem, value, value, None)
        choice = greedy(problem, criterion, per_byte=problem.limits.counts_bytes).tiles
        value = float(criterion.value(problem.information(choice)))
        bound = known_bound
        if criterion.submodular:
            bound = min(bound, _submodular_bound(problem, criterion, choice))
        bound = min(bound, relaxed_optimum(problem, criterion, value))
        return _Node(problem, max(bound, value), value, choice[0])


def _submodular_bound(problem: Problem, criterion: Criterion, choice: tuple[int, ...]) -> float:
    """The smallest f(S) + Σ gains over some beginnings S of a greedy choice."""
    beginnings = {0, len(choice) - 1, len(choice)} if len(problem) > 1000 else range(len(choice) + 1)
    bounds = []
    for length in beginnings:
        S = list(choice[:length])
        M = problem.information(S)
        gains = criterion.gains(M, problem.blocks)
        gains[S] = 0.0
        bounds.append(float(criterion.value(M)) + _best_fractions(problem, gains)[1])
    return min(bounds)


def relaxed_optimum(problem: Problem, criterion: Criterion, value: float) -> float:
    """A bound by prices, close to the optimum over fractions of tiles.

    Args:
        problem: with a positive definite base unless the criterion is the trace.
        criterion: log det, trace or λ_min.
        value: what a known choice achieves; a bound that proves it nearly optimal is not improved.
    """
    if isinstance(criterion, Trace):
        return _buy(problem, np.eye(6))[1]
    empty = float(criterion.value(problem.base))
    price = LogDet().price(problem.base)
    purchase, revenue = _buy(problem, price)
    bound = criterion.upper_bound(price, revenue)
    purchases, weights = purchase[None], np.ones(1)
    for p in (0.0,) if isinstance(criterion, LogDet) else _POWERS:
        smooth = KieferMean(p) if p else LogDet()
        excess = 1.0
        while excess > _RELAXATION_GAP:
            weights, M = _reweighted(purchases, weights, smooth, 1.0 / (p + 1.0), 0.1 * excess)
            price = smooth.price(M)
            purchase, revenue = _buy(problem, price)
            bound = min(bound, criterion.upper_bound(price, revenue))
            relaxed = float(criterion.value(M))
            proven = value - empty >= (1.0 - _GAP) * (bound - empty)
            if proven or bound - relaxed <= _RELAXATION_GAP * (bound - empty) or len(weights) == _PURCHASES:
                return bound
            excess = revenue / float((price * M).sum()) - 1.0
            share = 1.0 / (len(weights) + 1)
            purchases = np.concatenate([purchases, purchase[None]])
            weights = np.append((1.0 - share) * weights, share)
    return bound


def _reweighted(
    purchases: Array, weights: Array, criterion: Criterion, power: float, tolerance: float
) -> tuple[Array, Array]:
    """Weights α that nearly maximise the criterion of M = Σ α_v M_v, and M."""
    flat = purchases.reshape(-1, 36)
    for _ in range(_REWEIGHTINGS):
        M = (weights @ flat).reshape(6, 6)
        worth = flat @ criterion.price(M).ravel()
        if worth.max() <= (1.0 + tolerance) * (weights @ worth):
            break
        weights = weights * worth**power
        weights = weights / weights.sum()
    return weights, (weights @ flat).reshape(6, 6)


def _buy(problem: Problem, price: Array) -> tuple[Array, float]:
    """The sum M_v (6, 6) that is worth most at these prices, and its worth ⟨Y, M_v⟩ or slightly more."""
    worth = problem.blocks.reshape(-1, 36) @ price.ravel()
    x, most = _best_fractions(problem, worth)
    bought = x > 0.0
    M = problem.base + np.tensordot(x[bought], problem.blocks[bought], 1)
    return M, float((price * problem.base).sum()) + most


def _best_fractions(problem: Problem, worth: Array) -> tuple[Array, float]:
    """Maximise Σ worth_i x_i over 0 ≤ x ≤ 1 within the limits: x (n,), and an upper bound on the maximum."""
    limits, agent = problem.limits, problem.agent
    worth = np.maximum(worth, 0.0)  # rounding may leave a block a slightly negative price
    if limits.counts_tiles and limits.counts_bytes and len(problem) <= _SIMPLEX:
        return _by_simplex(problem, worth)
    solutions = []
    if limits.counts_tiles:
        solutions.append(_by_sorting(worth, np.ones_like(worth), agent, limits.agent_tiles, limits.tiles))
    if limits.counts_bytes:
        solutions.append(_by_sorting(worth, problem.cost, agent, limits.agent_bytes, limits.bytes))
    # Each ignores the other kind of limit, so the smaller maximum bounds the true one.
    return min(((x, float(x @ worth)) for x in solutions), key=lambda solution: solution[1])


def _by_sorting(worth: Array, size: Array, agent: NDArray[np.int64], agent_room: Array, room: float) -> Array:
    """Fractions by descending worth per size, as much as its agent and then the total have room for."""
    order = np.argsort(-worth / size, kind="stable")
    taken = size[order]
    if np.isfinite(agent_room).any():
        by_agent = np.argsort(agent[order], kind="stable")
        grouped, sizes = agent[order][by_agent], taken[by_agent]
        before = np.cumsum(sizes) - sizes
        first = np.flatnonzero(np.diff(grouped, prepend=-1))
        before -= np.repeat(before[first], np.diff(first, append=len(grouped)))
        taken[by_agent] = np.clip(agent_room[grouped] - before, 0.0, sizes)
    before = np.cumsum(taken) - taken
    taken = np.clip(room - before, 0.0, taken)
    x = np.empty(len(worth))
    x[order] = taken / size[order]
    return x


def _by_simplex(problem: Problem, worth: Array) -> tuple[Array, float]:
    """The same for limits on tiles and on bytes together."""
    limits, n = problem.limits, len(problem)
    tile = np.arange(n)
    agents = len(limits.agent_tiles)
    zero, ones = np.zeros(n, dtype=np.int64), np.ones(n)
    # One row per limit: every agent's tiles, every agent's bytes, all tiles, all bytes.
    rows = np.concatenate([problem.agent, agents + problem.agent, 2 * agents + zero, 2 * agents + 1 + zero])
    entries = np.concatenate([ones, problem.cost, ones, problem.cost])
    usage = coo_array((entries, (rows, np.tile(tile, 4))), shape=(2 * agents + 2, n)).tocsr()
    room = np.concatenate([limits.agent_tiles, limits.agent_bytes, [limits.tiles, limits.bytes]])
    binding = np.isfinite(room)
    usage, room = usage[binding], room[binding]
    unit = worth.max(initial=0.0) or 1.0
    result = linprog(-worth / unit, A_ub=usage, b_ub=room, bounds=(0.0, 1.0), method="highs")
    # Any limit prices y ≥ 0 give a bound; so it does not depend on the solver's tolerance.
    y = unit * np.maximum(-result.ineqlin.marginals, 0.0)
    bound = float(y @ room + np.maximum(worth - usage.T @ y, 0.0).sum())
    return np.clip(result.x, 0.0, 1.0), bound
