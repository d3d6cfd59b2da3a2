"""Noise models: their weights against the score's covariance in simulated images, and what they refuse."""

from __future__ import annotations

import json

import numpy as np
import pytest

from mitsuba_crb import noise
from mitsuba_crb.errors import NoiseError

HEIGHT, WIDTH = 4, 5
VARIANCE = np.linspace(0.5, 3.0, HEIGHT * WIDTH * 3).reshape(HEIGHT, WIDTH, 3)
PIXELS = np.array([[x, y] for y in range(HEIGHT) for x in range(WIDTH)])
MODELS = {
    "gaussian": (noise.Gaussian(0.7), np.full_like(VARIANCE, 0.49)),
    "per channel": (noise.PerChannel([0.5, 1.0, 2.0]), np.broadcast_to([0.25, 1.0, 4.0], VARIANCE.shape)),
    "per pixel": (noise.PerPixel(VARIANCE[..., 0]), np.repeat(VARIANCE[..., :1], 3, axis=2)),
    "per pixel and channel": (noise.PerPixel(VARIANCE), VARIANCE),
}


def _weights(model):
    return model.weights(PIXELS, np.zeros((HEIGHT * WIDTH, 3)))


@pytest.mark.parametrize("name", MODELS)
def test_weights_are_the_inverse_variances(name):
    model, variance = MODELS[name]
    model.check(HEIGHT, WIDTH, 3)
    weights = _weights(model)
    assert weights.dtype == np.float64
    np.testing.assert_allclose(weights, 1.0 / variance.reshape(-1, 3), rtol=1e-15)


@pytest.mark.parametrize("name", MODELS)
def test_weights_give_the_variance_of_the_score(name):
    """Second oracle: the variance of ∂ log p(I | θ) / ∂θ over simulated images is the Fisher information.

    Over 20000 Gaussian images its relative standard error is √(2/20000) = 1 %; 4 of them are allowed.
    """
    model, variance = MODELS[name]
    rng = np.random.default_rng(11)
    J = rng.normal(size=variance.shape)
    images = rng.normal(size=(20000, *variance.shape)) * np.sqrt(variance)

    def log_likelihood(theta):
        return -0.5 * np.sum((images - theta * J) ** 2 / variance, axis=(1, 2, 3))

    score = (log_likelihood(1e-3) - log_likelihood(-1e-3)) / 2e-3
    information = np.sum(J.reshape(-1, 3) ** 2 * _weights(model))
    assert abs(score.var() / information - 1.0) < 0.04
    # Negative control: standard deviations mistaken for variances.
    assert abs(score.var() / np.sum(J**2 / np.sqrt(variance)) - 1.0) > 0.04


def test_weights_follow_the_order_of_the_pixels():
    shuffled = np.random.default_rng(3).permutation(len(PIXELS))
    weights = noise.PerPixel(VARIANCE).weights(PIXELS[shuffled], np.zeros((len(PIXELS), 3)))
    np.testing.assert_array_equal(weights, 1.0 / VARIANCE.reshape(-1, 3)[shuffled])


def test_an_infinite_variance_ignores_the_pixel():
    variance = np.ones((HEIGHT, WIDTH))
    variance[1, 2] = np.inf
    weights = _weights(noise.PerPixel(variance))
    assert weights[1 * WIDTH + 2].tolist() == [0.0, 0.0, 0.0]
    assert np.count_nonzero(weights == 0.0) == 3


@pytest.mark.parametrize("name", MODELS)
def test_descriptions_are_short_and_parameters_are_json(name):
    model, _ = MODELS[name]
    assert isinstance(model, noise.NoiseModel)
    assert "\n" not in model.description
    assert len(model.description) < 80
    assert json.loads(json.dumps(model.to_dict(), allow_nan=False))["model"]


def test_an_infinite_variance_is_still_json():
    json.dumps(noise.PerPixel([[1.0, np.inf]]).to_dict(), allow_nan=False)


@pytest.mark.parametrize("sigma", [0.0, -1.0, np.nan, np.inf, 1e-200, "one", None, [1.0, 2.0]])
def test_impossible_standard_deviations_are_refused(sigma):
    with pytest.raises(NoiseError, match="positive"):
        noise.Gaussian(sigma)
    with pytest.raises(NoiseError, match="channel 1"):
        noise.PerChannel([1.0, sigma, 1.0])


@pytest.mark.parametrize("sigmas", [[], 0.1])
def test_channel_sigmas_must_be_a_list(sigmas):
    with pytest.raises(NoiseError, match="one sigma per channel"):
        noise.PerChannel(sigmas)


@pytest.mark.parametrize(
    ("variance", "message"),
    [
        ([[1.0, 0.0]], "1 of 2"),
        ([[-1.0, np.nan]], "2 of 2"),
        ([1.0, 2.0], "shape"),
        (np.ones((0, 3)), "shape"),
        ("map.exr", "array"),
    ],
)
def test_impossible_variance_maps_are_refused(variance, message):
    with pytest.raises(NoiseError, match=message):
        noise.PerPixel(variance)


@pytest.mark.parametrize(
    ("model", "size"),
    [
        (noise.PerChannel([1.0, 2.0]), (HEIGHT, WIDTH, 3)),
        (noise.PerPixel(VARIANCE), (WIDTH, HEIGHT, 3)),
        (noise.PerPixel(VARIANCE), (HEIGHT, WIDTH, 1)),
        (noise.PerPixel(VARIANCE[..., 0]), (HEIGHT, WIDTH + 1, 3)),
    ],
)
def test_a_model_of_another_image_is_refused_before_rendering(model, size):
    with pytest.raises(NoiseError, match="but the image"):
        model.check(*size)


def test_weights_outside_of_the_map_are_refused():
    with pytest.raises(NoiseError, match="not pixel"):
        noise.PerPixel(VARIANCE).weights(np.array([[WIDTH, 0]]), np.zeros((1, 3)))
    with pytest.raises(NoiseError, match="not pixel"):
        noise.PerPixel(VARIANCE).weights(np.array([[-1, 0]]), np.zeros((1, 3)))
    with pytest.raises(NoiseError, match="channels"):
        noise.PerPixel(VARIANCE).weights(np.array([[0, 0]]), np.zeros((1, 4)))


def test_the_variance_map_cannot_be_changed_afterwards():
    variance = np.ones((HEIGHT, WIDTH))
    model = noise.PerPixel(variance)
    variance[:] = 4.0
    assert model.variance.max() == 1.0
    with pytest.raises(ValueError, match="read-only"):
        model.variance[0, 0] = 2.0
