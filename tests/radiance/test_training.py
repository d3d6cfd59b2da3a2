"""Training: it learns, goes on where it stopped, keeps its file whole, and refuses what does not fit."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import drjit as dr
import numpy as np
import pytest
import small_capture
from PIL import Image

from mitsuba_crb import load_capture, se3
from mitsuba_crb.camera import Camera
from mitsuba_crb.cli import app as cli
from mitsuba_crb.datasets.photographs import Capture
from mitsuba_crb.errors import CameraError, CaptureError, FieldError, OptionError, OutputError
from mitsuba_crb.export.targets import check_target
from mitsuba_crb.radiance import training
from mitsuba_crb.radiance.field_file import is_field, load_field
from mitsuba_crb.radiance.network import Design
from mitsuba_crb.radiance.training import Progress, Trained, train_field
from mitsuba_crb.render.backend import use_mitsuba

use_mitsuba()

DESIGN = Design(levels=3, features=2, coarsest=8, finest=64, table=2**12, hidden=16, cells=16, steps=96)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_capture.write_capture(tmp_path_factory.mktemp("capture") / "cloud")


@pytest.fixture(scope="module")
def capture(folder: Path) -> Capture:
    return load_capture(folder)


@pytest.fixture(autouse=True)
def small_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training, "SAMPLES", 2**14)
    monkeypatch.setattr(training, "_WARM", 10)
    monkeypatch.setattr(training, "_EVERY", 2)


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Threads add to the grid in no fixed order."""
    before = dr.thread_count()
    dr.set_thread_count(1)
    yield
    dr.set_thread_count(before)


def trained(capture: Capture, out: Path, steps: int, **options: object) -> Trained:
    return train_field(capture, out, steps=steps, design=DESIGN, **options)  # type: ignore[arg-type]


def test_it_learns_and_its_file_holds_all_of_it(capture: Capture, tmp_path: Path) -> None:
    seen: list[Progress] = []
    result = trained(capture, tmp_path / "field.npz", 80, on_progress=seen.append)
    assert len(seen) == 80
    assert seen[-1].fraction == 1.0
    assert seen[-1].train_psnr > seen[0].train_psnr + 0.7  # of the last 50 steps' mean error
    assert [name for name, _ in result.held_out] == [capture.photographs[k].name for k in capture.test]
    assert is_field(tmp_path / "field.npz")
    again = load_field(tmp_path / "field.npz")
    assert [v.name for v in again.viewpoints] == sorted(p.name for p in capture.photographs)
    assert again.viewpoints[0].intrinsics == capture.photographs[0].intrinsics
    camera_pose = again.viewpoints[4].pose
    camera = Camera.of(again.viewpoints[4].intrinsics)
    pixels = np.argwhere(np.ones((24, 24)))
    np.testing.assert_array_equal(
        again.show(camera, camera_pose, pixels).values, result.field.show(camera, camera_pose, pixels).values
    )
    json.dumps(again.provenance())


@pytest.mark.slow
def test_what_was_interrupted_goes_on_as_if_it_had_not(
    capture: Capture, tmp_path: Path, one_thread: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "_WARM", 4)
    whole = trained(capture, tmp_path / "whole.npz", 12).field

    def stop(at: Progress) -> None:
        if at.step == 7:
            raise KeyboardInterrupt

    monkeypatch.setattr(training, "_CHECKPOINT_S", -1.0)
    with pytest.raises(KeyboardInterrupt):
        trained(capture, tmp_path / "parts.npz", 12, on_progress=stop)
    left = load_field(tmp_path / "parts.npz")
    assert left.facts["steps"] == 7
    parts = trained(capture, tmp_path / "parts.npz", 12).field
    np.testing.assert_array_equal(parts.entries, whole.entries)
    np.testing.assert_array_equal(parts.vertices, whole.vertices)
    for name in whole.weights:
        np.testing.assert_array_equal(parts.weights[name], whole.weights[name])
    assert not np.array_equal(left.entries, whole.entries)
    other = trained(capture, tmp_path / "other.npz", 12, seed=1).field
    assert not np.array_equal(other.entries, whole.entries)


def test_what_is_done_is_not_done_again(capture: Capture, tmp_path: Path) -> None:
    first = trained(capture, tmp_path / "field.npz", 3)
    before = (tmp_path / "field.npz").read_bytes()
    second = trained(capture, tmp_path / "field.npz", 3)
    assert second.held_out == first.held_out
    assert (tmp_path / "field.npz").read_bytes() == before


@pytest.fixture(scope="module")
def field(capture: Capture, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A field's file."""
    out = tmp_path_factory.mktemp("field") / "field.npz"
    trained(capture, out, 1)
    return out


def changed(file: Path, **header: object) -> None:
    """Give a field's file another header."""
    with np.load(file) as held:
        arrays = dict(held)
    arrays["header"] = np.array(json.dumps(json.loads(str(arrays["header"])) | header))
    with file.open("wb") as target:
        np.savez(target, **arrays)


def overwritten(file: Path) -> None:
    """Write zeros into the middle of a file."""
    data = file.read_bytes()
    middle = len(data) // 2
    file.write_bytes(data[:middle] + bytes(1000) + data[middle + 1000 :])


class TestRefusals:
    def test_a_file_of_another_capture_or_other_settings_is_kept(
        self, capture: Capture, tmp_path: Path
    ) -> None:
        out = tmp_path / "field.npz"
        trained(capture, out, 1)
        before = out.read_bytes()
        with pytest.raises(FieldError, match="seed = 0, not 1"):
            trained(capture, out, 2, seed=1)
        with pytest.raises(FieldError, match="size = '24x24', not '12x12'"):
            trained(capture, out, 2, size=(12, 12))
        other = load_capture(small_capture.write_capture(tmp_path / "other", 11))
        with pytest.raises(FieldError, match="photographs = 9, not 11"):
            trained(other, out, 2)
        assert out.read_bytes() == before

    @pytest.mark.parametrize(
        ("damage", "words"),
        [
            (lambda file: file.write_bytes(file.read_bytes()[:3000]), "no field"),
            (lambda file: file.write_text("mine"), "no field"),
            (
                lambda file: changed(file, schema="mitsuba-crb/field/9"),
                "'mitsuba-crb/field/9', and this version",
            ),
            (lambda file: changed(file, schema="something/1"), "no field's"),
            (lambda file: changed(file, design={}), "damaged"),
            (lambda file: changed(file, viewpoints=[]), "damaged"),
            (overwritten, "damaged"),
        ],
        ids=["half", "text", "version", "other", "design", "cameras", "bytes"],
    )
    def test_damaged_files_and_other_versions(
        self, damage: Callable[[Path], object], words: str, capture: Capture, field: Path, tmp_path: Path
    ) -> None:
        out = tmp_path / "field.npz"
        out.write_bytes(field.read_bytes())
        damage(out)
        before = out.read_bytes()
        for read in (lambda: load_field(out), lambda: trained(capture, out, 2)):
            with pytest.raises(FieldError, match=words) as caught:
                read()
            assert "\n" not in str(caught.value)
        assert out.read_bytes() == before

    def test_no_other_output_takes_its_place(self, field: Path) -> None:
        with pytest.raises(OutputError, match="a trained field that would be lost"):
            check_target(field, "--json")
        check_target(field, "--out", resumes=True)

    def test_impossible_lengths(self, capture: Capture, tmp_path: Path) -> None:
        with pytest.raises(OptionError, match="minutes"):
            train_field(capture, tmp_path / "f.npz", minutes=0.0)
        with pytest.raises(OptionError, match="step"):
            train_field(capture, tmp_path / "f.npz", steps=0)

    def test_another_shape(self, capture: Capture, tmp_path: Path) -> None:
        with pytest.raises(CameraError, match="another shape"):
            trained(capture, tmp_path / "f.npz", 1, size=(12, 20))

    def test_nothing_to_train_on(self, tmp_path: Path) -> None:
        alone = load_capture(small_capture.write_capture(tmp_path / "one", 1))
        with pytest.raises(CaptureError, match="none to train on"):
            trained(alone, tmp_path / "f.npz", 1)

    def test_too_little_memory(
        self, capture: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("os.sysconf", lambda name: 40)
        with pytest.raises(CaptureError, match="choose a smaller --size"):
            trained(capture, tmp_path / "f.npz", 1)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["{folder}/nothing", "--out", "{out}"], "No such file"),
        (["{empty}", "--out", "{out}"], "no posed photographs"),
        (["{folder}", "--out", "{out}", "--size", "12"], "--size"),
        (["{folder}", "--out", "{out}", "--minutes", "-1"], "minutes"),
        (["{folder}", "--out", "{empty}"], "folder"),
        (["{folder}", "--out", "{text}"], "no field"),
    ],
)
def test_the_command_refuses_in_one_line(
    arguments: list[str], words: str, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "text").write_text("mine")
    places = {name: str(tmp_path / name) for name in ("out", "empty", "text")} | {"folder": str(folder)}
    assert cli.run(["train", *(argument.format(**places) for argument in arguments)]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert words in err
    assert (tmp_path / "text").read_text() == "mine"
    assert not (tmp_path / "out").exists()


def test_the_command_refuses_missing_and_mismatched_images(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = small_capture.write_capture(tmp_path / "cloud")
    Image.new("RGB", (20, 24)).save(folder / "images" / "3.png")
    assert cli.run(["train", str(folder), "--out", str(tmp_path / "f.npz")]) == 2
    assert "3.png has 20x24" in capsys.readouterr().err
    (folder / "images" / "3.png").unlink()
    assert cli.run(["train", str(folder), "--out", str(tmp_path / "f.npz")]) == 2
    assert "missing" in capsys.readouterr().err


def test_the_command_trains_prints_a_table_and_says_when_it_is_stopped(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "_design_for", lambda _: DESIGN)
    arguments = ["train", str(folder), "--out", str(tmp_path / "f.npz"), "--steps", "3"]
    assert cli.run(arguments) == 0
    out = capsys.readouterr().out
    for word in ("PSNR", "images/0.png", "mean", "3 steps", "24x24", "display-referred"):
        assert word in out

    def stopped(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(training, "descend", stopped)
    before = (tmp_path / "f.npz").read_bytes()
    assert cli.run([*arguments[:-1], "9"]) == 130
    assert "interrupted" in capsys.readouterr().err
    assert (tmp_path / "f.npz").read_bytes() == before


@pytest.mark.slow
@pytest.mark.parametrize("transparent", [False, True])
def test_a_trained_field_shows_views_it_has_not_seen_and_its_columns_are_differences(
    transparent: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "SAMPLES", 2**16)
    monkeypatch.setattr(training, "_WARM", 100)
    cloud = load_capture(small_capture.write_capture(tmp_path / "cloud", 25, transparent=transparent))
    result = trained(cloud, tmp_path / "field.npz", 600)
    assert result.psnr > 27.0
    field = result.field
    assert field.background == ((1.0,) * 3 if transparent else (0.0,) * 3)
    viewpoint = next(v for v in field.viewpoints if v.name == result.held_out[0][0])
    camera, pose = Camera.of(viewpoint.intrinsics), viewpoint.pose
    pixels = np.argwhere(np.ones((24, 24)))
    shown = field.show(camera, pose, pixels)
    opaque = small_capture.shown(pose)[1][pixels[:, 1], pixels[:, 0]]
    if transparent:
        assert np.abs(shown.opacity - opaque).mean() < 0.03
    assert np.nanmedian(shown.depth[opaque > 0.99]) == pytest.approx(2.5, abs=0.2)
    columns = field.columns(camera, pose, pixels)[1]
    step = 1e-4  # a thousandth of a pixel: slopes jump where cells meet, and a step crosses some
    for k in range(6):
        twist = step * np.eye(6)[k]
        ahead, back = (field.show(camera, pose @ se3.exp(s * twist), pixels).values for s in (1.0, -1.0))
        wanted, found = (ahead - back) / (2.0 * step), columns[..., k]
        assert (found * wanted).sum() / (found**2).sum() == pytest.approx(1.0, abs=0.01)
        assert np.corrcoef(found.ravel(), wanted.ravel())[0, 1] > 0.999
