"""Errors drawn from the bound are consistent with it as often as stated; others are not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from rigs import made
from scipy import stats

from mitsuba_crb import se3
from mitsuba_crb.bound.consistency import LEVELS, consistency, wishart_band
from mitsuba_crb.errors import TrialError
from mitsuba_crb.information.fisher import FisherInformation

POSE = se3.exp([5.0, -3.0, 2.0, 0.3, 1.0, -0.5])


def _information(rng: Any) -> FisherInformation:
    root = (rng.standard_normal((6, 6)) + 4.0 * np.eye(6)) * np.array([3.0, 3.0, 3.0, 100.0, 100.0, 100.0])
    return made(root.T @ root, pose=POSE, length_scale=2.5)


def _errors(rng: Any, information: FisherInformation, n: int, scale: float = 1.0) -> Any:
    root = np.linalg.cholesky(np.linalg.inv(information.matrix))
    return scale * rng.standard_normal((n, 6)) @ root.T


@pytest.mark.slow
def test_errors_with_the_bounds_covariance_are_inside_as_often_as_stated() -> None:
    rng = np.random.default_rng(1)
    names = ("nees", "eigenvalues", *LEVELS)
    inside = dict.fromkeys(names, 0)
    repetitions = 150
    for _ in range(repetitions):
        information = _information(rng)
        found = consistency(_errors(rng, information, 60), information, confidence=0.9)
        inside["nees"] += found.nees_band[0] <= found.nees <= found.nees_band[1]
        band, values = found.wishart_band, found.generalized_eigenvalues
        inside["eigenvalues"] += bool(((band[:, 0] <= values) & (values <= band[:, 1])).all())
        for c in found.coverage:
            inside[c.nominal] += c.low <= c.nominal <= c.high
    # 99.9 % of a binomial; Wilson's intervals of small counts cover a little more or less than stated.
    low, high = stats.binom.interval(0.999, repetitions, 0.9)
    assert low <= inside["nees"] <= high
    assert low <= inside["eigenvalues"] <= high
    assert all(inside[level] >= low - 0.06 * repetitions for level in LEVELS)


@pytest.mark.parametrize("scale", [0.5, 2.0])
def test_errors_of_another_size_fail_in_all_three(scale: float) -> None:
    """Negative control."""
    rng = np.random.default_rng(2)
    information = _information(rng)
    found = consistency(_errors(rng, information, 400, scale), information, confidence=0.999)
    assert not found.nees_band[0] <= found.nees <= found.nees_band[1]
    band, values = found.wishart_band, found.generalized_eigenvalues
    assert not ((band[:, 0] <= values) & (values <= band[:, 1])).any()
    assert not any(c.low <= c.nominal <= c.high for c in found.coverage[:4])
    assert not found.consistent


def test_the_frame_does_not_matter_and_the_worst_direction_is_found() -> None:
    rng = np.random.default_rng(3)
    information = _information(rng)
    errors = _errors(rng, information, 400)
    direction = np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    sigma = 1.0 / np.sqrt(information.matrix[1, 1])
    errors += 6.0 * sigma * rng.standard_normal((400, 1)) * direction
    found, same = (consistency(errors, i) for i in (information, information.to_frame("world")))
    np.testing.assert_allclose(found.generalized_eigenvalues, same.generalized_eigenvalues, rtol=1e-6)
    worst = found.directions[0]
    assert abs(worst @ direction) > 0.95 * np.linalg.norm(worst)
    assert found.generalized_eigenvalues[0] > 20.0
    D, S = found.directions, errors.T @ errors / 400
    np.testing.assert_allclose(D.T @ D @ information.matrix, np.eye(6), atol=1e-8)
    np.testing.assert_allclose(
        D.T * found.generalized_eigenvalues @ D, S, rtol=1e-6, atol=1e-8 * np.abs(S).max()
    )


def test_a_bias_shows() -> None:
    rng = np.random.default_rng(4)
    information = _information(rng)
    errors = _errors(rng, information, 200)
    assert np.abs(consistency(errors, information).bias).max() < 4.0
    errors[:, 3] += errors[:, 3].std()
    assert consistency(errors, information).bias[3] > 10.0


def test_the_wishart_band_is_a_samples() -> None:
    """Second oracle: eigenvalues of sample covariances, drawn without Bartlett's decomposition."""
    rng = np.random.default_rng(5)
    samples = rng.standard_normal((3000, 30, 6))
    values = np.linalg.eigvalsh(samples.swapaxes(1, 2) @ samples / 30)[:, ::-1]
    band = wishart_band(30, 0.9)
    inside = ((band[:, 0] <= values) & (values <= band[:, 1])).all(axis=1).mean()
    assert abs(inside - 0.9) < 4.0 * np.sqrt(0.09 / 3000) + 0.005


def test_nobody_can_change_the_band_that_the_next_one_gets() -> None:
    with pytest.raises(ValueError, match="read-only"):
        wishart_band(30, 0.9)[0] = 0.0


def test_too_few_errors_and_unseen_directions_are_refused() -> None:
    rng = np.random.default_rng(6)
    information = _information(rng)
    with pytest.raises(TrialError, match="at least 7"):
        consistency(_errors(rng, information, 6), information)
    flat = made(np.diag([1.0, 1, 1, 1, 1, 0]), pose=POSE)
    with pytest.raises(TrialError, match="not positive definite"):
        consistency(rng.standard_normal((50, 6)), flat)
