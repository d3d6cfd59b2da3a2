"""The image that noise depends on, from pilot renders whose errors are not the Jacobian's.

Noise that every mean changes needs a pilot of all pixels, about as dear as the derivatives. Noise that
changes at a threshold alone (`ThresholdNoise`) does not: a coarse render of the whole image says where the
threshold may lie within reach, and only there is the pilot traced; once, whatever rounds of paths there are.

Beside what is many times as bright as white, a few paths decide whether a pixel is saturated, and the few of
the Jacobian's that hit a lamp would tell thousands of standard deviations where the pilot's missed it. Such
pixels glare, as in a camera: of what the brightest neighbour exceeds white by, a twentieth is added to them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ..information import subset
from ..jacobian.method import Paths
from ..noise import IndependentNoise, ThresholdNoise
from ..render.random import PILOT

if TYPE_CHECKING:
    from .measurable import Measurable

PILOT_SPP = 16
"""Paths per pixel of a pilot render, at least."""

_COARSE_SPP = 4
_REACH = 2  # pixels to each side, of the widest reconstruction filters in use
_GLARE = 0.05


@dataclass(frozen=True)
class ExpectedImage:
    """Of a view, by random numbers of its own."""

    view: Measurable
    seed: int
    tile: int
    """Side of the tiles in which the whole image is rendered [pixel]."""

    def of(
        self, pixels: NDArray[np.int64], mean: NDArray[np.float64], noise: IndependentNoise | None, spp: int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(n, 3) at some pixels (n, 2); the Jacobian's own `mean` (n, 3) where a pilot is not finite.

        And (n, 3) half of what two halves of the pilot differ by, 0 where no pilot is needed.

        Args:
            noise: what it is for; None: any, so that every pixel has a full pilot.
            spp: paths per pixel of the Jacobian there.
        """
        if not isinstance(noise, ThresholdNoise):
            return self._pilot(pixels, max(PILOT_SPP, spp), mean)
        coarse = self.coarse[pixels[:, 1], pixels[:, 0]]
        lowest, highest = (values[pixels[:, 1], pixels[:, 0]] for values in self._ranges)
        near = noise.near_threshold(lowest, highest)
        expected, error = np.where(np.isfinite(coarse), coarse, mean), np.zeros_like(mean)
        if near.any():
            spp = max(PILOT_SPP, spp // 4)  # pixels at white are few, and the noise smooths white anyway
            image, error[near] = self._pilot(pixels[near], spp, mean[near], kept=spp == PILOT_SPP)
            expected[near] = image + _GLARE * noise.excess(highest[near])
        return expected, error

    @cached_property
    def coarse(self) -> NDArray[np.float64]:
        """(H, W, 3) the whole image by few paths."""
        return whole_pilot(self.view, Paths(_COARSE_SPP, self.seed, 1), self.tile, even=True)

    @cached_property
    def _ranges(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(H, W, 3) the least and the largest coarse values within reach of each pixel, where finite."""
        wide = (2 * _REACH + 1, 2 * _REACH + 1, 1)
        lowest, highest = (np.where(np.isnan(self.coarse), other, self.coarse) for other in (np.inf, -np.inf))
        lowest = ndimage.minimum_filter(lowest, wide, mode="nearest")
        return lowest, np.maximum(ndimage.maximum_filter(highest, wide, mode="nearest"), 0.0)

    @cached_property
    def _kept(self) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """(H, W) of which pixels there is a pilot of the least paths, and (H, W, 2, 3) its halves there."""
        width, height = self.view.size
        return np.zeros((height, width), dtype=bool), np.empty((height, width, 2, 3))

    def _pilot(
        self, pixels: NDArray[np.int64], spp: int, mean: NDArray[np.float64], *, kept: bool = False
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """As `of`; `kept`, those of the least paths, for whoever asks for a pixel again."""
        if kept:
            known, halves = self._kept
            column, row = pixels.T
            new = ~known[row, column]
            if new.any():
                halves[row[new], column[new]] = self._halves(pixels[new], spp).transpose(1, 0, 2)
                known[row[new], column[new]] = True
            one, other = halves[row, column].transpose(1, 0, 2)
        else:
            one, other = self._halves(pixels, spp)
        image, error = 0.5 * (one + other), 0.5 * (one - other)
        good = np.isfinite(image)
        return np.where(good, image, mean), np.where(good, error, 0.0)

    def _halves(self, pixels: NDArray[np.int64], spp: int) -> NDArray[np.float64]:
        """(2, n, 3) the image by half of the paths each."""
        paths = Paths(2 * -(-spp // 2), self.seed, 2)
        return self.view.start_image(pixels, paths, purpose=PILOT, even=True)()


def whole_pilot(view: Measurable, paths: Paths, tile: int, *, even: bool = False) -> NDArray[np.float64]:
    """(H, W, 3) a pilot render of every pixel."""
    width, height = view.size
    image = np.empty((height, width, 3))
    for part in subset.tiles(np.ones((height, width), dtype=bool), tile):
        image[part[:, 1], part[:, 0]] = view.start_image(part, paths, purpose=PILOT, even=even)()[0]
    return image
