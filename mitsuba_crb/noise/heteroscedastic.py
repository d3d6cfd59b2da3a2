"""Gaussian noise whose variance is a polynomial of the mean, v(μ) = c₀ + c₁ μ + c₂ μ² + ...

The variance tells of the mean, too: i(μ) = 1/v + ½ (v'/v)². As a model of photons (c₁ is the gain, c₀ the
read noise's variance) it is right in bright pixels only: in the dark, where few photons are counted, it
overstates the information; `PoissonGaussian` does not. Negative means, which filters with negative lobes
give, count as 0.

Reference: Kay, "Fundamentals of Statistical Signal Processing: Estimation Theory", 1993, equation (3.31).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import NDArray
from scipy.special import ndtr

from ..errors import NoiseError
from .gaussian import normal_density
from .parameters import array
from .protocol import Array, ScalarNoise


@dataclass(frozen=True)
class Heteroscedastic(ScalarNoise):
    """Gaussian noise of variance v(μ) = Σ c_k μᵏ."""

    coefficients: tuple[float, ...]
    """c₀ [radiance²], c₁ [radiance], c₂ [1], ...: read noise, photons, fixed pattern."""

    def __init__(self, coefficients: Sequence[float] | Array) -> None:
        values = array(coefficients, "Heteroscedastic")
        if values.ndim != 1 or values.size == 0 or not np.isfinite(values).all():
            raise NoiseError(f"Heteroscedastic expects finite coefficients c0, c1, ..., not {coefficients!r}")
        if not values[0] > 0.0:
            raise NoiseError(
                f"the variance of a black pixel, coefficient c0, must be positive, not {values[0]:g}"
            )
        object.__setattr__(self, "coefficients", tuple(values.tolist()))

    @property
    def description(self) -> str:
        """One short phrase for tables."""
        powers = ["", " mu", *(f" mu^{k}" for k in range(2, len(self.coefficients)))]
        terms = (f"{c:.3g}{power}" for c, power in zip(self.coefficients, powers, strict=False))
        return "Gaussian, variance = " + " + ".join(terms)

    @property
    def depends_on_mean(self) -> bool:
        """Unless the variance is constant."""
        return any(self.coefficients[1:])

    def check(self, height: int, width: int, channels: int) -> None:
        """Any image will do."""

    def weights(self, pixels: NDArray[np.integer], mean: Array) -> Array:
        """1/v + ½ (v'/v)² for every value of `mean` (n, C)."""
        v, slope = self._variance(mean)
        return np.asarray(1.0 / v + 0.5 * (slope / v) ** 2, dtype=np.float64)

    def spread(self, pixels: NDArray[np.integer], mean: Array) -> Array:
        """√v(μ), (n, C)."""
        return np.sqrt(self._variance(mean)[0])

    def cumulative(self, thresholds: Array, pixels: NDArray[np.integer], mean: Array) -> tuple[Array, Array]:
        """Φ(z), z = (threshold − μ)/√v(μ), and φ(z) dz/dμ."""
        v, slope = self._variance(mean)
        z = (thresholds - mean[..., None]) / np.sqrt(v)[..., None]
        dz = -1.0 / np.sqrt(v)[..., None] - 0.5 * z * (slope / v)[..., None]
        return ndtr(z), normal_density(z) * dz

    def to_dict(self) -> dict[str, Any]:
        """The model's parameters as JSON-able values."""
        return {"model": "heteroscedastic", "coefficients": list(self.coefficients)}

    def _variance(self, mean: Array) -> tuple[Array, Array]:
        """v(μ) and v'(μ)."""
        mean = np.maximum(mean, 0.0)
        v = np.asarray(polynomial.polyval(mean, self.coefficients), dtype=np.float64)
        if not (v > 0.0).all():
            worst = np.unravel_index(np.argmin(v), v.shape)
            raise NoiseError(
                f"the variance is {v[worst]:.3g} at the mean {mean[worst]:.3g}: the coefficients "
                f"{self.coefficients} must give positive variances for every mean of the image"
            )
        return v, np.asarray(
            polynomial.polyval(mean, polynomial.polyder(self.coefficients)), dtype=np.float64
        )
