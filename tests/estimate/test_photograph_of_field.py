"""Photographs of radiance fields: values as they are stored, and what an erroneous map makes of the bound."""

from __future__ import annotations

import dataclasses
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soft_blobs
from PIL import Image
from rich.console import Console
from scipy import ndimage, stats
from soft_blobs import POSE

from mitsuba_crb import se3
from mitsuba_crb.camera import Camera, Intrinsics
from mitsuba_crb.datasets.photographs import Capture, Photograph
from mitsuba_crb.estimate.align import align
from mitsuba_crb.estimate.photograph import PhotographAlignment, align_photograph
from mitsuba_crb.estimate.reduction import reduced
from mitsuba_crb.estimate.searched_field import SearchedField, reduced_world
from mitsuba_crb.export.documents import alignment_document, bound_document
from mitsuba_crb.information.subset import selected
from mitsuba_crb.measure.held_out import held_out_residuals
from mitsuba_crb.measure.report import bound_report
from mitsuba_crb.noise import Gaussian, estimate_noise
from mitsuba_crb.show.align_table import print_alignment
from mitsuba_crb.show.bound_table import print_report

SIGMA = 0.01
CAMERA = Intrinsics((48, 36), (45.0, 46.5), (24.75, 16.5))
PIXELS = selected(np.ones((36, 48), dtype=bool))
BLUR = 1.5


def field(seed: int = 0) -> Any:
    """Blobs within what eight bits hold."""
    blobs = soft_blobs.many(60, seed)
    return dataclasses.replace(blobs, colours=0.35 * blobs.colours)


def shown(world: Any, pose: Any) -> Any:
    return world.show(Camera.of(CAMERA), pose, PIXELS).values.reshape(36, 48, 3)


def blotches(seed: int) -> Any:
    """Grey errors that are alike over some pixels, of standard deviation 1."""
    noise = np.random.default_rng(seed).standard_normal((76, 88))
    smooth = ndimage.gaussian_filter(noise, BLUR)[20:-20, 20:-20, None]
    return smooth * 2.0 * np.sqrt(np.pi) * BLUR * np.ones(3)


def photographed(image: Any, seed: int, error: float = 0.0) -> Any:
    noise = np.random.default_rng(seed).standard_normal(image.shape)
    return image + SIGMA * noise + error * blotches(seed)


def written(file: Path, display: Any) -> Path:
    Image.fromarray(np.rint(255.0 * np.clip(display, 0.0, 1.0)).astype(np.uint8)).save(file)
    return file


def start(position: float, degrees: float, seed: int = 0, pose: Any = POSE) -> Any:
    direction = np.random.default_rng(seed).standard_normal((2, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return pose @ se3.exp(np.concatenate([position * direction[0], np.radians(degrees) * direction[1]]))


def capture_of(world: Any, folder: Path, count: int, error: float) -> Capture:
    photographs = []
    for seed in range(count):
        here = start(0.2, 4.0, 100 + seed)
        file = written(folder / f"{seed}.png", photographed(shown(world, here), 100 + seed, error))
        photographs.append(Photograph(str(seed), str(file), CAMERA, here))
    return Capture(tuple(photographs), (), tuple(range(count)), "all", "made", "ours")


def printed(answer: Callable[[Console], None]) -> str:
    console = Console(width=160, file=io.StringIO(), record=True)
    answer(console)
    return console.export_text()


def squared(found: PhotographAlignment, covariance: Any) -> float:
    error = se3.log(se3.inverse(POSE) @ found.alignment.pose)
    return float(error @ np.linalg.inv(covariance) @ error)


@pytest.mark.parametrize("seed", range(2))
def test_stored_values_are_the_fields_own(tmp_path: Path, seed: int) -> None:
    world = field()
    file = written(tmp_path / "photo.png", photographed(shown(world, POSE), seed))
    found = align_photograph(world, file, camera=CAMERA, pose=start(0.2, 4.0, seed))
    assert (found.verdict, found.display, found.settings["spp"]) == ("aligned", True, 0)
    assert squared(found, found.alignment.bound.covariance) < 28.0
    np.testing.assert_array_equal(found.alignment.tone.gain, 1.0)
    assert found.alignment.noise["sigma"] == pytest.approx(np.hypot(SIGMA, 1 / 255 / np.sqrt(12)), rel=0.06)
    document = alignment_document(found)
    json.dumps(document, allow_nan=False)
    assert document["residual_unit"] == "display values, white is 1"


def test_a_fields_exposure_can_be_fitted_if_asked(tmp_path: Path) -> None:
    world = field()
    file = written(tmp_path / "photo.png", photographed(1.2 * shown(world, POSE) + 0.03, 1))
    options: dict[str, Any] = {"camera": CAMERA, "pose": start(0.05, 1.0)}
    found = align_photograph(world, file, tone="common", **options)
    np.testing.assert_allclose(found.alignment.tone.gain, 1.2, rtol=0.02)
    np.testing.assert_allclose(found.alignment.tone.black, 0.03, atol=0.005)
    assert squared(found, found.alignment.bound.covariance) < 28.0
    known = align_photograph(world, file, **options)
    assert known.alignment.rms > 2.0 * found.alignment.rms


def test_a_reduced_photograph_is_compared_with_a_reduced_render() -> None:
    """Values and columns are those of the whole image, averaged likewise; masked pixels take no part."""
    world, mask = field(), np.ones((36, 48), dtype=bool)
    mask[:13, 20:29] = False
    whole = np.where(mask[..., None], shown(world, POSE), np.nan)
    coarse, small_image = reduced_world(world, Camera.of(CAMERA), whole)
    small = Camera.of(CAMERA.scaled((24, 18)))
    pixels = selected(np.ones((18, 24), dtype=bool))
    values, columns = coarse.columns(small, POSE, pixels)
    np.testing.assert_allclose(values, small_image.reshape(-1, 3))
    np.testing.assert_array_equal(small_image, reduced(whole, 2))
    np.testing.assert_array_equal(coarse.show(small, POSE, pixels).values, values)
    step = 1e-5
    for k in range(6):
        twist = step * np.eye(6)[k]
        two = [coarse.show(small, POSE @ se3.exp(sign * twist), pixels).values for sign in (1, -1)]
        difference = (two[0] - two[1]) / (2.0 * step)
        scale = np.nanmax(np.abs(difference))
        np.testing.assert_allclose(columns[..., k], difference, atol=1e-6 * scale)
    # The negative control: the field drawn in larger pixels.
    drawn = world.show(small, POSE, pixels).values
    assert np.nanmax(np.abs(drawn - values)) > 0.02


def test_a_search_asks_for_columns_once() -> None:
    world, camera = field(), Camera.of(CAMERA)
    searched = SearchedField(world)
    first = searched.columns(camera, POSE, PIXELS)
    assert searched.columns(camera, POSE, PIXELS, order=1)[1] is first[1]
    np.testing.assert_array_equal(first[1], world.columns(camera, POSE, PIXELS)[1])
    there = start(0.1, 1.0)
    np.testing.assert_array_equal(
        searched.columns(camera, there, PIXELS)[1], world.columns(camera, there, PIXELS)[1]
    )


def test_held_out_photographs_tell_noise_and_correlation(tmp_path: Path) -> None:
    world = field()
    options: dict[str, Any] = {"display": True, "tone": "known"}
    clean = held_out_residuals(world, capture_of(world, tmp_path, 6, 0.0), **options)
    images = np.stack(clean.residuals)
    expected = estimate_noise(images, by="channel")
    np.testing.assert_allclose(clean.noise.estimate, expected.estimate)
    np.testing.assert_allclose(clean.noise.standard_error, expected.standard_error)
    np.testing.assert_array_equal(clean.renderer, 0.0)
    assert clean.covariance().pixels_alike == pytest.approx(1.0, abs=0.5)
    (tmp_path / "map").mkdir()
    wrong = held_out_residuals(world, capture_of(world, tmp_path / "map", 6, 0.02), longest=24, **options)
    assert wrong.residuals[0].shape == (18, 24, 3)
    assert wrong.covariance().pixels_alike > 5.0


def test_the_bound_stands_beside_what_the_map_makes_of_it(tmp_path: Path) -> None:
    world = dataclasses.replace(field(), viewpoints=())
    capture = capture_of(world, tmp_path, 8, 0.02)
    report = bound_report(world, capture=capture, camera=CAMERA, pose=POSE)
    beside = report.misspecified
    assert beside is not None
    assert report.held_out is not None
    sigmas = np.sqrt(report.held_out.noise.estimate)
    np.testing.assert_allclose(sigmas, np.hypot(SIGMA, 0.02), rtol=0.1)
    np.testing.assert_allclose(beside.ideal.position_std, report.bound.position_std, rtol=1e-6)
    assert np.all(beside.ratios > 1.5)
    assert report.bound.provenance["noise"]["origin"] == "residuals of 8 photographs held out"
    document = bound_document(report.bound, report.hcr, beside, report.held_out)
    assert document["misspecified"]["gap"] == beside.gap
    assert document["held_out"]["names"] == [str(k) for k in range(8)]
    text = printed(lambda console: print_report(console, report))
    assert "1σ misspecified" in text
    assert "gap: misspecified deviations are" in text


def test_table_says_which_is_which(tmp_path: Path) -> None:
    world = field()
    file = written(tmp_path / "photo.png", photographed(shown(world, POSE), 5, 0.02))
    options: dict[str, Any] = {"camera": CAMERA, "pose": start(0.05, 1.0)}
    found = align_photograph(world, file, capture=capture_of(world, tmp_path, 6, 0.02), **options)
    text = printed(lambda console: print_alignment(console, found, ["one thing"]))
    for words in (
        "1σ ideal",
        "1σ misspecified",
        "deterministic renders",
        "held out",
        "note: one thing",
        "gap: ",
    ):
        assert words in text
    assert "tone" not in text


@pytest.mark.slow
def test_errors_by_an_erroneous_map_have_the_misspecified_covariance(tmp_path: Path) -> None:
    """100 photographs, S from 12 others; mean NEES in its 99.9 % band, that of the ideal bound outside."""
    world = field()
    others = held_out_residuals(
        world, capture_of(world, tmp_path, 12, 0.02), display=True, tone="known"
    ).covariance()
    image = shown(world, POSE)
    sandwich, ideal = [], []
    for seed in range(100):
        measured = photographed(image, 5000 + seed, 0.02)
        found = align(
            world,
            measured,
            Gaussian(0.0224),
            residuals=others,
            camera=CAMERA,
            pose=start(0.01, 0.2, seed),
        )
        assert found.status == "converged"
        error = se3.log(se3.inverse(POSE) @ found.pose)
        assert found.misspecified is not None
        sandwich.append(error @ np.linalg.inv(found.misspecified.covariance) @ error)
        ideal.append(error @ np.linalg.inv(found.bound.covariance) @ error)
    low, high = stats.chi2.ppf([0.0005, 0.9995], 600) / 100
    # S itself is known to some per cent from so few photographs.
    assert 0.9 * low < np.mean(sandwich) < 1.1 * high
    assert np.mean(ideal) > 2.0 * high
