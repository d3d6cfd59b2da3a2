"""The page of a field of views: its numbers are the store's, and of very many places not all are drawn."""

from __future__ import annotations

import base64
import json
import re

import numpy as np
import pytest
import synthetic_field
from test_html_report import EVIL, ORIGIN, data_of, outlook

from mitsuba_crb.planning.field_outlook import field_outlook
from mitsuba_crb.planning.marks import marks_of
from mitsuba_crb.planning.plan_values import INSIDE_SOLID, NOTHING, SHOWN, TO_DO, UNSEEN, WORDS
from mitsuba_crb.planning.view_field import ViewField
from mitsuba_crb.show.report import write_field_report
from mitsuba_crb.show.report.field import field_page
from mitsuba_crb.show.report.field_maps import field_maps

pytest.importorskip("plotly")

HEADINGS = 4
INSIDE_PLACE, BLOCKED_PLACE, TO_DO_PLACE = 2, 4, 6


@pytest.fixture(scope="module")
def field() -> ViewField:
    def of(place: int) -> range:
        return range(HEADINGS * place, HEADINGS * (place + 1))

    made = synthetic_field.small_dataset(
        inside=(INSIDE_PLACE,), blocked=of(BLOCKED_PLACE), to_do=of(TO_DO_PLACE), headings=HEADINGS
    )
    for view in of(0):  # a place of which no direction knows the position
        made["position_bound"][view] = np.inf
        made["position_verdict"][view] = [1, 0, 0]
        made["rank"][view] = 5
    return ViewField(made.assign_attrs(settings=json.dumps({"scene": f"scenes/{EVIL}"})))


def many(count: int) -> ViewField:
    """As many places on a line, two views at each, of bounds that fall along it."""
    one = synthetic_field.small_dataset(shape=(1, 1), headings=1).isel(view=[0] * (2 * count))
    data = one.assign_attrs(candidates=json.dumps({"kind": "file"})).copy(deep=True)
    place = np.repeat(np.arange(count), 2)
    data["place"][:], data["heading"][:] = place, np.tile([0, 1], count)
    data["world_from_camera"].values[:, 0, 3] = 0.1 * place
    data["world_from_camera"].values[:, 2, 3] = 0.013 * (place % 7)
    data["position_bound"][:] = 1.0 / (1.0 + place) + np.tile([0.0, 1.0], count)
    return ViewField(data)


def traces(page) -> dict[str, dict]:
    return {trace["name"]: trace for trace in page.data["space"]["figure"]["data"] if "customdata" in trace}


def unpacked(values) -> np.ndarray:
    """An array of plotly's, packed or not."""
    if isinstance(values, list):
        return np.array(values, dtype=np.float64)
    found = np.frombuffer(base64.b64decode(values["bdata"]), values["dtype"]).astype(np.float64)
    shape = [int(n) for n in str(values.get("shape", len(found))).split(",")]
    return found.reshape(shape)


@pytest.mark.slow
def test_a_mark_says_what_the_store_says_of_its_best_view(field):
    page = field_page(field, outlook(), None)
    shown = traces(page)["places"]
    sights = page.data["space"]["sights"]
    places = set()
    for (sight,), text in zip(shown["customdata"], shown["text"], strict=True):
        place, best = (int(n) for n in re.search(r"place (\d+) .*best: view (\d+)", text).groups())
        here = np.flatnonzero(field.place == place)
        assert best == here[np.argmin(field.position_bound[here])]
        assert sights[sight]["name"] == f"view {best}"
        np.testing.assert_array_equal(sights[sight]["pose"], field.poses[best])
        position = float(re.search(r"position (\S+) scene", text)[1].replace("−", "-"))
        rotation = float(re.search(r"rotation (\S+)°", text)[1].replace("−", "-"))
        assert position == pytest.approx(field.position_bound[best], rel=1e-5)
        assert rotation == pytest.approx(field.rotation_bound_deg[best], rel=1e-5)
        places.add(place)
    assert places == set(range(12)) - {0, INSIDE_PLACE, BLOCKED_PLACE, TO_DO_PLACE}
    np.testing.assert_allclose(
        10.0 ** unpacked(shown["marker"]["color"]), marks_of(field).best.values[: len(places)]
    )


def test_what_has_no_number_is_marked_as_what_it_is_and_has_no_colour_of_the_scale(field):
    found = traces(field_page(field, outlook(), None))
    kinds = {UNSEEN: 0, INSIDE_SOLID: INSIDE_PLACE, NOTHING: BLOCKED_PLACE, TO_DO: TO_DO_PLACE}
    assert set(found) == {"places", *(WORDS[kind] for kind in kinds)}
    for kind, place in kinds.items():
        trace = found[WORDS[kind]]
        assert [text.split()[:2] for text in trace["text"]] == [["place", str(place)]]
        assert trace["text"][0].endswith(WORDS[kind])
        assert isinstance(trace["marker"]["color"], str)
    symbols = [found[WORDS[kind]]["marker"]["symbol"] for kind in kinds]
    assert len(set(symbols)) == len(symbols)


def test_under_the_pointer_of_a_map_is_the_store_s_number(field):
    charts = field_maps(field, None)
    for key, values in (
        ("position", field.position_bound),
        ("rotation", field.rotation_bound_deg),
        ("rank", -field.rank.astype(float)),
    ):
        (heat,) = (trace for trace in charts[key]["figure"]["data"] if trace["type"] == "heatmap")
        assert "%{customdata" in heat["hovertemplate"]
        x, y, numbers = (unpacked(heat[name]) for name in ("x", "y", "customdata"))
        for row, column in np.ndindex(numbers.shape):
            near = np.abs(field.poses[:, [0, 2], 3] - [x[column], y[row]]).max(axis=1) < 1e-6
            here = np.flatnonzero(near & field.usable & np.isfinite(values))
            if len(here):
                assert numbers[row, column] == abs(values[here].min())
            else:
                assert np.isnan(numbers[row, column])
    words = [trace.get("name") for trace in charts["position"]["figure"]["data"]]
    assert WORDS[UNSEEN] in words
    assert WORDS[UNSEEN] not in [trace.get("name") for trace in charts["rotation"]["figure"]["data"]]


def test_the_page_has_the_table_of_the_terminal_and_names_are_never_markup(field, tmp_path):
    path = tmp_path / "page.html"
    write_field_report(path, field, outlook(), None, ORIGIN)
    text = path.read_text(encoding="utf-8")
    for words in (
        "measured 36 (82%)",
        "inside 4 (9%)",
        "blocked 4 (9%)",
        "5 at 4",
        "median",
        "44 of 48 views are done; the same command goes on from there",
    ):
        assert words in text, words
    assert "<script>alert" not in text
    assert "<b>a</b>.xml" not in text
    assert json.dumps(data_of(text))


def test_of_very_many_places_the_best_of_those_that_are_near_is_drawn_and_that_is_said(tmp_path):
    few, lots = marks_of(many(300), most=1000), marks_of(many(300), most=40)
    assert (few.side, len(few.views)) == (0.0, 300)
    assert lots.side > 0.0
    assert 20 <= len(lots.views) <= 40
    assert lots.count.sum() == 600
    assert (lots.best.kind == SHOWN).all()
    assert lots.best.values[0] == 1.0 / 300
    assert (np.diff(lots.best.values) >= 0.0).all()
    own = lots.best.positions
    for view, position, value in zip(lots.views, own, lots.best.values, strict=True):
        assert (many(300).poses[view, :3, 3] == position).all()
        assert many(300).position_bound[view] == value


@pytest.mark.slow
def test_the_page_of_many_thousand_views_stays_small(tmp_path):
    path = tmp_path / "page.html"
    write_field_report(path, many(9000), outlook(36_000), None, ORIGIN)
    text = path.read_text(encoding="utf-8")
    assert len(text.encode()) < 15e6
    assert re.search(
        r"\d+ of 9000 places, .*: of those in one cube of \S+ scene units the best is drawn", text
    )


def test_without_its_world_a_field_is_drawn_and_that_is_said(field):
    seen = field_outlook(field, None)
    assert not len(seen.points)
    page = field_page(field, seen, None)
    assert "not at hand" in page.data["space"]["words"]
    assert len(page.data["space"]["sights"]) == 12
