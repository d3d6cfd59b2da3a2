"""A grid of tiles on an image, and every tile's information from each half of the batches.

With h_kl = sym(J_kᵀ W J_l) summed over a tile's pixels, the mean over pairs k < l of the first half of
batches and the mean over pairs of the second are two independent, unbiased estimates of the tile's
information: one to choose tiles by, the other to report what they are worth (`selection`). Sums over pixels
may come in parts of any shape, so that tiles of any size follow from one streaming pass.
"""

from __future__ import annotations

from itertools import combinations
from numbers import Integral

import numpy as np
from numpy.typing import NDArray

from ..errors import OptionError
from ..information.accumulate import MINIMUM_BATCHES
from ..information.symmetric import unpack
from ..information.ustatistic import square_root, unit_grams, unit_products, whiten
from ..se3 import Array

MINIMUM_HALVED_BATCHES = 2 * MINIMUM_BATCHES
"""Each half is an estimate of its own, with as many batches as any other."""


class TileGrid:
    """Adds up the information of tiles whose corners are multiples of one size; those at the rim are cut."""

    def __init__(
        self, size: tuple[int, int], tile_size: int | tuple[int, int], *, batches: int, sampled: bool = False
    ) -> None:
        """Start from nothing.

        Args:
            size: width and height of the image [pixel].
            tile_size: side, or width and height, of the tiles [pixel]; it may exceed the image.
            batches: K, independent estimates per pixel.
            sampled: the pixels are a random sample that stands for the whole image, so that a tile without
                any is estimated, too, as nothing.

        Raises:
            OptionError: a size that is no positive whole number, or too few batches for two halves.
        """
        if batches < MINIMUM_HALVED_BATCHES:
            raise OptionError(
                f"tiles are chosen by half of the batches and reported by the other half: batches must be at "
                f"least {MINIMUM_HALVED_BATCHES}, not {batches}"
            )
        self._width, self._height = size
        self._tile_width, self._tile_height = _checked(tile_size)
        self._columns = -(-self._width // self._tile_width)
        self._rows = -(-self._height // self._tile_height)
        self._batches = batches
        self._sampled = sampled
        self._sums = np.zeros((batches * (batches - 1) // 2, 21, self._rows * self._columns))
        self._count = np.zeros(self._rows * self._columns, dtype=np.int64)

    def add(self, batch_values: Array, weights: Array, pixels: NDArray[np.integer]) -> None:
        """Add some pixels, each once.

        Args:
            batch_values: (K, n, C, 6), independent estimates of ∂I/∂ξ.
            weights: (n, C) or (n, C, C), inverse noise variances.
            pixels: (n, 2), column x and row y.
        """
        if len(pixels) == 0:
            return
        x, y = pixels.T
        tile = y // self._tile_height * self._columns + x // self._tile_width
        order = np.lexsort((x, y, tile))
        starts = np.append(np.flatnonzero(np.diff(tile[order], prepend=-1)), len(order))
        touched, counts = np.unique(tile, return_counts=True)
        grams = unit_grams(whiten(batch_values[:, order], square_root(weights[order])), starts)
        self._sums[:, :, touched] += unit_products(grams, len(batch_values))
        self._count[touched] += counts

    @property
    def tiles(self) -> NDArray[np.int64]:
        """(T, 4), x, y, width and height of the tiles that were measured [pixel]."""
        row, column = np.divmod(self._measured, self._columns)
        x, y = column * self._tile_width, row * self._tile_height
        width = np.minimum(self._tile_width, self._width - x)
        height = np.minimum(self._tile_height, self._height - y)
        return np.column_stack([x, y, width, height]).astype(np.int64)

    def halves(self, scale: Array, *, factor: float = 1.0) -> tuple[Array, Array]:
        """Two independent estimates (T, 6, 6) of the tiles' information.

        Args:
            scale: (6,), units of the twist that it is about, in the derivatives' own.
            factor: pixels of the image per pixel added.
        """
        middle = self._batches // 2
        pairs = list(combinations(range(self._batches), 2))
        first = [k < middle and j < middle for k, j in pairs]
        second = [k >= middle and j >= middle for k, j in pairs]
        select, report = (
            factor * scale[:, None] * unpack(self._sums[half][:, :, self._measured].mean(axis=0).T) * scale
            for half in (first, second)
        )
        return select, report

    @property
    def _measured(self) -> NDArray[np.intp]:
        return np.arange(len(self._count)) if self._sampled else np.flatnonzero(self._count)


def _checked(tile_size: int | tuple[int, int]) -> tuple[int, int]:
    sides = (tile_size, tile_size) if isinstance(tile_size, Integral) else tile_size
    if not (
        isinstance(sides, tuple | list)
        and len(sides) == 2
        and all(isinstance(side, Integral) and not isinstance(side, bool) and side > 0 for side in sides)
    ):
        raise OptionError(
            f"a tile's size is a positive whole number of pixels, or its width and height, not {tile_size!r}"
        )
    return int(sides[0]), int(sides[1])
