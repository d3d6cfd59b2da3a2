"""`mitsuba-crb bound --poses`: a row a pose, files that a run goes on from, each mistake in one line."""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mitsuba_crb import pose_bound, se3
from mitsuba_crb.cli import app as cli
from mitsuba_crb.measure import many
from mitsuba_crb.measure import poses as module
from mitsuba_crb.render.view import open_view

WALL = str(Path(__file__).parents[2] / "scenes" / "textured_wall" / "textured_wall.xml")
FEW = ["--size", "32x24", "--spp", "16"]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Four poses, the third of which looks away."""
    moves = [[0, 0, 0, 0, 0, 0], [0.2, 0, 0.1, 0, 0.02, 0], [0, 0, 0, 0, np.pi, 0], [0.3, 0.1, 0, 0, 0, 0.1]]
    file = tmp_path / "path.npy"
    with open_view(WALL) as view:
        start = view.pose
    np.save(file, np.array([start @ se3.exp(move) for move in moves]))
    return file


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], list[Any]]:
    """Calls of `pose_bound`, and a way to interrupt one of them."""

    def count(interrupt: int = -1) -> list[Any]:
        calls: list[Any] = []

        def measured(*args: Any, **kwargs: Any) -> Any:
            calls.append(kwargs["pose"])
            if len(calls) == interrupt:
                raise KeyboardInterrupt
            return pose_bound(*args, **kwargs)

        monkeypatch.setattr(many, "pose_bound", measured)
        return calls

    return count


def rows(file: Path) -> list[dict[str, str]]:
    with file.open(newline="", encoding="utf-8") as text:
        return [row | {"seconds": ""} for row in csv.DictReader(text)]


def test_a_row_a_pose_is_printed_and_written(path: Path, tmp_path: Path, capsys: Any) -> None:
    files = {kind: tmp_path / f"out.{kind}" for kind in ("json", "csv", "parquet")}
    pytest.importorskip("arro3.io")
    outputs = [word for kind, file in files.items() for word in (f"--{kind}", str(file))]
    plot = tmp_path / "out.png"
    assert cli.run(["bound", WALL, "--poses", str(path), *FEW, *outputs, "--plot", str(plot)]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert out.startswith(f"{path}: 4 poses of ")
    assert "world_from_camera" in out.splitlines()[1]
    for words in ("textured_wall.xml", "32×24", "6 at 3, 0 at 1", "one exposure for all poses"):
        assert words in out
    table = rows(files["csv"])
    documents = [json.loads(line) for line in files["json"].read_text().splitlines()]
    assert [row["rank"] for row in table] == ["6", "6", "0", "6"]
    assert [document["rank"] for document in documents] == [6, 6, 0, 6]
    assert [float(row["position_std_x"]) for row in table] == [
        float(document["position_std"][0]) for document in documents
    ]
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert files["parquet"].read_bytes().startswith(b"PAR1")


def test_poses_of_a_body_are_carried_to_its_camera(path: Path, tmp_path: Path, capsys: Any) -> None:
    """Of many poses and of one; the camera's axes are OpenCV's."""
    body_from_camera = se3.exp([0.1, -0.2, 0.3, 1.0, -2.0, 0.5])
    (tmp_path / "sensor.yaml").write_text(f"T_BS:\n  data: {body_from_camera.ravel().tolist()}\n")
    camera = np.load(path)[0]
    body = camera @ np.diag([-1.0, -1.0, 1.0, 1.0]) @ se3.inverse(body_from_camera)
    np.save(tmp_path / "bodies.npy", body[None])
    np.save(tmp_path / "body.npy", body)
    carried = ["--body-from-camera", str(tmp_path / "sensor.yaml")]
    out, many = tmp_path / "one.json", tmp_path / "many.jsonl"
    command = ["bound", WALL, "--size", "12x8", "--spp", "4", *carried]
    assert cli.run([*command, "--pose", str(tmp_path / "body.npy"), "--json", str(out)]) == 0
    assert cli.run([*command, "--poses", str(tmp_path / "bodies.npy"), "--json", str(many)]) == 0
    assert "carried to its camera" in " ".join(capsys.readouterr().out.split())
    for document in (json.loads(out.read_text()), json.loads(many.read_text().splitlines()[0])):
        np.testing.assert_allclose(document["pose"], camera, atol=1e-6)
    assert cli.run(command) == 2
    assert "--body-from-camera is of poses" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["json", "csv"])
def test_an_interrupted_run_goes_on_with_the_same_command(
    path: Path, tmp_path: Path, capsys: Any, counted: Callable[..., list[Any]], kind: str
) -> None:
    def command(name: str) -> list[str]:
        return ["bound", WALL, "--poses", str(path), *FEW, f"--{kind}", str(tmp_path / name)]

    assert cli.run(command("whole")) == 0
    counted(interrupt=3)
    assert cli.run(command("parts")) == 130
    assert "interrupted: 2 of 4 poses are done" in capsys.readouterr().out
    again = counted()
    assert cli.run(command("parts")) == 0
    assert len(again) == 2
    third = counted()
    assert cli.run(command("parts")) == 0
    assert third == []
    if kind == "csv":
        assert rows(tmp_path / "parts") == rows(tmp_path / "whole")
    else:
        one, other = ((tmp_path / name).read_text().splitlines() for name in ("parts", "whole"))
        for line, expected in zip(one, other, strict=True):
            assert json.loads(line)["information"] == json.loads(expected)["information"]


@pytest.mark.slow
def test_what_is_no_bound_is_said_above_the_table(path: Path, scenes: Path, capsys: Any) -> None:
    scene = str(scenes / "checkerboard_wall" / "checkerboard_wall.xml")
    np.save(path, np.load(path)[:2])
    assert cli.run(["bound", scene, "--poses", str(path), *FEW, "--method", "forward"]) == 0
    above, _, below = capsys.readouterr().out.partition(" pose ")
    assert "no bound: " in above
    assert "(at all poses)" in above
    assert "checkerboard" not in below


def test_before_the_first_row_an_interrupt_is_one_line(
    path: Path, tmp_path: Path, capsys: Any, counted: Callable[..., list[Any]]
) -> None:
    counted(interrupt=1)
    assert cli.run(["bound", WALL, "--poses", str(path), *FEW, "--csv", str(tmp_path / "out.csv")]) == 130
    assert capsys.readouterr().out == ""
    assert not (tmp_path / "out.csv").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--poses", "PATH", "--pose", "0 0 0 0 0 0 1"], ["--pose", "leave out"]),
        (["--poses", "PATH", "--hcr"], ["--hcr", "leave out"]),
        (["--poses", "PATH", "--exr", "out.exr"], ["--exr", "leave out"]),
        (["--csv", "out.csv"], ["--csv", "give --poses"]),
        (["--parquet", "out.parquet"], ["--parquet", "give --poses"]),
        (["--convention", "opencv"], ["--convention", "give --poses"]),
        (["--poses", "missing.txt"], ["missing.txt"]),
        (["--poses", "PATH", "--convention", "sideways"], ["sideways"]),
        (["--poses", "PATH", "--csv", "PATH"], ["overwrite an input"]),
        (["--poses", "PATH", "--csv", "out.x", "--json", "out.x"], ["both name"]),
        (["--poses", "PATH", "--csv", "notes.csv"], ["notes.csv", "name another file"]),
        (["--poses", "PATH", "--json", "notes.csv"], ["notes.csv", "name another file"]),
        (["--poses", "PATH", "--csv", "nowhere/out.csv"], ["folder", "does not exist"]),
        (["--poses", "bent.npy"], ["bent.npy", "pose 1"]),
        (["--poses", "none.npy"], ["none.npy"]),
    ],
    ids=" ".join,
)
def test_a_mistake_is_one_line_and_touches_nothing(
    path: Path,
    tmp_path: Path,
    capsys: Any,
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    words: list[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("notes.csv").write_text("day,what\n1,nothing\n")
    poses = np.load(path)
    np.save("none.npy", poses[:0])
    poses[1, :3, :3] *= 2.0
    np.save("bent.npy", poses)
    before = {file: file.read_bytes() for file in tmp_path.iterdir()}
    assert cli.run(["bound", WALL, *FEW, *(str(path) if a == "PATH" else a for a in arguments)]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    for word in words:
        assert word in err
    assert {file: file.read_bytes() for file in tmp_path.iterdir()} == before


@pytest.mark.parametrize("kind", ["--json", "--csv"])
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (["--spp", "32"], "spp = 16, not 32"),
        (["--seed", "1"], "seed = 0, not 1"),
        (["--sigma", "0.1"], "noise = None, not"),
        (["--poses", "OTHER"], "poses.count = 4, not 3"),
    ],
)
def test_another_run_is_refused_by_name(
    path: Path, tmp_path: Path, capsys: Any, kind: str, change: list[str], words: str
) -> None:
    other = tmp_path / "other.npy"
    np.save(other, np.load(path)[:3])
    command = ["bound", WALL, "--poses", str(path), *FEW, kind, str(tmp_path / "out")]
    assert cli.run(command) == 0
    before = (tmp_path / "out").read_bytes()
    capsys.readouterr()
    assert cli.run([*command, *(str(other) if word == "OTHER" else word for word in change)]) == 2
    err = capsys.readouterr().err
    assert words in err
    assert "use the same settings" in err
    assert (tmp_path / "out").read_bytes() == before
    assert cli.run(["bound", WALL, *FEW, "--json", str(tmp_path / "out")]) == 2
    assert "bounds of many poses that would be lost" in capsys.readouterr().err


def test_parquet_is_refused_before_anything_is_measured_if_it_cannot_be_written(
    path: Path, tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch, counted: Any
) -> None:
    calls = counted()
    monkeypatch.setitem(sys.modules, "arro3.io", None)
    assert cli.run(["bound", WALL, "--poses", str(path), "--parquet", str(tmp_path / "out.parquet")]) == 2
    assert "pip install 'mitsuba_crb[parquet]'" in capsys.readouterr().err
    assert calls == []


@pytest.mark.slow
def test_names_and_numbers_are_whole_where_there_is_no_terminal_and_rows_fit_where_there_is_one(
    path: Path, tmp_path: Path, capsys: Any
) -> None:
    from rich.console import Console

    from mitsuba_crb.show.poses_table import print_poses

    names = [f"1403636579.75855539{k}" for k in range(4)]
    table = module.pose_table(WALL, np.load(path), names=names, size=(32, 24), spp=16)
    print_poses(Console(markup=False), table)
    out = capsys.readouterr().out
    assert all(name in out for name in names)
    rows_out = [line for line in out.splitlines() if "55539" in line and "%" in line]
    assert len(rows_out) == 3
    assert all(line.index("%") < len(line) < 180 and "…" not in line[: line.index("%")] for line in rows_out)
    for width in (80, 110, 160):
        terminal = Console(markup=False, force_terminal=True, color_system=None, width=width)
        print_poses(terminal, table)
        lines = [line for line in capsys.readouterr().out.splitlines() if "55539" in line and "%" in line]
        assert len(lines) == 3
        assert all(len(line) <= width for line in lines)
