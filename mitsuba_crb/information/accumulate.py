"""Fisher information of a pose from independent estimates of the image's Jacobian, without noise bias.

For K independent, unbiased estimates J_1 .. J_K of the Jacobian J and a noise precision W = Σ⁻¹,

    F̂ = [ (Σ J_k)ᵀ W (Σ J_k) − Σ J_kᵀ W J_k ] / (K (K − 1))  =  mean over k < l of  sym(J_kᵀ W J_l)

is unbiased for F = JᵀWJ, where the plain ĴᵀWĴ of the mean Ĵ is too large by E[δJᵀ W δJ]. It is symmetric, but
positive semi-definite only in expectation. The covariance of its entries (`ustatistic`) is summed over units
with independent errors: groups of pixels, or the blocks of pixels that share samples; what a random subset
of the pixels says of the whole image is `sampled`'s. A bias b_u F_u that pixels may have in common adds the
square of its sum, and so does what the noise of an image does to the weights made of it. Conventions: `se3`.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import NoiseError, OptionError, PixelsError, RadianceError, SaturatedError
from ..se3 import Array
from .block_variance import BlockProducts
from .blocks import in_squares
from .coupled import CoupledComponents, mean_of_ordered, ordered_products
from .fisher import FisherInformation
from .linearisation import Linearisation, PixelSelection
from .sampled import SampledComponents
from .symmetric import congruence, entries, pack, symmetrised, unpack
from .ustatistic import (
    VarianceComponents,
    gram,
    mean_of_batches,
    square_root,
    unit_grams,
    unit_products,
    whiten,
)

MINIMUM_BATCHES = 4
"""Two disjoint pairs of batches are needed to estimate the variance without bias."""


_UNIT = 4
"""Side [pixel] of the units whose products are summed where pixels are independent: larger units would say
less of the variance, single pixels take ten times as long."""


_CHUNK = 4096  # pixels whose products are held at once, about


class Coupling(Protocol):
    """What couples pixels: a noise that is correlated between them."""

    def solve(self, pixels: NDArray[np.integer], values: Array) -> Array:
        """See `CoupledNoise.solve`."""


@dataclass(frozen=True, eq=False)
class Sums:
    """What an `InformationAccumulator` has summed, for all of its P columns."""

    matrix: Array
    """(P, P), F̂."""
    covariance_of_entries: Array
    """(E, E), E = P (P + 1) / 2, of its upper triangle in `numpy.triu_indices(P)` order."""
    plain_matrix: Array
    """(P, P), ĴᵀWĴ."""
    bias: Array
    """(P, P), Σ b_u F̂_u, what F̂ may be wrong by for the way pixels were measured; its square is in the
    covariance."""

    def transform(self, old_from_new: Array) -> Sums:
        """Aᵀ F A of the columns J A, A (P, Q), and the covariance of its entries."""
        A, T = old_from_new, congruence(old_from_new)
        return Sums(
            symmetrised(A.T @ self.matrix @ A),
            T @ self.covariance_of_entries @ T.T,
            symmetrised(A.T @ self.plain_matrix @ A),
            symmetrised(A.T @ self.bias @ A),
        )

    def information(self, linearisation: Linearisation) -> FisherInformation:
        """The information of a pose that these sums (P = 6) are."""
        return FisherInformation(
            matrix=self.matrix,
            covariance_of_entries=self.covariance_of_entries,
            plain_matrix=self.plain_matrix,
            linearisation=linearisation,
        )


class InformationAccumulator:
    """Streams the information of an image, block by block; the tiles' sizes and order do not matter.

    Every call adds whole blocks: all selected pixels of one block of the film must come in the same call,
    because the variance is estimated per block. Tiles with sides that are multiples of `BLOCK` satisfy this.
    """

    def __init__(
        self,
        *,
        batches: int,
        block: int = 1,
        sampled: bool = False,
        columns: int = 6,
        coupled: bool = False,
        kept: BlockProducts | None = None,
    ) -> None:
        """Start from nothing.

        Args:
            batches: K ≥ 4, independent estimates per pixel.
            block: side [pixel] of the film blocks whose errors are independent of one another. The smaller,
                the more certain the standard errors.
            sampled: also sum what the sampling variance of a random pixel subset needs (slower).
            columns: P, six of the twist and one for each nuisance parameter.
            coupled: the noise is correlated between pixels: `add_coupled` takes the place of `add`.
            kept: where to keep what each unit contributes.

        Raises:
            OptionError: fewer than four batches.
            NoiseError: correlated noise and a random subset, which tells nothing of the whole image.
        """
        if batches < MINIMUM_BATCHES:
            raise OptionError(f"batches must be at least {MINIMUM_BATCHES}, not {batches}")
        if coupled and sampled:
            raise NoiseError(
                "noise is correlated between pixels, so a random subset cannot stand for the whole image; "
                "measure all pixels, or give a mask"
            )
        self._batches = batches
        self._block = block
        self._blocks: set[int] = set()
        self._count = 0
        self._informative = False
        self._columns = columns
        self._sum = np.zeros(entries(columns))
        self._plain = np.zeros((columns, columns))
        self._bias = np.zeros(entries(columns))
        self._weight_bias = np.zeros(entries(columns))
        self._of_weights = np.zeros((entries(columns), entries(columns)))
        components = CoupledComponents if coupled else SampledComponents if sampled else VarianceComponents
        self._units = components(batches, columns)
        self._kept = self._units.kept = kept

    def add(
        self,
        batch_values: ArrayLike,
        weights: ArrayLike,
        pixels: ArrayLike,
        bias: NDArray[np.float64] | None = None,
        weight_bias: NDArray[np.float64] | None = None,
    ) -> None:
        """Add the pixels of some whole blocks.

        Args:
            batch_values: (K, n, C, P), independent estimates of ∂I/∂ξ, then in the nuisance parameters.
            weights: (n, C) inverse noise variances, or (n, C, C) information that pixels carry about their
                means, see `IndependentNoise.weights`.
            pixels: (n, 2), column x and row y.
            bias: (n,) relative error, of one sign and all pixels' alike, that their information may have by
                the way they were measured; it enters the covariance.
            weight_bias: as `weights`, of either sign, by which their expectations may be off for the noise of
                the image that they were made of; it enters the covariance.

        Raises:
            OptionError: the number of batches is not the one announced.
            PixelsError: shapes do not fit, a pixel comes twice, or a block comes in two calls.
            NoiseError: a weight is negative or not finite.
            RadianceError: a derivative is not finite.
        """
        values = np.asarray(batch_values, dtype=np.float64)
        precision = np.asarray(weights, dtype=np.float64)
        positions = np.asarray(pixels)
        self._check(values, positions)
        if precision.shape not in (values.shape[1:3], (*values.shape[1:3], values.shape[2])):
            raise NoiseError(
                f"weights must have shape {values.shape[1:3]}, or blocks of channels, not {precision.shape}"
            )
        if len(positions) == 0:
            return
        root = square_root(precision)
        if bias is not None and bias.any():
            rows = np.flatnonzero(bias)
            self._bias += bias[rows] @ _weighed(values[:, rows], precision[rows])
        if weight_bias is not None and weight_bias.any():
            rows = np.flatnonzero(weight_bias.any(axis=tuple(range(1, weight_bias.ndim))))
            own = _weighed(values[:, rows], weight_bias[rows])
            self._weight_bias += own.sum(axis=0)
            self._of_weights += own.T @ own
        order, starts = self._order(positions)
        in_order = not np.any(np.diff(order) < 0)
        self._count += len(positions)
        self._informative = self._informative or bool(precision.any())
        edges = np.array([0, len(order)])
        if isinstance(self._units, SampledComponents):  # units of one pixel and of two come apart
            edges = np.insert(edges, 1, starts[np.searchsorted(np.diff(starts), [2, 3])])
        even = [np.linspace(a, b, -(-(b - a) // _CHUNK), endpoint=False) for a, b in pairwise(edges)]
        cuts = np.unique(np.searchsorted(starts, np.append(np.concatenate(even), len(order))))
        for low, high in pairwise(cuts):
            part: Any = slice(starts[low], starts[high])
            part = part if in_order else order[part]
            whitened = whiten(values[:, part], root[part])
            own = starts[low : high + 1] - starts[low]
            if self._kept is not None:
                self._kept.corners(positions[order[starts[low:high]]])
            if isinstance(self._units, SampledComponents):
                self._sum += self._units.add(whitened, own)
                self._plain += gram(whitened.mean(axis=1).mT).sum(axis=0)
            else:
                grams = unit_grams(whitened, own)
                self._sum += self._units.add(unit_products(grams, self._batches)).sum(axis=1)
                self._plain += mean_of_batches(grams.sum(axis=0), self._batches)

    def add_coupled(
        self,
        batch_values: ArrayLike,
        noise: Coupling,
        pixels: ArrayLike,
        bias: NDArray[np.float64] | None = None,
    ) -> None:
        """Add all pixels of an image whose noise is correlated between them: they must come in one call.

        Args:
            batch_values: (K, n, C, P), as for `add`.
            noise: solves with the covariance of these pixels' noise.
            pixels: (n, 2), column x and row y.
            bias: (n,), as for `add`; a pixel's information is sym(J_uᵀ(Σ⁻¹J)_u).

        Raises:
            NoiseError: the accumulator was not made for coupled pixels.
            MitsubaCRBError: as `add`, and whatever `noise.solve` raises.
        """
        components = self._units
        if not isinstance(components, CoupledComponents):
            raise NoiseError("noise that couples pixels needs InformationAccumulator(..., coupled=True)")
        values = np.asarray(batch_values, dtype=np.float64)
        positions = np.asarray(pixels)
        self._check(values, positions)
        if len(positions) == 0:
            return
        order, starts = self._order(positions)
        self._count += len(positions)
        columns = values[:, order].transpose(1, 2, 0, 3)
        n, C, K, P = columns.shape
        solved = noise.solve(positions[order], columns.reshape(n, C, K * P)).reshape(n, C, K, P)
        self._informative = self._informative or bool(solved.any())
        if bias is not None and bias.any():
            by_bias = (bias[order, None, None, None] * columns).reshape(1, n * C, K, P)
            products = ordered_products(by_bias, solved.reshape(1, n * C, K, P))
            self._bias += mean_of_ordered(products)[:, 0]
        self._plain += symmetrised(
            columns.mean(axis=2).reshape(n * C, P).T @ solved.mean(axis=2).reshape(n * C, P)
        )
        for low in range(0, len(starts) - 1, _CHUNK):
            if self._kept is not None:
                self._kept.corners(positions[order[starts[low : min(low + _CHUNK, len(starts) - 1)]]])
            units = [
                ordered_products(
                    columns[start:stop].reshape(1, -1, K, P), solved[start:stop].reshape(1, -1, K, P)
                )
                for start, stop in pairwise(starts[low : low + _CHUNK + 1])
            ]
            self._sum += components.add(np.concatenate(units, axis=-1)).sum(axis=1)

    def information(self, linearisation: Linearisation) -> FisherInformation:
        """The information of everything added so far, scaled to the whole image for a random subset.

        Raises:
            PixelsError: nothing was added, more pixels than selected, or a random subset without `sampled`.
        """
        return self.sums(linearisation.selection).information(linearisation)

    @property
    def added(self) -> Sums:
        """F̂ of all P columns from the pixels added so far and of no others; zero if they tell nothing."""
        covariance = self._units.positive + self._of_bias
        return Sums(unpack(self._sum), covariance, self._plain, unpack(self._bias))

    def sums(self, selection: PixelSelection) -> Sums:
        """F̂ of all P columns from everything added so far, scaled to the whole image for a random subset.

        Raises:
            PixelsError: as `information`.
            SaturatedError: no pixel tells anything.
        """
        n, N = selection.selected, selection.total
        if self._count == 0:
            raise PixelsError("no pixels were measured, so there is no information to report")
        if self._count > n or n > N:
            raise PixelsError(f"{self._count} pixels were added, {n} selected, of {N} in the image")
        if not self._informative:
            raise SaturatedError(
                f"the noise model leaves no information in any of {self._count} pixels: all are saturated or "
                "ignored; change the exposure, or the variances"
            )
        if selection.kind != "random" or n == N:
            return self.added
        if not isinstance(self._units, SampledComponents):
            raise PixelsError("a random pixel subset needs InformationAccumulator(batches=..., sampled=True)")
        if n < 2:
            raise PixelsError("a random subset of one pixel has no sampling variance; select at least two")
        covariance = self._units.covariance(self._sum, n, N) + (N / n) ** 2 * self._of_bias
        return Sums(N / n * unpack(self._sum), covariance, N / n * self._plain, N / n * unpack(self._bias))

    @property
    def _of_bias(self) -> Array:
        """(E, E), what either bias adds to the covariance; of that of weights the sum is itself uncertain."""
        own = np.outer(self._bias, self._bias) + np.outer(self._weight_bias, self._weight_bias)
        return np.asarray(own + self._of_weights)

    def _order(self, pixels: NDArray[np.integer]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """By unit, then by pixel, so that the sums do not depend on the order given: see `in_squares`."""
        alone = 1 if isinstance(self._units, SampledComponents) else _UNIT
        side = self._block if self._block > 1 else alone
        order, starts = in_squares(pixels, side)
        if self._block > 1:
            column, row = pixels[order[starts[:-1]]].T.astype(np.int64) // side
            blocks = (row << 32 | column).tolist()
            if not self._blocks.isdisjoint(blocks):
                raise PixelsError(
                    f"a {side} x {side} block came in two calls; use tile sides that are multiples of {side}"
                )
            self._blocks.update(blocks)
        return order, starts

    def _check(self, values: Array, pixels: NDArray[Any]) -> None:
        if values.ndim != 4 or values.shape[-1] != self._columns:
            raise PixelsError(f"batch values must have shape (K, n, C, {self._columns}), not {values.shape}")
        if values.shape[0] != self._batches:
            raise OptionError(f"got {values.shape[0]} batches, expected {self._batches}")
        if pixels.shape != (values.shape[1], 2) or not np.issubdtype(pixels.dtype, np.integer):
            raise PixelsError(f"pixels must be integers of shape ({values.shape[1]}, 2), not {pixels.shape}")
        if pixels.size and pixels.min() < 0:
            raise PixelsError("pixel coordinates must not be negative")
        if not np.isfinite(values.sum()):
            bad = int(np.count_nonzero(~np.isfinite(values).all(axis=(0, 2, 3))))
            raise RadianceError(f"the Jacobian is not finite at {bad} of {len(pixels)} pixels")


def _weighed(values: Array, weights: Array) -> Array:
    """(n, E) of each pixel, the mean over k < l of sym(J_kᵀ W J_l), of any symmetric weights."""
    K = len(values)
    wide = weights[..., None] * values if weights.ndim == 2 else np.einsum("nij,knjp->knip", weights, values)
    sums = values.sum(axis=0).mT @ wide.sum(axis=0) - (values.mT @ wide).sum(axis=0)
    return pack(symmetrised(sums)) / (K * (K - 1))
