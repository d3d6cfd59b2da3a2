"""The shortest path through a field of views on which a camera never knows its position worse than a limit.

*Without odometry* each view stands for itself: the shortest path (Dijkstra) over places whose best view's own
position bound, two of its standard errors added, is at most the limit. What is not resolved is not passed.

*With odometry* the views are joined by what it knows of the motion between them (`label_search`), and the
bound is at most the limit before and after each view.

Where no path keeps to the limit, the smallest limit that one keeps to is found.

Reference: Dijkstra, "A note on two problems in connexion with graphs", 1959.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from ..bound.prior import PosePrior
from ..errors import PlanError
from ..files import Record
from ..se3 import Array
from .label_search import LABELS, LabelSearch, Step
from .odometry import Odometry
from .one_body import refuse_prior
from .places import Places, places_of
from .view_field import ViewField

STANDARD_ERRORS = 2.0
"""Added to a view's own bound before it is compared with the limit."""


@dataclass(frozen=True, eq=False)
class PathPlan(Record):
    """A path under a limit, or that there is none."""

    start: int
    """Number of the place."""
    goal: int
    """Number of the place."""
    limit: float
    """Of the position bound, the root of its covariance's trace [scene unit]."""
    odometry: Odometry | None
    """What joins the views; None: each stands for itself."""
    places: tuple[int, ...]
    """Numbers of the places passed; empty if there is no path."""
    views: tuple[int, ...]
    """The view taken at each."""
    poses: Array
    """(m, 4, 4), `world_from_camera` of the views."""
    length: float
    """Of the path; infinite if there is none [scene unit]."""
    shortest: float
    """Of the shortest path without any limit; infinite if the places are not connected [scene unit]."""
    before: Array
    """(m,), the position bound on arrival, before the view; NaN at the start and without odometry."""
    after: Array
    """(m,), the position bound with the view; without odometry the view's own, its errors added."""
    smallest_limit: float
    """The path's largest bound; if there is none, the smallest limit that has one, infinite if none has
    [scene unit]."""
    dropped: int
    """Labels that were left out though they might have mattered; the answer is a heuristic unless it is 0."""
    length_lower_limit: float
    """No path under the limit is shorter: the length itself unless labels were left out [scene unit]."""
    dropped_below: int
    """Left out in the search for the smallest limit: unless it is 0, a smaller one may have a path."""
    neighbourhood: str
    """Which places are next to each other, in words."""

    @property
    def found(self) -> bool:
        """Whether there is a path."""
        return bool(self.places)

    @property
    def exit_code(self) -> int:
        """0 if there is one, 1 if there is none, 3 if the labels kept cannot tell."""
        return 0 if self.found else 3 if self.dropped else 1

    def __str__(self) -> str:
        lines = [f"from place {self.start} to place {self.goal}, position std at most {self.limit:.4g}"]
        if self.found:
            lines.append(f"length        {self.length:.4g} [scene unit], {len(self.places)} places")
            lines.append(f"position std  at most {self.smallest_limit:.3g} [scene unit]")
        else:
            lines.append(f"no path       the smallest limit that has one is {self.smallest_limit:.4g}")
        lines.append(f"without limit {self.shortest:.4g} [scene unit]")
        return "\n".join(lines)


def plan_path(
    field: ViewField,
    start: int | str,
    goal: int | str,
    *,
    limit: float,
    odometry: Odometry | None = None,
    start_prior: PosePrior | None = None,
    reach: float | None = None,
    labels: int = LABELS,
) -> PathPlan:
    """The shortest path on which the position bound is at most `limit`.

    Args:
        field: the views.
        start, goal: numbers of places, or points "x:y:z", which stand for the nearest place.
        limit: of the root of the position covariance's trace [scene unit].
        odometry: what joins the views; None: each stands for itself.
        start_prior: what is known of the camera's pose at the start, with odometry; default: what a view
            there knows by itself.
        reach: see `places_of`.
        labels: how many to keep of each place.

    Raises:
        PlanError: a place that does not exist or cannot be passed, a limit, a reach or a number of labels
            that is not positive, a prior without odometry; with it, a field that was measured with a prior,
            or no view at the start that sees all directions.
    """
    if not limit > 0.0 or math.isnan(limit):
        raise PlanError(f"the limit must be a positive length, not {limit:g}")
    if labels < 1:
        raise PlanError(f"at least 1 label has to be kept of each place, not {labels}")
    if start_prior is not None and odometry is None:
        raise PlanError("a prior at the start counts with odometry only: give --odometry, or leave it out")
    places = places_of(field, reach=reach)
    ends = places.find(str(start), "--from"), places.find(str(goal), "--to")
    remaining = dijkstra(places.lengths, indices=ends[1])
    if odometry is None:
        route, smallest = _by_themselves(field, places, ends, limit)
        dropped, below, shorter = 0, 0, math.inf
    else:
        refuse_prior(field)
        search = LabelSearch(field, places, odometry, labels)
        first = search.first(ends[0], start_prior)
        route = search.shortest(first, ends[1], limit, remaining)
        dropped, shorter = search.dropped, search.shorter
        smallest = math.nan if route else search.smallest_limit(first, ends[1], remaining)
        below = search.dropped - dropped
    views = [step.view for step in route]
    stops = [step.place for step in route]
    before, after = np.array([s.before for s in route]), np.array([s.after for s in route])
    bounds = np.concatenate([before[~np.isnan(before)], after])
    centres = places.positions[stops]
    length = float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum()) if route else math.inf
    return PathPlan(
        start=int(places.numbers[ends[0]]),
        goal=int(places.numbers[ends[1]]),
        limit=float(limit),
        odometry=odometry,
        places=tuple(places.numbers[stops].tolist()),
        views=tuple(views),
        poses=field.poses[views].reshape(-1, 4, 4),
        length=length,
        shortest=float(remaining[ends[0]]),
        before=before,
        after=after,
        smallest_limit=float(bounds.max()) if route else smallest,
        dropped=dropped,
        length_lower_limit=min(length, shorter),
        dropped_below=below,
        neighbourhood=places.neighbourhood,
    )


def upper_position_bounds(field: ViewField) -> Array:
    """(n,), each view's own position bound and two of its standard errors; infinite unless all is seen.

    The errors of the three axes count as if they were fully correlated, which is the largest that they make.
    """
    bound = field.position_bound
    deviations = field.values("position_std")
    errors = field.values("position_std_standard_error")
    seen = field.usable & np.isfinite(bound)
    upper = np.full(len(bound), np.inf)
    slope = (deviations[seen] * np.nan_to_num(errors[seen])).sum(axis=1) / bound[seen]
    upper[seen] = bound[seen] + STANDARD_ERRORS * slope
    return upper


def _by_themselves(
    field: ViewField, places: Places, ends: tuple[int, int], limit: float
) -> tuple[list[Step], float]:
    """The route without odometry, empty if there is none, and the smallest limit that has one."""
    upper = upper_position_bounds(field)
    best = [int(views[np.argmin(upper[views])]) if len(views) else -1 for views in places.views]
    bound = np.array([upper[view] if view >= 0 else np.inf for view in best])
    passed = _way(places, bound <= limit, ends)
    if passed:
        return [Step(place, best[place], math.nan, float(bound[place])) for place in passed], math.nan
    limits = np.unique(bound[np.isfinite(bound)])
    low, high = 0, len(limits)  # the smallest limit is limits[high], if any has a way
    while low < high:
        middle = (low + high) // 2
        if _way(places, bound <= limits[middle], ends):
            high = middle
        else:
            low = middle + 1
    return [], float(limits[high]) if high < len(limits) else math.inf


def _way(places: Places, allowed: NDArray[np.bool_], ends: tuple[int, int]) -> list[int]:
    """The shortest way over some places, empty if there is none."""
    start, goal = ends
    if not (allowed[start] and allowed[goal]):
        return []
    whole = places.lengths.tocoo()
    kept = allowed[whole.row] & allowed[whole.col]
    graph = csr_array((whole.data[kept], (whole.row[kept], whole.col[kept])), shape=whole.shape)
    distance, before = dijkstra(graph, indices=start, return_predecessors=True)
    if not np.isfinite(distance[goal]):
        return []
    way = [goal]
    while way[-1] != start:
        way.append(int(before[way[-1]]))
    return way[::-1]
