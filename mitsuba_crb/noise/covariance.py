"""Covariance and information matrices: the check of one that is given, its positive part, its roots.

Rows have different units (a pose's are lengths and angles): signs and ranks are judged with the diagonal
scaled to one, which nearly minimises the condition number and does not depend on units.

References: van der Sluis, "Condition numbers and equilibration of matrices", 1969; Higham, "Computing a
nearest symmetric positive semidefinite matrix", 1988.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from ..se3 import Array

ROUNDING = 1e-9
"""Of matrices with unit diagonal: rounding leaves less of the asymmetry and of a zero eigenvalue."""

DEFINITE = 1e-12
"""Likewise: a smaller eigenvalue leaves an inverse no digits."""


def positive_matrix(
    value: ArrayLike,
    what: str,
    fault: type[Exception],
    *,
    size: int | None = None,
    definite: bool = False,
    cure: str = "",
    names: Sequence[str] = (),
) -> Array:
    """A symmetric positive semi-definite matrix, or a stack of them, checked and made symmetric exactly.

    Args:
        value: (..., n, n); negative by rounding at most.
        what: what messages call it.
        fault: the class of error.
        size: n, of a single matrix; None for a stack, or for any size.
        definite: no eigenvalue may be zero either.
        cure: what to do if one is, for the message.
        names: of the rows, for the message; by default their numbers from 1.

    Raises:
        fault: no numbers, another shape, not finite, not symmetric, or an eigenvalue that is too small.
    """
    shape = "square" if size is None else f"{size} x {size}"
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise fault(f"{what} must be a {shape} matrix of numbers ({error})") from None
    single = size is None or matrix.shape == (size, size)
    if matrix.ndim < 2 or matrix.shape[-2] != matrix.shape[-1] or not single:
        raise fault(f"{what} must be a {shape} matrix of numbers, not of shape {matrix.shape}")
    if not np.isfinite(matrix).all():
        raise fault(f"{what} has entries that are not finite")
    unit, _ = unit_diagonal(matrix)
    skew = np.abs(unit - unit.mT) / np.maximum(np.abs(unit), 1.0)
    if skew.max(initial=0.0) > ROUNDING:
        raise fault(
            f"{what} is not symmetric: with its diagonal scaled to one, entries differ from their mirror "
            f"images by {np.abs(unit - unit.mT).max():.3g}"
        )
    zero = np.argwhere(~matrix.any(axis=-1))
    if definite and len(zero):
        rows = zero[(zero[:, :-1] == zero[0, :-1]).all(axis=1), -1]  # of the first such matrix of a stack
        listed = ", ".join(names[row] if names else str(row + 1) for row in rows)
        which = "it is all zero" if len(rows) == matrix.shape[-1] else f"all is zero in the rows of {listed}"
        raise fault(f"{what} is not positive definite: {which}{cure and '; '}{cure}")
    smallest = float(np.linalg.eigvalsh(unit).min(initial=1.0))
    if smallest < (DEFINITE if definite else -ROUNDING):
        raise fault(
            f"{what} is not positive {'definite' if definite else 'semi-definite'}: with its diagonal scaled "
            f"to one, its smallest eigenvalue is {smallest:.3g}{cure and '; '}{cure}"
        )
    return 0.5 * (matrix + matrix.mT)


def unit_diagonal(matrix: Array) -> tuple[Array, Array]:
    """S M S and the diagonal s (..., n) of S = diag(M)^(−1/2), for matrices M (..., n, n).

    A row whose own diagonal entry is not positive is scaled like the largest entry of all.
    """
    diagonal = np.diagonal(matrix, axis1=-2, axis2=-1)
    largest = np.abs(matrix).max(axis=(-2, -1), initial=0.0)[..., None]
    s = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, np.where(largest > 0.0, largest, 1.0)))
    return s[..., :, None] * matrix * s[..., None, :], s


def nearest_semidefinite(matrix: Array) -> Array:
    """Symmetric matrices (..., n, n) with their negative eigenvalues set to zero."""
    values, vectors = np.linalg.eigh(matrix)
    nearest: Array = (vectors * np.maximum(values, 0.0)[..., None, :]) @ vectors.mT
    return nearest


def symmetric_root(matrix: Array) -> Array:
    """The symmetric R (..., n, n) with R R = M, or what is nearest to M if that has negative eigenvalues.

    Unlike other roots it is unique: random numbers that are coloured with it are the same everywhere.
    """
    values, vectors = np.linalg.eigh(matrix)
    root: Array = (vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]) @ vectors.mT
    return root


def roots(matrix: Array, tolerance: float) -> tuple[Array, Array]:
    """R and W (n, r) with R Rᵀ = M, Wᵀ M W = 1, Wᵀ R = 1 and, of a regular M, W Wᵀ = M⁻¹.

    Args:
        matrix: (n, n), M; symmetric.
        tolerance: directions are left out whose eigenvalue is not above this fraction of the largest one's,
            M scaled to unit diagonal.
    """
    unit, s = unit_diagonal(matrix)
    values, vectors = np.linalg.eigh(unit)
    kept = values > tolerance * values.max(initial=0.0)
    axes, spread = vectors[:, kept], np.sqrt(values[kept])
    return axes * spread / s[:, None], s[:, None] * axes / spread


def inverse_cholesky(matrix: Array) -> Array:
    """L⁻¹ (..., n, n) with M = L Lᵀ, for an M that is known to be positive definite."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(matrix)), dtype=np.float64)
