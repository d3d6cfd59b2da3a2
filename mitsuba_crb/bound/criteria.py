"""How much a 6 x 6 information matrix is worth: log det, trace, and Kiefer's means up to λ_min.

All are concave and increasing in the Loewner order. A *price* Y of f at M is a supergradient there:
f(N) ≤ f(M) + ⟨Y, N − M⟩, ⟨A, B⟩ = tr(AB). Hence, with s the largest ⟨Y, N⟩ that a budget can buy,

    f(N) ≤ 6 log(s / 6) − log det Y     for log det (any Y ≻ 0; the scale of Y is already the best one),
    f(N) ≤ s                            for the trace (Y = 1),
    f(N) ≤ s / tr(Y)                    for λ_min (any Y ⪰ 0),

upper bounds over everything that the budget allows, and exact at the best Y for the relaxed problem.

References: Pukelsheim, "Optimal Design of Experiments", 2006, chapters 6 and 7 (Kiefer's φ_p, duality).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np

from ..noise.covariance import inverse_cholesky
from ..se3 import Array


class Criterion(Protocol):
    """A concave, increasing function f of an information matrix."""

    submodular: ClassVar[bool]
    """Whether a tile's gain never grows when others are added before it."""

    def value(self, matrices: Array) -> Array:
        """f of (..., 6, 6), as (...)."""

    def gains(self, matrix: Array, blocks: Array) -> Array:
        """f(M + F_i) − f(M) for M (6, 6) and F (n, 6, 6), as (n,)."""

    def price(self, matrix: Array) -> Array:
        """(6, 6), a supergradient at M."""

    def upper_bound(self, price: Array, revenue: float) -> float:
        """The largest f(N) possible if ⟨Y, N⟩ ≤ `revenue`."""


@dataclass(frozen=True)
class LogDet:
    """log det M; minus infinity where M is not positive definite."""

    submodular: ClassVar[bool] = True

    def value(self, matrices: Array) -> Array:
        """log det of (..., 6, 6), as (...)."""
        # By eigenvalues: an indefinite matrix with an even number of negative ones has a determinant, too.
        eigenvalues = np.linalg.eigvalsh(matrices)
        positive = eigenvalues[..., 0] > 0.0
        logarithms = np.log(np.where(positive[..., None], eigenvalues, 1.0)).sum(axis=-1)
        return np.where(positive, logarithms, -np.inf)

    def gains(self, matrix: Array, blocks: Array) -> Array:
        """log det(1 + L⁻¹ F_i L⁻ᵀ) with M = LLᵀ: small gains keep their digits, which log det M would eat."""
        whitening = inverse_cholesky(matrix)
        determinants = np.linalg.slogdet(np.eye(6) + whitening @ blocks @ whitening.T)
        return np.asarray(determinants.logabsdet, dtype=np.float64)

    def price(self, matrix: Array) -> Array:
        """M⁻¹."""
        whitening = inverse_cholesky(matrix)
        inverse: Array = whitening.T @ whitening
        return inverse

    def upper_bound(self, price: Array, revenue: float) -> float:
        """6 log(s / 6) − log det Y."""
        return float(6.0 * np.log(revenue / 6.0) - self.value(price))


@dataclass(frozen=True)
class Trace:
    """tr M."""

    submodular: ClassVar[bool] = True

    def value(self, matrices: Array) -> Array:
        """Traces of (..., 6, 6), as (...)."""
        return np.asarray(np.trace(matrices, axis1=-2, axis2=-1), dtype=np.float64)

    def gains(self, matrix: Array, blocks: Array) -> Array:
        """tr F_i."""
        return self.value(blocks)

    def price(self, matrix: Array) -> Array:
        """The unit matrix."""
        return np.eye(6)

    def upper_bound(self, price: Array, revenue: float) -> float:
        """The revenue s itself."""
        return revenue


@dataclass(frozen=True)
class KieferMean:
    """φ_p(M) = (Σ λ^−p / 6)^(−1/p) of the eigenvalues λ: the harmonic mean for p = 1, λ_min for p = ∞."""

    submodular: ClassVar[bool] = False
    p: float
    """1 ≤ p ≤ ∞."""

    def value(self, matrices: Array) -> Array:
        """φ_p of (..., 6, 6), as (...); λ_min where a matrix is not positive definite."""
        return self._mean(np.asarray(np.linalg.eigvalsh(matrices), dtype=np.float64))

    def gains(self, matrix: Array, blocks: Array) -> Array:
        """φ_p(M + F_i) − φ_p(M)."""
        return self.value(matrix + blocks) - self.value(matrix)

    def price(self, matrix: Array) -> Array:
        """Σ (φ_p / λ)^(p+1) v vᵀ / 6; v vᵀ of the smallest λ alone for p = ∞."""
        eigenvalues, vectors = np.linalg.eigh(matrix)
        if np.isinf(self.p):
            return np.outer(vectors[:, 0], vectors[:, 0])
        share = (self._mean(eigenvalues) / eigenvalues) ** (self.p + 1.0) / 6.0
        price: Array = (vectors * share) @ vectors.T
        return price

    def upper_bound(self, price: Array, revenue: float) -> float:
        """s / tr(Y), for λ_min."""
        return revenue / float(np.trace(price))

    def _mean(self, eigenvalues: Array) -> Array:
        smallest = eigenvalues[..., 0]
        if np.isinf(self.p):
            return np.asarray(smallest, dtype=np.float64)
        # Relative to the smallest eigenvalue, so that no power overflows.
        definite = smallest > 0.0
        ratios = np.where(definite, smallest, 1.0)[..., None] / np.where(
            definite[..., None], eigenvalues, 1.0
        )
        mean = smallest * np.mean(ratios**self.p, axis=-1) ** (-1.0 / self.p)
        return np.where(definite, mean, smallest)


LAMBDA_MIN = KieferMean(np.inf)

OBJECTIVES: dict[str, LogDet | Trace | KieferMean] = {
    "logdet": LogDet(),
    "trace": Trace(),
    "lambda_min": LAMBDA_MIN,
}
"""The criteria that a selection may maximise, by the names that the command line uses."""


@dataclass(frozen=True)
class Optimality:
    """Scalars of the information F in the camera frame, translation in units of the length scale.

    The larger log det F and λ_min, and the smaller tr F⁻¹, the better.
    """

    log_det: float
    """D-optimality, log det F; minus infinity where a direction is unseen."""
    trace_inverse: float
    """A-optimality, tr F⁻¹ [rad² or length scale²]; infinite where a direction is unseen."""
    smallest_eigenvalue: float
    """E-optimality, λ_min; zero where a direction is unseen."""

    @classmethod
    def of(cls, precision: Array) -> Optimality:
        """Those of F (6, 6), positive definite."""
        return cls(
            log_det=float(LogDet().value(precision)),
            trace_inverse=float(6.0 / KieferMean(1.0).value(precision)),
            smallest_eigenvalue=float(LAMBDA_MIN.value(precision)),
        )
