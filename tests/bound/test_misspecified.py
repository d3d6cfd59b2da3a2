"""The sandwich covariance: the bound where residuals are as assumed, and the errors' covariance where not.

Oracles: the bound itself, generalised least squares, and errors of simulated estimates; the ideal bound, and
the view's own residuals in the place of others', are the negative controls.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import synthetic_view
from scipy import ndimage, stats

from mitsuba_crb.bound.cramer_rao import cramer_rao_bound
from mitsuba_crb.bound.misspecified import MisspecifiedCovariance, misspecified_covariance
from mitsuba_crb.errors import NoiseError, OptionError
from mitsuba_crb.information.image_information import fisher_information
from mitsuba_crb.information.image_jacobian import ImageJacobian
from mitsuba_crb.noise import ColourBlocks, Gaussian, Stationary
from mitsuba_crb.noise.residuals import ResidualCovariance, residual_covariance

SIGMA = 0.02
COLOURS = np.array([[1.0, 0.6, 0.3], [0.6, 1.0, 0.5], [0.3, 0.5, 1.0]])
BLUR = 1.5
"""Of the residuals [pixel]."""


def exact(height: int = 48, width: int = 64, **options: Any) -> ImageJacobian:
    return synthetic_view.jacobian(height, width, noise=0.0, **options)


def with_gain_and_black(view: ImageJacobian) -> ImageJacobian:
    shown = np.broadcast_to(view.mean, view.batch_values.shape[:-1])
    columns = np.stack([shown, np.ones_like(shown)], axis=-1)
    return dataclasses.replace(
        view,
        batch_values=np.concatenate([view.batch_values, columns], axis=-1),
        parameters=("gain", "black"),
    )


def white(covariance: Any, reach: int = 0) -> ResidualCovariance:
    values = np.zeros((3, 3, 2 * reach + 1, 2 * reach + 1))
    values[:, :, reach, reach] = covariance
    return ResidualCovariance(values, 1)


def blurred(reach: int = 8) -> ResidualCovariance:
    """Of white noise through a Gaussian filter, its channels mixed."""
    impulse = np.zeros((2 * reach + 1,) * 2)
    impulse[reach, reach] = 1.0
    shape = ndimage.gaussian_filter(impulse, np.sqrt(2.0) * BLUR, truncate=6.0, mode="constant")
    return ResidualCovariance(SIGMA**2 * COLOURS[:, :, None, None] * shape / shape[reach, reach], images=1)


def drawn(count: int, height: int, width: int, seed: int) -> np.ndarray:
    """Residual images (count, H, W, 3) of that covariance."""
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal((count, height + 40, width + 40, 3)) @ np.linalg.cholesky(COLOURS).T
    smooth = ndimage.gaussian_filter(noise, (0, BLUR, BLUR, 0), truncate=6.0)[:, 20:-20, 20:-20]
    return SIGMA * smooth * 2.0 * np.sqrt(np.pi) * BLUR


def deviations(found: MisspecifiedCovariance) -> np.ndarray:
    return np.concatenate([found.position_std, found.rotation_std_deg])


def estimates(view: ImageJacobian, residuals: np.ndarray) -> np.ndarray:
    """(count, 6), what least squares finds of each image of residuals, all other parameters unknown, too."""
    columns = view.values.reshape(-1, view.values.shape[-1])
    x, y = view.pixels.T
    return np.linalg.lstsq(columns, residuals[:, y, x].reshape(len(residuals), -1).T)[0][:6].T


@pytest.mark.parametrize("parameters", [False, True])
def test_of_the_assumed_noise_it_is_the_bound(parameters: bool) -> None:
    view = synthetic_view.jacobian(noise=0.05)
    view = with_gain_and_black(view) if parameters else view
    found = misspecified_covariance(view, Gaussian(SIGMA), white(SIGMA**2 * np.eye(3)))
    np.testing.assert_allclose(found.covariance, found.ideal.covariance, rtol=1e-9)
    np.testing.assert_allclose(found.ratios, 1.0, rtol=1e-9)
    assert "like the assumed noise" in found.gap
    if not parameters:
        bound = cramer_rao_bound(fisher_information(view, Gaussian(SIGMA)))
        np.testing.assert_array_equal(found.ideal.covariance, bound.covariance)


def test_of_correlated_noise_that_is_known_it_is_the_bound_too() -> None:
    """W = S⁻¹, by another way to multiply with S."""
    across = np.exp(-np.abs(np.arange(-8, 9)) / 2.0) * np.hanning(19)[1:-1]
    shape = SIGMA**2 * across[:, None] * across
    residuals = ResidualCovariance(np.eye(3)[:, :, None, None] * shape, 1)
    found = misspecified_covariance(exact(24, 32), Stationary(shape), residuals)
    np.testing.assert_allclose(found.covariance, found.ideal.covariance, rtol=1e-6)


def test_colours_that_are_alike_tell_less() -> None:
    """Residuals alike in all channels of a grey texture are one value, not three."""
    view = exact()
    paint = np.array([0.9, 0.7, 0.5])
    alike = SIGMA**2 * np.ones((3, 3))
    found = misspecified_covariance(view, Gaussian(SIGMA), white(alike))
    np.testing.assert_allclose(found.ratios**2, paint.sum() ** 2 / (paint**2).sum(), rtol=1e-9)
    blocks = ColourBlocks(SIGMA**2 * COLOURS)
    known = misspecified_covariance(view, blocks, white(SIGMA**2 * COLOURS))
    np.testing.assert_allclose(known.ratios, 1.0, rtol=1e-9)


@pytest.mark.parametrize("parameters", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_errors_of_least_squares_have_it_and_not_the_bound(parameters: bool) -> None:
    """200 estimates from residuals that are blurred and alike in colour; NEES in its 99.9 % band."""
    view = with_gain_and_black(exact()) if parameters else exact()
    found = misspecified_covariance(view, Gaussian(SIGMA), blurred())
    errors = estimates(view, drawn(200, 48, 64, seed=5))
    band = stats.chi2.ppf([0.0005, 0.9995], 6 * len(errors)) / len(errors)

    def nees(covariance: np.ndarray) -> float:
        return float(np.mean(np.einsum("ni,ij,nj->n", errors, np.linalg.inv(covariance), errors)))

    assert band[0] < nees(found.covariance) < band[1]
    assert nees(found.ideal.covariance) > 2.0 * band[1]
    uncorrelated = misspecified_covariance(view, Gaussian(SIGMA), white(blurred().covariance_of_channels))
    assert nees(uncorrelated.covariance) > 1.5 * band[1]


def test_it_is_estimated_from_other_images_of_another_size_with_holes() -> None:
    images = [*drawn(3, 96, 128, seed=1), *drawn(3, 80, 100, seed=2)]
    images[0][10:40, 50:90] = np.nan
    images[4][::7, ::3, 1] = np.nan
    found = residual_covariance(images)
    assert found.reach == (20, 20)
    truth = blurred(20)
    error = np.abs(found.autocovariance - truth.autocovariance).max() / SIGMA**2
    assert error < 0.1  # some 70 independent values across and down in each image
    view = with_gain_and_black(exact())
    one, other = (misspecified_covariance(view, Gaussian(SIGMA), each) for each in (found, truth))
    np.testing.assert_allclose(deviations(one), deviations(other), rtol=0.12)
    assert "map's error" in one.gap


def test_white_residuals_stay_white() -> None:
    """What the estimate's own errors add, also by what is cut off of a spectrum that they make negative."""
    rng = np.random.default_rng(3)
    found = residual_covariance(list(SIGMA * rng.standard_normal((6, 96, 128, 3))))
    assert abs(found.pixels_alike - 1.0) < 0.5
    ratios = misspecified_covariance(with_gain_and_black(exact()), Gaussian(SIGMA), found).ratios
    np.testing.assert_allclose(ratios, 1.0, atol=0.15)


def test_of_the_views_own_residuals_it_is_nothing() -> None:
    """The negative control: where the estimate ends JᵀW r = 0."""
    view = exact()
    residuals = drawn(1, 48, 64, seed=9)
    x, y = view.pixels.T
    columns = view.values.reshape(-1, 6)
    left = residuals[0, y, x].ravel() - columns @ estimates(view, residuals)[0]
    weighed = columns / SIGMA**2
    M = np.outer(weighed.T @ left, weighed.T @ left)
    inverse = np.linalg.inv(fisher_information(view, Gaussian(SIGMA)).matrix)
    own = np.diagonal(inverse @ M @ inverse)
    assert np.all(own < 1e-12 * np.diagonal(inverse))


@pytest.mark.slow
def test_noise_of_the_columns_does_not_enter() -> None:
    """Batches with errors of their own: unbiased, and within the stated standard errors; J̄ᵀWSWJ̄ is not."""
    clean, S = exact(), white(SIGMA**2 * COLOURS)
    truth = misspecified_covariance(clean, Gaussian(SIGMA), S)
    chi, unbiased, plain = [], [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        noise = 0.5 * clean.batch_values.std(axis=(0, 1, 2)) * rng.standard_normal(clean.batch_values.shape)
        view = dataclasses.replace(clean, batch_values=clean.batch_values + noise)
        found = misspecified_covariance(view, Gaussian(SIGMA), S)
        error = np.concatenate([found.position_std_standard_error, found.rotation_std_deg_standard_error])
        chi.append((deviations(found) - deviations(truth)) / error)
        mean = dataclasses.replace(view, batch_values=np.broadcast_to(view.values, view.batch_values.shape))
        without = misspecified_covariance(mean, Gaussian(SIGMA), S)
        for kept, each in ((unbiased, found), (plain, without)):
            kept.append(np.trace(each.middle.matrix @ np.linalg.inv(truth.middle.matrix)) / 6.0)
    # Errors of F and of M largely cancel here, and are added as if they were independent.
    assert 0.02 < np.mean(np.square(chi)) < 1.5
    assert abs(np.mean(unbiased) - 1.0) < 0.015
    assert np.mean(plain) > 1.04


def test_what_is_unseen_stays_unseen_and_frames_agree() -> None:
    view = synthetic_view.jacobian(noise=0.3, unseen=(2,))
    found = misspecified_covariance(view, Gaussian(SIGMA), blurred())
    np.testing.assert_array_equal(np.isinf(deviations(found)), np.isinf(deviations(found.ideal)))
    assert np.isinf(deviations(found)).any()
    seen = exact()
    world = misspecified_covariance(seen.to_frame("world"), Gaussian(SIGMA), blurred())
    camera = misspecified_covariance(seen, Gaussian(SIGMA), blurred())
    np.testing.assert_allclose(deviations(world), deviations(camera), rtol=1e-9)
    assert world.ideal.frame == "world"
    scale = np.sqrt(np.diagonal(world.covariance))
    moved = cramer_rao_bound(camera.ideal.information).to_frame("world").covariance
    assert moved.shape == world.covariance.shape
    assert np.all(np.abs(world.covariance) <= np.outer(scale, scale) * (1 + 1e-9))


def test_only_the_given_pixels_are_correlated() -> None:
    """Pixels far apart are as good as independent, however many lie between them."""
    whole = exact()
    far = np.zeros((48, 64), dtype=bool)
    far[::12, ::12] = True
    found = misspecified_covariance(whole.only(far), Gaussian(SIGMA), blurred(11))
    alone = misspecified_covariance(whole.only(far), Gaussian(SIGMA), white(blurred().covariance_of_channels))
    np.testing.assert_allclose(found.covariance, alone.covariance, rtol=1e-5)


def test_what_it_cannot_be_of_is_refused() -> None:
    view = exact()
    with pytest.raises(OptionError, match="random subset"):
        misspecified_covariance(
            synthetic_view.jacobian(fraction=0.3, kind="random"), Gaussian(1.0), blurred()
        )
    with pytest.raises(NoiseError, match="1 channels"):
        misspecified_covariance(view, Gaussian(1.0), ResidualCovariance(np.ones((1, 1, 1, 1)), 1))
    local = dataclasses.replace(with_gain_and_black(view), parameters=("gain:8", "black"))
    with pytest.raises(OptionError, match="gain:8"):
        misspecified_covariance(local, Gaussian(1.0), blurred())


@pytest.mark.parametrize(
    ("images", "options", "words"),
    [
        ([], {}, "none"),
        ([np.zeros((8, 8))], {}, "shape"),
        ([np.zeros((8, 8, 3)), np.zeros((8, 8, 1))], {}, "shape"),
        ([np.zeros((8, 8, 3))], {}, "all zero"),
        ([np.full((8, 8, 3), np.nan)], {}, "nowhere finite"),
        ([np.ones((8, 8, 3))], {"reach": 8}, "shortest side, 8 pixels"),
        ([np.ones((8, 8, 3))], {"reach": -1}, "at least 0"),
    ],
)
def test_residuals_that_tell_nothing_are_refused(images: Any, options: Any, words: str) -> None:
    with pytest.raises(NoiseError, match=words):
        residual_covariance(images, **options)


def test_a_covariance_that_is_none_is_refused() -> None:
    with pytest.raises(NoiseError, match="shape"):
        ResidualCovariance(np.ones((3, 3, 2, 3)), 1)
    lopsided = np.zeros((1, 1, 3, 3))
    lopsided[0, 0, 1] = 0.5, 1.0, 0.0
    with pytest.raises(NoiseError, match="transpose"):
        ResidualCovariance(lopsided, 1)


def test_it_says_which_is_which() -> None:
    found = misspecified_covariance(exact(), Gaussian(SIGMA), blurred())
    lines = str(found).splitlines()
    assert lines[1].split()[:2] == ["if", "ideal"]
    assert "alike over" in lines[4]
    assert "times the ideal ones" in lines[5]
