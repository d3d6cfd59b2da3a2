"""Trials on a small wall: the estimator attains the bound, twice the noise does not, and runs resume."""

from __future__ import annotations

import inspect
import io
import json
import math
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from small_scenes import camera, textured_wall, torn_wall

from mitsuba_crb.bound.consistency import Consistency, consistency
from mitsuba_crb.errors import BlindSpotWarning, OptionError, OutOfViewError, RadianceError, TrialError
from mitsuba_crb.estimate import trial, trials
from mitsuba_crb.estimate.align import align
from mitsuba_crb.estimate.renderer_part import renderer_part
from mitsuba_crb.estimate.trial_record import SCHEMA, recorded
from mitsuba_crb.estimate.trials import validate
from mitsuba_crb.export.documents import validation_document, write_json
from mitsuba_crb.information.symmetric import unpack
from mitsuba_crb.measure import measurement as measure
from mitsuba_crb.show.trials_page import validation_figure
from mitsuba_crb.show.trials_table import print_validation

OPTIONS: dict[str, Any] = {"size": (16, 12), "spp": 32, "sigma": 0.005, "perturb_deg": 0.2, "seed": 5}


@pytest.mark.slow
def test_gauss_newton_attains_the_bound_and_another_sigma_is_found_out(tmp_path: Path) -> None:
    options = OPTIONS | {"trials": 24, "confidence": 0.999, "resume": tmp_path / "trials.json"}
    found = validate(textured_wall(), **options)
    assert found.failed == ()
    assert found.consistency.consistent
    assert found.excess < 0.1
    assert found.rmse_rotation_deg == pytest.approx(found.bound_rotation_deg, rel=0.35)
    # Negative control: the same errors beside the bound of half the noise.
    other = validate(textured_wall(), assumed_sigma=0.0025, **options)
    assert [t.error for t in other.trials] == [t.error for t in found.trials]
    assert not other.consistency.consistent
    assert other.consistency.nees == pytest.approx(4.0 * found.consistency.nees)
    document = json.loads(json.dumps(validation_document(found), allow_nan=False))
    assert document["schema"] == SCHEMA
    assert {"nees_band", "generalized_eigenvalues", "wishart_band", "coverage"} <= document.keys()


@pytest.mark.slow
def test_an_interrupted_run_resumes_to_the_same_result(tmp_path: Path) -> None:
    file = tmp_path / "trials.json"
    whole = validate(textured_wall(), trials=8, **OPTIONS)

    def interrupt(done: int, total: int) -> None:
        if done >= 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        validate(textured_wall(), trials=8, resume=file, on_trial=interrupt, **OPTIONS)
    calls: list[int] = []
    resumed = validate(
        textured_wall(), trials=8, resume=file, on_trial=lambda done, total: calls.append(done), **OPTIONS
    )
    assert calls == [8]
    assert [t.error for t in resumed.trials] == [t.error for t in whole.trials]
    before = file.read_bytes()
    with pytest.raises(TrialError, match=r"sigma = 0\.005, not 0\.02"):
        validate(textured_wall(), trials=8, resume=file, **(OPTIONS | {"sigma": 0.02}))
    with pytest.raises(TrialError, match=r"integrator = .PathIntegrator.*, not .DirectIntegrator"):
        validate(textured_wall(), trials=8, resume=file, integrator="direct", **OPTIONS)
    assert file.read_bytes() == before


@pytest.mark.slow
def test_what_the_method_cannot_see_is_said_once_even_if_a_trial_fails(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise OptionError("it failed")

    monkeypatch.setattr(trial, "align", fail)
    cut = textured_wall(sensor=camera(16, 12) | {"near_clip": 3.0})
    with pytest.warns(BlindSpotWarning) as caught, pytest.raises(OptionError):
        validate(cut, trials=8, method="forward", **OPTIONS)
    said = [str(warning.message) for warning in caught]
    assert any("near plane" in text for text in said)
    assert len(said) == len(set(said))


@pytest.mark.slow
def test_a_smaller_number_of_trials_loses_none(tmp_path: Path) -> None:
    file = tmp_path / "trials.json"
    many = validate(textured_wall(), trials=10, resume=file, **OPTIONS)
    few = validate(textured_wall(), trials=8, resume=file, **OPTIONS)
    assert few.trials == many.trials[:8]
    assert few.further == many.trials[8:]
    assert few.consistency.count == 8
    assert [result["index"] for result in validation_document(few)["results"]] == list(range(10))
    # As the command does at its end; a longer run then computes what is missing and nothing else.
    file.write_text(json.dumps(validation_document(few)))
    calls: list[tuple[int, int]] = []
    options = OPTIONS | {"on_trial": lambda done, total: calls.append((done, total))}
    again = validate(textured_wall(), trials=10, resume=file, **options)
    assert again.trials == many.trials
    assert calls == []
    validate(textured_wall(), trials=11, resume=file, **options)
    assert calls == [(11, 11)]
    validate(textured_wall(), trials=7, resume=file, **options)
    assert len(json.loads(file.read_text())["results"]) == 11


@pytest.mark.slow
def test_two_runs_that_write_one_file_lose_nothing_of_each_other(tmp_path: Path) -> None:
    file = tmp_path / "trials.json"
    others: list[Any] = []

    def meanwhile(done: int, total: int) -> None:
        if not others:
            others.append(validate(textured_wall(), trials=12, resume=file, **OPTIONS))

    validate(textured_wall(), trials=8, resume=file, on_trial=meanwhile, **OPTIONS)
    assert [result["index"] for result in json.loads(file.read_text())["results"]] == list(range(12))


def _left_half() -> Any:
    mask = np.zeros((12, 16), dtype=bool)
    mask[:, :8] = True
    return mask


@pytest.mark.slow
@pytest.mark.parametrize(
    ("before", "change", "message"),
    [
        ({}, {"drop_invalid": True}, "drop_invalid = False, not True"),
        ({"method": "finite_difference"}, {"step_pixels": 0.3}, r"step_pixels = 0\.15, not 0\.3"),
        ({"pixels": _left_half()}, {"pixels": ~_left_half()}, "pixels.mask = "),
        ({}, {"pixels": "random:0.5"}, "pixels.kind = 'all', not 'only', pixels.selected = 192, not 96"),
        ({}, {"iterations": 29, "seed": 6}, "iterations = 30, not 29, seed = 5, not 6"),
    ],
)
def test_what_changes_a_result_is_not_resumed(tmp_path: Path, before: Any, change: Any, message: str) -> None:
    file, options = tmp_path / "trials.json", OPTIONS | {"spp": 16, "trials": 7} | before
    validate(textured_wall(), resume=file, **options)
    kept = file.read_bytes()
    with pytest.raises(TrialError, match=message):
        validate(textured_wall(), resume=file, **(options | change))
    assert file.read_bytes() == kept


@pytest.mark.slow
def test_another_scene_under_the_same_name_is_not_resumed(tmp_path: Path, scenes: Path) -> None:
    for name in ("textured_wall.xml", "paint.exr"):
        shutil.copy(scenes / "textured_wall" / name, tmp_path)
    path, file = tmp_path / "textured_wall.xml", tmp_path / "trials.json"
    options = OPTIONS | {"spp": 16, "trials": 7, "resume": file}
    validate(path, **options)
    text = path.read_text()
    path.write_text(text.replace("</scene>", "<!-- edited --></scene>"))
    with pytest.raises(TrialError, match=r"scene_contents = '\w+', not '\w+'; name another file"):
        validate(path, **options)
    path.write_text(text)
    validate(path, **options)
    shutil.copy(scenes / "warehouse" / "lanes.exr", tmp_path / "paint.exr")
    with pytest.raises(TrialError, match="scene_contents"):
        validate(path, **options)
    file.unlink()
    validate(textured_wall(), **options)
    with pytest.raises(TrialError, match="scene_contents"):
        validate(textured_wall(sphere={"type": "sphere", "center": [0, 0, 2], "radius": 0.1}), **options)


def test_other_versions_are_named_and_not_resumed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options = OPTIONS | {"spp": 16, "trials": 7, "resume": tmp_path / "trials.json"}
    validate(textured_wall(), **options)
    others = {**measure.versions(), "mitsuba": "3.8.0"}
    monkeypatch.setattr(measure, "versions", lambda: others)
    with pytest.raises(TrialError, match=r"versions\.mitsuba = '[\d.]+', not '3\.8\.0'; name another file"):
        validate(textured_wall(), **options)


def test_every_option_that_changes_a_result_is_among_the_settings(tmp_path: Path) -> None:
    """`tile` bounds memory only; `exposure` acts by sigma, a precision by `spp`; trials never clip, and are
    of colour; a calibration is there if one is given."""
    found = validate(textured_wall(), **(OPTIONS | {"spp": 16, "trials": 7}))
    options = set(measure.MeasurementOptions.__annotations__)
    assert options - found.settings.keys() == {
        *("tile", "on_tile", "on_progress", "on_round"),
        *("exposure", "clip", "precision", "max_spp"),
        "camera",
        *("channels", "measure", "depth_sigma", "depth_range", "depth_edges"),
    }
    arguments = inspect.signature(validate).parameters.keys() - found.settings.keys()
    judging = {"trials", "assumed_sigma", "confidence", "workers", "resume", "on_trial", "options"}
    assert arguments == judging


@pytest.mark.slow
@pytest.mark.parametrize("levels", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_the_bound_is_that_of_the_pixels_that_the_estimator_has(levels: int) -> None:
    options = OPTIONS | {"size": (24, 18), "trials": 24, "confidence": 0.999, "levels": levels}
    found = validate(textured_wall(), pixels="random:0.3", **options)
    assert found.settings["pixels"].items() >= {"kind": "only", "selected": 130, "total": 432}.items()
    assert found.bound.information.selection.kind == "only"
    assert found.failed == ()
    low, high = found.consistency.nees_band
    assert low < found.consistency.nees / (1.0 + found.excess) < high
    # Negative control: beside the bound of the whole image, which the pixels sample, the errors are large.
    F = found.bound.information
    whole = consistency(found.errors, replace(F, matrix=F.matrix * 432 / 130), confidence=0.999)
    assert whole.nees / (1.0 + found.excess) > high


@pytest.mark.slow
def test_pixels_that_are_not_finite_belong_neither_to_trials_nor_to_the_bound() -> None:
    options = OPTIONS | {"size": (24, 18), "trials": 24, "confidence": 0.999}
    with pytest.raises(RadianceError, match="drop_invalid"):
        validate(torn_wall(), **options)
    found = validate(torn_wall(), drop_invalid=True, **options)
    selection = found.bound.information.selection
    assert selection.kind == "only"
    assert 0 < selection.selected < 400
    assert selection.description == "all, where the radiance is finite"
    assert found.settings["pixels"]["selected"] == selection.selected
    assert max(trial.invalid for trial in found.trials) < 0.05 * selection.selected
    low, high = found.consistency.nees_band
    assert found.failed == ()
    assert low < found.consistency.nees / (1.0 + found.excess) < high


BOXES: dict[str, Any] = {"size": (16, 12), "integrator": {"type": "path", "max_depth": 4}, "seed": 5}


@pytest.mark.slow
def test_where_the_renderers_noise_decides_the_verdict_is_inconclusive(scenes: Path) -> None:
    """Few paths among edges and in indirect light are neither an agreement nor an alarm."""
    noisy = validate(scenes / "boxes" / "boxes.xml", trials=16, spp=16, **BOXES)
    assert noisy.excess > 0.2
    assert (noisy.verdict, noisy.exit_code) == ("inconclusive", 3)
    assert noisy.renderer.times > 1
    assert noisy.cure == f"about {16 * noisy.renderer.times} paths per pixel would tell"
    document = validation_document(noisy)
    assert (document["verdict"], document["cure"]) == ("inconclusive", noisy.cure)
    text = io.StringIO()
    print_validation(Console(file=text, width=200), noisy)
    # Bands alone say otherwise: the verdict overturns them, and stands before them.
    assert text.getvalue().index("inconclusive") < text.getvalue().index("NEES, mean")
    assert noisy.cure in validation_figure(noisy).get_suptitle()


@pytest.mark.slow
def test_a_wrong_bound_is_inconsistent_and_the_verdict_stands_below_the_table() -> None:
    """Negative control: information scaled by 1.5 is that of less noise, by a root of 1.5."""
    options = OPTIONS | {"trials": 80, "size": (12, 9), "spp": 64}
    found = validate(textured_wall(), assumed_sigma=0.005 / math.sqrt(1.5), **options)
    assert (found.verdict, found.exit_code, found.cure) == ("inconsistent", 1, "")
    text = io.StringIO()
    print_validation(Console(file=text, width=200), found)
    assert text.getvalue().index("not as the bound says") > text.getvalue().index("NEES, mean")
    right = validate(textured_wall(), **options)
    assert (right.verdict, right.exit_code, right.cure) == ("consistent", 0, "")


@pytest.mark.slow
def test_without_a_number_of_paths_the_renderers_part_is_made_small(tmp_path: Path, scenes: Path) -> None:
    """The same number, when resumed, and the same trials as with that number."""
    boxes, file = scenes / "boxes" / "boxes.xml", tmp_path / "trials.json"
    found = validate(boxes, trials=7, resume=file, **BOXES)
    assert found.settings["spp"] > 64
    assert found.excess < 0.1
    calls: list[int] = []
    options = BOXES | {"on_trial": lambda done, total: calls.append(done)}
    again = validate(boxes, trials=7, resume=file, **options)
    assert calls == []
    assert again.settings == found.settings
    given = validate(boxes, trials=7, resume=file, spp=found.settings["spp"], **options)
    assert calls == []
    assert given.trials == found.trials
    few = validate(boxes, trials=7, max_spp=66, precision=0.01, **BOXES)
    assert few.settings["spp"] == 64  # a multiple of the batches
    assert (few.renderer.limit, few.verdict) == (0.01, "inconclusive")


@pytest.mark.slow
def test_a_room_with_light_of_several_bounces_is_consistent(scenes: Path) -> None:
    """Boxes by path tracing, without a number of paths; beside 1.5 times the information they are not."""
    path, integrator = scenes / "boxes" / "boxes.xml", {"type": "path", "max_depth": 4}
    found = validate(path, size=(32, 24), integrator=integrator, trials=60, seed=3, workers=None)
    assert found.settings["spp"] > 64
    assert (found.verdict, found.failed) == ("consistent", ())
    F = found.bound.information
    added = unpack(np.mean([t.added for t in found.trials], axis=0))
    wrong = renderer_part(found.errors, replace(F, matrix=1.5 * F.matrix), added)
    assert wrong.verdict == "inconsistent"


@pytest.mark.slow
def test_the_number_of_processes_changes_nothing(scenes: Path) -> None:
    path = scenes / "textured_wall" / "textured_wall.xml"
    more_than_cores = (os.cpu_count() or 1) + 1
    one, many = (validate(path, trials=9, workers=n, **OPTIONS) for n in (1, more_than_cores))
    np.testing.assert_array_equal(one.errors, many.errors)


def _inside(found: Consistency) -> dict[str, Any]:
    low, high = found.wishart_band.T
    return {
        "nees": found.nees_band[0] <= found.nees <= found.nees_band[1],
        "ratios": (low <= found.generalized_eigenvalues) & (found.generalized_eigenvalues <= high),
        "coverage": [c.low <= c.nominal <= c.high for c in found.coverage],
    }


@pytest.mark.slow
def test_gauss_newton_attains_the_bound_in_the_textured_room(scenes: Path) -> None:
    """400 trials, as in benchmarks/paper/calibration.py, which has two more seeds of them."""
    path = scenes / "textured_room" / "textured_room.xml"
    options: dict[str, Any] = {"size": (32, 24), "spp": 256, "sigma": 0.05, "perturb_deg": 0.2}
    # The room's direct light again, with less noise for the time.
    options["integrator"] = {"type": "direct", "emitter_samples": 4, "bsdf_samples": 0}
    found = validate(path, trials=400, confidence=0.999, workers=None, **options)
    assert found.failed == ()
    assert found.excess < 0.02
    inside = _inside(found.consistency)
    assert inside["nees"]
    assert all(inside["ratios"])
    assert all(inside["coverage"])
    # Negative control: beside the bound of half the noise the same errors fail in everything.
    F = found.bound.information
    other = _inside(consistency(found.errors, replace(F, matrix=4.0 * F.matrix), confidence=0.999))
    assert not other["nees"]
    assert not any(other["ratios"])
    assert not any(other["coverage"])


@pytest.mark.slow
def test_the_renderers_noise_adds_the_variance_that_is_said_and_no_bias(scenes: Path) -> None:
    """With a sixteenth of the paths errors have twice the bound's variance.

    What is said is its first order, 1.6 times, and the verdict leaves room for the next.
    """
    path = scenes / "textured_room" / "textured_room.xml"
    options: dict[str, Any] = {"size": (32, 24), "spp": 16, "sigma": 0.02, "perturb_deg": 0.2, "seed": 5}
    options["integrator"] = {"type": "direct", "emitter_samples": 4, "bsdf_samples": 0}
    found = validate(path, trials=60, confidence=0.999, **options)
    low, high = found.consistency.nees_band
    assert found.excess > 0.4
    assert found.consistency.nees > high
    next_order = found.excess**2 / (1.0 + found.excess)
    assert low < found.consistency.nees / (1.0 + found.excess) < high * (1.0 + next_order)
    assert found.verdict == "inconclusive"
    assert np.abs(found.consistency.bias).max() < 4.0  # Student's t, six of them: one in 1000 runs


@pytest.mark.slow
def test_far_starts_fail_and_are_counted_apart() -> None:
    options = OPTIONS | {"perturb_deg": 14.0, "perturb_trans": 0.1, "iterations": 12, "spp": 16}
    found = validate(textured_wall(), trials=30, **options)
    assert found.failed
    assert found.consistency.count == 30 - len(found.failed)
    # Those that are left are right: no one of them is at a wrong minimum.
    assert found.consistency.nees < 6.0 * 3.0


@pytest.mark.slow
def test_a_start_that_sees_nothing_is_a_failed_trial(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """And every trial may go through levels."""
    seen: list[int] = []

    def behind_the_wall(*args: Any, **options: Any) -> Any:
        seen.append(options["levels"])
        if len(seen) == 3:
            raise OutOfViewError("nothing to be seen")
        return align(*args, **options)

    monkeypatch.setattr(trial, "align", behind_the_wall)
    found = validate(textured_wall(), trials=8, levels=1, **(OPTIONS | {"size": (32, 24), "spp": 16}))
    assert seen == [1] * 8
    assert found.failed == (2,)
    assert found.trials[2].status == "diverged"
    file = tmp_path / "trials.json"
    write_json(file, validation_document(found))
    record = recorded(file)
    assert record is not None
    assert tuple(record.trials) == found.trials


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"trials": 0}, TrialError, "at least 7"),
        ({"trials": 8, "perturb_deg": -1.0}, TrialError, "negative"),
        ({"trials": 8, "workers": 0}, OptionError, "worker"),
    ],
)
def test_impossible_trials_are_refused(change: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        validate(textured_wall(), **(OPTIONS | change))


RECORD = f'{{"schema": "{SCHEMA}", "settings": {{}}, "results": %s}}'
RESULT = (
    '[{"index": %s, "status": "%s", "error": %s, "residual": 1, "iterations": 1, "excess": 0, "added": %s, '
    '"invalid": 0}]'
)


@pytest.mark.parametrize(
    "text",
    [
        "not json",
        '{"schema": "other/1", "settings": {}, "results": []}',
        f'{{"schema": "{SCHEMA}", "settings": 3, "results": []}}',
        "[]",
        RECORD % "3",
        RECORD % "[3]",
        RECORD % '[{"index": 0}]',
        RECORD % RESULT % ("Infinity", "converged", [0] * 6, [0] * 21),
        RECORD % RESULT % (0, "confused", [0] * 6, [0] * 21),
        RECORD % RESULT % (0, "converged", [0] * 5, [0] * 21),
        RECORD % RESULT % (0, "converged", [0] * 6, [0] * 20),
        RECORD % RESULT % (0, "converged", [[]] * 6, [0] * 21),
    ],
)
def test_a_file_that_is_no_record_of_trials_is_left_alone_and_nothing_rendered(
    tmp_path: Path, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trials, "truth_of", None)
    file = tmp_path / "something.json"
    file.write_text(text)
    with pytest.raises(TrialError, match="name another file"):
        validate(textured_wall(), trials=8, resume=file, **OPTIONS)
    assert file.read_text() == text
