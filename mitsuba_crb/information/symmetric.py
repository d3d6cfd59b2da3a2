"""Symmetric P x P matrices as vectors of P (P + 1) / 2 numbers, and the positive part of an estimate.

The covariance of a matrix's entries is a matrix over the upper triangle, in the order of
`numpy.triu_indices(P)`. For a pose, P = 6, it is 21 x 21: (0,0), (0,1), .. (0,5), (1,1), .. (5,5).
"""

from __future__ import annotations

from functools import lru_cache
from math import isqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..noise.covariance import roots
from ..se3 import Array

# Directions in which a metric is below this fraction of its own diagonal are rounding.
_RANK_TOLERANCE = 1e-12


@lru_cache
def triangle(size: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of the entries of a symmetric matrix of this size."""
    rows, columns = np.triu_indices(size)
    rows.flags.writeable = columns.flags.writeable = False
    return rows, columns


def entries(size: int) -> int:
    """P (P + 1) / 2, how many different entries a symmetric matrix of size P has."""
    return size * (size + 1) // 2


def pack(matrix: ArrayLike) -> Array:
    """The upper triangles of symmetric matrices: (..., P, P) to (..., P (P + 1) / 2)."""
    values = np.asarray(matrix, dtype=np.float64)
    rows, columns = triangle(values.shape[-1])
    return values[..., rows, columns]


def unpack(vector: ArrayLike) -> Array:
    """The symmetric matrices with these upper triangles: (..., P (P + 1) / 2) to (..., P, P)."""
    values = np.asarray(vector, dtype=np.float64)
    size = (isqrt(8 * values.shape[-1] + 1) - 1) // 2
    rows, columns = triangle(size)
    matrix = np.empty((*values.shape[:-1], size, size))
    matrix[..., rows, columns] = values
    matrix[..., columns, rows] = values
    return matrix


def congruence(A: ArrayLike) -> Array:
    """The matrix T with `pack(Aᵀ F A) = T pack(F)` for every symmetric F (P, P) and A (P, Q)."""
    columns = np.asarray(A, dtype=np.float64)
    return pack(columns.T @ unpack(np.eye(entries(len(columns)))) @ columns).T


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
    root, inverse_root = roots(metric, _RANK_TOLERANCE)
    generalised, axes = np.linalg.eigh(inverse_root.T @ matrix @ inverse_root)
    axes = root @ axes[:, generalised > 0.0] * np.sqrt(generalised[generalised > 0.0])
    norms = np.linalg.norm(axes, axis=1)
    wanted = np.sqrt(np.maximum(np.diagonal(matrix), 0.0))
    axes *= np.divide(wanted, norms, out=np.zeros_like(norms), where=norms > 0.0)[:, None]
    positive: Array = axes @ axes.T
    return positive
