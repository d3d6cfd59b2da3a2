"""Exported covariances in the other tools' own coordinates: by their readers, by derivatives, by simulation.

Every format is asked twice. The tool's coordinates of a pose that our twist has moved, differentiated, give
the covariance that its file must hold, to 1e-9; none of the exporter's matrices is used. And poses drawn with
our covariance scatter so in the tool's coordinates. Negative controls: other sides, orders, units.
"""

from __future__ import annotations

import csv
import dataclasses
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pycolmap
import pytest
import rerun
import yaml
from matrices import misfit
from numpy.typing import NDArray
from PIL import Image
from rigs import made, random_pose
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from mitsuba_crb import se3
from mitsuba_crb.agents.bundle import PointView, point_information
from mitsuba_crb.bound.cramer_rao import PoseBound, cramer_rao_bound
from mitsuba_crb.camera import Camera, Intrinsics
from mitsuba_crb.datasets.poses import load_poses
from mitsuba_crb.datasets.rows import rows_of
from mitsuba_crb.errors import DocumentError, OptionError, OutputError
from mitsuba_crb.export.documents import bound_document, write_json
from mitsuba_crb.export.formats import FORMATS, export_result

Array = NDArray[np.float64]
Coordinates = Callable[[Array], Array]
"""Of world_from_camera in our axes."""

OPENCV = np.diag([-1.0, -1.0, 1.0, 1.0])
UPPER = np.triu_indices(6)
CAMERA = Intrinsics((640, 480), (525.0, 520.0), (315.0, 242.0))


def bound_at(pose: Array, *, seed: int = 0, unseen: int = 0) -> PoseBound:
    """Correlated, rotation and translation of different sizes; of less rank, the last directions unseen."""
    rng = np.random.default_rng(seed)
    basis, _ = np.linalg.qr(rng.normal(size=(6, 6)))
    values = np.array([9.0, 6.0, 4.0, 3.0, 2.0, 1.0]) * 1e8
    values[6 - unseen :] = 0.0
    scale = np.array([2.0] * 3 + [1.0] * 3)
    F = (basis * values) @ basis.T / np.outer(scale, scale)
    bound = cramer_rao_bound(made(F, pose=pose))
    camera = CAMERA.to_dict()
    facts = {"scene": "boxes.xml", "sensor": "left eye", "camera": camera, "size": list(CAMERA.size)}
    return dataclasses.replace(bound, provenance=facts)


@pytest.fixture
def pose() -> Array:
    return random_pose(np.random.default_rng(3), origin=5.0)


def written(folder: Path, *bounds: PoseBound, names: tuple[str, ...] = ()) -> Path:
    """One JSON document, or lines with names."""
    path = folder / "result.json"
    if not names:
        write_json(path, bound_document(bounds[0]))
        return path
    lines = [
        json.dumps({"index": k, "name": name, **bound_document(bound)})
        for k, (name, bound) in enumerate(zip(names, bounds, strict=True))
    ]
    path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
    return path


def slope(coordinates: Coordinates, pose: Array, step: float = 2e-3) -> Array:
    """∂y/∂ξ (6, 6) of our camera-frame twist, by differences of fourth order."""

    def along(twist: Array) -> Array:
        first, second = (
            coordinates(pose @ se3.exp(h * twist)) - coordinates(pose @ se3.exp(-h * twist))
            for h in (step, 2.0 * step)
        )
        return np.asarray((8.0 * first - second) / (12.0 * step))

    return np.stack([along(twist) for twist in np.eye(6)], axis=1)


def scatter(coordinates: Coordinates, pose: Array, covariance: Array) -> Array:
    """The sample covariance of y over poses drawn so that ours, of ξ, has exactly this one."""
    draws = np.random.default_rng(11).normal(size=(60, 6))
    draws -= draws.mean(axis=0)
    twists = draws @ np.linalg.inv(np.linalg.cholesky(np.cov(draws.T))).T @ np.linalg.cholesky(covariance).T
    y = np.array([coordinates(moved) for moved in pose @ se3.exp(twists)])
    return np.asarray(np.cov(y.T))


CURVED = 1e-3
"""Largest misfit of a sample covariance: coordinates are not straight over deviations of 1e-4."""


def agree(found: Array, coordinates: Coordinates, bound: PoseBound) -> None:
    """Both oracles accept, and both refuse other orders, sides and units."""
    pose, C = bound.information.pose, bound.covariance
    A = slope(coordinates, pose)
    expected, drawn = A @ C @ A.T, scatter(coordinates, pose, C)
    assert misfit(found, expected) < 1e-9
    assert misfit(found, drawn) < CURVED
    swapped = [3, 4, 5, 0, 1, 2]
    left = A @ bound.to_frame("world").covariance @ A.T
    halved = np.diag([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])
    for wrong in (found[np.ix_(swapped, swapped)], left, halved @ found @ halved):
        assert misfit(wrong, expected) > 0.1
        assert misfit(wrong, drawn) > 0.1


def gtsam_coordinates(mean: Array) -> Coordinates:
    at = gtsam.Pose3(mean @ OPENCV)
    return lambda pose: np.asarray(at.localCoordinates(gtsam.Pose3(pose @ OPENCV)))


def g2o_coordinates(mean: Array) -> Coordinates:
    """EdgeSE3's error: translation, and the vector part of the quaternion with w > 0."""

    def error(pose: Array) -> Array:
        delta = np.linalg.inv(mean @ OPENCV) @ pose @ OPENCV
        quaternion = Rotation.from_matrix(delta[:3, :3]).as_quat(canonical=True)
        return np.concatenate([delta[:3, 3], quaternion[:3]])

    return error


def colmap_coordinates(mean: Array) -> Coordinates:
    """δ of q' = (√(1 − δ²), δ) q, and t' − t, of cam_from_world."""
    before = np.linalg.inv(mean @ OPENCV)

    def tangent(pose: Array) -> Array:
        after = np.linalg.inv(pose @ OPENCV)
        turn = Rotation.from_matrix(after[:3, :3]) * Rotation.from_matrix(before[:3, :3]).inv()
        return np.concatenate([turn.as_quat(canonical=True)[:3], after[:3, 3] - before[:3, 3]])

    return tangent


def fixed_axes(mean: Array, camera_from_body: Array = OPENCV) -> Coordinates:
    """The body's origin and its rotation vector about the world's axes."""
    before = mean @ camera_from_body

    def moved(pose: Array) -> Array:
        after = pose @ camera_from_body
        turn = Rotation.from_matrix(after[:3, :3] @ before[:3, :3].T)
        return np.concatenate([after[:3, 3] - before[:3, 3], turn.as_rotvec()])

    return moved


def symmetric(upper: Any) -> Array:
    matrix = np.zeros((6, 6))
    matrix[UPPER] = [float(value) for value in upper]
    return np.asarray(matrix + np.triu(matrix, 1).T)


def edges(path: Path) -> list[list[str]]:
    """The words of a graph's edges."""
    lines = path.read_text(encoding="utf-8").splitlines()
    return [line.split() for line in lines if line.startswith("EDGE_SE3:QUAT")]


class TestGTSAM:
    def test_reads_the_pose_and_its_covariance(self, pose: Array, tmp_path: Path) -> None:
        bound = bound_at(pose)
        done = export_result(written(tmp_path, bound), "gtsam")
        graph, values = gtsam.readG2o(str(done.path), True)
        np.testing.assert_allclose(values.atPose3(1).matrix(), pose @ OPENCV, atol=1e-12)
        factor = graph.at(0)
        agree(np.linalg.inv(factor.noiseModel().information()), gtsam_coordinates(pose), bound)

    def test_s_marginals_and_errors_are_the_bound_s(self, pose: Array, tmp_path: Path) -> None:
        bound = bound_at(pose)
        done = export_result(written(tmp_path, bound), "gtsam")
        graph, values = gtsam.readG2o(str(done.path), True)
        graph.add(gtsam.NonlinearEqualityPose3(0, gtsam.Pose3()))
        theirs = gtsam.Marginals(graph, values).marginalCovariance(1)
        A = slope(gtsam_coordinates(pose), pose)
        assert misfit(theirs, A @ bound.covariance @ A.T) < 1e-9
        twist = 1e-5 * np.random.default_rng(2).normal(size=6)
        values.update(1, gtsam.Pose3(pose @ se3.exp(twist) @ OPENCV))
        information = bound.information.matrix
        assert 2.0 * graph.error(values) == pytest.approx(twist @ information @ twist, rel=1e-8)

    def test_s_reader_wants_a_file_of_its_own(self, pose: Array, tmp_path: Path) -> None:
        bound = bound_at(pose)
        done = export_result(written(tmp_path, bound), "g2o")
        graph, _ = gtsam.readG2o(str(done.path), True)
        A = slope(gtsam_coordinates(pose), pose)
        found = np.linalg.inv(graph.at(0).noiseModel().information())
        assert misfit(found, A @ bound.covariance @ A.T) == pytest.approx(0.75, abs=1e-6)

    def test_is_given_nothing_that_it_would_read_wrongly(self, pose: Array, tmp_path: Path) -> None:
        result = written(tmp_path, bound_at(pose, unseen=1))
        with pytest.raises(OutputError, match=r"no singular information, and left eye has .*--to g2o or npz"):
            export_result(result, "gtsam")
        assert not (tmp_path / "result.gtsam.g2o").exists()


class TestG2O:
    def test_has_half_angles(self, pose: Array, tmp_path: Path) -> None:
        bound = bound_at(pose)
        done = export_result(written(tmp_path, bound), "g2o")
        (edge,) = edges(done.path)
        numbers = np.array(edge[3:10], dtype=np.float64)
        np.testing.assert_allclose(se3.pose_from_vector(numbers), pose @ OPENCV, atol=1e-12)
        agree(np.linalg.inv(symmetric(edge[10:])), g2o_coordinates(pose), bound)

    def test_has_no_information_about_what_is_unseen(self, pose: Array, tmp_path: Path) -> None:
        bound = bound_at(pose, unseen=2)
        assert bound.rank == 4
        done = export_result(written(tmp_path, bound), "g2o")
        assert len(done.notes) == 1
        assert "no information about" in done.notes[0]
        F = symmetric(edges(done.path)[0][10:])
        values = np.linalg.eigvalsh(F)
        assert (np.abs(values[:2]) < 1e-12 * values[-1]).all()
        A = slope(g2o_coordinates(pose), pose)
        assert misfit(A.T @ F @ A, bound.information.matrix) < 1e-9

    def test_has_all_poses(self, tmp_path: Path) -> None:
        rng = np.random.default_rng(5)
        bounds = [bound_at(random_pose(rng), seed=k) for k in range(3)]
        done = export_result(written(tmp_path, *bounds, names=("a", "b", "c d")), "g2o")
        assert done.count == 3
        for k, (bound, edge) in enumerate(zip(bounds, edges(done.path), strict=True), 1):
            assert edge[1:3] == ["0", str(k)]
            A = slope(g2o_coordinates(bound.information.pose), bound.information.pose)
            assert misfit(np.linalg.inv(symmetric(edge[10:])), A @ bound.covariance @ A.T) < 1e-9


class TestCOLMAP:
    def test_reads_the_model(self, tmp_path: Path) -> None:
        rng = np.random.default_rng(6)
        poses = [random_pose(rng) for _ in range(2)]
        lens = Intrinsics(
            (640, 480), (525.0, 520.0), (315.0, 242.0), "opencv", (0.1, -0.02, 1e-3, 0, 0, 0, 0, 0)
        )
        bounds = [bound_at(pose) for pose in poses]
        bounds[1] = dataclasses.replace(
            bounds[1], provenance=bounds[1].provenance | {"camera": lens.to_dict()}
        )
        done = export_result(written(tmp_path, *bounds, names=("a.png", "b c.png")), "colmap")
        model = pycolmap.Reconstruction(str(done.path))
        images = {image.name: image for image in model.images.values()}
        assert set(images) == {"a.png", "b_c.png"}
        for pose, name in zip(poses, sorted(images), strict=True):
            matrix = np.vstack([images[name].cam_from_world().matrix(), [0, 0, 0, 1]])
            np.testing.assert_allclose(se3.pose_from_colmap(matrix), pose, atol=1e-12)
        cameras = [images[name].camera for name in sorted(images)]
        assert [camera.model.name for camera in cameras] == ["PINHOLE", "OPENCV"]
        np.testing.assert_array_equal(cameras[0].params, [525.0, 520.0, 315.0, 242.0])
        np.testing.assert_array_equal(cameras[1].params[4:], [0.1, -0.02, 1e-3, 0.0])
        read = load_poses(done.path)
        np.testing.assert_allclose(read.poses, poses, atol=1e-12)

    def test_covariance_is_of_its_tangent(self, pose: Array, tmp_path: Path) -> None:
        bound = bound_at(pose)
        done = export_result(written(tmp_path, bound), "colmap")
        (row,) = rows_of((done.path / "covariances.txt").read_text(encoding="utf-8")).rows
        assert row[1][:2] == ["1", "left_eye"]
        agree(symmetric(row[1][2:]), colmap_coordinates(pose), bound)

    def test_covariance_is_that_which_pycolmap_estimates(self, tmp_path: Path) -> None:
        rng = np.random.default_rng(4)
        pose = random_pose(rng)
        camera = Camera.of(CAMERA)
        seen = rng.uniform([-2.0, -1.5, 4.0], [2.0, 1.5, 8.0], size=(40, 3))
        points = seen @ pose[:3, :3].T + pose[:3, 3]
        bound = cramer_rao_bound(point_information(points, PointView("left eye", pose, camera, 1.0)))
        facts = {"sensor": "left eye", "camera": CAMERA.to_dict(), "size": [640, 480]}
        done = export_result(written(tmp_path, dataclasses.replace(bound, provenance=facts)), "colmap")
        (row,) = rows_of((done.path / "covariances.txt").read_text(encoding="utf-8")).rows
        theirs = pycolmap.Camera(
            model="PINHOLE", width=640, height=480, params=[*CAMERA.focal, *CAMERA.centre]
        )
        found = pycolmap.estimate_and_refine_absolute_pose(
            camera.project(seen), points, theirs, return_covariance=True
        )
        assert misfit(symmetric(row[1][2:]), found["covariance"]) < 1e-9

    def test_model_that_is_there_stays(self, pose: Array, tmp_path: Path) -> None:
        result = written(tmp_path, bound_at(pose))
        folder = tmp_path / "model"
        folder.mkdir()
        (folder / "images.txt").write_text("mine")
        with pytest.raises(OutputError, match=r"images\.txt already"):
            export_result(result, "colmap", folder)
        assert [file.name for file in folder.iterdir()] == ["images.txt"]


class TestROS:
    @staticmethod
    def messages(path: Path) -> list[Any]:
        """By a reader of messages, from the bytes that a node would be sent."""
        store = get_typestore(Stores.ROS2_HUMBLE)
        kinds = store.types
        found = []
        for document in yaml.safe_load_all(path.read_text(encoding="utf-8")):
            header, pose = document["header"], document["pose"]["pose"]
            message = kinds["geometry_msgs/msg/PoseWithCovarianceStamped"](
                kinds["std_msgs/msg/Header"](
                    kinds["builtin_interfaces/msg/Time"](**header["stamp"]), header["frame_id"]
                ),
                kinds["geometry_msgs/msg/PoseWithCovariance"](
                    kinds["geometry_msgs/msg/Pose"](
                        kinds["geometry_msgs/msg/Point"](**pose["position"]),
                        kinds["geometry_msgs/msg/Quaternion"](**pose["orientation"]),
                    ),
                    np.array(document["pose"]["covariance"]),
                ),
            )
            sent = store.serialize_cdr(message, message.__msgtype__)
            found.append(store.deserialize_cdr(sent, message.__msgtype__))
        return found

    def test_reads_the_messages(self, tmp_path: Path) -> None:
        rng = np.random.default_rng(7)
        bounds = [bound_at(random_pose(rng, origin=4.0), seed=k) for k in range(2)]
        result = written(tmp_path, *bounds, names=("1305031102.175304", "1403636579763555584"))
        first, second = self.messages(export_result(result, "ros").path)
        assert (first.header.stamp.sec, first.header.stamp.nanosec) == (1305031102, 175304000)
        assert (second.header.stamp.sec, second.header.stamp.nanosec) == (1403636579, 763555584)
        for message, bound in zip((first, second), bounds, strict=True):
            place, turn = message.pose.pose.position, message.pose.pose.orientation
            numbers = [place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w]
            mean = bound.information.pose
            np.testing.assert_allclose(se3.pose_from_vector(numbers), mean @ OPENCV, atol=1e-12)
            agree(message.pose.covariance.reshape(6, 6), fixed_axes(mean), bound)

    def test_has_the_body_that_carries_the_camera(self, pose: Array, tmp_path: Path) -> None:
        body_from_camera = random_pose(np.random.default_rng(8))  # from OpenCV's axes, as calibrations say
        bound = bound_at(pose)
        done = export_result(written(tmp_path, bound), "ros", body_from_camera=body_from_camera)
        (message,) = self.messages(done.path)
        camera_from_body = OPENCV @ np.linalg.inv(body_from_camera)
        place = message.pose.pose.position
        np.testing.assert_allclose([place.x, place.y, place.z], (pose @ camera_from_body)[:3, 3], atol=1e-12)
        agree(message.pose.covariance.reshape(6, 6), fixed_axes(pose, camera_from_body), bound)
        # Negative control: without the lever arm.
        A = slope(fixed_axes(pose), pose)
        assert misfit(message.pose.covariance.reshape(6, 6), A @ bound.covariance @ A.T) > 0.1

    def test_has_no_infinity(self, pose: Array, tmp_path: Path) -> None:
        with pytest.raises(OutputError, match="ROS has no infinite variances"):
            export_result(written(tmp_path, bound_at(pose, unseen=1)), "ros")


class TestTUM:
    def test_has_21_numbers_a_line(self, tmp_path: Path) -> None:
        rng = np.random.default_rng(9)
        bounds = [bound_at(random_pose(rng, origin=4.0), seed=k) for k in range(2)]
        done = export_result(written(tmp_path, *bounds, names=("1.5", "2.25")), "tum")
        read = load_poses(done.path)
        assert read.names == ("1.5", "2.25")
        assert (read.format, len(np.loadtxt(done.path)[0])) == ("TUM", 29)
        for pose, row, bound in zip(read.poses, np.loadtxt(done.path), bounds, strict=True):
            mean = bound.information.pose
            np.testing.assert_allclose(pose, mean, atol=1e-12)
            agree(symmetric(row[8:]), fixed_axes(mean), bound)

    def test_has_informations_where_something_is_unseen(self, pose: Array, tmp_path: Path) -> None:
        bounds = [bound_at(pose), bound_at(pose, unseen=1)]
        done = export_result(written(tmp_path, *bounds, names=("a", "b")), "tum")
        assert "informations" in done.notes[0]
        assert " f11 f12 " in done.path.read_text(encoding="utf-8")
        A = slope(fixed_axes(pose), pose)
        for row, bound in zip(np.loadtxt(done.path), bounds, strict=True):
            assert misfit(A.T @ symmetric(row[8:]) @ A, bound.information.matrix) < 1e-9


class TestTables:
    def test_are_the_bound_to_the_last_bit(self, pose: Array, tmp_path: Path) -> None:
        """In our axes."""
        bound = bound_at(pose, unseen=1)
        result = written(tmp_path, bound)
        arrays = np.load(export_result(result, "npz").path)
        np.testing.assert_array_equal(arrays["covariances"][0], bound.covariance)
        np.testing.assert_allclose(arrays["poses"][0], pose, rtol=1e-15)
        assert misfit(arrays["informations"][0], bound.information.matrix) < 1e-12
        assert [str(arrays[name]) for name in ("side", "axes")] == [
            "right: world_from_body exp(xi)",
            "the camera, x left, y up, z forward (Mitsuba's)",
        ]
        with export_result(result, "csv").path.open(encoding="utf-8") as file:
            (row,) = csv.DictReader(file)
        found = symmetric([value for name, value in row.items() if name.startswith("cov_")])
        np.testing.assert_array_equal(np.diagonal(found), np.diagonal(bound.covariance))
        np.testing.assert_array_equal(found[UPPER], bound.covariance[UPPER])
        assert "(Mitsuba's)" in row["convention"]

    def test_have_infinities_where_a_coordinate_moves_along_what_is_unseen(self, tmp_path: Path) -> None:
        """Only translation along the world's z is unseen; a body in other axes keeps its rotation."""
        pose = random_pose(np.random.default_rng(1))
        direction = np.concatenate([pose[:3, :3].T @ [0.0, 0.0, 1.0], np.zeros(3)])
        F = 1e8 * (np.eye(6) - np.outer(direction, direction))
        bound = dataclasses.replace(cramer_rao_bound(made(F, pose=pose)), provenance={"sensor": "a"})
        body = random_pose(np.random.default_rng(2))
        arrays = np.load(export_result(written(tmp_path, bound), "npz", body_from_camera=body).path)
        deviations = np.diagonal(arrays["covariances"][0])
        assert np.isinf(deviations[:3]).all()
        np.testing.assert_allclose(deviations[3:], 1e-8, rtol=1e-9)
        seen = np.linalg.eigvalsh(arrays["informations"][0])
        assert abs(seen[0]) < 1e-9 * seen[-1] < seen[1]

    def test_of_a_world_frame_result_are_in_the_camera_s(self, pose: Array, tmp_path: Path) -> None:
        for unseen in (0, 2):
            bound = bound_at(pose, unseen=unseen)
            own = np.load(export_result(written(tmp_path, bound), "npz", tmp_path / "a.npz").path)
            world = written(tmp_path, bound.to_frame("world"))
            moved = np.load(export_result(world, "npz", tmp_path / "b.npz").path)
            assert misfit(moved["informations"][0], own["informations"][0]) < 1e-9
            finite = np.isfinite(own["covariances"][0]) & np.isfinite(moved["covariances"][0])
            scale = np.sqrt(np.diagonal(np.linalg.pinv(own["informations"][0])))
            theirs, ours = (np.where(finite, each["covariances"][0], 0.0) for each in (moved, own))
            difference = np.abs(theirs - ours) / np.outer(scale, scale)
            assert finite.any() == (unseen == 0)
            assert np.max(difference[finite], initial=0.0) < 1e-9


class TestAxes:
    @pytest.mark.parametrize(
        ("axes", "camera_from_body"),
        [("mitsuba", np.eye(4)), ("opencv", OPENCV), ("opengl", np.diag([-1.0, 1.0, -1.0, 1.0]))],
    )
    def test_turn_pose_and_covariance(
        self, axes: Any, camera_from_body: Array, pose: Array, tmp_path: Path
    ) -> None:
        bound = bound_at(pose)
        done = export_result(written(tmp_path, bound), "tum", axes=axes)
        row = np.loadtxt(done.path)
        np.testing.assert_allclose(se3.pose_from_vector(row[1:8]), pose @ camera_from_body, atol=1e-12)
        agree(symmetric(row[8:]), fixed_axes(pose, camera_from_body), bound)
        np.testing.assert_allclose(load_poses(done.path, axes).poses[0], pose, atol=1e-12)

    @pytest.mark.parametrize("to", ["colmap", "rerun"])
    def test_of_a_format_are_its_own(self, to: Any, pose: Array, tmp_path: Path) -> None:
        result = written(tmp_path, bound_at(pose))
        with pytest.raises(OptionError, match="leave out --axes"):
            export_result(result, to, axes="opengl")
        with pytest.raises(OptionError, match="leave out --body-from-camera"):
            export_result(result, to, body_from_camera=np.eye(4))


class TestResults:
    def test_are_not_replaced_unasked(self, pose: Array, tmp_path: Path) -> None:
        result = written(tmp_path, bound_at(pose))
        for to, form in FORMATS.items():
            target = tmp_path / f"result{form.ending}"
            target.write_text("mine")
            with pytest.raises(OutputError, match="is there already"):
                export_result(result, to)  # type: ignore[arg-type]
            assert target.read_text() == "mine"
        before = result.read_bytes()
        with pytest.raises(OutputError, match="overwrite an input"):
            export_result(result, "g2o", result)
        assert result.read_bytes() == before

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            ({"schema": "mitsuba-crb/bound/9"}, "of another version.*write it again"),
            ({"schema": "mitsuba-crb/validate/2"}, "errors of an estimator"),
            ({"schema": "mitsuba-crb/select/1"}, "tiles, not a pose's covariance"),
            ({"schema": "mitsuba-crb/map/1"}, "is of map, and has no poses with covariances"),
            ({"schema": 7}, "no result of mitsuba-crb"),
            ({"covariance": [[1.0]]}, r"damaged: an array has the shape \(1, 1\)"),
            ({"information": [["inf"] * 6] * 6}, "damaged: a matrix has entries that are no numbers"),
            ({"information": np.diag([1e308] * 6).tolist()}, "or absurd ones"),
            ({"covariance": (np.eye(6) + np.eye(6, k=1)).tolist()}, "damaged: a matrix is not symmetric"),
            ({"covariance": [["inf"] * 6] * 6}, "damaged: a matrix has entries"),  # nothing is unseen
            ({"pose": "here"}, "damaged"),
            ({"frame": "moon"}, "the frame 'moon'"),
            ({"unobserved": [{"direction": [1, 2]}]}, "damaged"),
            (
                {"unobserved": [{"direction": [3] * 6, "description": "a", "verdict": "unseen"}]},
                "no orthonormal ones",
            ),
            ({"length_scale": None}, "damaged"),
            ({"length_scale": 0.0}, "the length scale is 0.0"),
        ],
    )
    def test_that_are_damaged_or_of_another_kind_are_refused(
        self, change: dict[str, Any], words: str, pose: Array, tmp_path: Path
    ) -> None:
        path = written(tmp_path, bound_at(pose))
        document = json.loads(path.read_text(encoding="utf-8"))
        path.write_text(json.dumps(document | change), encoding="utf-8")
        with pytest.raises(DocumentError, match=words):
            export_result(path, "csv")

    def test_without_a_key_or_cut_short_are_refused(self, pose: Array, tmp_path: Path) -> None:
        path = written(tmp_path, bound_at(pose))
        text = path.read_text(encoding="utf-8")
        document = json.loads(text)
        for key in ("pose", "frame", "covariance", "information", "unobserved", "length_scale"):
            path.write_text(json.dumps({name: value for name, value in document.items() if name != key}))
            with pytest.raises(DocumentError, match=f"damaged: it has no '{key}'"):
                export_result(path, "csv")
        for count in (0, 1, len(text) // 2):
            path.write_text(text[:count], encoding="utf-8")
            with pytest.raises(DocumentError, match="no JSON"):
                export_result(path, "csv")
        with pytest.raises(DocumentError, match="cannot read"):
            export_result(tmp_path / "none.json", "csv")

    def test_of_an_interrupted_run_are_those_that_are_whole(self, pose: Array, tmp_path: Path) -> None:
        path = written(tmp_path, bound_at(pose), bound_at(pose), names=("a", "b"))
        text = path.read_text(encoding="utf-8")
        path.write_text(text[:-20], encoding="utf-8")
        assert export_result(path, "csv").count == 1
        path.write_text(text[:40], encoding="utf-8")
        with pytest.raises(DocumentError, match="no whole line"):
            export_result(path, "npz")

    def test_misspecified_covariance_takes_the_ideal_one_s_place(self, pose: Array, tmp_path: Path) -> None:
        bound = bound_at(pose)
        path = written(tmp_path, bound)
        with pytest.raises(DocumentError, match="no misspecified covariance"):
            export_result(path, "npz", misspecified=True)
        document = json.loads(path.read_text(encoding="utf-8"))
        larger = (4.0 * bound.covariance).tolist()
        document["misspecified"] = {"frame": "camera", "covariance": larger}
        path.write_text(json.dumps(document), encoding="utf-8")
        done = export_result(path, "gtsam", misspecified=True)
        assert "misspecified covariance" in done.path.read_text(encoding="utf-8")
        graph, _ = gtsam.readG2o(str(done.path), True)
        A = slope(gtsam_coordinates(pose), pose)
        found = np.linalg.inv(graph.at(0).noiseModel().information())
        assert misfit(found, 4.0 * A @ bound.covariance @ A.T) < 1e-9


class TestRerun:
    @staticmethod
    def recorded(path: Path) -> dict[str, dict[str, Any]]:
        """By Rerun's reader: the components of every entity, of its first row."""
        found: dict[str, dict[str, Any]] = {}
        for chunk in rerun.chunk.RrdReader(path).stream().to_chunks():
            batch = chunk.to_record_batch()
            values = {name.rpartition(":")[2]: batch.column(name)[0].as_py() for name in batch.schema.names}
            found.setdefault(chunk.entity_path, {}).update(values)
        return found

    @staticmethod
    def spread(ellipsoid: dict[str, Any]) -> Array:
        """The matrix whose ellipsoid it is."""
        axes = Rotation.from_quat(ellipsoid["quaternions"][0]).as_matrix()
        return np.asarray((axes * np.square(ellipsoid["half_sizes"][0])) @ axes.T)

    def test_recording_has_frusta_ellipsoids_and_pictures(self, pose: Array, tmp_path: Path) -> None:
        picture = tmp_path / "view.png"
        Image.new("RGB", (8, 6), "red").save(picture)
        bound = bound_at(pose)
        found = self.recorded(export_result(written(tmp_path, bound), "rerun", images=picture).path)
        turn = np.reshape(found["/world/0"]["mat3x3"][0], (3, 3)).T  # by columns
        np.testing.assert_allclose(turn, (pose @ OPENCV)[:3, :3], atol=1e-6)
        np.testing.assert_allclose(found["/world/0"]["translation"][0], pose[:3, 3], rtol=1e-6)
        np.testing.assert_allclose(
            np.reshape(found["/world/0/camera"]["image_from_camera"][0], (3, 3)).T,
            [[525.0, 0.0, 315.0], [0.0, 520.0, 242.0], [0.0, 0.0, 1.0]],
        )
        assert bytes(found["/world/0/camera/picture"]["blob"][0]) == picture.read_bytes()
        one, many = (self.spread(found[f"/errors/{level}/world/0"]) for level in ("1_sigma", "95_percent"))
        assert misfit(one, bound.position_covariance) < 1e-5  # float32
        assert misfit(many, chi2.ppf(0.95, 3) * bound.position_covariance) < 1e-5
        # Negative control: the covariance along the camera's axes.
        assert misfit(one, bound.covariance[:3, :3]) > 0.1
        assert "/errors/unseen/world/0" not in found
        with pytest.raises(OutputError, match="neither the only pose's picture nor a folder"):
            export_result(tmp_path / "result.json", "rerun", tmp_path / "b.rrd", images=tmp_path)
        with pytest.raises(OptionError, match="--images is of --to rerun"):
            export_result(tmp_path / "result.json", "csv", images=picture)

    def test_unseen_direction_is_an_open_line_and_no_ball(self, pose: Array, tmp_path: Path) -> None:
        along = np.array([1.0, 2.0, 2.0]) / 3.0
        unseen = np.concatenate([pose[:3, :3].T @ along, np.zeros(3)])
        F = 1e8 * (np.eye(6) - np.outer(unseen, unseen))
        bound = dataclasses.replace(cramer_rao_bound(made(F, pose=pose)), provenance={"sensor": "a"})
        done = export_result(written(tmp_path, bound), "rerun")
        assert "open line" in done.notes[0]
        found = self.recorded(done.path)
        (start, end), *others = found["/errors/unseen/world/0"]["strips"][0:]
        assert not others
        direction = np.subtract(end, start)
        assert abs(direction @ along) == pytest.approx(np.linalg.norm(direction), rel=1e-5)
        assert np.linalg.norm(direction) == pytest.approx(2.0 * bound.length_scale, rel=1e-5)
        disk = np.sort(found["/errors/1_sigma/world/0"]["half_sizes"][0])
        np.testing.assert_allclose(disk, [0.0, 1e-4, 1e-4], rtol=1e-5)

    def test_without_its_library_is_refused_in_a_line(
        self, pose: Array, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setitem(sys.modules, "rerun", None)
        with pytest.raises(OutputError, match=r"pip install 'mitsuba_crb\[rerun\]'"):
            export_result(written(tmp_path, bound_at(pose)), "rerun")
