"""Van Trees' bound: the tangent of the prior's mean, the average, and what it tends to."""

from __future__ import annotations

import numpy as np
import pytest
import synthetic_view
from matrices import misfit
from small_scenes import camera, texture, textured_wall, wall

from mitsuba_crb import fisher_information, pose_bound, se3
from mitsuba_crb.bound.prior import prior_from_dict
from mitsuba_crb.errors import PriorError
from mitsuba_crb.measure.bayesian import _draw, prior_average, right_jacobian, van_trees
from mitsuba_crb.noise import Gaussian

pytestmark = pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")
SIGMA = Gaussian(0.01)


@pytest.mark.parametrize("size", [1e-9, 0.1, 2.0])
def test_the_right_jacobian_is_the_derivative_of_the_exponential(size):
    """Against central differences; the left Jacobian, J_r(−η), is the negative control."""
    eta = size * np.array([0.3, -0.5, 0.2, 0.4, 0.6, -0.3])
    step = 1e-6
    columns = [
        se3.log(se3.inverse(se3.exp(eta)) @ se3.exp(eta + step * e))
        - se3.log(se3.inverse(se3.exp(eta)) @ se3.exp(eta - step * e))
        for e in np.eye(6)
    ]
    derivative = np.transpose(columns) / (2 * step)
    np.testing.assert_allclose(right_jacobian(eta), derivative, atol=1e-8)
    if size > 0.01:
        assert np.abs(right_jacobian(-eta) - derivative).max() > 0.01


def test_draws_have_the_priors_covariance():
    """20,000 draws: relative errors of 1 % in variances, and as much of unit correlations."""
    rng = np.random.default_rng(0)
    root = np.diag([10.0, 5, 1, 100, 50, 20]) @ (np.eye(6) + 0.3 * rng.normal(size=(6, 6)))
    P = root @ root.T
    whitened = _draw(P, 20_000, 0) @ np.linalg.cholesky(P)
    np.testing.assert_allclose(np.cov(whitened, rowvar=False), np.eye(6), atol=0.05)


def test_the_average_at_the_mean_is_the_information_itself():
    information = fisher_information(synthetic_view.jacobian(), SIGMA)
    average = prior_average([information] * 3, np.zeros((3, 6)), information.pose)
    assert misfit(average.matrix, information.matrix) < 1e-12
    assert np.abs(average.covariance_of_entries).max() < 1e-20 * information.matrix.max() ** 2


@pytest.mark.slow
def test_a_narrow_prior_gives_the_local_bound_with_that_prior():
    """Within 4 standard errors of F(x̄) + P, entry by entry."""
    view = {**textured_wall(), "camera": camera(16, 12), "wall": wall(texture(cells=16))}
    prior = prior_from_dict({"frame": "world", "position_std": 1e-4, "rotation_std_deg": 0.003})
    averaged = van_trees(view, SIGMA, prior, draws=8, spp=16)
    local = pose_bound(view, SIGMA, prior=prior, spp=256)
    error = np.hypot(averaged.information.standard_error, local.information.standard_error)
    difference = np.abs(averaged.information.matrix - local.information.matrix)
    assert (difference <= 4.0 * error).all()
    assert averaged.provenance["draws"] == 8
    assert (averaged.position_std < 1e-4).all()


def test_a_prior_that_leaves_a_direction_open_is_refused():
    prior = prior_from_dict({"frame": "camera", "position_std": 0.1})
    with pytest.raises(PriorError, match="leaves a direction open"):
        van_trees(textured_wall(), SIGMA, prior, spp=8)
    with pytest.raises(PriorError, match="at least two draws, not 1"):
        van_trees(textured_wall(), SIGMA, prior, draws=1)
