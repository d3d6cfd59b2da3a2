"""Which blocks of the film the errors of the standard deviations come from.

A standard deviation σ² = aᵀ F⁻¹ a changes by δσ² = −bᵀ δF b, b = F⁻¹ a, and δF is a sum over units of pixels
with independent errors (`accumulate`). So of the relative variance of σ, unit u has the part

    v_u = Var[bᵀ F̂_u b] / (4 σ⁴) = linear + degenerate,

by the analysis of variance of `ustatistic`, of the numbers bᵀ h_kl b instead of matrices. With n times the
paths the linear part, signal by noise, is 1/n of that, and the degenerate one, noise by noise, 1/n². Either
may be negative for one unit: they are unbiased.

Paths that are rare and bright are in one batch of one unit, which then holds nearly all of the variance: what
is known of it is what one batch has met, and by chance not yet met elsewhere. So beside the parts there is
whether w_u = Σ_k s_k², s_k = Σ_l (h_kl − F̂), is that of fewer than `FEW` equal units, (Σ w)²/Σ w², and the
largest s_k² nearly the (K−1)/K of it that it is if all others are alike.

Source: design section 11; Hoeffding 1948, as in `ustatistic`.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ..se3 import Array
from .symmetric import pack

FEW = 1.5
"""Units' worth of variance below which one unit decides."""
NEARLY = 0.75
"""Of the largest share that one batch's square can have: above it one batch decides."""


@dataclass(frozen=True, eq=False)
class BlockVariance:
    """Parts of relative variances, by unit of pixels."""

    corner: NDArray[np.int64]
    """(units, 2) column and row of one of the unit's pixels."""
    linear: Array
    """(m, units), what goes with one over the number of paths."""
    degenerate: Array
    """(m, units), what goes with one over its square."""
    rare: NDArray[np.bool_]
    """(m,) whether one batch of one unit decides."""
    effect: Array
    """(m, units) bᵀ F̂_u b / (2 σ²), by which σ would be larger, in first order, without the unit."""

    def scaled(self, factor: float) -> BlockVariance:
        """Of units that count so many times."""
        square = factor**2
        return BlockVariance(
            self.corner,
            square * self.linear,
            square * self.degenerate,
            self.rare,
            factor * self.effect,
        )

    @property
    def total(self) -> Array:
        """(m, units), with the paths that they were measured by."""
        return self.linear + self.degenerate


class BlockProducts:
    """h_kl of every unit, kept while an information is summed up."""

    def __init__(self, batches: int, columns: int = 6) -> None:
        self._batches, self._columns = batches, columns
        self._corners: list[NDArray[np.int64]] = []
        self._products: list[NDArray[np.float32]] = []

    def corners(self, pixels: NDArray[np.int64]) -> None:
        """Of the units (n, 2) whose products come next."""
        self._corners.append(pixels)

    def add(self, products: Array) -> None:
        """Of some units, (pairs k < l, E, units), or of ordered pairs (K, K, E, units)."""
        if products.ndim == 4:
            products = np.stack(
                [0.5 * (products[k, j] + products[j, k]) for k, j in combinations(range(self._batches), 2)]
            )
        self._products.append(products.astype(np.float32))

    def variance(self, vectors: Array, values: Array) -> BlockVariance:
        """Parts of the relative variances of σ = values^½.

        Args:
            vectors: (m, P), each b in the columns' own units.
            values: (m,), σ² = bᵀ F b.
        """
        K = self._batches
        # Off-diagonal entries of a symmetric matrix occur twice in a quadratic form but once in `pack`.
        multiplicity = pack(2.0 - np.eye(self._columns))
        gradient = pack(vectors[:, :, None] * vectors[:, None, :]) * multiplicity / (2.0 * values[:, None])
        h = np.concatenate([gradient @ part for part in self._products], axis=-1)
        effect = h.mean(axis=0)
        d = h - effect
        s = np.zeros((K, *d.shape[1:]))
        for pair, (k, j) in zip(d, combinations(range(K), 2), strict=True):
            s[k] += pair
            s[j] += pair
        square = np.sum(s**2, axis=0)
        between = square / (K - 2)
        total = square.sum(axis=1)
        alone = total**2 < FEW * np.sum(square**2, axis=1)
        rare = alone & (np.max(s**2, axis=0).sum(axis=1) > NEARLY * (K - 1) / K * total)
        within = 2.0 * (np.sum(d**2, axis=0) - between) / (K * (K - 3))
        linear = 4.0 / (K * (K - 2)) * (between / (K - 1) - within)
        return BlockVariance(
            np.concatenate(self._corners),
            linear,
            2.0 / (K * (K - 1)) * within,
            rare,
            effect,
        )
