"""Laws that every noise model of independent pixels obeys; a case supplies the true process.

A case gives one pixel: how its measurement is drawn (photons, read noise, curve, rounding; by NumPy), and the
log-likelihood of a measurement, written with SciPy's distributions.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod

import numpy as np

from mitsuba_crb import noise

DRAWS = 20000


class NoiseLaws(ABC):
    """Inherit, and define `model`, `means`, `draw` and `log_likelihood`."""

    model: noise.IndependentNoise
    means = ((0.3, 0.1, 0.7),)
    """Noise-free radiances of the channels at which the laws are tested."""

    @abstractmethod
    def draw(self, rng, mean):
        """(DRAWS, D) measurements of a pixel with the mean (C,), from the true process."""

    @abstractmethod
    def log_likelihood(self, values, mean):
        """(DRAWS,) log probability (density) of measurements (DRAWS, D)."""

    def information(self, mean, model=None):
        """(C, C) what the model says."""
        weights = (model or self.model).weights(np.zeros((1, 2), int), np.array([mean]))[0]
        return np.diag(weights) if weights.ndim == 1 else weights

    def misfit(self, mean, model=None):
        """The largest deviation of the score's covariance from the information, in Monte Carlo errors."""
        values = self.draw(np.random.default_rng(7), np.array(mean))
        step = 1e-4 * (0.01 + np.abs(mean))
        score = np.empty((DRAWS, len(mean)))
        for c, h in enumerate(step):
            shift = h * np.eye(len(mean))[c]
            plus, minus = (self.log_likelihood(values, np.array(mean) + sign * shift) for sign in (1, -1))
            score[:, c] = (plus - minus) / (2 * h)
        score = score - score.mean(axis=0)
        products = score[:, :, None] * score[:, None, :]
        error = products.std(axis=0) / np.sqrt(DRAWS) + 1e-9 * np.abs(products).max()
        return np.max(np.abs(products.mean(axis=0) - self.information(mean, model)) / error)

    def test_information_is_the_covariance_of_the_score_of_the_true_process(self):
        """9 entries within 4 Monte Carlo errors each: 99.9 % of seeds."""
        for mean in self.means:
            assert self.misfit(mean) < 4.0, mean

    def test_distribution_is_that_of_the_true_process(self):
        """P(value ≤ t) to 4 binomial errors, and its derivative by differences."""
        if not isinstance(self.model, noise.ScalarNoise):
            return
        mean = np.array(self.means[0])
        values = self.draw(np.random.default_rng(8), mean)
        thresholds = np.quantile(values, [0.03, 0.3, 0.5, 0.8, 0.99], axis=0).T[None] + 1e-7
        pixels = np.zeros((1, 2), int)
        P, D = self.model.cumulative(thresholds, pixels, mean[None])
        empirical = (values[:, :, None] <= thresholds).mean(axis=0)
        assert np.abs(P[0] - empirical).max() < 4.0 * np.sqrt(0.25 / DRAWS)
        h = 1e-5
        plus, minus = (
            self.model.cumulative(thresholds, pixels, mean[None] + sign * h)[0] for sign in (1, -1)
        )
        np.testing.assert_allclose((plus - minus) / (2 * h), D, rtol=1e-3, atol=1e-6 * np.abs(D).max())

    def test_weights_belong_to_pixels_one_by_one(self):
        means = np.array([*self.means, *self.means[::-1]])
        pixels = np.zeros((len(means), 2), int)
        together = self.model.weights(pixels, means)
        alone = [self.model.weights(pixels[:1], mean[None])[0] for mean in means]
        np.testing.assert_allclose(together, alone, rtol=1e-9)
        assert together.dtype == np.float64

    def test_the_mean_matters_only_where_it_is_said_to(self):
        if not self.model.depends_on_mean:
            np.testing.assert_array_equal(
                self.information((0.1, 0.2, 0.3)), self.information((3.0, 2.0, 1.0))
            )

    def test_it_describes_itself(self):
        assert isinstance(self.model, noise.NoiseModel)
        assert isinstance(self.model, noise.IndependentNoise)
        assert not self.model.couples_pixels
        assert "\n" not in self.model.description
        assert len(self.model.description) < 110
        assert json.loads(json.dumps(self.model.to_dict(), allow_nan=False))["model"]
        self.model.check(1, 1, 3)
