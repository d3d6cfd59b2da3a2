"""Which part of the film gets how many paths."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..jacobian.method import Paths


@dataclass(frozen=True, eq=False)
class Plan:
    """Paths per pixel of each cell of the film, and whose random numbers they have."""

    spp: NDArray[np.int64]
    """(rows, columns), multiples of the number of batches."""
    side: int
    """Of the cells [pixel]: whole blocks, and whole tiles of nuisances that have one value in each."""
    seed: int
    """Of the round's random numbers."""
    before: int = 0
    """Paths of the rounds before it."""

    def efforts(self, mask: NDArray[np.bool_], batches: int) -> Iterator[tuple[Paths, NDArray[np.bool_]]]:
        """Each number of paths, and the pixels of a mask (H, W) that get so many."""
        spp = self.of_pixels(mask)
        for number in np.unique(spp[mask]):
            yield Paths(int(number), self.seed, batches), mask & (spp == number)

    def of_pixels(self, mask: NDArray[np.bool_]) -> NDArray[np.int64]:
        """(H, W) paths of every pixel of a film of a mask's shape."""
        height, width = mask.shape
        return self.spp.repeat(self.side, axis=0).repeat(self.side, axis=1)[:height, :width]

    def mean_spp(self, mask: NDArray[np.bool_]) -> float:
        """Paths per pixel of a mask (H, W), on average."""
        return float(self.of_pixels(mask)[mask].mean())
