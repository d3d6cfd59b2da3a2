"""Cameras that calibration tools write: OpenCV (YAML, XML, JSON), ROS `camera_info`, Kalibr, EuRoC.

All of them count pixels from the first one's centre, so that half a pixel is added to their principal points.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from ..camera import Intrinsics
from ..errors import CameraError
from ..files import read_text
from .entries import number, numbers, required, whole
from .lens import HALF, calibrated, unknown_model

Cameras = dict[str, Callable[[], Intrinsics]]
"""By name, each made when it is asked for: a file may hold a lens beside others that is not known here."""

_PLAIN = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_FISHEYE = ("k1", "k2", "k3", "k4")
_MODELS: dict[str, tuple[str, tuple[str, ...]]] = {
    "none": ("pinhole", ()),
    "plumb_bob": ("opencv", _PLAIN[:5]),
    "rational_polynomial": ("opencv", _PLAIN),
    "equidistant": ("fisheye", _FISHEYE),
    "equi": ("fisheye", _FISHEYE),
    "fisheye": ("fisheye", _FISHEYE),
    "radtan": ("opencv", _PLAIN[:4]),
    "radial-tangential": ("opencv", _PLAIN[:4]),
}
"""Distortion models of ROS, Kalibr and EuRoC: our name, and their coefficients in their order."""


def read_xml(path: Path) -> Any:
    """OpenCV's XML as the same table that its YAML would give.

    Raises:
        CameraError: it is no XML, or none of OpenCV's.
    """
    try:
        root = ElementTree.fromstring(read_text(path, CameraError))
    except ElementTree.ParseError as error:
        raise CameraError(f"{path} is no XML: {error}") from None
    if root.tag != "opencv_storage":
        raise CameraError(f"{path} is XML, but its root is <{root.tag}>, not OpenCV's <opencv_storage>")
    return _of_element(root)


def calibrated_cameras(document: Any, path: Path) -> Cameras | None:
    """The cameras in a document of one of these tools, by name; None if it is of none of them.

    Args:
        document: nested tables and lists, their numbers possibly as texts.
        path: for messages.
    """
    if not isinstance(document, Mapping):
        return None
    found = {str(key).lower(): value for key, value in document.items()}
    chain = {
        str(key): value
        for key, value in document.items()
        if isinstance(value, Mapping) and ("camera_model" in value or "intrinsics" in value)
    }
    if chain:
        return {key: partial(_chained, value, f"{path}: {key}") for key, value in chain.items()}
    if "intrinsics" in found and "camera_model" in found:
        return {str(found.get("comment", "")): partial(_chained, found, str(path))}
    if _matrix_key(found) is not None:
        return {str(found.get("camera_name", "")): partial(_with_matrix, found, str(path))}
    return None


def _chained(section: Mapping[str, Any], where: str) -> Intrinsics:
    """Of Kalibr's chain, or EuRoC's `sensor.yaml`."""
    camera_model = str(required(section, "camera_model", where, CameraError))
    if camera_model.lower() != "pinhole":
        raise unknown_model(where, camera_model, {"pinhole": None})
    model, names = _model(str(section.get("distortion_model", "none")), where)
    given = section.get("distortion_coeffs", section.get("distortion_coefficients", []))
    sides, values = (
        numbers(required(section, key, where, CameraError), f"{where}: {key}", CameraError, count)
        for key, count in (("resolution", 2), ("intrinsics", 4))
    )
    return calibrated(
        where,
        size=[whole(side, f"{where}: resolution", CameraError) for side in sides],
        focal=values[:2],
        centre=[value + HALF for value in values[2:]],
        model=model,
        coefficients=_coefficients(names, numbers(given, f"{where}: its distortion", CameraError), where),
    )


def _with_matrix(found: Mapping[str, Any], where: str) -> Intrinsics:
    """Of OpenCV or ROS, keys in small letters."""
    key = str(_matrix_key(found))
    matrix = _array(found[key], f"{where}: {key}")
    if len(matrix) != 9:
        raise CameraError(f"{where}: {key} has {len(matrix)} numbers, not the 9 of a 3x3 matrix")
    fx, skew, cx, below, fy, cy, *last = matrix
    if skew or below or last != [0.0, 0.0, 1.0]:
        raise CameraError(
            f"{where}: {key} is not [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; is it transposed, or skewed?"
        )
    distortion = next((name for name in _DISTORTIONS if name in found), None)
    given = [] if distortion is None else _array(found[distortion], f"{where}: {distortion}")
    if "distortion_model" in found:
        model, names = _model(str(found["distortion_model"]), where)
    elif _flag(found.get("fisheye_model", found.get("fisheye", "0"))):
        model, names = "fisheye", _FISHEYE
    else:
        model, names = ("opencv", _PLAIN) if given else ("pinhole", ())
    _whole_image(found, where)
    return calibrated(
        where,
        size=_size(found, where),
        focal=[fx, fy],
        centre=[cx + HALF, cy + HALF],
        model=model,
        coefficients=_coefficients(names, given, where),
    )


_MATRICES = ("camera_matrix", "cameramatrix", "intrinsic_matrix", "k", "mtx")
_DISTORTIONS = (
    "distortion_coefficients",
    "distortion_coeffs",
    "distcoeffs",
    "dist_coeffs",
    "distortion",
    "dist",
    "d",
)
"""What tools, and the samples of OpenCV's own, call them, in small letters."""


def _matrix_key(found: Mapping[str, Any]) -> str | None:
    return next((name for name in _MATRICES if name in found), None)


def _model(name: str, where: str) -> tuple[str, tuple[str, ...]]:
    lowered = name.strip().lower() or "none"
    if lowered not in _MODELS:
        raise unknown_model(where, name, _MODELS)
    return _MODELS[lowered]


def _coefficients(names: Sequence[str], given: Sequence[float], where: str) -> dict[str, float]:
    """Coefficients by name; further ones must be zero, such as those of OpenCV's thin prism."""
    if any(given[len(names) :]):
        raise CameraError(
            f"{where}: {len(given)} coefficients of distortion, of which {len(names)} are known here "
            f"({', '.join(names) or 'none'}); calibrate without the others, or undistort the images"
        )
    return dict(zip(names, given, strict=False))


def _size(found: Mapping[str, Any], where: str) -> list[int]:
    if "image_size" in found:
        sides = _array(found["image_size"], f"{where}: image_size")
        if len(sides) != 2:
            raise CameraError(f"{where}: image_size must be width and height, not {len(sides)} numbers")
        return [whole(side, f"{where}: image_size", CameraError) for side in sides]
    size = []
    for side in ("width", "height"):
        key = next((name for name in (f"image_{side}", side) if name in found), None)
        if key is None:
            raise CameraError(f"{where} does not say the image's size; add image_width and image_height")
        size.append(whole(found[key], f"{where}: {key}", CameraError))
    return size


def _whole_image(found: Mapping[str, Any], where: str) -> None:
    """Refuses ROS's parts of an image, whose pixels are not those of the matrix."""
    region = found.get("roi", {})
    offset = [region.get(key, "0") for key in ("x_offset", "y_offset")] if isinstance(region, Mapping) else []
    binning = [found.get(key, "0") for key in ("binning_x", "binning_y")]
    if any(number(value, f"{where}: roi", CameraError) for value in offset):
        raise CameraError(f"{where} is of a region of the image (roi); give the whole image's calibration")
    if any(number(value, f"{where}: binning", CameraError) > 1.0 for value in binning):
        raise CameraError(f"{where} is of binned pixels; give the calibration of the image itself")


def _array(value: Any, where: str) -> list[float]:
    """The numbers of a matrix: a table with `data`, nested lists, or a list."""
    if isinstance(value, Mapping):
        value = required(value, "data", where, CameraError)
    if isinstance(value, str):  # XML's
        value = value.split()
    if isinstance(value, list) and value and all(isinstance(row, list) for row in value):
        value = [entry for row in value for entry in row]
    return numbers(value, where, CameraError)


def _flag(value: Any) -> bool:
    return str(value).strip().lower() in ("1", "true", "yes")


def _of_element(element: ElementTree.Element) -> Any:
    """Tables for elements that have parts, texts for the others."""
    if len(element) == 0:
        return (element.text or "").strip()
    return {part.tag: _of_element(part) for part in element}
