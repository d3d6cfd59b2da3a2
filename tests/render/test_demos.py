"""Shipped scenes are found by name from any folder, wherever a scene is taken."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import mitsuba_crb
from mitsuba_crb import pose_bound
from mitsuba_crb.cli import app as cli
from mitsuba_crb.errors import SceneError
from mitsuba_crb.measure.team_file import load_team
from mitsuba_crb.render.demos import demo_names, scene_path
from mitsuba_crb.render.scene import load_scene

# Few samples on small images: that standard errors exceed 10 % is expected.
pytestmark = pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def assert_shipped(file: Path, original: Path) -> None:
    """A file is the checkout's own, or in an installed package a copy of it."""
    if not file.samefile(original):
        assert file.parents[1] == Path(mitsuba_crb.__file__).parent / "scenes"
        assert file.read_bytes() == original.read_bytes()


def test_every_shipped_scene_has_a_name(scenes: Path) -> None:
    folders = {file.parent.name for file in scenes.glob("*/*.xml")}
    assert set(demo_names()) == folders
    assert demo_names(".toml") == ("warehouse",)
    for name in demo_names():
        assert_shipped(scene_path(f"demo:{name}"), scenes / name / f"{name}.xml")


def test_other_paths_stay_as_they_are() -> None:
    for path in ("boxes.xml", "rooms/demo:boxes", "Demo:boxes", Path("a") / "b.glb"):
        assert scene_path(path) == Path(path)


def test_a_demo_is_the_scene_s_file(scenes: Path) -> None:
    options = {"size": (16, 12), "spp": 16}
    by_name, by_file = (
        pose_bound(scene, **options) for scene in ("demo:boxes", scenes / "boxes" / "boxes.xml")
    )
    np.testing.assert_array_equal(by_name.information.matrix, by_file.information.matrix)
    assert by_name.provenance["scene"] == "demo:boxes"
    assert load_scene("demo:white_wall", width="8").sensors()[0].film().size()[0] == 8


def test_a_team_may_be_a_demo_and_look_at_one(scenes: Path) -> None:
    team = load_team(Path("demo:warehouse"))
    assert_shipped(team.path, scenes / "warehouse" / "warehouse.toml")
    Path("team.toml").write_text('[[agents]]\nname = "a"\nscene = "demo:boxes"\n')
    (member,) = load_team(Path("team.toml")).members
    assert_shipped(member.scene, scenes / "boxes" / "boxes.xml")


def test_an_unknown_demo_is_refused_with_the_near_one(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SceneError, match="there is no demo:boxs; did you mean demo:boxes"):
        pose_bound("demo:boxs")
    with pytest.raises(SceneError, match="there is no demo:boxes with a team; there are demo:warehouse"):
        load_team(Path("demo:boxes"))
    for command in ("bound", "check", "validate", "fuse"):
        assert cli.run([command, "demo:../boxes"]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("mitsuba-crb: there is no demo:../boxes")


def test_no_output_replaces_a_demo(capsys: pytest.CaptureFixture[str]) -> None:
    file = scene_path("demo:boxes")
    before = file.read_bytes()
    assert cli.run(["bound", "demo:boxes", "--json", str(file)]) == 2
    assert "overwrite an input" in capsys.readouterr().err
    assert file.read_bytes() == before
