"""Next views: by exhaustive search and by fusion, wherever the origin is, and never what cannot be used."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from synthetic_field import BLOCKED, heading_pose, room_points, small_dataset, small_field

from mitsuba_crb import se3
from mitsuba_crb.agents.fusion import Agent, fuse
from mitsuba_crb.bound.cramer_rao import cramer_rao_bound
from mitsuba_crb.bound.prior import PosePrior
from mitsuba_crb.errors import PlanError
from mitsuba_crb.information.significance import identified
from mitsuba_crb.planning.next_view import next_views, stored_views
from mitsuba_crb.planning.odometry import Odometry
from mitsuba_crb.planning.one_body import body_at, information_about, seen_blocks
from mitsuba_crb.planning.path_search import plan_path
from mitsuba_crb.planning.view_field import ViewField

OBJECTIVES = ("logdet", "trace", "lambda_min")
SMALL = {"shape": (3, 2), "headings": 3, "seed": 2}


@pytest.fixture(scope="module")
def field() -> ViewField:
    return small_field(**SMALL)


def moved(field: ViewField, motion: np.ndarray) -> ViewField:
    """The same field in a world that has been moved."""
    return ViewField(
        field.dataset.assign(world_from_camera=(("view", "row", "column"), motion @ field.poses))
    )


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_no_choice_beats_the_upper_bound_and_the_certificate_holds(field: ViewField, objective: str) -> None:
    found = next_views(field, budget=3, objective=objective, have=(0,))
    body, scale = found.body, np.array([found.length_scale] * 3 + [1.0] * 3)
    blocks = scale[:, None] * seen_blocks(field, np.arange(len(field)), body) * scale
    sums = (
        np.eye(6)
        + blocks[0]
        + np.array(
            [blocks[list(some)].sum(axis=0) for some in itertools.combinations(range(1, len(field)), 3)]
        )
    )
    eigenvalues = np.linalg.eigvalsh(sums)
    values = {
        "logdet": np.log(eigenvalues).sum(axis=1),
        "trace": eigenvalues.sum(axis=1),
        "lambda_min": eigenvalues[:, 0],
    }[objective]
    best = values.max()
    assert found.value <= best * (1 + 1e-12) <= found.upper_bound * (1 + 1e-9)
    assert found.value - found.value_empty >= found.certificate * (best - found.value_empty) * (1 - 1e-9)
    assert found.value > np.median(values)
    if objective != "lambda_min":
        assert found.value - found.value_empty >= 0.95 * (best - found.value_empty)


def test_the_first_view_has_its_own_bound_and_more_views_never_a_larger_one(field: ViewField) -> None:
    found = next_views(field, budget=5)
    assert np.isinf(found.position_bound[0])
    assert found.position_bound[1] == pytest.approx(field.position_bound[found.chosen[0]], rel=1e-9)
    assert found.rotation_bound_deg[1] == pytest.approx(field.rotation_bound_deg[found.chosen[0]], rel=1e-9)
    assert (np.diff(found.rotation_bound_deg) < 0.0).all()
    assert found.rank == (0, 6, 6, 6, 6, 6)


def test_the_bound_is_that_of_agents_fused_on_one_body(field: ViewField) -> None:
    found = next_views(field, budget=2, have=(4,))
    views = [*found.have, *found.chosen]
    body = body_at(field.poses[views, :3, 3].mean(axis=0))
    agents = [
        Agent(
            str(view),
            information_about(field, view, field.poses[view]),
            se3.inverse(body) @ field.poses[view],
        )
        for view in views
    ]
    fused = fuse(agents).bound
    assert found.position_bound[-1] == pytest.approx(np.linalg.norm(fused.position_std), rel=1e-9)
    assert found.rotation_bound_deg[-1] == pytest.approx(np.linalg.norm(fused.rotation_std_deg), rel=1e-9)
    assert found.position_bound_standard_error[-1] > 0.0


@pytest.mark.slow
@pytest.mark.parametrize("objective", OBJECTIVES)
def test_the_choice_does_not_depend_on_where_the_world_has_its_origin(
    field: ViewField, objective: str
) -> None:
    motion = se3.exp(np.array([4e4, -3e4, 2e4, 0.3, -0.2, 0.9]))
    here = next_views(field, budget=4, objective=objective)
    there = next_views(moved(field, motion), budget=4, objective=objective)
    assert here.chosen == there.chosen
    np.testing.assert_allclose(here.position_bound[1:], there.position_bound[1:], rtol=1e-6)


def test_what_is_known_changes_the_choice() -> None:
    """With one wall seen from the front already, views of it again tell less than those of another."""
    field = small_field(**SMALL)
    alone, again = (
        next_views(field, budget=1),
        next_views(field, budget=1, have=next_views(field, budget=3).chosen),
    )
    assert alone.chosen != again.chosen
    tight = np.diag([0.0, 0.0, 0.0, 1e12, 1e12, 1e12])
    turned = next_views(field, budget=2, prior=PosePrior(tight, "camera"))
    assert turned.rank[0] == 3
    assert turned.position_bound[1] < alone.position_bound[1]
    assert turned.rotation_bound_deg[-1] < 1e-3


def test_what_cannot_be_used_is_never_chosen() -> None:
    plain = small_field(**SMALL)
    best = next_views(plain, budget=6).chosen
    inside = plain.place[best[0]]
    blocked, to_do = [view for view in best if plain.place[view] != inside][:2]
    field = small_field(**SMALL, inside=(inside,), blocked=(blocked,), to_do=(to_do,))
    usable = field.usable & (field.rank > 0)
    found = next_views(field, budget=int(usable.sum()))
    assert sorted(found.chosen) == np.flatnonzero(usable).tolist()
    assert found.certificate == pytest.approx(1.0)
    assert found.guarantee == 1.0
    assert field.status[blocked] == BLOCKED
    assert blocked not in found.chosen


def test_noise_that_is_not_information_is_not_counted() -> None:
    """A view of rank 3 whose unseen block is nothing but noise adds nothing there."""
    field = small_field(**SMALL)
    dataset = field.dataset.copy(deep=True)
    noise = np.zeros((6, 6))
    noise[:3, :3] = 1e3 * np.eye(3)
    dataset["information_camera"][0] = noise + 1e-2 * np.diag([0, 0, 0, 1.0, 2.0, 3.0])
    dataset["rank"][0] = 3
    dataset["length_scale"][0] = 1.0
    (block,) = seen_blocks(ViewField(dataset), np.array([0]), field.poses[0])
    np.testing.assert_allclose(block, noise, atol=1e-9)


def test_a_view_of_much_noise_does_not_hide_what_others_see() -> None:
    """One direction of it is seen, with so much noise about it that nothing else of the sum would be."""
    dataset = small_field(**SMALL).dataset.copy(deep=True)
    good, noisy = np.flatnonzero(dataset["rank"].values == 6)[:2]
    largest = np.abs(dataset["information_camera"].values[good]).max()
    dataset["information_camera"][noisy] = np.diag([1e4 * largest, 0.0, 0.0, 0.0, 0.0, 0.0])
    dataset["covariance_of_entries"][noisy] = (1e2 * largest) ** 2 * np.eye(21)
    dataset["length_scale"][noisy] = dataset["length_scale"].values[good]
    dataset["rank"][noisy] = 1
    field = ViewField(dataset)
    body = body_at(field.poses[[good, noisy], :3, 3].mean(axis=0))
    alone, other = (information_about(field, view, body) for view in (good, noisy))
    assert identified(alone + other).rank < 6
    found = next_views(field, have=(good, noisy), budget=1)
    assert found.rank[0] == 6
    # Without the noisy one: that of the good one at the same point.
    expected = np.linalg.norm(cramer_rao_bound(alone).position_std)
    assert found.position_bound[0] == pytest.approx(expected, rel=1e-9)


def test_poses_are_found_in_the_store_and_others_named_with_the_nearest(field: ViewField) -> None:
    rounded = field.poses[[7, 2]].round(4)
    assert stored_views(field, rounded) == (7, 2)
    away = heading_pose(field.poses[5, :3, 3] + [0.0, 0.2, 0.0], 2.0 * np.pi * 2 / 3)
    with pytest.raises(
        PlanError, match=r"no view at pose 0; the nearest is view 5, 0\.2 scene units and 0 deg"
    ):
        stored_views(field, away[None])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"budget": 0}, "at least 1, not 0"),
        ({"budget": 2.5}, "whole number of views"),
        ({"budget": 18}, "only 16 of 18 can be chosen"),
        ({"budget": 1, "objective": "log_det"}, "did you mean 'logdet'"),
        ({"budget": 1, "objective": "volume"}, "expected 'logdet', 'trace', 'lambda_min'"),
        ({"budget": 1, "have": (18,)}, "no view 18; the field has 18"),
        ({"budget": 1, "have": (4, 4)}, "view 4 is among those taken twice"),
        ({"budget": 1, "have": (3,)}, "view 3 is not measured yet"),
        ({"budget": 1, "ridge": 0.0}, "the ridge must be a positive number"),
    ],
)
def test_what_cannot_be_chosen_is_refused_in_a_line(options: dict[str, object], words: str) -> None:
    field = small_field(**SMALL, to_do=(3,), blocked=(6,))
    with pytest.raises(PlanError, match=words):
        next_views(field, **options)


def test_a_field_with_a_prior_in_its_ranks_is_refused(field: ViewField) -> None:
    known = ViewField(field.dataset.assign_attrs(settings='{"prior": "prior.toml"}'))
    with pytest.raises(PlanError, match="was measured with a prior, which would count again with every view"):
        next_views(known, budget=1)
    with pytest.raises(PlanError, match="was measured with a prior"):
        plan_path(known, 0, 1, limit=1.0, odometry=Odometry(0.1, 1.0))
    assert plan_path(known, 0, 1, limit=10.0).found  # of each view by itself, the prior's part is welcome


def test_a_field_that_sees_nothing_has_nothing_to_choose() -> None:
    with pytest.raises(PlanError, match="only 0 of 4 can be chosen"):
        next_views(
            ViewField(small_dataset(shape=(1, 1), points=room_points(np.random.default_rng(0))[:0])), budget=1
        )
