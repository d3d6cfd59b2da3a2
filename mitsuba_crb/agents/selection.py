"""Which image tiles should several agents send under a budget? Maximise f(F_0 + Σ tiles) over what it allows.

f is log det, the trace or λ_min of the joint information of one common pose (`tiles`), F_0 a prior and a
ridge. The choice is made on positive semi-definite projections of half of the batches and reported on the
other half: a tile that was chosen because its error was lucky is not lucky again (no winner's curse).

| limits | log det | trace | λ_min |
|---|---|---|---|
| tiles in total | 1 − 1/e | optimal | no guarantee |
| tiles per agent, with or without a total | 1/2 | optimal | no guarantee |
| bytes in total | (1 − 1/e) / 2 | 1/2 | no guarantee |
| other | no guarantee | no guarantee | no guarantee |

are the fractions of the best possible gain f − f(F_0) that the choice is certain to reach. The certificate of
every selection is usually far better: the choice's gain over an upper bound on the best gain (`relaxation`).

References: Nemhauser, Wolsey and Fisher, "An analysis of approximations for maximizing submodular set
functions I", 1978; Fisher, Nemhauser and Wolsey, the same II, 1978 (1/2 for a laminar matroid); Leskovec et
al., "Cost-effective outbreak detection in networks", KDD 2007 (bytes).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from numbers import Real
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..bound.criteria import OBJECTIVES, Criterion, Trace
from ..errors import SelectionError
from ..files import Record
from ..information.symmetric import symmetrised
from ..noise.covariance import nearest_semidefinite, positive_matrix
from ..se3 import Array
from .greedy import choose, equal_split, random_choice, top_trace
from .relaxation import upper_bound
from .tiles import Budget, Limits, Problem, TileInformation, check_agents, limits_of

RANDOM_DRAWS = 16
"""The random baseline is the mean of this many draws."""


@dataclass(frozen=True)
class ChosenTile:
    """One tile to send."""

    agent: str
    """The agent's name."""
    tile: int
    """Index into the agent's tiles."""


@dataclass(frozen=True)
class Baseline:
    """What a simpler rule achieves under the same budget."""

    value: float
    """f on the half that the selection was made on."""
    value_heldout: float
    """f on the other half."""


@dataclass(frozen=True)
class TileSelection(Record):
    """Which tiles to send, what they are worth, and what no choice could exceed."""

    objective: str
    """`"logdet"`, `"trace"` or `"lambda_min"`."""
    chosen: tuple[ChosenTile, ...]
    """In the order in which they were chosen."""
    value: float
    """f(F_0 + Σ) on the half of the batches that the choice was made on, projected: biased upwards."""
    value_heldout: float
    """f(F_0 + Σ) on the other half as it is: independent of the choice; −inf if log det does not exist."""
    value_empty: float
    """f(F_0), without any tile."""
    upper_bound: float
    """No choice within the budget has a larger `value`."""
    certificate: float
    """(value − value_empty) / (upper_bound − value_empty): at least this fraction of the best gain."""
    guarantee: float | None
    """The fraction of the best gain that is certain before looking at the tiles; None if there is none."""
    baselines: dict[str, Baseline]
    """`"random"` (a mean over draws), `"equal_split"` (every agent on its own), `"top_trace"`."""
    total_bytes: int
    """Size of all chosen tiles' messages."""
    evaluations: int
    """How often a tile's gain was evaluated to make the choice."""

    def bounded(self, upper_bound: float) -> TileSelection:
        """The same choice where `upper_bound` is known to hold, too."""
        bound = min(self.upper_bound, upper_bound)
        certificate = certified(self.value, self.value_empty, bound)
        return replace(self, upper_bound=bound, certificate=certificate)

    def __str__(self) -> str:
        agents = len({chosen.agent for chosen in self.chosen})
        baselines = ", ".join(
            f"{name.replace('_', ' ')} {base.value:.4g} ({base.value_heldout:.4g})"
            for name, base in self.baselines.items()
        )
        guarantee = "none" if self.guarantee is None else f"{self.guarantee:.3g}"
        return "\n".join(
            (
                f"chosen       {len(self.chosen)} tiles of {agents} agents, {self.total_bytes} bytes",
                f"{self.objective:<12} {self.value:.4g} on the half chosen by, "
                f"{self.value_heldout:.4g} held out",
                f"nothing sent {self.value_empty:.4g}",
                f"upper bound  {self.upper_bound:.4g} on the half chosen by",
                f"certificate  {self.certificate:.3f} of the best gain; guaranteed beforehand {guarantee}",
                f"baselines    {baselines} (held out)",
            )
        )


def select_tiles(
    agents: Sequence[TileInformation],
    budget: Budget,
    *,
    objective: Literal["logdet", "trace", "lambda_min"] = "logdet",
    ridge: float = 1.0,
    prior: ArrayLike | None = None,
    lazy: bool = True,
    seed: int = 0,
) -> TileSelection:
    """Choose the tiles that tell most about the common pose: max f(F_0 + Σ tiles), F_0 = prior + ridge · 1.

    Args:
        agents: every agent's tiles, about one common pose.
        budget: limits on tiles and bytes, in total and per agent; more than there is, is allowed.
        objective: log det (all directions), trace (of no use against unseen directions) or λ_min (the worst).
        ridge: information about every direction beforehand, in scaled units: 1 stands for a standard
            deviation of one length scale and one radian.
        prior: (6, 6), information known beforehand, in the blocks' frame and units.
        lazy: do not evaluate tiles that a bound rules out; False evaluates every tile in every round, for
            comparison, and chooses the same ones.
        seed: of the random baseline.

    Raises:
        SelectionError: no agents, duplicate names, correlated noise, a budget for an agent that does not
            exist, an unknown objective, an impossible prior or ridge.
        FrameError: the agents' tiles are about different poses or in different units.
    """
    if objective not in OBJECTIVES:
        raise SelectionError(f"unknown objective {objective!r}; expected {', '.join(map(repr, OBJECTIVES))}")
    criterion = OBJECTIVES[objective]
    check_agents(agents)
    base = _base(ridge, prior, definite=not isinstance(criterion, Trace))
    problem, tile_of, report = _assembled(agents, limits_of(budget, agents), base)
    simple = problem.simplified()
    choice = choose(simple, criterion, lazy=lazy)

    def values(tiles: Sequence[int]) -> tuple[float, float]:
        chosen = problem.information(tiles), base + report[list(tiles)].sum(axis=0)
        on_select, held_out = criterion.value(np.stack(chosen)).tolist()
        return on_select, held_out

    generator = np.random.default_rng(seed)
    draws = np.mean([values(random_choice(problem, generator)) for _ in range(RANDOM_DRAWS)], axis=0)
    baselines = {
        "random": draws,
        "equal_split": values(equal_split(problem, criterion)),
        "top_trace": values(top_trace(problem)),
    }
    value, held_out = values(choice.tiles)
    empty = float(criterion.value(base))
    bound = upper_bound(simple, criterion, value)
    return TileSelection(
        objective=objective,
        chosen=tuple(ChosenTile(agents[problem.agent[i]].agent, int(tile_of[i])) for i in choice.tiles),
        value=value,
        value_heldout=held_out,
        value_empty=empty,
        upper_bound=bound,
        certificate=certified(value, empty, bound),
        guarantee=guaranteed(simple, criterion),
        baselines={name: Baseline(float(pair[0]), float(pair[1])) for name, pair in baselines.items()},
        total_bytes=int(problem.cost[list(choice.tiles)].sum()),
        evaluations=choice.evaluations,
    )


def certified(value: float, empty: float, bound: float) -> float:
    """At least this fraction of the best gain is reached, where no value exceeds `bound`."""
    return (value - empty) / (bound - empty) if bound > empty else 1.0


def _base(ridge: float, prior: ArrayLike | None, *, definite: bool) -> Array:
    """F_0 (6, 6)."""
    if not (isinstance(ridge, Real) and np.isfinite(ridge) and ridge >= 0.0):
        raise SelectionError(f"the ridge must be a finite number that is not negative, not {ridge!r}")
    base = ridge * np.eye(6)
    if prior is not None:
        base += positive_matrix(prior, "the prior's information", SelectionError, size=6)
    eigenvalues = np.linalg.eigvalsh(base)
    if definite and eigenvalues[0] <= 1e-12 * eigenvalues[-1]:
        raise SelectionError(
            "log det and λ_min need a starting information that is positive definite: give a positive ridge, "
            "or a prior that knows something about every direction"
        )
    return base


def _assembled(
    agents: Sequence[TileInformation], limits: Limits, base: Array
) -> tuple[Problem, NDArray[np.int64], Array]:
    """All tiles that fit by themselves: the problem, each tile's index in its agent, its report block."""
    counts = [len(agent.tiles) for agent in agents]
    owner = np.repeat(np.arange(len(agents)), counts)
    tile = np.concatenate([np.arange(count) for count in counts])
    cost = np.concatenate([agent.cost_bytes for agent in agents]).astype(np.float64)
    fits = limits.fits(owner, cost)
    select = np.concatenate([agent.select for agent in agents])[fits]
    report = np.concatenate([agent.report for agent in agents])[fits]
    projected = symmetrised(nearest_semidefinite(select))
    return Problem(base, projected, owner[fits], cost[fits], limits), tile[fits], report


def guaranteed(problem: Problem, criterion: Criterion) -> float | None:
    """The fraction of the best gain that is certain beforehand, see the module; None if there is none."""
    limits = problem.limits
    if not criterion.submodular:
        return None
    if not limits.counts_bytes:
        if isinstance(criterion, Trace) or not limits.counts_tiles:
            return 1.0
        return 0.5 if np.isfinite(limits.agent_tiles).any() else 1.0 - math.exp(-1.0)
    if limits.counts_tiles or np.isfinite(limits.agent_bytes).any():
        return None
    return 0.5 if isinstance(criterion, Trace) else 0.5 * (1.0 - math.exp(-1.0))
