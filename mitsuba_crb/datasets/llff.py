"""`poses_bounds.npy` of LLFF: n x 17, a 3x5 matrix by rows, and the nearest and farthest depth.

The matrix' columns are the camera's down, right and back in the world, its centre, and height, width and
focal length [pixel] of the original image. Rows are in the sorted order of the images' names.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import Intrinsics
from ..errors import CameraError, PoseError
from .calibrations import Cameras
from .conventions import Convention
from .entries import whole
from .images import images_beside
from .lens import calibrated
from .pose_list import Poses, from_matrices

_WORDS = "world_from_camera, camera axes x down, y right, z back (LLFF)"


def is_llff(array: NDArray[Any]) -> bool:
    """Whether an array is one of these."""
    return array.ndim == 2 and array.shape[1] == 17 and len(array) > 0


def llff_poses(array: NDArray[Any], path: Path, given: Convention, names: Sequence[str] | None) -> Poses:
    """The poses, by the images' names if they are known.

    Raises:
        PoseError: a pose is no rigid motion, or the user contradicts the format.
    """
    for word in (given.axes, given.maps, given.order):
        if word not in (None, "world_from_camera"):
            raise PoseError(f"{path} is {_WORDS} by definition; leave {word} out of the convention")
    if given.body_from_camera is not None:
        raise PoseError(f"{path} has the camera's own poses; leave body_from_camera out")
    matrices = array[:, :15].reshape(-1, 3, 5).astype(np.float64)
    down, right, back, centre = np.moveaxis(matrices[:, :, :4], 2, 0)
    ours = np.stack([-right, -down, -back, centre], axis=2)
    poses, notes = from_matrices(ours, [f"{path}: pose {k + 1}" for k in range(len(ours))])
    known = tuple(names) if names is not None else tuple(str(k) for k in range(len(ours)))
    return Poses(poses, known, "LLFF", _WORDS, notes=notes)


def llff_cameras(array: NDArray[Any], path: Path) -> Cameras:
    """The cameras, by the images' names if they are known.

    Raises:
        CameraError: the array is none of LLFF's, or the numbers make no camera.
    """
    if not is_llff(array):
        raise CameraError(f"{path} has the shape {array.shape}; an array of cameras is LLFF's, of (n, 17)")
    names = images_beside(path, len(array)) or [str(k) for k in range(len(array))]
    return {name: partial(_camera, array, path, k) for k, name in enumerate(names)}


def llff_intrinsics(array: NDArray[Any], path: Path) -> list[Intrinsics]:
    """Of the original images, one a row: a pinhole whose axis is in the middle.

    Raises:
        CameraError: the numbers make no camera.
    """
    return [_camera(array, path, k) for k in range(len(array))]


def _camera(array: NDArray[Any], path: Path, k: int) -> Intrinsics:
    height, width, focal = array[k, :15].reshape(3, 5)[:, 4].tolist()
    where = f"{path}: camera {k + 1}"
    size = [whole(side, f"{where}: the size", CameraError) for side in (width, height)]
    centre = [0.5 * side for side in size]
    return calibrated(where, size=size, focal=[focal, focal], centre=centre)
