"""Symmetric 6 x 6 matrices as vectors of 21 numbers, and the positive semi-definite part of an estimate.

The covariance of a matrix's entries is a 21 x 21 matrix over the upper triangle, in the order of
`numpy.triu_indices(6)`: (0,0), (0,1), .. (0,5), (1,1), .. (5,5).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .se3 import Array

TRIANGLE = np.triu_indices(6)
"""Rows and columns of the 21 entries."""

# Directions in which a metric is below this fraction of its own diagonal are rounding.
_RANK_TOLERANCE = 1e-12


def pack(matrix: ArrayLike) -> Array:
    """The upper triangles of symmetric matrices: (..., 6, 6) to (..., 21)."""
    return np.asarray(matrix, dtype=np.float64)[..., TRIANGLE[0], TRIANGLE[1]]


def unpack(vector: ArrayLike) -> Array:
    """The symmetric matrices with these upper triangles: (..., 21) to (..., 6, 6)."""
    values = np.asarray(vector, dtype=np.float64)
    matrix = np.empty((*values.shape[:-1], 6, 6))
    matrix[..., TRIANGLE[0], TRIANGLE[1]] = values
    matrix[..., TRIANGLE[1], TRIANGLE[0]] = values
    return matrix


def congruence(A: ArrayLike) -> Array:
    """The (21, 21) matrix T with `pack(Aᵀ F A) = T pack(F)` for every symmetric F."""
    columns = np.asarray(A, dtype=np.float64)
    return pack(columns.T @ unpack(np.eye(21)) @ columns).T


def symmetrised(matrices: Array) -> Array:
    """(M + Mᵀ) / 2 of (..., n, n)."""
    return 0.5 * (matrices + matrices.swapaxes(-1, -2))


def positive_part(matrix: Array, metric: Array) -> Array:
    """A positive semi-definite stand-in for a symmetric estimate A of a covariance, relative to W ⪰ 0.

    The negative generalised eigenvalues of A v = λ W v become zero; eigenvalues of A alone would depend on
    units, as its entries have different ones. That makes the diagonal larger, so rows and columns are then
    scaled down to A's own diagonal, or to zero where that is negative: variances stay unbiased but for that.

    Args:
        matrix: (n, n), A; it must vanish where W does.
        metric: (n, n), W, positive semi-definite and of the size of A.
    """
    diagonal = np.diagonal(metric)
    d = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    values, vectors = np.linalg.eigh(metric / np.outer(d, d))
    kept = values > _RANK_TOLERANCE * max(values[-1], 0.0)
    root = d[:, None] * vectors[:, kept] * np.sqrt(values[kept])
    inverse_root = vectors[:, kept] / np.sqrt(values[kept]) / d[:, None]
    generalised, axes = np.linalg.eigh(inverse_root.T @ matrix @ inverse_root)
    axes = root @ axes[:, generalised > 0.0] * np.sqrt(generalised[generalised > 0.0])
    norms = np.linalg.norm(axes, axis=1)
    wanted = np.sqrt(np.maximum(np.diagonal(matrix), 0.0))
    axes *= np.divide(wanted, norms, out=np.zeros_like(norms), where=norms > 0.0)[:, None]
    positive: Array = axes @ axes.T
    return positive
