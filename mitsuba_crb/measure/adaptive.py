"""To a precision: rounds of paths, each where the rounds before it have seen that the bound needs them.

A pilot gives every pixel a few paths. What it has seen says how many more which part of the film should get
(`allocation`) for every standard deviation that is seen to reach its precision, and for those that noise
still hides, unknown nuisances among them, to come out of it. If that is many times what has been spent, or
something is hidden, a round in between betters what is known. Size and allocation of the last round are fixed
before its random numbers are drawn; it alone is the answer, and its error is reported whatever it is: neither
is mixed with the paths that decided on it, and it is not topped up until it looks precise. So no choice made
here biases the information.

Source: design section 11; Muthukkumar 2025, outlook ("adaptive rendering").
"""

from __future__ import annotations

import dataclasses
import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..bound.cramer_rao import AXES, TURN, PoseBound, cramer_rao_bound, position_functionals
from ..errors import PrecisionWarning
from ..information.allocation import Needs, allocate
from ..information.block_variance import BlockProducts
from ..information.blocks import BLOCK
from ..information.joint import JointInformation, tile_side
from ..noise import NoiseModel
from ..render.random import derived_seed
from ..se3 import Array
from .measurement import Measurement
from .options import MAX_PATHS
from .plan import Plan

ROUND = 0x524F554E
"""Purpose of the rounds' random numbers."""

_FAR = 8.0
"""Times what has been spent, beyond which another round betters the allocation first."""
_BETWEEN = 0.15
"""Of what is needed, in such a round."""
_EXPLORING = 2.0
"""Times what has been spent, of a round for what noise still hides."""
_AGAIN = 2
"""Times the paths by which something came out of the noise, of the answer."""
_SMALL = 0.25
"""Of the variance that no paths can mend, what is always good enough for the paths."""


@dataclasses.dataclass(frozen=True)
class Round:
    """What a round came to."""

    paths: int
    """Paths in all."""
    precision: float
    """Largest relative standard error of the standard deviations that are seen; infinite if none is."""
    hidden: int
    """How many of the six and of the unknown nuisances noise still hides."""
    ahead: int
    """Paths of the next round."""


@dataclasses.dataclass(frozen=True, eq=False)
class Answer:
    """What was found in the last round, and how it came to it."""

    run: Measurement
    """The measurement of that round, after it."""
    joint: JointInformation
    products: BlockProducts
    rounds: tuple[Round, ...] = ()
    """Those before it."""
    interrupted: bool = False
    """Whether a round was broken off, and this is the one before it."""

    def rare(self, bound: PoseBound) -> list[str]:
        """The standard deviations of its bound that are seen, but whose errors too few paths decide.

        See `block_variance`.
        """
        vectors, values = sensitivities(self.joint, bound)
        rare = self.products.variance(vectors, values).rare
        found = zip(AXES, bound.verdicts, rare, strict=True)
        return [axis for axis, verdict, few in found if verdict == "seen" and few]

    @property
    def provenance(self) -> dict[str, Any]:
        """How many paths went where, JSON-able."""
        plan = self.run.plan
        if plan is None:
            return {}
        spp = plan.of_pixels(self.run.mask)[self.run.mask]
        return {
            "sampling": {
                "precision": self.run.options.goal,
                "rounds": [dataclasses.asdict(each) for each in self.rounds],
                "spp": {"least": int(spp.min()), "mean": float(spp.mean()), "most": int(spp.max())},
                "paths": sum(each.paths for each in self.rounds) + int(spp.sum()),
                "interrupted": self.interrupted,
            }
        }


def answer(run: Measurement, noise: NoiseModel, *, prior: Any = None) -> Answer:
    """The joint information of a view under a noise model: by as many paths everywhere, or to a precision.

    Args:
        run: an opened measurement; its options say which.
        noise: from `Measurement.noise`.
        prior: as for `cramer_rao_bound`: with it there may be less to measure.
    """
    rounds = Rounds(run, noise, prior=prior)
    try:
        last = rounds.decided()
        return Answer(last, *last.summed(noise), tuple(rounds.done))
    except KeyboardInterrupt:
        if rounds.last is None:
            raise
        return dataclasses.replace(rounds.last, interrupted=True)


class Rounds:
    """What has been spent and seen so far, and what comes next."""

    def __init__(self, run: Measurement, noise: NoiseModel, *, prior: Any = None) -> None:
        """Before the pilot; arguments as of `answer`."""
        self._run, self._noise, self._prior = run, noise, prior
        self.done: list[Round] = []
        self.last: Answer | None = None
        self._seen: list[tuple[BlockProducts, NDArray[np.int64]]] = []
        side = tile_side(run.parameters, sampled=run.selection.kind == "random") or BLOCK
        rows, columns = (-(-n // side) for n in run.mask.shape)
        row, column = np.nonzero(run.mask)
        cell = row // side * columns + column // side
        self._side = side
        self._pixels = np.bincount(cell, minlength=rows * columns).reshape(rows, columns)
        self._least = run.options.pilot_spp
        most = run.options.max_spp
        self._budget = float(MAX_PATHS if most is None else most * int(self._pixels.sum()))

    def decided(self) -> Measurement:
        """The measurement that is to give the answer, after all rounds but its own."""
        if self._run.options.spp is not None or self._run.view.deterministic:
            return self._run
        plan = self._planned(np.full(self._pixels.shape, self._least, dtype=np.int64))
        # A pilot and an answer of the same size must fit: else the pilot is the answer.
        final = self._budget < 2.0 * self._cost(plan.spp)
        while not final:
            run = self._run.planned(plan, final=False)
            self.last = Answer(run, *run.summed(self._noise), tuple(self.done))
            plan, final = self._decide(self.last, plan)
        return self._run.planned(plan)

    def _decide(self, found: Answer, plan: Plan) -> tuple[Plan, bool]:
        """What comes after a round, and whether it is the last."""
        self._seen.append((found.products, plan.spp))
        cost = self._cost(plan.spp)
        spent = cost + sum(each.paths for each in self.done)
        left = self._budget - spent
        bound = self._bound(found.joint)
        needs, hidden = self._needs(found, bound)
        spp = allocate(needs, self._least, left)
        may_hide = bound.rank < 6 or found.joint.parameters
        if may_hide and any(each.hidden for each in self.done):
            # What it took to come out of the noise: with less, the answer would not say what is known.
            enough = np.maximum(spp, _AGAIN * plan.spp)
            spp = enough if self._cost(enough) <= left else self._in_between(needs, left)
        needed = self._cost(spp)
        between = _EXPLORING * spent if hidden.any() else _BETWEEN * needed
        final = not hidden.any() and needed <= _FAR * spent
        if not final:
            # What is left after a round in between must be worth more than that.
            final = left < 2.0 * between
            if hidden.any() or not final:
                spp = self._in_between(needs, left if final else between)
        self.done.append(Round(cost, _precision(bound), int(hidden.sum()), self._cost(spp)))
        if self._run.options.on_round is not None:
            self._run.options.on_round(self.done[-1])
        return self._planned(spp), final

    def _planned(self, spp: NDArray[np.int64]) -> Plan:
        """A plan with random numbers that no round before it had."""
        seed = derived_seed(self._run.options.seed, ROUND, len(self.done) + 1)
        return Plan(spp, self._side, seed, before=sum(each.paths for each in self.done))

    def _cost(self, spp: NDArray[np.int64]) -> int:
        return int(np.sum(self._pixels * spp))

    def _in_between(self, needs: Needs, paths: float) -> NDArray[np.int64]:
        """So many paths, where they tell most of what the next round needs."""
        return allocate(dataclasses.replace(needs, goal=1e-6 * needs.goal), self._least, paths)

    def _bound(self, joint: JointInformation) -> PoseBound:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PrecisionWarning)
            return cramer_rao_bound(joint.marginalize().information, prior=self._prior)

    def _needs(self, found: Answer, bound: PoseBound) -> tuple[Needs, NDArray[np.bool_]]:
        """What is to be expected of each cell, and which of the six standard deviations are not resolved.

        Those are followed by the nuisances that noise hides.
        """
        joint, selection = found.joint.marginalize(), self._run.selection
        vectors, values = sensitivities(joint, bound)
        columns, least = joint.blurred
        wanted = np.concatenate([vectors, columns]), np.concatenate([values, least])
        sampled = selection.kind == "random"
        scale = selection.total / selection.selected if sampled else 1.0
        rounds = [(products.variance(*wanted).scaled(scale), spp) for products, spp in self._seen]
        # What no paths can mend: the step of finite differences, and a random subset's choice.
        pose = vectors[:, :6]
        fixed = np.square(np.einsum("mi,ij,mj->m", pose, joint.bias, pose) / (2.0 * values))
        if sampled:
            own = np.sum(rounds[-1][0].total[:6], axis=1)
            fixed += np.maximum(np.nan_to_num(np.square(bound.relative_standard_error)) - own, 0.0)
        precision = self._run.options.goal
        goal = np.maximum(precision**2 - fixed, _SMALL * fixed)
        # An axis may be infinite for one direction and have a share of another that is not resolved.
        blurred = bound.inverse.is_blurred(functionals(bound))
        goal[(np.array(bound.verdicts) == "unseen") & ~blurred] = np.inf
        goal = np.concatenate([goal, np.full(len(least), precision**2)])
        needs = Needs.of(rounds, self._side, self._pixels, goal)
        # What the image may tell below its noise, where a prior makes the number finite without it.
        squares = np.square([*bound.position_std, *bound.rotation_std_deg])
        hidden = np.isfinite(squares) & (squares - values > precision * squares)
        return needs.smoothed(), np.concatenate([hidden | blurred, np.ones(len(least), dtype=bool)])


def functionals(bound: PoseBound) -> Array:
    """(6, 6) of position along world axes and of rotation about the camera's, of a bound's inverse."""
    return np.concatenate([position_functionals(bound.inverse), TURN])


def sensitivities(joint: JointInformation, bound: PoseBound) -> tuple[Array, Array]:
    """b (6, 6 + m), in the columns of a joint information, and σ² (6,) of its bound, see `block_variance`."""
    vectors, values = bound.inverse.sensitivity(functionals(bound))
    return vectors @ joint.marginalize().elimination.T, values


def _precision(bound: PoseBound) -> float:
    errors = bound.relative_standard_error
    return float(np.nanmax(errors)) if np.isfinite(errors).any() else float("inf")
