"""`--camera FILE`: the commands that measure a view measure it through a calibration, or say why not."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mitsuba_crb.cli import app as cli

WALL = str(Path(__file__).parents[2] / "scenes" / "textured_wall" / "textured_wall.xml")
FISHEYE = 'size = [32, 24]\nfocal = 17.0\nmodel = "fisheye"\nk1 = -0.02\n'
OPENCV = 'size = [64, 48]\nfocal = [52.0, 50.0]\ncentre = [31.0, 25.0]\nmodel = "opencv"\nk1 = -0.1\n'


@pytest.fixture
def calibration(tmp_path: Path) -> Any:
    def written(text: str) -> str:
        file = tmp_path / "camera.toml"
        file.write_text(text)
        return str(file)

    return written


def test_bound_measures_through_a_calibration(calibration: Any, tmp_path: Path, capsys: Any) -> None:
    out = tmp_path / "out.json"
    lens = ["--camera", calibration(FISHEYE), "--marginalize", "k1", "--marginalize", "fx"]
    assert cli.run(["bound", WALL, *lens, "--spp", "16", "--json", str(out)]) == 0
    printed = capsys.readouterr().out
    found = json.loads(out.read_text())
    assert found["camera"]["model"] == "fisheye"
    assert found["size"] == [32, 24]
    # θ (1 + k1 θ²) 17 = 16 at the sides' middles.
    theta = max(root.real for root in np.roots([-0.02, 0.0, 1.0, -16 / 17]) if abs(root) < 2.0)
    assert f"32×24 pixels  {2.0 * np.degrees(theta):.1f}°×" in printed
    assert "fisheye lens" in printed
    assert found["nuisances"]["how"] == {"k1": "filter term", "fx": "filter term"}


def test_a_size_scales_it(calibration: Any, tmp_path: Path, capsys: Any) -> None:
    out = tmp_path / "out.json"
    lens = ["--camera", calibration(OPENCV), "--size", "32x24"]
    assert cli.run(["bound", WALL, *lens, "--spp", "16", "--json", str(out)]) == 0
    found = json.loads(out.read_text())
    assert found["camera"]["focal"] == [26.0, 25.0]
    assert found["camera_scaled_from"] == [64, 48]
    capsys.readouterr()


def test_many_poses_name_the_lens(calibration: Any, tmp_path: Path, capsys: Any) -> None:
    np.save(tmp_path / "path.npy", np.eye(4)[None])
    many = ["--poses", str(tmp_path / "path.npy"), "--spp", "16"]
    assert cli.run(["bound", WALL, *many, "--camera", calibration(FISHEYE)]) == 0
    seen = r"textured_wall.xml  32×24 pixels  [\d.]+°×[\d.]+° field of view"
    assert re.search(rf"{seen}  fisheye lens  1 pose\n", capsys.readouterr().out)
    assert cli.run(["bound", WALL, *many, "--size", "32x24"]) == 0
    assert re.search(rf"{seen}  1 pose\n", capsys.readouterr().out)


@pytest.mark.slow
def test_check_and_validate_take_it_too(calibration: Any, capsys: Any) -> None:
    lens = ["--camera", calibration(FISHEYE)]
    assert cli.run(["check", WALL, *lens, "--max-spp", "64"]) in (0, 3)
    few = ["--trials", "7", "--spp", "16", "--workers", "1"]
    assert cli.run(["validate", WALL, *lens, *few]) in (0, 1, 3)
    capsys.readouterr()


@pytest.mark.parametrize(
    ("text", "more", "expected"),
    [
        (
            OPENCV.replace("-0.1", "-0.9"),
            [],
            r"opencv with k1 = -0.9 folds the image over at \d+.* crop",
        ),
        (FISHEYE.replace("17.0", "10.0"), [], r"fisheye with k1 = -0.02 comes to 88° off the axis at \d+"),
        (OPENCV, ["--size", "32x32"], "the calibration is of 64x48 pixels, and 32x32 is another shape"),
        (OPENCV, ["--marginalize", "k9"], "no nuisance or scene parameter is named k9; near ones: k"),
        ("size = [64, 48]\nfocal = 52.0\n", ["--marginalize", "k1"], "the camera's is a pinhole"),
    ],
    ids=["folds", "looks aside", "another shape", "no such nuisance", "no lens"],
)
def test_mistakes_are_one_line(
    text: str, more: list[str], expected: str, calibration: Any, capsys: Any
) -> None:
    assert cli.run(["bound", WALL, "--spp", "16", "--camera", calibration(text), *more]) == 2
    message = capsys.readouterr().err
    assert re.search(expected, message), message
    assert message.count("\n") == 1
