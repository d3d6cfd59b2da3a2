"""Information of the pose together with nuisance parameters: more columns, Schur complements, undoing."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest

from mitsuba_crb.information import BLOCK, InformationAccumulator, PixelSelection
from mitsuba_crb.symmetric import pack

ALL = PixelSelection("all", 16 * 32, 16 * 32, "all")


class Columns:
    """A Jacobian of six columns of the twist and some more, and estimates of it with independent errors."""

    def __init__(self, nuisances: int = 2, *, noise: float = 0.8, batches: int = 4, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        y, x = np.divmod(np.arange(16 * 32), 32)
        self.pixels = np.stack([x, y], axis=1)
        mixing = rng.normal(size=(6 + nuisances, 6 + nuisances))
        self.J = (rng.normal(size=(len(x), 3, 6 + nuisances)) + 0.5) @ mixing
        self.weights = rng.uniform(0.5, 2.0, size=(len(x), 3))
        self.noise, self.batches = noise, batches
        self.rng = np.random.default_rng(seed + 1)
        self.truth = np.einsum("nci,nc,ncj->ij", self.J, self.weights, self.J)

    def draw(self):
        return self.J + self.noise * self.rng.normal(size=(self.batches, *self.J.shape))

    def sums(self, values, *, block=1, sampled=False, selection=ALL):
        accumulator = InformationAccumulator(
            batches=len(values), block=block, sampled=sampled, columns=values.shape[-1]
        )
        accumulator.add(values, self.weights, self.pixels)
        return accumulator.sums(selection)


class TestMoreColumns:
    @pytest.mark.parametrize("block", [1, BLOCK])
    @pytest.mark.parametrize("kind", ["all", "random"])
    def test_the_pose_block_is_the_information_of_six_columns(self, block, kind):
        view = Columns(3)
        values = view.draw()
        selection = PixelSelection(kind, 1024, 512, kind)
        joint = view.sums(values, block=block, sampled=True, selection=selection)
        six = view.sums(values[..., :6], block=block, sampled=True, selection=selection)
        np.testing.assert_allclose(joint.matrix[:6, :6], six.matrix, rtol=1e-10)
        np.testing.assert_allclose(joint.plain_matrix[:6, :6], six.plain_matrix, rtol=1e-10)
        rows, columns = np.triu_indices(9)
        pose = (rows < 6) & (columns < 6)
        part = joint.covariance_of_entries[np.ix_(pose, pose)]
        # The positive part is taken of the whole, which changes little of the part.
        scale = np.sqrt(np.diagonal(six.covariance_of_entries))
        assert np.abs(part - six.covariance_of_entries).max() / np.outer(scale, scale).max() < 0.2
        np.testing.assert_allclose(np.diagonal(part), np.diagonal(six.covariance_of_entries), rtol=1e-8)

    def test_without_monte_carlo_noise_it_is_the_gram_matrix(self):
        view = Columns(2, noise=0.0)
        sums = view.sums(view.draw())
        np.testing.assert_allclose(sums.matrix, view.truth, rtol=1e-10, atol=1e-10 * view.truth.max())

    def test_covariance_of_entries_is_the_enumeration_of_disjoint_pairs(self):
        view = Columns(1)
        values = view.draw()
        accumulator = InformationAccumulator(batches=4, columns=7)
        accumulator.add(values, view.weights, view.pixels)
        h = {
            (k, j): pack(np.einsum("nci,nc,ncj->nij", values[k], view.weights, values[j]))
            + pack(np.einsum("nci,nc,ncj->nji", values[k], view.weights, values[j]))
            for k, j in permutations(range(4), 2)
        }
        mean = np.mean(list(h.values()), axis=0)
        expected = mean.T @ mean - np.mean(
            [h[k, j].T @ h[p, q] for k, j, p, q in permutations(range(4), 4)], axis=0
        )
        actual = accumulator._units.unbiased
        np.testing.assert_allclose(actual, 0.25 * expected, atol=1e-9 * np.abs(expected).max())
