"""Bundle adjustment through distorted lenses: pycolmap's covariances, of made-up points and a capture's."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from matrices import misfit
from numpy.typing import NDArray

from mitsuba_crb import load_capture, se3
from mitsuba_crb.agents.bundle import PointView, joint_point_information, point_information
from mitsuba_crb.camera import Camera, Intrinsics

SIZE = (640, 480)
LENSES = {
    "FULL_OPENCV": Intrinsics(
        SIZE, (330.0, 320.0), (310.0, 250.0), "opencv", (-0.3, 0.08, 1e-3, -7e-4, 0.0, 0.0, 0.0, 0.0)
    ),
    "OPENCV_FISHEYE": Intrinsics(
        SIZE, (330.0, 320.0), (310.0, 250.0), "fisheye", (-0.02, 0.01, -0.004, 0.0005)
    ),
}
"""By COLMAP's names."""
FIXED = 2
"""Cameras that are known, so that neither the place of everything nor its size is free."""
every_lens = pytest.mark.parametrize("model", LENSES)


def scene(model: str, views: int) -> tuple[NDArray[Any], list[PointView]]:
    """Points (n, 3) in the world that fill every image, and cameras that see them to one pixel."""
    rng = np.random.default_rng(12)
    camera = Camera.of(LENSES[model])
    film = rng.uniform([40.0, 40.0], [600.0, 440.0], size=(60, 2))
    world_from_scene = se3.exp(rng.normal(size=6))
    local = camera.directions(film) * rng.uniform(3.0, 8.0, size=(60, 1))
    points = local @ world_from_scene[:3, :3].T + world_from_scene[:3, 3]
    moves = rng.normal(size=(views, 6)) * [0.2, 0.2, 0.2, 0.02, 0.02, 0.02]
    return points, [
        PointView(f"c{k}", world_from_scene @ se3.exp(move), camera, 1.0) for k, move in enumerate(moves)
    ]


def rigid(pose: NDArray[Any]) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(se3.pose_to_colmap(pose)[:3])


def reconstruction(model: str, points: NDArray[Any], views: list[PointView]) -> pycolmap.Reconstruction:
    """The same cameras and points as a model of COLMAP's, every point seen where it is."""
    found, lens = pycolmap.Reconstruction(), LENSES[model]
    numbers = [*lens.focal, *lens.centre, *lens.distortion]
    found.add_camera_with_trivial_rig(
        pycolmap.Camera(model=model, width=SIZE[0], height=SIZE[1], params=numbers, camera_id=1)
    )
    for k, view in enumerate(views, 1):
        film = view.camera.project((points - view.pose[:3, 3]) @ view.pose[:3, :3])
        image = pycolmap.Image(name=view.variable, keypoints=film, camera_id=1, image_id=k)
        found.add_image_with_trivial_frame(image, rigid(view.pose))
    for j, point in enumerate(points):
        track = pycolmap.Track()
        for k in range(1, len(views) + 1):
            track.add_element(k, j)
        found.add_point3D(point, track, np.zeros(3, dtype=np.uint8))
    return found


def their_covariance(model: pycolmap.Reconstruction) -> NDArray[Any]:
    """Of the poses of all images but the first, known ones, points being unknown and the camera known."""
    images = sorted(model.images)
    config = pycolmap.BundleAdjustmentConfig()
    for image in images:
        config.add_image(image)
    for camera in model.cameras:
        config.set_constant_cam_intrinsics(camera)
    for image in images[:FIXED]:
        config.set_constant_rig_from_world_pose(model.images[image].frame_id)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(
        pycolmap.BundleAdjustmentOptions(), config, model
    )
    options = pycolmap.BACovarianceOptions()
    options.params, options.damping = pycolmap.BACovarianceOptionsParams.POSES, 0.0
    found = pycolmap.estimate_ba_covariance(options, model, adjuster)
    free = images[FIXED:]
    return np.block([[found.get_cam_cross_cov_from_world(a, b) for b in free] for a in free])


def our_covariance(points: NDArray[Any], views: list[PointView]) -> NDArray[Any]:
    """Of the same poses in COLMAP's tangent."""
    covariance = np.linalg.inv(joint_point_information(points, views).matrix[6 * FIXED :, 6 * FIXED :])
    turned = np.zeros_like(covariance)
    for k, view in enumerate(views[FIXED:]):
        own = slice(6 * k, 6 * k + 6)
        turned[own, own] = se3.colmap_from_camera(view.pose)
    return turned @ covariance @ turned.T


def without_distortion(views: list[PointView]) -> list[PointView]:
    return [dataclasses.replace(view, camera=view.camera.plain) for view in views]


@every_lens
def test_known_points_have_pycolmap_s_covariance(model: str) -> None:
    points, (view,) = scene(model, 1)
    lens = LENSES[model]
    numbers = [*lens.focal, *lens.centre, *lens.distortion]
    found = pycolmap.estimate_and_refine_absolute_pose(
        view.camera.project((points - view.pose[:3, 3]) @ view.pose[:3, :3]),
        points,
        pycolmap.Camera(model=model, width=SIZE[0], height=SIZE[1], params=numbers),
        return_covariance=True,
    )

    def ours(view: PointView) -> NDArray[Any]:
        covariance = np.linalg.inv(point_information(points, view).matrix)
        return se3.move_covariance(covariance, se3.colmap_from_camera(view.pose))

    assert found["num_inliers"] == len(points)
    assert misfit(found["covariance"], ours(view)) < 1e-9
    assert misfit(found["covariance"], ours(*without_distortion([view]))) > 0.05


@every_lens
def test_unknown_points_have_pycolmap_s_covariance(model: str) -> None:
    points, views = scene(model, 4)
    theirs = their_covariance(reconstruction(model, points, views))
    assert misfit(theirs, our_covariance(points, views)) < 1e-9
    assert misfit(theirs, our_covariance(points, without_distortion(views))) > 0.05


@pytest.mark.slow
def test_a_capture_s_points_have_pycolmap_s_covariance(captures: Path) -> None:
    """Twelve photographs, 11,384 points, SIMPLE_RADIAL: found to 3e-7."""
    folder = captures / "lund_door_colmap_12"
    model = pycolmap.Reconstruction(folder / "colmap_ground_truth")
    photographs = {photograph.name: photograph for photograph in load_capture(folder).photographs}
    places = {key: place for place, key in enumerate(model.points3D)}
    views = []
    for _, image in sorted(model.images.items()):
        photograph = photographs[image.name]
        observed = [places[point.point3D_id] for point in image.points2D if point.has_point3D()]
        # Some points are found twice in an image: twice the information.
        seen, times = np.unique(observed, return_counts=True)
        camera = Camera.of(photograph.intrinsics)
        views.append(PointView(image.name, photograph.pose, camera, 1.0 / np.sqrt(times), seen))
    points = np.array([point.xyz for point in model.points3D.values()])
    theirs = their_covariance(model)
    assert misfit(theirs, our_covariance(points, views)) < 1e-6
    assert misfit(theirs, our_covariance(points, without_distortion(views))) > 1e-2
