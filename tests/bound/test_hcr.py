"""Hammersley–Chapman–Robbins: against the formulas written out, sampled densities and real estimators.

The image of these tests is μ(ξ) = sin(A ξ + b), 60 values, as nonlinear as its noise is strong; with a column
of A made of multiples of 2π it repeats exactly.
"""

from __future__ import annotations

import json

import numpy as np
import pytest
from matrices import misfit
from rigs import made

from mitsuba_crb import se3
from mitsuba_crb.bound.hcr import axis_displacements, chapman_robbins, hammersley_chapman_robbins
from mitsuba_crb.camera import Camera
from mitsuba_crb.errors import OptionError

RNG = np.random.default_rng(5)
WAVES, PHASES = RNG.normal(size=(60, 6)), RNG.uniform(0, 2 * np.pi, 60)
PERIODIC = WAVES.copy()
PERIODIC[:, 0] = 2 * np.pi * RNG.integers(1, 4, 60)
SMALL = 0.3 * RNG.normal(size=(12, 6))
POSE = se3.exp([1.0, -2.0, 0.5, 0.4, -0.3, 0.8])


def _moments(waves, displacements, sigma):
    """F, B and A of the image for white noise."""
    J = np.cos(PHASES)[:, None] * waves / sigma
    delta = (np.sin(displacements @ waves.T + PHASES) - np.sin(PHASES)).T / sigma
    return J.T @ J, delta.T @ J, delta.T @ delta


def _information(F, pose=POSE):
    return made(F, pose=pose, length_scale=1.0)


def _bound(waves, displacements, sigma, **options):
    F, B, A = _moments(waves, displacements, sigma)
    return hammersley_chapman_robbins(_information(F), displacements, A, B, **options)


def _changes(displacements, pose=POSE):
    """(m, 6): the camera centre in the world, and the rotation vector about the camera's axes."""
    moved = pose @ se3.exp(displacements)
    turned = [se3.log(se3.inverse(pose) @ g)[3:] for g in moved]
    return np.hstack([moved[:, :3, 3] - pose[:3, 3], turned])


def test_one_displacement_is_the_formula_of_chapman_and_robbins():
    for distance in (1e-6, 0.1, 1.0, 30.0, 700.0):
        found = chapman_robbins([[2.0]], [[distance]])[0, 0]
        np.testing.assert_allclose(found, 4.0 / np.expm1(distance), rtol=1e-9)
    assert chapman_robbins([[2.0]], [[1e8]])[0, 0] == 0.0


def test_a_set_is_the_matrix_formula_written_out():
    _, _, A = _moments(WAVES, SMALL, 2.0)
    expected = SMALL.T @ np.linalg.solve(np.exp(A) - 1.0, SMALL)
    np.testing.assert_allclose(chapman_robbins(SMALL, A), expected, rtol=1e-6)


def test_with_the_score_it_is_the_block_formula_written_out():
    F, B, A = _moments(WAVES, SMALL, 2.0)
    found = _bound(WAVES, SMALL, 2.0)
    rotation = np.block([[POSE[:3, :3], np.zeros((3, 3))], [np.zeros((3, 3)), np.eye(3)]])
    sides = np.vstack([rotation.T, _changes(SMALL)])
    expected = sides.T @ np.linalg.solve(np.block([[F, B.T], [B, np.exp(A) - 1.0]]), sides)
    assert misfit(found.covariance, expected) < 1e-6
    np.testing.assert_allclose(found.position_std, np.sqrt(np.diagonal(expected)[:3]), rtol=1e-6)
    np.testing.assert_allclose(
        found.rotation_std_deg, np.degrees(np.sqrt(np.diagonal(expected)[3:])), rtol=1e-6
    )


def test_the_functions_have_the_covariances_that_the_derivation_says():
    """100,000 images: the moments of p_i/p₀ − 1 and of the score, within five of their standard errors."""
    F, B, A = _moments(WAVES, 0.4 * SMALL[:2], 4.0)
    J = np.cos(PHASES)[:, None] * WAVES / 4.0
    delta = (np.sin(0.4 * SMALL[:2] @ WAVES.T + PHASES) - np.sin(PHASES)).T / 4.0
    noise = np.random.default_rng(0).normal(size=(100_000, 60))
    ratios = np.exp(noise @ delta - 0.5 * np.sum(delta**2, axis=0)) - 1.0
    functions = np.hstack([noise @ J, ratios])
    products = functions[:, :, None] * functions[:, None, :]
    expected = np.block([[F, B.T], [B, np.exp(A) - 1.0]])
    error = products.std(axis=0) / np.sqrt(len(noise))
    assert np.all(np.abs(products.mean(axis=0) - expected) < 5.0 * error)
    # Negative control: without the exponential.
    wrong = np.block([[F, B.T], [B, A]])
    assert np.any(np.abs(products.mean(axis=0) - wrong) > 5.0 * error)


@pytest.mark.parametrize("sigma", [1e-3, 0.1, 1.0, 10.0])
@pytest.mark.parametrize("scale", [1e-4, 1e-2, 1.0, 30.0])
def test_it_is_never_below_the_local_bound(sigma, scale):
    found = _bound(WAVES, scale * SMALL, sigma)
    assert np.all(found.position_std >= found.cramer_rao.position_std)
    assert np.all(found.rotation_std_deg >= found.cramer_rao.rotation_std_deg)
    assert np.all(np.isfinite(found.covariance))


def test_small_displacements_alone_tend_to_the_local_bound():
    steps = 1e-4 * np.eye(6)
    F, _, A = _moments(WAVES, steps, 1.0)
    np.testing.assert_allclose(chapman_robbins(steps, A), np.linalg.inv(F), rtol=1e-3)


def test_an_image_that_is_linear_in_the_pose_gives_the_local_bound():
    J = RNG.normal(size=(60, 6))
    F = J.T @ J
    xi = 0.1 * RNG.normal(size=(8, 6)) * [1, 1, 1, 0, 0, 0]  # translations, for which y is linear, too
    found = hammersley_chapman_robbins(_information(F), xi, xi @ F @ xi.T, xi @ F)
    np.testing.assert_allclose(found.position_std, found.cramer_rao.position_std, rtol=1e-6)


def test_more_displacements_never_lower_it():
    sizes = (1, 2, 4, 8, 12)
    traces = [np.trace(_bound(WAVES, SMALL[:n], 2.0).covariance) for n in sizes]
    assert np.all(np.diff(traces) >= -1e-9)
    assert traces[-1] > 1.01 * np.trace(_bound(WAVES, SMALL[:1], 2.0).cramer_rao.covariance)


def test_an_exact_repetition_is_infinite_along_itself_and_nowhere_else():
    period = np.array([[1.0, 0, 0, 0, 0, 0]])
    found = _bound(PERIODIC, np.vstack([period, SMALL]), 0.5, floor=1e-20)
    assert found.repeats.tolist() == [True] + [False] * 12
    # The camera's x axis is tilted against all of the world's.
    assert np.all(np.isinf(found.position_std))
    assert np.all(np.isfinite(found.rotation_std_deg))
    straight = hammersley_chapman_robbins(
        _information(_moments(PERIODIC, period, 0.5)[0], np.eye(4)),
        period,
        np.zeros((1, 1)),
        np.zeros((1, 6)),
    )
    assert np.isinf(straight.position_std).tolist() == [True, False, False]
    np.testing.assert_allclose(straight.position_std[1:], straight.cramer_rao.position_std[1:])
    assert np.all(np.isnan(straight.covariance[0, 1:]))
    assert np.isinf(chapman_robbins([[1.0]], [[0.0]])[0, 0])
    # Negative control: a hundredth of a period aside it is an image like any other.
    assert not _bound(PERIODIC, 1.01 * period, 0.5, floor=1e-20).repeats.any()


def test_what_is_unseen_locally_stays_infinite():
    waves = WAVES * [1, 1, 1, 1, 1, 0]
    found = _bound(waves, SMALL * [1, 1, 1, 1, 1, 0], 0.5)
    assert np.isinf(found.rotation_std_deg).tolist() == [False, False, True]
    assert np.all(np.isfinite(found.position_std))


def test_a_displacement_that_nothing_resolves_says_nothing():
    """Shorter than Monte Carlo noise, locally, too: no repetition, and no effect."""
    tiny = 1e-6 * SMALL[:1]
    found = _bound(WAVES, tiny, 1.0, standard_error=1e-3)
    assert not found.repeats.any()
    np.testing.assert_allclose(found.position_std, found.cramer_rao.position_std)


def test_monte_carlo_noise_in_the_distances_makes_it_smaller():
    """One per cent of noise in A, 60 times: the exact value is exceeded by no more than that noise."""
    F, B, A = _moments(WAVES, SMALL, 2.0)
    exact = _bound(WAVES, SMALL, 2.0).position_std
    rng = np.random.default_rng(8)
    scale = np.sqrt(np.diagonal(A))
    found = []
    for _ in range(60):
        E = rng.normal(size=(12, 12)) / np.sqrt(2.0)
        noisy = A + 0.01 * np.outer(scale, scale) * (E + E.T)
        errors = 0.01 * np.sqrt(2.0) * scale**2
        found.append(
            hammersley_chapman_robbins(_information(F), SMALL, noisy, B, standard_error=errors).position_std
        )
    assert np.all(np.quantile(found, 0.95, axis=0) <= 1.01 * exact)
    assert np.all(np.array(found) >= _bound(WAVES, SMALL, 2.0).cramer_rao.position_std)


def _grating(x, contrast):
    """Four waves under a slow one of some contrast, seen at 48 points, as the camera moves along x."""
    u = np.arange(48) / 48.0
    shift = np.asarray(x)[..., None] + u
    return np.sin(8 * np.pi * shift) * (1.0 + contrast * np.cos(2 * np.pi * shift))


@pytest.mark.parametrize(("contrast", "sigma", "ambiguous"), [(0.05, 0.5, True), (0.5, 0.1, False)])
def test_maximum_likelihood_mistakes_one_place_for_another_where_the_bound_says_so(
    contrast, sigma, ambiguous
):
    """A nearly periodic grating: the likelihood's other peaks cost what HCR foresees and CRB does not."""
    grid = np.linspace(-0.5, 0.5, 4001)[:-1]
    images = _grating(grid, contrast)
    truth = _grating(0.0, contrast)
    xi = np.zeros((120, 6))
    xi[:, 0] = np.linspace(-0.48, 0.5, 120)
    delta = (_grating(xi[:, 0], contrast) - truth) / sigma
    J = (_grating(1e-6, contrast) - _grating(-1e-6, contrast)) / 2e-6 / sigma
    F = np.diag([J @ J, 1e9, 1e9, 1e9, 1e9, 1e9])
    cross = np.hstack([(delta @ J)[:, None], np.zeros((120, 5))])
    found = hammersley_chapman_robbins(_information(F, np.eye(4)), xi, delta @ delta.T, cross)
    noisy = truth + sigma * np.random.default_rng(3).normal(size=(2000, 48))
    # ‖y − μ(x)‖² less ‖y‖²
    misfit = np.sum(images**2, axis=1) - 2.0 * noisy @ images.T
    error = np.mean(grid[np.argmin(misfit, axis=1)] ** 2)
    local = found.cramer_rao.position_std[0] ** 2
    assert (found.position_std[0] ** 2 >= 10.0 * local) == ambiguous
    assert (error >= 3.0 * local) == ambiguous
    if not ambiguous:
        np.testing.assert_allclose(error, local, rtol=0.15)


def test_axis_displacements_move_the_image_by_what_they_say():
    camera = Camera.pinhole(100.0, centre=(30.0, 40.0), size=(60, 80))
    xi = axis_displacements([2.0, 8.0], camera, length_scale=3.0)
    assert xi.shape == (24, 6)
    roll = 2.0 * np.sqrt(12.0) / 100.0
    np.testing.assert_allclose(xi[:6], np.diag([0.06, 0.06, 3.0 * roll, 0.02, 0.02, roll]))
    np.testing.assert_allclose(xi[12:], -xi[:12])


@pytest.mark.parametrize(
    ("displacements", "inner", "cross", "words"),
    [
        (np.zeros((1, 6)), np.eye(1), np.zeros((1, 6)), "not zero"),
        (np.full((1, 6), np.nan), np.eye(1), np.zeros((1, 6)), "finite"),
        (np.ones((2, 6)), np.eye(3), np.zeros((2, 6)), "must have shapes"),
        (np.ones((2, 5)), np.eye(2), np.zeros((2, 6)), "must have shapes"),
    ],
)
def test_bad_input_is_named(displacements, inner, cross, words):
    with pytest.raises(OptionError, match=words):
        hammersley_chapman_robbins(_information(np.eye(6)), displacements, inner, cross)


def test_it_is_json_and_prints():
    found = _bound(PERIODIC, np.array([[1.0, 0, 0, 0, 0, 0]]), 0.5, floor=1e-20)
    assert json.loads(json.dumps(found.to_dict(), allow_nan=False))["position_std"]["values"] == ["inf"] * 3
    assert "1 of 1 displaced images repeat the image" in str(found)
