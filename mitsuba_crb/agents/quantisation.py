"""An information matrix in few bits, rounded so that it never claims more than the original.

Rows are scaled by powers of two, F = D G D with 1/4 < G_ii ≤ 1, and G is stored in one of three forms P:

    full     P = H + u R                 42 numbers: the upper triangles of G and of its rounding's remainder
    factor   P = L Lᵀ                    21 numbers, lower triangular
    sketch   P = Σ_{i ≤ k} ± c_i c_iᵀ    6 k numbers, the k eigenvectors of the largest |eigenvalues|

With hats for rounded numbers and u their unit roundoff, what is decoded is D (α P̂ − δ 1) D ⪯ F:

- where F is well enough conditioned for the precision, δ = 0 and α, close to 1, is the largest that keeps
  α P̂ ⪯ G. The loss is that of the weakest direction. In the full form an error u² ‖G‖ is weighed against
  λ_min; in the factored ones it is u √(λ_max λ_min), and the rounding of each row makes up for that of the
  rows before it as seen through L⁻¹ (Babai's nearest plane), so that factors reach twice the digits.
- otherwise, singular and indefinite matrices included, α = 1 and δ = ‖P̂ − G‖ ≤ 8 u ‖G‖ (plus −λ_min of an
  indefinite G in the factor, and of what a sketch leaves out). No rounded positive semi-definite matrix lies
  below a singular one, so that λ_min(decoded) ≥ −2δ is all there can be.

One number per entry would not do for the full form, however it is rounded and shrunk. Entries near one
another are multiples of their spacing, so that with v = (1, −1) and w = (1, 1) in two nearly equal rows vᵀP̂v
is either ≤ 0 or above some (u/4) wᵀP̂w. A P̂ ⪯ F that keeps the fraction f of both exists only up to the
condition 4/(f u): 8700 for float16 and f = 0.94, 7e7 for float32.

References: Babai, "On Lovász' lattice reduction and the nearest lattice point problem", Combinatorica 1986;
Higham, "Accuracy and Stability of Numerical Algorithms", 2nd ed., chapter 10.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..errors import MessageError
from ..information.symmetric import pack, symmetrised, unpack
from ..noise.covariance import roots
from ..se3 import Array

Form: TypeAlias = Literal["full", "factor", "sketch"]
Precision: TypeAlias = Literal["float16", "float32"]

FORMS: tuple[Form, ...] = ("full", "factor", "sketch")
UNIT_ROUNDOFF: dict[Precision, float] = {"float16": 2.0**-11, "float32": 2.0**-24}
"""Largest relative error of a rounded number."""

LARGEST_EXPONENT = 127
"""Rows are scaled by 2^±127 at most, one signed byte."""

LARGEST_SCALE, LARGEST_SHIFT, LARGEST_NUMBER = 4.0, 16.0, 4.0
"""α, δ and the numbers are below these by construction; anything else is a corrupt message."""

# Below this fraction kept, subtracting δ (which spares the strong directions) is the better bargain.
_SMALLEST_KEPT = 0.5
# If a rounding keeps less than this, other scalings of the factor round differently and are tried, too.
_GOOD = 1.0 - 2.0**-6
_TRIAL_SCALES = (1.0, 0.97, 0.93, 0.89, 0.86, 0.83, 0.79, 0.77)
_RANK_TOLERANCE = 6.0 * np.finfo(np.float64).eps
_LOWER = np.tril_indices(6)


@dataclass(frozen=True, eq=False)
class QuantisedInformation:
    """A rounded information matrix: the numbers that a message carries."""

    form: Form
    """How the matrix follows from the numbers."""
    precision: Precision
    """Type of the numbers."""
    numbers: Array
    """(42,) upper triangles H and R, (21,) lower triangular factor by rows, or (6 k,) k columns."""
    signs: NDArray[np.int8]
    """(k,), ±1 for every column of a sketch; empty in the other forms."""
    exponents: NDArray[np.int8]
    """(6,), D = diag(2^exponents)."""
    scale: float
    """α, a float32."""
    shift: float
    """δ, a float32: the decoded matrix is above −2δ D² (for F ⪰ 0)."""

    @property
    def rank(self) -> int:
        """Directions that are sent: 6, or the columns of a sketch."""
        return len(self.signs) if self.form == "sketch" else 6

    @property
    def row_scales(self) -> Array:
        """(6,), the diagonal of D."""
        return np.ldexp(1.0, self.exponents.astype(np.int64))

    @property
    def scaled_matrix(self) -> Array:
        """(6, 6), α P̂ − δ 1."""
        return self.scale * _product(self) - self.shift * np.eye(6)

    @property
    def matrix(self) -> Array:
        """(6, 6), the decoded information D (α P̂ − δ 1) D."""
        d = self.row_scales
        return d[:, None] * self.scaled_matrix * d


def number_count(form: Form, rank: int) -> int:
    """How many numbers a form needs."""
    return {"full": 42, "factor": 21, "sketch": 6 * rank}[form]


def quantise(matrix: Array, *, form: Form, precision: Precision, rank: int = 6) -> QuantisedInformation:
    """Round an information matrix downwards.

    Args:
        matrix: (6, 6), symmetric; an unbiased estimate, so possibly indefinite.
        form: `"full"`, `"factor"` or `"sketch"`.
        precision: `"float16"` or `"float32"`.
        rank: columns of a sketch, 1 to 6.

    Raises:
        MessageError: entries too large or too small for the scaling's range.
    """
    exponents = _row_exponents(matrix)
    d = np.ldexp(1.0, -exponents.astype(np.int64))
    G = d[:, None] * matrix * d
    values, vectors = np.linalg.eigh(G)
    scaled = _Scaled(exponents, G, values, vectors)
    if values[0] > _RANK_TOLERANCE * values[-1]:
        definite = _below_definite(scaled, form, precision, rank)
        if definite is not None:
            return definite
    return _below_any(scaled, form, precision, rank)


def kept_fraction(decoded: Array, matrix: Array, rank: int = 6) -> float:
    """The smallest fraction vᵀ decoded v / vᵀ F v over the `rank` directions kept best, within [0, 1].

    Directions that F itself does not have are left out; 1 if there are no others.
    """
    _, whiten = roots(matrix, _RANK_TOLERANCE)
    if whiten.shape[1] == 0:
        return 1.0
    fractions = np.linalg.eigvalsh(whiten.T @ decoded @ whiten)
    return float(np.clip(fractions[-min(rank, len(fractions))], 0.0, 1.0))


@dataclass(frozen=True, eq=False)
class _Scaled:
    """F = D G D, D = diag(2^exponents), and G's eigenvalues, ascending, with eigenvectors."""

    exponents: NDArray[np.int8]
    G: Array
    values: Array
    vectors: Array


def _below_definite(
    scaled: _Scaled, form: Form, precision: Precision, rank: int
) -> QuantisedInformation | None:
    """The rounding α P̂ ⪯ G that keeps most, or None if that is too little. G positive definite."""
    L = np.asarray(np.linalg.cholesky(scaled.G), dtype=np.float64)
    whiten = np.linalg.inv(L)
    signs = np.ones(rank if form == "sketch" else 0, dtype=np.int8)
    best, most = None, _SMALLEST_KEPT
    for t in _TRIAL_SCALES:
        if form == "full":
            numbers = _rounded_twice(t * pack(scaled.G), precision)
        elif form == "factor":
            numbers = _rounded_through(L, t * L, precision)[_LOWER]
        else:
            columns = t * scaled.vectors[:, -rank:] * np.sqrt(scaled.values[-rank:])
            numbers = _rounded_through(L, columns, precision).T.ravel()
        trial = QuantisedInformation(form, precision, numbers, signs, scaled.exponents, 1.0, 0.0)
        fractions = np.linalg.eigvalsh(whiten @ trial.scaled_matrix @ whiten.T)
        # α in float32, rounded down, with room for the rounding of this very computation in float64.
        scale = float(np.nextafter(np.float32((1.0 - 1e-14) / fractions[-1]), np.float32(0.0)))
        kept = scale * float(fractions[-trial.rank])
        if kept > most and scale <= LARGEST_SCALE:
            best, most = replace(trial, scale=scale), kept
        if most > _GOOD:
            break
    return best


def _below_any(scaled: _Scaled, form: Form, precision: Precision, rank: int) -> QuantisedInformation:
    """The rounding P̂ − δ 1 ⪯ G, for any symmetric G."""
    values, vectors = scaled.values, scaled.vectors
    signs = np.empty(0, dtype=np.int8)
    if form == "full":
        numbers = _rounded_twice(pack(scaled.G), precision)
    elif form == "factor":
        # The factor of G + c 1, whose surplus c goes into δ.
        root = vectors * np.sqrt(values - min(float(values[0]), 0.0))
        numbers = _rounded(np.linalg.qr(root.T)[1].T[_LOWER], precision)
    else:
        largest = np.sort(np.argsort(np.abs(values))[-rank:])
        signs = np.where(values[largest] < 0.0, -1, 1).astype(np.int8)
        numbers = _rounded((vectors[:, largest] * np.sqrt(np.abs(values[largest]))).T.ravel(), precision)
    trial = QuantisedInformation(form, precision, numbers, signs, scaled.exponents, 1.0, 0.0)
    error = np.linalg.eigvalsh(trial.scaled_matrix - scaled.G)
    # The full form must not fall below −2δ either, hence both signs; products of factors are never negative.
    delta = max(float(error[-1]), -float(error[0]) if form == "full" else 0.0)
    if delta > 0.0:
        delta = float(np.nextafter(np.float32(delta + 1e-15), np.float32(np.inf)))
    return replace(trial, shift=delta)


def _product(quantised: QuantisedInformation) -> Array:
    """P̂, (6, 6)."""
    if quantised.form == "full":
        high, remainder = quantised.numbers.reshape(2, 21)
        return unpack(high + UNIT_ROUNDOFF[quantised.precision] * remainder)
    if quantised.form == "factor":
        L = np.zeros((6, 6))
        L[_LOWER] = quantised.numbers
        return symmetrised(L @ L.T)
    columns = quantised.numbers.reshape(-1, 6).T
    return symmetrised((columns * quantised.signs) @ columns.T)


def _row_exponents(matrix: Array) -> NDArray[np.int8]:
    """Powers of two above √F_ii, and large enough for every |F_ij| ≤ d_i d_j, which F ⪰ 0 gives by itself."""
    absolute = np.abs(matrix)
    d = np.sqrt(np.diagonal(absolute))
    d = np.where(d > 0.0, d, np.sqrt(absolute.max(axis=0)))
    d = np.where(d > 0.0, d, 1.0)
    for i in range(6):
        d[i] = max(d[i], float((absolute[i] / d).max()))
    exponents = np.ceil(np.log2(d))
    if np.abs(exponents).max() > LARGEST_EXPONENT:
        raise MessageError(
            f"the information's entries reach {absolute.max():.3g}; a message carries 1e-76 to 1e76, "
            "so choose another length unit"
        )
    return exponents.astype(np.int8)


def _rounded(numbers: Array, precision: Precision) -> Array:
    return numbers.astype(precision).astype(np.float64)


def _rounded_twice(numbers: Array, precision: Precision) -> Array:
    """Rounded numbers, then what that left out, in units of u, rounded."""
    high = _rounded(numbers, precision)
    return np.concatenate([high, _rounded((numbers - high) / UNIT_ROUNDOFF[precision], precision)])


def _rounded_through(L: Array, columns: Array, precision: Precision) -> Array:
    """Round columns (6, k) so that L⁻¹ times their errors stays small, row by row (nearest plane)."""
    rounded = np.zeros_like(columns)
    whitened_error = np.zeros_like(columns)
    for i in range(6):
        carried = L[i, :i] @ whitened_error[:i]
        rounded[i] = _rounded(columns[i] + carried, precision)
        whitened_error[i] = (rounded[i] - columns[i] - carried) / L[i, i]
    return rounded
