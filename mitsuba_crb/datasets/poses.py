"""Poses from a file of another tool, or of ours, whose format is told by what is in it.

`trajectories.KNOWN` lists them. All become world_from_camera in the axes of `se3`.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..errors import PoseError
from ..files import read_array, read_bytes, read_json, read_text
from .binary import is_binary
from .colmap import is_cameras_binary, is_cameras_text
from .colmap_images import colmap_poses, is_images_binary, is_images_text
from .conventions import Convention, parse_convention
from .folders import capture_file
from .images import images_beside
from .inria import inria_poses, is_inria
from .llff import is_llff, llff_poses
from .pose_list import Poses, from_matrices, listed
from .rows import first_row
from .seven_scenes import is_seven_scenes, seven_scenes_poses
from .trajectories import KNOWN, trajectory
from .transform_poses import transforms_poses
from .transforms import is_transforms

_OURS = Convention("mitsuba", "world_from_camera")


def load_poses(
    path: str | os.PathLike[str],
    convention: str | None = None,
    *,
    dataparser: str | os.PathLike[str] | None = None,
    body_from_camera: ArrayLike | None = None,
) -> Poses:
    """The poses in a file, as world_from_camera in our axes.

    Args:
        path: the file, in a format of `trajectories.KNOWN`, or the folder of a COLMAP model, a
            transforms.json, LLFF's poses_bounds.npy, or 7-Scenes.
        convention: what the file does not say, in words: the camera's axes (mitsuba, opencv, opengl), what
            the poses map (world_from_camera, camera_from_world) and a quaternion's order (xyzw, wxyz).
        dataparser: nerfstudio's `dataparser_transforms.json`, for poses of a transforms.json in the trained
            model's world; default: the one beside the file, if there is one.
        body_from_camera: 4 x 4, of poses of a body: EuRoC's T_BS (`load_body_from_camera`), or the inverse of
            Kalibr's T_cam_imu. The camera's axes are OpenCV's then, unless the convention says otherwise.

    Raises:
        PoseError: the file is of none of these formats or is damaged, a pose is no rigid motion, or the
            convention contradicts the file.
    """
    file = capture_file(Path(path), "images", PoseError)
    given = parse_convention(convention, body_from_camera)
    if dataparser is not None:
        document = read_json(file, PoseError)
        if not is_transforms(document):
            raise PoseError(f"{file} is no transforms.json; leave {dataparser} out")
        return transforms_poses(document, file, given, Path(dataparser))
    if is_seven_scenes(file):
        return seven_scenes_poses(file, given)
    data = read_bytes(file, PoseError)
    if data.startswith(b"\x93NUMPY"):
        return _of_array(read_array(file, PoseError), file, given)
    if is_binary(data):
        if is_cameras_binary(data):
            raise PoseError(f"{file} lists cameras, not poses; give images.bin, or the model's folder")
        if not is_images_binary(data):
            raise PoseError(f"{file} is no file of poses that is known here; known: {KNOWN}")
        return colmap_poses(file, given)
    text = read_text(file, PoseError)
    line = first_row(text)
    if line is None:
        raise PoseError(f"{file} is empty; expected poses: {KNOWN}")
    if line.startswith(("{", "[")):
        return _of_document(read_json(file, PoseError), file, given)
    if is_cameras_text(line):
        raise PoseError(f"{file} lists cameras, not poses; give images.txt, or the model's folder")
    if is_images_text(line) or re.search(r"^#.*\bIMAGE_ID\b.*\bQW\b", text, re.MULTILINE):
        return colmap_poses(file, given)
    return trajectory(file, given)


def _of_document(document: Any, file: Path, given: Convention) -> Poses:
    if is_transforms(document):
        return transforms_poses(document, file, given)
    if is_inria(document):
        return inria_poses(document, file, given)
    try:
        array = np.array(document, dtype=np.float64)
    except (TypeError, ValueError):
        raise PoseError(f"{file} is no file of poses that is known here; known: {KNOWN}") from None
    return _of_array(array, file, given)


def _of_array(array: Any, file: Path, given: Convention) -> Poses:
    if is_llff(array):
        return llff_poses(array, file, given, images_beside(file, len(array)))
    if array.ndim == 2 and array.shape in ((4, 4), (3, 4)):
        array = array[None]
    if array.ndim != 3 or array.shape[1:] not in ((4, 4), (3, 4)) or not len(array):
        raise PoseError(f"{file} has the shape {array.shape}; poses have (n, 4, 4), and LLFF's (n, 17)")
    poses, notes = from_matrices(array, [f"{file}: pose {k}" for k in range(len(array))])
    names = [str(k) for k in range(len(array))]
    return listed(file, given, _OURS, form="4x4 matrices", poses=poses, names=names, notes=notes)
