"""`transforms.json` of NeRF, instant-ngp and nerfstudio: intrinsics for all frames, or for each.

The pixel origin is the image's upper left corner. Sizes that the file leaves out are those of the images.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from ..camera import Intrinsics
from ..errors import CameraError
from ..files import read_image_size
from .calibrations import Cameras
from .entries import number, table, whole
from .lens import calibrated, unknown_model

_MODELS = {
    "PINHOLE": "pinhole",
    "SIMPLE_PINHOLE": "pinhole",
    "PERSPECTIVE": "pinhole",
    "SIMPLE_RADIAL": "opencv",
    "RADIAL": "opencv",
    "OPENCV": "opencv",
    "FULL_OPENCV": "opencv",
    "OPENCV_FISHEYE": "fisheye",
    "FISHEYE": "fisheye",
    "SIMPLE_RADIAL_FISHEYE": "fisheye",
    "RADIAL_FISHEYE": "fisheye",
}
_COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
_FOCAL = ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y")
_INTRINSICS = (*_FOCAL, "cx", "cy", "w", "h", "camera_model", *_COEFFICIENTS)


def is_transforms(document: Any) -> bool:
    """Whether a JSON document is one of these."""
    return isinstance(document, Mapping) and bool({"frames", "fl_x", "camera_angle_x"} & set(document))


def frames_of(document: Mapping[str, Any], path: Path, fault: type[Exception]) -> list[Mapping[str, Any]]:
    """The file's frames.

    Raises:
        fault: `frames` is no list of tables.
    """
    frames = document.get("frames", [])
    if not isinstance(frames, Sequence) or isinstance(frames, str):
        raise fault(f"{path}: frames must be a list of tables")
    return [table(frame, f"{path}: frame {k + 1}", fault) for k, frame in enumerate(frames)]


def says_focal(document: Mapping[str, Any]) -> bool:
    """Whether the document has intrinsics, for all frames or in any."""
    return any(key in where for where in (document, *document.get("frames", [])) for key in _FOCAL)


def transforms_cameras(document: Mapping[str, Any], path: Path) -> Cameras:
    """The cameras in the document: by frame if frames have their own, else one."""
    frames = frames_of(document, path, CameraError)
    if any(key in frame for frame in frames for key in _INTRINSICS):
        return {
            str(frame.get("file_path", k)): partial(frame_intrinsics, document, frame, path)
            for k, frame in enumerate(frames)
        }
    return {"": partial(frame_intrinsics, document, frames[0] if frames else {}, path)}


def frame_intrinsics(document: Mapping[str, Any], frame: Mapping[str, Any], path: Path) -> Intrinsics:
    """Intrinsics of a frame, what it does not say itself being what the file says.

    Raises:
        CameraError: a number is missing or is none, or the lens model is not known.
    """
    own = {key: frame[key] for key in _INTRINSICS if key in frame}
    of_file = {key: document[key] for key in (*_INTRINSICS, "is_fisheye") if key in document}
    if any(key in own for key in _FOCAL):  # an angle of the frame's own, say, in place of the file's length
        of_file = {key: value for key, value in of_file.items() if key not in _FOCAL}
    merged = {**of_file, **own}
    where = f"{path}: {frame['file_path']}" if own and "file_path" in frame else str(path)
    given = {
        key: number(value, f"{where}: {key}", CameraError)
        for key, value in merged.items()
        if key not in ("camera_model", "is_fisheye")
    }
    size = _size(given, frame, where, path)
    focal = [_focal(given, axis, side) for axis, side in zip("xy", size, strict=True)]
    known = [value for value in focal if value is not None]
    if not known:
        raise CameraError(f"{where} has neither fl_x nor camera_angle_x, so that the focal length is unknown")
    return calibrated(
        where,
        size=size,
        focal=[known[0], known[-1]],
        centre=[given.get("cx", 0.5 * size[0]), given.get("cy", 0.5 * size[1])],
        model=_model(merged, given, where),
        coefficients={name: given[name] for name in _COEFFICIENTS if name in given},
    )


def image_path(frame: Mapping[str, Any], path: Path) -> Path | None:
    """Where the frame's image is, whose ending NeRF's own files leave out; None if the frame names none."""
    name = frame.get("file_path")
    if not isinstance(name, str):
        return None
    image = path.parent / name
    others = [image.with_name(image.name + ending) for ending in (".png", ".jpg", ".jpeg", ".JPG")]
    return next((file for file in (image, *others) if file.is_file()), image)


def _size(given: Mapping[str, float], frame: Mapping[str, Any], where: str, path: Path) -> list[int]:
    if "w" in given and "h" in given:
        return [whole(given[key], f"{where}: {key}", CameraError) for key in "wh"]
    image = image_path(frame, path)
    if image is None or not image.is_file():
        raise CameraError(f"{where} has no w and h, and no image to take them from; add them to it")
    return list(read_image_size(image, CameraError))


def _focal(given: Mapping[str, float], axis: str, side: int) -> float | None:
    """fl, or what the angle between the image's sides makes it; the length wins, as in instant-ngp."""
    if f"fl_{axis}" in given:
        return given[f"fl_{axis}"]
    angle = given.get(f"camera_angle_{axis}")
    return None if angle is None else 0.5 * side / math.tan(0.5 * angle) if 0.0 < angle < math.pi else 0.0


def _model(merged: Mapping[str, Any], given: Mapping[str, float], where: str) -> str:
    name = str(merged.get("camera_model", "")).upper()
    if name and name not in _MODELS:
        raise unknown_model(where, name, _MODELS)
    if merged.get("is_fisheye") is True:
        return "fisheye"
    model = _MODELS[name] if name else "opencv" if any(key in given for key in _COEFFICIENTS) else "pinhole"
    if model == "opencv" and given.get("k4") and name != "FULL_OPENCV" and not {"k5", "k6"} & set(given):
        raise CameraError(
            f"{where}: k4 is of r⁸ in nerfstudio and of a denominator in OpenCV; say camera_model = "
            "FULL_OPENCV if it is OpenCV's, else calibrate without it"
        )
    return model
