"""Where to look next: k views of a field that tell most of the common pose of one body that carries them all.

The unknown is the pose of a rigid body whose relative poses to its cameras are exactly known: a rig, or a
robot that stands still between exact motions. Then informations add (`one_body`), and the choice maximises

    f(F_0 + Σ chosen F_i),    f = log det, the trace or λ_min,    F_0 = views taken + prior + ridge,

in the body's frame at the centroid of all usable views' cameras, with translation in units of the usable
views' median length scale. This is the problem of `agents.selection` with views in place of tiles: greedy,
then exchanges; an upper bound on what any choice could reach, and so a certificate. Log det does not depend
on where the body's origin is, the trace and λ_min do.

The ridge stands in for what is not known of the body beforehand, one length scale and one radian by default;
it takes part in the choice, not in the reported bounds. Those are of the position of the centroid of the
cameras taken and chosen so far, so that a single view's is its own, and take the whole information, with its
error. A view whose noise would hide a direction that those before it see is left out of them: more views
never tell less, so that the others' bound holds with it, too. A view chosen for its lucky error keeps it: the
field has no second half to report on.

This is information about the pose. What FisherRF and its kin maximise, information about the map, is another
quantity.

References: Zhang and Scaramuzza, "Fisher Information Field", 2020; Kaveti et al., "OASIS: optimal
arrangements for sensing in SLAM", 2024.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from numbers import Integral

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..agents.greedy import choose, greedy
from ..agents.relaxation import upper_bound
from ..agents.selection import certified, guaranteed
from ..agents.tiles import Limits, Problem
from ..bound.cramer_rao import PoseBound, cramer_rao_bound
from ..bound.criteria import OBJECTIVES
from ..bound.prior import PosePrior
from ..errors import PlanError, PrecisionWarning
from ..files import Record
from ..information.fisher import FisherInformation
from ..information.significance import identified, no_information
from ..se3 import Array
from .layout import TO_DO
from .one_body import body_at, information_about, refuse_prior, seen_blocks
from .view_field import BODY, ViewField

ONE_BODY = "the common pose of one body that carries all these views, their relative poses exactly known"
"""What the numbers are about, for every output."""


@dataclass(frozen=True, eq=False)
class NextViews(Record):
    """Which views to add, and the bound of the body that carries them."""

    objective: str
    """`"logdet"`, `"trace"` or `"lambda_min"`."""
    have: tuple[int, ...]
    """The views that were taken before."""
    chosen: tuple[int, ...]
    """By falling gain, each beside those before it; the first few are not always the best few."""
    poses: Array
    """(k, 4, 4), `world_from_camera` of those chosen."""
    position_bound: Array
    """(k + 1,), after 0 to k of them: root of the position covariance's trace, at the centroid of the cameras
    so far; infinite unless all of it is seen [scene unit]."""
    position_bound_standard_error: Array
    """(k + 1,), NaN where the bound is infinite [scene unit]."""
    rotation_bound_deg: Array
    """(k + 1,), the same of the body's rotation [deg]."""
    rotation_bound_deg_standard_error: Array
    """(k + 1,) [deg]."""
    rank: tuple[int, ...]
    """(k + 1,), of the information, the prior included."""
    value: float
    """f of the choice, the ridge included."""
    value_empty: float
    """f without it."""
    upper_bound: float
    """No choice of as many usable views has a larger `value`."""
    certificate: float
    """(value − value_empty) / (upper_bound − value_empty): at least this fraction of the best gain."""
    guarantee: float | None
    """The fraction of the best gain that is certain before looking at the views; None if there is none."""
    usable: int
    """How many views could be chosen: measured, of some rank, and not taken before."""
    body: Array
    """(4, 4), the pose of the body that the objective is about, the world's axes at the cameras' centroid."""
    length_scale: float
    """The objective's unit of translation [scene unit]."""
    ridge: float
    """Information about every direction beforehand, in that unit."""

    def __str__(self) -> str:
        guarantee = "none" if self.guarantee is None else f"{self.guarantee:.3g}"
        return "\n".join(
            (
                f"chosen         {', '.join(map(str, self.chosen))} of {self.usable} usable views, "
                f"{len(self.have)} taken before",
                f"position std   {self.position_bound[0]:.3g} to {self.position_bound[-1]:.3g} "
                "[scene unit], all three together",
                f"rotation std   {self.rotation_bound_deg[0]:.3g} to {self.rotation_bound_deg[-1]:.3g} "
                "[deg], all three together",
                f"{self.objective:<14} {self.value_empty:.4g} to {self.value:.4g}, no choice above "
                f"{self.upper_bound:.4g}",
                f"certificate    {self.certificate:.3f} of the best gain; guaranteed beforehand {guarantee}",
                f"of             {ONE_BODY}",
            )
        )


def next_views(
    field: ViewField,
    *,
    have: Sequence[int] = (),
    budget: int,
    objective: str = "logdet",
    prior: PosePrior | None = None,
    ridge: float = 1.0,
) -> NextViews:
    """Choose views that tell most of the common pose of one body that carries them: max f(F_0 + Σ F_i).

    Args:
        field: the candidates and their informations.
        have: views that are taken already, by their numbers in the field.
        budget: how many to add.
        objective: log det (all directions), trace (of no use against unseen directions) or λ_min (the worst).
        prior: of the body's pose, with the world's axes at the centroid of the usable views' cameras.
        ridge: information about every direction beforehand, one length scale and one radian; see the module.

    Raises:
        PlanError: an unknown objective, a budget below 1 or above the usable views, a view that does not
            exist, is named twice or is not measured yet, a ridge that is not positive, or a field that was
            measured with a prior.
    """
    if objective not in OBJECTIVES:
        raise PlanError(f"unknown objective {objective!r}; {_near(objective)}")
    if not (np.isfinite(ridge) and ridge > 0.0):
        raise PlanError(f"the ridge must be a positive number, not {ridge!r}")
    refuse_prior(field)
    criterion = OBJECTIVES[objective]
    taken = _taken(field, have)
    candidates = _candidates(field, taken, budget)
    known = np.flatnonzero(field.usable & (field.rank > 0))
    body = body_at(field.poses[known, :3, 3].mean(axis=0))
    length = float(np.median(field.values("length_scale")[known]))
    scale = np.array([length] * 3 + [1.0] * 3)
    base = ridge * np.eye(6) + scale[:, None] * _summed(field, taken, body) * scale
    if prior is not None:
        base += scale[:, None] * prior.in_frame("camera", body) * scale
    blocks = scale[:, None] * seen_blocks(field, candidates, body) * scale
    problem = Problem(
        base=base,
        blocks=blocks,
        agent=np.zeros(len(candidates), dtype=np.int64),
        cost=np.ones(len(candidates)),
        limits=Limits(np.full(1, np.inf), np.full(1, np.inf), float(budget), np.inf),
    )
    choice = choose(problem.simplified(), criterion)
    # Exchanges leave no order that means something: the one of the largest gains among those chosen does.
    own = problem.restricted(np.isin(np.arange(len(problem)), choice.tiles))
    among = np.sort(choice.tiles)[list(greedy(own, criterion).tiles)].tolist()
    value = float(criterion.value(problem.information(among)))
    empty = float(criterion.value(base))
    most = upper_bound(problem.simplified(), criterion, value)
    chosen = [int(candidates[tile]) for tile in among]
    bounds = [_bound(field, [*taken, *chosen[:k]], body, prior) for k in range(len(chosen) + 1)]
    position = [_root(bound.position_std, bound.position_std_standard_error) for bound in bounds]
    rotation = [_root(bound.rotation_std_deg, bound.rotation_std_deg_standard_error) for bound in bounds]
    return NextViews(
        objective=objective,
        have=tuple(taken),
        chosen=tuple(chosen),
        poses=field.poses[chosen],
        position_bound=np.array([value for value, _ in position]),
        position_bound_standard_error=np.array([error for _, error in position]),
        rotation_bound_deg=np.array([value for value, _ in rotation]),
        rotation_bound_deg_standard_error=np.array([error for _, error in rotation]),
        rank=tuple(bound.rank for bound in bounds),
        value=value,
        value_empty=empty,
        upper_bound=most,
        certificate=certified(value, empty, most),
        guarantee=guaranteed(problem.simplified(), criterion),
        usable=len(candidates),
        body=body,
        length_scale=length,
        ridge=ridge,
    )


def body_bound(field: ViewField, views: Sequence[int], prior: PosePrior | None = None) -> PoseBound:
    """The bound of one body that carries some views, at the centroid of their cameras, with the world's axes.

    Args:
        field: with their informations.
        views: by their numbers.
        prior: of the body's pose at the centroid of the usable views' cameras.
    """
    known = np.flatnonzero(field.usable & (field.rank > 0))
    return _bound(field, list(views), body_at(field.poses[known, :3, 3].mean(axis=0)), prior)


def stored_views(field: ViewField, poses: Array) -> tuple[int, ...]:
    """The numbers of the field's views at some poses (m, 4, 4).

    Raises:
        PlanError: at one of them the field has no view; names the nearest.
    """
    found = []
    for k, pose in enumerate(np.asarray(poses, dtype=np.float64)):
        distance = np.linalg.norm(field.poses[:, :3, 3] - pose[:3, 3], axis=1)
        # From the chord: an arc cosine near 1 has half of the digits.
        chord = np.linalg.norm(field.poses[:, :3, :3] - pose[:3, :3], axis=(1, 2)) / np.sqrt(8.0)
        angle = np.degrees(2.0 * np.arcsin(np.minimum(chord, 1.0)))
        reach = _SAME_POSITION * np.maximum(field.values("length_scale"), _SMALLEST_SCALE)
        nearest = int(np.lexsort((angle, distance.round(12)))[0])
        fitting = np.flatnonzero((distance <= reach) & (angle <= _SAME_ANGLE_DEG))
        if not len(fitting):
            raise PlanError(
                f"the store has no view at pose {k}; the nearest is view {nearest}, {distance[nearest]:.3g} "
                f"scene units and {angle[nearest]:.3g} degrees away: measure a field that has the pose, too"
            )
        found.append(int(fitting[np.argmin(distance[fitting] / reach[fitting] + angle[fitting])]))
    return tuple(found)


_SAME_POSITION = 1e-3  # length scales; files of poses are texts of a few decimals
_SAME_ANGLE_DEG = 0.1
_SMALLEST_SCALE = 1e-3  # of views that see nothing


def _taken(field: ViewField, have: Sequence[int]) -> list[int]:
    """The views that are there already, checked."""
    taken = [int(view) for view in have]
    for view in taken:
        if not 0 <= view < len(field):
            raise PlanError(f"there is no view {view}; the field has {len(field)}, numbered from 0")
        if field.status[view] == TO_DO or not field.done[view]:
            raise PlanError(f"view {view} is not measured yet; finish the field by the same command first")
    if len(set(taken)) < len(taken):
        twice = next(view for view in taken if taken.count(view) > 1)
        raise PlanError(f"view {twice} is among those taken twice")
    return taken


def _candidates(field: ViewField, taken: Sequence[int], budget: int) -> NDArray[np.intp]:
    """Which views could be chosen, as many as the budget at least."""
    usable = field.usable & (field.rank > 0)
    usable[list(taken)] = False
    candidates = np.flatnonzero(usable)
    if not isinstance(budget, Integral) or budget < 1:
        raise PlanError(f"the budget must be a whole number of views, at least 1, not {budget!r}")
    if budget > len(candidates):
        raise PlanError(
            f"a budget of {budget} views, but only {len(candidates)} of {len(field)} can be chosen: the "
            "others are taken, not measured, inside or behind something, or see nothing"
        )
    return candidates


def _summed(field: ViewField, views: Sequence[int], body: Array) -> Array:
    total: Array = seen_blocks(field, np.array(views, dtype=np.intp), body).sum(axis=0)
    return total


def _bound(field: ViewField, views: Sequence[int], body: Array, prior: PosePrior | None) -> PoseBound:
    """Of views on one body, at the centroid of their cameras; the prior is about `body`."""
    centre = body if not len(views) else body_at(field.poses[list(views), :3, 3].mean(axis=0))
    total = no_information(variable=BODY, pose=centre)
    rank = 0
    for k, view in enumerate(views):
        information = information_about(field, view, centre)
        joined = information if k == 0 else total + information
        found = identified(joined).rank
        if k == 0 or found >= rank:
            total, rank = joined, found
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PrecisionWarning)  # standard errors say as much
        return cramer_rao_bound(total, prior=None if prior is None else _moved(prior, body, total))


def _moved(prior: PosePrior, body: Array, information: FisherInformation) -> PosePrior:
    """A prior about the body's origin as one about the same body's pose at the information's."""
    about = se3.adjoint(se3.inverse(body) @ information.pose)
    return PosePrior(about.T @ prior.in_frame("camera", body) @ about, "camera")


def _root(deviations: Array, errors: Array) -> tuple[float, float]:
    """The norm of three standard deviations, and at most its standard error, whatever their correlation."""
    norm = float(np.linalg.norm(deviations))
    return norm, float(deviations @ errors) / norm if np.isfinite(norm) else np.nan


def _near(objective: str) -> str:
    near = get_close_matches(objective, OBJECTIVES, 1, 0.5)
    return f"did you mean {near[0]!r}?" if near else f"expected {', '.join(map(repr, OBJECTIVES))}"
