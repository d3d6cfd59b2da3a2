"""Covariance intersection: consistent for every correlation, where summing is not; optimal weights."""

from __future__ import annotations

import json

import numpy as np
import pytest
from matrices import misfit
from rigs import definite, made, noisy, random_pose
from scipy.stats import chi2

from mitsuba_crb import se3
from mitsuba_crb.agents.covariance_intersection import covariance_intersection
from mitsuba_crb.bound.cramer_rao import cramer_rao_bound
from mitsuba_crb.errors import FrameError, FusionError


def _objective(minimise, matrix, scale):
    S = np.diag(scale)
    C = np.linalg.inv(S @ matrix @ S)
    return np.linalg.slogdet(C)[1] if minimise == "det" else np.trace(C)


def _correlations(rng, count):
    """Contractions R of the whitened errors: the extremes ±1 and rotations first, then all kinds between."""
    yield from (np.eye(6), -np.eye(6), np.zeros((6, 6)))
    for k in range(count - 3):
        Q = np.linalg.qr(rng.normal(size=(6, 6)))[0]
        if k % 3 == 0:
            yield Q
        else:
            P = np.linalg.qr(rng.normal(size=(6, 6)))[0]
            yield Q @ np.diag(rng.uniform(0.0 if k % 3 == 1 else 0.9, 1.0, size=6)) @ P


class TestConsistency:
    @pytest.mark.parametrize("minimise", ["det", "trace"])
    def test_for_every_correlation_where_naive_summing_is_over_confident(self, minimise):
        """4,000 draws for each of 40 correlations: NEES and generalised eigenvalues, 99.9 % bands."""
        rng = np.random.default_rng(1)
        draws, kinds = 4000, 40
        # Davidson and Szarek: the largest singular value of draws x 6 normal numbers, all kinds together.
        deviation = np.sqrt(2.0 * np.log(1000.0 * kinds) / draws)
        band = (1.0 + np.sqrt(6.0 / draws) + deviation) ** 2
        nees_band = chi2.ppf(1.0 - 0.001 / kinds, 6 * draws) / (6 * draws)
        naive_failures = 0
        for R in _correlations(rng, kinds):
            F = [definite(rng), definite(rng)]
            roots = [np.linalg.inv(np.linalg.cholesky(f)).T for f in F]
            z = rng.normal(size=(draws, 6))
            # The second whitened error is R z plus what keeps its covariance 1.
            values, vectors = np.linalg.eigh(np.eye(6) - R @ R.T)
            rest = (vectors * np.sqrt(np.maximum(values, 0.0))) @ rng.normal(size=(6, draws))
            errors = np.stack([z @ roots[0].T, (R @ z.T + rest).T @ roots[1].T], axis=1)
            found = covariance_intersection([made(f) for f in F], minimise=minimise)
            x = found.estimate(errors)
            L = np.linalg.cholesky(found.information.matrix)
            whitened = x @ L
            spread = np.linalg.eigvalsh(whitened.T @ whitened / draws)
            assert spread[-1] < band
            assert np.mean(np.sum(whitened**2, axis=1)) / 6.0 < nees_band
            total = F[0] + F[1]
            naive = np.linalg.solve(total, np.einsum("aij,naj->in", np.array(F), errors)).T
            naive_nees = np.mean(np.einsum("ni,ij,nj->n", naive, total, naive)) / 6.0
            naive_failures += naive_nees > nees_band
        # Summing is right for uncorrelated and for opposed errors, and wrong for many others.
        assert naive_failures >= 8

    def test_identical_sources_are_worth_one(self):
        F = made(definite(np.random.default_rng(2)))
        for count in (1, 2, 5):
            found = covariance_intersection([F] * count)
            assert misfit(found.information.matrix, F.matrix) < 1e-12
            np.testing.assert_allclose(found.gains.sum(axis=0), np.eye(6), atol=1e-12)

    def test_it_claims_no_more_than_the_sum_and_no_less_than_the_best_source(self):
        rng = np.random.default_rng(3)
        for _ in range(20):
            F = [made(definite(rng)) for _ in range(3)]
            found = covariance_intersection(F)
            total = F[0] + F[1] + F[2]
            assert np.linalg.eigvalsh(total.matrix - found.information.matrix)[0] > 0.0
            best = max(np.linalg.slogdet(f.matrix)[1] for f in F)
            assert np.linalg.slogdet(found.information.matrix)[1] >= best - 1e-9


class TestWeights:
    @pytest.mark.parametrize("minimise", ["det", "trace"])
    @pytest.mark.parametrize("count", [2, 3, 8])
    def test_they_are_optimal(self, minimise, count):
        rng = np.random.default_rng(4)
        F = [made(definite(rng, 6 if count < 8 else 2)) for _ in range(count)]
        found = covariance_intersection(F, minimise=minimise)
        assert found.weights.min() >= 0.0
        assert found.weights.sum() == pytest.approx(1.0)
        assert found.gap <= 1e-8
        best = _objective(minimise, found.information.matrix, F[0].scale)
        for _ in range(500):
            other = rng.dirichlet(np.full(count, 0.7))
            matrix = sum(w * f.matrix for w, f in zip(other, F, strict=True))
            assert _objective(minimise, matrix, F[0].scale) >= best - 1e-7 * abs(best)

    def test_two_sources_by_scanning_the_segment(self):
        rng = np.random.default_rng(5)
        a, b = made(definite(rng)), made(np.diag([9.0, 0.1, 1.0, 1.0, 20.0, 0.2]))
        scan = np.linspace(0.0, 1.0, 100_001)
        matrices = scan[:, None, None] * a.matrix + (1.0 - scan)[:, None, None] * b.matrix
        best = scan[np.argmax(np.linalg.slogdet(matrices)[1])]
        assert covariance_intersection([a, b]).weights[0] == pytest.approx(best, abs=2e-5)

    def test_a_useless_source_gets_no_weight(self):
        F = definite(np.random.default_rng(6))
        found = covariance_intersection([made(F), made(0.5 * F), made(0.9 * F)])
        np.testing.assert_allclose(found.weights, [1.0, 0.0, 0.0], atol=1e-9)

    def test_sources_that_see_different_directions_complete_each_other(self):
        a, b = np.diag([4.0, 4, 4, 0, 0, 0]), np.diag([0.0, 0, 0, 4, 4, 4])
        found = covariance_intersection([made(a), made(b)])
        np.testing.assert_allclose(found.weights, [0.5, 0.5], atol=1e-9)
        assert cramer_rao_bound(found.information).rank == 6

    def test_directions_that_nobody_sees_stay_unseen(self):
        rng = np.random.default_rng(7)
        sources = []
        for _ in range(3):
            matrix = np.zeros((6, 6))
            matrix[:5, :5] = definite(rng)[:5, :5]
            sources.append(made(*noisy(rng, 1e3 * matrix, error=0.5)))
        found = covariance_intersection(sources)
        assert cramer_rao_bound(found.information).rank == 5
        assert found.gap < 1e-8
        nothing = covariance_intersection([made(np.zeros((6, 6)))] * 2)
        assert not nothing.information.matrix.any()
        assert not nothing.gains.any()

    def test_the_uncertainty_of_entries_follows_the_weights(self):
        rng = np.random.default_rng(8)
        sources = [made(*noisy(rng, 1e3 * definite(rng), error=0.5)) for _ in range(2)]
        found = covariance_intersection(sources)
        expected = sum(w**2 * f.covariance_of_entries for w, f in zip(found.weights, sources, strict=True))
        assert misfit(found.information.covariance_of_entries, expected) < 1e-12


class TestFrames:
    def test_the_world_frame_gives_the_same_combination(self):
        rng = np.random.default_rng(9)
        pose = random_pose(rng)
        F = [made(definite(rng), pose=pose) for _ in range(2)]
        camera = covariance_intersection(F)
        world = covariance_intersection([f.to_frame("world") for f in F])
        assert world.information.frame == "world"
        np.testing.assert_allclose(world.weights, camera.weights, atol=1e-12)
        twists = rng.normal(size=(5, 2, 6))
        A = se3.adjoint(pose)
        np.testing.assert_allclose(
            world.estimate(twists @ A.T), camera.estimate(twists) @ A.T, rtol=1e-9, atol=1e-12
        )

    def test_other_poses_and_no_sources_are_refused(self):
        F = definite(np.random.default_rng(10))
        with pytest.raises(FusionError, match="no sources"):
            covariance_intersection([])
        with pytest.raises(FusionError, match="'det' or 'trace'"):
            covariance_intersection([made(F)], minimise="max")
        with pytest.raises(FrameError):
            covariance_intersection([made(F), made(F, variable="other")])
        assert json.dumps(covariance_intersection([made(F)]).weights.tolist()) == "[1.0]"
