"""Estimated poses: they come back to the truth, from further away with levels, and say when they do not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from scipy import stats
from small_scenes import scene, textured_wall, torn_wall, wall

from mitsuba_crb import pose_bound, pose_jacobian, se3
from mitsuba_crb.errors import AlignmentError, NoiseError, RadianceError
from mitsuba_crb.estimate.align import Alignment, align
from mitsuba_crb.estimate.misfit import Anchor
from mitsuba_crb.estimate.trials import validate
from mitsuba_crb.information.linearisation import PixelSelection
from mitsuba_crb.information.subset import selected
from mitsuba_crb.measure.measurement import measurement
from mitsuba_crb.noise import SRGB, ColourBlocks, Gaussian, PerPixel, PoissonGaussian, Sensor
from mitsuba_crb.render.pixels import render_pixels
from mitsuba_crb.render.scene import as_scene
from mitsuba_crb.render.view import open_view

SIGMA = Gaussian(0.01)
SIZE = (32, 24)


@pytest.fixture(scope="module")
def textured() -> Any:
    return as_scene(textured_wall())[0]


@pytest.fixture(scope="module")
def truth(textured: Any) -> Anchor:
    """The expected image at the scene's own pose."""
    with open_view(textured) as view:
        pixels = np.stack(np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1])), axis=-1).reshape(-1, 2)
        image = render_pixels(view, pixels, spp=2048, seed=77)
        return Anchor(view.pose, image.reshape(1, SIZE[1], SIZE[0], 3))


def _measured(truth: Anchor, seed: int = 0) -> Any:
    noise = np.random.default_rng(seed).standard_normal(truth.batches.shape[1:])
    return truth.batches[0] + SIGMA.sigma * noise


def _start(truth: Anchor, position: float, degrees: float, seed: int = 0) -> Any:
    direction = np.random.default_rng(seed).standard_normal((2, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return truth.pose @ se3.exp(np.concatenate([position * direction[0], np.radians(degrees) * direction[1]]))


def _nees(found: Alignment, truth: Anchor) -> float:
    error = se3.log(se3.inverse(truth.pose) @ found.pose)
    return float(error @ found.bound.information.matrix @ error)


@pytest.mark.parametrize("estimator", ["gauss_newton", "levenberg_marquardt"])
def test_the_truth_is_found_to_within_the_bound(textured: Any, truth: Anchor, estimator: str) -> None:
    start = _start(truth, 0.05, 1.0)
    found = align(textured, _measured(truth), SIGMA, estimator=estimator, anchor=truth, spp=64, pose=start)
    assert found.status == "converged"
    assert abs(found.residual - 1.0) < 0.1  # 2304 values: its standard deviation is 0.015
    # The 99.99 % quantile of χ² with 6 degrees of freedom, widened by the renderer's own noise.
    assert _nees(found, truth) < 28.0 * (1.0 + found.excess)
    assert _nees(found, Anchor(start, truth.batches)) > 1000.0  # it did move


def test_without_an_anchor_the_excess_says_what_the_renderers_noise_costs(
    textured: Any, truth: Anchor
) -> None:
    found = align(textured, _measured(truth), SIGMA, spp=64, pose=_start(truth, 0.02, 0.3))
    tied = align(textured, _measured(truth), SIGMA, spp=64, pose=_start(truth, 0.02, 0.3), anchor=truth)
    assert found.excess > tied.excess > 0.0
    assert _nees(found, truth) < 28.0 * (1.0 + found.excess)


@pytest.mark.slow
def test_levels_reach_further(textured: Any, truth: Anchor) -> None:
    reached = {0: 0, 1: 0}
    for levels in reached:
        for seed in range(6):
            start = _start(truth, 0.4, 12.0, seed)
            found = align(
                textured,
                _measured(truth),
                SIGMA,
                anchor=truth,
                spp=16,
                pose=start,
                levels=levels,
                iterations=15,
            )
            right = _nees(found, truth) < 28.0 * (1.0 + found.excess)
            reached[levels] += right
            # What went elsewhere does not claim to fit.
            assert right or found.status != "converged" or found.residual > 1.2
    assert reached[1] > reached[0]


@pytest.mark.slow
def test_levels_reach_further_with_scattered_pixels(scenes: Path) -> None:
    """Reduced images are made of three in ten pixels."""
    room, noise = as_scene(scenes / "textured_room" / "textured_room.xml")[0], Gaussian(0.05)
    options: dict[str, Any] = {"size": (64, 48), "pixels": "random:0.3", "spp": 16, "iterations": 20}
    with measurement(room, size=options["size"]) as run:
        image = render_pixels(run.view, selected(run.mask), spp=1024, seed=77).reshape(1, 48, 64, 3)
        truth, depth = Anchor(run.view.pose, image), run.length_scale
    reached = {0: 0, 2: 0}
    for levels in reached:
        for seed in range(4):
            measured = image[0] + noise.sigma * np.random.default_rng(seed).standard_normal(image[0].shape)
            options |= {"pose": _start(truth, 0.1 * depth, 4.0, seed), "seed": seed, "levels": levels}
            found = align(room, measured, noise, anchor=truth, **options)
            reached[levels] += _nees(found, truth) < 28.0 * (1.0 + found.excess)
    assert reached[2] >= 3 > reached[0]


@pytest.mark.slow
def test_nearby_starts_find_the_truth_in_a_furnished_room(scenes: Path) -> None:
    """Within 2 degrees and a twentieth of the depth, by way of one reduced image, in over 90 % of cases."""
    depth = 4.07
    path = scenes / "textured_room" / "textured_room.xml"
    options: dict[str, Any] = {"size": (48, 36), "spp": 32, "sigma": 0.04, "seed": 11, "levels": 1}
    found = validate(path, trials=48, perturb_deg=2.0, perturb_trans=0.05 * depth, workers=2, **options)
    information = found.bound.information.to_frame("camera")
    assert information.length_scale == pytest.approx(depth, rel=0.01)
    right = 0
    for trial in found.trials:
        error = np.array(trial.error)
        nees = float(error @ information.matrix @ error)
        right += trial.status == "converged" and nees < 28.0 * (1.0 + trial.excess)
    # 47 of 48 or more: were the rate 90 %, that would be one case in twenty-five.
    assert stats.binomtest(right, len(found.trials), 0.9, alternative="greater").pvalue < 0.05


@pytest.mark.slow
def test_inerfs_recipe_comes_close(textured: Any, truth: Anchor) -> None:
    """In what the image shows: along the valley of the weakest direction a first-order method creeps."""
    options: dict[str, Any] = {"anchor": truth, "spp": 16, "pose": _start(truth, 0.05, 1.0)}
    options |= {"estimator": "adam", "learning_rate": 0.01, "batch_pixels": 256}
    found = align(textured, _measured(truth), SIGMA, iterations=60, **options)
    hardly = align(textured, _measured(truth), SIGMA, iterations=1, **options)
    assert found.residual < 1.05
    assert hardly.residual > 1.5


def test_pixels_that_are_not_finite_are_counted_and_left_out(textured: Any, truth: Anchor) -> None:
    image = _measured(truth)
    image[:3, :5] = np.nan
    image[10, 10, 1] = np.inf
    found = align(textured, image, SIGMA, anchor=truth, spp=64, pose=_start(truth, 0.02, 0.3))
    assert found.masked == 16
    assert found.status == "converged"
    assert _nees(found, truth) < 28.0 * (1.0 + found.excess)


@pytest.mark.parametrize("pixels", ["mask", "random:0.5", "gradient:0.5"])
def test_what_is_not_chosen_matters_on_no_level(textured: Any, truth: Anchor, pixels: Any) -> None:
    start = _start(truth, 0.1, 3.0)
    if pixels == "mask":
        pixels = np.ones((SIZE[1], SIZE[0]), dtype=bool)
        pixels[:, 20:] = False
    with measurement(textured, size=SIZE, pose=start, pixels=pixels) as run:
        mask = run.mask
    poses = []
    for value in (0.0, 1000.0):
        image = np.where(mask[..., None], _measured(truth), value)
        found = align(textured, image, SIGMA, anchor=truth, spp=16, pose=start, pixels=pixels, levels=1)
        assert _nees(found, truth) < 28.0 * (1.0 + found.excess)
        assert found.bound.information.selection.selected == mask.sum()
        poses.append(found.pose)
    np.testing.assert_array_equal(*poses)


@pytest.mark.parametrize("pixels", ["random:0.3", "gradient:0.3"])
def test_chosen_pixels_are_the_measurement(textured: Any, truth: Anchor, pixels: str) -> None:
    """Pose, bound and excess are those of an estimator that was given these pixels by name."""
    options: dict[str, Any] = {"anchor": truth, "spp": 64, "pose": _start(truth, 0.02, 0.3)}
    with measurement(textured, size=SIZE, pose=options["pose"], pixels=pixels) as run:
        mask = run.mask
    found = align(textured, _measured(truth), SIGMA, pixels=pixels, **options)
    named = align(textured, _measured(truth), SIGMA, pixels=mask, **options)
    np.testing.assert_array_equal(found.pose, named.pose)
    np.testing.assert_array_equal(found.bound.information.matrix, named.bound.information.matrix)
    assert found.excess == named.excess > 0.0
    assert found.bound.information.selection == PixelSelection("only", 768, 230, pixels)
    assert _nees(found, truth) < 28.0 * (1.0 + found.excess)


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["gauss_newton", "levenberg_marquardt", "adam"])
def test_what_is_not_finite_in_the_scene_is_left_out_on_request(truth: Anchor, estimator: str) -> None:
    """The measured image shows what is there."""
    options: dict[str, Any] = {"spp": 32, "pose": _start(truth, 0.05, 1.0), "levels": 1}
    options |= {"estimator": estimator, "iterations": 80 if estimator == "adam" else 30}
    torn = torn_wall()
    with pytest.raises(RadianceError, match=r"\d+ of \d+ pixels.*drop_invalid=True"):
        align(torn, _measured(truth), SIGMA, **options)
    found = align(torn, _measured(truth), SIGMA, drop_invalid=True, **options)
    assert 100 < found.invalid < 600
    assert found.masked == 0
    selection = found.bound.information.selection
    assert (selection.kind, selection.selected) == ("only", 768 - found.invalid)
    assert selection.description == "all, where the radiance is finite"
    assert found.residual < (1.25 if estimator == "adam" else 1.15)  # Adam's last steps are still random
    if estimator != "adam":
        assert found.status == "converged"
        assert _nees(found, truth) < 28.0 * (1.0 + found.excess)


@pytest.mark.slow
def test_noise_of_every_pixel_is_reduced_with_the_image(textured: Any, truth: Anchor) -> None:
    """Values of infinite variance matter on no level, nor do they take others with them."""
    variance = np.full((*SIZE[::-1], 3), SIGMA.sigma**2)
    variance[:, :16] *= 100.0
    variance[4:8, 4:28] = np.inf
    variance[..., 2] = np.inf
    noise = np.random.default_rng(3).standard_normal(variance.shape)
    noise *= np.sqrt(np.where(np.isinf(variance), 0.0, variance))
    poses = []
    for value in (0.0, 1000.0):
        image = np.where(np.isinf(variance), value, truth.batches[0] + noise)
        options: dict[str, Any] = {"anchor": truth, "spp": 16, "pose": _start(truth, 0.1, 3.0), "levels": 1}
        found = align(textured, image, PerPixel(variance), **options)
        assert found.status == "converged"
        assert _nees(found, truth) < 28.0 * (1.0 + found.excess)
        poses.append(found.pose)
    np.testing.assert_array_equal(*poses)


def test_levels_refuse_noise_that_no_reduced_image_has(textured: Any, truth: Anchor) -> None:
    camera = Sensor(PerPixel(np.full((24, 32), 1e-4)), "after", SRGB)
    with pytest.raises(NoiseError, match=r"levels need noise that is the same .* leave out levels"):
        align(textured, _measured(truth), camera, levels=1)
    with pytest.raises(NoiseError, match="independent between channels"):
        align(textured, _measured(truth), ColourBlocks(np.tile(np.eye(3), (24, 32, 1, 1))), levels=1)


def test_an_image_of_another_shape_can_be_confirmed(truth: Anchor) -> None:
    """Its sides' ratio sets the vertical field of view; a description says so, a loaded object does not."""
    image = _measured(truth)[2:22]
    found = align(textured_wall(), image, SIGMA, spp=8, iterations=1, size=(32, 20))
    assert found.masked == 0


def test_the_estimate_is_not_biased_by_the_renderers_noise(textured: Any, truth: Anchor) -> None:
    """Twenty estimates from few paths: their mean is the truth's, in units of its own standard deviation."""
    errors, excess = [], []
    for seed in range(20):
        found = align(textured, _measured(truth, seed), SIGMA, anchor=truth, spp=16, seed=seed, iterations=10)
        assert found.status == "converged"
        errors.append(se3.log(se3.inverse(truth.pose) @ found.pose))
        excess.append(found.excess)
    root = np.linalg.cholesky(found.bound.information.matrix).T
    mean = root @ np.mean(errors, axis=0) * np.sqrt(len(errors) / (1.0 + np.mean(excess)))
    assert mean @ mean < 22.5  # 99.9 % quantile of χ² with 6 degrees of freedom
    whitened = np.array(errors) @ root.T
    nees = np.mean(np.sum(whitened**2, axis=1)) / (1.0 + np.mean(excess))
    assert 3.6 < nees < 9.0  # 99.9 % of χ²_120 / 20


@pytest.mark.slow
def test_the_bound_at_the_estimate_is_the_measurements_also_where_noise_depends_on_the_image() -> None:
    """To the error of the Jacobian that the search has measured near there."""
    edges = scene(wall=wall({"type": "checkerboard", "to_uv": mi.ScalarTransform4f().scale(8)}))
    photons = PoissonGaussian(gain=1e-3, read_noise=2e-4)
    image = pose_jacobian(edges, spp=1024).image
    found = align(edges, image, photons, spp=64, seed=1)
    assert found.status == "converged"
    bound = pose_bound(edges, photons, spp=64, seed=2, pose=found.pose)
    informations = found.bound.information, bound.information
    one, other = (np.diagonal(information.matrix) for information in informations)
    error = np.hypot(*(np.diagonal(information.standard_error) for information in informations))
    # Weights are not linear in the image: 64 paths leave some per cent.
    assert np.all(np.abs(one - other) < 4.0 * error + 0.05 * other)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"image": np.zeros((24, 32))}, r"\(H, W, 3\)"),
        ({"image": np.zeros((24, 32, 4))}, r"\(H, W, 3\)"),
        ({"image": np.ones((24, 24, 3))}, "24x24, the film 32x24"),
        ({"image": np.full((24, 32, 3), np.nan)}, "no pixel"),
        ({"size": (16, 12)}, "32x24"),
        ({"estimator": "newton"}, "gauss_newton"),
        ({"iterations": 0}, "iterations"),
        ({"levels": -1}, "levels"),
        ({"pose": se3.exp([0, 0, 0, 0, 3.1, 0])}, "out of view"),
        ({"anchor": Anchor(np.eye(4), np.zeros((1, 12, 16, 3)))}, "anchor"),
    ],
)
def test_what_cannot_be_aligned_is_refused_by_name(change: dict[str, Any], message: str) -> None:
    dark = textured_wall()
    dark.pop("light")
    dark["lamp"] = {"type": "point", "position": [0, 0, 0], "intensity": {"type": "rgb", "value": 20.0}}
    options: dict[str, Any] = {"image": np.ones((24, 32, 3)), "spp": 8, "iterations": 2} | change
    with pytest.raises(AlignmentError, match=message):
        align(dark, options.pop("image"), SIGMA, **options)
