"""7-Scenes: `frame-*.pose.txt`, a 4x4 matrix each, beside `frame-*.color.png`, and one camera of them all."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..camera import Intrinsics
from ..errors import CameraError, PoseError
from ..files import read_image_size, read_rows
from .conventions import Convention
from .lens import HALF, calibrated
from .pose_list import Poses, from_matrices, listed

FORMAT = "7-Scenes"
_ENDING = ".pose.txt"
_CAMERA = "camera-intrinsics.txt"


def is_seven_scenes(folder: Path) -> bool:
    """Whether a folder has such poses."""
    return folder.is_dir() and any(folder.glob(f"frame-*{_ENDING}"))


def seven_scenes_poses(folder: Path, given: Convention) -> Poses:
    """The poses in the folder, by their frames' names.

    Raises:
        PoseError: one is no rigid motion.
    """
    files = sorted(folder.glob(f"frame-*{_ENDING}"))
    matrices = [read_rows(file, PoseError) for file in files]
    wrong = [file for file, matrix in zip(files, matrices, strict=True) if matrix.shape != (4, 4)]
    if wrong:
        raise PoseError(f"{wrong[0]} is no 4x4 matrix")
    poses, notes = from_matrices(np.array(matrices), [f"{file}: the pose" for file in files])
    names = [file.name.removesuffix(_ENDING) for file in files]
    custom = Convention("opencv", "world_from_camera")
    return listed(folder, given, custom, form=FORMAT, poses=poses, names=names, notes=notes)


def has_camera(folder: Path) -> bool:
    """Whether the folder says what its camera is."""
    return (folder / _CAMERA).is_file()


def seven_scenes_camera(folder: Path) -> Intrinsics:
    """Of `camera-intrinsics.txt`: a 3x3 matrix that counts pixels from the first one's centre.

    Raises:
        CameraError: it is missing or another, or there is no image to take the size from.
    """
    file = folder / _CAMERA
    if not has_camera(folder):
        raise CameraError(f"{folder} has no {_CAMERA}; give the camera's calibration")
    matrix = read_rows(file, CameraError)
    if matrix.shape != (3, 3):
        raise CameraError(f"{file} must be a 3x3 matrix, not {matrix.shape}")
    image = next((found for k in ("color", "depth") if (found := _first(folder, k))), None)
    if image is None:
        raise CameraError(f"{folder} has no frame-*.color.png to take the image's size from; add one")
    return calibrated(
        str(file),
        size=read_image_size(image, CameraError),
        focal=[matrix[0, 0], matrix[1, 1]],
        centre=[matrix[0, 2] + HALF, matrix[1, 2] + HALF],
    )


def frame_file(folder: Path, name: str, kind: str) -> Path | None:
    """A frame's `color` or `depth` image, if it is there."""
    files = [folder / f"{name}.{kind}.{ending}" for ending in ("png", "jpg")]
    return next((file for file in files if file.is_file()), None)


def _first(folder: Path, kind: str) -> Path | None:
    return next(iter(sorted(folder.glob(f"frame-*.{kind}.*"))), None)
