"""The mean of J_kᵀΣ⁻¹J_l over pairs of batches, and its variance, where Σ⁻¹ couples the pixels.

With G_l = Σ⁻¹J_l the product is a sum over units (pixels, or blocks of pixels that share samples) of
h_kl,u = sym(J_k,uᵀ G_l,u), now for *ordered* pairs k ≠ l: G_l,u depends on batch l in other units too. With
J_k = J + δ_k and G_l = G + ε_l, ε_l = Σ⁻¹δ_l,

    h_kl,u = F_u + α_k,u + β_l,u + e_kl,u,    α = sym(δ_kᵀG),   β = sym(Jᵀε_l),   e = sym(δ_kᵀε_l).

Only α and e are needed: Σ_u β_l = Σ_u α_l, because Σ is symmetric, and α_u, and e_u given ε_l, are
uncorrelated between units, because δ_u is, however far Σ⁻¹ reaches: units need not be as wide as the noise's
correlation. So

    Cov[F̂] = 4/K Σ_u Cov[α_u] + 2/(K (K−1)) Σ_u Cov[e_u].

Unbiased for each unit, as means over distinct batches, less the same of pairs with no batch in common:
Cov[α] = ⟨h_kl h_kqᵀ⟩ − ⟨h_kl h_pqᵀ⟩ and Cov[e] = ⟨h_kl h_klᵀ⟩ − ⟨h_kl h_kqᵀ⟩ − ⟨h_kl h_qlᵀ⟩ + ⟨h_kl h_pqᵀ⟩.
For diagonal Σ it is the estimate of `ustatistic`.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from ..se3 import Array
from .symmetric import entries, pack, positive_part, symmetrised
from .ustatistic import VarianceComponents, gram


class CoupledComponents(VarianceComponents):
    """Sums of squares over units of ordered pairs' products, and the covariance of the sum of their F̂."""

    def __init__(self, batches: int, columns: int = 6) -> None:
        self._batches = batches
        # Sums of products of the pairs (kl, kl), (kl, kq), (kl, ql) and (kl, pq).
        self._sums = np.zeros((4, entries(columns), entries(columns)))

    def add(self, h: Array) -> Array:
        """Add units with products h (K, K, E, units), the diagonal unused; returns their F̂ (E, units)."""
        if self.kept is not None:
            self.kept.add(h)
        K = self._batches
        mean = mean_of_ordered(h)
        # Coefficients of F Fᵀ cancel in both covariances, so F̂ may be taken off beforehand.
        d = h - mean
        d[np.arange(K), np.arange(K)] = 0.0
        row, column = d.sum(axis=1), d.sum(axis=0)
        same = sum(gram(d[k, j].T) for k in range(K) for j in range(K))
        rows = sum(gram(row[k].T) for k in range(K)) - same
        columns = sum(gram(column[k].T) for k in range(K)) - same
        # All pairs of pairs sum to nothing, so those without a common batch are what the others lack.
        lacking = [gram((row[k] + column[k]).T) for k in range(K)]
        doubled = [gram((d[k, j] + d[j, k]).T) for k, j in combinations(range(K), 2)]
        disjoint = np.sum(doubled, axis=0) - np.sum(lacking, axis=0)
        self._sums += np.stack([same, rows, columns, disjoint])
        return mean

    def _parts(self) -> tuple[Array, Array, Array]:
        """4/K Cov[α], 2/(K(K−1)) Cov[e], and ⟨h_kl h_klᵀ⟩ about the mean."""
        K = self._batches
        pairs = K * (K - 1)
        counts = np.array([pairs, pairs * (K - 2), pairs * (K - 2), pairs * (K - 2) * (K - 3)])
        same, rows, columns, disjoint = symmetrised(self._sums) / counts[:, None, None]
        return 4.0 / K * (rows - disjoint), 2.0 / pairs * (same - rows - columns + disjoint), same

    @property
    def positive(self) -> Array:
        """(E, E), Cov of ΣF̂, positive semi-definite, and unbiased where there are many units."""
        linear, degenerate, metric = self._parts()
        return positive_part(linear, metric) + positive_part(degenerate, metric)


def ordered_products(values: Array, solved: Array) -> Array:
    """h_kl = sym(J_kᵀ G_l) of every unit, (K, K, E, units).

    Args:
        values: (units, rows, K, P), J_k; rows are a unit's pixels and channels.
        solved: the same of G_k = Σ⁻¹J_k.
    """
    units, rows, K, P = values.shape
    products = values.reshape(units, rows, K * P).swapaxes(1, 2) @ solved.reshape(units, rows, K * P)
    paired = products.reshape(units, K, P, K, P).transpose(1, 3, 0, 2, 4)
    return np.moveaxis(pack(symmetrised(paired)), -1, -2)


def mean_of_ordered(h: Array) -> Array:
    """F̂ of every unit (E, units), from `ordered_products`: their mean over k ≠ l."""
    K = len(h)
    return np.asarray((h.sum(axis=(0, 1)) - np.einsum("kkeu->eu", h)) / (K * (K - 1)), dtype=np.float64)
