"""The places of a field of views as a graph: where one can go, and from where to where in one step.

A place can be passed if a camera was measured there, or sees nothing there; not if all of its views are
inside a solid, behind something, or not measured. On a grid each place is next to those around it, diagonals
included if none of the corners they cut is closed. Otherwise, places within a reach are next to each other:
half again the median distance of a place to its nearest one.

What stands between two places that can both be passed, a field does not know: walls are to be thicker than
the places are apart.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from ..errors import PlanError
from ..se3 import Array
from .layout import MEASURED, OUTSIDE
from .view_field import ViewField

_REACH = 1.5  # of the median distance to the nearest place
_ON_THE_LATTICE = 1e-3  # of a spacing


@dataclass(frozen=True, eq=False)
class Places:
    """Positions and which are next to each other."""

    numbers: NDArray[np.int64]
    """(p,) as the field calls them, ascending."""
    positions: Array
    """(p, 3) [scene unit]."""
    views: tuple[NDArray[np.int64], ...]
    """Of each, the views that a camera can have there; none where it cannot be."""
    lengths: Any
    """(p, p) sparse: the distance of places that are next to each other [scene unit]."""
    neighbourhood: str
    """Which are, in words."""

    @property
    def open(self) -> NDArray[np.bool_]:
        """(p,) where a camera can be."""
        return np.array([len(views) > 0 for views in self.views])

    def neighbours(self, place: int) -> NDArray[np.int64]:
        """The places next to one, by their indices."""
        found: NDArray[np.int64] = self.lengths.indices[
            self.lengths.indptr[place] : self.lengths.indptr[place + 1]
        ]
        return found

    def find(self, text: str, what: str) -> int:
        """The index of a place by its number, or of the nearest open one to a point x:y:z.

        Args:
            text: as the user gives it.
            what: "--from" or "--to", for messages.

        Raises:
            PlanError: there is no such place, it cannot be passed, or these are no three numbers.
        """
        if ":" in text:
            distance = np.linalg.norm(self.positions - _point(text, what), axis=1)
            return int(np.argmin(np.where(self.open, distance, np.inf)))
        try:
            number = int(text)
        except ValueError:
            raise PlanError(f"{what} {text}: expected the number of a place, or a point x:y:z") from None
        (found,) = np.nonzero(self.numbers == number)
        if not len(found):
            raise PlanError(
                f"{what} {text}: there is no such place; the field has {len(self.numbers)}, from "
                f"{self.numbers[0]} to {self.numbers[-1]}"
            )
        place = int(found[0])
        if not self.open[place]:
            raise PlanError(
                f"{what} {text}: no camera can be there: its views are inside or behind something, or not "
                f"measured; the nearest open place has the number {self.numbers[self._open_near(place)]}"
            )
        return place

    def _open_near(self, place: int) -> int:
        distance = np.linalg.norm(self.positions - self.positions[place], axis=1)
        return int(np.argmin(np.where(self.open, distance, np.inf)))


def places_of(field: ViewField, *, reach: float | None = None) -> Places:
    """The graph of a field's places.

    Args:
        field: the views.
        reach: places no farther apart are next to each other [scene unit]; default: see the module.

    Raises:
        PlanError: no place can be passed, or a reach that is not positive.
    """
    if reach is not None and not (np.isfinite(reach) and reach > 0.0):
        raise PlanError(f"the reach must be a positive length, not {reach:g}")
    numbers, first, index = np.unique(field.place, return_index=True, return_inverse=True)
    positions = field.poses[first, :3, 3]
    free = field.done & np.isin(field.status, (MEASURED, OUTSIDE))
    views = tuple(np.flatnonzero(free & (index == place)) for place in range(len(numbers)))
    passable = np.array([len(some) > 0 for some in views])
    if not passable.any():
        raise PlanError("the field has no place where a camera can be; measure one that has")
    lattice = _lattice(field, positions) if reach is None else None
    if lattice is not None:
        pairs, words = _grid_pairs(lattice, passable), "places of the grid around each"
    else:
        reach = _default_reach(positions[passable]) if reach is None else reach
        pairs, words = (
            _pairs_within(positions, passable, reach),
            f"places at most {reach:.3g} scene units apart",
        )
    length = np.linalg.norm(positions[pairs[:, 0]] - positions[pairs[:, 1]], axis=1)
    both = np.concatenate([pairs, pairs[:, ::-1]])
    shape = (len(numbers), len(numbers))
    lengths = csr_array((np.concatenate([length, length]), (both[:, 0], both[:, 1])), shape=shape)
    lengths.sort_indices()
    return Places(numbers.astype(np.int64), positions, views, lengths, words)


def _point(text: str, what: str) -> Array:
    try:
        point = np.array([float(word) for word in text.split(":")])
    except ValueError:
        point = np.empty(0)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise PlanError(f"{what} {text}: expected the number of a place, or a point x:y:z")
    return point


def _lattice(field: ViewField, positions: Array) -> NDArray[np.int64] | None:
    """Whole coordinates (p, 3) of the places of a grid; None if these are none."""
    said = field.candidates
    if said.get("kind") != "grid":
        return None
    spacing = np.asarray(said["spacing"], dtype=np.float64)
    steps = positions @ np.asarray(said["axes"], dtype=np.float64).T - np.asarray(said["origin"])
    coordinates = np.divide(steps, spacing, out=np.zeros_like(steps), where=spacing > 0.0)
    whole = coordinates.round()
    return whole.astype(np.int64) if np.abs(coordinates - whole).max() <= _ON_THE_LATTICE else None


def _grid_pairs(lattice: NDArray[np.int64], passable: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Pairs (m, 2) of places next to each other, none of the corners between them closed."""
    at = {tuple(cell): place for place, cell in enumerate(lattice.tolist()) if passable[place]}
    pairs = []
    for cell, place in at.items():
        for step in itertools.product((-1, 0, 1), repeat=3):
            if step <= (0, 0, 0):  # each pair once
                continue
            box = itertools.product(*({0, part} for part in step))
            corners = [at.get((cell[0] + i, cell[1] + j, cell[2] + k)) for i, j, k in box]
            if None not in corners:
                pairs.append((place, at[cell[0] + step[0], cell[1] + step[1], cell[2] + step[2]]))
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def _default_reach(positions: Array) -> float:
    if len(positions) < 2:
        return 1.0
    return _REACH * float(np.median(cKDTree(positions).query(positions, k=2)[0][:, 1]))


def _pairs_within(positions: Array, passable: NDArray[np.bool_], reach: float) -> NDArray[np.int64]:
    kept = np.flatnonzero(passable)
    pairs = cKDTree(positions[kept]).query_pairs(reach * (1.0 + 1e-9), output_type="ndarray")
    return np.asarray(kept[pairs], dtype=np.int64).reshape(-1, 2)
