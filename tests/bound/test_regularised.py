"""Ridge and pseudo-inverse against dense linear algebra, and what they say of the unseen."""

from __future__ import annotations

import numpy as np
import pytest
from test_coordinates import POSE, F, _information

from mitsuba_crb import se3
from mitsuba_crb.bound.cramer_rao import cramer_rao_bound
from mitsuba_crb.bound.regularised import moore_penrose, ridge
from mitsuba_crb.errors import OptionError

ROLL = np.eye(6)[5]
BLIND = (np.eye(6) - np.outer(ROLL, ROLL)) @ F @ (np.eye(6) - np.outer(ROLL, ROLL))


def test_moore_penrose_is_numpy_s_pseudo_inverse_and_zero_where_the_bound_is_infinite():
    found = moore_penrose(_information(BLIND))
    np.testing.assert_allclose(found, np.linalg.pinv(BLIND, hermitian=True), atol=1e-9 * np.abs(found).max())
    assert abs(found[5, 5]) < 1e-12 * found[3, 3]
    assert np.isinf(cramer_rao_bound(_information(BLIND)).rotation_std_deg[2])
    np.testing.assert_allclose(found, cramer_rao_bound(_information(BLIND)).seen_covariance, atol=1e-18)


def test_ridge_is_the_inverse_of_the_ridged_matrix_and_as_large_as_it_says():
    found = ridge(_information(BLIND), 10.0)
    np.testing.assert_allclose(found, np.linalg.inv(BLIND + 10.0 * np.eye(6)), rtol=1e-6, atol=1e-15)
    np.testing.assert_allclose(found[5, 5], 0.1)


@pytest.mark.parametrize("regularised", [lambda i: ridge(i, 1.0), moore_penrose])
def test_both_come_in_the_information_s_frame(regularised):
    world = regularised(_information(F).to_frame("world"))
    np.testing.assert_allclose(world, se3.move_covariance(regularised(_information(F)), se3.adjoint(POSE)))


@pytest.mark.parametrize("epsilon", [0.0, -1.0, np.nan, np.inf])
def test_a_ridge_that_is_none_is_refused(epsilon):
    with pytest.raises(OptionError, match="ridge must be positive"):
        ridge(_information(F), epsilon)
