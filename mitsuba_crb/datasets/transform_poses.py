"""The poses of a `transforms.json`: world_from_camera in axes x right, y up, z back.

nerfstudio turns and scales the world twice. Of the world w that a capture came with, `transforms.json` holds
the poses in applied_scale · (applied_transform · w), and what it trains lives in scale · (transform · w), by
`dataparser_transforms.json`. Poses are read in w, or, with the latter file, in the trained model's world.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import PoseError
from ..files import read_json
from ..se3 import Array, as_pose, inverse
from .conventions import Convention
from .entries import number, numbers, required, table
from .pose_list import Poses, from_matrices, listed
from .transforms import frames_of

CONVENTION = Convention("opengl", "world_from_camera")
DATAPARSER = "dataparser_transforms.json"


def transforms_poses(
    document: Mapping[str, Any], path: Path, given: Convention, dataparser: Path | None = None
) -> Poses:
    """The poses in the document, by their images' names.

    Args:
        document: of the file.
        path: the file.
        given: what the user says.
        dataparser: nerfstudio's `dataparser_transforms.json`; None: the one beside the file, if there is one.

    Raises:
        PoseError: one is no rigid motion, or the user contradicts the format.
    """
    frames = frames_of(document, path, PoseError)
    if not frames:
        raise PoseError(f"{path} has no frame in it")
    names = [str(frame.get("file_path", k)) for k, frame in enumerate(frames)]
    wheres = [f"{path}: the pose of {name}" for name in names]
    matrices = [
        _matrix(required(frame, "transform_matrix", where, PoseError), where)
        for frame, where in zip(frames, wheres, strict=True)
    ]
    poses, notes = from_matrices(matrices, wheres)
    world = ""
    if "applied_transform" in document or "applied_scale" in document:
        poses = _unapplied(poses, document, path)
        world = ", in the world before applied_transform"
    beside = path.with_name(DATAPARSER)
    if dataparser is not None or beside.is_file():
        poses = _trained(poses, dataparser or beside)
        world = f", in the trained model's world of {(dataparser or beside).name}"
    return listed(
        path,
        given,
        CONVENTION,
        form="transforms.json",
        poses=poses,
        names=names,
        notes=notes,
        more=world,
        fixed=True,
    )


def _matrix(rows: Any, where: str) -> Array:
    """4 x 4, of a list of three or four rows of four numbers."""
    if not isinstance(rows, list) or len(rows) not in (3, 4):
        raise PoseError(f"{where} must be a matrix of four rows of four numbers")
    matrix = np.eye(4)
    matrix[: len(rows)] = [numbers(row, f"{where}: a row", PoseError, 4) for row in rows]
    return matrix


def _unapplied(poses: Array, document: Mapping[str, Any], path: Path) -> Array:
    scale = _scale(document.get("applied_scale", 1.0), f"{path}: applied_scale")
    where = f"{path}: applied_transform"
    applied = as_pose(_matrix(document.get("applied_transform", np.eye(4).tolist()), where), where)
    return np.asarray(inverse(applied) @ _scaled(poses, 1.0 / scale))


def _trained(poses: Array, path: Path) -> Array:
    document = table(read_json(path, PoseError), str(path), PoseError)
    where = f"{path}: transform"
    transform = as_pose(_matrix(required(document, "transform", str(path), PoseError), where), where)
    return _scaled(transform @ poses, _scale(document.get("scale", 1.0), f"{path}: scale"))


def _scale(value: Any, where: str) -> float:
    scale = number(value, where, PoseError)
    if scale <= 0.0:
        raise PoseError(f"{where} must be positive, not {scale}")
    return scale


def _scaled(poses: Array, scale: float) -> Array:
    scaled = poses.copy()
    scaled[:, :3, 3] *= scale
    return scaled
