"""The film's blocks, and pixels in the order in which their information is summed: square by square."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..errors import PixelsError

BLOCK = 8
"""Side [pixel] of the film blocks, on a fixed grid (x // 8, y // 8), whose pixels may share samples.

Smaller blocks would waste samples on what lies between them; with larger ones, a contour on a small image
would lie in so few that its variance, estimated from them, is itself too uncertain for intervals to cover."""


def in_squares(pixels: NDArray[np.integer], side: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Pixels (n, 2) square by square of so many pixels' side: first squares of one pixel, then those of two.

    Returns:
        (n,) Which pixel comes when; (squares + 1,) where each square starts, and n.

    Raises:
        PixelsError: a pixel comes twice.
    """
    pixels = pixels.astype(np.int64, copy=False)
    square = pixels // side
    column, row = square.T
    x, y = (pixels - side * square).T
    place = ((row << 32 | column) * side + y) * side + x
    order = np.argsort(place, kind="stable")
    place = place[order]
    if np.any(np.diff(place) == 0):
        raise PixelsError("a pixel was given twice in one call")
    sizes = np.diff(np.append(np.flatnonzero(np.diff(place // side**2, prepend=-1)), len(pixels)))
    few = np.minimum(sizes, 3).astype(np.uint8)
    sorted_sizes = sizes[np.argsort(few, kind="stable")]
    order = order[np.argsort(np.repeat(few, sizes), kind="stable")]
    return order, np.concatenate([[0], np.cumsum(sorted_sizes)])
