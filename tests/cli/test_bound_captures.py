"""`bound --poses` of a capture: each pose has its camera, and a photograph that tells how it was read."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from mitsuba_crb import se3
from mitsuba_crb.camera import Intrinsics
from mitsuba_crb.cli import app as cli
from mitsuba_crb.datasets.pose_photographs import photographs_at_hand, photographs_in
from mitsuba_crb.datasets.poses import load_poses
from mitsuba_crb.jacobian.method import Paths
from mitsuba_crb.measure.opening import open_measurable
from mitsuba_crb.measure.options import MeasurementOptions
from mitsuba_crb.noise import SRGB

WALL = str(Path(__file__).parents[2] / "scenes" / "textured_wall" / "textured_wall.xml")
CAMERAS = [
    Intrinsics((32, 24), (30.0, 30.0), (16.0, 12.0)),
    Intrinsics((32, 24), (26.0, 26.0), (15.0, 12.5), "opencv", (-0.1, 0.02, 0, 0, 0, 0, 0, 0)),
]
MOVES = [[0.1, 0, 0, 0, 0, 0.6], [-0.2, 0.1, 0.1, 0.05, 0.1, -0.9]]


def row(k: int, pose: Any) -> str:
    """Of `images.txt`."""
    matrix = se3.pose_to_colmap(pose)
    x, y, z, w = Rotation.from_matrix(matrix[:3, :3]).as_quat()
    numbers = [w, x, y, z, *matrix[:3, 3]]
    return f"{k + 1} {' '.join(f'{value:.17g}' for value in numbers)} {k + 1} p{k}.png\n\n"


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """Two photographs of the wall by two cameras, as a COLMAP model."""
    folder = tmp_path / "capture"
    (folder / "images").mkdir(parents=True)
    pixels = np.stack(np.meshgrid(np.arange(32), np.arange(24)), axis=-1).reshape(-1, 2)
    images = ""
    for k, (intrinsics, move) in enumerate(zip(CAMERAS, MOVES, strict=True)):
        with open_measurable(WALL, MeasurementOptions(camera=intrinsics)) as here:
            view = here.at(here.pose @ se3.exp(move))
            values = view.start_image(pixels, Paths(64, 1, 4), purpose=1)().mean(axis=0)
        stored = np.rint(255.0 * SRGB(np.clip(0.5 * values, 0.0, 1.0))).astype(np.uint8)
        Image.fromarray(stored.reshape(24, 32, 3)).save(folder / "images" / f"p{k}.png")
        images += row(k, view.pose)
    (folder / "images.txt").write_text(images)
    lines = ["1 PINHOLE 32 24 30 30 16 12", "2 OPENCV 32 24 26 26 15 12.5 -0.1 0.02 0 0"]
    (folder / "cameras.txt").write_text("\n".join(lines))
    return folder


def bound(*arguments: Any) -> int:
    return cli.run(["bound", WALL, "--spp", "16", *map(str, arguments)])


def test_each_pose_has_its_camera_and_its_photograph(capture: Path, tmp_path: Path, capsys: Any) -> None:
    files = [tmp_path / "out.json", tmp_path / "out.csv"]
    assert bound("--poses", capture, "--json", files[0], "--csv", files[1]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert "cameras of the same file: 2 different ones, each pose its own" in out
    assert "PSNR of the render against the photograph: median " in out
    assert "unlike" not in out
    documents = [json.loads(line) for line in files[0].read_text().splitlines()]
    assert [document["camera"]["focal"][0] for document in documents] == [30.0, 26.0]
    with files[1].open(newline="") as text:
        rows = list(csv.DictReader(text))
    assert min(float(row["psnr_db"]) for row in rows) > 30.0
    assert [float(row["psnr_db"]) for row in rows] == [document["row"]["psnr_db"] for document in documents]
    assert bound("--poses", capture, "--json", files[0]) == 0  # what is there is read back
    assert "PSNR" in capsys.readouterr().out


def test_inverted_poses_are_told_before_and_after(capture: Path, capsys: Any) -> None:
    with open_measurable(WALL, MeasurementOptions()) as view:
        away = [view.pose @ se3.inverse(se3.exp(move)) for move in MOVES]
    (capture / "images.txt").write_text("".join(row(k, pose) for k, pose in enumerate(away)))
    assert bound("--poses", capture) == 0
    out, err = capsys.readouterr()
    for text in (out, err):
        assert "the renders are unlike the photographs (median PSNR" in text
        assert "--convention" in text
    assert err.count("\n") == 1


def test_a_camera_that_is_given_comes_first(capture: Path, tmp_path: Path, capsys: Any) -> None:
    out = tmp_path / "out.json"
    assert bound("--poses", capture, "--camera", f"{capture}:2", "--json", out) == 0
    documents = [json.loads(line) for line in out.read_text().splitlines()]
    assert [document["camera"]["focal"][0] for document in documents] == [26.0, 26.0]
    assert bound("--poses", capture, "--camera", "scene", "--size", "16x12") == 0
    printed = capsys.readouterr().out
    assert "cameras of the same file" not in printed
    assert "16×12 pixels" in printed


def test_photographs_in_a_folder(capture: Path, tmp_path: Path, capsys: Any) -> None:
    poses = load_poses(capture)
    assert photographs_at_hand(capture, poses) == [capture / "images" / f"p{k}.png" for k in range(2)]
    folder = (capture / "images").rename(tmp_path / "photos")
    assert photographs_at_hand(capture, poses) == []
    assert photographs_in(folder, poses) == [folder / f"p{k}.png" for k in range(2)]
    (folder / "p0.png").rename(folder / "a.png")
    assert photographs_in(folder, poses) == [None, folder / "p1.png"]
    (folder / "p1.png").rename(folder / "b.png")
    assert photographs_in(folder, poses) == [folder / "a.png", folder / "b.png"]
    assert bound("--poses", capture, "--images", folder) == 0
    assert "PSNR" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--images", "IMAGES"], "--images is of many poses: give --poses"),
        (["--poses", "CAPTURE", "--images", "none"], "none is no folder of images"),
        (["--poses", "CAPTURE", "--images", "CAPTURE"], "has 0 images, none of which is called like one of"),
        (["--poses", "CAPTURE", "--camera", "CAPTURE"], "several different cameras; name one of them"),
        (["--poses", "CAPTURE", "--size", "32x32"], "32x32 is another shape"),
    ],
    ids=" ".join,
)
def test_mistakes_are_one_line(capture: Path, capsys: Any, arguments: list[str], words: str) -> None:
    places = {"CAPTURE": capture, "IMAGES": capture / "images"}
    assert bound(*(places.get(word, word) for word in arguments)) == 2
    message = capsys.readouterr().err
    assert words in message, message
    assert message.count("\n") == 1
