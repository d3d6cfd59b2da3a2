"""Pages of results: what they say, that no name is markup, and what their numbers are."""

from __future__ import annotations

import base64
import json
import re
import warnings
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import synthetic_view

from mitsuba_crb.bound.cramer_rao import cramer_rao_bound
from mitsuba_crb.errors import OutputError, PrecisionWarning
from mitsuba_crb.export.documents import bound_document
from mitsuba_crb.information.image_information import fisher_information
from mitsuba_crb.measure.outlook import Outlook, Sight
from mitsuba_crb.measure.pictures import Pictures, pictures_of
from mitsuba_crb.noise import Gaussian
from mitsuba_crb.show.report import Origin, write_bound_report
from mitsuba_crb.show.report.ellipsoids import LEVELS, Ellipsoid
from mitsuba_crb.show.report.layers import GRID, column_layer, map_layer, picture_layers
from mitsuba_crb.show.report.markup import Markup, tag
from mitsuba_crb.show.report.space import frustum, space

pytest.importorskip("plotly")

EVIL = "<script>alert(1)<!--.xml"
ORIGIN = Origin("mitsuba-crb bound '<b>a</b>.xml' --report page.html", {"mitsuba": "3.9.1"})
CORNERS = np.array([[0.5, 0.4, 1.0], [-0.5, 0.4, 1.0], [-0.5, -0.4, 1.0], [0.5, -0.4, 1.0]])


def outlook(count: int = 2000) -> Outlook:
    rng = np.random.default_rng(0)
    points, normals = rng.normal(size=(count, 3)), rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    sight = Sight("camera", np.eye(4), CORNERS)
    return Outlook(points, rng.random((count, 3)), normals, f"{count} of 1000000 splats, as points", (sight,))


def made(unseen: tuple[int, ...] = (), name: str = EVIL) -> tuple[dict, Pictures]:
    """A bound's document and pictures, of a synthetic view."""
    view = synthetic_view.jacobian(40, 30, unseen=unseen)
    information = fisher_information(view, Gaussian(0.01))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PrecisionWarning)
        bound = synthetic_view.bound(view) if not unseen else cramer_rao_bound(information)
    provenance = {**synthetic_view.bound(synthetic_view.jacobian(40, 30)).provenance, "scene": name}
    bound.provenance.update(provenance)
    return bound_document(bound), pictures_of(view, information)


def page_of(tmp_path: Path, **options: object) -> str:
    document, pictures = made(**options)  # type: ignore[arg-type]
    write_bound_report(tmp_path / "page.html", document, pictures, outlook(), ORIGIN)
    return (tmp_path / "page.html").read_text(encoding="utf-8")


class _Elements(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []

    def handle_starttag(self, name: str, attributes: list[tuple[str, str | None]]) -> None:
        self.found.append((name, dict(attributes)))


def data_of(text: str) -> dict:
    found = re.search(r'<script type="application/json" id="report-data">(.*?)</script>', text, re.S)
    assert found is not None
    return json.loads(found[1])


def value_at(grid: dict, column: int, row: int, channel: int = 0) -> float:
    """As `page.js` reads it."""
    codes = np.frombuffer(base64.b64decode(grid["codes"]), "<u2")
    code = int(codes[(row * grid["width"] + column) * len(grid["channels"]) + channel])
    assert code < 65534
    value = grid["low"] + code * grid["step"]
    return float(np.exp(value)) if grid["log"] else value


def test_texts_are_escaped_and_markup_is_not():
    assert tag("b", "<i>", Markup("<i></i>"), title='"<') == '<b title="&quot;&lt;">&lt;i&gt;<i></i></b>'
    assert tag("b", class_="a", hidden=True, id=None, data_k=0) == '<b class="a" hidden data-k="0"></b>'


def test_a_name_is_never_markup(tmp_path):
    text = page_of(tmp_path)
    assert "alert(1)" in text
    assert "<script>alert" not in text
    assert "<b>a</b>.xml" not in text
    elements = _Elements()
    elements.feed(text)
    assert sum(name == "script" for name, _ in elements.found) == 3


def test_a_page_needs_nothing_else(tmp_path):
    text = page_of(tmp_path)
    elements = _Elements()
    elements.feed(text)
    for name, attributes in elements.found:
        for key in ("src", "href"):
            address = attributes.get(key) or ""
            assert not address or address.startswith(("data:", "#")), (name, address)
    policy = next(a["content"] for _, a in elements.found if a.get("http-equiv") == "Content-Security-Policy")
    assert policy is not None
    assert "default-src 'none'" in policy
    assert len(text.encode()) < 15e6
    assert "of 1000000 splats" in text  # that the world is only a part of it is said


def test_the_table_says_what_is_unseen(tmp_path):
    seen, hidden = page_of(tmp_path), page_of(tmp_path, unseen=(2,))
    assert "All six directions are seen." in seen
    row = re.search(r"<tr><th scope=\"row\">position z</th>.*?</tr>", hidden)
    assert row is not None
    assert "∞" in row[0] or "&gt;" in row[0]
    assert 'class="verdict seen"' not in row[0]


@pytest.mark.parametrize("size", [(40, 30), (700, 500), (90, 600)])
def test_values_are_those_of_the_picture_to_half_a_step(size):
    width, height = size
    rng = np.random.default_rng(1)
    column = rng.normal(size=(height, width, 3))
    layer = column_layer(column, 1.0, name="c", unit="u", about="a")
    grid = layer["grid"]
    assert grid["width"] <= GRID[0]
    assert grid["height"] <= GRID[1]
    block = -(-width // grid["width"])
    luminance = column @ [0.2126, 0.7152, 0.0722]
    for x, y in ((0, 0), (grid["width"] - 1, grid["height"] - 1), (grid["width"] // 2, grid["height"] // 3)):
        part = luminance[y * block : (y + 1) * block, x * block : (x + 1) * block]
        assert abs(value_at(grid, x, y) - part.mean()) <= 0.51 * grid["step"]


def test_maps_keep_sums_over_decades_and_say_what_is_not_positive():
    values = 10.0 ** np.random.default_rng(2).uniform(-8, 3, (48, 64))
    values[3, 5], values[4, 6] = -1.0, np.nan
    grid = map_layer(values, name="m", unit="u", about="a", summed=True)["grid"]
    for y, x in ((0, 0), (20, 30), (47, 63)):
        assert value_at(grid, x, y) == pytest.approx(values[y, x], rel=5e-4)
    codes = np.frombuffer(base64.b64decode(grid["codes"]), "<u2").reshape(48, 64)
    assert (codes[3, 5], codes[4, 6]) == (65534, 65535)
    coarse = map_layer(np.ones((96, 128)), name="m", unit="u", about="a", summed=True)["grid"]
    assert value_at(coarse, 3, 3) == pytest.approx(4.0)


def test_all_columns_are_there_and_samples_where_there_are_paths():
    _, pictures = made()
    names = [layer["name"] for layer in picture_layers(pictures, unit="radiance", displayed=False)]
    assert names[0] == "Render"
    assert len([name for name in names if name.startswith("∂I/∂")]) == 6
    assert "Samples" not in names


def test_frusta_point_where_the_camera_looks():
    pose = np.eye(4)
    pose[:3, 3] = (1.0, 2.0, 3.0)
    lines = frustum(pose, CORNERS, 0.5)
    lines = lines[np.isfinite(lines[:, 0])]
    np.testing.assert_allclose(lines[0], pose[:3, 3])
    assert (lines[:, 2] >= 3.0).all()
    assert np.linalg.norm(lines[1:6] - pose[:3, 3], axis=1).max() == pytest.approx(0.5)


def drawn(semi_axes: list[float], verdicts: list[str]) -> dict:
    return space(outlook(), [Ellipsoid("camera", np.zeros(3), np.array(semi_axes), np.eye(3), verdicts)])


def names_of(view: dict) -> list[str]:
    return [trace.get("name", "") for trace in view["figure"]["data"]]


def test_ellipsoids_are_as_large_as_they_say():
    view = drawn([3e-3, 2e-3, 1e-3], ["seen"] * 3)
    assert [name for name in names_of(view) if "ellipsoid" in name] == ["1σ ellipsoid", "95 % ellipsoid"]
    for (_, level), part in zip(LEVELS, view["scaled"], strict=True):
        offsets = np.frombuffer(base64.b64decode(part["offsets"]), "<f4").reshape(-1, 3)
        np.testing.assert_allclose(
            np.abs(offsets).max(axis=0), level * np.array([3e-3, 2e-3, 1e-3]), rtol=2e-2
        )
    assert view["factor"] in view["factors"]
    assert 1.0 in view["factors"]


def test_what_is_not_seen_is_a_line_and_never_a_ball():
    view = drawn([np.inf, np.inf, 1e-3], ["unseen", "not resolved", "seen"])
    lines = {
        trace["name"]: trace["line"]["dash"]
        for trace in view["figure"]["data"]
        if "dash" in trace.get("line", {})
    }
    assert lines == {"unseen direction (open line)": "solid", "direction not resolved (dashed)": "dash"}
    assert not [name for name in names_of(view) if "ellipsoid" in name]
    nothing = drawn([np.inf] * 3, ["unseen"] * 3)
    assert not nothing["scaled"]
    assert "unseen" in nothing["alt"]


def test_a_disc_is_flat_along_what_is_not_seen():
    view = drawn([np.inf, 2e-3, 1e-3], ["unseen", "seen", "seen"])
    offsets = np.frombuffer(base64.b64decode(view["scaled"][0]["offsets"]), "<f4").reshape(-1, 3)
    assert np.abs(offsets[:, 0]).max() == 0.0
    assert np.abs(offsets[:, 1]).max() == pytest.approx(2e-3, rel=2e-2)


def test_without_plotly_the_extra_is_named(monkeypatch, tmp_path):
    def missing(name: str) -> object:
        raise ImportError(name)

    monkeypatch.setattr("importlib.import_module", missing)
    document, pictures = made()
    with pytest.raises(OutputError, match=r"pip install 'mitsuba_crb\[report\]'"):
        write_bound_report(tmp_path / "page.html", document, pictures, outlook(), ORIGIN)
    assert not list(tmp_path.iterdir())
