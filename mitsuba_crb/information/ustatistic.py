"""The mean of J_kᵀ W J_l over pairs of independent batches, and its variance: a U-statistic of order two.

With h_kl = sym(J_kᵀ W J_l) of one unit (a pixel, or a block of pixels) as E = P (P+1)/2 numbers (21 for the
P = 6 columns of a pose), K batches and F̂ their mean over k < l, Hoeffding's decomposition
h_kl = F + a_k + a_l + e_kl has uncorrelated terms, so that

    Cov[F̂] = 4/K Cov[a] + 2/(K (K−1)) Cov[e].

Both come from an analysis of variance. With d_kl = h_kl − F̂ and s_k = Σ_l d_kl,

    SS_a = Σ_k s_k s_kᵀ / (K−2),      SS_e = Σ_{k<l} d_kl d_klᵀ − SS_a,
    MS_a = SS_a / (K−1),              MS_e = 2 SS_e / (K (K−3)),
    Cov[a] ≈ (MS_a − MS_e) / (K−2),   Cov[e] ≈ MS_e,

all unbiased, and free of cancellation against F̂F̂ᵀ. It is the same number as F̂F̂ᵀ less the mean over disjoint
pairs, [4 Σ_k s_k s_kᵀ − 4 Σ_{k<l} d_kl d_klᵀ] / (K (K−1) (K−2) (K−3)). Of the sum over units, Cov[a] is
replaced by its `positive_part`: where the information is all noise, a = 0, and few units' unbiased estimates
are often negative, which would look like certainty.

Reference: Hoeffding, "A class of statistics with asymptotically normal distribution", 1948, section 5.
"""

from __future__ import annotations

import copy
from functools import reduce
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ..errors import NoiseError
from ..noise.covariance import ROUNDING, symmetric_root
from ..se3 import Array
from .block_variance import BlockProducts
from .symmetric import entries, pack, positive_part, symmetrised

# Rows of one BLAS call. Larger products wake BLAS's threads, whose barrier costs milliseconds on a busy
# machine, a hundred times the product itself.
_ROWS = 128


class VarianceComponents:
    """Sums of squares over units, and the covariance of the sum of their F̂."""

    kept: BlockProducts | None = None
    """Where the units' products are kept, too."""

    def __init__(self, batches: int, columns: int = 6) -> None:
        self._batches = batches
        self._linear = np.zeros((entries(columns),) * 2)
        self._degenerate = np.zeros((entries(columns),) * 2)

    def add(self, h: Array) -> Array:
        """Add units with products h (pairs k < l, E, units), overwritten here; returns their F̂ (E, units)."""
        if self.kept is not None:
            self.kept.add(h)
        mean: Array = h.mean(axis=0)
        linear, degenerate = _squares(h, mean, self._batches)
        self._linear += linear
        self._degenerate += degenerate
        return mean

    def __add__(self, other: VarianceComponents) -> VarianceComponents:
        """Of all units of both."""
        total = copy.copy(self)
        total._linear = self._linear + other._linear
        total._degenerate = self._degenerate + other._degenerate
        return total

    def _parts(self) -> tuple[Array, Array, Array]:
        """4/K Cov[a], 2/(K(K−1)) Cov[e] and MS_a + MS_e."""
        K = self._batches
        MS_a = self._linear / (K - 1)
        MS_e = 2.0 * self._degenerate / (K * (K - 3))
        return 4.0 / (K * (K - 2)) * (MS_a - MS_e), 2.0 / (K * (K - 1)) * MS_e, MS_a + MS_e

    @property
    def unbiased(self) -> Array:
        """(E, E), Cov of ΣF̂ without bias; possibly indefinite."""
        linear, degenerate, _ = self._parts()
        return linear + degenerate

    @property
    def positive(self) -> Array:
        """(E, E), Cov of ΣF̂, positive semi-definite, and unbiased where there are many units."""
        linear, degenerate, metric = self._parts()
        return positive_part(linear, metric) + degenerate

    @property
    def metric(self) -> Array:
        """(E, E), positive semi-definite, of the covariance's order of magnitude."""
        return self._parts()[2]


def _squares(h: Array, mean: Array, batches: int) -> tuple[Array, Array]:
    """SS_a and SS_e, summed over units; h is overwritten."""
    if batches == 4:
        return _squares_of_four(h, mean)
    d = np.subtract(h, mean, out=h)
    pairs = list(combinations(range(batches), 2))
    s = np.stack([d[[i for i, pair in enumerate(pairs) if k in pair]].sum(axis=0) for k in range(batches)])
    linear = gram(s.mT).sum(axis=0) / (batches - 2)
    return linear, gram(d.mT).sum(axis=0) - linear


def _squares_of_four(h: Array, mean: Array) -> tuple[Array, Array]:
    """The same for four batches, in half the time.

    The linear part of d is what 12 and 34, 13 and 24, and 14 and 23 differ by, the rest what their sums do.
    """
    others, one = h[:2:-1], h[:3]
    differences = np.subtract(one, others, out=others)
    one *= 2.0
    one -= differences
    one -= 2.0 * mean
    return 0.5 * gram(differences.mT).sum(axis=0), 0.5 * gram(one.mT).sum(axis=0)


def square_root(weights: Array) -> Array:
    """√W, symmetric, of pixels' weights (n, C), or of their blocks (n, C, C).

    Raises:
        NoiseError: a weight or an eigenvalue is negative, or not finite.
    """
    if not np.isfinite(weights).all() or (weights.ndim == 2 and (weights < 0.0).any()):
        raise NoiseError("the noise model gave inverse variances that are negative or not finite")
    if weights.ndim == 2:
        return np.asarray(np.sqrt(weights), dtype=np.float64)
    blocks = symmetrised(weights)
    root = symmetric_root(blocks)
    lost = np.abs(root @ root - blocks).max(axis=(1, 2), initial=0.0)
    if (lost > ROUNDING * np.abs(blocks).max(axis=(1, 2), initial=0.0)).any():
        raise NoiseError(
            "the noise model gave a pixel's channels an information with the eigenvalue "
            f"{np.linalg.eigvalsh(blocks).min():.3g}; none may be negative"
        )
    return root


def whiten(values: Array, root: Array) -> Array:
    """√W J_k, (C, K, P, n), the pixels' numbers beside each other.

    Args:
        values: (K, n, C, P), J_k.
        root: √W, (n, C), or blocks (n, C, C).
    """
    columns = values.transpose(2, 0, 3, 1)
    if root.ndim == 2:
        return np.multiply(columns, root.T[:, None, None], order="C")
    return np.stack([sum(map(np.multiply, row, columns)) for row in root.transpose(1, 2, 0)])


def gram(rows: Array, others: Array | None = None) -> Array:
    """Aᵀ A of A (..., r, c), or Aᵀ B with a B of the same shape."""
    *lead, r, c = rows.shape
    whole = r // _ROWS * _ROWS
    (stack, rest), (other_stack, other_rest) = (
        (matrix[..., :whole, :].reshape(*lead, -1, _ROWS, c), matrix[..., whole:, :])
        for matrix in (rows, rows if others is None else others)
    )
    return np.asarray((stack.mT @ other_stack).sum(axis=-3) + rest.mT @ other_rest, dtype=np.float64)


def unit_grams(whitened: Array, starts: NDArray[np.intp]) -> Array:
    """Σ J_kᵀ W J_l of every unit and all k and l, (units, K P, K P).

    Args:
        whitened: (C, K, P, n), from `whiten`.
        starts: (units + 1,) where each unit's pixels start, and n.
    """
    C, K, P, _ = whitened.shape
    rows = whitened.reshape(C, K * P, -1)
    sizes = np.diff(starts)
    grams = np.empty((len(sizes), K * P, K * P))
    for size in np.unique(sizes):
        which = np.flatnonzero(sizes == size)
        if len(which) == len(sizes):
            units = rows.reshape(C, K * P, len(sizes), size).transpose(0, 2, 3, 1)
            grams[which] = gram(units).sum(axis=0)
        else:
            units = rows[:, :, starts[which, None] + np.arange(size)].transpose(2, 0, 3, 1)
            grams[which] = gram(units.reshape(len(which), C * size, K * P))
    return grams


def unit_products(grams: Array, batches: int) -> Array:
    """h_kl of every unit, (pairs k < l, E, units), from `unit_grams`."""
    products = grams.reshape(len(grams), batches, -1, batches, grams.shape[1] // batches)
    pairs = combinations(range(batches), 2)
    return np.stack([pack(symmetrised(products[:, k, :, j, :])).T for k, j in pairs])


def mean_of_batches(gram_of_all: Array, batches: int) -> Array:
    """J̄ᵀ W J̄ of J̄ = Σ J_k / K, from Σ J_kᵀ W J_l of all k and l (K P, K P)."""
    P = len(gram_of_all) // batches
    return np.asarray(gram_of_all.reshape(batches, P, batches, P).sum(axis=(0, 2)) / batches**2)


def pixel_products(whitened: Array, out: Array | None = None) -> Array:
    """As `unit_products`, of units of one pixel each: long sums over pixels, not many small matrices.

    Args:
        whitened: (C, K, P, n), from `whiten`.
        out: where the result goes, (pairs, E, at least n): fresh memory costs as much as the products.
    """
    _, K, P, n = whitened.shape
    products = np.empty((K * (K - 1) // 2, entries(P), n)) if out is None else out[..., :n]
    halves = 0.5 * whitened[:, :-1]
    for product, (k, j) in zip(products, combinations(range(K), 2), strict=True):
        a, b = halves[:, k], whitened[:, j]
        end = 0
        for i in range(P):
            row, end = product[end : end + P - i], end + P - i
            np.einsum("cn,cqn->qn", a[:, i], b[:, i:], out=row)
            row += np.einsum("cqn,cn->qn", a[:, i:], b[:, i])
    return products


def disjoint_products(products: Array, batches: int) -> Array:
    """Σ F_u F_uᵀ over units without bias, (E, E): the mean of h_kl h_mnᵀ over pairs without a common batch.

    Args:
        products: h_kl of every unit, (pairs k < l, E, units), from `pixel_products`.
        batches: K ≥ 4.
    """
    pairs = list(combinations(range(batches), 2))
    total = np.zeros((products.shape[1],) * 2)
    count = 0
    for i, pair in enumerate(pairs):
        others = [products[j] for j in range(i) if not set(pair) & set(pairs[j])]
        if others:
            total += gram(products[i].T, reduce(np.add, others).T)
            count += len(others)
    return symmetrised(total / count)
