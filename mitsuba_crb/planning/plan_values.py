"""A field of views as a map: of each position in the plan the best, or the worst, of what is seen there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..se3 import Array
from .layout import INSIDE, VERDICTS
from .plan_view import PlanView
from .view_field import ViewField

Quantity = Literal["position", "rotation", "rank"]

SHOWN, UNSEEN, NOT_RESOLVED, INSIDE_SOLID, NOTHING, TO_DO = range(6)
"""What a position is: there is a number; no view has one, and a direction is unseen; or not resolved; it is
inside a solid; every view of it is blocked or shows nothing; not all of its views are measured yet."""

WORDS = {
    UNSEEN: "a direction is unseen",
    NOT_RESOLVED: "not resolved",
    INSIDE_SOLID: "inside a solid",
    NOTHING: "nothing to see",
    TO_DO: "not measured yet",
}
"""Of those without a number."""

_SAME = 1e-6
"""Of the extent: positions that differ by less are one."""
_UNEVEN = 0.01
"""Of a grid's spacing: by how much it may differ."""


@dataclass(frozen=True, eq=False)
class PlanValues:
    """One number for each position in the plan."""

    positions: Array
    """(p, 2) in the plan's coordinates; of marks (p, 3) in the world [scene unit]."""
    values: Array
    """(p,) bound or rank; NaN where there is none."""
    kind: NDArray[np.int64]
    """(p,) of `SHOWN`, `UNSEEN` and so on."""
    view: NDArray[np.int64]
    """(p,) index of the view that has the number; −1 where there is none."""


def plan_values(field: ViewField, quantity: Quantity, *, worst: bool = False) -> PlanValues:
    """The best, or the worst, of all directions and heights at each position in the plan.

    An infinite bound is the worst there is: where a view has one, the worst is unseen or not resolved.

    Args:
        field: of at least one view.
        quantity: `position` or `rotation` for the bound (the root of the trace), or `rank`.
        worst: in place of the best.
    """
    positions, group = grouped(PlanView.of(field.up).flat(field.poses[:, :3, 3]))
    return group_values(field, quantity, positions, group, worst=worst)


def group_values(
    field: ViewField, quantity: Quantity, positions: Array, group: NDArray[np.int64], *, worst: bool = False
) -> PlanValues:
    """The same of any groups of views.

    Args:
        field, quantity, worst: as for `plan_values`.
        positions: (p, ...) of the groups.
        group: (n,) which one each view is in.
    """
    numbers = {
        "position": field.position_bound,
        "rotation": field.rotation_bound_deg,
        "rank": -field.rank.astype(np.float64),  # the least is best, as of bounds
    }[quantity]
    verdict = "rotation_verdict" if quantity == "rotation" else "position_verdict"
    unseen = np.any(field.values(verdict) == VERDICTS.index("unseen"), axis=1)
    usable, done, status = field.usable, field.done, field.status
    values, kind = np.full(len(positions), np.nan), np.full(len(positions), TO_DO)
    view = np.full(len(positions), -1)
    for k in range(len(positions)):
        (all_here,) = np.nonzero(group == k)
        here = all_here[usable[all_here]]
        if not len(here):
            if done[all_here].all():
                solid = (status[all_here] == INSIDE).all()
                kind[k] = INSIDE_SOLID if solid else NOTHING
            continue
        chosen = here[np.argmax(numbers[here]) if worst else np.argmin(numbers[here])]
        if np.isfinite(numbers[chosen]):
            values[k], kind[k], view[k] = numbers[chosen], SHOWN, chosen
        else:
            infinite = here[~np.isfinite(numbers[here])]
            kind[k] = UNSEEN if unseen[infinite].any() else NOT_RESOLVED
    return PlanValues(positions, np.abs(values), kind, view)


def grouped(flat: Array) -> tuple[Array, NDArray[np.int64]]:
    """Different positions (p, 2) of points (n, 2), by their first coordinate, and which each point has."""
    grain = _SAME * max(float(np.ptp(flat, axis=0).max()), 1e-300)
    keys = np.round((flat - flat.min(axis=0)) / grain).astype(np.int64)
    _, first, group = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return flat[first], group.ravel()


def lattice(positions: Array) -> Array | None:
    """(2,) spacing of positions (p, 2) that lie on a rectangular grid, most of which they fill; else None."""
    extent = float(np.ptp(positions, axis=0).max())
    if extent == 0.0:
        return None
    steps, cells = np.empty(2), 1
    for axis in (0, 1):
        places = np.unique(np.round(positions[:, axis] / (_SAME * extent))) * _SAME * extent
        gaps = np.diff(places)
        if len(gaps) and np.ptp(gaps) > _UNEVEN * gaps.min():
            return None
        steps[axis] = gaps.min() if len(gaps) else np.nan
        cells *= len(places)
    if cells > 2 * len(positions):
        return None
    return np.where(np.isnan(steps), np.nanmax(steps), steps)
