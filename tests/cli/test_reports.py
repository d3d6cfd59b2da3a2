"""`--report` of every command that has it."""

from __future__ import annotations

from pathlib import Path

import pytest

from mitsuba_crb.cli import app as cli
from mitsuba_crb.measure import report, teams
from mitsuba_crb.planning import field_run, world_at_hand

pytest.importorskip("plotly")

SCENES = Path(__file__).parents[2] / "scenes"
WALL = str(SCENES / "textured_wall" / "textured_wall.xml")
TEAM = str(SCENES / "warehouse" / "warehouse.toml")
SMALL = ("--size", "24x18", "--spp", "16")


def test_without_plotly_nothing_is_measured(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(__import__("sys").modules, "plotly.graph_objects", None)
    for module, name in ((report, "pose_bound"), (teams, "pose_bound")):
        monkeypatch.setattr(module, name, lambda *_, **__: pytest.fail("measured"))
    page = str(tmp_path / "page.html")
    monkeypatch.setattr(field_run, "measure_field", lambda *_, **__: pytest.fail("measured"))
    field = ["field", WALL, "--poses", "grid:nx=2,ny=2", "--out", str(tmp_path / "views.zarr")]
    for arguments in (["bound", WALL], ["validate", WALL], ["fuse", TEAM], ["select", TEAM], field):
        assert cli.run([*arguments, "--report", page]) == 2
        out, err = capsys.readouterr()
        assert out == ""
        assert err == "mitsuba-crb: --report needs plotly: pip install 'mitsuba_crb[report]'\n"
    assert not list(tmp_path.iterdir())


def test_the_page_of_a_bound_says_its_command(tmp_path, capsys):
    page = tmp_path / "a page.html"
    assert cli.run(["bound", WALL, *SMALL, "--report", str(page)]) == 0
    capsys.readouterr()
    text = page.read_text(encoding="utf-8")
    assert f"mitsuba-crb bound {WALL} --size 24x18 --spp 16 --report &#x27;{page}&#x27;" in text
    for words in (
        "position x",
        "∂I/∂ρx",
        "Samples",
        "random points of the scene&#x27;s surfaces",
        "mitsuba 3.",
    ):
        assert words in text


def test_the_page_of_many_poses_has_a_row_for_each(tmp_path, capsys):
    poses, page = tmp_path / "poses.txt", tmp_path / "page.html"
    poses.write_text("0 0 0 0 0 0 0 1\n1 0.1 0 0 0 0 0 1\n")
    convention = ("--convention", "opencv world_from_camera")
    assert cli.run(["bound", WALL, *SMALL, "--poses", str(poses), *convention, "--report", str(page)]) == 0
    capsys.readouterr()
    text = page.read_text(encoding="utf-8")
    assert text.count('class="pose"') == 2


@pytest.mark.slow
def test_the_page_of_a_field_shows_the_world_which_is_loaded_once_for_all_that_is_drawn(
    tmp_path, capsys, monkeypatch
):
    pytest.importorskip("zarr")
    poses, page = tmp_path / "poses.txt", tmp_path / "page.html"
    poses.write_text("0 0 0 0 0 0 0 1\n1 0.1 0 0 0 0 0 1\n")
    arguments = ["field", WALL, *SMALL, "--poses", str(poses), "--convention", "opencv world_from_camera"]
    arguments += ["--out", str(tmp_path / "views.zarr"), "--report", str(page)]
    loads = []
    real = world_at_hand.as_world
    monkeypatch.setattr(world_at_hand, "as_world", lambda *given: loads.append(given) or real(*given))
    assert cli.run([*arguments, "--plot", str(tmp_path / "plan.png")]) == 0
    capsys.readouterr()
    assert len(loads) == 1
    text = page.read_text(encoding="utf-8")
    for words in ("mitsuba-crb field", "random points of the scene&#x27;s surfaces", "2 places, coloured by"):
        assert words in text
    assert '"name":"view 1"' in text


@pytest.mark.slow
def test_pages_of_trials_and_teams(tmp_path, capsys):
    commands = {
        "validate": ["validate", WALL, *SMALL, "--trials", "8", "--workers", "1"],
        "fuse": ["fuse", TEAM, "--workers", "1"],
        "select": ["select", TEAM, "--budget", "6", "--workers", "1"],
    }
    for name, arguments in commands.items():
        page = tmp_path / f"{name}.html"
        assert cli.run([*arguments, "--report", str(page)]) in (0, 1, 3)
        capsys.readouterr()
        text = page.read_text(encoding="utf-8")
        assert {"validate": "Calibration", "fuse": "What each agent brings", "select": "Tiles that are sent"}[
            name
        ] in text
        assert len(text) < 15e6
