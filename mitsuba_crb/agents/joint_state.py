"""Many coupled parameters at once: which directions their joint information sees, and projections of it.

The rule is that of `identifiability`, for an n x n matrix F̂ whose noise is in independent 6 x 6 blocks on the
diagonal (the cameras' estimates; links between them are exact): the unseen subspace is spanned by the largest
number q of lowest eigenvectors N for which the largest eigenvalue of F̂ on it stays below the 99 % quantile of
noise restricted likewise, plus a floor for float32 rendering and float64 sums. Then

    M = F_seen⁺ + N Nᵀ / λ_99

is the covariance of all that has no significant share of N. Small matrices are decomposed whole; of large
sparse ones only the lowest eigenvectors are found, by shift and invert, and M is applied through the
bordered system [[F, N], [Nᵀ, 0]].

Reference: Lehoucq, Sorensen and Yang, "ARPACK Users' Guide", 1998, section 4.3.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import eigsh, splu

from ..errors import FusionError
from ..information.identifiability import CONFIDENCE, SIGNIFICANT, SMALLEST_SHARE
from ..information.symmetric import congruence, pack, symmetrised, triangle, unpack
from ..noise.covariance import inverse_cholesky, symmetric_root
from ..se3 import Array

DENSE = 600
"""Matrices up to this size are decomposed whole."""

_MOST_UNDECIDED = 256
_MOST_SAMPLED = 48
_DRAWS = 1000
# The 99 % quantile of a normal vector's norm is at most this many times its root mean square.
_NORM_QUANTILE = 2.6
_ROUNDING = 1e-13
_MULTIPLICITY = pack(2.0 - np.eye(6))


@dataclass(frozen=True, eq=False)
class Projection:
    """Information about m linear functionals, everything else marginalised."""

    matrix: Array
    """(m, m); zero where a functional has a share of what is unseen."""
    response: Array
    """(n, m), G with δ matrix = Gᵀ δF G."""


class JointState:
    """Seen and unseen directions of an n x n information matrix."""

    unseen: Array
    """(n, q), orthonormal columns N."""
    threshold: float
    """λ_99 of the unseen subspace; 0 if everything is seen."""

    def __init__(self, matrix: sp.csc_array, noise: Mapping[int, Array], floor: Array) -> None:
        """Decide.

        Args:
            matrix: (n, n), F̂, its parameters scaled alike.
            noise: by first row of a block of six, the (21, 21) covariance of its entries.
            floor: (n,), what rendering in float32 cannot resolve: the diagonal of an information.
        """
        self._noise = {row: covariance for row, covariance in noise.items() if covariance.any()}
        n = matrix.shape[0]
        largest = float(np.abs(matrix).sum(axis=0).max()) if n else 0.0
        self._floor, self._rounding = floor, _ROUNDING * largest
        self._dense = None
        if n <= DENSE:
            values, vectors = np.linalg.eigh(matrix.toarray())
            self._dense = (values, vectors)
        else:
            values, vectors = self._lowest(matrix)
        q, self.threshold = self._decide(values, vectors)
        self.unseen = np.asarray(vectors[:, :q], dtype=np.float64)
        if self._dense is None:
            N = sp.csc_array(self.unseen)
            self._bordered = splu(
                sp.block_array([[matrix, N], [N.T, None]] if q else [[matrix]], format="csc")
            )

    def covariance_times(self, columns: Array) -> Array:
        """M H for H (n, m), without the part N Nᵀ / λ_99."""
        if self._dense is not None:
            values, vectors = self._dense
            q = self.unseen.shape[1]
            seen = vectors[:, q:]
            return np.asarray(seen @ ((seen.T @ columns) / values[q:, None]), dtype=np.float64)
        padded = np.vstack([columns, np.zeros((self.unseen.shape[1], columns.shape[1]))])
        return np.asarray(self._bordered.solve(padded)[: len(columns)], dtype=np.float64)

    def project(self, functionals: Array) -> Projection:
        """The information about Hᵀ z for linearly independent functionals H (n, m)."""
        Q, R = np.linalg.qr(functionals)
        share = Q.T @ self.unseen
        response = self.covariance_times(Q)
        directions, shares, _ = np.linalg.svd(share)
        shares = np.concatenate([shares, np.zeros(Q.shape[1] - len(shares))])
        hidden = shares > np.maximum(SMALLEST_SHARE, SIGNIFICANT * self._tilt(response @ directions))
        W = directions[:, ~hidden]
        if self.threshold > 0.0:
            response = response + self.unseen @ share.T / self.threshold
        # The information about Wᵀ Qᵀ z is the inverse of its covariance; about the rest there is none.
        root = W @ inverse_cholesky(symmetrised(W.T @ Q.T @ response @ W)).T
        R_inverse = np.linalg.inv(R)
        information = root @ root.T
        return Projection(
            matrix=symmetrised(R_inverse @ information @ R_inverse.T),
            response=response @ information @ R_inverse.T,
        )

    def covariance_of_entries(self, response: Array) -> Array:
        """(21, 21), of Gᵀ F̂ G for a response G (n, 6)."""
        total = np.zeros((21, 21))
        for row, covariance in self._noise.items():
            T = congruence(response[row : row + 6])
            total += T @ covariance @ T.T
        return total

    def _tilt(self, columns: Array) -> Array:
        """Standard errors (m,) of a unit functional's share, from M times it (n, m): δn = −M δF n."""
        variance = np.zeros(columns.shape[1])
        for row, covariance in self._noise.items():
            b, n = columns[row : row + 6], self.unseen[row : row + 6]
            outer = np.einsum("im,jq->mqij", b, n)
            gradient = pack(symmetrised(outer)) * _MULTIPLICITY
            variance += np.einsum("mqu,uv,mqv->m", gradient, covariance, gradient)
        return np.sqrt(np.maximum(variance, 0.0))

    def _decide(self, values: Array, vectors: Array) -> tuple[int, float]:
        """Q and λ_99 from the lowest eigenvalues, ascending."""
        q, bound = len(values), np.inf
        # The norm of all noise bounds its largest eigenvalue and costs little.
        while q:
            bound = self._norm_bound(vectors[:, :q])
            kept = int(np.searchsorted(values[:q], bound, side="right"))
            if kept == q:
                break
            q = kept
        if q > _MOST_SAMPLED or q == 0:
            return q, bound if q else 0.0
        draws = self._draws(vectors[:, :q])
        while q:
            largest = np.linalg.eigvalsh(draws[:, :q, :q])[:, -1] if self._noise else np.zeros(1)
            quantile = float(np.quantile(largest, CONFIDENCE)) + self._floor_in(vectors[:, :q])
            if values[q - 1] <= quantile:
                return q, quantile
            q -= 1
        return 0, 0.0

    def _norm_bound(self, vectors: Array) -> float:
        """An upper bound on the 99 % quantile of the largest eigenvalue of noise in a subspace (n, q)."""
        square = 0.0
        i, j = triangle(6)
        for row, covariance in self._noise.items():
            P = vectors[row : row + 6] @ vectors[row : row + 6].T
            pairs = 0.5 * (P[np.ix_(i, i)] * P[np.ix_(j, j)] + P[np.ix_(i, j)] * P[np.ix_(j, i)])
            square += float(_MULTIPLICITY @ (covariance * pairs) @ _MULTIPLICITY)
        return _NORM_QUANTILE * float(np.sqrt(max(square, 0.0))) + self._floor_in(vectors)

    def _floor_in(self, vectors: Array) -> float:
        """The floor in a subspace (n, q): strong images elsewhere do not drown what they have no part in."""
        return float(np.linalg.eigvalsh(vectors.T @ (self._floor[:, None] * vectors))[-1]) + self._rounding

    def _draws(self, vectors: Array) -> Array:
        """(draws, q, q), noise in a subspace (n, q)."""
        rng = np.random.default_rng(1948)
        total = np.zeros((_DRAWS if self._noise else 1, vectors.shape[1], vectors.shape[1]))
        for row in sorted(self._noise):
            V = vectors[row : row + 6]
            noise = rng.standard_normal((_DRAWS, 21)) @ symmetric_root(self._noise[row])
            total += V.T @ unpack(noise) @ V
        return total

    def _lowest(self, matrix: sp.csc_array) -> tuple[Array, Array]:
        """The lowest eigenvalues, ascending, and eigenvectors: enough for the highest to exceed all noise."""
        n = matrix.shape[0]
        norms = [
            _NORM_QUANTILE * float(np.sqrt(_MULTIPLICITY @ np.diagonal(c))) for c in self._noise.values()
        ]
        shift = -2.0 * (max(norms, default=0.0) + float(self._floor.max()) + self._rounding)
        start = np.random.default_rng(1951).standard_normal(n)
        count = 16
        while True:
            values, vectors = eigsh(matrix, k=count, sigma=shift, which="LM", v0=start)
            order = np.argsort(values)
            values, vectors = values[order], vectors[:, order]
            if values[-1] > self._norm_bound(vectors):
                return values, vectors
            if 2 * count > min(_MOST_UNDECIDED, n // 2):
                raise FusionError(
                    f"more than {count} directions of the joint state are unseen or drowned in noise; use "
                    "more samples, or fuse fewer poses at a time"
                )
            count *= 2
