"""Independent Gaussian noise, and a few patterns of random strength on top: Σ = D + U Uᵀ.

Banding, flicker, vignetting that changes, dirt on the lens. (Σ_PP)⁻¹ is exact by Woodbury's identity,
D⁻¹ − D⁻¹U (1 + UᵀD⁻¹U)⁻¹ UᵀD⁻¹, on the rows of the selected pixels.

Reference: Golub and Van Loan, "Matrix Computations", 4th ed., section 2.1.4.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import NoiseError
from .parameters import array, at_pixels, check_map, variance_map
from .protocol import Array, CoupledNoise


@dataclass(frozen=True, eq=False)
class LowRankPlusDiagonal(CoupledNoise):
    """Σ = D + U Uᵀ, D diagonal, U of few columns."""

    variance: Array
    """D, (H, W) or (H, W, C) [radiance²]; an infinite variance makes the estimator ignore that value."""
    modes: Array
    """Uᵀ, (r, H, W), alike in all channels, or (r, H, W, C) [radiance]: patterns of unit random strength."""

    def __init__(self, variance: ArrayLike, modes: ArrayLike) -> None:
        diagonal = variance_map(variance, "LowRankPlusDiagonal")
        patterns = array(modes, "LowRankPlusDiagonal")
        if patterns.ndim not in (3, 4) or patterns.shape[1:3] != diagonal.shape[:2]:
            raise NoiseError(
                f"modes must have shape (r, H, W) or (r, H, W, C) with the variances' "
                f"{diagonal.shape[:2]}, not {patterns.shape}"
            )
        if not np.isfinite(patterns).all():
            raise NoiseError("the modes have entries that are not finite")
        object.__setattr__(self, "variance", diagonal)
        object.__setattr__(self, "modes", patterns)

    @property
    def description(self) -> str:
        """One short phrase for tables."""
        sigma = np.sqrt(np.median(self.variance))
        return f"Gaussian, median sigma = {sigma:.4g}, and {len(self.modes)} random patterns"

    def check(self, height: int, width: int, channels: int) -> None:
        """Variances and modes must have the image's size, and one or all of its channels."""
        check_map(self.variance.shape, height, width, channels, "variance map")
        check_map(self.modes.shape[1:], height, width, channels, "map of modes")

    def solve(self, pixels: NDArray[np.integer], values: Array) -> Array:
        """(Σ_PP)⁻¹ of columns (n, C, m), by Woodbury's identity."""
        n, C, m = values.shape
        weights = 1.0 / at_pixels(self.variance, pixels, "variance map").reshape(n, -1, 1)
        modes = at_pixels(np.moveaxis(self.modes, 0, 2), pixels, "map of modes")
        r = len(self.modes)
        U = np.broadcast_to(modes.reshape(n, r, -1).swapaxes(1, 2), (n, C, r)).reshape(n * C, r)
        scaled = (np.broadcast_to(weights, (n, C, 1)) * U.reshape(n, C, r)).reshape(n * C, r)
        columns = (weights * values).reshape(n * C, m)
        inner = np.eye(r) + U.T @ scaled
        solved = columns - scaled @ np.linalg.solve(inner, scaled.T @ values.reshape(n * C, m))
        return np.asarray(solved, dtype=np.float64).reshape(n, C, m)

    def to_dict(self) -> dict[str, Any]:
        """Shapes."""
        return {
            "model": "low_rank_plus_diagonal",
            "shape": list(self.variance.shape),
            "modes": len(self.modes),
        }
