"""Maps of a field of views: every position has its number or says why not; a stranger can read the page."""

from __future__ import annotations

import itertools
import json
import shutil
from pathlib import Path

import matplotlib as mpl
import mitsuba as mi
import numpy as np
import pytest
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.figure import Figure
from small_scenes import T, camera, scene
from synthetic_field import small_field

from mitsuba_crb import se3
from mitsuba_crb.measure.opening import as_world, fingerprint
from mitsuba_crb.planning.floor_plan import floor_plan
from mitsuba_crb.planning.plan_values import (
    INSIDE_SOLID,
    NOT_RESOLVED,
    NOTHING,
    SHOWN,
    TO_DO,
    UNSEEN,
    grouped,
    lattice,
    plan_values,
)
from mitsuba_crb.planning.plan_view import PlanView
from mitsuba_crb.planning.view_field import ViewField
from mitsuba_crb.planning.world_at_hand import world_at_hand
from mitsuba_crb.render.fit import Wanted
from mitsuba_crb.render.scene import SceneFile
from mitsuba_crb.show import field_page as page

HEADINGS = 4
INSIDE, BLOCKED, MISSING = 5, 7, 9
"""Places of the small field of which there is no number."""


@pytest.fixture(scope="module")
def field() -> ViewField:
    """4 x 3 places, up is y; one inside a solid, one that sees nothing, one half measured."""
    blocked = range(HEADINGS * BLOCKED, HEADINGS * (BLOCKED + 1))
    to_do = range(HEADINGS * MISSING, HEADINGS * (MISSING + 1))
    return small_field(headings=HEADINGS, inside=[INSIDE], blocked=blocked, to_do=to_do)


@pytest.fixture(scope="module")
def blind(field: ViewField) -> ViewField:
    """The same; of the first view of place 0 a direction is unseen, of place 1 one is not resolved."""
    changed = field.dataset.copy(deep=True)
    for view, verdict in ((0, 1), (HEADINGS, 2)):
        changed["position_bound"][view] = np.inf
        changed["position_verdict"][view, 0] = verdict
    return ViewField(changed)


def words(figure: Figure) -> str:
    return "\n".join(text.get_text() for text in figure.findobj(mpl.text.Text))


def test_the_best_and_the_worst_of_each_position(field: ViewField) -> None:
    for quantity, numbers in (("position", field.position_bound), ("rotation", field.rotation_bound_deg)):
        best, worst = plan_values(field, quantity), plan_values(field, quantity, worst=True)
        plan = PlanView.of(field.up)
        flat = plan.flat(field.poses[:, :3, 3])
        for k in np.flatnonzero(best.kind == SHOWN):
            here = np.flatnonzero(np.linalg.norm(flat - best.positions[k], axis=1) < 1e-6)
            assert len(here) == HEADINGS
            assert best.values[k] == numbers[here].min() == numbers[best.view[k]]
            if worst.kind[k] == SHOWN:
                assert worst.values[k] == numbers[here].max()
            else:
                assert np.isinf(numbers[here]).any()
    ranks = plan_values(field, "rank"), plan_values(field, "rank", worst=True)
    assert np.all(ranks[0].values[ranks[0].kind == SHOWN] >= ranks[1].values[ranks[1].kind == SHOWN])


def test_what_has_no_number_says_why(field: ViewField, blind: ViewField) -> None:
    shown = plan_values(field, "position")
    assert np.bincount(shown.kind, minlength=6).tolist()[INSIDE_SOLID] == 1
    for place, kind in ((INSIDE, INSIDE_SOLID), (BLOCKED, NOTHING), (MISSING, TO_DO)):
        index = _index(field, place)
        assert shown.kind[index] == kind
        assert np.isnan(shown.values[index])
        assert shown.view[index] == -1
    for place, kind in ((0, UNSEEN), (1, NOT_RESOLVED)):
        index = _index(blind, place)
        worst, best = (plan_values(blind, "position", worst=w) for w in (True, False))
        assert worst.kind[index] == kind
        assert best.kind[index] == SHOWN
        assert plan_values(blind, "rotation", worst=True).kind[index] == SHOWN


def _index(field: ViewField, place: int) -> int:
    """Of a place among the positions of the map."""
    plan = PlanView.of(field.up)
    positions = plan_values(field, "rank").positions
    return int(
        np.argmin(np.linalg.norm(positions - plan.flat(field.poses[[HEADINGS * place], :3, 3]), axis=1))
    )


def test_a_grid_is_known_by_its_places_and_a_path_is_none(field: ViewField) -> None:
    positions, group = grouped(PlanView.of(field.up).flat(field.poses[:, :3, 3]))
    assert len(positions) == 12
    np.testing.assert_array_equal(np.bincount(group), HEADINGS)
    np.testing.assert_allclose(lattice(positions), [2.0, 2.0], rtol=1e-5)
    np.testing.assert_allclose(lattice(positions[[0, 1, 3, 5, 6, 8, 10, 11]]), [2.0, 2.0], rtol=1e-5)
    row = np.stack([np.arange(5.0), np.zeros(5)], axis=1)
    np.testing.assert_allclose(lattice(row), [1.0, 1.0], rtol=1e-5)
    assert lattice(np.random.default_rng(0).uniform(size=(12, 2))) is None
    turn = 2 * np.pi * np.arange(12) / 12
    assert lattice(np.stack([np.cos(turn), np.sin(turn)], axis=1)) is None


@pytest.mark.parametrize("up", [[0, 0, 1], [0, 0, -1], [0, 1, 0], [0, -1, 0], [1, 0, 0], [0.1, -0.9, 0.3]])
def test_the_plan_is_seen_from_above(up: list[float]) -> None:
    """Right, up the page and towards the eye are right-handed; points come back."""
    direction = np.array(up) / np.linalg.norm(up)
    plan = PlanView.of(direction)
    right, away = (plan.axes[axis] for axis in plan.level)
    page_up = -away if plan.mirrored(direction) else away
    np.testing.assert_allclose(np.cross(right, page_up), direction, atol=1e-12)
    points = np.random.default_rng(0).normal(size=(5, 3))
    np.testing.assert_allclose(plan.points(plan.flat(points), plan.height(points)), points, atol=1e-12)


def test_outlines_are_where_the_walls_are() -> None:
    """A room of 4 x 6 and a ball of radius 0.5, cut at the ball's middle and below it."""
    room = mi.load_dict(
        scene(
            sensor=camera(origin=(0, 1, -2)),
            walls={"type": "cube", "to_world": T().translate([0, 1.5, 0]).scale([2, 1.5, 3])},
            ball={"type": "sphere", "center": [0.5, 1.0, 1.0], "radius": 0.5},
        )
    )
    found = floor_plan(room, np.array([0.0, 1.0, 0.0]), np.array([-3.0, -4.0]), np.array([3.0, 4.0]), 1.0)
    assert found is not None
    assert found.heights == (1.0, pytest.approx(0.25))
    pieces = found.pieces[0]
    middle = pieces.mean(axis=1)
    to_ball = np.linalg.norm(middle - [0.5, 1.0], axis=1)
    of_ball = to_ball < 1.0
    np.testing.assert_allclose(to_ball[of_ball], 0.5, atol=1e-3)
    to_wall = np.minimum(np.abs(np.abs(middle[:, 0]) - 2), np.abs(np.abs(middle[:, 1]) - 3))
    np.testing.assert_allclose(to_wall[~of_ball], 0.0, atol=1e-3)
    # Together as long as the outlines, and a fifth longer, lest there be gaps.
    length = np.linalg.norm(pieces[:, 1] - pieces[:, 0], axis=1)
    assert length[of_ball].sum() == pytest.approx(1.2 * np.pi, rel=0.1)
    assert length[~of_ball].sum() == pytest.approx(1.2 * 20.0, rel=0.05)
    # At the other height there is no ball.
    other = found.pieces[1].mean(axis=1)
    assert np.linalg.norm(other - [0.5, 1.0], axis=1).min() > 0.9


def test_the_page_says_what_it_shows(field: ViewField) -> None:
    figure = page.field_figure(field)
    text = words(figure)
    for word in (
        "synthetic",
        "48 views, 12 places",
        "y = 1.5",
        "not measured yet",
        "Position, best direction",
        "Rotation, worst direction",
        "Rank, best direction",
        "inside a solid",
        "nothing to see",
        "best direction to look",
        "[deg]",
        "[scene unit]",
    ):
        assert word in text
    assert "unseen" not in text
    maps = figure.axes[:6]
    assert maps[0].yaxis_inverted()  # y is up and x points right: z points towards the reader
    panels = [(quantity, worst) for worst in (False, True) for quantity in ("position", "rotation", "rank")]
    for ax, (quantity, worst) in zip(maps, panels, strict=True):
        shown = plan_values(field, quantity, worst=worst)
        cells = [c for c in ax.collections if isinstance(c, PatchCollection)]
        assert sum(len(c.get_paths()) for c in cells) == 12
        coloured = [c for c in cells if c.get_array() is not None]
        assert sum(len(c.get_paths()) for c in coloured) == int((shown.kind == SHOWN).sum())


def overlaps(figure: Figure) -> list[tuple[str, str]]:
    """Texts of a figure that touch one another."""
    figure.draw_without_rendering()
    shown = [t for t in figure.texts if t.get_text()]
    shown += [t for legend in figure.legends for t in legend.get_texts()]
    for ax in figure.axes:
        shown += [ax.title, ax._left_title, ax.xaxis.label, ax.yaxis.label, *ax.texts]
    for bar in figure.axes[6 if len(figure.axes) > 2 else 1 :]:
        shown += bar.get_xticklabels()
    boxes = [(t.get_text(), t.get_window_extent()) for t in shown if t.get_visible() and t.get_text()]
    return [(a, b) for (a, p), (b, q) in itertools.combinations(boxes, 2) if p.overlaps(q)]


@pytest.mark.slow
def test_no_labels_touch(field: ViewField) -> None:
    assert not overlaps(page.field_figure(field))
    assert not overlaps(page.next_views_figure(field, [0, 17, 30], have=[12]))
    assert not overlaps(page.paths_figure(field, {"short": [0, 4, 8], "long": [0, 12, 24, 8]}))


def test_an_arrow_points_where_the_best_view_looks(field: ViewField) -> None:
    (arrows,) = [c for c in page.field_figure(field).axes[0].collections if isinstance(c, mpl.quiver.Quiver)]
    shown = plan_values(field, "position")
    which = np.flatnonzero(shown.view >= 0)
    looks = field.poses[shown.view[which], :3, 2][:, [0, 2]]
    drawn = np.stack([arrows.U, arrows.V], axis=1)
    np.testing.assert_allclose(drawn / np.linalg.norm(drawn, axis=1, keepdims=True), looks, atol=1e-9)


def test_next_views_are_numbered_in_their_order(field: ViewField) -> None:
    figure = page.next_views_figure(field, [30, 2, 17], have=[12])
    texts = {t.get_text(): t.get_position() for t in figure.axes[0].texts}
    assert set(texts) == {"1", "2", "3"}
    for number, view in (("1", 30), ("2", 2), ("3", 17)):
        offset = np.array(texts[number]) - field.poses[view, :3, 3][[0, 2]]
        look = field.poses[view, :3, 2][[0, 2]]
        assert offset @ look / np.linalg.norm(offset) == pytest.approx(1.0, abs=1e-6)
    assert "views at hand" in words(figure)


def test_paths_go_from_view_to_view(field: ViewField) -> None:
    paths = {"shortest": [0, 4, 8], "within 0.1": [0, 12, 24, 8]}
    figure = page.paths_figure(field, paths)
    lines = {line.get_label(): line for line in figure.axes[0].lines}
    for label, views in paths.items():
        np.testing.assert_allclose(
            np.array(lines[label].get_xydata()), field.poses[views][:, :3, 3][:, [0, 2]], atol=1e-12
        )
        assert label in words(figure)
    assert any(isinstance(c, LineCollection) for c in figure.axes[0].collections)


def ring() -> ViewField:
    """Places on a ring, as of `around:`."""
    field = small_field(shape=(4, 3), headings=1)
    poses = field.poses.copy()
    for k in range(len(poses)):
        poses[k] = se3.exp([0, 0, 0, 0, 0.5 * k, 0]) @ se3.exp([0, 1.0, -2.0, 0, 0, 0])
    dataset = field.dataset.assign(world_from_camera=(("view", "row", "column"), poses))
    return ViewField(dataset)


@pytest.mark.slow
def test_other_fields_can_be_drawn(blind: ViewField, tmp_path: Path) -> None:
    around = ring()
    assert "a direction is unseen" in words(page.field_figure(blind))
    page.write_field_page(tmp_path / "ring.png", around)
    page.write_next_views_page(tmp_path / "one.png", ViewField(around.dataset.isel(view=[0])), [0])
    page.write_paths_page(tmp_path / "path.png", around, {"there": [0], "nowhere": []})
    for name in ("ring", "one", "path"):
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(("low", "high"), [(0.9, 1.2), (1e-3, 1e-2), (3.1e-5, 0.4), (2.0, 2.6), (1e-9, 1e9)])
def test_colour_bars_have_few_round_ticks(low: float, high: float) -> None:
    ticks = page.round_ticks(low, high)
    assert 1 <= len(ticks) <= 7
    assert all(low <= tick <= high for tick in ticks)


def test_outlines_are_of_the_world_that_was_measured_and_of_no_other(tmp_path: Path, scenes: Path) -> None:
    folder = tmp_path / "room"
    shutil.copytree(scenes / "boxes", folder)
    file = folder / "boxes.xml"
    loaded, _ = as_world(SceneFile(file), Wanted(0, (32, 24)))
    settings = {"scene": str(file), "scene_contents": fingerprint(loaded, str(file), {}), "size": [32, 24]}
    dataset = small_field(shape=(2, 2), headings=1).dataset
    field = ViewField(dataset.assign_attrs(settings=json.dumps(settings)))
    assert world_at_hand(field) is not None
    found = page.outlines_of(field)
    assert found is not None
    file.write_text(file.read_text().replace("</scene>", '<shape type="sphere"/></scene>'))
    assert world_at_hand(field) is None
    file.write_text("no scene")
    assert world_at_hand(field) is None
    file.unlink()
    assert page.outlines_of(field) is None


def test_outlines_of_a_demo_are_found_from_any_folder() -> None:
    loaded, label = as_world("demo:boxes", Wanted(0, (32, 24)))
    settings = {"scene": label, "scene_contents": fingerprint(loaded, label, {}), "size": [32, 24]}
    dataset = small_field(shape=(2, 2), headings=1).dataset
    assert world_at_hand(ViewField(dataset.assign_attrs(settings=json.dumps(settings)))) is not None
    settings["scene"] = "demo:of_another_version"
    assert world_at_hand(ViewField(dataset.assign_attrs(settings=json.dumps(settings)))) is None
