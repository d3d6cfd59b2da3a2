"""COLMAP's cameras, from its text and its binary files.

The pixel origin is the image's upper left corner, as ours. Layout: COLMAP's documentation, "Output format".
"""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import NamedTuple

from ..camera import Intrinsics
from ..errors import CameraError
from ..files import read_bytes, read_text
from .binary import Cursor, is_binary
from .entries import number, whole
from .lens import COLMAP_MODELS, colmap_intrinsics, unknown_model
from .rows import rows_of

_BY_ID: dict[int, tuple[str, int]] = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4),
    13: ("DIVISION", 5),
    14: ("SIMPLE_FISHEYE", 3),
    15: ("FISHEYE", 4),
    16: ("EUCM", 6),
    17: ("EQUIRECTANGULAR", 2),
}
"""Name and number of parameters of a model in a binary file; of unsupported ones too, to pass over them."""

_LINE = re.compile(r"\d+[\s,;]+[A-Za-z][A-Za-z_0-9]*[\s,;]+\d+[\s,;]+\d+([\s,;]|$)")


class ColmapCamera(NamedTuple):
    """A record of a camera, whose model may be one that we do not have."""

    where: str
    """What messages begin with."""
    model: str
    """COLMAP's name of it."""
    size: tuple[int, int]
    """Width and height [pixel]."""
    values: tuple[float, ...]
    """Its parameters, in COLMAP's order."""

    def intrinsics(self) -> Intrinsics:
        """As ours.

        Raises:
            CameraError: the model is none of ours, or the numbers make no camera.
        """
        return colmap_intrinsics(self.where, self.model, self.size, self.values)


def is_cameras_text(line: str) -> bool:
    """Whether a text whose first row this is lists COLMAP's cameras."""
    return _LINE.match(line) is not None


def is_cameras_binary(data: bytes) -> bool:
    """Whether bytes list COLMAP's cameras, the last of which may be cut off."""
    if len(data) < 32:
        return False
    _, _, model, width, height = struct.unpack_from("<QIiQQ", data)
    return model in _BY_ID and 0 < width < 1 << 20 and 0 < height < 1 << 20


def read_cameras(path: Path) -> dict[str, ColmapCamera]:
    """Cameras by their number, of a `cameras.txt` or a `cameras.bin`.

    Raises:
        CameraError: the file is neither, is cut off, or has the same camera twice.
    """
    data = read_bytes(path, CameraError)
    records = _binary(Cursor(data, path, CameraError)) if is_binary(data) else _text(path)
    cameras: dict[str, ColmapCamera] = {}
    for key, camera in records:
        if key in cameras:
            raise CameraError(f"{path} has two cameras {key}")
        cameras[key] = camera
    if not cameras:
        raise CameraError(f"{path} has no camera in it")
    return cameras


def _text(path: Path) -> list[tuple[str, ColmapCamera]]:
    cameras = []
    for line, words in rows_of(read_text(path, CameraError)).rows:
        where = f"{path}, line {line}"
        if len(words) < 4:
            raise CameraError(
                f"{where}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS, got {len(words)} words"
            )
        width, height = (
            whole(words[k], f"{where}: the {side}", CameraError) for k, side in ((2, "width"), (3, "height"))
        )
        values = tuple(number(word, f"{where}: a parameter", CameraError) for word in words[4:])
        key = str(whole(words[0], f"{where}: the camera's number", CameraError))
        cameras.append((key, ColmapCamera(where, words[1], (width, height), values)))
    return cameras


def _binary(cursor: Cursor) -> list[tuple[str, ColmapCamera]]:
    (count,) = cursor.take("Q")
    cameras = []
    for _ in range(count):
        key, model, width, height = cursor.take("IiQQ")
        where = f"{cursor.path}: camera {key}"
        if model not in _BY_ID:
            raise unknown_model(where, f"number {model}", COLMAP_MODELS)
        name, parameters = _BY_ID[model]
        cameras.append((str(key), ColmapCamera(where, name, (width, height), cursor.take(f"{parameters}d"))))
    cursor.end()
    return cameras
