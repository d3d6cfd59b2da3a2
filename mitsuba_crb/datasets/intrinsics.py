"""A camera from a file of another tool, or of ours, whose format is told by what is in it.

`KNOWN` lists them. Principal points are converted to our origin, the image's upper left corner.
"""

from __future__ import annotations

import os
import re
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Any

from ..camera import Intrinsics
from ..errors import CameraError
from ..files import read_array, read_bytes, read_json, read_text, read_toml, read_yaml
from .binary import is_binary
from .calibrations import Cameras, calibrated_cameras, read_xml
from .colmap import is_cameras_binary, is_cameras_text, read_cameras
from .folders import capture_file
from .inria import inria_cameras, is_inria
from .llff import llff_cameras
from .own_camera import own_cameras
from .pose_list import Poses
from .rows import first_row
from .seven_scenes import FORMAT, has_camera, is_seven_scenes, seven_scenes_camera
from .transforms import is_transforms, says_focal, transforms_cameras

KNOWN = (
    "COLMAP's cameras.txt and cameras.bin, transforms.json, LLFF's poses_bounds.npy, ROS camera_info, "
    "Kalibr's camera chain, OpenCV's YAML, XML and JSON, INRIA's cameras.json, and our TOML with size, "
    "focal, centre, model"
)
"""The formats, in words."""
_HERE = Path()


def load_camera(path: str | os.PathLike[str], name: str | None = None) -> Intrinsics:
    """The camera of a calibration's file.

    Args:
        path: the file, in one of the formats in `KNOWN`, or the folder of a COLMAP model, transforms.json,
            LLFF or 7-Scenes.
        name: which camera, of a file with several different ones: what COLMAP or Kalibr call it, or the
            name of an image that has its own.

    Raises:
        CameraError: the file is of none of these formats or is damaged, its lens model is not known, the
            image's size is missing, or the name is missing or unknown.
    """
    file = Path(path)
    found = _cameras(capture_file(file, "cameras", CameraError))
    if name is not None:
        if name not in found:
            raise CameraError(f"{file} has no camera {name!r}; {_listed(found, name)}")
        return found[name]()
    cameras: set[Intrinsics | None] = set()
    for make in found.values():
        try:
            cameras.add(make())
        except CameraError:
            if len(found) == 1:
                raise
            cameras.add(None)  # which may not be the one that is meant
    if len(cameras) > 1 or None in cameras:
        raise CameraError(f"{file} has several different cameras; name one of them: {_listed(found)}")
    (camera,) = cameras
    assert camera is not None
    return camera


def file_and_name(text: str, folder: Path = _HERE) -> tuple[Path, str | None]:
    """The arguments of `load_camera` in "FILE:NAME" or "FILE", in whose own name colons are allowed.

    Args:
        text: what was said.
        folder: where the file is.
    """
    file, _, name = text.rpartition(":")
    named = file and not os.path.lexists(folder / text) and os.path.lexists(folder / file)
    return (folder / file, name) if named else (folder / text, None)


def cameras_of_poses(path: str | os.PathLike[str], poses: Poses) -> list[Intrinsics]:
    """The camera of each pose of a file that has both; none if the file has poses alone.

    Args:
        path: what the poses were loaded from.
        poses: those of the file, in its order.

    Raises:
        CameraError: a camera is missing, or cannot be used.
    """
    file = _beside(capture_file(Path(path), "images", CameraError), poses.format)
    if file is None:
        return []
    found = _cameras(file)
    if "" in found:
        return [found[""]()] * len(poses)
    keys = poses.cameras or poses.names
    missing = next((key for key in keys if key not in found), None)
    if missing is not None:
        raise CameraError(f"{file} lacks the camera {missing} of a pose; {_listed(found, missing)}")
    made = {key: found[key]() for key in dict.fromkeys(keys)}
    return [made[key] for key in keys]


def _beside(file: Path, form: str) -> Path | None:
    """What has the cameras of a file of poses in some format; None if there are none."""
    if form == "COLMAP":
        names = [f"cameras{ending}" for ending in (file.suffix, ".bin", ".txt")]
        return next((file.with_name(name) for name in names if file.with_name(name).is_file()), None)
    if form == FORMAT:
        return file if has_camera(file) else None
    if form == "transforms.json":
        return file if says_focal(read_json(file, CameraError)) else None
    return file if form in ("LLFF", "INRIA's cameras.json") else None


def _cameras(file: Path) -> Cameras:
    if is_seven_scenes(file):
        return {"": partial(seven_scenes_camera, file)}
    data = read_bytes(file, CameraError)
    if data.startswith(b"\x93NUMPY"):
        return llff_cameras(read_array(file, CameraError), file)
    if is_binary(data):
        if not is_cameras_binary(data):
            raise CameraError(f"{file} is no file of a camera that is known here; known: {KNOWN}")
        return {key: camera.intrinsics for key, camera in read_cameras(file).items()}
    line = first_row(read_text(file, CameraError))
    if line is None:
        raise CameraError(f"{file} is empty; expected a camera: {KNOWN}")
    if is_cameras_text(line):
        return {key: camera.intrinsics for key, camera in read_cameras(file).items()}
    if re.match(r"\[[\s\w.\"'-]+\]$|[\w.\"'-]+\s*=", line.partition("#")[0].strip()):
        return own_cameras(read_toml(file, CameraError), file)
    document = _document(file, line)
    if is_transforms(document):
        return transforms_cameras(document, file)
    if is_inria(document):
        return inria_cameras(document, file)
    found = calibrated_cameras(document, file)
    if not found:
        raise CameraError(f"{file} is no file of a camera that is known here; known: {KNOWN}")
    return found


def _document(file: Path, line: str) -> Any:
    """Of JSON, XML or YAML, by the first line."""
    if line.startswith(("{", "[")):
        return read_json(file, CameraError)
    if line.startswith("<"):
        return read_xml(file)
    return read_yaml(file, CameraError)


def _listed(found: Cameras, name: str | None = None) -> str:
    """The cameras' names, the near ones first, not too many."""
    names = [repr(key) for key in found if key]
    near = [repr(key) for key in get_close_matches(name or "", list(found), 3)]
    if not names:
        return "its one camera has no name"
    if near:
        return f"near ones are {', '.join(near)}"
    return f"it has {', '.join(names[:8])}{', …' if len(names) > 8 else ''}"
