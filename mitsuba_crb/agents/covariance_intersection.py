"""Fusion where the correlation between the sources is unknown: covariance intersection.

Agents that share a map, an earlier message or a rumour are not independent, and adding their information
counts it twice. For weights ω ≥ 0, Σ ω = 1, the convex combination

    F = Σ ω_i F_i,    x = F⁻¹ Σ ω_i F_i x_i

is consistent (Cov(x) ⪯ F⁻¹) whatever the correlation, provided that each source is. The weights minimise
det F⁻¹ or tr F⁻¹ (camera frame, translation in units of the length scale) over the directions that the
sources see together: a convex problem, solved by pairwise exchanges with exact line search, which stop once
the optimality gap is closed. Weights that are not optimal would be consistent, too.

References: Julier and Uhlmann, "A non-divergent estimation algorithm in the presence of unknown
correlations", ACC 1997; Lacoste-Julien and Jaggi, "On the global linear convergence of Frank-Wolfe
optimization variants", NIPS 2015 (pairwise steps).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from .. import se3
from ..errors import FusionError
from ..files import Record
from ..information.fisher import FisherInformation
from ..information.significance import identified
from ..noise.covariance import inverse_cholesky
from ..se3 import Array

_GAP = 1e-9
_EXCHANGES = 20_000
_BISECTIONS = 60


@dataclass(frozen=True, eq=False)
class Intersection(Record):
    """A consistent combination of sources of unknown correlation."""

    information: FisherInformation
    """Σ ω_i F_i, in the sources' frame."""
    weights: Array
    """(A,), ω."""
    gap: float
    """No other weights lower log det F⁻¹ by more than this, or tr F⁻¹ by more than this fraction."""
    gains: Array
    """(A, 6, 6), F⁺ ω_i F_i on the directions seen together: the estimate is Σ gains_i x_i."""

    def estimate(self, estimates: ArrayLike) -> Array:
        """The combined estimate (..., 6) of the sources' (..., A, 6), twists about the linearisation pose."""
        return np.asarray(np.einsum("aij,...aj->...i", self.gains, np.asarray(estimates, dtype=np.float64)))


def covariance_intersection(
    informations: Sequence[FisherInformation], *, minimise: Literal["det", "trace"] = "det"
) -> Intersection:
    """Combine sources about one pose whose correlation is unknown.

    Args:
        informations: of the same variable, frame and pose; `fusion.to_common` transports them.
        minimise: the determinant or the trace of the covariance.

    Raises:
        FusionError: no sources, or another criterion.
        FrameError: variables, frames or poses differ.
    """
    if not informations:
        raise FusionError("there are no sources to intersect")
    if minimise not in ("det", "trace"):
        raise FusionError(f"covariance intersection minimises 'det' or 'trace', not {minimise!r}")
    cameras = [information.to_frame("camera") for information in informations]
    even = reduce(add, (_weighted(camera, 1.0 / len(cameras)) for camera in cameras))
    basis = even.scale[:, None] * identified(even).seen
    blocks = np.array([basis.T @ camera.matrix @ basis for camera in cameras])
    weights, gap = _optimal_weights(blocks, minimise)
    total = reduce(add, (_weighted(camera, w) for camera, w in zip(cameras, weights, strict=True)))
    inverse = basis @ np.linalg.solve(np.einsum("a,aij->ij", weights, blocks), basis.T)
    gains = np.array([w * inverse @ camera.matrix for camera, w in zip(cameras, weights, strict=True)])
    frame = informations[0].frame
    if frame == "world":
        pose = cameras[0].pose
        gains = se3.adjoint(pose) @ gains @ se3.adjoint(se3.inverse(pose))
    return Intersection(total.to_frame(frame), weights, gap, gains)


def _weighted(information: FisherInformation, weight: float) -> FisherInformation:
    plain = information.plain_matrix
    return replace(
        information,
        matrix=weight * information.matrix,
        covariance_of_entries=weight**2 * information.covariance_of_entries,
        plain_matrix=None if plain is None else weight * plain,
    )


def _optimal_weights(blocks: Array, minimise: Literal["det", "trace"]) -> tuple[Array, float]:
    """Weights (A,) of the blocks (A, r, r), and the optimality gap.

    With M = Σ ω G, the derivative of log det M in ω_i is tr(M⁻¹ G_i), that of −tr M⁻¹ is tr(M⁻¹ G_i M⁻¹).
    Each step moves weight from the source with the smallest derivative to the one with the largest.
    """
    count, rank = len(blocks), blocks.shape[1]
    weights = np.full(count, 1.0 / count)
    gap = 0.0
    if count == 1 or rank == 0:
        return weights, gap
    for _ in range(_EXCHANGES):
        M = np.einsum("a,aij->ij", weights, blocks)
        whiten = inverse_cholesky(M)
        price = whiten.T @ whiten
        objective = float(rank)
        if minimise == "trace":
            objective, price = float(np.trace(price)), price @ price
        derivatives = np.einsum("aij,ij->a", blocks, price)
        best = int(np.argmax(derivatives))
        worst = int(np.argmin(np.where(weights > 0.0, derivatives, np.inf)))
        # Both objectives are concave with Σ ω_i derivative_i = `objective`: no weights gain more than this.
        gap = float(derivatives[best]) / objective - 1.0
        if minimise == "det":
            gap = rank * max(gap, 0.0)
        if gap <= _GAP or best == worst:
            break
        change = whiten @ (blocks[best] - blocks[worst]) @ whiten.T
        rates, axes = np.linalg.eigh(change)
        c = np.sum((whiten.T @ axes) ** 2, axis=0) if minimise == "trace" else None
        step = _line_search(rates, c, float(weights[worst]))
        weights[best] += step
        weights[worst] = 0.0 if step >= weights[worst] else weights[worst] - step
    return weights / weights.sum(), max(gap, 0.0)


def _line_search(rates: Array, c: Array | None, longest: float) -> float:
    """T in [0, longest] where the derivative of the objective along the exchange vanishes.

    log det(M + t Δ) grows as Σ log(1 + t μ_k), and tr (M + t Δ)⁻¹ is Σ c_k / (1 + t μ_k).
    """

    def rises(t: float) -> bool:
        growth = 1.0 + t * rates
        if growth.min() <= 0.0:
            return False
        return bool(np.sum(rates / growth if c is None else c * rates / growth**2) > 0.0)

    if rises(longest):
        return longest
    low, high = 0.0, longest
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if rises(middle) else (low, middle)
    return low
