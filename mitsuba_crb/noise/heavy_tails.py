"""Noise with heavier tails than a Gaussian's: Student's t and Laplace.

For a location family p((y − μ)/s)/s the information about μ is a constant over s²: (ν+1)/(ν+3) for
Student's t with ν degrees of freedom, 1 for Laplace.

Reference: Lange, Little and Taylor, JASA 1989, appendix B.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, stdtr

from .parameters import positive
from .protocol import Array, ScalarNoise


@dataclass(frozen=True)
class StudentT(ScalarNoise):
    """Student's t noise of independent values."""

    scale: float
    """s [radiance]; the standard deviation is s √(ν/(ν−2)), for ν > 2."""
    nu: float
    """ν, degrees of freedom: the smaller, the heavier the tails."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "scale", positive(self.scale, "scale"))
        object.__setattr__(self, "nu", positive(self.nu, "nu", "1"))

    @property
    def description(self) -> str:
        """One short phrase for tables."""
        return f"Student's t, scale = {self.scale:.4g}, nu = {self.nu:.4g}"

    def check(self, height: int, width: int, channels: int) -> None:
        """Any image will do."""

    def weights(self, pixels: NDArray[np.integer], mean: Array) -> Array:
        """(ν+1)/((ν+3) s²) for every value of `mean` (n, C)."""
        return np.full(np.shape(mean), (self.nu + 1.0) / ((self.nu + 3.0) * self.scale**2))

    def spread(self, pixels: NDArray[np.integer], mean: Array) -> Array:
        """s: the score far in the tails tells hardly anything, though values fall there."""
        return np.full(np.shape(mean), self.scale)

    def cumulative(self, thresholds: Array, pixels: NDArray[np.integer], mean: Array) -> tuple[Array, Array]:
        """The t distribution of z = (threshold − mean)/s, and minus its density / s."""
        z, nu = (thresholds - mean[..., None]) / self.scale, self.nu
        norm = np.exp(gammaln(0.5 * (nu + 1.0)) - gammaln(0.5 * nu)) / np.sqrt(nu * np.pi)
        density = norm * (1.0 + z**2 / nu) ** (-0.5 * (nu + 1.0))
        return stdtr(nu, z), -density / self.scale

    def to_dict(self) -> dict[str, Any]:
        """The model's parameters as JSON-able values."""
        return {"model": "student_t", "scale": self.scale, "nu": self.nu}


@dataclass(frozen=True)
class Laplace(ScalarNoise):
    """Laplace noise of independent values, p = exp(−|y − μ|/b)/(2b)."""

    scale: float
    """b [radiance]; the standard deviation is √2 b."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "scale", positive(self.scale, "scale"))

    @property
    def description(self) -> str:
        """One short phrase for tables."""
        return f"Laplace, scale = {self.scale:.4g}"

    def check(self, height: int, width: int, channels: int) -> None:
        """Any image will do."""

    def weights(self, pixels: NDArray[np.integer], mean: Array) -> Array:
        """1/b² for every value of `mean` (n, C)."""
        return np.full(np.shape(mean), self.scale**-2)

    def spread(self, pixels: NDArray[np.integer], mean: Array) -> Array:
        """b: beyond, the score is constant, so that tails may be lumped together."""
        return np.full(np.shape(mean), self.scale)

    def cumulative(self, thresholds: Array, pixels: NDArray[np.integer], mean: Array) -> tuple[Array, Array]:
        """The Laplace distribution of z = (threshold − mean)/b, and minus its density / b."""
        z = (thresholds - mean[..., None]) / self.scale
        tail = 0.5 * np.exp(-np.abs(z))
        return np.where(z < 0.0, tail, 1.0 - tail), -tail / self.scale

    def to_dict(self) -> dict[str, Any]:
        """The model's parameters as JSON-able values."""
        return {"model": "laplace", "scale": self.scale}
