"""The uncertainty of an estimated information's entries, bounded by eight numbers.

The covariance of F̂'s 21 different entries is too long for a message, but without it noise in a direction that
nobody sees would count as information. Noise in F̂ comes from noise in the Jacobian, δF = JᵀδJ + δJᵀJ + δJᵀδJ.
With P the information, N the noise's Gram matrix and Z of independent standard normal entries, it has about
the covariance of sym(√(P+N) Z √N):

    M_ij,kl = ¼ [ (P+N)_ik N_jl + (P+N)_il N_jk + (P+N)_jk N_il + (P+N)_jl N_ik ],    Cov[δG] ⪯ c M.

In the row-scaled units of `quantisation`, P is the positive part of the decoded matrix and N = η P + diag(n):
noise that resembles the signal, and noise of each row. Of a few η and n the pair with the smallest det(c M)
is taken. The bound exceeds real renderings' standard errors 1 to 10 times, typically 2 to 3; two numbers for
all rows would exceed them by thousands as soon as one axis is unseen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import MessageError
from ..information.symmetric import triangle
from ..noise.covariance import nearest_semidefinite
from ..se3 import Array

LARGEST_NOISE = 1e15
"""Standard errors in row-scaled units may reach this."""

LARGEST_INFLATION = 1e30
"""C is far below this; anything else is a corrupt message."""

_ROW, _COLUMN = triangle(6)
_LIKE_SIGNAL = (0.0, 1e-4, 1e-3, 1e-2)
_ROW_PARTS = (0, -4, -8)
_SMALLEST_EXPONENT = -127
# The smallest eigenvalue of M's correlation matrix that float64 resolves well.
_RESOLVED = 1e-11


@dataclass(frozen=True, eq=False)
class NoiseBound:
    """What bounds the covariance of a row-scaled information's entries."""

    inflation: float
    """c, a float32; 0 for exact information."""
    like_signal: float
    """η, a float32."""
    row_exponents: NDArray[np.int8]
    """(6,), n = 2^(exponents / 2)."""

    def covariance(self, scaled_matrix: Array) -> Array:
        """(21, 21), c M, in the units of the row-scaled matrix."""
        if self.inflation == 0.0:
            return np.zeros((21, 21))
        P = nearest_semidefinite(scaled_matrix)
        return self.inflation * _model(P, self.like_signal, self.row_exponents)


def noise_bound(scaled_matrix: Array, scaled_covariance: Array) -> NoiseBound:
    """The bound for a row-scaled matrix' entries.

    Args:
        scaled_matrix: (6, 6), as decoded.
        scaled_covariance: (21, 21), of the matrix that was encoded, in the same units.

    Raises:
        MessageError: the standard errors are beyond `LARGEST_NOISE`.
    """
    variances = np.maximum(np.diagonal(scaled_covariance), 0.0)
    largest = float(np.sqrt(variances.max()))
    if largest == 0.0:
        return NoiseBound(0.0, 0.0, np.zeros(6, dtype=np.int8))
    if largest > LARGEST_NOISE:
        raise MessageError(
            f"the information's standard errors reach {largest:.3g} times its own size; a message carries "
            f"up to {LARGEST_NOISE:g}"
        )
    P = nearest_semidefinite(scaled_matrix)
    # (P_ii + n_i) n_i = Var[F_ii]
    p, v = np.diagonal(P), variances[_ROW == _COLUMN]
    n = 2.0 * v / (p + np.sqrt(p**2 + 4.0 * v) + np.finfo(float).tiny)
    exponents = np.ceil(2.0 * np.log2(np.maximum(n, 1e-30)))
    trials = [
        (float(np.float32(eta)), np.maximum(exponents + part, _SMALLEST_EXPONENT).astype(np.int8))
        for eta in _LIKE_SIGNAL
        for part in _ROW_PARTS
    ]
    # The same for all rows, at least 1e-9: coarse, but never ill-conditioned.
    even = max(float(exponents.max()), -60.0)
    trials.append((0.0, np.full(6, even, dtype=np.int8)))
    models = np.array([_model(P, eta, rows) for eta, rows in trials])
    d = 1.0 / np.sqrt(np.diagonal(models, axis1=1, axis2=2))
    values, vectors = np.linalg.eigh(d[:, :, None] * models * d[:, None, :])
    resolved = values[:, 0] > _RESOLVED
    whiten = d[:, :, None] * vectors / np.sqrt(np.where(resolved[:, None], values, 1.0))[:, None, :]
    ratios = np.linalg.eigvalsh(whiten.swapaxes(1, 2) @ scaled_covariance @ whiten)[:, -1]
    volumes = 21.0 * np.log(ratios) + np.where(resolved[:, None], np.log(np.abs(values)), 0.0).sum(axis=1)
    volumes = np.where(resolved, volumes - 2.0 * np.log(d).sum(axis=1), np.inf)
    best = int(np.argmin(volumes))
    # Room for the rounding of this computation, which the threshold on `values` bounds.
    inflation = float(np.nextafter(np.float32(1.0001 * ratios[best]), np.float32(np.inf)))
    return NoiseBound(inflation, *trials[best])


def _model(P: Array, like_signal: float, row_exponents: NDArray[np.int8]) -> Array:
    """M, (21, 21)."""
    N = like_signal * P + np.diag(np.exp2(0.5 * row_exponents))
    Q = P + N
    i, j = _ROW, _COLUMN
    terms = (
        Q[np.ix_(a, b)] * N[np.ix_(c, d)]
        for a, b, c, d in ((i, i, j, j), (i, j, j, i), (j, i, i, j), (j, j, i, i))
    )
    return 0.25 * sum(terms, start=np.zeros((21, 21)))
