"""Closure: a constant picture does not change, so `flow` of L = 1 without baseline must add up to zero.

R_ku, of batch k and pixel u, is that picture's filter and parallax terms, in translation's three columns (a
pinhole's rotation closes by itself). They need no radiance, and every discontinuity of the film flow that the
contours miss or count twice is in their mean. Over the pixels of a block, batches being independent,

    U = Σ_u mean over k < l of R_ku·R_lu,    E U = |E R|²,    Var U = 2/(K (K−1)) tr(Σ²)   where E R = 0,

R the block's, Σ its covariance. tr(Σ²) is the larger of two estimates, for four batches say little of either:
as if pixels were independent, and without that (Himeno and Yamada 2014, which is free of E R).

All tiles are screened by the batches at hand. A block is suspect if U exceeds `SUSPICION` standard errors and
if the breach would matter: times the block's contrast, the largest error of L − Ī, it reaches `SHARE` of the
block's own derivative. Suspects are measured again with more batches and random numbers of their own, which
alone decide, by `LIMIT`. This tests the geometry of the flow: neither the view term, nor media, nor on which
side L_bg is taken. Source: design section 4.1.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ..information.blocks import BLOCK

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

SUSPICION, LIMIT = 3.0, 4.0
"""Standard errors of a block's U beyond which it is measured again, and beyond which its flow is wrong."""
SHARE = 0.01
"""Least error of a block's derivative, over the derivative, that is worth a block's finite differences."""
BATCHES, PATHS = 16, 16
"""Of suspects: batches, and the least paths of each, which is otherwise those of a batch that suspected."""


@dataclass(frozen=True)
class FilmBlocks:
    """The film blocks that some pixels belong to."""

    home: Ints
    """(n,) place of each pixel's block among them."""
    number: Ints
    """(blocks,) of each in the whole film, in ascending order."""

    @staticmethod
    def of(pixels: Ints) -> FilmBlocks:
        """Of pixels (n, 2)."""
        row, column = pixels[:, 1] // BLOCK, pixels[:, 0] // BLOCK
        number, home = np.unique(row << 32 | column, return_inverse=True)
        return FilmBlocks(home, number)

    def sum(self, values: Floats) -> Floats:
        """(blocks,) of values (n,)."""
        return np.asarray(np.bincount(self.home, values, len(self.number)), dtype=np.float64)

    def any(self, which: Bools) -> Bools:
        """(blocks,) whether a block has one."""
        return self.sum(which.astype(np.float64)) > 0.0

    def range(self, values: Floats) -> Floats:
        """(blocks,) largest less smallest of values (n, C), over the channels the largest."""
        low, high = (np.full((len(self.number), values.shape[1]), sign * np.inf) for sign in (1.0, -1.0))
        np.minimum.at(low, self.home, values)
        np.maximum.at(high, self.home, values)
        return np.asarray((high - low).max(axis=1))


def suspects(residual: Floats, columns: Floats, image: Floats, blocks: FilmBlocks) -> Bools:
    """(blocks,) where the flow's terms may not close, and where that would matter.

    Args:
        residual: (K, n, 3) R [1/scene unit].
        columns: (K, n, C, 3) the derivative in translation [radiance / scene unit].
        image: (n, C) radiance.
        blocks: of the n pixels.
    """
    square, error = _squares(residual, blocks)
    suspect = square > SUSPICION * error
    if not suspect.any():
        return suspect
    change = square * blocks.range(image) ** 2
    return np.asarray(suspect & (change > SHARE**2 * blocks.sum(_square(columns))))


def breaches(residual: Floats, blocks: FilmBlocks) -> Bools:
    """(blocks,) where the flow's terms do not close; `residual` as for `suspects`."""
    square, error = _squares(residual, blocks)
    return np.asarray(square > LIMIT * error)


def _squares(residual: Floats, blocks: FilmBlocks) -> tuple[Floats, Floats]:
    """U of every block, and its standard error where E R = 0."""
    K = len(residual)
    centred = residual - residual.mean(axis=0)
    covariance = np.einsum("kni,knj->nij", centred, centred) / (K - 1)
    apart = blocks.sum(np.einsum("nij,nij->n", covariance, covariance))
    gram = np.empty((K, K, len(blocks.number)))
    for k in range(K):
        for m in range(k + 1):
            gram[k, m] = gram[m, k] = blocks.sum(np.einsum("ni,ni->n", centred[k], centred[m]))
    own = np.einsum("kkb->kb", gram)
    together = (
        (K - 2) * np.sum(gram**2, axis=(0, 1)) + own.sum(axis=0) ** 2 / (K - 1) - K * np.sum(own**2, axis=0)
    ) / (K * (K - 2) * (K - 3))
    variance = 2.0 / (K * (K - 1)) * np.maximum(apart, together)
    return blocks.sum(_square(residual[:, :, None])), np.sqrt(variance)


def _square(values: Floats) -> Floats:
    """(n,) |E v|² of values (K, n, C, P), over the channels the largest, without the noise's bias."""
    pairs = list(combinations(values, 2))
    return np.asarray((sum(np.sum(a * b, axis=-1) for a, b in pairs) / len(pairs)).max(axis=1))
