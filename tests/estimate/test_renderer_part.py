"""Errors of which a part is the renderer's: freed of it they say of the bound what they can, and no more."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from rigs import made

from mitsuba_crb.errors import TrialError
from mitsuba_crb.estimate.renderer_part import RendererPart, renderer_part, times_for, uncertainty, whitening
from mitsuba_crb.information.fisher import FisherInformation


def _information(rng: Any) -> FisherInformation:
    root = (rng.standard_normal((6, 6)) + 4.0 * np.eye(6)) * np.array([3.0, 3.0, 3.0, 100.0, 100.0, 100.0])
    return made(root.T @ root, length_scale=2.5)


def _judged(
    rng: Any, n: int, epsilon: Any, *, wrong: float = 1.0, error: float = 0.0, confidence: float = 0.95
) -> RendererPart:
    """Errors to which the renderer adds E = diag ε in some axes, beside a bound that is wrong by a factor.

    `error` is the relative standard error that the information states of itself.
    """
    true = _information(rng)
    inverse = whitening(true)[1] @ np.linalg.qr(rng.standard_normal((6, 6)))[0]
    E = np.broadcast_to(np.asarray(epsilon, dtype=np.float64), 6)
    errors = rng.standard_normal((n, 6)) * np.sqrt(1.0 + E) @ inverse.T
    covariance = np.diag((error * np.sqrt(np.diagonal(true.matrix)[np.triu_indices(6)[0]])) ** 2)
    stated = made(wrong * true.matrix, covariance, length_scale=2.5)
    return renderer_part(errors, stated, inverse * E @ inverse.T, confidence=confidence)


@pytest.mark.slow
def test_a_right_bound_is_called_inconsistent_no_more_often_than_stated() -> None:
    rng = np.random.default_rng(1)
    found = [_judged(rng, 60, (0.1, 0.05, 0.03, 0.02, 0.01, 0.0)) for _ in range(300)]
    assert sum(f.verdict == "inconsistent" for f in found) <= 25  # 99 % of a binomial of 300 and 5 %
    assert {f.verdict for f in found} == {"consistent", "inconsistent"}


@pytest.mark.parametrize("epsilon", [0.2, (1.5, 0.5, 0.3, 0.2, 0.1, 0.0)])
def test_what_the_renderer_adds_does_not_pass_for_a_wrong_bound(epsilon: Any) -> None:
    found = _judged(np.random.default_rng(2), 400, epsilon)
    assert found.excess == pytest.approx(np.mean(epsilon))
    assert found.verdict == "inconclusive"
    assert found.times > 1
    assert found.freed.nees == pytest.approx(6.0, rel=0.08)


@pytest.mark.parametrize("wrong", [1.5, 1.0 / 1.5])
@pytest.mark.parametrize("epsilon", [0.02, 0.2])
def test_a_wrong_bound_is_found_out_where_the_paths_suffice(wrong: float, epsilon: float) -> None:
    """Negative control."""
    assert _judged(np.random.default_rng(3), 200, epsilon, wrong=wrong).verdict == "inconsistent"


def test_a_wrong_bound_among_much_of_the_renderers_noise_is_no_verdict() -> None:
    found = _judged(np.random.default_rng(4), 100, 9.0, wrong=1.5)
    assert found.verdict == "inconclusive"
    assert found.excess == pytest.approx(13.5)  # in units of the bound that is said
    assert found.times == 128  # 13.5 / √14.5 / 0.05 = 71


def test_a_bound_that_is_not_known_itself_is_judged_with_its_error() -> None:
    rng = np.random.default_rng(5)
    sure, unsure = (_judged(rng, 200, 0.0, wrong=1.3, error=error) for error in (0.0, 3.0))
    assert (sure.uncertainty, sure.verdict) == (0.0, "inconsistent")
    assert unsure.uncertainty > 0.1
    assert unsure.allowance == pytest.approx(1.96 * unsure.uncertainty, rel=1e-3)
    assert unsure.verdict == "inconclusive"


def test_directions_have_the_error_that_draws_of_the_information_have() -> None:
    rng = np.random.default_rng(6)
    F = _information(rng).matrix
    half = rng.standard_normal((21, 21))
    covariance = half @ half.T
    u = uncertainty(made(F, covariance, length_scale=2.5))
    axes = whitening(made(F, length_scale=2.5))[1]
    np.testing.assert_allclose(axes.T @ F @ axes, np.eye(6), atol=1e-9)
    draws = np.zeros((4000, 6, 6))
    rows, columns = np.triu_indices(6)
    draws[:, rows, columns] = draws[:, columns, rows] = rng.standard_normal((4000, 21)) @ half.T
    spread = np.einsum("pi,npq,qi->ni", axes, draws, axes).std(axis=0)
    assert u == pytest.approx(spread.max(), rel=0.05)


@pytest.mark.parametrize(
    ("excess", "u", "times"),
    [(0.05, 0.05, 1), (-0.1, 0.0, 1), (0.051, 0.0, 2), (0.2, 0.0, 4), (0.0, 0.1, 4), (0.0, 0.11, 8)],
)
def test_variances_fall_as_the_paths_and_errors_as_their_root(excess: float, u: float, times: int) -> None:
    assert times_for(excess, u, 0.05) == times


def test_a_direction_that_is_not_seen_is_refused() -> None:
    with pytest.raises(TrialError, match="not positive definite"):
        uncertainty(made(np.diag([1.0, 1, 1, 1, 1, 0])))
