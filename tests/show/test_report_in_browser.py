"""Pages as a browser shows them; skipped where there is no Chromium with its driver."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator
from pathlib import Path

import browser
import numpy as np
import pytest
import result_samples
import synthetic_field
from PIL import Image
from test_html_report import CORNERS, ORIGIN, data_of, made, outlook, value_at

from mitsuba_crb.errors import PrecisionWarning
from mitsuba_crb.measure.outlook import Outlook, Sight
from mitsuba_crb.measure.pose_table import PoseTable
from mitsuba_crb.show.report import write_bound_report, write_field_report, write_poses_report

pytest.importorskip("plotly")
if browser.programs() is None:
    pytest.skip("needs chromium and chromedriver", allow_module_level=True)

pytestmark = pytest.mark.slow  # drawn by software: seconds a page

WIDE, NARROW = (1280, 900), (390, 800)


@pytest.fixture(scope="module")
def window() -> Iterator[browser.Browser]:
    with browser.browsing() as opened:
        yield opened


@pytest.fixture(scope="module")
def bound_page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bound") / "page.html"
    document, pictures = made()
    write_bound_report(path, document, pictures, outlook(), ORIGIN)
    return path


@pytest.fixture(scope="module")
def poses_page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("poses") / "page.html"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PrecisionWarning)
        found = result_samples.bounds(np.random.default_rng(0))
    table = PoseTable.of([found["plain"], found["rank 4"], found["world"]], ["<b>first</b>", "2", "3"])
    world = outlook(500)
    image = np.random.default_rng(1).random((6, 8, 3)).astype(np.float32)
    sights = tuple(Sight(row.name, row.pose, CORNERS, image) for row in table.rows)
    seen = Outlook(
        world.points + table.rows[0].pose[:3, 3], world.colours, world.normals, world.words, sights
    )
    write_poses_report(path, table, seen, ORIGIN)
    return path


def shown(window: browser.Browser, selector: str) -> np.ndarray:
    """Pixels of an element, as they are on the screen."""
    script = """const e = document.querySelector(arguments[0]); e.scrollIntoView({block: "center"});
        const b = e.getBoundingClientRect(); return [b.left, b.top, b.right, b.bottom]"""
    left, top, right, bottom = (round(value) for value in window.run(script, selector))
    return np.asarray(Image.open(io.BytesIO(window.screenshot())).convert("RGB"))[top:bottom, left:right]


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [WIDE, NARROW])
def test_a_page_is_drawn_without_complaint(window, bound_page, scheme, size):
    window.size(*size)
    window.scheme(scheme)
    window.open(bound_page)
    assert window.complaints() == []
    back = window.run("return getComputedStyle(document.body).backgroundColor")
    assert (int(re.findall(r"\d+", back)[0]) < 128) == (scheme == "dark")
    assert window.run("return document.documentElement.scrollWidth") <= size[0]
    pixels = shown(window, "#space canvas").reshape(-1, 3)
    assert len(np.unique(pixels, axis=0)) > 100


def test_what_is_under_the_pointer_is_the_data_s(window, bound_page):
    window.size(*WIDE)
    window.open(bound_page)
    layers = data_of(bound_page.read_text(encoding="utf-8"))["images"]["view"]
    script = """const select = document.querySelector(".viewer select"); select.value = arguments[0];
        select.dispatchEvent(new Event("change"));
        const e = document.querySelector(".picture"); e.scrollIntoView({block: "center"});
        const b = e.getBoundingClientRect(); return [b.left, b.top, b.width, b.height]"""
    for index in (1, 4, len(layers) - 2):
        grid = layers[index]["grid"]
        left, top, wide, high = window.run(script, str(index))
        for column, row in ((3, 5), (grid["width"] - 1, grid["height"] - 1), (11, 2)):
            window.point(
                left + (column + 0.5) / grid["width"] * wide, top + (row + 0.5) / grid["height"] * high
            )
            said = window.run("return document.querySelector('.readout').textContent")
            assert said.startswith(f"{layers[index]['name']} at pixel ({column}, {row}): ")
            if "not above the noise" in said:
                continue
            number = float(said.rpartition(": ")[2].partition(" [")[0].replace("−", "-"))
            assert number == pytest.approx(value_at(grid, column, row), rel=1e-3)


def test_keys_do_what_the_mouse_does(window, bound_page):
    window.size(*WIDE)
    window.open(bound_page)
    window.run("document.querySelector('.picture').focus()")
    right, down, page_down = "\ue014", "\ue015", "\ue00f"
    window.press(page_down, right, down, down)
    said = window.run("return document.querySelector('.readout').textContent")
    layers = data_of(bound_page.read_text(encoding="utf-8"))["images"]["view"]
    grid = layers[1]["grid"]
    middle = grid["width"] // 2, grid["height"] // 2
    assert said.startswith(f"{layers[1]['name']} at pixel ({middle[0] + 1}, {middle[1] + 2})")
    eye = "const c = document.getElementById('space')._fullLayout.scene.camera.eye; return [c.x, c.y, c.z]"
    window.run("document.getElementById('space').focus()")
    before = window.run(eye)
    window.press(right)
    turned = window.run(eye)
    assert not np.allclose(before, turned)
    assert np.linalg.norm(before) == pytest.approx(np.linalg.norm(turned), rel=0.1)
    window.press("+")
    assert np.linalg.norm(window.run(eye)) < np.linalg.norm(turned)
    assert window.complaints() == []


def test_ellipsoids_grow_by_the_factor_that_is_said(window, bound_page):
    window.size(*WIDE)
    window.open(bound_page)
    space = data_of(bound_page.read_text(encoding="utf-8"))["space"]
    trace = space["scaled"][0]["trace"]
    width = (
        f"const x = document.getElementById('space').data[{trace}].x; return Math.max(...x) - Math.min(...x)"
    )
    script = """const s = document.getElementById("factor"); s.value = arguments[0];
        s.dispatchEvent(new Event("input")); return document.getElementById("factor-said").textContent"""
    one = space["factors"].index(1.0)
    assert window.run(script, str(one)) == "as large as they are"
    small = window.run(width)
    said = window.run(script, str(one + 2))
    assert said == f"{space['factors'][one + 2]:g} times as large as they are"
    assert window.run(width) == pytest.approx(space["factors"][one + 2] * small, rel=1e-2)


def test_the_theme_can_be_chosen(window, bound_page):
    window.size(*WIDE)
    window.scheme("light")
    window.open(bound_page)
    colour = "return getComputedStyle(document.body).backgroundColor"
    light = window.run(colour)
    window.run("document.getElementById('theme').click(); document.getElementById('theme').click()")
    assert window.run("return document.getElementById('theme').textContent") == "Theme: dark"
    assert window.run(colour) != light


def test_a_pose_of_the_table_is_shown_in_the_world(window, poses_page):
    window.size(*WIDE)
    window.open(poses_page)
    assert window.run("return document.querySelectorAll('#poses b').length") == 0
    count = "return document.getElementById('space').data.length"
    before = window.run(count)
    window.run("document.querySelector('[data-pose=\"1\"]').focus()")
    window.press("\ue007")
    assert window.run("return document.querySelector('[data-pose=\"1\"]').ariaPressed") == "true"
    assert window.run(count) == before + 1
    assert window.run("return document.querySelector('.viewer select').value") == "1"
    assert window.complaints() == []


def test_a_field_of_views_is_drawn_and_its_places_can_be_chosen(window, tmp_path):
    page = tmp_path / "field.html"
    field = synthetic_field.small_field(inside=(2,), to_do=(4,))
    write_field_report(page, field, outlook(500), None, ORIGIN)
    for size in (WIDE, NARROW):
        window.size(*size)
        window.open(page)
        assert window.complaints() == []
        assert window.run("return document.documentElement.scrollWidth") <= size[0]
        for selector in ("#space canvas", '[data-chart="position"] svg'):
            assert len(np.unique(shown(window, selector).reshape(-1, 3), axis=0)) > 20
    drawn = """const e = document.querySelector('[data-chart="position"]');
        return e.calcdata[0][0].trace.customdata.map(row => Array.from(row))"""
    numbers = np.array(window.run(drawn), dtype=np.float64)
    best = [np.nanmin(field.position_bound[field.place == k]) for k in range(12) if k != 2]
    assert sorted(numbers[np.isfinite(numbers)]) == sorted(best)
    count = "return document.getElementById('space').data.length"
    before = window.run(count)
    window.run("document.querySelector('[data-pose=\"1\"]').click()")
    assert window.run(count) == before + 1
    assert window.complaints() == []
