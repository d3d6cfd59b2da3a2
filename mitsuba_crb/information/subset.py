"""Which pixels are measured: all, a random or gradient-rich fraction, or a mask; and their tiles.

A random subset *estimates* the whole image's information, so it is scaled up and its sampling variance
enters the standard errors. A mask or a gradient-rich subset *is* the measurement of an estimator that sees
only those pixels. `PixelSelection` says which (design section 5); where there is an estimator (`align`,
`trials`) every subset is its measurement, see `PixelSelection.only`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ..errors import PixelsError
from ..files import read_grey
from .blocks import BLOCK, in_squares
from .linearisation import PixelSelection


def everything(size: tuple[int, int]) -> PixelSelection:
    """The selection of every pixel of a width x height image."""
    total = size[0] * size[1]
    return PixelSelection("all", total, total, "all")


def telling(mask: NDArray[np.bool_], told: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The pixels of a mask (H, W) that tell anything; or its first, to tell nothing."""
    found = mask & told
    if not found.any():
        found.flat[np.argmax(mask)] = True
    return found


def is_mask(pixels: Any) -> bool:
    """Whether a choice names its pixels, for one size of image, instead of a fraction of them."""
    return not _is_all(pixels) and not (
        isinstance(pixels, str) and pixels.split(":")[0] in ("random", "gradient")
    )


def _is_all(pixels: Any) -> bool:
    return pixels is None or (isinstance(pixels, str) and pixels == "all")


def choose(
    pixels: Any,
    size: tuple[int, int],
    seed: int,
    pilot_image: Callable[[], NDArray[np.float64]],
    told: NDArray[np.bool_] | None = None,
) -> tuple[NDArray[np.bool_], PixelSelection]:
    """The pixels that a user asked for.

    Args:
        pixels: None or "all", "random:f", "gradient:f" with 0 < f ≤ 1, a boolean array (H, W), or the path
            of a mask image (white where measured).
        size: width and height [pixel].
        seed: of the random choice.
        pilot_image: gives an image (H, W, 3) whose gradients are ranked; called only for "gradient:f".
        told: (H, W) pixels that measure anything, of which alone "gradient:f" takes any; None: all.

    Returns:
        Mask (H, W), and what it means.

    Raises:
        PixelsError: none of these, a fraction outside (0, 1], a mask that is empty or of another size.
    """
    whole = everything(size)
    width, height = size
    if _is_all(pixels):
        return np.ones((height, width), dtype=bool), whole
    if not is_mask(pixels):
        rule, count = _parse_fraction(pixels, whole.total)
        if count == whole.total:
            return np.ones((height, width), dtype=bool), whole
        if rule == "random":
            chosen = np.random.default_rng(seed).choice(whole.total, count, replace=False, shuffle=False)
        else:
            gradient = _gradient(pilot_image())
            gradient = gradient if told is None else np.where(told, gradient, -1.0)
            chosen = np.argsort(-gradient.ravel(), kind="stable")[:count]
        mask = np.zeros(whole.total, dtype=bool)
        mask[chosen] = True
        return mask.reshape(height, width), PixelSelection(
            "random" if rule == "random" else "only", whole.total, count, pixels
        )
    mask, description = read_mask(pixels, (height, width))
    return mask, PixelSelection("only", whole.total, int(mask.sum()), description)


def _gradient(image: NDArray[np.float64]) -> NDArray[np.float64]:
    """Squared image gradient at the scale of one pixel, where a pilot's noise does not outweigh it."""
    magnitude = ndimage.gaussian_gradient_magnitude(image, sigma=1.0, axes=(0, 1), mode="nearest")
    return np.asarray(np.sum(magnitude**2, axis=2))


def _parse_fraction(text: str, total: int) -> tuple[str, int]:
    rule, _, number = text.partition(":")
    try:
        fraction = float(number)
    except ValueError:
        fraction = np.nan
    if not 0.0 < fraction <= 1.0:
        raise PixelsError(f"{text!r}: the fraction must lie in (0, 1], for example {rule}:0.1")
    return rule, max(1, round(fraction * total))


def read_mask(pixels: Any, shape: tuple[int, int]) -> tuple[NDArray[np.bool_], str]:
    """A mask of this shape (height, width), from an array or an image's path, and what to call it."""
    description = "mask"
    if isinstance(pixels, str | os.PathLike):
        path = Path(pixels)
        description = path.name
        if not os.path.lexists(path):
            raise PixelsError(
                f"pixels {str(pixels)!r} is neither random:f, gradient:f nor the path of a mask image"
            )
        pixels = read_grey(path, PixelsError) > 127
    mask = np.asarray(pixels)
    if mask.dtype != bool:
        raise PixelsError(f"a mask is a boolean array; got {mask.dtype}")
    if mask.shape != shape:
        raise PixelsError(
            f"the mask is {' x '.join(map(str, mask.shape[::-1]))}, the image {shape[1]} x {shape[0]} "
            "(width x height)"
        )
    if not mask.any():
        raise PixelsError("the mask is empty: no pixel is white")
    return mask, description


def selected(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Columns and rows (n, 2) of a mask's pixels, row by row."""
    rows, columns = np.divmod(np.flatnonzero(mask), mask.shape[1])
    return np.stack([columns, rows], axis=1).astype(np.int64, copy=False)


def tiles(mask: NDArray[np.bool_], tile: int) -> Iterator[NDArray[np.int64]]:
    """The selected pixels (n, 2) of one tile after the other, of several at once where few are selected.

    In the order in which flow's information sums them up, block by block, each row by row. Several tiles are
    at most a third of what is left, so that a part is summed up while the next one's paths are traced and the
    last is small; but up to an eighth of a tile, for each part has its price, and no more than a whole one.
    """
    height, width = mask.shape
    left = int(np.count_nonzero(mask))
    held: list[NDArray[np.int64]] = []
    for y in range(0, height, tile):
        for x in range(0, width, tile):
            pixels = selected(mask[y : y + tile, x : x + tile])
            count = sum(map(len, held))
            if held and count + len(pixels) > min(tile * tile, max(tile * tile // 8, left // 3)):
                yield _by_block(held)
                held, left = [], left - count
            if len(pixels):
                held.append(pixels + np.array([x, y]))
    if held:
        yield _by_block(held)


def _by_block(parts: list[NDArray[np.int64]]) -> NDArray[np.int64]:
    pixels = np.concatenate(parts)
    return pixels[in_squares(pixels, BLOCK)[0]]
