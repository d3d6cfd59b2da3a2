"""Walks through a field of views on which odometry and views together keep a camera's position known.

The covariance Σ of the twist in the world frame is predicted by Σ + Q on the way to the next place
(`odometry`), and updated by one view there, (Σ⁻¹ + F)⁻¹, F what is seen of its information. The position's
bound is the root of its covariance's trace, before and after each view; between two places it is largest at
one of them, as a sum of convex functions.

A label is a walk that ends with a view: its length, its largest bound and its Σ. Both steps are monotone, so
that of two labels at one place (and, if turns cost, of one view) the one settled later, whose Σ is no smaller
in the positive semi-definite order, can be left out: whatever it leads to, the other does no worse. Settled
in the order of length plus the remaining distance, the first label at the goal is the shortest walk there is.
It may pass a place twice, to look around first.

Labels that do not compare with each other may be many. Of each place (or view) only so many are kept, those
settled first. If any are left out, the answer is a heuristic: there may be a shorter walk, though not one
shorter than what the first of them could have become.

Reference: Bry and Roy, "Rapidly-exploring random belief trees for motion planning under uncertainty", 2011
(dominance of covariances).
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from .. import se3
from ..bound.prior import PosePrior
from ..errors import PlanError
from ..noise.covariance import DEFINITE, unit_diagonal
from ..se3 import Array
from .odometry import Odometry
from .one_body import body_at, seen_roots
from .places import Places
from .view_field import ViewField

LABELS = 64
"""Kept of each place, or view."""

_ROUNDING = 1e-9  # of covariances that count as equal


@dataclass(frozen=True)
class Step:
    """A place of a route, its view, and the position bound before and after that."""

    place: int
    view: int
    before: float
    after: float


@dataclass(frozen=True, eq=False)
class _Label:
    """A walk by its end, and the one that it goes on from."""

    step: Step
    length: float
    covariance: Array
    worst: float
    parent: _Label | None

    @property
    def place(self) -> int:
        return self.step.place

    def route(self) -> list[Step]:
        """From its start."""
        steps = []
        label: _Label | None = self
        while label is not None:
            steps.append(label.step)
            label = label.parent
        return steps[::-1]


Order = Callable[[_Label], tuple[float, float]]


@dataclass
class LabelSearch:
    """Walks and their covariances, about the centroid of the open places, with the world's axes."""

    views: ViewField
    places: Places
    odometry: Odometry
    most: int
    """Labels kept of each place, or view."""
    dropped: int = 0
    """Labels left out so far, over all searches."""
    shorter: float = math.inf
    """In the search for the shortest walk: what the first of these could have come to."""
    roots: dict[int, Array] = field(default_factory=dict)
    """By place: of its views, R (h, 6, 6)."""
    ways: dict[tuple[int, int], Array] = field(default_factory=dict)
    """By places next to each other: Q of the way."""

    def __post_init__(self) -> None:
        self.body = body_at(self.places.positions[self.places.open].mean(axis=0))
        self.positions = self.places.positions - self.body[:3, 3]
        # The camera's centre c moves by δc = ρ − [c]× φ.
        self.centres = [np.hstack([np.eye(3), -se3.skew(c)]) for c in self.positions]
        self.poses = self.views.poses

    def first(self, start: int, prior: PosePrior | None) -> list[_Label]:
        """Labels at the start: one for each view there that, with the prior, sees all directions.

        Raises:
            PlanError: none does.
        """
        labels = []
        for view, root in zip(self.places.views[start].tolist(), self._roots(start), strict=True):
            information = root @ root.T
            if prior is not None:
                A = se3.adjoint(se3.inverse(self.poses[view]) @ self.body)
                information += A.T @ prior.in_frame("camera", self.poses[view]) @ A
            unit, s = unit_diagonal(information)
            if np.linalg.eigvalsh(unit)[0] > DEFINITE:
                covariance = s[:, None] * np.linalg.inv(unit) * s
                after = float(self._position(start, covariance))
                labels.append(_Label(Step(start, view, math.nan, after), 0.0, covariance, after, None))
        if not labels:
            raise PlanError(
                f"at the start, place {self.places.numbers[start]}, no view sees all directions"
                + (", not even with the prior" if prior is not None else ": give a prior of the start")
            )
        return labels

    def shortest(self, first: list[_Label], goal: int, limit: float, remaining: Array) -> list[Step]:
        """The route of the shortest walk whose bounds are at most the limit; empty if none was found.

        Args:
            first: labels at the start.
            goal: index of the place.
            limit: of the position bound [scene unit].
            remaining: (p,), distance of each place from the goal [scene unit].
        """

        def order(label: _Label) -> tuple[float, float]:
            return label.length + float(remaining[label.place]), label.step.after

        kept = [label for label in first if label.worst <= limit and np.isfinite(remaining[label.place])]
        end, self.shorter = self._settle(kept, goal, limit, order)
        return [] if end is None else end.route()

    def smallest_limit(self, first: list[_Label], goal: int, remaining: Array) -> float:
        """The smallest that a walk's largest bound can be; infinite if there is no walk."""

        def order(label: _Label) -> tuple[float, float]:
            return label.worst, label.length + float(remaining[label.place])

        kept = [label for label in first if np.isfinite(remaining[label.place])]
        end, _ = self._settle(kept, goal, math.inf, order)
        return math.inf if end is None else end.worst

    def _settle(
        self, first: list[_Label], goal: int, limit: float, order: Order
    ) -> tuple[_Label | None, float]:
        """Settle labels in this order until one is at the goal; the order of the first one left out, too."""
        count = itertools.count()  # equal ones in the order in which they came
        heap = [(*order(label), next(count), label) for label in first]
        heapq.heapify(heap)
        fronts: dict[int, _Front] = {}
        left_out = math.inf
        while heap:
            cost, _, _, label = heapq.heappop(heap)
            front = fronts.setdefault(self._node(label), _Front(self.most))
            if front.dominates(label.covariance):
                continue
            if label.place == goal:
                return label, left_out
            if front.full:
                self.dropped += 1
                left_out = min(left_out, cost)
                continue
            front.add(label.covariance)
            for place in self.places.neighbours(label.place).tolist():
                for new in self._moved(label, place, limit):
                    heapq.heappush(heap, (*order(new), next(count), new))
        return None, left_out

    def _node(self, label: _Label) -> int:
        """What labels have to have in common to be compared: the place or, if turns cost, the view."""
        return label.step.view if self.odometry.turn_deg > 0.0 else label.place

    def _moved(self, label: _Label, place: int, limit: float) -> list[_Label]:
        """The labels that follow from a step to a place: one for each view there."""
        predicted = label.covariance + self._way(label.place, place)
        before = float(self._position(place, predicted))
        if before > limit:
            return []
        views, R = self.places.views[place], self._roots(place)
        sigma = np.broadcast_to(predicted, (len(views), 6, 6))
        if self.odometry.turn_deg > 0.0:
            chord = self.poses[views, :3, :3] - self.poses[label.step.view, :3, :3]
            half = np.minimum(np.linalg.norm(chord, axis=(1, 2)) / np.sqrt(8.0), 1.0)
            sigma = sigma + self.odometry.turned(self.positions[place], 2.0 * np.arcsin(half))
        # (Σ⁻¹ + R Rᵀ)⁻¹ without an inverse of Σ, which perfect odometry may leave singular.
        gain = sigma @ R
        updated = sigma - gain @ np.linalg.solve(np.eye(6) + R.mT @ gain, gain.mT)
        updated = 0.5 * (updated + updated.mT)
        length = label.length + float(np.linalg.norm(self.positions[place] - self.positions[label.place]))
        worst = max(label.worst, before)
        return [
            _Label(Step(place, view, before, after), length, covariance, max(worst, after), label)
            for view, covariance, after in zip(
                views.tolist(), updated, self._position(place, updated).tolist(), strict=True
            )
        ]

    def _way(self, start: int, end: int) -> Array:
        if (start, end) not in self.ways:
            self.ways[start, end] = self.odometry.moved(self.positions[start], self.positions[end])
        return self.ways[start, end]

    def _roots(self, place: int) -> Array:
        if place not in self.roots:
            self.roots[place] = seen_roots(self.views, self.places.views[place], self.body)
        return self.roots[place]

    def _position(self, place: int, covariance: Array) -> Array:
        """(...), the position bound of covariances (..., 6, 6) at a place."""
        J = self.centres[place]
        variance = np.trace(J @ covariance @ J.T, axis1=-2, axis2=-1)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)), dtype=np.float64)


class _Front:
    """Covariances at one place of which none is larger than another, in the positive semi-definite order."""

    def __init__(self, most: int) -> None:
        """Empty, with room for so many."""
        self._all = np.empty((most, 6, 6))
        self._count = 0

    @property
    def full(self) -> bool:
        """Whether there is no more room."""
        return self._count == len(self._all)

    def add(self, covariance: Array) -> None:
        """One more."""
        self._all[self._count] = covariance
        self._count += 1

    def dominates(self, covariance: Array) -> bool:
        """Whether one of them is no larger than this one."""
        held = self._all[: self._count]
        # No larger in any direction is no larger along the axes: most fail there, at a small price.
        diagonal = np.diagonal(covariance) * (1.0 + _ROUNDING)
        held = held[(np.diagonal(held, axis1=1, axis2=2) <= diagonal).all(axis=1)]
        if not len(held):
            return False
        unit, s = unit_diagonal(covariance)
        smallest = np.linalg.eigvalsh(unit - s[:, None] * held * s)[:, 0]
        return bool((smallest >= -_ROUNDING).any())
