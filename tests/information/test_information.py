"""The information estimate: unbiased, with a covariance of its entries that is what repetition shows.

Simulated Jacobians with known truth; every statistical statement has a closed form or a brute-force
enumeration beside the simulation, and a negative control.
"""

from __future__ import annotations

import dataclasses
import json
from itertools import combinations, pairwise, permutations

import numpy as np
import pytest
from matrices import misfit
from rigs import about, made

from mitsuba_crb import noise, se3
from mitsuba_crb.errors import FrameError, NoiseError, OptionError, PixelsError, RadianceError
from mitsuba_crb.information.accumulate import InformationAccumulator
from mitsuba_crb.information.blocks import BLOCK, in_squares
from mitsuba_crb.information.image_information import fisher_information
from mitsuba_crb.information.image_jacobian import ImageJacobian
from mitsuba_crb.information.linearisation import PixelSelection
from mitsuba_crb.information.symmetric import congruence, pack, positive_part, triangle, unpack
from mitsuba_crb.information.ustatistic import (
    VarianceComponents,
    disjoint_products,
    pixel_products,
    unit_grams,
    unit_products,
    whiten,
)

POSE = se3.exp([1.0, -2.0, 0.5, 0.4, -0.3, 0.8])
FAR = np.array([[1.0, 0, 0, 1e4], [0, 1, 0, -7e3], [0, 0, 1, 2e3], [0, 0, 0, 1]]) @ POSE


def _grid(height, width):
    y, x = np.divmod(np.arange(height * width), width)
    return np.stack([x, y], axis=1)


def _selection(kind, total, selected=None):
    return PixelSelection(kind, total, total if selected is None else selected, kind)


def _information(
    values, weights, pixels, *, block=1, selection=None, sampled=False, frame="camera", pose=POSE
):
    accumulator = InformationAccumulator(batches=len(values), block=block, sampled=sampled)
    accumulator.add(values, weights, pixels)
    selection = selection or _selection("all", len(pixels))
    return accumulator.information(about(frame=frame, pose=pose, selection=selection))


def _truth(J, weights):
    return np.einsum("nci,nc,ncj->ij", J, weights, J)


def _made(matrix, covariance=None, **changes):
    return made(matrix, covariance, **({"pose": POSE, "selection": _selection("all", 10)} | changes))


class Simulation:
    """A Jacobian, and estimates of it with errors that may be shared within blocks of the film."""

    def __init__(self, height, width, *, batches=4, noise=0.8, common=0.0, seed=0):
        rng = np.random.default_rng(seed)
        self.pixels = _grid(height, width)
        n = len(self.pixels)
        mixing = rng.normal(size=(6, 6))
        self.J = (rng.normal(size=(n, 3, 6)) + 0.5) @ mixing
        self.weights = rng.uniform(0.5, 2.0, size=(n, 3))
        self.scale = noise * rng.uniform(0.5, 1.5, size=(n, 3, 1)) * np.linspace(1.0, 3.0, 6)
        self.common, self.batches = common, batches
        self.block = (self.pixels // BLOCK) @ [1, 1000]
        self.truth = _truth(self.J, self.weights)
        self._rng = np.random.default_rng(seed + 1)

    def draw(self):
        values = self.J + self.scale * self._rng.normal(size=(self.batches, *self.J.shape))
        if self.common:
            blocks, index = np.unique(self.block, return_inverse=True)
            shared = self._rng.normal(size=(self.batches, len(blocks), 1, 6))
            values += self.common * shared[:, index]
        return values

    def information(self, **options):
        return _information(self.draw(), self.weights, self.pixels, **options)


class TestMean:
    def test_without_monte_carlo_noise_it_is_the_gram_matrix(self):
        sim = Simulation(20, 30, noise=0.0)
        for block in (1, BLOCK):
            information = sim.information(block=block)
            assert misfit(information.matrix, sim.truth) < 1e-12
            assert misfit(information.plain_matrix, sim.truth) < 1e-12
            assert np.abs(information.standard_error).max() < 1e-12 * np.abs(sim.truth).max()

    @pytest.mark.parametrize("batches", [4, 5, 7])
    def test_it_is_the_formula_of_sums_over_batches(self, batches):
        sim = Simulation(18, 17, batches=batches)
        values = sim.draw()
        total = _truth(values.sum(axis=0), sim.weights)
        squares = sum(_truth(v, sim.weights) for v in values)
        expected = (total - squares) / (batches * (batches - 1))
        for block in (1, BLOCK):
            information = _information(values, sim.weights, sim.pixels, block=block)
            assert misfit(information.matrix, expected) < 1e-11
            assert misfit(information.plain_matrix, total / batches**2) < 1e-12

    def test_it_is_unbiased_where_the_plain_product_is_not(self):
        sim = Simulation(16, 16)
        runs = [sim.information() for _ in range(300)]
        matrices = np.array([run.matrix for run in runs])
        z = (matrices.mean(axis=0) - sim.truth) / (matrices.std(axis=0) / np.sqrt(len(runs)))
        # 21 standard normal numbers: all below 4 with 99.9 % confidence.
        assert np.abs(z).max() < 4.0
        plain = np.array([run.plain_matrix for run in runs])
        z = (plain.mean(axis=0) - sim.truth) / (plain.std(axis=0) / np.sqrt(len(runs)))
        assert np.diagonal(z).min() > 20.0
        # The plain excess is E[δJᵀ W δJ] = Σ w v / K.
        excess = np.sum(sim.weights[..., None] * sim.scale**2, axis=(0, 1)) / sim.batches
        error = plain.std(axis=0).diagonal() / np.sqrt(len(runs))
        assert np.abs((plain.mean(axis=0) - sim.truth).diagonal() - excess).max() < 4.0 * error.max()

    def test_noise_inflation_is_the_plain_excess_in_scaled_units(self):
        sim = Simulation(32, 32, noise=0.5)
        information = sim.information()
        scale = np.array([2.0] * 3 + [1.0] * 3)
        expected = np.trace(information.plain_matrix * np.outer(scale, scale))
        expected = expected / np.trace(information.matrix * np.outer(scale, scale)) - 1.0
        assert expected > 0.01
        assert information.noise_inflation == pytest.approx(expected)
        assert information.to_frame("world").noise_inflation == pytest.approx(expected)
        assert _made(np.eye(6)).noise_inflation is None
        assert _made(-np.eye(6), plain_matrix=np.eye(6)).noise_inflation == np.inf


def _enumerated_covariance(values, weights, groups):
    """F̂F̂ᵀ less the mean over all disjoint pairs of pairs of batches, summed over groups of pixels."""
    K = len(values)
    total = np.zeros((21, 21))
    for group in groups:
        v, w = values[:, group], weights[group]
        h = {}
        for k, j in permutations(range(K), 2):
            product = np.einsum("nci,nc,ncj->ij", v[k], w, v[j])
            h[k, j] = pack(0.5 * (product + product.T))
        mean = np.mean(list(h.values()), axis=0)
        disjoint = [np.outer(h[k, j], h[p, q]) for k, j, p, q in permutations(range(K), 4)]
        total += np.outer(mean, mean) - np.mean(disjoint, axis=0)
    return total


class TestCovarianceOfEntries:
    @pytest.mark.parametrize("batches", [4, 5])
    def test_its_unbiased_form_is_the_enumeration_of_disjoint_pairs(self, batches):
        sim = Simulation(17, 20, batches=batches)
        values = sim.draw()
        quad = (sim.pixels // 4) @ [1, 1000]
        for block, groups in (
            (BLOCK, [sim.block == b for b in np.unique(sim.block)]),
            (1, [quad == q for q in np.unique(quad)]),
        ):
            accumulator = InformationAccumulator(batches=batches, block=block)
            accumulator.add(values, sim.weights, sim.pixels)
            expected = _enumerated_covariance(values, sim.weights, groups)
            actual = accumulator._units.unbiased
            np.testing.assert_allclose(actual, expected, atol=1e-9 * np.abs(expected).max())

    @pytest.mark.slow
    @pytest.mark.parametrize(("size", "block", "common"), [((16, 32), 1, 0.0), ((48, 64), BLOCK, 0.3)])
    def test_it_is_the_covariance_of_repetitions(self, size, block, common):
        """Sample variances of 250 runs have a relative error of 9 %; 21 of them stay within 4 errors."""
        sim = Simulation(*size, noise=0.5, common=common)
        runs = [sim.information(block=block) for _ in range(250)]
        sample = np.cov(np.array([pack(run.matrix) for run in runs]).T)
        estimate = np.mean([run.covariance_of_entries for run in runs], axis=0)
        np.testing.assert_allclose(np.diagonal(estimate) / np.diagonal(sample), 1.0, atol=0.36)
        assert misfit(estimate, sample) < 0.36

    def test_pixels_taken_for_independent_would_hide_what_a_block_shares(self):
        sim = Simulation(32, 48, noise=0.5, common=0.6)
        runs = [sim.information(block=1) for _ in range(100)]
        sample = np.var([pack(run.matrix) for run in runs], axis=0)
        estimate = np.mean([np.diagonal(run.covariance_of_entries) for run in runs], axis=0)
        assert np.median(estimate / sample) < 0.5

    def test_diagonal_entries_have_the_closed_form_variance(self):
        """Var F̂_ii = 4 Σ w² J² v / K + 2 Σ w² v² / (K (K−1)) for independent errors of variance v."""
        sim = Simulation(64, 64, noise=0.8)
        w, v, K = sim.weights[..., None], sim.scale**2, sim.batches
        expected = 4 * np.sum(w**2 * sim.J**2 * v, (0, 1)) / K + 2 * np.sum(w**2 * v**2, (0, 1)) / (
            K * (K - 1)
        )
        estimates = [
            np.diagonal(unpack(np.diagonal(sim.information().covariance_of_entries))) for _ in range(40)
        ]
        mean, error = np.mean(estimates, axis=0), np.std(estimates, axis=0) / np.sqrt(40)
        assert np.all(np.abs(mean - expected) < 4 * error)
        assert np.all(4 * error < 0.1 * expected)

    def test_intervals_cover(self):
        sim = Simulation(32, 32)
        z = []
        for _ in range(200):
            run = sim.information()
            z.append(np.diagonal((run.matrix - sim.truth) / run.standard_error))
        # Of 200 intervals at 95 %, fewer than 90 % or more than 99 % cover with a probability of 0.3 %.
        coverage = np.mean(np.abs(z) < 1.96, axis=0)
        assert np.all((coverage >= 0.90) & (coverage <= 0.99))

    @pytest.mark.parametrize("size", [(16, 16), (32, 32)])
    def test_it_stays_positive_when_there_are_few_blocks_and_only_noise(self, size):
        sim = Simulation(*size)
        sim.J[:] = 0.0
        negative = 0
        for _ in range(50):
            accumulator = InformationAccumulator(batches=4, block=BLOCK)
            accumulator.add(sim.draw(), sim.weights, sim.pixels)
            negative += np.diagonal(accumulator._units.unbiased).min() < 0.0
            values = np.linalg.eigvalsh(accumulator._units.positive)
            assert values[0] > -1e-12 * values[-1]
        assert negative > 10  # the unbiased estimate alone would claim certainty

    def test_it_scales_exactly_with_the_units(self):
        """Millimetres for metres: each entry of F scales by the powers of 1000 of its columns."""
        sim = Simulation(16, 32)
        values = sim.draw()
        scale = np.array([1e-3] * 3 + [1.0] * 3)
        metres = _information(values, sim.weights, sim.pixels, block=BLOCK)
        millimetres = _information(values * scale, sim.weights, sim.pixels, block=BLOCK)
        T = congruence(np.diag(scale))
        np.testing.assert_allclose(
            millimetres.covariance_of_entries, T @ metres.covariance_of_entries @ T.T, rtol=1e-6, atol=0.0
        )


class TestPositivePart:
    A = np.array([[3.0, 1.0, 0.5], [1.0, -1.0, 0.2], [0.5, 0.2, 2.0]])

    def test_it_is_positive_and_keeps_a_positive_diagonal(self):
        metric = np.diag([3.0, 2.0, 2.0])
        part = positive_part(self.A, metric)
        assert np.linalg.eigvalsh(part)[0] > -1e-14
        np.testing.assert_allclose(np.diagonal(part), [3.0, 0.0, 2.0], atol=1e-14)

    def test_what_is_positive_already_stays(self):
        positive = self.A @ self.A
        np.testing.assert_allclose(positive_part(positive, np.diag([9.0, 2.0, 5.0])), positive, rtol=1e-12)

    def test_it_does_not_depend_on_units(self):
        scale = np.diag([1.0, 1e3, 1e-6])
        metric = np.diag([3.0, 2.0, 2.0])
        moved = positive_part(scale @ self.A @ scale, scale @ metric @ scale)
        np.testing.assert_allclose(moved, scale @ positive_part(self.A, metric) @ scale, rtol=1e-10)

    def test_a_singular_metric_is_no_obstacle(self):
        A = np.diag([3.0, -1.0, 0.0])
        np.testing.assert_allclose(positive_part(A, np.diag([1.0, 1, 0])), np.diag([3.0, 0, 0]), atol=1e-14)
        np.testing.assert_array_equal(positive_part(np.zeros((3, 3)), np.zeros((3, 3))), np.zeros((3, 3)))


class TestTiles:
    @pytest.mark.parametrize("block", [1, BLOCK])
    @pytest.mark.parametrize("tile", [16, 32, 48])
    def test_tile_size_and_order_do_not_matter(self, tile, block):
        sim = Simulation(50, 70)
        values = sim.draw()
        whole = _information(values, sim.weights, sim.pixels, block=block)
        accumulator = InformationAccumulator(batches=4, block=block)
        tiles = (sim.pixels // tile) @ [1, 1000]
        rng = np.random.default_rng(7)
        for t in rng.permutation(np.unique(tiles)):
            index = rng.permutation(np.flatnonzero(tiles == t))
            accumulator.add(values[:, index], sim.weights[index], sim.pixels[index])
        tiled = accumulator.information(about(selection=_selection("all", 3500)))
        assert misfit(tiled.matrix, whole.matrix) < 1e-12
        assert misfit(tiled.plain_matrix, whole.plain_matrix) < 1e-12
        tolerance = 1e-10 * np.abs(whole.covariance_of_entries).max()
        np.testing.assert_allclose(tiled.covariance_of_entries, whole.covariance_of_entries, atol=tolerance)

    def test_pixel_order_does_not_change_a_bit(self):
        sim = Simulation(20, 40)
        values = sim.draw()
        index = np.random.default_rng(8).permutation(800)
        a = _information(values, sim.weights, sim.pixels, block=BLOCK)
        b = _information(values[:, index], sim.weights[index], sim.pixels[index], block=BLOCK)
        np.testing.assert_array_equal(a.matrix, b.matrix)
        np.testing.assert_array_equal(a.covariance_of_entries, b.covariance_of_entries)

    def test_a_block_in_two_calls_is_refused(self):
        sim = Simulation(16, 20)
        values = sim.draw()
        accumulator = InformationAccumulator(batches=4, block=BLOCK)
        accumulator.add(values[:, :100], sim.weights[:100], sim.pixels[:100])
        with pytest.raises(PixelsError, match="two calls"):
            accumulator.add(values[:, 100:], sim.weights[100:], sim.pixels[100:])


class TestRandomSubset:
    """Simple random sampling of n of N pixels: the whole image's information, with its sampling variance."""

    def test_without_noise_it_is_the_textbook_variance(self):
        sim = Simulation(20, 20, noise=0.0)
        index = np.random.default_rng(9).choice(400, 100, replace=False)
        information = _information(
            sim.draw()[:, index],
            sim.weights[index],
            sim.pixels[index],
            selection=_selection("random", 400, 100),
            sampled=True,
        )
        per_pixel = np.array([pack(_truth(sim.J[[i]], sim.weights[[i]])) for i in index])
        expected = 400**2 * (1 - 0.25) / 100 * np.cov(per_pixel.T)
        np.testing.assert_allclose(
            information.matrix, 4.0 * _truth(sim.J[index], sim.weights[index]), rtol=1e-12
        )
        assert misfit(information.covariance_of_entries, expected) < 1e-9

    @pytest.mark.parametrize(("block", "common", "fraction"), [(1, 0.0, 0.3), (BLOCK, 0.3, 0.4)])
    def test_matrix_and_covariance_are_unbiased_over_subsets_and_noise(self, block, common, fraction):
        """Sample variances of 250 runs have a relative error of 9 %; 21 of them stay within 4 errors."""
        sim = Simulation(32, 32, noise=0.8, common=common)
        rng = np.random.default_rng(10)
        N, n = 1024, int(1024 * fraction)
        matrices, covariances, monte_carlo = [], [], []
        for _ in range(250):
            index = rng.choice(N, n, replace=False)
            run = _information(
                sim.draw()[:, index],
                sim.weights[index],
                sim.pixels[index],
                block=block,
                selection=_selection("random", N, n),
                sampled=True,
            )
            matrices.append(pack(run.matrix))
            covariances.append(run.covariance_of_entries)
        sample = np.var(matrices, axis=0)
        z = (np.mean(matrices, axis=0) - pack(sim.truth)) / np.sqrt(sample / 250)
        assert np.abs(z).max() < 4.0
        np.testing.assert_allclose(np.mean(covariances, axis=0).diagonal() / sample, 1.0, atol=0.36)
        # Negative control: the Monte Carlo covariance alone, which forgets that other pixels could be drawn.
        for _ in range(20):
            index = rng.choice(N, n, replace=False)
            only = _information(
                sim.draw()[:, index],
                sim.weights[index],
                sim.pixels[index],
                block=block,
                selection=_selection("only", N, n),
            )
            monte_carlo.append((N / n) ** 2 * np.diagonal(only.covariance_of_entries))
        assert np.min(np.mean(monte_carlo, axis=0) / sample) < 0.5

    @pytest.mark.parametrize("batches", [4, 5])
    @pytest.mark.parametrize(("block", "share"), [(BLOCK, 0.03), (BLOCK, 0.4), (1, 0.3)])
    def test_covariance_is_cochrans_with_the_noise_of_pixels_and_blocks(self, batches, block, share):
        """N²(1−f)/n s² + (N/n)² [f V + (1−f) n/(n−1) (V − ΣV_u)], s² of F̂_u, noise included (13.9)."""
        sim = Simulation(64, 64, batches=batches, common=0.3, noise=0.3)
        N, n = 4096, int(4096 * share)
        f = n / N
        index = np.random.default_rng(4).choice(N, n, replace=False)
        values, weights = sim.draw()[:, index], sim.weights[index]
        accumulator = InformationAccumulator(batches=batches, block=block, sampled=True)
        accumulator.add(values, weights, sim.pixels[index])
        sums = accumulator.sums(_selection("random", N, n))
        of_pixel = [_enumerated_covariance(values, weights, [slice(i, i + 1)]) for i in range(n)]
        groups = [sim.block[index] == b for b in np.unique(sim.block[index])] if block > 1 else None
        V_u = np.sum(of_pixel, axis=0)
        V = V_u if groups is None else _enumerated_covariance(values, weights, groups)
        each = pixel_products(whiten(values, np.sqrt(weights))).mean(axis=0)
        s2 = np.cov(each)
        between = N**2 * (1 - f) / n * s2 + (N / n) ** 2 * (1 - f) * n / (n - 1) * (V - V_u)
        expected = between + (N / n) ** 2 * f * V
        # Close, not equal: what is negative by chance is made positive, which keeps the diagonal.
        np.testing.assert_allclose(np.diagonal(sums.covariance_of_entries), np.diagonal(expected), rtol=1e-6)
        assert misfit(sums.covariance_of_entries, expected) < 0.05

    def test_all_pixels_at_random_are_all_pixels(self):
        sim = Simulation(16, 16)
        values = sim.draw()
        every = _information(values, sim.weights, sim.pixels)
        drawn = _information(values, sim.weights, sim.pixels, selection=_selection("random", 256, 256))
        np.testing.assert_array_equal(drawn.matrix, every.matrix)
        np.testing.assert_array_equal(drawn.covariance_of_entries, every.covariance_of_entries)

    def test_only_means_no_scaling(self):
        sim = Simulation(16, 16)
        values = sim.draw()
        half = sim.pixels[:128]
        information = _information(
            values[:, :128], sim.weights[:128], half, selection=_selection("only", 256, 128)
        )
        np.testing.assert_array_equal(
            information.matrix, _information(values[:, :128], sim.weights[:128], half).matrix
        )

    def test_it_needs_the_sampling_sums_and_two_pixels(self):
        sim = Simulation(16, 16)
        values = sim.draw()
        with pytest.raises(PixelsError, match="sampled=True"):
            _information(
                values[:, :9], sim.weights[:9], sim.pixels[:9], selection=_selection("random", 256, 9)
            )
        with pytest.raises(PixelsError, match="at least two"):
            _information(
                values[:, :1],
                sim.weights[:1],
                sim.pixels[:1],
                selection=_selection("random", 256, 1),
                sampled=True,
            )


class PlaneView:
    """A pinhole view of a textured plane, a smooth function of the pose: oracle for both Jacobians."""

    def __init__(self, world_from_camera):
        self.pose = world_from_camera
        self.pixels = _grid(24, 32)
        x, y = self.pixels.T
        self.rays = np.stack([-(x - 15.5) / 24, -(y - 11.5) / 24, np.ones(len(x))], axis=1)
        # The plane n·p = 0 through a point three units before the camera, slanted, fixed in the world.
        self.origin = world_from_camera[:3, :3] @ [0.1, 0.2, 3.0]
        self.normal = world_from_camera[:3, :3] @ np.array([0.2, -0.3, 1.0])
        self.anchor = world_from_camera[:3, 3]

    def image(self, relative):
        """Radiance with the camera at `relative` (4 x 4) with respect to world axes at the anchor."""
        rays = self.rays @ relative[:3, :3].T
        t = (self.normal @ (self.origin - relative[:3, 3])) / (rays @ self.normal)
        points = relative[:3, 3] + t[:, None] * rays
        phase = points @ np.array([[2.0, 1.1, -0.7], [0.4, -1.9, 1.3], [1.0, 0.5, 2.2]]).T
        return np.sin(phase)

    def differentiate(self, frame):
        """∂I/∂ξ by central differences, computed relative to the anchor so that 10 km cost no digits."""
        here = self.pose.copy()
        here[:3, 3] = 0.0
        # A rotation about the world's origin moves a far camera by |anchor| times its angle.
        h, columns = 1e-5 / max(1.0, np.linalg.norm(self.anchor)), []
        for e in np.eye(6):
            images = []
            for step in (h * e, -h * e):
                if frame == "camera":
                    moved = here @ se3.exp(step)
                else:
                    # exp(ξ) applied at the world's origin, then seen from the anchor.
                    g = se3.exp(step)
                    moved = g @ here
                    moved[:3, 3] += (g[:3, :3] - np.eye(3)) @ self.anchor
                images.append(self.image(moved))
            columns.append((images[0] - images[1]) / (2 * h))
        return np.stack(columns, axis=-1)

    def jacobian(self, frame, noise=0.0, block=1):
        J = self.differentiate(frame)
        rng = np.random.default_rng(12)
        values = J + noise * J.std() * rng.normal(size=(4, *J.shape)) if noise else np.stack([J] * 4)
        image = np.empty((24, 32, 3))
        x, y = self.pixels.T
        image[y, x] = 0.5
        linearisation = about(frame=frame, pose=self.pose, length_scale=3.0, selection=_selection("all", 768))
        return ImageJacobian(values, self.pixels, image, block, linearisation=linearisation)


class TestFrames:
    # At 10 km the step of the difference quotient is 1e-9, and its rounding 1e-7 of values above derivatives.
    @pytest.mark.parametrize(("pose", "tolerance"), [(POSE, 1e-8), (FAR, 1e-5)])
    def test_the_jacobian_in_the_other_frame_is_the_derivative_there(self, pose, tolerance):
        view = PlaneView(pose)
        moved = view.jacobian("camera").to_frame("world").values
        derived = view.differentiate("world")
        np.testing.assert_allclose(moved, derived, atol=tolerance * np.abs(derived).max())
        assert np.abs(view.differentiate("camera") - derived).max() > 0.1 * np.abs(derived).max()

    @pytest.mark.parametrize(("pose", "tolerance"), [(POSE, 1e-8), (FAR, 1e-5)])
    def test_transported_information_is_the_information_of_the_other_jacobian(self, pose, tolerance):
        view = PlaneView(pose)
        transported = (
            fisher_information(view.jacobian("camera"), noise.Gaussian(0.1)).to_frame("world").matrix
        )
        derived = view.differentiate("world")
        expected = _truth(derived, np.full(derived.shape[:2], 100.0))
        assert misfit(transported, expected) < tolerance

    @pytest.mark.parametrize("pose", [POSE, FAR])
    def test_the_quadratic_form_is_invariant(self, pose):
        view = PlaneView(pose)
        camera = fisher_information(view.jacobian("camera", noise=0.2), noise.Gaussian(0.1))
        world = camera.to_frame("world")
        A = se3.adjoint(pose)
        for twist in np.random.default_rng(13).normal(size=(50, 6)):
            moved = A @ twist
            error = abs(moved @ world.matrix @ moved - twist @ camera.matrix @ twist)
            assert error < 1e-9 * np.linalg.norm(world.matrix) * (moved @ moved)
            variances = [
                pack(np.outer(t, t) * (2 - np.eye(6)))
                @ f.covariance_of_entries
                @ pack(np.outer(t, t) * (2 - np.eye(6)))
                for t, f in ((twist, camera), (moved, world))
            ]
            bound = 1e-9 * np.linalg.norm(world.covariance_of_entries) * (moved @ moved) ** 2
            assert abs(variances[0] - variances[1]) < bound

    def test_an_information_asked_in_world_frame_equals_one_computed_there(self):
        view = PlaneView(POSE)
        jacobian = view.jacobian("camera", noise=0.2)
        a = fisher_information(jacobian, noise.Gaussian(0.1)).to_frame("world")
        b = fisher_information(jacobian.to_frame("world"), noise.Gaussian(0.1))
        assert b.frame == "world"
        assert misfit(a.matrix, b.matrix) < 1e-9
        np.testing.assert_allclose(a.standard_error, b.standard_error, rtol=1e-7)

    def test_the_way_back_from_far_away_loses_nothing(self):
        camera = fisher_information(PlaneView(FAR).jacobian("camera", noise=0.2), noise.Gaussian(0.1))
        world = camera.to_frame("world")
        np.testing.assert_array_equal(world.to_frame("camera").matrix, camera.matrix)
        # Negative control: the world matrix alone has lost digits.
        forgetful = dataclasses.replace(world).to_frame("camera").matrix
        assert np.abs(forgetful / camera.matrix - 1.0).max() > 1e-10

    def test_entries_covariance_moves_with_the_matrix(self):
        """A covariance made of samples must move to the covariance of the moved samples."""
        rng = np.random.default_rng(14)
        samples = rng.normal(size=(40, 6, 6))
        samples = samples + samples.swapaxes(1, 2)
        information = _made(samples.mean(axis=0), np.cov(pack(samples).T))
        A = rng.normal(size=(6, 6))
        moved = information.transform(A, variable="body", frame="world", pose=FAR)
        assert misfit(moved.matrix, (A.T @ samples @ A).mean(axis=0)) < 1e-10
        assert misfit(moved.covariance_of_entries, np.cov(pack(A.T @ samples @ A).T)) < 1e-9
        np.testing.assert_allclose(moved.standard_error[2, 4], np.std((A.T @ samples @ A)[:, 2, 4], ddof=1))
        assert (moved.variable, moved.frame) == ("body", "world")
        np.testing.assert_array_equal(moved.pose, FAR)

    def test_an_unknown_frame_is_refused(self):
        with pytest.raises(FrameError, match="expected 'camera' or 'world'"):
            _made(np.eye(6)).to_frame("body")
        with pytest.raises(FrameError, match="expected 'camera' or 'world'"):
            _made(np.eye(6), frame="body")
        with pytest.raises(FrameError, match="expected 'camera' or 'world'"):
            PlaneView(POSE).jacobian("camera").to_frame("body")


class TestAddition:
    def test_matrices_and_covariances_add(self):
        a = _made(np.diag(np.arange(1.0, 7.0)), np.eye(21), plain_matrix=2 * np.eye(6))
        b = _made(np.full((6, 6), 0.5), 2 * np.eye(21), plain_matrix=np.eye(6), length_scale=5.0)
        total = a + b
        np.testing.assert_array_equal(total.matrix, a.matrix + b.matrix)
        np.testing.assert_array_equal(total.covariance_of_entries, 3 * np.eye(21))
        np.testing.assert_array_equal(total.plain_matrix, 3 * np.eye(6))
        assert total.length_scale == (b + a).length_scale == 5.0
        assert (total.selection.total, total.selection.selected) == (20, 20)
        assert (a + dataclasses.replace(b, plain_matrix=None)).plain_matrix is None

    def test_two_halves_of_an_image_add_to_the_whole(self):
        sim = Simulation(32, 32)
        values = sim.draw()
        halves = [
            _information(values[:, part], sim.weights[part], sim.pixels[part])
            for part in (slice(0, 512), slice(512, 1024))
        ]
        whole = _information(values, sim.weights, sim.pixels)
        assert misfit((halves[0] + halves[1]).matrix, whole.matrix) < 1e-12

    def test_far_world_frames_add_as_precisely_as_camera_frames(self):
        a, b = (_made(M, pose=FAR) for M in (np.diag([1.0, 2, 3, 4, 5, 6]), np.eye(6)))
        total = a.to_frame("world") + b.to_frame("world")
        assert total.frame == "world"
        np.testing.assert_array_equal(total.to_frame("camera").matrix, (a + b).matrix)

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"variable": "other"}, "about 'camera' and about 'other'"),
            ({"frame": "world"}, "camera and in the world frame"),
            ({"pose": FAR}, "two different poses"),
            ({"pose": POSE @ se3.exp([0, 0, 0, 0, 0, 1e-6])}, "two different poses"),
        ],
    )
    def test_mixing_is_refused(self, changes, message):
        with pytest.raises(FrameError, match=message):
            _made(np.eye(6)) + _made(np.eye(6), **changes)

    def test_other_types_do_not_add(self):
        with pytest.raises(TypeError):
            _made(np.eye(6)) + np.eye(6)

    def test_rounding_of_the_pose_does_not_prevent_adding(self):
        nearby = POSE * (1 + 1e-14)
        nearby[3] = [0, 0, 0, 1]
        assert (_made(np.eye(6)) + _made(np.eye(6), pose=nearby)).matrix[0, 0] == 2.0


def _jacobian(sim, values, block=1):
    height, width = sim.pixels[-1, ::-1] + 1
    linearisation = about(pose=POSE, selection=_selection("all", height * width))
    return ImageJacobian(values, sim.pixels, np.ones((height, width, 3)), block, linearisation=linearisation)


class TestDifference:
    def test_it_is_that_of_the_pixels_that_both_have_whatever_their_order(self):
        sim = Simulation(8, 12)
        a, b = (_jacobian(sim, sim.draw()) for _ in range(2))
        rng = np.random.default_rng(3)
        kept = rng.permutation(96)[:80], rng.permutation(96)[:70]
        both = np.intersect1d(*kept)
        parts = [
            dataclasses.replace(
                jacobian, batch_values=jacobian.batch_values[:, index], pixels=sim.pixels[index]
            )
            for jacobian, index in zip((a, b), kept, strict=True)
        ]
        difference = parts[0] - parts[1]
        np.testing.assert_array_equal(difference.pixels, sim.pixels[both])
        np.testing.assert_array_equal(difference.batch_values, (a.batch_values - b.batch_values)[:, both])
        assert (difference.selection.kind, difference.selection.selected) == ("only", len(both))
        assert (a - b).selection == a.selection

    @pytest.mark.parametrize(("blocks", "expected"), [((1, 1), 1), ((1, 8), 8), ((8, 1), 8), ((8, 16), 16)])
    def test_its_errors_are_independent_where_both_sides_are(self, blocks, expected):
        sim = Simulation(8, 12)
        a, b = (_jacobian(sim, sim.draw(), block=block) for block in blocks)
        assert (a - b).block == expected

    @pytest.mark.slow
    def test_its_covariance_of_entries_is_that_of_repetitions(self):
        """Of 100 runs, to a median within 25 %; with the blocks of the other side it hides what is shared."""
        sim, other = Simulation(48, 64, noise=0.5, common=0.6), Simulation(48, 64, noise=0.5, seed=5)
        other.J = 0.8 * sim.J
        wide, narrow, found = [], [], []
        for _ in range(100):
            a = _jacobian(sim, sim.draw(), block=BLOCK)
            b = _jacobian(other, other.draw())
            for difference, variances in (
                (b - a, wide),
                (dataclasses.replace(b, batch_values=b.batch_values - a.batch_values), narrow),
            ):
                information = fisher_information(difference, noise.Gaussian(1.0))
                variances.append(np.diagonal(information.covariance_of_entries))
            found.append(pack(information.matrix))
        sample = np.var(found, axis=0)
        assert np.median(np.mean(wide, axis=0) / sample) == pytest.approx(1.0, abs=0.25)
        assert np.median(np.mean(narrow, axis=0) / sample) < 0.5

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"variable": "other"}, "about 'camera' and about 'other'"),
            ({"frame": "world"}, "camera and in the world frame"),
            ({"pose": FAR}, "two different poses"),
        ],
    )
    def test_mixing_is_refused(self, changes, message):
        sim = Simulation(4, 4)
        a = _jacobian(sim, sim.draw())
        with pytest.raises(FrameError, match=f"subtract derivatives .*{message}"):
            a - a.about(**changes)

    def test_other_batches_and_nuisances_are_refused(self):
        sim = Simulation(4, 4)
        a = _jacobian(sim, sim.draw())
        with pytest.raises(OptionError, match="the same batches and nuisances"):
            a - dataclasses.replace(a, parameters=("gain",))
        with pytest.raises(OptionError, match="the same batches"):
            a - dataclasses.replace(a, batch_values=np.repeat(a.batch_values, 2, axis=0))
        with pytest.raises(TypeError):
            a - a.values


class TestFisherInformation:
    @pytest.mark.parametrize(
        "model",
        [noise.Gaussian(0.1), noise.PerChannel([0.1, 0.2, 0.3]), noise.PerPixel(np.full((24, 32), 0.02))],
    )
    def test_it_weights_by_the_noise_model(self, model):
        jacobian = PlaneView(POSE).jacobian("camera")
        weights = model.weights(jacobian.pixels, jacobian.mean)
        np.testing.assert_allclose(
            fisher_information(jacobian, model).matrix, _truth(jacobian.values, weights), rtol=1e-12
        )

    def test_an_ignored_pixel_is_a_pixel_left_out(self):
        jacobian = PlaneView(POSE).jacobian("camera", noise=0.1)
        variance = np.full((24, 32), 0.01)
        variance[0, :10] = np.inf
        kept = ~((jacobian.pixels[:, 1] == 0) & (jacobian.pixels[:, 0] < 10))
        without = dataclasses.replace(
            jacobian,
            batch_values=jacobian.batch_values[:, kept],
            pixels=jacobian.pixels[kept],
        ).about(selection=_selection("only", 768, 758))
        np.testing.assert_allclose(
            fisher_information(jacobian, noise.PerPixel(variance)).matrix,
            fisher_information(without, noise.Gaussian(0.1)).matrix,
            rtol=1e-12,
        )

    @pytest.mark.slow
    def test_it_is_the_variance_of_the_score(self):
        """Second oracle for F: Cov of ∂ log p(I | ξ)/∂ξ over 20000 noisy images, to 4 errors of 1 %."""
        view = PlaneView(POSE)
        J = view.differentiate("camera").reshape(-1, 6)
        F = fisher_information(view.jacobian("camera"), noise.Gaussian(0.3)).matrix
        residuals = 0.3 * np.random.default_rng(15).standard_normal((20000, len(J)), dtype=np.float32)
        score = residuals @ (J / 0.09).astype(np.float32)
        sample = np.cov(score.T.astype(np.float64))
        assert misfit(sample, F) < 0.04

    def test_a_number_is_no_noise_model(self):
        with pytest.raises(NoiseError, match=r"noise.Gaussian\(0.01\)"):
            fisher_information(PlaneView(POSE).jacobian("camera"), 0.1)

    def test_a_model_of_another_image_is_refused(self):
        with pytest.raises(NoiseError, match="but the image is 24 rows x 32 columns"):
            fisher_information(PlaneView(POSE).jacobian("camera"), noise.PerPixel(np.ones((32, 24))))

    def test_it_can_be_written_as_json_and_not_be_changed(self):
        information = _made(np.eye(6), plain_matrix=np.eye(6))
        assert (
            json.loads(json.dumps(information.to_dict(), allow_nan=False))["linearisation"]["selection"][
                "kind"
            ]
            == "all"
        )
        with pytest.raises(ValueError, match="read-only"):
            information.matrix[0, 0] = 2.0

    def test_malformed_matrices_are_refused(self):
        with pytest.raises(FrameError, match="plain_matrix must be a finite array"):
            _made(np.eye(6), plain_matrix=np.eye(5))
        with pytest.raises(FrameError, match="matrix must be a finite array"):
            _made(np.full((6, 6), np.nan))


class TestBadInput:
    def _add(self, *, values=None, weights=None, pixels=None, batches=4):
        sim = Simulation(4, 4)
        accumulator = InformationAccumulator(batches=batches)
        accumulator.add(
            sim.draw() if values is None else values,
            sim.weights if weights is None else weights,
            sim.pixels if pixels is None else pixels,
        )

    def test_fewer_than_four_batches(self):
        with pytest.raises(OptionError, match="at least 4, not 3"):
            InformationAccumulator(batches=3)
        with pytest.raises(OptionError, match="got 4 batches, expected 5"):
            self._add(batches=5)

    @pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
    @pytest.mark.parametrize("block", [1, BLOCK])
    def test_derivatives_that_are_not_finite_are_counted(self, bad, block):
        sim = Simulation(4, 4)
        values = sim.draw()
        values[2, 3, 1, 5] = values[0, 7, 0, 0] = bad
        with pytest.raises(RadianceError, match="2 of 16 pixels"):
            _information(values, sim.weights, sim.pixels, block=block)

    def test_malformed_arrays(self):
        sim = Simulation(4, 4)
        with pytest.raises(PixelsError, match=r"\(K, n, C, 6\)"):
            self._add(values=np.zeros((4, 16, 6)))
        with pytest.raises(NoiseError, match="weights must have shape"):
            self._add(weights=np.ones((16, 1)))
        for weight in (-1.0, np.nan, np.inf):
            with pytest.raises(NoiseError, match="negative or not finite"):
                self._add(weights=np.full((16, 3), weight))
        with pytest.raises(PixelsError, match="integers"):
            self._add(pixels=sim.pixels.astype(float))
        with pytest.raises(PixelsError, match="integers"):
            self._add(pixels=sim.pixels[:5])
        with pytest.raises(PixelsError, match="negative"):
            self._add(pixels=sim.pixels - 1)
        with pytest.raises(PixelsError, match="twice"):
            self._add(pixels=np.zeros((16, 2), int))

    def test_nothing_measured_and_more_than_selected(self):
        four = about(selection=_selection("all", 4))
        with pytest.raises(PixelsError, match="no pixels"):
            InformationAccumulator(batches=4).information(four)
        accumulator = InformationAccumulator(batches=4)
        accumulator.add(np.zeros((4, 0, 3, 6)), np.zeros((0, 3)), np.zeros((0, 2), int))
        with pytest.raises(PixelsError, match="no pixels"):
            accumulator.information(four)
        sim = Simulation(4, 4)
        with pytest.raises(PixelsError, match="16 pixels were added, 4 selected"):
            _information(sim.draw(), sim.weights, sim.pixels, selection=_selection("only", 16, 4))


def test_products_of_single_pixels_are_those_of_units_of_one() -> None:
    whitened = np.random.default_rng(3).normal(size=(3, 5, 7, 50))
    expected = unit_products(unit_grams(whitened, np.arange(51)), whitened.shape[1])
    assert pixel_products(whitened) == pytest.approx(expected, rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("batches", [4, 5, 6])
def test_disjoint_pairs_are_enumerated(batches: int) -> None:
    h = np.random.default_rng(5).normal(size=(batches * (batches - 1) // 2, 21, 7))
    number = {pair: i for i, pair in enumerate(combinations(range(batches), 2))}
    every = [
        np.einsum("eu,fu->ef", h[number[tuple(sorted(p[:2]))]], h[number[tuple(sorted(p[2:]))]])
        for p in permutations(range(batches), 4)
    ]
    np.testing.assert_allclose(disjoint_products(h, batches), np.mean(every, axis=0), atol=1e-12)


def test_sums_of_squares_of_two_sets_of_units_add_up() -> None:
    h = np.random.default_rng(6).normal(size=(6, 21, 300))
    parts = [VarianceComponents(4) for _ in range(3)]
    for components, own in zip(parts, (slice(None), slice(100), slice(100, None)), strict=True):
        components.add(h[..., own].copy())
    whole, first, second = parts
    np.testing.assert_allclose((first + second).positive, whole.positive, rtol=1e-9, atol=1e-9)


def test_squares_come_by_their_number_of_pixels() -> None:
    """Those of one pixel, those of two, then all others, each of them whole and row by row."""
    pixels = _grid(64, 64)[np.random.default_rng(7).permutation(4096)[:200]]
    order, starts = in_squares(pixels, 8)
    sizes = np.diff(starts)
    assert np.array_equal(np.sort(order), np.arange(200))
    assert np.all(np.diff(np.minimum(sizes, 3)) >= 0)
    assert set(np.minimum(sizes, 3)) == {1, 2, 3}
    squares = [{tuple(p) for p in pixels[order[a:b]] // 8} for a, b in pairwise(starts)]
    assert all(len(square) == 1 for square in squares)
    assert len(set.union(*squares)) == len(squares)
    with pytest.raises(PixelsError, match="twice"):
        in_squares(np.array([[3, 4], [3, 4]]), 8)


def test_nobody_can_change_the_entries_order_that_the_next_one_gets():
    for indices in triangle(6):
        with pytest.raises(ValueError, match="read-only"):
            indices[0] = 1
