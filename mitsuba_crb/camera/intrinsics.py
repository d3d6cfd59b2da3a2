"""What a calibration file says of a camera: its image, its lens model and their numbers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..errors import CameraError, OptionError
from ..files import Record


def image_size(size: Any) -> tuple[int, int]:
    """Width and height [pixel] as whole numbers.

    Raises:
        OptionError: they are none, or not positive.
    """
    try:
        width, height = (int(value) for value in size)
    except (TypeError, ValueError, OverflowError) as error:
        raise OptionError(f"size must be two whole numbers, width and height; got {size!r}") from error
    if width <= 0 or height <= 0:
        raise OptionError(f"size must be positive; got {width}x{height}")
    return width, height


LENS_MODELS: dict[str, tuple[str, ...]] = {
    "pinhole": (),
    "opencv": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}
"""Their coefficients, in OpenCV's order."""


@dataclass(frozen=True)
class Intrinsics(Record):
    """What a calibration says of a camera.

    A point (X, Y, Z) in axes x right, y down, z forward lands at v = centre + focal · D(X/Z, Y/Z) [pixel]
    from the image's upper left corner, D the lens model's distortion. With r² = x² + y² and θ = arctan r,

        opencv   D = (x, y) (1 + k1 r² + k2 r⁴ + k3 r⁶)/(1 + k4 r² + k5 r⁴ + k6 r⁶)
                     + (2 p1 x y + p2 (r² + 2 x²), p1 (r² + 2 y²) + 2 p2 x y)
        fisheye  D = (x, y)/r θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸)

    as in OpenCV; COLMAP's SIMPLE_RADIAL, RADIAL, OPENCV, FULL_OPENCV and fisheyes are instances.

    Raises:
        CameraError: a value is not finite, a focal length not positive, or the model and its coefficients do
            not fit.
    """

    size: tuple[int, int]
    """Width and height of the image [pixel]."""
    focal: tuple[float, float]
    """fx, fy [pixel]."""
    centre: tuple[float, float]
    """cx, cy [pixel], where the first pixel's centre is at (0.5, 0.5)."""
    model: str = "pinhole"
    """A name in `LENS_MODELS`."""
    distortion: tuple[float, ...] = ()
    """The model's coefficients, in the order of `LENS_MODELS`."""

    def __post_init__(self) -> None:
        if self.model not in LENS_MODELS:
            raise CameraError(f"lens model {self.model!r} is not known; known: {', '.join(LENS_MODELS)}")
        names = LENS_MODELS[self.model]
        if len(self.distortion) != len(names):
            raise CameraError(
                f"lens model {self.model} has {len(names)} coefficients ({', '.join(names)}), not "
                f"{len(self.distortion)}"
            )
        object.__setattr__(self, "size", image_size(self.size))
        for name, length in (("focal", 2), ("centre", 2), ("distortion", len(names))):
            values = tuple(float(value) for value in getattr(self, name))
            if len(values) != length or not np.isfinite(values).all():
                raise CameraError(f"{name} must be {length} finite numbers; got {getattr(self, name)!r}")
            object.__setattr__(self, name, values)
        if min(self.focal) <= 0.0:
            raise CameraError(f"focal lengths must be positive [pixel]; got {self.focal}")

    @property
    def distorts(self) -> bool:
        """Whether the lens bends anything: a pinhole and OpenCV's model without coefficients do not."""
        return self.model == "fisheye" or any(self.distortion)

    @property
    def parameters(self) -> dict[str, float]:
        """Every number by its name: fx, fy, cx, cy [pixel], and the model's coefficients."""
        names = ("fx", "fy", "cx", "cy", *LENS_MODELS[self.model])
        return dict(zip(names, (*self.focal, *self.centre, *self.distortion), strict=True))

    @property
    def plain_fov_deg(self) -> float:
        """Horizontal field of view of the film without the lens' distortion [deg]."""
        return float(np.degrees(2.0 * np.arctan(0.5 * self.size[0] / self.focal[0])))

    @property
    def words(self) -> str:
        """The coefficients that are not zero."""
        names = LENS_MODELS[self.model]
        found = [f"{n} = {k:.4g}" for n, k in zip(names, self.distortion, strict=True) if k]
        return ", ".join(found) or "no coefficients"

    def __str__(self) -> str:
        (width, height), (fx, fy), (cx, cy) = self.size, self.focal, self.centre
        lens = "pinhole" if self.model == "pinhole" else f"{self.model} lens, {self.words}"
        return f"{width}×{height} pixels, fx = {fx:.6g}, fy = {fy:.6g}, cx = {cx:.6g}, cy = {cy:.6g}; {lens}"

    def moved(self, name: str, by: float) -> Intrinsics:
        """The same with one of `parameters` changed."""
        fx, fy, cx, cy, *distortion = (self.parameters | {name: self.parameters[name] + by}).values()
        return replace(self, focal=(fx, fy), centre=(cx, cy), distortion=tuple(distortion))

    def scaled(self, size: tuple[int, int]) -> Intrinsics:
        """Those of the same image in other pixels.

        Raises:
            CameraError: it has another shape.
        """
        (width, height), (across, down) = size, self.size
        # As close to the image's shape as whole pixels can be.
        if abs(width * down - height * across) >= max(across, down):
            raise CameraError(
                f"the calibration is of {across}x{down} pixels, and {width}x{height} is another shape: give "
                "a size of the same, or the calibration of the cropped image"
            )
        x, y = width / across, height / down
        focal = (self.focal[0] * x, self.focal[1] * y)
        return replace(self, size=size, focal=focal, centre=(self.centre[0] * x, self.centre[1] * y))
