"""The folder of a capture: which of its files has the poses, which the cameras."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from ..files.reading import Fault
from .colmap_model import model_file, model_folder
from .seven_scenes import is_seven_scenes

_TRANSFORMS = ("transforms.json", "transforms_train.json")
_LLFF = "poses_bounds.npy"


def capture_file(path: Path, part: Literal["images", "cameras"], fault: Fault) -> Path:
    """The file itself, or of a folder what has its poses (`images`) or `cameras`; 7-Scenes' folder is both.

    Raises:
        fault: the folder has none.
    """
    if not path.is_dir() or is_seven_scenes(path):
        return path
    names = _TRANSFORMS if model_folder(path) is not None else (*_TRANSFORMS, _LLFF)
    whole = next((path / name for name in names if (path / name).is_file()), None)
    return whole or model_file(path, part, fault)
