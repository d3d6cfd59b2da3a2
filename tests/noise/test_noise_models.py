"""Noise models and sensor responses against the true process: photons, read noise, curves, codes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from noise_laws import DRAWS, NoiseLaws
from scipy import stats

from mitsuba_crb import noise
from mitsuba_crb.errors import NoiseError
from mitsuba_crb.noise.poisson_gaussian import photon_information

ORIGIN = np.zeros((1, 2), int)


class TestGaussian(NoiseLaws):
    model = noise.Gaussian(0.2)

    def draw(self, rng, mean):
        return mean + 0.2 * rng.normal(size=(DRAWS, 3))

    def log_likelihood(self, values, mean):
        return stats.norm(mean, 0.2).logpdf(values).sum(axis=1)

    def test_a_tenth_too_much_fails(self):
        assert self.misfit(self.means[0], noise.Gaussian(0.2 / np.sqrt(1.1))) > 4.0


class TestClipped(NoiseLaws):
    """Below white, at it, and so far above that only one value in 400 is measured at all."""

    sigma, white = 0.2, 0.5
    model = noise.Clipped(sigma, white)
    means = ((0.3, 0.1, 0.7), (-1.0, 0.5, 1.06))

    def draw(self, rng, mean):
        return np.minimum(mean + self.sigma * rng.normal(size=(DRAWS, 3)), self.white)

    def log_likelihood(self, values, mean):
        process = stats.norm(mean, self.sigma)
        return np.where(values < self.white, process.logpdf(values), process.logsf(self.white)).sum(axis=1)

    def test_a_camera_that_does_not_clip_fails(self):
        assert self.misfit(self.means[0], noise.Gaussian(self.sigma)) > 10.0

    def test_far_below_white_it_is_gaussian_and_far_above_it_tells_nothing(self):
        weights = self.model.weights(ORIGIN, np.array([[0.5 - 9 * 0.2, -1e6, 0.5]]))[0]
        np.testing.assert_allclose(weights * self.sigma**2, [1.0, 1.0, 0.5 + 1.0 / np.pi], rtol=1e-12)
        np.testing.assert_array_equal(self.model.weights(ORIGIN, np.array([[2.4, 1e6, np.inf]])), 0.0)

    def test_it_is_a_sensor_of_fine_codes_that_end_at_white(self):
        fine = noise.Quantisation(8001, black=-3.5, white=self.white)
        sensor = noise.Sensor(noise.Gaussian(self.sigma), "after", quantisation=fine)
        means = np.linspace(-1.0, 1.2, 24).reshape(8, 3)
        pixels = np.zeros((8, 2), int)
        theirs = sensor.weights(pixels, means) * self.sigma**2
        assert np.abs(self.model.weights(pixels, means) * self.sigma**2 - theirs).max() < 1e-3

    def test_the_mean_matters_near_white_alone(self):
        """Where a pixel is not near, means a fifth off give equal weights; elsewhere some differ."""
        model = noise.Luminance(noise.Clipped(0.01, 0.5))
        means = np.repeat(np.geomspace(1e-3, 1e3, 601)[:, None], 3, axis=1)
        pixels = np.zeros((601, 2), int)
        for each in (model, model.noise):
            near = each.near_threshold(means, means)
            differ = each.weights(pixels, 0.8 * means) != each.weights(pixels, 1.25 * means)
            assert not differ[~near].any()
            assert 20 < near.sum() < 40
            assert np.array_equal(each.saturated(means)[:, 0], means[:, 0] > 0.51)
        assert not noise.Luminance(noise.Gaussian(0.1)).near_threshold(means, means).any()
        assert noise.Luminance(noise.PoissonGaussian(0.1, 0.1)).near_threshold(means, means).all()


class TestColourBlocks(NoiseLaws):
    covariance = np.array([[0.04, 0.02, 0.0], [0.02, 0.03, -0.01], [0.0, -0.01, 0.05]])
    model = noise.ColourBlocks(covariance)

    def draw(self, rng, mean):
        return rng.multivariate_normal(mean, self.covariance, DRAWS)

    def log_likelihood(self, values, mean):
        return stats.multivariate_normal(mean, self.covariance).logpdf(values)

    def test_the_diagonal_alone_fails(self):
        alone = noise.PerChannel(np.sqrt(np.diagonal(self.covariance)))
        assert self.misfit(self.means[0], alone) > 10.0

    def test_a_map_gives_each_pixel_its_own_block(self):
        blocks = self.covariance * np.arange(1.0, 7.0).reshape(2, 3, 1, 1)
        model = noise.ColourBlocks(blocks)
        model.check(2, 3, 3)
        weights = model.weights(np.array([[2, 0], [0, 1]]), np.zeros((2, 3)))
        inverse = np.linalg.inv(self.covariance)
        np.testing.assert_allclose(weights, [inverse / 3, inverse / 4], rtol=1e-12)


class TestHeteroscedastic(NoiseLaws):
    model = noise.Heteroscedastic((0.01, 0.05, 0.02))
    means = ((0.3, 0.1, 0.7), (0.02, 2.0, 5.0))

    def variance(self, mean):
        return 0.01 + 0.05 * mean + 0.02 * mean**2

    def draw(self, rng, mean):
        return mean + np.sqrt(self.variance(mean)) * rng.normal(size=(DRAWS, 3))

    def log_likelihood(self, values, mean):
        return stats.norm(mean, np.sqrt(self.variance(mean))).logpdf(values).sum(axis=1)


class TestSigmaPower(NoiseLaws):
    model = noise.SigmaPower(0.4, 2.0)
    means = ((0.3, 0.1, 0.7), (1.5, 2.0, 0.9))

    def sigma(self, mean):
        return 0.4 * mean**2

    def draw(self, rng, mean):
        return mean + self.sigma(mean) * rng.normal(size=(DRAWS, 3))

    def log_likelihood(self, values, mean):
        return stats.norm(mean, self.sigma(mean)).logpdf(values).sum(axis=1)

    def test_what_has_no_spread_tells_nothing(self):
        np.testing.assert_array_equal(self.model.weights(ORIGIN, np.array([[0.0, -1.0]])), 0.0)


class TestSigmaTable(TestSigmaPower):
    """Between its rows and beyond them."""

    model = noise.SigmaTable([0.2, 0.5, 1.5], [0.05, 0.2, 1.0])
    means = ((0.3, 0.1, 0.7), (1.7, 0.4, 0.9))

    def sigma(self, mean):
        return np.interp(mean, [0.2, 0.5, 1.5], [0.05, 0.2, 1.0])

    def test_what_has_no_spread_tells_nothing(self):
        with pytest.raises(NoiseError):
            noise.SigmaTable([0.0, 1.0], [0.0, 1.0])


class TestStudentT(NoiseLaws):
    model = noise.StudentT(scale=0.2, nu=3.5)

    def draw(self, rng, mean):
        return mean + 0.2 * rng.standard_t(3.5, size=(DRAWS, 3))

    def log_likelihood(self, values, mean):
        return stats.t(3.5, mean, 0.2).logpdf(values).sum(axis=1)


class TestLaplace(NoiseLaws):
    model = noise.Laplace(scale=0.2)

    def draw(self, rng, mean):
        return mean + rng.laplace(scale=0.2, size=(DRAWS, 3))

    def log_likelihood(self, values, mean):
        return stats.laplace(mean, 0.2).logpdf(values).sum(axis=1)


def _photons(mean, gain, reach=60):
    """Counts (n,) and their probabilities (C, n) for means (C,)."""
    counts = np.arange(reach)
    return counts, stats.poisson(np.asarray(mean)[:, None] / gain).pmf(counts)


class TestPoissonGaussian(NoiseLaws):
    gain, read = 0.1, 0.05
    model = noise.PoissonGaussian(gain=gain, read_noise=read)
    means = ((0.02, 0.1, 0.5), (0.3, 1.0, 2.0))

    def draw(self, rng, mean):
        return self.gain * rng.poisson(mean / self.gain, (DRAWS, 3)) + self.read * rng.normal(size=(DRAWS, 3))

    def log_likelihood(self, values, mean):
        counts, probability = _photons(mean, self.gain)
        z = (values[:, :, None] - self.gain * counts) / self.read
        # Some count is always within few standard deviations of the read noise: nothing underflows.
        return np.log(np.einsum("dcn,cn->dc", np.exp(-0.5 * z * z), probability)).sum(axis=1)

    def test_the_heteroscedastic_formula_fails_in_the_dark_and_agrees_in_the_light(self):
        formula = noise.Heteroscedastic((self.read**2, self.gain))
        assert self.misfit((0.02, 0.1, 0.5), formula) > 10.0
        bright = np.array([[50.0, 90.0, 300.0]])
        exact, gaussian = (m.weights(ORIGIN, bright) for m in (self.model, formula))
        np.testing.assert_allclose(gaussian, exact, rtol=2e-3)

    @pytest.mark.slow
    @pytest.mark.parametrize("read", [0.05, 0.2, 0.7, 3.0, 40.0])
    def test_it_lies_between_the_bounds_and_falls_with_the_mean(self, read):
        model = noise.PoissonGaussian(1.0, read)
        electrons = np.geomspace(1e-4, 1e6, 400)
        information = model.weights(np.zeros((400, 2), int), electrons[:, None])[:, 0]
        assert np.all(information <= 1.0 / electrons)
        assert np.all(information * (electrons + read**2) >= 1.0 - 1e-6)
        assert np.all(np.diff(information) <= 0.0)

    def test_black_has_the_closed_form_of_its_limit(self):
        """exp(1/s²) − 1 at λ = 0, and the table against a direct quadrature between its nodes."""
        model = noise.PoissonGaussian(1.0, 0.8)
        black = model.weights(np.zeros((2, 2), int), np.array([[0.0], [-0.1]]))
        np.testing.assert_allclose(black, np.expm1(1 / 0.64), rtol=2e-3)
        for electrons in (0.0123, 0.7, 31.0, 777.0):
            exact = photon_information(electrons, 0.8)
            np.testing.assert_allclose(model.weights(ORIGIN, np.array([[electrons]])), exact, rtol=3e-5)


class TestPhotonsThroughSRGBIntoCodes(NoiseLaws):
    """A whole camera: exposure, photons and read noise, sRGB, clipping, 6 bits."""

    gain, read, exposure, levels = 0.05, 0.03, 1.5, 64
    model = noise.Sensor(
        noise.PoissonGaussian(gain, read), "before", noise.SRGB, exposure, noise.Quantisation(levels)
    )
    means = ((0.01, 0.1, 0.3), (0.5, 0.7, 0.8))

    def draw(self, rng, mean):
        electrons = rng.poisson(self.exposure * mean / self.gain, (DRAWS, 3))
        x = self.gain * electrons + self.read * rng.normal(size=(DRAWS, 3))
        y = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 0.0031308) ** (1 / 2.4) - 0.055)
        return np.rint(np.clip(y, 0.0, 1.0) * (self.levels - 1)).astype(int)

    def log_likelihood(self, values, mean):
        edges = (np.arange(self.levels - 1) + 0.5) / (self.levels - 1)
        edges = np.where(edges <= 0.04045, edges / 12.92, ((edges + 0.055) / 1.055) ** 2.4)
        counts, probability = _photons(self.exposure * mean, self.gain)
        below = stats.norm(self.gain * counts, self.read).cdf(edges[:, None]) @ probability.T
        bins = np.diff(below, axis=0, prepend=0.0, append=1.0)
        return np.log(bins[values, np.arange(3)]).sum(axis=1)

    @pytest.mark.parametrize("levels", [4, 64, 256])
    def test_values_are_interpolated_to_a_relative_1e_3(self, levels):
        mean = np.geomspace(1e-3, 0.9, 300).reshape(100, 3)
        sensor = dataclasses.replace(self.model, quantisation=noise.Quantisation(levels))
        x = self.exposure * mean
        edges = noise.SRGB.inverse(sensor.quantisation.thresholds)
        P, D = sensor.noise.cumulative(np.broadcast_to(edges, (100, 3, levels - 1)), ORIGIN, x)
        p, d = (np.diff(each, axis=-1, prepend=0.0, append=end) for each, end in ((P, 1.0), (D, 0.0)))
        exact = self.exposure**2 * np.sum(d**2 / np.maximum(p, 1e-30), axis=-1, where=p > 1e-14)
        found = sensor.weights(np.zeros((100, 2), int), mean)
        np.testing.assert_allclose(found, exact, rtol=1e-3, atol=1e-6 * exact.max())

    def test_the_unquantised_information_fails(self):
        endless = noise.Sensor(self.model.noise, "before", noise.SRGB, self.exposure)
        assert self.misfit(self.means[1], endless) > 10.0


class TestNoiseAfterGamma(NoiseLaws):
    model = noise.Sensor(noise.Gaussian(0.1), "after", noise.Power(2.0), 0.8)

    def draw(self, rng, mean):
        return np.sqrt(0.8 * mean) + 0.1 * rng.normal(size=(DRAWS, 3))

    def log_likelihood(self, values, mean):
        return stats.norm(np.sqrt(0.8 * mean), 0.1).logpdf(values).sum(axis=1)

    def test_noise_before_the_curve_is_another_thing(self):
        before = noise.Sensor(noise.Gaussian(0.1), "before", noise.Power(2.0), 0.8)
        assert self.misfit(self.means[0], before) > 10.0
        linear = noise.Sensor(noise.Gaussian(0.1), "before", exposure=0.8)
        np.testing.assert_array_equal(
            self.information((1, 2, 3), before), self.information((1, 2, 3), linear)
        )


class TestCoarseCodes(NoiseLaws):
    """Gaussian noise far narrower than a code, and clipping of what is too bright."""

    model = noise.Sensor(noise.Gaussian(0.02), "after", quantisation=noise.Quantisation(6))
    means = ((0.11, 0.28, 0.69), (0.895, 0.93, 0.88))

    def draw(self, rng, mean):
        return np.rint(np.clip(mean + 0.02 * rng.normal(size=(DRAWS, 3)), 0, 1) * 5).astype(int)

    def log_likelihood(self, values, mean):
        below = stats.norm(mean, 0.02).cdf(np.arange(0.1, 1.0, 0.2)[:, None])
        bins = np.diff(below, axis=0, prepend=0.0, append=1.0)
        return np.log(bins[values, np.arange(3)]).sum(axis=1)


class TestLuminance(NoiseLaws):
    model = noise.Luminance(noise.Heteroscedastic((0.01, 0.02)))

    def draw(self, rng, mean):
        y = mean @ noise.colour.REC709
        return y + np.sqrt(0.01 + 0.02 * y) * rng.normal(size=(DRAWS, 1))

    def log_likelihood(self, values, mean):
        y = mean @ noise.colour.REC709
        return stats.norm(y, np.sqrt(0.01 + 0.02 * y)).logpdf(values[:, 0])

    def test_a_single_channel_tells_of_that_channel_alone(self):
        green = noise.Luminance(noise.Gaussian(0.1), (0.0, 1.0, 0.0))
        np.testing.assert_allclose(self.information((1.0, 2.0, 3.0), green), np.diag([0.0, 100.0, 0.0]))


class TestQuantisation:
    @pytest.mark.parametrize("levels", [6, 64, 256])
    @pytest.mark.parametrize(
        "model", [noise.Gaussian(0.03), noise.Laplace(0.01), noise.PoissonGaussian(1e-3, 2e-3)], ids=str
    )
    def test_what_a_value_tells_does_not_depend_on_the_others(self, model, levels):
        """Two of them alone, and among 3000."""
        mean = np.random.default_rng(0).uniform(0.0, 1.1, (1000, 3))
        sensor = noise.Sensor(model, "before", noise.SRGB, quantisation=noise.Quantisation(levels))
        together = sensor.weights(np.zeros((1000, 2), int), mean)
        for low in range(0, 1000, 100):
            alone = sensor.weights(np.zeros((2, 2), int), mean[low : low + 2])
            np.testing.assert_allclose(
                alone, together[low : low + 2], rtol=1e-11, atol=1e-11 * together.max()
            )

    @pytest.mark.parametrize(
        "model",
        [
            noise.Gaussian(0.05),
            noise.Laplace(0.05),
            noise.StudentT(0.05, 4.0),
            noise.PoissonGaussian(0.01, 0.02),
        ],
    )
    def test_fine_codes_lose_nothing_and_coarse_ones_never_gain(self, model):
        mean = np.linspace(0.4, 0.6, 9).reshape(3, 3)
        pixels = np.zeros((3, 2), int)
        full = model.weights(pixels, mean)
        for levels, loss in ((65536, 1e-2), (256, 0.2), (16, 1.0), (2, 1.0)):
            sensor = noise.Sensor(model, "before", quantisation=noise.Quantisation(levels, -2.0, 3.0))
            told = sensor.weights(pixels, mean)
            assert np.all(told <= full * (1 + 1e-9))
            assert np.all(told >= (1 - loss) * full)
        assert told.min() < 0.7 * full.min()

    def test_saturated_values_tell_nothing(self):
        sensor = noise.Sensor(noise.Gaussian(0.01), "after", quantisation=noise.Quantisation(256))
        weights = sensor.weights(np.zeros((1, 2), int), np.array([[0.5, 1.2, -0.3]]))
        assert weights[0, 0] == pytest.approx(1e4, rel=0.03)
        assert weights[0, 1:].tolist() == [0.0, 0.0]

    def test_an_ignored_pixel_stays_ignored(self):
        sensor = noise.Sensor(noise.PerPixel([[np.inf]]), "after", quantisation=noise.Quantisation(256))
        assert not sensor.weights(ORIGIN, np.full((1, 3), 0.5)).any()


@pytest.mark.parametrize(
    "curve",
    [
        noise.SRGB,
        noise.Power(2.2),
        noise.Power(0.5),
        noise.Linear(),
        noise.Tabulated([0, 0.1, 0.5, 1], [0, 0.4, 0.8, 1]),
    ],
)
def test_curves_increase_and_have_an_inverse_and_a_derivative(curve):
    x = np.linspace(-0.2, 1.5, 341) + 1e-4
    y = curve(x)
    assert np.all(np.diff(y) > 0.0)
    np.testing.assert_allclose(curve.inverse(y), x, atol=1e-9)
    h = 1e-6
    np.testing.assert_allclose(
        curve.derivative(x), (curve(x + h) - curve(x - h)) / (2 * h), rtol=1e-4, atol=1e-8
    )


def test_srgb_is_the_standards_curve():
    np.testing.assert_allclose(
        noise.SRGB(np.array([0.0, 0.002, 0.2140411, 1.0])), [0, 0.02584, 0.5, 1], atol=1e-5
    )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: noise.PoissonGaussian(0.0, 0.1), "gain must be positive"),
        (lambda: noise.PoissonGaussian(0.1, 0.0), "read_noise must be positive"),
        (lambda: noise.PoissonGaussian(1.0, 0.001), "0.001 photo-electrons"),
        (lambda: noise.Heteroscedastic([0.0, 1.0]), "black pixel"),
        (lambda: noise.Heteroscedastic([]), "coefficients"),
        (lambda: noise.Heteroscedastic([1.0, -1.0]).weights(ORIGIN, np.array([[2.0]])), "variance is -1"),
        (lambda: noise.SigmaPower(0.0, 2.0), "factor must be positive"),
        (lambda: noise.SigmaTable([1.0, 3.0, 2.0], [1.0, 1.0, 1.0]), "must increase; row 3 does not"),
        (lambda: noise.SigmaTable([1.0, 2.0], [1.0, np.nan]), "sigma in a table"),
        (lambda: noise.SigmaTable([1.0], [1.0]), "two at least"),
        (lambda: noise.Stereo(0.0, 0.1), "baseline must be positive"),
        (lambda: noise.StudentT(0.1, 0.0), "nu must be positive"),
        (lambda: noise.Laplace(-1.0), "scale must be positive"),
        (lambda: noise.Clipped(0.0, 1.0), "sigma must be positive"),
        (lambda: noise.Clipped(0.1, -1.0), "white must be positive"),
        (lambda: noise.ColourBlocks(np.eye(2)).check(4, 5, 3), "but the image is 4 rows"),
        (lambda: noise.ColourBlocks([[1.0, 2.0], [2.0, 1.0]]), "smallest eigenvalue is -1"),
        (lambda: noise.ColourBlocks([[1.0, 0.5], [0.0, 1.0]]), "not symmetric"),
        (lambda: noise.ColourBlocks([1.0, 2.0]), "shape"),
        (lambda: noise.Luminance(0.1), "independent pixels"),
        (lambda: noise.Luminance(noise.Gaussian(1), [0, 0, 0]), "coefficient"),
        (lambda: noise.Luminance(noise.Gaussian(1)).check(4, 5, 4), "3 coefficients"),
        (lambda: noise.Sensor(noise.Gaussian(1), "during"), "'before' or 'after'"),
        (lambda: noise.Sensor(noise.Gaussian(1), "after", 2.2), "response curve"),
        (lambda: noise.Sensor(noise.Gaussian(1), "after", exposure=0.0), "exposure must be positive"),
        (
            lambda: noise.Sensor(noise.ColourBlocks(np.eye(3)), "after", quantisation=noise.Quantisation()),
            "distribution",
        ),
        (lambda: noise.Sensor(1.0, "after"), "independent pixels"),
        (lambda: noise.Quantisation(1), "between 2 and 65536"),
        (lambda: noise.Quantisation(256, 1.0, 0.5), "black must lie below"),
        (lambda: noise.Tabulated([0, 1], [1, 0]), "its y do not"),
        (lambda: noise.Tabulated([0, 1], [1]), "as many x as y"),
        (lambda: noise.Power(0.0), "gamma must be positive"),
        (lambda: noise.Power(2.4, 1e-9, 0.055), "toe"),
    ],
)
def test_impossible_parameters_are_one_line(make, message):
    with pytest.raises(NoiseError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)
