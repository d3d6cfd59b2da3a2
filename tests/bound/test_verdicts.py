"""Seen, unseen, not resolved: lower limits that hold, and finite numbers that earn their place.

Truths of every rank and many condition numbers, noise of every size and shape: an entry's covariance is that
of JᵀJ from pixels with independent errors, of which a few or very many may carry the noise.
"""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from rigs import made
from scipy.linalg import expm

from mitsuba_crb import cramer_rao_bound
from mitsuba_crb.bound import inverse as inverses
from mitsuba_crb.bound.inverse import Inverse
from mitsuba_crb.errors import PrecisionWarning
from mitsuba_crb.information import resolution
from mitsuba_crb.information.symmetric import pack, triangle, unpack
from mitsuba_crb.noise.covariance import symmetric_root

AXES = np.eye(6)


def covariance_of(F, noise, pixels):
    """(21, 21), of JᵀJ + Jᵀε + εᵀJ + (εᵀε without its mean), ε of covariance `noise` in so many pixels."""
    i, j = triangle(6)

    def product(A, B):
        return A[np.ix_(i, i)] * B[np.ix_(j, j)] + A[np.ix_(i, j)] * B[np.ix_(j, i)]

    return product(F, noise) + product(noise, F) + pixels * product(noise, noise)


def drawn(rng, F, noise, pixels):
    covariance = covariance_of(F, noise, pixels)
    return F + unpack(rng.standard_normal(21) @ symmetric_root(covariance)), covariance


def turned(rng, smallest):
    """A random rotation by an angle that is small now and then."""
    A = rng.normal(size=(6, 6))
    return expm(10.0 ** rng.uniform(smallest, 0.5) * (A - A.T) / 2.0)[:, rng.permutation(6)]


def case(rng, *, rank=None, smallest=-4.0):
    """A true information, an estimate of it, and the covariance of its entries."""
    values = 10.0 ** (-rng.uniform(0, 6) * rng.uniform(0, 1, 6))
    values[rng.integers(1, 7) if rank is None else rank :] = 0.0
    Q = turned(rng, smallest)
    sizes = 10.0 ** (-rng.uniform(0, 4) * rng.uniform(0, 1, 6))
    sizes[rng.integers(6)] *= rng.random() > 0.3
    W = turned(rng, -3.0) if rng.random() < 0.5 else Q
    pixels = 10.0 ** rng.uniform(1.5, 5)
    F = (Q * values) @ Q.T
    return F, *drawn(rng, F, (W * sizes) @ W.T * 10.0 ** rng.uniform(-7, 0) / np.sqrt(pixels), pixels)


def true_deviations(F):
    values, vectors = np.linalg.eigh(F)
    seen = values > 1e-12 * values[-1]
    deviations = np.sqrt((vectors[:, seen] ** 2 / values[seen]).sum(axis=1))
    return np.where((vectors[:, ~seen] ** 2).sum(axis=1) > 1e-10, np.inf, deviations)


def inverse_of(estimate, covariance):
    return Inverse(made(estimate, covariance, length_scale=1.0), None)


def bound_of(F, covariance=None, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PrecisionWarning)
        return cramer_rao_bound(made(F, covariance, length_scale=1.0), **options)


class TestLowerLimits:
    def broken(self, cases):
        """The share of limits that the truth lies below, by verdict, and how many verdicts there were."""
        rng = np.random.default_rng(1)
        found = {name: [] for name in ("seen", "unseen", "not resolved")}
        for _ in range(cases):
            F, *estimate = case(rng)
            inverse = inverse_of(*estimate)
            above = inverse.lower_limits(AXES) > true_deviations(F) * (1 + 1e-9)
            for verdict, wrong in zip(inverse.verdicts(AXES), above, strict=True):
                found[verdict].append(wrong)
        return {name: np.mean(wrong) for name, wrong in found.items()}, min(map(len, found.values()))

    @pytest.mark.parametrize("cases", [40, pytest.param(1000, marks=pytest.mark.slow)])
    def test_the_truth_lies_above_them_in_98_of_100_cases(self, cases):
        broken, least = self.broken(cases)
        assert least > 0.5 * cases
        assert max(broken.values()) <= 0.02

    @pytest.mark.slow
    def test_without_the_noise_they_would_not_hold(self, monkeypatch):
        """Negative control: the median in the 99 % quantile's place."""
        monkeypatch.setattr(resolution, "CONFIDENCE", 0.5)
        monkeypatch.setattr(resolution, "_QUANTILE", 0.0)
        broken, _ = self.broken(60)
        assert broken["seen"] > 0.2

    def test_they_are_no_idle_words(self):
        """An axis that noise of its own eigenvalue's size hides is limited to within a factor of three."""
        F = np.diag([1.0, 1, 1, 1, 1, 0.01])
        noise = np.diag([0, 0, 0, 0, 0, 1e-4])
        rng = np.random.default_rng(2)
        limits = [inverse_of(*drawn(rng, F, noise, 1e4)).lower_limits(AXES)[5] for _ in range(50)]
        assert 10.0 / 3.0 < np.median(limits) < 10.0

    def test_an_exact_information_is_its_own_limit(self):
        rng = np.random.default_rng(3)
        J = rng.normal(size=(30, 6))
        bound = bound_of(J.T @ J)
        np.testing.assert_allclose(bound.position_std_lower_limit, bound.position_std, rtol=1e-9)
        np.testing.assert_allclose(bound.rotation_std_deg_lower_limit, bound.rotation_std_deg, rtol=1e-9)

    @pytest.mark.slow
    def test_a_prior_lowers_them(self):
        rng = np.random.default_rng(4)
        for _ in range(30):
            F, *estimate = case(rng)
            prior = np.diag(rng.uniform(size=6) * (rng.random(6) < 0.5)) * 10.0 ** rng.uniform(-3, 3)
            inverse = Inverse(made(*estimate, length_scale=1.0), prior)
            above = inverse.lower_limits(AXES) > true_deviations(F + prior) * (1 + 1e-6)
            assert above.sum() <= 1


class TestVerdicts:
    def test_nothing_without_noise_is_unseen_and_nothing_with_noise_is_not_resolved(self):
        F = np.diag([1.0, 1, 1, 1, 1, 0])
        bound = bound_of(F)
        assert bound.rotation_verdict == ("seen", "seen", "unseen")
        assert bound.position_verdict == ("seen", "seen", "seen")
        (direction,) = bound.unobserved
        assert (direction.verdict, direction.paths_factor) == ("unseen", None)
        covariance = np.diag(pack(np.diag([0, 0, 0, 0, 0, 0.1]))) ** 2
        bound = bound_of(F, covariance)
        assert bound.rotation_verdict == ("seen", "seen", "not resolved")
        assert np.isinf(bound.rotation_std_deg[2])
        (direction,) = bound.unobserved
        # 2.33 standard errors of 0.1 over 1e-3 of the best
        assert direction.verdict == "not resolved"
        assert direction.paths_factor == pytest.approx(233, rel=0.05)
        assert direction.std_lower_limit == pytest.approx(0.233**-0.5, rel=0.05)
        assert bound.rotation_std_deg_lower_limit[2] == pytest.approx(np.degrees(0.233**-0.5), rel=0.05)

    @pytest.mark.parametrize("turn", [0.0, 0.3])
    def test_noise_in_one_direction_hides_nothing_that_is_known_of_another(self, turn):
        """Two null directions, one without any noise, in a plane that is turned towards other axes."""
        c, s = np.cos(turn), np.sin(turn)
        Q = np.eye(6)
        Q[np.ix_([0, 5], [0, 5])] = [[c, -s], [s, c]]
        Q[np.ix_([1, 4], [1, 4])] = [[c, -s], [s, c]]
        F = Q @ np.diag([1.0, 1, 1, 1, 0, 0]) @ Q.T
        noise = Q @ np.diag([0, 0, 0, 0, 1e-3, 0]) @ Q.T
        estimate, covariance = drawn(np.random.default_rng(5), F, noise, 1e4)
        bound = bound_of(estimate, covariance)
        assert [direction.verdict for direction in bound.unobserved] == ["unseen", "not resolved"]
        np.testing.assert_allclose(np.abs(bound.unobserved[0].direction), np.abs(Q[:, 5]), atol=1e-6)
        assert bound.rotation_verdict == ("seen", "not resolved", "unseen")

    def test_nothing_seen_with_noise_has_nothing_to_compare_with(self):
        bound = bound_of(np.zeros((6, 6)), 1e-6 * np.eye(21))
        assert {*bound.position_verdict, *bound.rotation_verdict} == {"not resolved"}
        assert all(direction.paths_factor is None for direction in bound.unobserved)
        assert "more would decide" in bound.not_resolved
        assert np.all(np.isfinite(bound.position_std_lower_limit))

    def test_exactly_nothing_is_unseen_without_limit(self):
        bound = bound_of(np.zeros((6, 6)))
        assert {*bound.position_verdict, *bound.rotation_verdict} == {"unseen"}
        assert np.isinf(bound.position_std_lower_limit).all()
        assert bound.not_resolved is None

    def test_what_a_prior_sees_is_seen(self):
        covariance = np.diag(pack(np.diag([0.1, 0, 0, 0, 0, 0.1]))) ** 2
        F = np.diag([0.0, 1, 1, 1, 1, 0])
        bound = bound_of(F, covariance, prior=np.diag([0, 0, 0, 0, 0, 4.0]))
        assert bound.position_verdict == ("not resolved", "seen", "seen")
        assert bound.rotation_verdict == ("seen", "seen", "seen")

    def test_few_paths_are_said_and_so_many_as_decide(self):
        covariance = np.diag(pack(np.diag([0, 0, 0, 0, 0, 0.1]))) ** 2
        with pytest.warns(PrecisionWarning, match=r"not resolved: roll: .*about 2[234]\d times as many"):
            bound = cramer_rao_bound(made(np.diag([1.0, 1, 1, 1, 1, 0]), covariance, length_scale=1.0))
        assert "roll > " in str(bound)
        assert "nothing, not resolved: rotation about the optical axis (roll)" in str(bound)

    @pytest.mark.parametrize("name", ["position", "rotation"])
    def test_an_ellipsoid_says_of_each_axis(self, name):
        covariance = np.diag(pack(np.diag([0.1, 0, 0, 0, 0, 0.1]))) ** 2
        bound = bound_of(np.diag([0.0, 1, 1, 1, 1, 0]), covariance)
        semi_axes, directions = bound.ellipsoid(name)
        assert np.isinf(semi_axes).tolist() == [True, False, False]
        assert bound.verdicts_along(name, directions) == ("not resolved", "seen", "seen")


class TestFiniteNumbers:
    """Of informations that see all six directions, but for noise that may hide some."""

    def too_small(self, cases):
        rng = np.random.default_rng(6)
        wrong, count = 0, 0
        for _ in range(cases):
            F, *estimate = case(rng, rank=6, smallest=-2.0)
            inverse = inverse_of(*estimate)
            std = np.sqrt(np.diagonal(inverse.covariance(AXES)))
            error = inverse.standard_error(AXES, std)
            finite = np.isfinite(std)
            count += finite.sum()
            wrong += np.sum((true_deviations(F) - std > 4.0 * error)[finite])
        return wrong, count

    @pytest.mark.slow
    def test_hardly_any_is_four_errors_too_small(self):
        wrong, count = self.too_small(800)
        assert wrong <= 0.01 * count

    @pytest.mark.slow
    def test_many_would_be_if_failing_to_find_a_share_proved_none(self, monkeypatch):
        """Negative control: the rule without the tilt's error."""
        monkeypatch.setattr(inverses, "LARGEST_TILT", np.inf)
        wrong, count = self.too_small(800)
        assert wrong > 0.02 * count

    def test_a_tilt_that_noise_leaves_open_keeps_no_number(self):
        """A weak direction tilted by 0.3, of which the estimate shows only that it may be."""
        Q = expm(0.3 * (np.outer(AXES[0], AXES[5]) - np.outer(AXES[5], AXES[0])))
        F = Q @ np.diag([1.0, 1, 1, 1, 1, 1e-3]) @ Q.T
        noise = Q @ np.diag([0, 0, 0, 0, 0, 0.03]) @ Q.T
        rng, kept = np.random.default_rng(7), 0
        for _ in range(50):
            bound = bound_of(*drawn(rng, F, noise, 3.0))
            kept += bound.rank < 6 and np.isfinite(bound.position_std[0])
        assert kept == 0


def test_an_axis_that_is_unseen_may_hide_something_that_is_not_resolved():
    """One direction tells nothing for certain, the next is drowned in noise: more paths tell of their sum."""
    covariance = np.zeros((21, 21))
    covariance[-1, -1] = 0.1  # of the last direction's own information
    inverse = inverse_of(np.diag([4.0, 3.0, 2.0, 1.0, 0.0, 0.05]), covariance)
    axes = np.array([AXES[4], AXES[5], (AXES[4] + AXES[5]) / np.sqrt(2.0), AXES[0]])
    assert inverse.verdicts(axes) == ("unseen", "not resolved", "unseen", "seen")
    np.testing.assert_array_equal(inverse.is_blurred(axes), [False, True, True, False])
