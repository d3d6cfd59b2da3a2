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
alone decide: the same by `LIMIT`, and because a few samples of a contour may make the errors of all pixels,
so that U is no normal variable but like a square, also by the tail of

    K |R̄|² / mean |R_k|²  ~  χ²_ν / ν,     ν = (tr Σ)²/tr(Σ²)

(Satterthwaite 1946; that a sum over its own size has no heavier tail, however bounded or not the errors are:
Efron 1969). This tests the geometry of the flow: neither the view term, nor media, nor on which side L_bg is
taken. Source: design section 4.1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from ..information.blocks import BLOCK

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

SUSPICION, LIMIT = 3.0, 4.0
"""Standard errors of a block's U beyond which it is measured again, and beyond which (or in the tail of so
many of a normal variable) its flow is wrong."""
SHARE = 0.01
"""Least error of a block's derivative, over the derivative, that is worth a block's finite differences."""
BATCHES, PATHS = 32, 8
"""Of suspects: batches, and the least paths of each, which is otherwise those of a batch that suspected."""
_TINY = 1e-300


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
        row, column = (pixels[:, axis] // BLOCK for axis in (1, 0))
        first, left = row.min(initial=0), column.min(initial=0)
        width = int(column.max(initial=0) - left) + 1
        place = (row - first) * width + column - left
        present = np.bincount(place) > 0
        where = np.flatnonzero(present)
        number = (where // width + first) << 32 | (where % width + left)
        return FilmBlocks((np.cumsum(present) - 1)[place], number)

    def part(self, rows: Ints) -> FilmBlocks:
        """Of some of the pixels, whole blocks of them."""
        kept = np.zeros(len(self.number), dtype=bool)
        kept[self.home[rows]] = True
        return FilmBlocks((np.cumsum(kept) - 1)[self.home[rows]], self.number[kept])

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
        residual: (3, K, n) R, the pixels' numbers beside each other [1/scene unit].
        columns: (K, n, C, 3) the derivative in translation [radiance / scene unit].
        image: (n, C) radiance.
        blocks: of the n pixels.
    """
    return matters(residual, columns, image, blocks, _exceeds(residual, blocks, SUSPICION))


def matters(residual: Floats, columns: Floats, image: Floats, blocks: FilmBlocks, which: Bools) -> Bools:
    """(blocks,) those of `which` whose breach is worth finite differences; arguments as for `suspects`."""
    if not which.any():
        return which
    found = which.copy()
    rows = np.flatnonzero(which[blocks.home])
    own = blocks.part(rows)
    change = _square(residual[..., rows], own) * own.range(image[rows]) ** 2
    size = np.max([_square(c, own) for c in columns[:, rows].transpose(2, 3, 0, 1)], axis=0)
    found[which] = change > SHARE**2 * size
    return found


def breaches(residual: Floats, blocks: FilmBlocks) -> Bools:
    """(blocks,) where the flow does not close, by `BATCHES` or so; `residual` as for `suspects`."""
    found = _exceeds(residual, blocks, LIMIT)
    if found.any():
        rows = np.flatnonzero(found[blocks.home])
        found[found] = _chance(residual[..., rows], blocks.part(rows)) < special.ndtr(-LIMIT)
    return found


def _exceeds(residual: Floats, blocks: FilmBlocks, limit: float) -> Bools:
    """(blocks,) where U is larger than so many standard errors."""
    K = residual.shape[1]
    U = _square(residual, blocks)
    square = np.sign(U) * (U / limit) ** 2 * (K * (K - 1) / 2.0)
    found = square > apart(residual, blocks)
    if found.any():  # the other estimate costs more
        rows = np.flatnonzero(found[blocks.home])
        found[found] = square[found] > together(residual[..., rows], blocks.part(rows))
    return np.asarray(found, dtype=bool)


def _chance(residual: Floats, blocks: FilmBlocks) -> Floats:
    """(blocks,) that K |R̄|² over the mean of |R_k|² is so large where E R = 0."""
    K = residual.shape[1]
    centred = residual - residual.mean(axis=1, keepdims=True)
    own, rest = (blocks.sum(np.einsum("pkn,pkn->n", part, part)) for part in (residual, centred))
    spread = np.maximum(apart(residual, blocks), together(residual, blocks))
    freedom = np.maximum((rest / (K - 1)) ** 2 / np.maximum(spread, _TINY), 1.0)
    return np.asarray(special.chdtrc(freedom, freedom * K * (own - rest) / np.maximum(own, _TINY)))


def _square(values: Floats, blocks: FilmBlocks) -> Floats:
    """(blocks,) U of values (P, K, n), without the noise's bias."""
    K = values.shape[1]
    total = values.sum(axis=1)
    own = np.einsum("pkn,pkn->n", values, values)
    return blocks.sum((np.einsum("pn,pn->n", total, total) - own) / (K * (K - 1)))


def apart(residual: Floats, blocks: FilmBlocks) -> Floats:
    """(blocks,) tr(Σ²) as if the pixels' errors were independent."""
    centred = residual - residual.mean(axis=1, keepdims=True)
    total = np.zeros(residual.shape[-1])
    for i, row in enumerate(centred):
        for j, other in enumerate(centred[: i + 1]):
            total += (1.0 if i == j else 2.0) * np.einsum("kn,kn->n", row, other) ** 2
    return blocks.sum(total / (residual.shape[1] - 1) ** 2)


def together(residual: Floats, blocks: FilmBlocks) -> Floats:
    """(blocks,) tr(Σ²) whatever errors pixels have in common: the mean of ((R_k − R_l)·(R_m − R_n))² / 4."""
    K = residual.shape[1]
    centred = residual - residual.mean(axis=1, keepdims=True)
    gram = np.empty((K, K, len(blocks.number)))
    for k in range(K):
        for m in range(k + 1):
            gram[k, m] = gram[m, k] = blocks.sum(np.einsum("pn,pn->n", centred[:, k], centred[:, m]))
    own = np.einsum("kkb->kb", gram)
    return np.asarray(
        ((K - 2) * np.sum(gram**2, axis=(0, 1)) + own.sum(axis=0) ** 2 / (K - 1) - K * np.sum(own**2, axis=0))
        / (K * (K - 2) * (K - 3))
    )
