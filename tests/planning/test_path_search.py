"""Paths under a limit: by exhaustive search in other frames, monotone in the limit, honest about labels."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

import numpy as np
import pytest
from synthetic_field import OUTSIDE, small_field

from mitsuba_crb import se3
from mitsuba_crb.bound.prior import PosePrior
from mitsuba_crb.errors import PlanError
from mitsuba_crb.planning.odometry import Odometry
from mitsuba_crb.planning.path_search import PathPlan, plan_path, upper_position_bounds
from mitsuba_crb.planning.places import places_of
from mitsuba_crb.planning.view_field import ViewField

ODOMETRY = Odometry(0.05, 1.0)
TURNING = Odometry(0.05, 1.0, 2.0)
SMALL = {"shape": (3, 3), "headings": 2, "seed": 5}


@pytest.fixture(scope="module")
def field() -> ViewField:
    return small_field(**SMALL)


@pytest.fixture(scope="module")
def large() -> ViewField:
    return small_field(shape=(6, 5), inside=(12, 13))


def changed(field: ViewField, **variables: np.ndarray) -> ViewField:
    """A field with other values of some variables."""
    new = {name: (field.dataset[name].dims, values) for name, values in variables.items()}
    return ViewField(field.dataset.assign(new))


class Filter:
    """What a walk knows, in the camera's own frame and by plain inverses: another frame than the search's."""

    def __init__(self, field: ViewField, odometry: Odometry) -> None:
        self.field, self.odometry = field, odometry
        self.information = field.dataset["information_camera"].values
        self.density = np.diag([odometry.translation**2] * 3 + [np.radians(odometry.rotation_deg) ** 2] * 3)

    def start(self, view: int, prior: np.ndarray | None = None) -> np.ndarray:
        """Σ of the right twist at a view, of its own information and a prior's."""
        return np.linalg.inv(self.information[view] + (0.0 if prior is None else prior))

    def step(self, covariance: np.ndarray, start: int, end: int) -> tuple[float, np.ndarray, float]:
        """The position bound before the view at the end, Σ after it, and the bound then."""
        before = self.field.poses[start]
        there = before.copy()
        there[:3, 3] = self.field.poses[end, :3, 3]
        motion = se3.inverse(before) @ there
        length = np.linalg.norm(motion[:3, 3])
        carried = se3.adjoint(se3.inverse(motion))
        covariance = carried @ covariance @ carried.T
        # Gauss–Legendre of ∫ Ad(−s d) D Ad(−s d)ᵀ ds, exact for its quadratic integrand.
        for node, weight in zip(*np.polynomial.legendre.leggauss(3), strict=True):
            rest = np.eye(4)
            rest[:3, 3] = -0.5 * (1.0 - node) * motion[:3, 3]
            A = se3.adjoint(rest)
            covariance = covariance + 0.5 * weight * length * A @ self.density @ A.T
        turn = se3.inverse(there) @ self.field.poses[end]
        angle = np.linalg.norm(se3.log(turn)[3:])
        covariance = covariance + angle * np.radians(self.odometry.turn_deg) ** 2 * np.diag(
            [0, 0, 0, 1, 1, 1]
        )
        carried = se3.adjoint(se3.inverse(turn))
        covariance = carried @ covariance @ carried.T
        first = math.sqrt(np.trace(covariance[:3, :3]))
        covariance = np.linalg.inv(np.linalg.inv(covariance) + self.information[end])
        return first, covariance, math.sqrt(np.trace(covariance[:3, :3]))


def walks(
    field: ViewField, odometry: Odometry, start: int, goal: int, limit: float, longest: float
) -> Iterator[tuple[float, list[int]]]:
    """Every walk from place to place under the limit and no longer than that: its length and its views."""
    places, known = places_of(field), Filter(field, odometry)

    def on(views: list[int], covariance: np.ndarray, length: float) -> Iterator[tuple[float, list[int]]]:
        here = int(field.place[views[-1]])
        if here == goal:
            yield length, views
        for place in places.neighbours(here).tolist():
            far = length + float(np.linalg.norm(places.positions[place] - places.positions[here]))
            rest = float(np.linalg.norm(places.positions[place] - places.positions[goal]))
            if far + rest > longest + 1e-9:
                continue
            for view in places.views[place].tolist():
                before, new, after = known.step(covariance, views[-1], view)
                if max(before, after) <= limit:
                    yield from on([*views, view], new, far)

    for view in places.views[start].tolist():
        covariance = known.start(view)
        if math.sqrt(np.trace(covariance[:3, :3])) <= limit:
            yield from on([view], covariance, 0.0)


def assert_as_simulated(field: ViewField, plan: PathPlan, prior: np.ndarray | None = None) -> None:
    """Its bounds are those of the independent filter along its views, and at most the limit."""
    known = Filter(field, plan.odometry)
    covariance = known.start(plan.views[0], prior)
    assert plan.after[0] == pytest.approx(math.sqrt(np.trace(covariance[:3, :3])), rel=1e-6)
    for k in range(1, len(plan.views)):
        before, covariance, after = known.step(covariance, plan.views[k - 1], plan.views[k])
        assert (plan.before[k], plan.after[k]) == pytest.approx((before, after), rel=1e-6)
    assert max(plan.after.max(), np.nanmax(plan.before)) <= plan.limit
    assert field.place[list(plan.views)].tolist() == list(plan.places)


@pytest.mark.parametrize("odometry", [ODOMETRY, TURNING], ids=["turns are free", "turns cost"])
def test_no_walk_at_all_is_shorter(field: ViewField, odometry: Odometry) -> None:
    """Among limits that bite, exhaustive search finds the same length: dominance loses none."""
    lengths = set()
    loose = plan_path(field, 0, 8, limit=np.inf, odometry=odometry)
    for limit in np.linspace(0.6, 0.98, 4) * loose.smallest_limit:
        plan = plan_path(field, 0, 8, limit=limit, odometry=odometry, labels=100_000)
        assert plan.dropped == 0
        longest = plan.length if plan.found else 2.0 * loose.length
        found = list(walks(field, odometry, 0, 8, limit, longest))
        assert plan.found == bool(found)
        if plan.found:
            assert_as_simulated(field, plan)
            assert plan.length == pytest.approx(min(length for length, _ in found))
            assert plan.length_lower_limit == plan.length
        lengths.add(round(plan.length, 6))
    assert len(lengths) >= 2  # the limit decides something


@pytest.mark.slow
@pytest.mark.parametrize("odometry", [None, ODOMETRY, TURNING], ids=["none", "turns are free", "turns cost"])
def test_a_larger_limit_never_makes_it_longer_and_the_smallest_one_is_just_enough(
    large: ViewField, odometry: Odometry | None
) -> None:
    start, goal = 0, 29
    none = plan_path(large, start, goal, limit=1e-6, odometry=odometry, labels=1000)
    assert (none.found, none.exit_code, none.length) == (False, 1, math.inf)
    smallest = none.smallest_limit
    assert 1e-6 < smallest < math.inf
    assert none.dropped_below == 0
    just = plan_path(large, start, goal, limit=smallest * (1 + 1e-9), odometry=odometry, labels=1000)
    assert just.found
    assert just.smallest_limit == pytest.approx(smallest)
    below = plan_path(large, start, goal, limit=smallest * (1 - 1e-6), odometry=odometry, labels=1000)
    assert not below.found
    lengths = [
        plan_path(large, start, goal, limit=factor * smallest, odometry=odometry, labels=1000).length
        for factor in (1.0 + 1e-9, 1.3, 2.0, 10.0)
    ]
    assert (np.diff(lengths) <= 1e-12).all()
    assert lengths[-1] == pytest.approx(just.shortest)
    assert lengths[0] > lengths[-1]


def test_without_odometry_it_is_the_shortest_of_all_simple_paths(field: ViewField) -> None:
    upper, places = upper_position_bounds(field), places_of(field)
    bound = np.array([upper[views].min() for views in places.views])

    def paths(place: int, passed: tuple[int, ...], length: float, limit: float) -> Iterator[float]:
        if place == 8:
            yield length
        for other in places.neighbours(place).tolist():
            if other not in passed and bound[other] <= limit:
                far = float(np.linalg.norm(places.positions[other] - places.positions[place]))
                yield from paths(other, (*passed, other), length + far, limit)

    for limit in np.sort(bound)[3:]:
        allowed = bound[0] <= limit and bound[8] <= limit
        shortest = min(paths(0, (0,), 0.0, limit), default=math.inf) if allowed else math.inf
        plan = plan_path(field, 0, 8, limit=limit)
        assert plan.length == pytest.approx(shortest)
        if plan.found:
            assert (plan.after <= limit).all()
            assert np.isnan(plan.before).all()


def test_a_view_counts_with_two_standard_errors_and_what_is_not_resolved_is_not_passed(
    field: ViewField,
) -> None:
    upper = upper_position_bounds(field)
    assert (upper > field.position_bound).all()
    rough = np.full((len(field), 3), 10.0)
    assert (upper_position_bounds(changed(field, position_std_standard_error=rough)) > 19.0).all()
    limit = 1.01 * upper.max()
    sure = plan_path(field, 0, 8, limit=limit)
    middle = field.place == sure.places[1]
    bound = np.where(middle, np.inf, field.position_bound)
    around = plan_path(changed(field, position_bound=bound), 0, 8, limit=limit)
    assert sure.places[1] not in around.places
    assert around.length > sure.length


def test_places_that_see_nothing_are_passed_with_odometry_alone(field: ViewField) -> None:
    blind = field.place == 4
    dark = changed(
        field,
        status=np.where(blind, OUTSIDE, field.status),
        rank=np.where(blind, 0, field.rank),
        information_camera=np.where(blind[:, None, None], 0.0, field.dataset["information_camera"].values),
        position_bound=np.where(blind, np.inf, field.position_bound),
    )
    alone = plan_path(dark, 0, 8, limit=10.0)
    together = plan_path(dark, 0, 8, limit=10.0, odometry=ODOMETRY)
    assert 4 not in alone.places
    assert together.places == (0, 4, 8)
    assert together.before[1] == together.after[1]
    assert together.length < alone.length


def test_solids_are_gone_round_and_their_corners_not_cut() -> None:
    open_, closed = small_field(**SMALL), small_field(**SMALL, inside=(4,))
    assert plan_path(open_, 0, 8, limit=10.0).places == (0, 4, 8)
    around = plan_path(closed, 0, 8, limit=10.0)
    assert around.length == pytest.approx(8.0)
    assert len(around.places) == 5
    with pytest.raises(PlanError, match=r"--from 4: no camera can be there.*open place has the number"):
        plan_path(closed, 4, 8, limit=10.0)


def test_a_wall_leaves_no_path_at_any_limit() -> None:
    plan = plan_path(small_field(**SMALL, inside=(3, 4, 5)), 0, 8, limit=10.0)
    assert (plan.found, plan.smallest_limit, plan.shortest) == (False, math.inf, math.inf)
    plan = plan_path(small_field(**SMALL, inside=(3, 4, 5)), 0, 8, limit=10.0, odometry=ODOMETRY)
    assert (plan.exit_code, plan.smallest_limit, plan.shortest) == (1, math.inf, math.inf)


def test_a_prior_at_the_start_is_what_the_walk_begins_with(field: ViewField) -> None:
    tight = 1e8 * np.eye(6)
    plan = plan_path(field, 0, 8, limit=1.0, odometry=ODOMETRY, start_prior=PosePrior(tight, "camera"))
    assert plan.after[0] < 2e-4
    assert_as_simulated(field, plan, tight)


def test_labels_that_are_left_out_are_said_and_bounded() -> None:
    field = small_field(**(SMALL | {"shape": (4, 4)}))
    smallest = plan_path(field, 0, 15, limit=1e-6, odometry=ODOMETRY, labels=1000).smallest_limit
    exact, few = (
        plan_path(field, 0, 15, limit=1.001 * smallest, odometry=ODOMETRY, labels=labels)
        for labels in (1000, 1)
    )
    assert exact.dropped == 0
    assert few.dropped > 0
    assert few.length_lower_limit <= exact.length < few.length
    assert_as_simulated(field, few)
    assert (few.exit_code, dataclasses.replace(few, places=()).exit_code) == (0, 3)


def test_it_does_not_depend_on_where_the_world_has_its_origin(field: ViewField) -> None:
    motion = se3.exp(np.array([3e4, -4e4, 2e4, 0.3, -0.2, 0.9]))
    there = changed(field, world_from_camera=motion @ field.poses)
    there = ViewField(there.dataset.assign_attrs(candidates='{"kind": "file"}'))
    for odometry in (None, TURNING):
        here = plan_path(field, 0, 8, limit=0.3, odometry=odometry, reach=3.0)
        far = plan_path(there, 0, 8, limit=0.3, odometry=odometry, reach=3.0)
        assert far.views == here.views
        np.testing.assert_allclose(far.after, here.after, rtol=1e-5)
        assert far.length == pytest.approx(here.length)


def test_points_stand_for_the_nearest_open_place() -> None:
    field = small_field(**SMALL, inside=(0,))
    assert plan_path(field, "-2.1:1.5:-2.2", "2:1:2.4", limit=10.0).start in (1, 3)
    assert plan_path(field, 1, "2:1:2.4", limit=10.0).goal == 8


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"start": "9"}, r"--from 9: there is no such place; the field has 9, from 0 to 8"),
        ({"start": "door"}, r"--from door: expected the number of a place, or a point x:y:z"),
        ({"goal": "1:2"}, r"--to 1:2: expected the number of a place, or a point"),
        ({"goal": "1:2:nan"}, r"--to 1:2:nan: expected"),
        ({"limit": -1.0}, r"the limit must be a positive length, not -1"),
        ({"limit": math.nan}, r"the limit must be"),
        ({"reach": 0.0}, r"the reach must be a positive length"),
        ({"labels": 0}, r"at least 1 label"),
        ({"start_prior": PosePrior(np.eye(6), "camera")}, r"a prior at the start counts with odometry only"),
    ],
)
def test_what_cannot_be_planned_is_refused_in_a_line(
    field: ViewField, changes: dict[str, object], words: str
) -> None:
    options = {"start": "0", "goal": "8", "limit": 1.0, **changes}
    with pytest.raises(PlanError, match=words):
        plan_path(field, options.pop("start"), options.pop("goal"), **options)


def test_a_start_that_sees_too_little_asks_for_a_prior(field: ViewField) -> None:
    rank = np.where(field.place == 0, 5, field.rank)
    blind = changed(field, rank=rank)
    with pytest.raises(PlanError, match="no view sees all directions: give a prior of the start"):
        plan_path(blind, 0, 8, limit=1.0, odometry=ODOMETRY)
    prior = PosePrior(np.eye(6), "camera")
    assert plan_path(blind, 0, 8, limit=9.0, odometry=ODOMETRY, start_prior=prior).found


def test_places_of_a_file_are_joined_within_a_reach() -> None:
    field = small_field(shape=(5, 1), headings=1)
    line = ViewField(field.dataset.assign_attrs(candidates='{"kind": "file"}'))
    assert [places_of(line).neighbours(place).tolist() for place in range(5)] == [
        [1],
        [0, 2],
        [1, 3],
        [2, 4],
        [3],
    ]
    assert places_of(line, reach=4.0).neighbours(0).tolist() == [1, 2]
    assert dataclasses.asdict(places_of(line))["neighbourhood"] == "places at most 3 scene units apart"
