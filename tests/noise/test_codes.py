"""What codes tell, against the exact sum over codes: every noise from far below a step to several of them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.special import ndtr

from mitsuba_crb import noise
from mitsuba_crb.noise.sensor import categorical_information

TOLERANCE = 5e-3
"""Of the exact value, or of a thousandth of the largest where codes hardly tell anything."""


def bins(edges, mean, sigma):
    """(n, L) probabilities of the codes, each from its nearer tail, and their derivatives in the mean."""
    z = (edges - mean[:, None]) / sigma
    low = np.pad(z, ((0, 0), (1, 0)), constant_values=-np.inf)
    high = np.pad(z, ((0, 0), (0, 1)), constant_values=np.inf)
    p = np.where(low > 0.0, ndtr(-low) - ndtr(-high), ndtr(high) - ndtr(low))
    return p, (stats.norm.pdf(low) - stats.norm.pdf(high)) / sigma


def exact_gaussian(edges, mean, sigma):
    """Σ_k (dP_k/dμ)²/P_k."""
    p, d = bins(edges, mean, sigma)
    return np.sum(np.divide(d**2, p, out=np.zeros_like(p), where=p > 1e-200), axis=1)


def exact_photons(edges, mean, gain, read):
    """The same of a mixture over photon counts, with dP_k/dμ from dP(n; λ)/dλ = P(n; λ)(n/λ − 1).

    Codes beyond ten standard deviations of the read noise from every count are one at either end.
    """
    told = []
    for electrons in mean / gain:
        reach = 10.0 * np.sqrt(electrons) + 60.0
        count = np.arange(max(0, int(electrons - reach)), int(electrons + reach) + 1)
        weight = stats.poisson(electrons).pmf(count)
        low, high = gain * count[0] - 10.0 * read, gain * count[-1] + 10.0 * read
        q, _ = bins(edges[(low < edges) & (edges < high)], gain * count, read)
        p, d = weight @ q, (weight * (count / electrons - 1.0) / gain) @ q
        told.append(np.sum(np.divide(d**2, p, out=np.zeros_like(p), where=p > 1e-200)))
    return np.array(told)


def misfit(found, exact):
    return np.max(np.abs(found - exact) / np.maximum(exact, 1e-3 * exact.max()))


def weights(model, mean):
    return model.weights(np.zeros((len(mean), 2), int), mean[:, None])[:, 0]


def means(quantisation, beyond, count):
    """Of all, and as many about white, where one tail decides."""
    rng = np.random.default_rng(quantisation.levels)
    black, white = quantisation.black, quantisation.white
    low = max(black - beyond, 0.0)
    return np.concatenate(
        [
            rng.uniform(low, white + beyond, count),
            rng.uniform(max(low, white - beyond), white + beyond, count),
        ]
    )


@pytest.mark.parametrize(("black", "white"), [(0.0, 1.0), (0.1, 0.6)])
@pytest.mark.parametrize("bits", [1, 2, 4, 8, 10, 12])
def test_gaussian_codes_tell_the_exact_sum(bits, black, white):
    codes = noise.Quantisation(2**bits, black, white)
    step = (white - black) / (codes.levels - 1)
    for steps in (0.05, 0.1, 0.3, 0.5, 0.72, 1.0, 2.0, 5.0):
        sigma = steps * step
        mean = means(codes, 3.0 * max(step, sigma), 100 if bits < 10 else 25)
        exact = exact_gaussian(codes.thresholds, mean, sigma)
        sensor = noise.Sensor(noise.Gaussian(sigma), "after", quantisation=codes)
        assert misfit(weights(sensor, mean), exact) < 1e-6, steps
        if steps < 0.3 and bits > 1:
            # EMVA 1288's twelfth of a step as noise is another thing there.
            assert misfit(np.full(len(mean), 1.0 / (sigma**2 + step**2 / 12.0)), exact) > 0.5


@pytest.mark.parametrize("noise_at", ["before", "after"])
def test_so_they_do_through_a_curve(noise_at):
    """After it by its slope, before it by edges that are carried back."""
    codes, mean = noise.Quantisation(64), np.linspace(0.003, 1.05, 300)
    for sigma in (0.001, 0.005, 0.012, 0.05):
        sensor = noise.Sensor(noise.Gaussian(sigma), noise_at, noise.SRGB, 0.9, codes)
        x, edges, slope = 0.9 * mean, codes.thresholds, 0.9
        if noise_at == "after":
            x, slope = noise.SRGB(x), 0.9 * noise.SRGB.derivative(x)
        else:
            edges = np.where(edges <= 0.04045, edges / 12.92, ((edges + 0.055) / 1.055) ** 2.4)
        assert misfit(weights(sensor, mean), slope**2 * exact_gaussian(edges, x, sigma)) < 1e-4, sigma


@pytest.mark.parametrize(
    ("bits", "gain", "read"),
    [  # in steps
        (1, 0.01, 0.01),
        (1, 1.0, 0.3),
        (2, 0.05, 0.05),
        (4, 0.01, 0.01),
        (4, 0.01, 0.1),
        (4, 1.0, 0.1),
        (4, 3.0, 0.3),
        (8, 0.01, 0.01),
        (8, 0.05, 0.05),
        (8, 0.1, 0.3),
        (8, 1.0, 0.72),
        (8, 3.0, 1.0),
        (10, 1.0, 0.3),
        pytest.param(10, 0.3, 4.0, marks=pytest.mark.slow),
    ],
)
def test_photons_codes_tell_the_exact_sum(bits, gain, read):
    codes = noise.Quantisation(2**bits)
    step = codes.white / (codes.levels - 1)
    photons = noise.PoissonGaussian(gain * step, read * step)
    mean = means(codes, 3.0 * step, 10 if bits < 8 else 4)
    exact = exact_photons(codes.thresholds, mean, photons.gain, photons.read_noise)
    sensor = noise.Sensor(photons, "before", quantisation=codes)
    assert misfit(weights(sensor, mean), exact) < TOLERANCE


def test_a_gaussian_of_the_photons_variance_fails_about_white_even_with_thousands():
    """1500 photo-electrons: the skewness and the threshold between two of them."""
    codes = noise.Quantisation(16)
    gain, read = 0.01 / 15, 0.01 / 15
    mean = means(codes, 3.0 / 15, 25)
    exact = exact_photons(codes.thresholds, mean, gain, read)
    alike = noise.Heteroscedastic((read**2, gain))
    pixels = np.zeros((len(mean), 2), int)
    found = categorical_information(alike, codes.thresholds, pixels, mean[:, None])[:, 0]
    assert misfit(found, exact) > 4.0 * TOLERANCE


@pytest.mark.parametrize("steps", [1.0, 3.0])
def test_nearly_black_photons_are_told_one_by_one(steps):
    """Two of them lie far from the mean, however the spread falls with it."""
    codes = noise.Quantisation(16)
    photons = noise.PoissonGaussian(steps / 15, 0.1 * steps / 15)
    mean = photons.gain * np.geomspace(1e-9, 1.0, 40)
    exact = exact_photons(codes.thresholds, mean, photons.gain, photons.read_noise)
    sensor = noise.Sensor(photons, "before", quantisation=codes)
    np.testing.assert_allclose(weights(sensor, mean), exact, rtol=TOLERANCE)
