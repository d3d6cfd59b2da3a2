"""Gaussian noise by its sparse precision Q = Σ⁻¹, a Gaussian Markov random field.

All pixels need products with Q only. Of a subset P, with R the rest, (Σ_PP)⁻¹ is the Schur complement
Q_PP − Q_PR Q_RR⁻¹ Q_RP, by a sparse factorisation of Q_RR. Signs of the pivots of a symmetric factorisation
are those of the eigenvalues (Sylvester), which tells whether Q is positive definite.

Reference: Rue and Held, "Gaussian Markov Random Fields", 2005, theorem 2.5.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import eigsh, splu

from ..errors import NoiseError
from .covariance import DEFINITE, ROUNDING
from .protocol import Array, CoupledNoise


@dataclass(frozen=True, eq=False)
class SparsePrecision(CoupledNoise):
    """Noise of a sparse inverse covariance."""

    precision: Any
    """Q, a SciPy sparse matrix [1 / radiance²]: (H W, H W), every channel alike, pixel (x, y) at y W + x; or
    (H W C, H W C), its channel c at (y W + x) C + c."""
    shape: tuple[int, int]
    """H and W."""

    def __init__(self, precision: Any, shape: tuple[int, int]) -> None:
        if not sparse.issparse(precision):
            raise NoiseError(f"SparsePrecision expects a SciPy sparse matrix, not {type(precision).__name__}")
        Q = sparse.csc_array(precision, dtype=np.float64)
        height, width = (int(side) for side in shape)
        count = max(height, 0) * max(width, 0)
        if Q.shape[0] != Q.shape[1] or Q.shape[0] == 0 or count == 0 or Q.shape[0] % count:
            raise NoiseError(
                f"the precision has shape {Q.shape}, but the image is {height} rows x {width} columns"
            )
        _check_positive_definite(Q)
        object.__setattr__(self, "precision", Q)
        object.__setattr__(self, "shape", (height, width))

    @property
    def description(self) -> str:
        """One short phrase for tables."""
        filling = self.precision.nnz / self.precision.shape[0]
        return f"correlated, sparse precision with {filling:.3g} entries per row"

    def check(self, height: int, width: int, channels: int) -> None:
        """The precision must have the image's size, and one or all of its channels."""
        if self.shape != (height, width) or self._channels not in (1, channels):
            raise NoiseError(
                f"the precision is of {self.shape[0]} rows x {self.shape[1]} columns x {self._channels} "
                f"channels, but the image is {height} rows x {width} columns x {channels} channels"
            )

    def solve(self, pixels: NDArray[np.integer], values: Array) -> Array:
        """(Q_PP − Q_PR Q_RR⁻¹ Q_RP) times columns (n, C, m)."""
        C = self._channels
        rows = (pixels[:, 1].astype(np.int64) * self.shape[1] + pixels[:, 0])[:, None] * C + np.arange(C)
        selected = rows.ravel()
        columns = values.reshape(len(selected), -1)
        Q = self.precision
        rest = np.setdiff1d(np.arange(Q.shape[0]), selected)
        product = Q[selected][:, selected] @ columns
        if rest.size:
            between = Q[rest][:, selected]
            product -= between.T @ splu(Q[rest][:, rest].tocsc()).solve(between @ columns)
        return np.asarray(product, dtype=np.float64).reshape(values.shape)

    def to_dict(self) -> dict[str, Any]:
        """Shape and number of entries."""
        return {"model": "sparse_precision", "shape": list(self.shape), "entries": int(self.precision.nnz)}

    @property
    def _channels(self) -> int:
        return int(self.precision.shape[0] // (self.shape[0] * self.shape[1]))


def _check_positive_definite(Q: sparse.csc_array) -> None:
    if not np.isfinite(Q.data).all():
        raise NoiseError("the precision has entries that are not finite")
    diagonal = Q.diagonal()
    s = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, float(np.abs(Q).max()) or 1.0))
    unit = sparse.csc_array(sparse.diags_array(s) @ Q @ sparse.diags_array(s))
    skew = float(np.abs(unit - unit.T).max())
    if skew > ROUNDING:
        raise NoiseError(
            "the precision is not symmetric: with its diagonal scaled to one, entries differ from their "
            f"mirror images by {skew:.3g}"
        )
    # Gershgorin: nothing needs to be factorised where the diagonal dominates.
    if np.all(2.0 * unit.diagonal() > np.asarray(np.abs(unit).sum(axis=0)).ravel() * (1.0 + 1e-9)):
        return
    try:
        pivots = splu(
            unit, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        ).U.diagonal()
    except RuntimeError:  # exactly singular
        pivots = np.zeros(1)
    if pivots.min() < DEFINITE:
        raise NoiseError(
            "the precision is not positive definite: with its diagonal scaled to one, its smallest "
            f"eigenvalue is {_smallest_eigenvalue(unit):.3g}"
        )


def _smallest_eigenvalue(Q: sparse.csc_array) -> float:
    if Q.shape[0] <= 1000:
        return float(np.linalg.eigvalsh(Q.toarray())[0])
    return float(eigsh(Q, k=1, which="SA", tol=1e-3, v0=np.ones(Q.shape[0]), return_eigenvectors=False)[0])
