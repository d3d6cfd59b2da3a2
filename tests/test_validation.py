"""The derivative check tells right from wrong, and says when it cannot tell."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_scenes import camera, scene, texture, textured_wall, wall

from mitsuba_crb import check_jacobian
from mitsuba_crb.errors import BlindSpotWarning, OptionError

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
