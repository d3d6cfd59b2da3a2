"""Poses for COLMAP: a model in text, cameras.txt, images.txt and points3D.txt, and covariances.txt beside it.

COLMAP keeps cam_from_world, axes x right, y down, and its covariances are of the split tangent y = (δ, d),
`q ← (1, δ) q`, `t ← t + d`, that `pycolmap.estimate_ba_covariance` has: δ is half an angle in the camera's
axes. From cam_from_world = D (world_from_camera exp(ξ))⁻¹ (`se3.colmap_from_camera`):

    δ = −½ D φ,    d = −D ρ + [t]× D φ

The format has no place for covariances; covariances.txt has a line for each image, as images.txt has.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from .. import se3
from ..camera import Intrinsics
from ..errors import OutputError
from ..files import atomic
from .estimates import AXES, Estimate
from .headings import UPPER, Heading, said_blind
from .pose_graph import numbers
from .targets import check_folder

FILES = ("cameras.txt", "images.txt", "points3D.txt", "covariances.txt")
"""What is written, in this order."""
_CAMERAS, _IMAGES, _POINTS, _COVARIANCES = FILES
_ORDER = "dx dy dz of the quaternion (half angles), then dx dy dz of the translation"


def write_colmap(folder: Path, estimates: Sequence[Estimate], heading: Heading) -> list[str]:
    """Write the model into a folder; returns what there is to say of it.

    Args:
        folder: made if it is not there.
        estimates: of cameras in OpenCV's axes.
        heading: of all files.

    Raises:
        OutputError: a model is there already, or the poses are no camera's with known intrinsics.
    """
    cameras = [_intrinsics(estimate, heading) for estimate in estimates]
    different = list(dict.fromkeys(cameras))
    taken = [name for name in FILES if os.path.lexists(folder / name)]
    if taken:
        raise OutputError(f"{folder} has a {taken[0]} already; name another folder")
    notes = said_blind(estimates)
    what = "information" if notes else "covariance"
    head = heading.lines(estimates, "here inverted: cam_from_world")
    images, matrices, upper = [], [], np.triu_indices(6)
    for number, (estimate, camera) in enumerate(zip(estimates, cameras, strict=True), 1):
        x, y, z, qx, qy, qz, qw = se3.vector_from_pose(se3.inverse(estimate.pose))
        name = "_".join(estimate.name.split())
        pose = numbers(np.array([qw, qx, qy, qz, x, y, z]))
        found = estimate.in_coordinates(_split_tangent(estimate.pose))[bool(notes)]
        images += [f"{number} {pose} {different.index(camera) + 1} {name}", ""]
        matrices.append(f"{number} {name} {numbers(found[upper])}")
    texts = {
        _CAMERAS: ["CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"],
        _IMAGES: ["IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then an empty line for its points"],
        _POINTS: ["no points"],
        _COVARIANCES: [
            *notes,
            f"{what} of cam_from_world: {_ORDER}; {UPPER}",
            f"IMAGE_ID NAME {what.upper()}[21]",
        ],
    }
    rows = {
        _CAMERAS: [f"{k} {_line(camera)}" for k, camera in enumerate(different, 1)],
        _IMAGES: images,
        _POINTS: [],
        _COVARIANCES: matrices,
    }
    check_folder(folder, "--out")
    for name in FILES:
        lines = [*(f"# {line}" for line in [*head, *texts[name]]), *rows[name]]
        with atomic(folder / name) as temporary:
            temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return notes


def _split_tangent(world_from_camera: se3.Array) -> se3.Array:
    """A (6, 6) with (δ, d) = A ξ, the camera's axes OpenCV's."""
    ours_from_opencv = np.diag([*AXES["opencv"][0], 1.0])
    ours = world_from_camera @ se3.inverse(ours_from_opencv)
    A: se3.Array = se3.colmap_from_camera(ours) @ se3.adjoint(ours_from_opencv)
    return A


def _intrinsics(estimate: Estimate, heading: Heading) -> Intrinsics:
    if not estimate.of_camera:
        raise OutputError(
            f"{heading.source} has the pose of {estimate.body}, and COLMAP has cameras; export --to tum"
        )
    if estimate.camera is None:
        raise OutputError(
            f"{heading.source} does not say the camera's focal length, which COLMAP wants; write it again "
            "with bound --json, or export --to tum"
        )
    return estimate.camera


_MODELS = {"opencv": ((4, "OPENCV"), (8, "FULL_OPENCV")), "fisheye": ((4, "OPENCV_FISHEYE"),)}


def _line(camera: Intrinsics) -> str:
    """Model, size and parameters; of the smallest model that has all coefficients."""
    width, height = camera.size
    model, coefficients = "PINHOLE", camera.distortion
    if camera.model in _MODELS:
        used = max((k + 1 for k, value in enumerate(coefficients) if value), default=0)
        count, model = next(pair for pair in _MODELS[camera.model] if pair[0] >= used)
        coefficients = coefficients[:count]
    return f"{model} {width} {height} {numbers(np.array([*camera.focal, *camera.centre, *coefficients]))}"
