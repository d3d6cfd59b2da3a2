"""Gaussian noise whose standard deviation is a function of the mean: that of depth sensors.

The spread tells of the mean, too: with σ' = dσ/dμ,

    i(μ) = 1/v + ½ (v'/v)² = (1 + 2 σ'²) / σ²,    v = σ².

Stereo triangulates z = f b / d from a disparity d [pixel], whose error σ_d makes σ = z² σ_d / (f b).

Reference: Kay, "Fundamentals of Statistical Signal Processing: Estimation Theory", 1993, equation (3.31).
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from ..errors import NoiseError
from .gaussian import normal_density
from .parameters import array, positive
from .protocol import Array, ScalarNoise


class SigmaOfMean(ScalarNoise):
    """Gaussian noise of standard deviation σ(μ); what has none, σ = 0, tells nothing."""

    @abstractmethod
    def sigma(self, mean: Array) -> tuple[Array, Array]:
        """σ(μ) and σ'(μ)."""

    @property
    def depends_on_mean(self) -> bool:
        """Yes."""
        return True

    def check(self, height: int, width: int, channels: int) -> None:
        """Any image will do."""

    def weights(self, pixels: NDArray[np.integer], mean: Array) -> Array:
        """(1 + 2 σ'²)/σ² for every value of `mean` (n, C)."""
        sigma, slope = self.sigma(mean)
        with np.errstate(divide="ignore"):
            return np.where(sigma > 0.0, (1.0 + 2.0 * slope**2) / sigma**2, 0.0)

    def spread(self, pixels: NDArray[np.integer], mean: Array) -> Array:
        """σ(μ), (n, C)."""
        return self.sigma(mean)[0]

    def cumulative(self, thresholds: Array, pixels: NDArray[np.integer], mean: Array) -> tuple[Array, Array]:
        """Φ(z), z = (threshold − μ)/σ(μ), and φ(z) dz/dμ = −φ(z) (1 + z σ')/σ."""
        sigma, slope = (part[..., None] for part in self.sigma(mean))
        z = (thresholds - mean[..., None]) / sigma
        return ndtr(z), -normal_density(z) * (1.0 + z * slope) / sigma


@dataclass(frozen=True)
class SigmaPower(SigmaOfMean):
    """σ = factor μ^exponent; means below zero count as 0."""

    factor: float
    """σ at the mean 1."""
    exponent: float
    """2 of stereo, 1 of an error in proportion."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "factor", positive(self.factor, "factor", "unit of the values"))
        object.__setattr__(self, "exponent", positive(self.exponent, "exponent", "1"))

    @property
    def description(self) -> str:
        """One short phrase for tables."""
        power = "" if self.exponent == 1.0 else f"^{self.exponent:g}"
        return f"Gaussian, sigma = {self.factor:.4g} mu{power}"

    def sigma(self, mean: Array) -> tuple[Array, Array]:
        """Of a power."""
        mean = np.maximum(mean, 0.0)
        sigma = self.factor * mean**self.exponent
        slope = self.exponent * np.divide(sigma, mean, out=np.zeros_like(sigma), where=mean > 0.0)
        return sigma, slope

    def to_dict(self) -> dict[str, Any]:
        """The model's parameters as JSON-able values."""
        return {"model": "sigma_power", "factor": self.factor, "exponent": self.exponent}


@dataclass(frozen=True)
class SigmaTable(SigmaOfMean):
    """σ linear between the rows of a table, and constant beyond its ends."""

    means: tuple[float, ...]
    """Increasing."""
    sigmas: tuple[float, ...]
    """At these means."""

    def __init__(self, means: ArrayLike, sigmas: ArrayLike) -> None:
        x, y = array(means, "SigmaTable"), array(sigmas, "SigmaTable")
        if x.ndim != 1 or x.shape != y.shape or x.size < 2:
            raise NoiseError(
                f"a table of sigma needs as many means as sigmas, two at least; got {x.shape}, {y.shape}"
            )
        if not np.isfinite(x).all() or not (np.diff(x) > 0.0).all():
            row = int(np.argmin(np.append(np.diff(x) > 0.0, False)))
            raise NoiseError(f"the means of a table of sigma must increase; row {row + 2} does not")
        for value in y:
            positive(value, "sigma in a table", "unit of the values")
        object.__setattr__(self, "means", tuple(x.tolist()))
        object.__setattr__(self, "sigmas", tuple(y.tolist()))

    @property
    def description(self) -> str:
        """One short phrase for tables."""
        return (
            f"Gaussian, sigma = {self.sigmas[0]:.4g} at {self.means[0]:.4g} to {self.sigmas[-1]:.4g} at "
            f"{self.means[-1]:.4g}, a table of {len(self.means)} rows"
        )

    def sigma(self, mean: Array) -> tuple[Array, Array]:
        """Of a table."""
        x, y = np.array(self.means), np.array(self.sigmas)
        slopes = np.concatenate([[0.0], np.diff(y) / np.diff(x), [0.0]])
        return np.interp(mean, x, y), slopes[np.searchsorted(x, mean, side="right")]

    def to_dict(self) -> dict[str, Any]:
        """The model's parameters as JSON-able values."""
        return {"model": "sigma_table", "means": list(self.means), "sigmas": list(self.sigmas)}


@dataclass(frozen=True)
class Stereo:
    """A pair of cameras side by side, whose noise of depth follows from their focal length."""

    baseline: float
    """Between them [scene unit]."""
    disparity_sigma: float
    """Standard deviation of a disparity [pixel]."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "baseline", positive(self.baseline, "stereo's baseline", "scene unit"))
        sigma = positive(self.disparity_sigma, "stereo's sigma of the disparity", "pixel")
        object.__setattr__(self, "disparity_sigma", sigma)

    def __str__(self) -> str:
        return f"stereo, baseline {self.baseline:g}, disparity ± {self.disparity_sigma:g} pixels"

    def noise(self, focal_length: float) -> SigmaPower:
        """σ = z² σ_d/(f b), f the focal length [pixel]."""
        return SigmaPower(self.disparity_sigma / (focal_length * self.baseline), 2.0)
