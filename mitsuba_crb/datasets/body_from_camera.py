"""Where a body carries its camera: EuRoC's T_BS, or a matrix or seven numbers in a file of their own."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..errors import PoseError
from ..files import read_array, read_bytes, read_text, read_yaml
from ..se3 import Array, pose_from_numbers


def load_body_from_camera(path: str | os.PathLike[str]) -> Array:
    """(4, 4) as `load_poses` takes it, in the file's own axes.

    Args:
        path: EuRoC's `sensor.yaml`, whose T_BS it is, or a 4x4 matrix or x y z qx qy qz qw as text, `.npy` or
            JSON.

    Raises:
        PoseError: the file is none of these, or its matrix is no rigid motion.
    """
    file = Path(path)
    numbers = _numbers(file)
    try:
        return pose_from_numbers(numbers)
    except PoseError as error:
        raise PoseError(f"{file}: {error}") from None


def _numbers(file: Path) -> Any:
    if read_bytes(file, PoseError).startswith(b"\x93NUMPY"):
        return read_array(file, PoseError)
    text = read_text(file, PoseError)
    try:
        return [float(word) for word in re.split(r"[\s,]+", text.strip())]
    except ValueError:
        pass
    document = read_yaml(file, PoseError)  # JSON is YAML
    if isinstance(document, list):
        return document
    found = document.get("T_BS") if isinstance(document, Mapping) else None
    if found is None:
        raise PoseError(
            f"{file}: expected a 4x4 matrix, x y z qx qy qz qw, or T_BS as in EuRoC's sensor.yaml"
        )
    return found.get("data") if isinstance(found, Mapping) else found
