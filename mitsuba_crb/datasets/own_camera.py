"""Our own cameras in TOML: a table for the camera, or a table with a name for each of several.

size = [640, 480]
focal = [525.0, 525.5]   # [pixel]; one number if they are equal
centre = [320.0, 240.0]  # [pixel] from the image's upper left corner; default: the image's middle
model = "opencv"         # or "fisheye" or "pinhole", the default
k1 = -0.12               # the model's coefficients by name; those left out are zero
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from ..camera import LENS_MODELS, Intrinsics
from ..errors import CameraError
from ..files import Table, checked, expected
from .calibrations import Cameras
from .lens import calibrated, unknown_model

_Pair = Annotated[list[float], Field(min_length=2, max_length=2)]


class _Camera(Table):
    """A camera's table."""

    size: Annotated[
        list[int], Field(min_length=2, max_length=2), expected("[width, height], two whole numbers of pixels")
    ]
    focal: Annotated[float | _Pair, expected("[fx, fy] or one number [pixel]")]
    centre: Annotated[_Pair | None, expected("[cx, cy] [pixel]")] = None
    model: str = "pinhole"
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0


def own_cameras(document: dict[str, Any], path: Path) -> Cameras:
    """The cameras in a TOML document, by name."""
    if document and all(isinstance(value, dict) for value in document.values()):
        return {name: partial(_own, value, f"{path}: [{name}]") for name, value in document.items()}
    return {"": partial(_own, document, str(path))}


def _own(document: dict[str, Any], where: str) -> Intrinsics:
    camera = checked(_Camera, document, CameraError, where)
    if camera.model not in LENS_MODELS:
        raise unknown_model(where, camera.model, LENS_MODELS)
    given = camera.model_dump(exclude_unset=True, exclude={"size", "focal", "centre", "model"})
    return calibrated(
        where,
        size=camera.size,
        focal=camera.focal if isinstance(camera.focal, list) else [camera.focal, camera.focal],
        centre=camera.centre or [0.5 * side for side in camera.size],
        model=camera.model,
        coefficients=given,
    )
