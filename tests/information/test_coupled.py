"""Correlated noise: the information of a Jacobian held whole, and a covariance that repetition confirms."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np
import pytest
from matrices import misfit

from mitsuba_crb import noise
from mitsuba_crb.errors import NoiseError
from mitsuba_crb.information.accumulate import InformationAccumulator
from mitsuba_crb.information.coupled import CoupledComponents, ordered_products
from mitsuba_crb.information.linearisation import PixelSelection
from mitsuba_crb.information.symmetric import pack, symmetrised
from mitsuba_crb.information.ustatistic import VarianceComponents


@dataclasses.dataclass(frozen=True)
class Dense(noise.CoupledNoise):
    """Noise of any covariance, by a dense matrix over all values (pixel by pixel, channel by channel)."""

    covariance: Any
    width: int
    channels: int

    @property
    def description(self):
        return "dense"

    def check(self, height, width, channels):
        pass

    def solve(self, pixels, values):
        index = (pixels[:, 1] * self.width + pixels[:, 0])[:, None] * self.channels
        index = (index + np.arange(self.channels)).ravel()
        if len(index) == len(self.covariance):
            inverse = self.precision[np.ix_(index, index)]
        else:
            inverse = np.linalg.inv(self.covariance[np.ix_(index, index)])
        # No BLAS, whose threads wait for one another on a busy machine.
        return np.einsum("ij,jm->im", inverse, values.reshape(len(index), -1)).reshape(values.shape)

    @functools.cached_property
    def precision(self):
        return np.linalg.inv(self.covariance)

    def to_dict(self):
        return {"model": "dense"}


class Simulation:
    """Estimates of a Jacobian with independent errors, under noise that decays over some pixels."""

    def __init__(
        self, height=12, width=14, *, channels=2, columns=3, reach=2.0, common=0.0, block=1, rough=1.0
    ):
        rng, channels = np.random.default_rng(5), 2
        y, x = np.divmod(np.arange(height * width), width)
        self.pixels = np.stack([x, y], axis=1)
        distance = np.hypot(np.subtract.outer(x, x), np.subtract.outer(y, y))
        covariance = np.kron(np.exp(-distance / reach), np.eye(channels)) if reach else None
        covariance = np.eye(len(x) * channels) if covariance is None else covariance
        self.model = Dense(covariance, width, channels)
        self.J = rough * rng.normal(size=(len(x), channels, columns)) + np.sin(x / 3.0)[:, None, None]
        self.scale = rng.uniform(0.3, 0.9, size=self.J.shape)
        self.common, self.block, self.columns = common, block, columns
        self.film_block = (self.pixels // max(block, 1)) @ [1, 1000]
        flat = self.J.reshape(-1, columns)
        self.truth = flat.T @ np.linalg.solve(covariance, flat)
        self.rng = np.random.default_rng(6)

    def draw(self, batches=4):
        values = self.J + self.scale * self.rng.normal(size=(batches, *self.J.shape))
        if self.common:
            _, index = np.unique(self.film_block, return_inverse=True)
            shared = self.rng.normal(size=(batches, index.max() + 1, *self.J.shape[1:]))
            values += self.common * shared[:, index]
        return values

    def sums(self, values):
        accumulator = InformationAccumulator(
            batches=len(values), block=self.block, columns=self.columns, coupled=True
        )
        accumulator.add_coupled(values, self.model, self.pixels)
        n = len(self.pixels)
        return accumulator.sums(PixelSelection("all", n, n, "all"))


def test_without_monte_carlo_noise_it_is_the_dense_formula():
    sim = Simulation()
    sums = sim.sums(np.broadcast_to(sim.J, (4, *sim.J.shape)))
    assert misfit(sums.matrix, sim.truth) < 1e-11
    assert misfit(sums.plain_matrix, sim.truth) < 1e-11
    assert np.abs(sums.covariance_of_entries).max() < 1e-20 * np.abs(sim.truth).max() ** 2


@pytest.mark.parametrize("block", [1, 4])
def test_with_noise_of_independent_pixels_it_is_what_the_streaming_sums_give(block):
    """The same F̂ and the same unbiased covariance, from ordered pairs as from unordered ones."""
    sim = Simulation(reach=0.0, block=block)
    values = sim.draw(5)
    both = []
    for coupled in (True, False):
        accumulator = InformationAccumulator(batches=5, block=block, columns=3, coupled=coupled)
        if coupled:
            accumulator.add_coupled(values, sim.model, sim.pixels)
        else:
            accumulator.add(values, np.ones(sim.J.shape[:2]), sim.pixels)
        both.append((accumulator._sum, accumulator._plain, accumulator._units.unbiased))
    for coupled, independent in zip(*both, strict=True):
        np.testing.assert_allclose(coupled, independent, rtol=1e-9, atol=1e-11 * np.abs(independent).max())


@pytest.mark.parametrize(("block", "common"), [(1, 0.0), (4, 0.5)])
def test_it_is_unbiased_and_its_covariance_is_that_of_repetitions(block, common):
    """Sample variances of 200 runs have a relative error of 10 %; 6 of them stay within 3.5 errors."""
    sim = Simulation(block=block, common=common)
    runs = [sim.sums(sim.draw()) for _ in range(200)]
    entries = np.array([pack(run.matrix) for run in runs])
    z = (entries.mean(axis=0) - pack(sim.truth)) / (entries.std(axis=0) / np.sqrt(200))
    assert np.abs(z).max() < 4.0
    plain = np.array([pack(run.plain_matrix) for run in runs])
    assert ((plain.mean(axis=0) - pack(sim.truth)) / (plain.std(axis=0) / np.sqrt(200)))[
        [0, 3, 5]
    ].min() > 10.0
    sample = np.cov(entries.T)
    estimate = np.mean([run.covariance_of_entries for run in runs], axis=0)
    assert misfit(estimate, sample) < 0.35


def test_unordered_pairs_would_misjudge_the_variance():
    """Negative control: sym(J_kᵀG_l + J_lᵀG_k)/2 per pixel takes correlated errors for independent ones."""
    sim = Simulation(reach=3.0, rough=0.0)
    estimates, samples = [], []
    for _ in range(100):
        columns = sim.draw().transpose(1, 2, 0, 3)
        solved = sim.model.solve(sim.pixels, columns.reshape(*columns.shape[:2], -1)).reshape(columns.shape)
        h = ordered_products(columns, solved)
        symmetric = 0.5 * (h + h.swapaxes(0, 1))
        units = VarianceComponents(4, 3)
        upper = np.triu_indices(4, 1)
        samples.append(units.add(symmetric[upper]).sum(axis=1))
        estimates.append(np.diagonal(units.unbiased))
    ratio = np.mean(estimates, axis=0) / np.var(samples, axis=0)
    assert np.abs(np.log(ratio)).max() > np.log(1.5)


def test_a_subset_of_pixels_has_the_information_of_its_own_covariance():
    sim = Simulation()
    kept = np.random.default_rng(1).permutation(len(sim.pixels))[:60]
    accumulator = InformationAccumulator(batches=4, columns=3, coupled=True)
    values = np.broadcast_to(sim.J[kept], (4, 60, 2, 3))
    accumulator.add_coupled(values, sim.model, sim.pixels[kept])
    index = (kept[:, None] * 2 + np.arange(2)).ravel()
    J = sim.J[kept].reshape(-1, 3)
    expected = J.T @ np.linalg.inv(sim.model.covariance[np.ix_(index, index)]) @ J
    sums = accumulator.sums(PixelSelection("only", len(sim.pixels), 60, "mask"))
    assert misfit(sums.matrix, expected) < 1e-11
    assert np.linalg.eigvalsh(sim.truth - expected)[0] > 0.0


def test_the_positive_covariance_stays_positive_when_there_is_only_noise():
    rng = np.random.default_rng(3)
    negative = 0
    for _ in range(50):
        components = CoupledComponents(4, 3)
        columns = rng.normal(size=(6, 2, 4, 3))
        components.add(ordered_products(columns, columns + 0.3 * columns[::-1]))
        negative += np.diagonal(components.unbiased).min() < 0.0
        values = np.linalg.eigvalsh(components.positive)
        assert values[0] > -1e-12 * values[-1]
    assert negative > 5


def test_ordered_products_are_what_they_say():
    rng = np.random.default_rng(2)
    J, G = rng.normal(size=(2, 5, 7, 4, 3))
    h = ordered_products(J, G)
    assert h.shape == (4, 4, 6, 5)
    np.testing.assert_allclose(h[1, 3, :, 2], pack(symmetrised(J[2, :, 1].T @ G[2, :, 3])), rtol=1e-12)


def test_a_random_subset_is_refused():
    with pytest.raises(NoiseError, match="random subset"):
        InformationAccumulator(batches=4, sampled=True, coupled=True)


def test_a_model_that_leaves_no_information_is_refused():
    accumulator = InformationAccumulator(batches=4)
    pixels = np.array([[0, 0], [1, 0]])
    accumulator.add(np.ones((4, 2, 3, 6)), np.zeros((2, 3)), pixels)
    with pytest.raises(NoiseError, match="all are saturated or ignored"):
        accumulator.sums(PixelSelection("all", 2, 2, "all"))
