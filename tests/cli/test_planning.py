"""`next-view` and `path`: what they print and write, their exit codes, and mistakes in one line."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from synthetic_field import small_dataset, small_field, small_store

from mitsuba_crb import load_poses, se3
from mitsuba_crb.cli import app as cli
from mitsuba_crb.planning.next_view import next_views
from mitsuba_crb.planning.odometry import Odometry
from mitsuba_crb.planning.path_search import plan_path

SMALL = {"shape": (4, 3), "headings": 3, "inside": (4,), "to_do": (35,)}
ODOMETRY = "translation_per_sqrt_length = 0.05\nrotation_deg_per_sqrt_length = 1.0\n"


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_store(tmp_path_factory.mktemp("stores") / "room.zarr", **SMALL)


def test_next_views_are_printed_and_written(
    store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "next.json"
    assert cli.run(["next-view", str(store), "--budget", "2", "--have", "3, 20", "--json", str(file)]) == 0
    printed = capsys.readouterr().out
    expected = next_views(small_field(**SMALL), budget=2, have=(3, 20))
    assert "the common pose of one body that carries all these views" in printed
    assert f"{expected.certificate:.1%} of the best gain" in printed
    document = json.loads(file.read_text())
    assert document["schema"] == "mitsuba-crb/next-view/1"
    assert document["have"] == [3, 20]
    assert [chosen["view"] for chosen in document["chosen"]] == list(expected.chosen)
    assert [row["position_bound"] for row in document["bounds"]] == pytest.approx(expected.position_bound)
    np.testing.assert_allclose(document["chosen"][0]["pose"], expected.poses[0])


def test_views_taken_may_be_a_file_of_poses(
    store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    field, out = small_field(**SMALL), tmp_path / "next.json"
    np.save(tmp_path / "have.npy", field.poses[[3, 20]])
    arguments = ["next-view", str(store), "--have", str(tmp_path / "have.npy"), "--json", str(out)]
    assert cli.run(arguments) == 0
    assert json.loads(out.read_text())["have"] == [3, 20]
    np.save(tmp_path / "have.npy", field.poses[[3]] + np.eye(4, k=3)[None])
    assert cli.run(arguments) == 2
    assert "the store has no view at pose 0; the nearest is view" in capsys.readouterr().err


def test_a_path_is_printed_and_written_as_others_read_it(
    store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "odometry.toml").write_text(ODOMETRY)
    files = ["--json", str(tmp_path / "path.json"), "--tum", str(tmp_path / "path.txt")]
    options = [
        "--from",
        "0",
        "--to",
        "3:1.5:0",
        "--limit",
        "1",
        "--odometry",
        str(tmp_path / "odometry.toml"),
    ]
    assert cli.run(["path", str(store), *options, *files]) == 0
    printed = capsys.readouterr().out
    expected = plan_path(small_field(**SMALL), 0, 10, limit=1.0, odometry=Odometry(0.05, 1.0))
    assert f"{expected.length:.4g} scene units; without the limit" in printed
    assert "walls thinner than that" in printed
    document = json.loads((tmp_path / "path.json").read_text())
    assert [step["view"] for step in document["steps"]] == list(expected.views)
    assert (document["found"], document["heuristic"]) == (True, False)
    read = load_poses(tmp_path / "path.txt")
    assert read.format == "TUM"
    for pose, given in zip(read.poses, expected.poses, strict=True):
        np.testing.assert_allclose(se3.log(se3.inverse(given) @ pose), 0.0, atol=1e-7)


@pytest.mark.parametrize("odometry", [False, True])
def test_no_path_is_an_answer_with_the_smallest_limit_and_exit_code_1(
    store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], odometry: bool
) -> None:
    (tmp_path / "odometry.toml").write_text(ODOMETRY)
    options = ["--odometry", str(tmp_path / "odometry.toml")] if odometry else []
    ways = ["path", str(store), "--from", "0", "--to", "10", *options]
    files = ["--json", str(tmp_path / "path.json"), "--tum", str(tmp_path / "path.txt")]
    assert cli.run([*ways, "--limit", "1e-5", *files]) == 1
    assert "No path with this limit; the smallest that has one: " in capsys.readouterr().out
    document = json.loads((tmp_path / "path.json").read_text())
    assert (document["found"], document["length"], document["steps"]) == (False, "inf", [])
    assert not (tmp_path / "path.txt").exists()
    assert cli.run([*ways, "--limit", str(document["smallest_limit"] * 1.0001)]) == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["next-view", "nowhere.zarr"], "nowhere.zarr: no such store"),
        (["next-view", "."], ". is no store of views"),
        (["next-view", "STORE", "--budget", "0"], "at least 1, not 0"),
        (["next-view", "STORE", "--budget", "99"], "only 32 of 36 can be chosen"),
        (["next-view", "STORE", "--objective", "lambda-min"], "did you mean 'lambda_min'?"),
        (["next-view", "STORE", "--have", "nobody.txt"], "--have nobody.txt: there is no such file"),
        (["next-view", "STORE", "--have", "1,99"], "there is no view 99; the field has 36"),
        (["next-view", "STORE", "--have", "35"], "view 35 is not measured yet"),
        (["next-view", "STORE", "--have", ","], "--have ,: there is no such file"),
        (["next-view", "STORE", "--prior", "nobody.toml"], "cannot read nobody.toml"),
        (["next-view", "STORE", "--json", "no/where.json"], "the folder no does not exist"),
        (["path", "STORE", "--from", "0", "--to", "10"], "--limit"),
        (["path", "STORE", "--from", "0", "--to", "10", "--limit", "-1"], "a positive length, not -1"),
        (
            ["path", "STORE", "--from", "12", "--to", "10", "--limit", "1"],
            "--from 12: there is no such place",
        ),
        (["path", "STORE", "--from", "4", "--to", "10", "--limit", "1"], "--from 4: no camera can be there"),
        (
            ["path", "STORE", "--from", "0", "--to", "a", "--limit", "1"],
            "--to a: expected the number of a place",
        ),
        (["path", "STORE", "--from", "0", "--to", "10", "--limit", "1", "--odometry", "O"], "cannot read O"),
        (["path", "STORE", "--from", "0", "--to", "10", "--limit", "1", "--labels", "0"], "at least 1 label"),
        (
            ["path", "STORE", "--from", "0", "--to", "10", "--limit", "1", "--reach", "-2"],
            "the reach must be",
        ),
    ],
    ids=lambda value: " ".join(value[2:]) if isinstance(value, list) else "",
)
def test_mistakes_are_named_in_one_line(
    store: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.run([str(store) if word == "STORE" else word for word in arguments]) == 2
    captured = capsys.readouterr()
    assert words in captured.err
    assert captured.err.count("\n") == 1
    assert captured.out == ""


def test_both_draw_a_plan(store: Path, tmp_path: Path) -> None:
    views, way, none = (tmp_path / f"{name}.png" for name in ("views", "way", "none"))
    ways = ["--from", "0", "--to", "10"]
    assert cli.run(["next-view", str(store), "--budget", "2", "--have", "3", "--plot", str(views)]) == 0
    assert cli.run(["path", str(store), *ways, "--limit", "10", "--plot", str(way)]) == 0
    for file in (views, way):
        assert file.read_bytes().startswith(b"\x89PNG")
    assert cli.run(["path", str(store), *ways, "--limit", "1e-5", "--plot", str(none)]) == 1
    assert not none.exists()


def test_views_that_the_method_does_not_see_wholly_are_noted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dataset = small_dataset(shape=(2, 2), headings=2)
    dataset["no_bound"][:] = 1
    dataset.to_zarr(tmp_path / "blind.zarr", zarr_format=3, consolidated=False)
    assert cli.run(["next-view", str(tmp_path / "blind.zarr")]) == 0
    assert "no bound: the method cannot see something at 1 of these views" in capsys.readouterr().out
    ways = ["--from", "0", "--to", "3", "--limit", "100"]
    assert cli.run(["path", str(tmp_path / "blind.zarr"), *ways]) == 0
    assert "no bound: the method cannot see something at 2 of these views" in capsys.readouterr().out


def test_an_odometry_of_other_keys_and_a_store_of_another_layout_are_refused(
    store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "odometry.toml").write_text("translation_per_length = 1.0\n")
    ways = ["--from", "0", "--to", "10", "--limit", "1"]
    assert cli.run(["path", str(store), *ways, "--odometry", str(tmp_path / "odometry.toml")]) == 2
    assert "unknown key 'translation_per_length'; did you mean" in capsys.readouterr().err
    other = small_store(tmp_path / "other.zarr", shape=(1, 2), headings=1)
    description = other / "zarr.json"
    described = json.loads(description.read_text())
    described["attributes"]["schema"] = 999
    description.write_text(json.dumps(described))
    assert cli.run(["path", str(other), *ways]) == 2
    assert "but of 999" in capsys.readouterr().err


def test_a_damaged_store_is_named_with_what_is_wrong_in_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = small_store(tmp_path / "whole.zarr", shape=(2, 2), headings=2)

    def without_rank(store: Path) -> None:
        shutil.rmtree(store / "rank")

    def with_other_bytes(store: Path) -> None:
        for file in (store / "position_bound" / "c").rglob("*"):
            file.write_bytes(b"xx")

    def with_settings_cut(store: Path) -> None:
        described = json.loads((store / "zarr.json").read_text())
        described["attributes"]["settings"] = "{"
        (store / "zarr.json").write_text(json.dumps(described))

    for damage, words in (
        (without_rank, "it has no rank"),
        (with_other_bytes, "position_bound cannot be read"),
        (with_settings_cut, "its settings cannot be read"),
    ):
        store = tmp_path / f"{damage.__name__}.zarr"
        shutil.copytree(whole, store)
        damage(store)
        assert cli.run(["path", str(store), "--from", "0", "--to", "3", "--limit", "9"]) == 2
        said = capsys.readouterr().err
        assert f"damaged: {words}" in said
        assert "measure it again" in said
        assert said.count("\n") == 1


def test_nothing_is_written_into_a_store(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    described = (store / "zarr.json").read_bytes()
    for file in (store / "zarr.json", store / "new.json", store / "rank" / "zarr.json"):
        for arguments in (
            ["next-view", str(store)],
            ["path", str(store), *["--from", "0", "--to", "1", "--limit", "9"]],
        ):
            assert cli.run([*arguments, "--json", str(file)]) == 2
            said = capsys.readouterr().err
            assert "this is in a store of views; name a file elsewhere" in said
            assert said.count("\n") == 1
    assert (store / "zarr.json").read_bytes() == described
    assert not (store / "new.json").exists()


def test_pages_of_plans_have_their_answers_and_say_that_the_world_is_not_at_hand(
    store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("plotly")
    page = tmp_path / "<b> page.html"
    next_view = ["next-view", str(store), "--budget", "2", "--have", "3"]
    way = ["path", str(store), "--from", "0", "--to", "10", "--limit"]
    for arguments, code, words in (
        (next_view, 0, ["the common pose of one body", "1: view ", "taken: view 3", "of the best gain"]),
        ([*way, "100"], 0, ["on arrival", "largest bound", "place 0"]),
        ([*way, "1e-5"], 1, ["No path with this limit; the smallest that has one: "]),
    ):
        assert cli.run([*arguments, "--report", str(page)]) == code
        capsys.readouterr()
        text = page.read_text(encoding="utf-8")
        for each in (
            *words,
            "The world is not at hand",
            "12 places, coloured by",
            "mitsuba-crb " + arguments[0],
        ):
            assert each in text, each
        assert "<b> page" not in text
