"""Rigid motions: each map against its definition, SciPy's matrix exponential, other tools' numbers."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import RigidTransform, Rotation

from mitsuba_crb import se3
from mitsuba_crb.errors import PoseError

POSE = se3.pose_from_vector("3 -2 1 0.3 0.1 -0.2 0.927361849549570")
FAR = se3.exp([0.4, -0.2, 0.1, 0.3, -0.5, 0.9]) + np.array(
    [[0, 0, 0, 1e4], [0, 0, 0, -7e3], [0, 0, 0, 2e3], [0] * 4]
)


def _generator(twist):
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = se3.skew(twist[3:])
    matrix[:3, 3] = twist[:3]
    return matrix


def _twists(angles, seed=0):
    rng = np.random.default_rng(seed)
    for angle in angles:
        axis = rng.normal(size=3)
        yield np.concatenate([rng.normal(size=3), angle * axis / np.linalg.norm(axis)])


@pytest.mark.parametrize(
    "angle", [0.0, 1e-12, 1e-8, 1e-4, 1e-3, 0.1, 1.0, 3.0, np.pi - 1e-6, np.pi - 1e-9, np.pi]
)
def test_exp_is_the_matrix_exponential(angle):
    for twist in _twists([angle] * 5):
        np.testing.assert_allclose(se3.exp(twist), expm(_generator(twist)), atol=1e-13)


def test_exp_takes_translation_first():
    np.testing.assert_allclose(se3.exp([1, 2, 3, 0, 0, 0])[:3, 3], [1, 2, 3])
    swapped = se3.exp([0, 0, 0, 1, 2, 3])
    assert np.abs(swapped[:3, 3]).max() == 0.0


# Near π the logarithm's axis is only defined to √ε: a looser tolerance on the twist, not on the pose.
@pytest.mark.parametrize(
    ("angle", "tolerance"),
    [(0.0, 1e-14), (1e-9, 1e-14), (1e-4, 1e-12), (1.0, 1e-13), (3.1, 1e-12), (np.pi - 1e-7, 1e-7)],
)
def test_log_inverts_exp(angle, tolerance):
    for twist in _twists([angle] * 5, seed=1):
        np.testing.assert_allclose(se3.log(se3.exp(twist)), twist, atol=tolerance)
        np.testing.assert_allclose(se3.exp(se3.log(se3.exp(twist))), se3.exp(twist), atol=1e-12)


def test_exp_and_log_are_vectorised():
    twists = np.array(list(_twists([0.1, 1.0, 2.0])))
    np.testing.assert_allclose(se3.exp(twists)[1], se3.exp(twists[1]))
    np.testing.assert_allclose(se3.log(se3.exp(twists)), twists, atol=1e-13)


def test_inverse_is_the_matrix_inverse():
    np.testing.assert_allclose(se3.inverse(POSE), np.linalg.inv(POSE), atol=1e-15)


def test_adjoint_carries_a_twist_through_a_pose():
    for twist in _twists([0.3, 2.0]):
        left = POSE @ se3.exp(twist) @ se3.inverse(POSE)
        np.testing.assert_allclose(left, se3.exp(se3.adjoint(POSE) @ twist), atol=1e-13)
        rotation_first = np.roll(np.roll(se3.adjoint(POSE), 3, axis=0), 3, axis=1)
        assert np.abs(left - se3.exp(rotation_first @ twist)).max() > 0.1


def test_world_twist_is_the_left_perturbation_even_ten_kilometres_away():
    for pose, tolerance in ((POSE, 1e-14), (FAR, 1e-11)):
        for twist in _twists([0.3]):
            world = se3.adjoint(pose) @ twist
            np.testing.assert_allclose(se3.exp(world) @ pose, pose @ se3.exp(twist), atol=tolerance)


def test_camera_centre_moves_by_rho_minus_c_cross_phi():
    step = 1e-6
    for column in np.eye(6):
        moved = [(se3.exp(sign * step * column) @ POSE)[:3, 3] for sign in (1, -1)]
        expected = column[:3] - np.cross(POSE[:3, 3], column[3:])
        np.testing.assert_allclose((moved[0] - moved[1]) / (2 * step), expected, atol=1e-9)


def test_information_moves_so_that_the_quadratic_form_stays():
    rng = np.random.default_rng(2)
    J = rng.normal(size=(30, 6))
    F = J.T @ J
    for pose in (POSE, FAR):
        A = se3.adjoint(pose)
        F_world = se3.move_information(F, A)
        for twist in rng.normal(size=(20, 6)):
            world = A @ twist
            error = world @ F_world @ world - twist @ F @ twist
            assert abs(error) < 1e-9 * np.linalg.norm(F_world) * (world @ world)
    C_world = se3.move_covariance(np.linalg.inv(F), se3.adjoint(POSE))
    np.testing.assert_allclose(se3.move_information(F, se3.adjoint(POSE)) @ C_world, np.eye(6), atol=1e-9)


class TestAsPose:
    def test_exact_poses_pass_unchanged_and_copied(self):
        pose = se3.as_pose(POSE)
        np.testing.assert_array_equal(pose, POSE)
        assert pose is not POSE

    def test_a_rigid_transform_passes(self):
        np.testing.assert_allclose(se3.as_pose(RigidTransform.from_matrix(POSE)), POSE, atol=1e-15)

    def test_rounding_of_float32_and_text_is_removed(self):
        for rounded in (POSE.astype(np.float32), np.round(POSE, 5), np.round(POSE, 3)):
            rotation = se3.as_pose(rounded)[:3, :3]
            np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
            np.testing.assert_allclose(rotation, POSE[:3, :3], atol=1e-3)
            assert np.abs(np.asarray(rounded[:3, :3] @ rounded[:3, :3].T, float) - np.eye(3)).max() > 1e-9

    @pytest.mark.parametrize(
        ("value", "message"),
        [
            (np.diag([-1.0, 1, 1, 1]), "reflection"),
            (np.diag([2.0, 2, 2, 1]), "a scale"),
            (np.diag([1.0, 1.01, 1, 1]), "unequal scales"),
            (np.diag([0.0, 1, 1, 1]), "unequal scales"),
            (np.diag([1.002, 1.002, 1.002, 1]), "a scale"),
            (POSE[:3], "shape"),
            (np.where(np.eye(4) > 0, np.nan, 0.0), "NaN"),
            (POSE.T, "transposed"),
            ("camera", "4 x 4 matrix"),
            ([[1, 2], [3]], "4 x 4 matrix"),
        ],
    )
    def test_what_is_no_rigid_motion_is_named(self, value, message):
        with pytest.raises(PoseError, match=message):
            se3.as_pose(value)
        with pytest.raises(PoseError, match="the rig's pose .*" + message):
            se3.as_pose(value, "the rig's pose")


class TestPoseFromVector:
    def test_text_and_numbers_agree_with_scipy(self):
        quaternion = np.array([0.5, -0.5, 0.1, 0.7])
        quaternion /= np.linalg.norm(quaternion)
        numbers = [1.0, 2.0, 3.0, *quaternion]
        pose = se3.pose_from_vector(numbers)
        np.testing.assert_allclose(pose[:3, :3], Rotation.from_quat(quaternion).as_matrix(), atol=1e-15)
        np.testing.assert_array_equal(pose[:3, 3], [1, 2, 3])
        np.testing.assert_array_equal(se3.pose_from_vector(", ".join(map(repr, map(float, numbers)))), pose)

    def test_rounded_quaternions_are_normalised(self):
        rotation = se3.pose_from_vector("0 0 0 0 0 0.71 0.71")[:3, :3]
        np.testing.assert_allclose(rotation, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15)

    @pytest.mark.parametrize(
        ("value", "message"),
        [
            ("1 2 3", "seven numbers"),
            ("1 2 3 0 0 0 one", "cannot read"),
            ([0, 0, 0, 0, 0, 0, 0], "length 0"),
            ([0, 0, 0, 1, 1, 1, 1], "length 2"),
            ([np.inf, 0, 0, 0, 0, 0, 1], "infinite"),
        ],
    )
    def test_mistakes_are_named(self, value, message):
        with pytest.raises(PoseError, match=message):
            se3.pose_from_vector(value)


def _point_information():
    """Information (camera frame) of 18 known points seen with unit pixel noise, by central differences."""
    points = np.array([[x, y, z] for x in (-1, 0.5, 1) for y in (-1, 0.2, 1) for z in (5.0, 6.5)])
    world_from_colmap = se3.pose_to_gtsam(POSE)
    world = points @ world_from_colmap[:3, :3].T + world_from_colmap[:3, 3]

    def project(pose):
        cam_from_world = se3.pose_to_colmap(pose)
        camera = world @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
        return (500.0 * camera[:, :2] / camera[:, 2:]).ravel()

    h = 1e-5
    J = [(project(POSE @ se3.exp(h * e)) - project(POSE @ se3.exp(-h * e))) / (2 * h) for e in np.eye(6)]
    return np.array(J) @ np.array(J).T


class TestOtherTools:
    # Upper triangles that the tools themselves returned for `_point_information`'s points and POSE:
    # estimate_and_refine_absolute_pose(..., return_covariance=True) of pycolmap 4.2.1, and Marginals over
    # GenericProjectionFactorCal3_S2 with fixed points of gtsam 4.3.0.
    COLMAP = (
        "3.30733931e-06 -4.31026463e-09 -4.86838972e-08 1.10669010e-07 5.17895147e-05 2.32528353e-06 "
        "3.33715514e-06 -2.09546854e-08 -5.26163353e-05 -2.03658165e-07 -2.03661597e-05 1.24936408e-06 "
        "-3.25922038e-07 6.35443089e-06 9.40235769e-08 8.37054587e-04 1.97430106e-07 3.25623307e-04 "
        "8.58535420e-04 3.90359932e-05 2.73032046e-04"
    )
    GTSAM = (
        "1.32293572e-05 -1.72410585e-08 -1.94735589e-07 1.19476058e-07 7.52040452e-05 2.42777393e-07 "
        "1.33486205e-05 -8.38187415e-08 -7.60367828e-05 -1.16739033e-07 -4.61635325e-07 4.99745633e-06 "
        "8.10074772e-07 -1.93922584e-06 -6.68180839e-10 4.40262293e-04 7.85035402e-07 7.11394715e-06 "
        "4.34648622e-04 3.17433891e-06 1.47162756e-04"
    )

    # Ten printed digits and central differences with step 1e-5.
    @pytest.mark.parametrize(
        ("upper", "tool_from_camera"),
        [(COLMAP, se3.colmap_from_camera(POSE)), (GTSAM, se3.gtsam_from_camera())],
    )
    def test_covariance_is_what_the_tool_itself_computes(self, upper, tool_from_camera):
        expected = np.array(upper.split(), dtype=float)
        F = _point_information()
        actual = se3.move_covariance(np.linalg.inv(F), tool_from_camera)[np.triu_indices(6)]
        np.testing.assert_allclose(actual, expected, rtol=1e-5, atol=1e-7 * np.abs(expected).max())
        inverse = np.linalg.inv(se3.move_information(F, tool_from_camera))[np.triu_indices(6)]
        np.testing.assert_allclose(inverse, expected, rtol=1e-5, atol=1e-7 * np.abs(expected).max())
        left_twist = se3.move_covariance(np.linalg.inv(F), se3.adjoint(POSE))[np.triu_indices(6)]
        assert np.abs(left_twist / expected - 1.0).max() > 1.0

    def test_gtsam_tangent_is_right_and_rotation_first(self):
        # gtsam 4.3.0: Pose3.localCoordinates of the two poses.
        expected = [-0.02, -0.05, -0.04, -0.1, 0.2, 0.3]
        twist = [0.1, -0.2, 0.3, 0.02, 0.05, -0.04]
        np.testing.assert_allclose(se3.gtsam_from_camera() @ twist, expected, atol=1e-15)
        local = se3.log(se3.inverse(se3.pose_to_gtsam(POSE)) @ se3.pose_to_gtsam(POSE @ se3.exp(twist)))
        np.testing.assert_allclose(np.roll(local, 3), expected, atol=1e-14)

    def test_colmap_tangent_doubles_the_angle(self):
        h = 1e-6
        for twist in np.eye(6):
            delta, shift = np.split(se3.colmap_from_camera(POSE) @ (h * twist), 2)
            before, after = se3.pose_to_colmap(POSE), se3.pose_to_colmap(POSE @ se3.exp(h * twist))
            rotated = Rotation.from_rotvec(2 * delta).as_matrix() @ before[:3, :3]
            np.testing.assert_allclose(after[:3, :3], rotated, atol=1e-11)
            np.testing.assert_allclose(after[:3, 3], before[:3, 3] + shift, atol=1e-11)

    def test_poses_come_back(self):
        np.testing.assert_allclose(se3.pose_from_gtsam(se3.pose_to_gtsam(POSE)), POSE, atol=1e-15)
        np.testing.assert_allclose(se3.pose_from_colmap(se3.pose_to_colmap(POSE)), POSE, atol=1e-15)

    def test_turned_axes_point_right_and_down(self):
        # Mitsuba's camera has x left and y up: a point at its (1, 1, 5) is left of and above the axis.
        world = POSE @ [1.0, 1.0, 5.0, 1.0]
        np.testing.assert_allclose(se3.pose_to_colmap(POSE) @ world, [-1, -1, 5, 1], atol=1e-14)


def test_the_convention_table_comes_from_the_docstring():
    assert se3.CONVENTIONS in (se3.__doc__ or "")
    assert se3.CONVENTIONS.startswith("| what | convention |")
    for word in (
        "translation ρ",
        "right perturbation",
        "left perturbation",
        "GTSAM",
        "COLMAP",
        "pitch x, yaw y, roll z",
    ):
        assert word in se3.CONVENTIONS
    assert len(se3.TWIST_ORDER) == 6


def test_a_matrix_without_its_last_row_is_told_to_have_one() -> None:
    with pytest.raises(PoseError, match="3x4 matrix: append its last row, 0 0 0 1"):
        se3.pose_from_numbers(np.eye(4)[:3].tolist())
