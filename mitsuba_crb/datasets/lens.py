"""Lens models by the names that other tools give them, and what each calls its parameters.

Every reader of calibrations ends here: numbers by name become `Intrinsics`, whose pixel origin is the image's
upper left corner. COLMAP, instant-ngp and nerfstudio count likewise; OpenCV, ROS and Kalibr count from the
first pixel's centre, which is our (0.5, 0.5): their readers add `HALF`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from difflib import get_close_matches

from ..camera import LENS_MODELS, Intrinsics
from ..errors import CameraError, OptionError

HALF = 0.5
"""What is added to a principal point that is counted from the first pixel's centre [pixel]."""

COLMAP_MODELS: dict[str, tuple[str, str]] = {
    "SIMPLE_PINHOLE": ("pinhole", "f cx cy"),
    "PINHOLE": ("pinhole", "fx fy cx cy"),
    "SIMPLE_RADIAL": ("opencv", "f cx cy k1"),
    "RADIAL": ("opencv", "f cx cy k1 k2"),
    "OPENCV": ("opencv", "fx fy cx cy k1 k2 p1 p2"),
    "OPENCV_FISHEYE": ("fisheye", "fx fy cx cy k1 k2 k3 k4"),
    "FULL_OPENCV": ("opencv", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    "SIMPLE_RADIAL_FISHEYE": ("fisheye", "f cx cy k1"),
    "RADIAL_FISHEYE": ("fisheye", "f cx cy k1 k2"),
    "SIMPLE_FISHEYE": ("fisheye", "f cx cy"),
    "FISHEYE": ("fisheye", "fx fy cx cy"),
}
"""COLMAP's models that are instances of ours: our name, and what each calls its parameters, in its order."""


def calibrated(
    where: str,
    *,
    size: Sequence[int],
    focal: Sequence[float],
    centre: Sequence[float],
    model: str = "pinhole",
    coefficients: Mapping[str, float] | None = None,
) -> Intrinsics:
    """Intrinsics from coefficients by name; those that are not named are zero.

    Args:
        where: what messages begin with.
        size: width and height [pixel].
        focal: fx, fy [pixel].
        centre: cx, cy [pixel] from the image's corner.
        model: a name in `LENS_MODELS`.
        coefficients: of the lens.

    Raises:
        CameraError: they make no camera, or the model has no such coefficient (unless it is zero).
    """
    given = coefficients or {}
    names = LENS_MODELS.get(model, ())
    for name, value in given.items():
        if model in LENS_MODELS and name not in names and value != 0.0:
            known = ", ".join(names) or "none"
            raise CameraError(f"{where}: the lens model {model} has no coefficient {name}; it has {known}")
    try:
        return Intrinsics(
            size=(size[0], size[1]),
            focal=(focal[0], focal[1]),
            centre=(centre[0], centre[1]),
            model=model,
            distortion=tuple(given.get(name, 0.0) for name in names),
        )
    except (CameraError, OptionError) as error:
        raise CameraError(f"{where}: {error}") from None


def colmap_intrinsics(where: str, model: str, size: Sequence[int], values: Sequence[float]) -> Intrinsics:
    """Intrinsics from a model of COLMAP's and its parameters, in COLMAP's order.

    Raises:
        CameraError: the model is none of `COLMAP_MODELS`, or the parameters do not fit it.
    """
    if model not in COLMAP_MODELS:
        raise unknown_model(where, model, COLMAP_MODELS)
    ours, parameters = COLMAP_MODELS[model]
    names = parameters.split()
    if len(values) != len(names):
        raise CameraError(
            f"{where}: {model} has {len(names)} parameters ({', '.join(names)}), not {len(values)}"
        )
    named = dict(zip(names, values, strict=True))
    focal = [named.pop(name, named.get("f", 0.0)) for name in ("fx", "fy")]
    named.pop("f", None)
    centre = [named.pop(name) for name in ("cx", "cy")]
    return calibrated(where, size=size, focal=focal, centre=centre, model=ours, coefficients=named)


def unknown_model(where: str, model: str, known: Mapping[str, object]) -> CameraError:
    """The refusal of a lens model, with the near ones."""
    near = get_close_matches(model, known, 3, 0.5)
    others = f"near ones that are: {', '.join(near)}" if near else f"known: {', '.join(known)}"
    return CameraError(
        f"{where}: the lens model {model!r} is not known; {others}; calibrate with one of them, or undistort "
        "the images"
    )
