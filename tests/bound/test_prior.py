"""Priors of a pose: frames, per-axis standard deviations, files, and what cannot be one."""

from __future__ import annotations

import json

import numpy as np
import pytest
import synthetic_view
from matrices import misfit
from synthetic_view import POSE

from mitsuba_crb import cramer_rao_bound, fisher_information, se3
from mitsuba_crb.bound.prior import PosePrior, load_prior, prior_from_dict
from mitsuba_crb.errors import PriorError
from mitsuba_crb.noise import Gaussian


def _written(tmp_path, text, name="prior.toml"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("frame", ["camera", "world"])
def test_the_quadratic_form_does_not_depend_on_the_frame(frame):
    """ξᵀPξ is invariant; taking the matrix for one of the other frame is the negative control."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6))
    prior = PosePrior(root @ root.T, frame)
    camera = rng.normal(size=6)
    world = se3.adjoint(POSE) @ camera
    own = camera if frame == "camera" else world
    expected = own @ prior.matrix @ own
    assert camera @ prior.in_frame("camera", POSE) @ camera == pytest.approx(expected)
    assert world @ prior.in_frame("world", POSE) @ world == pytest.approx(expected)
    other = world if frame == "camera" else camera
    assert other @ prior.matrix @ other != pytest.approx(expected, rel=0.01)


def test_deviations_in_the_world_are_of_the_centre_and_about_it():
    """A bound of nothing but the prior has the prior's own standard deviations, however far the origin is."""
    deviations = {"position_std": [0.1, 0.2, 0.3], "rotation_std_deg": 2.0}
    prior = prior_from_dict({"frame": "world", **deviations})
    covariance = np.linalg.inv(prior.in_frame("camera", POSE))
    R = POSE[:3, :3]
    centre = R @ covariance[:3, :3] @ R.T
    np.testing.assert_allclose(np.sqrt(np.diagonal(centre)), deviations["position_std"])
    np.testing.assert_allclose(centre, np.diag(np.diagonal(centre)), atol=1e-12)
    np.testing.assert_allclose(covariance[3:, 3:], np.radians(2.0) ** 2 * np.eye(3), atol=1e-12)


def test_it_is_added_whatever_the_frame_of_the_information():
    information = fisher_information(synthetic_view.jacobian(), Gaussian(0.1))
    prior = prior_from_dict({"frame": "world", "position_std": 0.001})
    added = information.matrix + prior.in_frame("camera", POSE)
    camera = cramer_rao_bound(information, prior=prior)
    world = cramer_rao_bound(information.to_frame("world"), prior=prior)
    assert misfit(camera.information.matrix, added) < 1e-12
    np.testing.assert_allclose(world.position_std, camera.position_std, rtol=1e-6)
    assert (camera.position_std < cramer_rao_bound(information).position_std).all()
    assert (camera.position_std < 0.001).all()


def test_files_say_the_same_as_matrices(tmp_path):
    rng = np.random.default_rng(1)
    root = rng.normal(size=(6, 6))
    covariance = root @ root.T
    text = json.dumps({"frame": "world", "covariance": covariance.tolist()})
    from_json = load_prior(_written(tmp_path, text, "prior.json"))
    assert misfit(from_json.matrix, np.linalg.inv(covariance)) < 1e-9
    toml = 'frame = "camera"\nposition_std = 0.5\nrotation_std_deg = [1.0, inf, 1.0]\n'
    expected = np.diag([4.0, 4.0, 4.0, *(np.radians(1.0) ** -2.0 * np.array([1.0, 0.0, 1.0]))])
    np.testing.assert_allclose(load_prior(_written(tmp_path, toml)).matrix, expected)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("frame = 'camera'\n", "needs a frame and either"),
        ("position_std = 1\n", "has no frame"),
        ("frame = 'body'\nposition_std = 1\n", "'camera' or 'world', not 'body'"),
        ("frame = 'camera'\nsigma = 1\n", "unknown key 'sigma'; known are frame, information"),
        ("frame = 'camera'\npositon_std = 1\n", "unknown key 'positon_std'; did you mean 'position_std'"),
        ("frame = 1\nposition_std = 1\n", "frame must be 'camera' or 'world', not 1"),
        ("frame = 'camera'\nposition_std = true\n", "position_std must be a positive number or"),
        ("frame = 'camera'\nposition_std = nan\n", "position_std must be a positive number or"),
        ("frame = 'camera'\nposition_std = [1, true, 1]\n", "position_std must be a positive number or"),
        ("frame = 'camera'\nrotation_std_deg = '1'\n", "rotation_std_deg must be a positive number or three"),
        ("frame = 'camera'\ncovariance = [[true]]\n", "covariance must be a 6 x 6 matrix of numbers, not"),
        ("frame = 'camera'\ninformation = {}\n", "information\\]? must be a 6 x 6 matrix of numbers, not {}"),
        ("frame = 'camera'\nposition_std = -1\n", "position_std must be a positive number"),
        (
            "frame = 'camera'\nposition_std = 1e-300\n",
            "prior has entries that are not finite",
        ),
        (f"frame = 'camera'\nposition_std = 1{400 * '0'}\n", "position_std must be a positive number"),
        (f"frame = 'camera'\ninformation = 1{400 * '0'}\n", "6 x 6 matrix of numbers"),
        ("frame = 'camera'\nposition_std = [1, 2]\n", "position_std must be a positive number"),
        ("frame = 'camera'\ninformation = [[1, 2]]\n", r"6 x 6 matrix of numbers, not of shape \(1, 2\)"),
        ("frame = ", "prior.toml is no TOML"),
    ],
)
def test_what_is_no_prior_is_named(tmp_path, text, message):
    with pytest.raises(PriorError, match=message):
        load_prior(_written(tmp_path, text))


def test_matrices_that_are_no_information_are_named(tmp_path):
    with pytest.raises(PriorError, match=r"cannot read .*missing.toml: No such file"):
        load_prior(tmp_path / "missing.toml")
    with pytest.raises(PriorError, match=r"not positive semi-definite.* eigenvalue is -1$"):
        PosePrior(np.diag([1.0, 1, 1, 1, 1, -1]), "camera")
    with pytest.raises(PriorError, match="not symmetric"):
        PosePrior(np.triu(np.ones((6, 6))), "camera")
    with pytest.raises(PriorError, match=r"not positive definite.*; give information"):
        prior_from_dict({"frame": "camera", "covariance": np.diag([1, 1, 1, 1, 1, 0]).tolist()})
    with pytest.raises(PriorError, match=r"a prior must be a table, not \[1\]"):
        prior_from_dict([1])


ROW_BY_ROW = [0.1 * (i == j) + 0.01 for i in range(6) for j in range(6)]
"""A covariance as a ROS message has it."""


def test_rows_of_zeros_are_named_and_zeros_are_allowed_in_information():
    """What a SLAM system publishes of a planar robot; a variance of 1e-9 is taken as it is written."""
    hessian = np.zeros((6, 6))
    hessian[np.ix_([0, 1, 5], [0, 1, 5])] = [[2500, 0, 100], [0, 2500, 0], [100, 0, 40000]]
    table = {"frame": "camera", "covariance": hessian.tolist()}
    with pytest.raises(PriorError, match=r"rows of z, phi_x, phi_y; give information, in which zeros are al"):
        prior_from_dict(table)
    information = prior_from_dict({"frame": "camera", "information": hessian.tolist()})
    np.testing.assert_array_equal(information.matrix, hessian)
    one = np.diag([1.0, 1, 1, 1, 0, 1]).tolist()
    with pytest.raises(PriorError, match="all is zero in the rows of phi_y;"):
        prior_from_dict({"frame": "world", "covariance": one})
    tiny = [1e-4, 1e-4, 1e-9, 1e-9, 1e-9, 1e-5]
    known = prior_from_dict({"frame": "camera", "covariance": np.diag(tiny).tolist()})
    np.testing.assert_allclose(known.matrix, np.diag(1.0 / np.array(tiny)), rtol=1e-12)


@pytest.mark.parametrize("row_by_row", [False, True])
def test_what_ros_means_by_zeros_and_minus_one_is_said(row_by_row):
    zeros = np.zeros((6, 6))
    absent = zeros.copy()
    absent[0, 0] = -1.0
    for matrix, message in (
        (zeros, r"is all zero.*give information.*all zeros in ROS messages: leave the prior out"),
        (absent, r"begins with -1, by which ROS messages say that there is none: leave the prior out"),
    ):
        values = (matrix.ravel() if row_by_row else matrix).tolist()
        with pytest.raises(PriorError, match=message) as caught:
            prior_from_dict({"frame": "camera", "covariance": values})
        assert "\n" not in str(caught.value)
    nothing = (zeros.ravel() if row_by_row else zeros).tolist()
    assert not prior_from_dict({"frame": "camera", "information": nothing}).matrix.any()


def test_36_numbers_in_a_row_are_6_x_6():
    square = np.reshape(ROW_BY_ROW, (6, 6)).tolist()
    for key in ("covariance", "information"):
        flat, nested = (
            prior_from_dict({"frame": "camera", key: values}).matrix for values in (ROW_BY_ROW, square)
        )
        np.testing.assert_array_equal(flat, nested)
        with pytest.raises(PriorError, match="a 6 x 6 matrix of numbers, not"):
            prior_from_dict({"frame": "camera", key: ROW_BY_ROW[:-1]})
        with pytest.raises(PriorError, match="a 6 x 6 matrix of numbers, not"):
            prior_from_dict({"frame": "camera", key: [True, *ROW_BY_ROW[1:]]})


def test_a_message_in_the_world_is_of_the_centre_and_about_it_not_a_world_twist():
    """The camera's centre keeps the covariance that it is given; a world twist's is another, far from 0."""
    table = {"frame": "world", "covariance": ROW_BY_ROW}
    with pytest.raises(PriorError, match="in the world frame need kind = 'axes' if"):
        prior_from_dict(table)
    covariance = np.linalg.inv(prior_from_dict({**table, "kind": "axes"}).in_frame("camera", POSE))
    world = np.kron(np.eye(2), POSE[:3, :3])
    np.testing.assert_allclose(world @ covariance @ world.T, np.reshape(ROW_BY_ROW, (6, 6)), atol=1e-12)
    twist = np.linalg.inv(prior_from_dict({**table, "kind": "twist"}).in_frame("camera", POSE))
    assert misfit(world @ twist @ world.T, np.reshape(ROW_BY_ROW, (6, 6))) > 0.1
    with pytest.raises(PriorError, match="kind goes with information or covariance, not with position_std"):
        prior_from_dict({"frame": "world", "position_std": 1.0, "kind": "axes"})
