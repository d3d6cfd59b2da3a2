"""Coordinates of the pose: the bound does not depend on them, and infinities go where they belong.

Oracles: central differences of the coordinates themselves, and the information of a bundle of points that is
parameterised by the coordinates from the start.
"""

from __future__ import annotations

import json

import numpy as np
import pytest
from matrices import misfit
from rigs import made
from scipy.spatial.transform import Rotation

from mitsuba_crb import se3
from mitsuba_crb.bound.coordinates import NAMES, coordinates_of, to_coordinates
from mitsuba_crb.bound.cramer_rao import cramer_rao_bound
from mitsuba_crb.errors import CoordinatesError

POSE = se3.exp([1.0, -2.0, 0.5, 0.4, -0.3, 0.8])
POINTS = np.random.default_rng(0).uniform([-2, -2, 3], [2, 2, 8], (12, 3)) @ POSE[:3, :3].T + POSE[:3, 3]
SIGMA = 1e-3
STEP = 1e-5
"""Central differences of O(1) functions: truncation h², rounding 1e-16 / h, both near 1e-10."""

SEQUENCES = ("YXZ", "zyx", "ZXZ", "xyz")
CHARTS = [*((name, "ZYX") for name in NAMES), *(("euler", sequence) for sequence in SEQUENCES)]


def _information(matrix, pose=POSE, covariance=None):
    return made(matrix, covariance, pose=pose, length_scale=1.0)


def _project(pose):
    """(24,), the points' images, by a pinhole."""
    seen = (POINTS - pose[:3, 3]) @ pose[:3, :3]
    return (seen[:, :2] / seen[:, 2:]).ravel()


def _pose_of(y, name, sequence):
    """The pose with coordinates y, written down anew from each chart's definition."""
    pose = POSE.copy()
    if name == "camera":
        return POSE @ se3.exp(y)
    if name == "world":
        return se3.exp(y) @ POSE
    if name == "gtsam":
        return se3.pose_from_gtsam(se3.pose_to_gtsam(POSE) @ se3.exp(np.roll(y, 3)))
    if name == "colmap":
        moved = se3.pose_to_colmap(POSE)
        moved[:3, :3] = Rotation.from_rotvec(2.0 * y[:3]).as_matrix() @ moved[:3, :3]
        moved[:3, 3] += y[3:]
        return se3.pose_from_colmap(moved)
    pose[:3, 3] = y[:3]
    if name == "centre_rotation":
        pose[:3, :3] = POSE[:3, :3] @ Rotation.from_rotvec(y[3:]).as_matrix()
    elif name == "euler":
        pose[:3, :3] = Rotation.from_euler(sequence, y[3:]).as_matrix()
    else:
        pose[:3, :3] = Rotation.from_quat([*y[3:], np.sqrt(1.0 - y[3:] @ y[3:])]).as_matrix()
    return pose


def _derivative(function, at):
    steps = STEP * np.eye(6)
    return np.column_stack([(function(at + h) - function(at - h)) / (2.0 * STEP) for h in steps])


J = _derivative(lambda xi: _project(POSE @ se3.exp(xi)), np.zeros(6))
F = J.T @ J / SIGMA**2


@pytest.mark.parametrize(("name", "sequence"), CHARTS)
def test_the_values_are_those_of_the_pose(name, sequence):
    y = coordinates_of(POSE, name, sequence=sequence)
    np.testing.assert_allclose(_pose_of(y.values, name, sequence), POSE, atol=1e-14)


@pytest.mark.parametrize(("name", "sequence"), CHARTS)
def test_the_jacobian_is_the_derivative_by_central_differences(name, sequence):
    y = coordinates_of(POSE, name, sequence=sequence)

    def pose_entries(values):
        return _pose_of(values, name, sequence)[:3].ravel()

    by_twist = _derivative(lambda xi: (POSE @ se3.exp(xi))[:3].ravel(), np.zeros(6))
    np.testing.assert_allclose(_derivative(pose_entries, y.values) @ y.jacobian, by_twist, atol=1e-8)


@pytest.mark.parametrize(("name", "sequence"), CHARTS)
def test_the_bound_is_that_of_the_problem_posed_in_these_coordinates(name, sequence):
    y = coordinates_of(POSE, name, sequence=sequence)
    J_y = _derivative(lambda values: _project(_pose_of(values, name, sequence)), y.values)
    F_y = J_y.T @ J_y / SIGMA**2
    found = to_coordinates(cramer_rao_bound(_information(F)), name, sequence=sequence)
    C = np.linalg.inv(F_y)
    scale = np.sqrt(np.diagonal(C))
    # 1e-9 of the differences, times F's condition number of about 1e3
    assert misfit(found.covariance, C) < 1e-6
    np.testing.assert_allclose(found.std, scale, rtol=1e-6)
    np.testing.assert_allclose(found.information, F_y, atol=1e-6 * np.abs(F_y).max())


def test_a_function_of_the_pose_has_one_bound_in_all_coordinates():
    """The variance of a depth: ∇fᵀ C ∇f, the gradient taken in each chart."""

    def depth(pose):
        return np.array([(POINTS[0] - pose[:3, 3]) @ pose[:3, 2]])

    variances = []
    for name, sequence in CHARTS:
        y = to_coordinates(_information(F), name, sequence=sequence)
        gradient = _derivative(lambda v, n=name, s=sequence: depth(_pose_of(v, n, s)), y.coordinates.values)[
            0
        ]
        variances.append(gradient @ y.covariance @ gradient)
    np.testing.assert_allclose(variances, variances[0], rtol=1e-6)
    # Negative control: one chart's covariance with another's gradient.
    gradient = _derivative(lambda v: depth(_pose_of(v, "world", "")), np.zeros(6))[0]
    wrong = gradient @ to_coordinates(_information(F), "camera").covariance @ gradient
    assert abs(wrong / variances[0] - 1.0) > 0.1


def test_the_twists_are_the_bound_s_own_matrices():
    for frame in ("camera", "world"):
        bound = cramer_rao_bound(_information(F).to_frame(frame))
        assert misfit(to_coordinates(bound, frame).covariance, bound.covariance) < 1e-9
    found = to_coordinates(bound, "centre_rotation")
    np.testing.assert_allclose(found.std[:3], bound.position_std, rtol=1e-9)
    np.testing.assert_allclose(np.degrees(found.std[3:]), bound.rotation_std_deg, rtol=1e-9)


@pytest.mark.parametrize(("name", "sequence"), CHARTS)
def test_a_coordinate_is_infinite_exactly_if_it_moves_along_what_is_unseen(name, sequence):
    roll = np.array([0.0, 0, 0, 0, 0, 1])
    S = np.eye(6) - np.outer(roll, roll)
    found = to_coordinates(_information(S @ F @ S), name, sequence=sequence)
    moved = np.abs(coordinates_of(POSE, name, sequence=sequence).jacobian @ roll) > 1e-12
    np.testing.assert_array_equal(np.isinf(found.std), moved)
    assert moved.any()  # six of the world's twist: far from the origin every rotation drags it along
    assert np.all(np.isnan(found.covariance[moved][:, ~moved]))
    assert np.all(np.isfinite(found.covariance[~moved][:, ~moved]))
    np.testing.assert_array_equal(np.isnan(found.std_standard_error), moved)


def test_a_prior_counts_in_all_coordinates():
    prior = np.diag([0.0, 0, 0, 0, 0, 1e4])
    roll = np.eye(6)[5]
    S = np.eye(6) - np.outer(roll, roll)
    bound = cramer_rao_bound(_information(S @ F @ S), prior=prior)
    found = to_coordinates(bound, "euler")
    expected = coordinates_of(POSE, "euler").jacobian @ np.linalg.inv(S @ F @ S + prior)
    expected = expected @ coordinates_of(POSE, "euler").jacobian.T
    assert misfit(found.covariance, expected) < 1e-6


@pytest.mark.parametrize(("sequence", "second"), [("ZYX", np.pi / 2), ("ZXZ", 0.0), ("xyz", -np.pi / 2)])
def test_gimbal_lock_is_an_error_and_close_to_it_the_jacobian_still_right(sequence, second):
    def pose(angle):
        return np.block(
            [[Rotation.from_euler(sequence, [0.3, angle, 0.2]).as_matrix(), np.ones((3, 1))], [0, 0, 0, 1]]
        )

    for angle in (second, second + 1e-8):
        with pytest.raises(CoordinatesError, match=r"gimbal lock .* take another sequence"):
            coordinates_of(pose(angle), "euler", sequence=sequence)
    near = coordinates_of(pose(second + 1e-3), "euler", sequence=sequence)
    other = "YXZ"
    a, b = near.jacobian, coordinates_of(pose(second + 1e-3), "euler", sequence=other).jacobian
    step = 1e-7 * np.array([0.2, -0.5, 0.4])
    moved = Rotation.from_matrix(pose(second + 1e-3)[:3, :3]) * Rotation.from_rotvec(step)
    change = moved.as_euler(sequence) - near.values[3:]
    np.testing.assert_allclose(a[3:, 3:] @ step, change, rtol=1e-3)
    assert np.linalg.cond(b) < np.linalg.cond(a)


def test_a_half_turn_has_no_quaternion_vector_part():
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0.0, np.pi, 0.0]).as_matrix()
    with pytest.raises(
        CoordinatesError, match=r"singular at this pose \(w = .*take centre_rotation or euler"
    ):
        to_coordinates(_information(F, pose), "quaternion")
    pose[:3, :3] = Rotation.from_rotvec([0.0, np.pi - 1e-3, 0.0]).as_matrix()
    assert np.all(np.isfinite(to_coordinates(_information(F, pose), "quaternion").std))


@pytest.mark.parametrize("sequence", ["ZZX", "ZY", "abc", "ZyX", "ZYXZ", ""])
def test_an_impossible_euler_sequence_is_named(sequence):
    with pytest.raises(CoordinatesError, match=r"Euler sequence .* is none; give three axes"):
        coordinates_of(POSE, "euler", sequence=sequence)


def test_unknown_coordinates_list_the_known_ones():
    with pytest.raises(CoordinatesError, match="no coordinates 'rodrigues'; there are camera, world"):
        to_coordinates(_information(F), "rodrigues")


def test_coordinates_are_json_and_print_with_units():
    roll = np.eye(6)[5]
    S = np.eye(6) - np.outer(roll, roll)
    found = to_coordinates(_information(S @ F @ S), "euler")
    text = json.dumps(found.to_dict(), allow_nan=False)
    assert json.loads(text)["std"]["values"][3:] == ["inf"] * 3
    assert "[scene unit]" in str(found)
    assert "std inf [rad]" in str(found)
