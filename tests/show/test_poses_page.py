"""The page of many poses: every pose has a mark, what is unseen is an open line and no ball."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.colors import LogNorm, to_hex
from matplotlib.figure import Figure
from rigs import made

from mitsuba_crb import se3
from mitsuba_crb.bound.cramer_rao import cramer_rao_bound
from mitsuba_crb.information.significance import no_information
from mitsuba_crb.measure.pose_table import PoseRow, PoseTable
from mitsuba_crb.show import poses_page as page


def row(index: int, matrix: np.ndarray) -> PoseRow:
    pose = se3.exp([0.5 * index, 0.0, 0.2 * index, 0, 0, 0])
    return PoseRow.of(str(index), cramer_rao_bound(made(matrix, pose=pose)))


def blind(index: int) -> PoseRow:
    pose = se3.exp([0.5 * index, 0.0, 0.2 * index, 0, 0, 0])
    return PoseRow.of(str(index), cramer_rao_bound(no_information(variable="camera", pose=pose)))


@pytest.fixture(scope="module")
def table() -> PoseTable:
    full = np.diag([4e6, 1e6, 2e6, 1e7, 1e7, 1e7])
    # No camera is turned; the fourth does not see the world's x.
    flat = np.diag([0.0, 1e6, 2e6, 1e7, 1e7, 1e7])
    rows = (row(0, full), row(1, 2 * full), row(2, full), row(3, flat), blind(4))
    return PoseTable(rows, tuple(range(5)), 6, {"scene": "room.xml"})


def words(figure: Any) -> str:
    return "\n".join(text.get_text() for text in figure.findobj(mpl.text.Text))


def test_the_page_says_what_it_shows(table: PoseTable) -> None:
    assert [one.rank for one in table.rows] == [6, 6, 6, 5, 0]
    text = words(page.poses_figure(table))
    for word in (
        "room.xml",
        "5 poses",
        "2 not of rank 6",
        "from above",
        "from the side",
        "3σ",
        "rank 0",
        "times as large",
    ):
        assert word in text


def test_up_is_the_cameras_own(table: PoseTable) -> None:
    above, side, *_ = page.poses_figure(table).axes
    assert (above.get_xlabel()[0], above.get_ylabel()[0]) == ("x", "z")
    assert (side.get_xlabel()[0], side.get_ylabel()[0]) == ("x", "y")


def test_what_is_unseen_is_a_short_line(table: PoseTable) -> None:
    above = page.poses_figure(table).axes[0]
    (line,) = [line for line in above.lines if to_hex(line.get_color()) == "#b2182b"]
    ends = np.array(line.get_xydata())
    extent = np.ptp([one.pose[:3, 3] for one in table.rows], axis=0).max()
    np.testing.assert_allclose(ends.mean(axis=0), table.rows[3].pose[[0, 2], 3])
    assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(0.1 * extent, rel=0.05)
    rings = [line for line in above.lines if len(line.get_xdata()) > 50]
    assert len(rings) == 3
    for ring in rings:
        assert np.isfinite(ring.get_xydata()).all()


def test_ellipsoids_are_drawn_to_one_stated_scale(table: PoseTable) -> None:
    above = page.poses_figure(table, sigma=2.0).axes[0]
    first = next(line for line in above.lines if len(line.get_xdata()) > 50)
    factor = page._enlarged(table.rows, 2.0, 2.0)
    assert f"{factor:g} times" in words(page.poses_figure(table, sigma=2.0))
    # ρ is along the world's axes: 1/√F, longer along z than along x.
    assert np.ptp(first.get_xdata()) == pytest.approx(2 * 2.0 * factor / np.sqrt(4e6), rel=1e-2)
    assert np.ptp(first.get_ydata()) == pytest.approx(2 * 2.0 * factor / np.sqrt(2e6), rel=1e-2)


@pytest.mark.parametrize("which", [slice(0, 1), slice(3, 4), slice(4, 5), slice(3, 5)])
def test_a_single_pose_and_a_lost_camera_can_be_drawn(table: PoseTable, tmp_path: Path, which: slice) -> None:
    some = dataclasses.replace(table, rows=table.rows[which], places=table.places[which])
    page.write_poses_plot(tmp_path / "page.png", some)
    assert (tmp_path / "page.png").read_bytes().startswith(b"\x89PNG")


def test_drawing_returns_what_it_drew_where_it_was_told(table: PoseTable) -> None:
    _, ax, other = Figure().subplots(1, 3)
    norm = LogNorm(1e-4, 1e-2)
    path = page.draw_path(ax, table.rows, (0, 2), sigma=3.0, factor=1.0, extent=2.0, norm=norm)
    along = page.draw_along(other, table, [row.position for row in table.rows], "position")
    assert {artist.axes for artist in path} == {ax}
    assert {artist.axes for artist in along} == {other}
    assert len(path) > len(table.rows)
