"""`cameras.json` of INRIA's Gaussian splatting: pinholes with their axis in the middle.

`position` is the camera's centre, `rotation` world_from_camera by rows, in axes x right, y down, z forward.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..camera import Intrinsics
from ..errors import CameraError, PoseError
from .calibrations import Cameras
from .conventions import Convention
from .entries import number, numbers, required, whole
from .lens import calibrated
from .pose_list import Poses, from_matrices, listed

CONVENTION = Convention("opencv", "world_from_camera")


def is_inria(document: Any) -> bool:
    """Whether a JSON document is one of these."""
    return (
        isinstance(document, list)
        and bool(document)
        and all(isinstance(entry, Mapping) and {"rotation", "position"} <= set(entry) for entry in document)
    )


def inria_cameras(document: list[Mapping[str, Any]], path: Path) -> Cameras:
    """The cameras in the document, by their images' names."""
    return {name_of(entry, k): partial(_intrinsics, entry, path, k) for k, entry in enumerate(document)}


def inria_poses(document: list[Mapping[str, Any]], path: Path, given: Convention) -> Poses:
    """The poses in the document, by their images' names.

    Raises:
        PoseError: one is no rigid motion.
    """
    names = [name_of(entry, k) for k, entry in enumerate(document)]
    wheres = [f"{path}: camera {name!r}" for name in names]
    matrices = np.zeros((len(document), 3, 4))
    for matrix, entry, where in zip(matrices, document, wheres, strict=True):
        rows = entry["rotation"]
        if not isinstance(rows, list) or len(rows) != 3:
            raise PoseError(f"{where}: rotation must be three rows of three numbers")
        matrix[:, :3] = [numbers(row, f"{where}: a row of rotation", PoseError, 3) for row in rows]
        matrix[:, 3] = numbers(entry["position"], f"{where}: position", PoseError, 3)
    poses, notes = from_matrices(matrices, wheres)
    return listed(
        path,
        given,
        CONVENTION,
        form="INRIA's cameras.json",
        poses=poses,
        names=names,
        cameras=names,
        notes=notes,
        fixed=True,
    )


def name_of(entry: Mapping[str, Any], k: int) -> str:
    """What the file calls its k-th camera."""
    return str(entry.get("img_name", entry.get("id", k)))


def _intrinsics(entry: Mapping[str, Any], path: Path, k: int) -> Intrinsics:
    where = f"{path}: camera {name_of(entry, k)!r}"
    width, height, fx, fy = (
        number(required(entry, key, where, CameraError), f"{where}: {key}", CameraError)
        for key in ("width", "height", "fx", "fy")
    )
    size = [whole(side, f"{where}: the size", CameraError) for side in (width, height)]
    return calibrated(where, size=size, focal=[fx, fy], centre=[0.5 * side for side in size])
