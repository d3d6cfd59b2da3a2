"""Which photograph was taken at each pose of a file: by what the file calls it, or by the sorted order."""

from __future__ import annotations

import os
from pathlib import Path

from ..errors import CaptureError, PoseError
from ..files import read_json
from .folders import capture_file
from .images import image_folders, images_in, so_many_images
from .pose_list import Poses
from .seven_scenes import FORMAT, frame_file
from .transforms import frames_of, image_path

_NAMED = ("COLMAP", "transforms.json", "INRIA's cameras.json")
"""Formats that call poses by their images' files."""
_SORTED = ("LLFF", "Tanks and Temples")
"""Formats whose poses have the order of their images."""


def photographs_at_hand(path: str | os.PathLike[str], poses: Poses) -> list[Path | None]:
    """The photographs beside a file of poses, each None if it is not there; none where there are none at all.

    Args:
        path: what the poses were loaded from.
        poses: those of the file, in its order.
    """
    file = capture_file(Path(path), "images", PoseError)
    found: list[Path | None] = []
    if poses.format == FORMAT:
        found = [frame_file(file, name, "color") for name in poses.names]
    elif poses.format == "transforms.json":
        frames = frames_of(read_json(file, CaptureError), file, CaptureError)
        images = [image_path(frame, file) for frame in frames]
        found = [image if image is not None and image.is_file() else None for image in images]
    elif poses.format in (*_NAMED, *_SORTED):
        folders = [folder for root in (file.parent, *file.parents[1:3]) for folder in image_folders(root)]
        for folder in folders:
            found = _by_name(folder, poses) if poses.format in _NAMED else _by_order(folder, poses)
            if any(found):
                break
    return found if any(found) else []


def photographs_in(folder: Path, poses: Poses) -> list[Path | None]:
    """The photographs of the poses in a folder: by their names, or else by their sorted order.

    Raises:
        CaptureError: there is no such folder, or neither is the case.
    """
    if not folder.is_dir():
        raise CaptureError(f"{folder} is no folder of images")
    found = _by_name(folder, poses)
    if not any(found):
        found = _by_order(folder, poses)
    if not found:
        raise CaptureError(
            f"{folder} has {len(images_in(folder))} images, none of which is called like one of the "
            f"{len(poses)} poses, such as {poses.names[0]}; name them alike, or give as many images as poses"
        )
    return found


def _by_name(folder: Path, poses: Poses) -> list[Path | None]:
    """Files called like a pose, with or without an ending, or with or without its folder."""
    files = {file.name: file for file in images_in(folder)}
    files |= {file.stem: file for file in files.values()}
    below = [folder / name for name in poses.names]
    return [file if file.is_file() else files.get(file.name) or files.get(file.stem) for file in below]


def _by_order(folder: Path, poses: Poses) -> list[Path | None]:
    found = so_many_images([folder], len(poses))
    return [] if found is None else [*found[1]]
