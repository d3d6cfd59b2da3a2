"""The derivative check tells right from wrong, and says when it cannot tell."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from small_scenes import T, camera, scene, texture, textured_wall, torn_wall, wall

from mitsuba_crb import check_jacobian, fisher_information, pose_jacobian
from mitsuba_crb.errors import BlindSpotWarning, OptionError
from mitsuba_crb.information.blocks import BLOCK
from mitsuba_crb.jacobian import finite_difference, flow
from mitsuba_crb.jacobian.silhouettes import Contours
from mitsuba_crb.measure import check as checking
from mitsuba_crb.noise import Gaussian

FORWARD = {"methods": ("forward",)}


@pytest.mark.slow
def test_forward_passes_on_a_smooth_wall() -> None:
    check = check_jacobian(textured_wall(sensor=camera(48, 36)), spp=256, seed=1, **FORWARD)
    assert (check.verdict, check.exit_code) == ("agree", 0)
    assert check.detectable <= 0.05
    (row,) = check.rows
    assert row.ratio == pytest.approx(1.0, abs=0.05)
    assert np.all(row.difference < 0.1)
    assert "agree; would have seen" in str(check)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.BlindSpotWarning")
def test_forward_fails_on_a_nearest_texture() -> None:
    jumpy = scene(wall=wall(texture(filter_type="nearest")))
    check = check_jacobian(jumpy, spp=32, **FORWARD)
    assert (check.verdict, check.exit_code) == ("disagree", 1)
    assert np.all(check.rows[0].disagrees)
    assert np.all(np.abs(check.rows[0].ratio) < 0.01)
    assert check.rows[0].difference == pytest.approx(1.0, abs=0.05)


def board(name: str) -> dict[str, Any]:
    """A white board, a little turned, before nothing: all that is seen is its outline."""
    sensor = camera(24, 18)
    sensor["film"] |= {"rfilter": {"type": name}}
    placed = T().translate([0.1, 0.15, 3.0]).rotate([0, 0, 1], 20).rotate([0, 1, 0], 180).scale(0.7)
    glow = {"type": "area", "radiance": {"type": "rgb", "value": 1.0}}
    shape = {"type": "rectangle", "to_world": placed, "emitter": glow}
    return {"type": "scene", "camera": sensor, "board": shape}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["box", "tent", "gaussian"])
def test_flow_is_never_found_wrong_where_it_is_right_whatever_the_film(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The negative control counts contours twice, and lets no closure mend that."""
    options: dict[str, Any] = {"spp": 512, "batches": 8}
    check = check_jacobian(board(name), **options)
    (row,) = check.rows
    assert row.method == "flow"
    assert check.verdict != "disagree"
    assert np.all(np.abs(row.ratio - 1.0) < row.detectable)
    assert (check.paths is None) == (check.verdict == "agree")
    jump = Contours.jump
    monkeypatch.setattr(Contours, "jump", lambda *args: 2.0 * jump(*args))
    monkeypatch.setattr(flow, "suspects", lambda *args: np.zeros(len(args[-1].number), dtype=bool))
    wrong = check_jacobian(board(name), **options)
    assert wrong.exit_code == 1
    assert wrong.rows[0].disagrees[:3].all()


def test_a_camera_of_one_channel_is_checked_by_that_alone() -> None:
    """By the same random numbers as all three."""
    options: dict[str, Any] = {"spp": 8, "seed": 2}
    seen = textured_wall(sensor=camera(24, 18))
    colour, red = (
        check_jacobian(seen, channels=channels, **options).rows[0].ratio for channels in (None, "red")
    )
    assert np.all(red > 0.0)
    assert not np.array_equal(red, colour)


@pytest.mark.slow
def test_as_many_paths_as_it_says_decide() -> None:
    wall = textured_wall(sensor=camera(24, 16))
    few = check_jacobian(wall, spp=16, seed=2)
    assert few.verdict == "inconclusive"
    assert few.paths is not None
    assert f"about {few.paths} paths per pixel would tell" in str(few)
    assert few.rows[0].undecided.any()
    many = check_jacobian(wall, spp=2 * few.paths, seed=3)
    assert (many.verdict, many.paths, many.cure) == ("agree", None, "")


@pytest.mark.slow
def test_without_a_number_of_paths_it_goes_on_until_it_can_tell(
    monkeypatch: pytest.MonkeyPatch, scenes: Path
) -> None:
    """In rounds of fresh random numbers, whose last alone is the answer; or until its paths are spent."""
    boxes, rounds = scenes / "boxes" / "boxes.xml", []
    checked = checking._checked

    def observed(scene: Any, methods: Any, options: Any) -> Any:
        rounds.append((options["spp"], options["seed"], checked(scene, methods, options)))
        return rounds[-1][2]

    monkeypatch.setattr(checking, "_checked", observed)
    options: dict[str, Any] = {"size": (16, 12), "batches": 4}
    found = check_jacobian(boxes, seed=2, max_spp=300, **options)
    assert found is rounds[-1][2]
    assert [spp for spp, _, _ in rounds] == [64, 300]
    assert len({seed for _, seed, _ in rounds}) == 2
    assert (found.verdict, found.spp) == ("inconclusive", 300)
    assert found.cure == f"about {found.paths} paths per pixel would tell"
    alone = check_jacobian(boxes, spp=300, seed=rounds[-1][1], **options)
    np.testing.assert_array_equal(alone.rows[0].ratio, found.rows[0].ratio)
    # What tells ends it.
    rounds.clear()
    check_jacobian(textured_wall(sensor=camera(24, 16)), batches=4)
    *before, last = [found.verdict for _, _, found in rounds]
    assert last == "agree"
    assert set(before) <= {"inconclusive"}
    with pytest.raises(OptionError, match="leave out precision"):
        check_jacobian(boxes, precision=0.01)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.BlindSpotWarning")
def test_a_disagreement_that_few_paths_show_needs_no_more() -> None:
    found = check_jacobian(scene(wall=wall(texture(filter_type="nearest"))), batches=4, **FORWARD)
    assert (found.verdict, found.spp) == ("disagree", 64)


@pytest.mark.slow
def test_too_few_samples_are_inconclusive() -> None:
    check = check_jacobian(textured_wall(), spp=8, seed=3, **FORWARD)
    assert (check.verdict, check.exit_code) == ("inconclusive", 3)
    assert check.detectable > 0.05


@pytest.mark.slow
def test_columns_that_nobody_sees_do_not_count() -> None:
    plain = check_jacobian(scene(wall=wall()), spp=16, **FORWARD)
    assert plain.verdict == "inconclusive"
    assert np.all(np.isnan(plain.rows[0].ratio))


@pytest.mark.slow
def test_what_the_reference_does_not_see_is_no_alarm_and_no_agreement(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Finite differences without roll, beside flow with it; with it they agree."""
    options: dict[str, Any] = {"spp": 256, "seed": 3}
    wall = textured_wall(sensor=camera(24, 16))
    assert check_jacobian(wall, **options).verdict == "agree"
    column = finite_difference.column

    def blind(view: Any, pixels: Any, axis: int, *others: Any) -> Any:
        values, image = column(view, pixels, axis, *others)
        return (0.0 if axis == 5 else 1.0) * values, image

    monkeypatch.setattr(finite_difference, "column", blind)
    check = check_jacobian(wall, **options)
    assert (check.verdict, check.paths) == ("inconclusive", 1024)
    assert check.rows[0].undecided.tolist() == 5 * [False] + [True]


def test_steps_that_disagree_decide_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps as long as the filter is wide, at which a board's outline is washed out."""
    monkeypatch.setattr("mitsuba_crb.jacobian.finite_difference.step_for", lambda _: 0.6)
    check = check_jacobian(board("gaussian"), spp=256)
    assert (check.verdict, check.paths) == ("inconclusive", None)
    assert "finite differences by 0.6 and 1.2 pixels disagree" in str(check)
    assert np.all(np.isinf(check.reference_bias))  # of z because the longer step is cut


@pytest.mark.slow
@pytest.mark.parametrize(("pixels", "method"), [("random:0.5", "forward"), ("gradient:0.5", "flow")])
def test_all_methods_measure_the_same_of_some_pixels(pixels: str, method: str) -> None:
    """Other pixels, row by row, would differ by √2; what is left here is the noise of 96 paths."""
    check = check_jacobian(textured_wall(sensor=camera(24, 16)), methods=(method,), spp=96, pixels=pixels)
    assert check.disagreeing == []
    assert np.all(check.rows[0].difference < 0.1)


@pytest.mark.slow
def test_pixels_that_a_method_drops_are_left_out_of_its_comparison() -> None:
    """A texel of NaN spoils the pixels whose paths meet it, which are not the same for any two methods."""
    values = np.random.default_rng(0).uniform(0.1, 0.9, (64, 64, 3)).astype(np.float32)
    values[31, 31] = np.nan
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True}
    spoiled = scene(wall=wall(bitmap), sensor=camera(24, 16))
    options: dict[str, Any] = {"spp": 32, "batches": 4, "drop_invalid": True}
    left = [
        len(pose_jacobian(spoiled, method=method, seed=seed, **options).pixels)
        for method, seed in (("finite_difference", 1), ("flow", 2))
    ]
    assert left[0] != left[1]
    assert max(left) < 24 * 16
    check = check_jacobian(spoiled, methods=("flow",), **options)
    assert check.disagreeing == []
    assert np.all(check.rows[0].difference < 0.4)


def test_the_difference_has_the_errors_of_flow_s_blocks() -> None:
    """Whose pixels share samples; the negative control takes them for independent, as the reference's are."""
    scene, options = textured_wall(sensor=camera(24, 16)), {"spp": 32, "batches": 4}
    (row,) = check_jacobian(scene, methods=("flow",), **options).rows
    reference = pose_jacobian(scene, method="finite_difference", seed=1, **options)
    flow = pose_jacobian(scene, seed=2, **options)
    noise = Gaussian(float(reference.image.max()))
    fd = np.diag(fisher_information(flow, noise).matrix) / row.ratio
    expected = []
    for block in (BLOCK, 1):
        values = flow.batch_values - reference.batch_values
        left = fisher_information(
            dataclasses.replace(flow, batch_values=values, block=block, bias=None), noise
        )
        error = np.diag(left.standard_error)
        expected.append(0.5 * error / np.sqrt(np.maximum(np.diag(left.matrix), error) * fd))
    assert row.difference_standard_error == pytest.approx(expected[0], rel=1e-6)
    assert np.all(np.abs(row.difference_standard_error / expected[1] - 1.0) > 1e-3)


@pytest.mark.parametrize("pixels", ["random:0.3", "gradient:0.3"])
def test_methods_are_compared_at_the_same_pixels(pixels: str) -> None:
    """A choice that differs from run to run would make a method differ from itself."""
    check = check_jacobian(textured_wall(), methods=("flow",), spp=64, batches=4, pixels=pixels)
    assert check.verdict != "disagree"
    assert np.all(check.rows[0].difference < 0.3)


def test_what_is_not_finite_is_compared_nowhere() -> None:
    check = check_jacobian(torn_wall(), methods=("flow",), spp=64, batches=4, drop_invalid=True)
    assert check.verdict != "disagree"


def test_methods_that_do_not_exist_are_named() -> None:
    for methods in ((), ("magic",), ("finite_difference",)):
        with pytest.raises(OptionError, match="methods to check"):
            check_jacobian(textured_wall(), methods=methods)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "words", "seen_at_most"),
    [
        ("checkerboard_wall", "checkerboard", 0.001),
        pytest.param("boxes", "silhouettes", 0.35, marks=pytest.mark.slow),
        pytest.param("shadows", "shadows", 0.05, marks=pytest.mark.slow),
    ],
)
def test_what_forward_misses_on_shipped_scenes(
    name: str, words: str, seen_at_most: float, scenes: Path
) -> None:
    """The share of the information that forward sees; finite differences see all of it."""
    options: dict[str, Any] = {"spp": 64, "size": (48, 36)}
    with pytest.warns(BlindSpotWarning, match=words):
        check = check_jacobian(scenes / name / f"{name}.xml", **FORWARD, **options)
    assert check.verdict == "disagree"
    assert np.all(check.rows[0].ratio < seen_at_most)
