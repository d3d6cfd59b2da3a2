"""The derivative check tells right from wrong, and says when it cannot tell."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from small_scenes import camera, scene, texture, textured_wall, torn_wall, wall

from mitsuba_crb import check_jacobian, fisher_information, pose_jacobian
from mitsuba_crb.errors import BlindSpotWarning, OptionError
from mitsuba_crb.information.blocks import BLOCK
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


@pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.BlindSpotWarning")
def test_forward_fails_on_a_nearest_texture() -> None:
    jumpy = scene(wall=wall(texture(filter_type="nearest")))
    check = check_jacobian(jumpy, spp=32, **FORWARD)
    assert (check.verdict, check.exit_code) == ("disagree", 1)
    assert np.all(check.rows[0].disagrees)
    assert np.all(np.abs(check.rows[0].ratio) < 0.01)
    assert check.rows[0].difference == pytest.approx(1.0, abs=0.05)


@pytest.mark.slow
def test_too_few_samples_are_inconclusive() -> None:
    check = check_jacobian(textured_wall(), spp=8, seed=3, **FORWARD)
    assert (check.verdict, check.exit_code) == ("inconclusive", 3)
    assert check.detectable > 0.05


def test_columns_that_nobody_sees_do_not_count() -> None:
    plain = check_jacobian(scene(wall=wall()), spp=16, **FORWARD)
    assert plain.verdict == "inconclusive"
    assert np.all(np.isnan(plain.rows[0].ratio))


@pytest.mark.parametrize(("pixels", "method"), [("random:0.5", "forward"), ("gradient:0.5", "flow")])
def test_all_methods_measure_the_same_of_some_pixels(pixels: str, method: str) -> None:
    """Other pixels, row by row, would differ by √2; what is left here is the noise of 96 paths."""
    check = check_jacobian(textured_wall(sensor=camera(24, 16)), methods=(method,), spp=96, pixels=pixels)
    assert check.disagreeing == []
    assert np.all(check.rows[0].difference < 0.1)


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
        left = fisher_information(dataclasses.replace(flow, batch_values=values, block=block), noise)
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
