"""A field of views as marks in the world: one for each place; of very many places one for some that are near.

A mark stands where its best view is, or where the first one is if no view there has a finite bound.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..se3 import Array
from .plan_values import PlanValues, group_values
from .view_field import ViewField

MOST = 4000
"""Marks that can be turned and looked at."""
_COARSER = 1.2
"""From one try of the cells' side to the next."""


@dataclass(frozen=True, eq=False)
class Marks:
    """What is drawn in place of views, the best first, those without a number last."""

    best: PlanValues
    """Of each the best position bound and whose it is."""
    views: NDArray[np.int64]
    """(m,) index of the view that stands for each."""
    count: NDArray[np.int64]
    """(m,) how many views each is drawn in place of."""
    places: int
    """Of the field, all together."""
    side: float
    """Of the cubes of which only the best place is drawn [scene unit]; 0: every place is drawn."""


def marks_of(field: ViewField, most: int = MOST) -> Marks:
    """The marks of a field of at least one view.

    Args:
        field: the views.
        most: marks; where there are more places, the best of each cube of a lattice is drawn.
    """
    _, group = np.unique(field.place, return_inverse=True)
    places, side = int(group.max()) + 1, 0.0
    if places > most:
        group, side = _cubes(field.poses[:, :3, 3], most)
    _, first = np.unique(group, return_index=True)
    best = group_values(field, "position", np.zeros((len(first), 3)), group)
    views = np.where(best.view >= 0, best.view, first)
    order = np.argsort(best.values, kind="stable")  # NaN last
    positions = field.poses[views[order], :3, 3]
    return Marks(
        PlanValues(positions, best.values[order], best.kind[order], best.view[order]),
        views[order],
        np.bincount(group)[order],
        places,
        side,
    )


def _cubes(positions: Array, most: int) -> tuple[NDArray[np.int64], float]:
    """(n,) which cube each is in, and their side: the smallest tried of which at most `most` have any."""
    low = positions.min(axis=0)
    side = float((positions.max(axis=0) - low).max()) / most
    while True:
        cells = np.floor((positions - low) / side).astype(np.int64)
        found, group = np.unique(cells, axis=0, return_inverse=True)
        if len(found) <= most:
            return group.ravel(), side
        side *= _COARSER
