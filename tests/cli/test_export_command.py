"""`mitsuba-crb export`: one library call, its file named, its notes said; mistakes in one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import synthetic_view

from mitsuba_crb.cli import app as cli
from mitsuba_crb.export.documents import bound_document, write_json


def result_in(folder: Path, *, unseen: tuple[int, ...] = ()) -> Path:
    noise = 0.05 if unseen else 0.01
    path = folder / "room.json"
    write_json(
        path, bound_document(synthetic_view.bound(synthetic_view.jacobian(unseen=unseen, noise=noise)))
    )
    return path


def test_the_file_is_named_with_its_body(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = result_in(tmp_path)
    assert cli.run(["export", str(result), "--to", "tum"]) == 0
    said = capsys.readouterr()
    assert said.out.startswith(f"{tmp_path / 'room.tum'}: 1 pose of the camera, x right, y down, z forward")
    assert not said.err
    assert np.loadtxt(tmp_path / "room.tum").shape == (29,)
    other = tmp_path / "other.npz"
    other.write_text("of no use")  # replaced, as it is named
    body = ["--body-from-camera", "0 0 1 0 0 0 1", "--axes", "opengl"]
    assert cli.run(["export", str(result), "--to", "npz", "--out", str(other), *body]) == 0
    assert "the body that carries the camera" in capsys.readouterr().out
    assert np.load(other)["poses"].shape == (1, 4, 4)


def test_what_is_unseen_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = result_in(tmp_path, unseen=(1, 5))
    assert cli.run(["export", str(result), "--to", "g2o"]) == 0
    said = capsys.readouterr()
    assert "mitsuba-crb: note: " in said.err
    assert "no information about" in said.err
    for to in ("gtsam", "ros"):
        assert cli.run(["export", str(result), "--to", to]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert "export --to g2o or npz" in line
    assert {file.name for file in tmp_path.iterdir()} == {"room.json", "room.g2o"}


def test_mistakes_are_a_line_each(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = result_in(tmp_path)
    deep = tmp_path / "deep.json"
    deep.write_text("[" * 100_000)
    for arguments, words in (
        ([str(result)], "--to"),
        ([str(result), "--to", "kml"], "'kml'"),
        ([str(tmp_path / "none.json"), "--to", "csv"], "cannot read"),
        ([str(result), "--to", "csv", "--out", str(tmp_path / "no" / "a.csv")], "create it first"),
        ([str(result), "--to", "csv", "--out", str(result)], "would overwrite an input"),
        ([str(result), "--to", "csv", "--body-from-camera", str(tmp_path / "no.yaml")], "no.yaml"),
        ([str(deep), "--to", "csv"], "deep.json is no JSON"),
    ):
        assert cli.run(["export", *arguments]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert words in line
    assert {file.name for file in tmp_path.iterdir()} == {"room.json", "deep.json"}
