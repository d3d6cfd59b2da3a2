"""Each pixel's information and its share in one direction: unbiased, adds up, and not the noise."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import synthetic_view

from mitsuba_crb.errors import OptionError
from mitsuba_crb.information.image_information import fisher_information
from mitsuba_crb.information.pixel_information import along, information_share, pixel_information
from mitsuba_crb.information.symmetric import unpack
from mitsuba_crb.noise import Gaussian, PerPixel

NOISE = Gaussian(synthetic_view.SIGMA)


@pytest.fixture(scope="module")
def view():
    return synthetic_view.jacobian()


def test_the_pixels_informations_add_up_to_the_image_s(view):
    weights = NOISE.weights(view.pixels, view.mean)
    own = pixel_information(view.batch_values, weights)
    F = fisher_information(view, NOISE).matrix
    np.testing.assert_allclose(unpack(own.sum(axis=0)), F, atol=1e-10 * np.abs(F).max())
    v = np.array([0.3, -0.2, 0.5, 0.1, 0.4, -0.6])
    np.testing.assert_allclose(along(own, v).sum(), v @ F @ v, rtol=1e-9)


def test_shares_are_unbiased_where_the_plain_ones_show_noise():
    """Forty noisy Jacobians; mean shares within five standard errors of the exact ones, per block."""
    exact = synthetic_view.columns(48, 64)[1]
    v = synthetic_view.bound(synthetic_view.jacobian()).weakest.direction
    scaled = v * np.repeat([2.5, 1.0], 3)
    truth = np.sum((exact @ scaled) ** 2, axis=-1)
    truth = _blocks(truth / truth.sum())
    shares, plain = [], []
    rng = np.random.default_rng(0)
    for _ in range(40):
        noisy = synthetic_view.jacobian(noise=0.0)
        errors = 0.3 * exact.std(axis=(0, 1, 2)) * rng.normal(size=noisy.batch_values.shape)
        noisy = dataclasses.replace(noisy, batch_values=noisy.batch_values + errors)
        shares.append(_blocks(information_share(noisy, NOISE, v)))
        own = np.sum((noisy.values @ scaled) ** 2, axis=-1).reshape(48, 64)
        plain.append(_blocks(own / own.sum()))
    error = np.std(shares, axis=0) / np.sqrt(40.0)
    assert np.all(np.abs(np.mean(shares, axis=0) - truth) < 5.0 * error)
    assert np.any(np.abs(np.mean(plain, axis=0) - truth) > 10.0 * error)


def test_pixels_without_weight_have_no_share_and_unmeasured_ones_none_to_tell():
    view = synthetic_view.jacobian(fraction=0.5, kind="only")
    variance = np.full((48, 64), synthetic_view.SIGMA**2)
    variance[:, :32] = np.inf
    weakest = synthetic_view.bound(view).weakest
    share = information_share(view, PerPixel(variance), weakest.direction)
    measured = np.zeros((48, 64), bool)
    measured[view.pixels[:, 1], view.pixels[:, 0]] = True
    np.testing.assert_array_equal(np.isfinite(share), measured)
    assert np.all(share[:, :32][measured[:, :32]] == 0.0)
    assert np.nansum(share) == pytest.approx(1.0)


def test_it_is_the_same_in_both_frames(view):
    v = synthetic_view.bound(view).weakest.direction
    here = information_share(view, NOISE, v)
    np.testing.assert_allclose(information_share(view.to_frame("world"), NOISE, v), here, atol=1e-9)


@pytest.mark.parametrize("direction", [np.zeros(6), np.ones(5), np.full(6, np.nan)])
def test_a_direction_that_is_none_is_named(view, direction):
    with pytest.raises(OptionError, match="six finite numbers"):
        information_share(view, NOISE, direction)


def test_a_direction_without_information_has_nothing_to_share():
    view = synthetic_view.jacobian(unseen=(5,), noise=0.0)
    with pytest.raises(OptionError, match="no information about this direction"):
        information_share(view, NOISE, np.eye(6)[5])


def _blocks(image):
    return image.reshape(6, 8, 8, 8).sum(axis=(1, 3))
