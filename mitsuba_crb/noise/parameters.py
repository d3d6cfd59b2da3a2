"""What parameters of noise models may be: positive numbers, maps over the image."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import NoiseError
from .protocol import Array


def positive(value: object, name: str, unit: str = "radiance") -> float:
    """A number whose square, and its inverse, are finite.

    Raises:
        NoiseError: it is none.
    """
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        raise NoiseError(f"{name} must be a positive number [{unit}], not {value!r}") from None
    # Outside of this range the inverse variance overflows or vanishes.
    if not 1e-150 < number < 1e150:
        raise NoiseError(f"{name} must be positive and finite [{unit}], not {number:g}")
    return number


def array(values: ArrayLike, name: str) -> Array:
    """A read-only copy in float64.

    Raises:
        NoiseError: it is no array of numbers.
    """
    try:
        copy = np.array(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise NoiseError(f"{name} expects an array of numbers: {error}") from None
    copy.flags.writeable = False
    return copy


def variance_map(variance: ArrayLike, name: str) -> Array:
    """(H, W) or (H, W, C) positive variances, infinite ones allowed.

    Raises:
        NoiseError: another shape, or a variance that is zero, negative or NaN.
    """
    values = array(variance, name)
    if values.ndim not in (2, 3) or values.size == 0:
        raise NoiseError(f"{name} expects variances of shape (H, W) or (H, W, C), not {values.shape}")
    bad = int(np.count_nonzero(~(values > 0.0)))
    if bad:
        raise NoiseError(f"{bad} of {values.size} variances are zero, negative or NaN; they must be positive")
    return values


def check_map(shape: tuple[int, ...], height: int, width: int, channels: int, what: str) -> None:
    """Refuse a map (H, W) or (H, W, C) of another image.

    Raises:
        NoiseError: the sizes differ.
    """
    if shape not in ((height, width), (height, width, channels)):
        raise NoiseError(
            f"the {what} has shape {shape}, but the image is {height} rows x {width} columns x {channels} "
            "channels"
        )


def at_pixels(values: Array, pixels: NDArray[np.integer], what: str) -> Array:
    """The rows values[y, x] of a map (H, W, ...).

    Raises:
        NoiseError: a pixel lies outside.
    """
    x, y = np.asarray(pixels).T
    height, width = values.shape[:2]
    if x.size and (min(x.min(), y.min()) < 0 or x.max() >= width or y.max() >= height):
        raise NoiseError(f"the {what} covers {width} x {height} pixels, but not pixel ({x.max()}, {y.max()})")
    return np.asarray(values[y, x], dtype=np.float64)
