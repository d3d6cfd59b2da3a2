"""Points: against the Gauss–Newton Hessian by complex steps, pycolmap and GTSAM; the gauge; bad input."""

from __future__ import annotations

import dataclasses

import gtsam
import numpy as np
import pycolmap
import pytest
from matrices import misfit
from rigs import made
from scipy.linalg import expm

from mitsuba_crb import se3
from mitsuba_crb.agents.bundle import (
    PointView,
    bundle_adjustment,
    joint_point_information,
    point_information,
)
from mitsuba_crb.agents.pose_graph import JointPoseInformation, PoseGraph
from mitsuba_crb.bound.cramer_rao import cramer_rao_bound
from mitsuba_crb.camera import Camera, Intrinsics
from mitsuba_crb.errors import FusionError, PointsError

CAMERA = Camera.pinhole(focal=(520.0, 480.0), centre=(310.0, 250.0), size=(640, 480))
SIGMA = 0.7
LENSES = {
    "PINHOLE": CAMERA,
    "FULL_OPENCV": Camera.of(
        Intrinsics(
            CAMERA.size, (520.0, 480.0), (310.0, 250.0), "opencv", (-0.25, 0.05, 1e-3, -2e-3, 0, 0.01, 0, 0)
        )
    ),
    "OPENCV_FISHEYE": Camera.of(
        Intrinsics(CAMERA.size, (520.0, 480.0), (310.0, 250.0), "fisheye", (-0.05, 0.01, -0.004, 5e-4))
    ),
}


def scene(rng, *, views=1, count=20, origin=0.0):
    """Points (n, 3) in the world and views that see all of them, each with covariances of its own."""
    world_from_scene = se3.exp(rng.normal(size=6))
    world_from_scene[:3, 3] += origin
    local = rng.uniform([-1.5, -1.0, 4.0], [1.5, 1.0, 9.0], size=(count, 3))
    points = local @ world_from_scene[:3, :3].T + world_from_scene[:3, 3]
    found = []
    for k in range(views):
        pose = world_from_scene @ se3.exp(rng.normal(size=6) * [0.5, 0.5, 0.5, 0.05, 0.05, 0.5])
        root = rng.normal(size=(count, 2, 2)) + 2.0 * np.eye(2)
        found.append(PointView(f"c{k}", pose, CAMERA, root @ root.swapaxes(1, 2)))
    return points, found


def reprojection_jacobian(points, view):
    """∂u/∂(ξ, X), (2n, 6 + 3n), by complex steps through the matrix exponential, no formula shared."""
    step = 1e-30
    n = len(points)
    jacobian = np.zeros((2 * n, 6 + 3 * n))
    for column in range(6 + 3 * n):
        direction = np.zeros(6 + 3 * n)
        direction[column] = 1.0
        generator = np.zeros((4, 4))
        generator[:3, :3] = se3.skew(direction[3:6])
        generator[:3, 3] = direction[:3]
        camera_from_world = expm(-1j * step * generator) @ np.linalg.inv(view.pose)
        moved = points + 1j * step * direction[6:].reshape(n, 3)
        p = moved @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
        (fx, fy), (cx, cy) = view.camera.focal, view.camera.centre
        image = np.stack([cx - fx * p[:, 0] / p[:, 2], cy - fy * p[:, 1] / p[:, 2]], axis=1)
        jacobian[:, column] = image.ravel().imag / step
    return jacobian


def weight(view):
    """The (2n, 2n) inverse covariance of all coordinates."""
    blocks = np.linalg.inv(view.noise)
    whole = np.zeros((2 * len(blocks), 2 * len(blocks)))
    for k, block in enumerate(blocks):
        whole[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = block
    return whole


class TestKnownPoints:
    @pytest.mark.parametrize("origin", [0.0, 1e4])
    def test_it_is_the_gauss_newton_hessian(self, origin):
        """To 1e-10; at ten kilometres the points themselves carry 12 digits."""
        points, (view,) = scene(np.random.default_rng(1), origin=origin)
        J = reprojection_jacobian(points, view)[:, :6]
        information = point_information(points, view)
        assert misfit(information.matrix, J.T @ weight(view) @ J) < (1e-10 if origin == 0.0 else 1e-9)
        assert not information.covariance_of_entries.any()
        assert (information.frame, information.variable) == ("camera", "c0")
        np.testing.assert_array_equal(information.pose, view.pose)
        # Negative control: the left perturbation's Hessian is another matrix.
        assert misfit(information.to_frame("world").matrix, J.T @ weight(view) @ J) > 0.1

    def test_one_sigma_many_and_covariances_agree(self):
        points, (view,) = scene(np.random.default_rng(2))
        count = len(points)
        forms = [SIGMA, np.full(count, SIGMA), np.broadcast_to(SIGMA**2 * np.eye(2), (count, 2, 2))]
        one, many, full = (
            point_information(points, dataclasses.replace(view, noise=noise)).matrix for noise in forms
        )
        np.testing.assert_allclose(many, one, rtol=1e-14)
        np.testing.assert_allclose(full, one, rtol=1e-12)

    def test_points_add(self):
        points, (view,) = scene(np.random.default_rng(3))
        parts = [
            point_information(points, dataclasses.replace(view, noise=np.asarray(view.noise)[s], seen=s))
            for s in (np.arange(8), np.arange(8, 20))
        ]
        assert misfit((parts[0] + parts[1]).matrix, point_information(points, view).matrix) < 1e-13

    def test_points_on_a_line_leave_the_turn_about_it_unseen(self):
        line = np.array([0.3, -0.2, 5.0]) + np.outer(np.linspace(-1.0, 1.0, 9), [0.4, 0.9, 0.3])
        bound = cramer_rao_bound(point_information(line, PointView("c", np.eye(4), CAMERA, SIGMA)))
        assert bound.rank == 5
        spread = np.vstack([line, [1.0, 0.0, 6.0]])
        assert cramer_rao_bound(point_information(spread, PointView("c", np.eye(4), CAMERA, SIGMA))).rank == 6

    @pytest.mark.parametrize("model", LENSES)
    def test_pycolmap_s_covariance(self, model):
        """Found to 1e-13; 1e-9 leaves room for where its refinement stops."""
        points, (view,) = scene(np.random.default_rng(4), count=40)
        view = dataclasses.replace(view, camera=LENSES[model])
        lens = LENSES[model].distortion
        k = () if lens is None else lens.coefficients
        camera = pycolmap.Camera(
            model=model, width=640, height=480, params=[*CAMERA.focal, *CAMERA.centre, *k]
        )
        p = (points - view.pose[:3, 3]) @ view.pose[:3, :3]
        found = pycolmap.estimate_and_refine_absolute_pose(
            view.camera.project(p), points, camera, return_covariance=True
        )
        assert found["num_inliers"] == len(points)
        np.testing.assert_allclose(
            se3.pose_from_colmap(np.vstack([found["cam_from_world"].matrix(), [0, 0, 0, 1]])),
            view.pose,
            atol=1e-8,
        )
        unit = point_information(points, dataclasses.replace(view, noise=1.0))
        ours = se3.move_covariance(np.linalg.inv(unit.matrix), se3.colmap_from_camera(view.pose))
        assert misfit(found["covariance"], ours) < 1e-9
        # Negative control: without the half of COLMAP's quaternion tangent.
        assert misfit(found["covariance"], np.linalg.inv(unit.matrix)) > 0.1

    def test_gtsam_s_marginals(self):
        points, (view,) = scene(np.random.default_rng(5))
        graph, values = gtsam_graph(points, [view], points_known=True)
        theirs = gtsam.Marginals(graph, values).marginalCovariance(0)
        ours = np.linalg.inv(point_information(points, view).matrix)
        assert misfit(theirs, se3.move_covariance(ours, se3.gtsam_from_camera())) < 1e-9
        assert misfit(theirs, ours) > 0.1


def gtsam_graph(points, views, *, points_known, priors=()):
    """The same problem in GTSAM: poses are 0, 1, .., points 1000, 1001, .."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    calibration = gtsam.Cal3_S2(*CAMERA.focal, 0.0, *CAMERA.centre)
    for j, point in enumerate(points):
        values.insert(1000 + j, gtsam.Point3(*point))
        if points_known:
            graph.add(gtsam.NonlinearEqualityPoint3(1000 + j, gtsam.Point3(*point)))
    for k, view in enumerate(views):
        values.insert(k, gtsam.Pose3(se3.pose_to_gtsam(view.pose)))
        seen = range(len(points)) if view.seen is None else view.seen
        p = (points - view.pose[:3, 3]) @ view.pose[:3, :3]
        image = CAMERA.project(p)
        for j, covariance in zip(seen, view.noise, strict=True):
            graph.add(
                gtsam.GenericProjectionFactorCal3_S2(
                    image[j], gtsam.noiseModel.Gaussian.Covariance(covariance), k, 1000 + j, calibration
                )
            )
    for k, information in priors:
        moved = se3.move_information(information, se3.gtsam_from_camera())
        noise = gtsam.noiseModel.Gaussian.Information(moved)
        graph.add(gtsam.PriorFactorPose3(k, values.atPose3(k), noise))
    return graph, values


class TestUnknownPoints:
    def _two_of_three(self, seed):
        """Three cameras; every camera misses some points, two points are seen once."""
        rng = np.random.default_rng(seed)
        points, views = scene(rng, views=3, count=24)
        seen = [np.arange(0, 18), np.arange(5, 23), np.r_[0:9, 14:24]]
        return points, [
            dataclasses.replace(view, seen=s, noise=np.asarray(view.noise)[s])
            for view, s in zip(views, seen, strict=True)
        ]

    def _rows(self, points, views):
        """The whole whitened Jacobian of poses and points, by complex steps."""
        size = 6 * len(views)
        rows = []
        for k, view in enumerate(views):
            J = np.zeros((2 * len(view.seen), size + 3 * len(points)))
            local = reprojection_jacobian(points[view.seen], view)
            J[:, 6 * k : 6 * k + 6] = local[:, :6]
            columns = size + (3 * view.seen[:, None] + np.arange(3)).ravel()
            J[:, columns] = local[:, 6:]
            rows.append(np.linalg.cholesky(weight(view)).T @ J)
        return np.vstack(rows)

    def test_it_is_the_schur_complement_of_the_gauss_newton_hessian(self):
        """The reference marginalises all points at once, by least squares on the rows: HᵀH loses digits."""
        points, views = self._two_of_three(6)
        rows = self._rows(points, views)
        poses, all_points = rows[:, :18], rows[:, 18:]
        rest = poses - all_points @ np.linalg.lstsq(all_points, poses, rcond=1e-10)[0]
        expected = rest.T @ rest
        found = joint_point_information(points, views)
        assert found.variables == ("c0", "c1", "c2")
        assert misfit(found.matrix, expected) < 1e-10
        assert misfit(found.matrix, poses.T @ poses) > 0.1

    def test_gtsam_s_marginals_with_what_is_known_of_two_poses(self):
        """Two priors remove the gauge, scale included; joint covariances with their cross terms."""
        points, views = self._two_of_three(7)
        # Seen once, a point is no variable that GTSAM can solve for.
        once = np.bincount(np.concatenate([view.seen for view in views]), minlength=len(points)) < 2
        views = [
            dataclasses.replace(v, seen=v.seen[~once[v.seen]], noise=np.asarray(v.noise)[~once[v.seen]])
            for v in views
        ]
        known = np.diag([4e2, 5e2, 3e2, 1e4, 2e4, 3e4])
        graph, values = gtsam_graph(points, views, points_known=False, priors=[(0, known), (1, known)])
        for j in np.flatnonzero(once):
            values.erase(1000 + j)
        marginals = gtsam.Marginals(graph, values)
        keys = gtsam.KeyVector([0, 1, 2])
        theirs = marginals.jointMarginalCovariance(keys)
        images = [
            made(known if k < 2 else np.zeros((6, 6)), variable=v.variable, pose=v.pose)
            for k, v in enumerate(views)
        ]
        ours = PoseGraph(images, joint=[joint_point_information(points, views)])
        A = np.kron(np.eye(3), se3.gtsam_from_camera())
        whole = A @ np.linalg.inv(ours.matrix.toarray()) @ A.T
        assert misfit(np.block([[theirs.at(a, b) for b in keys] for a in keys]), whole) < 1e-6
        for k, view in enumerate(views):
            covariance = np.linalg.inv(ours.marginal(view.variable).matrix)
            moved = se3.move_covariance(covariance, se3.gtsam_from_camera())
            assert misfit(marginals.marginalCovariance(k), moved) < 1e-6

    def test_seven_directions_are_free_and_six_once_a_camera_is_fixed(self):
        points, views = self._two_of_three(8)
        graph = bundle_adjustment(points, views)
        assert [(g.free, g.common) for g in graph.gauges] == [(7, 6)]
        assert graph.matrix.shape == (18, 18)
        anchored = graph.fixed("c0")
        assert [g.free for g in anchored.gauges] == [1]
        assert cramer_rao_bound(anchored.marginal("c1")).rank == 5
        assert cramer_rao_bound(graph.relative("c0", "c1")).rank == 5

    def test_unknown_points_tell_less_than_known_ones_and_many_cameras_more(self):
        points, views = self._two_of_three(9)
        known = [point_information(points, view) for view in views]
        alone = np.linalg.eigvalsh(known[0].matrix)[-1]
        joint = bundle_adjustment(points, views)
        for view, information in zip(views, known, strict=True):
            lost = information.matrix - joint.conditional(view.variable).matrix
            assert np.linalg.eigvalsh(lost)[0] > -1e-10 * alone
        pair = bundle_adjustment(points, views[:2]).fixed("c0").marginal("c1").matrix
        three = joint.fixed("c0").marginal("c1").matrix
        assert np.linalg.eigvalsh(three - pair)[0] > -1e-9 * np.linalg.eigvalsh(three)[-1]

    def test_one_camera_learns_nothing_from_unknown_points(self):
        points, views = self._two_of_three(10)
        assert not joint_point_information(points, views[:1]).matrix.any()
        assert cramer_rao_bound(bundle_adjustment(points, views[:1]).marginal("c0")).rank == 0


class TestBadInput:
    def _view(self, **changes):
        return dataclasses.replace(PointView("left", np.eye(4), CAMERA, SIGMA), **changes)

    @pytest.mark.parametrize(
        ("points", "changes", "message"),
        [
            (np.ones((2, 3)), {}, "sees 2 points, and a pose needs at least 3"),
            (np.ones((4, 2)), {}, r"shape \(n, 3\), not of shape \(4, 2\)"),
            (np.full((4, 3), np.nan), {}, "finite"),
            (
                np.ones((4, 3)) * [1, 1, -1],
                {},
                "4 of 4 points are behind camera 'left'.* number 0",
            ),
            (np.ones((4, 3)), {"noise": 0.0}, "sigma.* must be positive and finite, not 0.0"),
            (np.ones((4, 3)), {"noise": [1.0, -2.0, 1.0, 1.0]}, "not -2.0"),
            (np.ones((4, 3)), {"noise": np.nan}, "not nan"),
            (np.ones((4, 3)), {"noise": np.ones(3)}, r"4 of them.* not of shape \(3,\)"),
            (np.ones((4, 3)), {"noise": np.ones((4, 2, 2))}, "positive definite"),
            (np.ones((4, 3)), {"seen": np.array([0, 1, 1])}, "different points, from 0 to 3"),
            (np.ones((4, 3)), {"seen": np.array([0, 1, 4])}, "different points, from 0 to 3"),
            (np.ones((4, 3)), {"seen": np.array([0.0, 1.0, 2.0])}, "whole numbers"),
        ],
    )
    def test_one_line_that_names_it(self, points, changes, message):
        with pytest.raises(PointsError, match=message) as caught:
            point_information(points, self._view(**changes))
        assert "\n" not in str(caught.value)

    def test_cameras_and_joint_matrices(self):
        points = np.random.default_rng(0).uniform(1.0, 2.0, size=(5, 3))
        with pytest.raises(FusionError, match="different variables"):
            joint_point_information(points, [self._view(), self._view()])
        with pytest.raises(FusionError, match="different variables, not \\[\\]"):
            joint_point_information(points, [])
        with pytest.raises(FusionError, match="12 x 12 matrix"):
            JointPoseInformation(("a", "b"), np.eye(6))
        with pytest.raises(FusionError, match="no pose is called 'b'"):
            PoseGraph([made(np.eye(6), variable="a")], joint=[JointPoseInformation(("a", "b"), np.eye(12))])
