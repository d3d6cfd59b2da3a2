"""The information of a random subset of an image's pixels, and the variance of what it says of the whole.

For a simple random sample of n of N pixels, F̂ = (N/n) Σ F̂_u, f = n/N, s² the sample covariance of the pixels'
information F_u without noise, and V the Monte Carlo covariance of the sum (`ustatistic`),

    Cov[F̂] = N² (1−f)/n s² + (N/n)² V = (N/n)² [ (1−f) n/(n−1) B + f V ],    B = Q + V − ΣF̂_u ΣF̂_uᵀ / n.

Q estimates Σ F_u F_uᵀ without bias, from pairs that have no batch in common. Pixels of one block share
samples, so V is summed over blocks; where a pixel is alone in its block, Q + V is F̂_u F̂_uᵀ itself. B, which
is positive semi-definite in expectation, is replaced by its `positive_part`.

Reference: Cochran, "Sampling Techniques", 3rd ed., chapter 2 and section 13.9 (errors of measurement).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..se3 import Array
from .block_variance import BlockProducts
from .symmetric import entries, positive_part
from .ustatistic import VarianceComponents, disjoint_products, gram, pixel_products


class SampledComponents:
    """Sums over the pixels of a random subset, and the covariance of what they say of the whole image."""

    def __init__(self, batches: int, columns: int = 6) -> None:
        self._batches = batches
        self._alone, self._units = (VarianceComponents(batches, columns) for _ in range(2))
        # Q + V of pixels alone in their unit; Q of the others, and ΣF̂F̂ᵀ of their units.
        self._of_alone, self._disjoint, self._of_others = np.zeros((3, *(entries(columns),) * 2))
        self._memory = np.empty((batches * (batches - 1) // 2, entries(columns), 0))

    @property
    def kept(self) -> BlockProducts | None:
        """See `VarianceComponents`."""
        return self._units.kept

    @kept.setter
    def kept(self, products: BlockProducts | None) -> None:
        self._alone.kept = self._units.kept = products

    def add(self, whitened: Array, starts: NDArray[np.intp]) -> Array:
        """Add units of one pixel each, of two each, or of more; returns the sum of their F̂ (E,).

        Args:
            whitened: (C, K, P, n), from `ustatistic.whiten`.
            starts: (units + 1,) where each unit's pixels start, and n.
        """
        n = whitened.shape[-1]
        if n > self._memory.shape[-1]:
            self._memory = np.empty((*self._memory.shape[:-1], n))
        products = pixel_products(whitened, out=self._memory)
        if len(starts) > n:
            means = self._alone.add(products)
            self._of_alone += gram(means.T)
            return np.asarray(means.sum(axis=1))
        self._disjoint += disjoint_products(products, self._batches)
        if 2 * (len(starts) - 1) == n:
            units = products[..., ::2] + products[..., 1::2]
        else:
            units = np.add.reduceat(products, starts[:-1], axis=-1)
        means = self._units.add(units)
        self._of_others += gram(means.T)
        return np.asarray(means.sum(axis=1))

    def covariance(self, total: Array, n: int, N: int) -> Array:
        """(E, E), of F̂, for n of N pixels whose ΣF̂_u is `total` (E,)."""
        of_total = np.outer(total, total) / n
        B = self._of_alone + self._disjoint + self._units.unbiased - of_total
        metric = self._of_alone + self._of_others + self._units.metric - of_total
        f = n / N
        between = (1.0 - f) * n / (n - 1) * positive_part(B, metric)
        return (N / n) ** 2 * (between + f * self.positive)

    @property
    def positive(self) -> Array:
        """(E, E), V."""
        return (self._alone + self._units).positive
