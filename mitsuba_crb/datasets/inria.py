"""`cameras.json` of INRIA's Gaussian splatting: pinholes with their axis in the middle."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from ..camera import Intrinsics
from ..errors import CameraError
from .calibrations import Cameras
from .entries import number, required, whole
from .lens import calibrated


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
