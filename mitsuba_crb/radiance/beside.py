"""The cameras beside a field's file, and their photographs.

INRIA's `cameras.json` lies beside it, or in the model's folder: `point_cloud/iteration_N/point_cloud.ply`.
Others, a `transforms.json` (in the trained model's world, if its `dataparser_transforms.json` is there) and a
COLMAP model, lie beside it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ..datasets.colmap_model import model_folder
from ..datasets.intrinsics import cameras_of_poses
from ..datasets.pose_photographs import photographs_at_hand
from ..datasets.poses import load_poses
from ..errors import CameraError
from .field import Viewpoint

_INRIA = "cameras.json"
_TRANSFORMS = "transforms.json"


@dataclass(frozen=True, eq=False)
class Beside:
    """Cameras of a file."""

    source: Path
    viewpoints: tuple[Viewpoint, ...]
    photographs: tuple[Path | None, ...]
    """Of each, the file of what it saw, if that is there."""


def beside(file: Path) -> Beside | None:
    """The cameras beside a file; None if there are none.

    Raises:
        CameraError: their file says poses alone, or cannot be used.
        PoseError: likewise.
    """
    source = _source(file)
    if source is None:
        return None
    poses = load_poses(source)
    cameras = cameras_of_poses(source, poses)
    if not cameras:
        raise CameraError(f"{source} says where cameras are, not what they see: give --camera FILE (camera=)")
    photographs = photographs_at_hand(source, poses) or [None] * len(poses)
    viewpoints = (
        Viewpoint(name, camera, pose)
        for name, camera, pose in zip(poses.names, cameras, poses.poses, strict=True)
    )
    return Beside(source, tuple(viewpoints), tuple(photographs))


def _source(file: Path) -> Path | None:
    if not file.is_file():
        return None
    folder = file.absolute().parent
    of_model = [place / _INRIA for place in (folder, *folder.parents[:2])]
    found = next((source for source in (of_model[0], folder / _TRANSFORMS) if source.is_file()), None)
    if found is not None:
        return found
    if model_folder(folder) is not None:
        return folder
    return next((source for source in of_model if source.is_file()), None)
