"""Gaussian noise of a camera whose values end at white: what lies above reads white and tells nothing.

A value is y = min(μ + e, w), e ~ N(0, σ²), a censored normal variable (Tobin 1958). With z = (w − μ)/σ and
the hazard h(z) = φ(z)/Φ(−z), its information about μ is

    i(μ) = [Φ(z) + φ(z) (h(z) − z)] / σ²,

1/σ² well below white, 0.82/σ² at it and zero well above. Unlike a threshold it does not jump, so that a wall
which is white exactly tells the same whichever way its mean was rounded.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, ndtr

from .gaussian import normal_density
from .parameters import positive
from .protocol import Array, ThresholdNoise

_REACH = 9.0
"""Standard deviations beyond which white makes no difference in float64."""
_FACTOR = 1.25
"""By which an image of few paths may be wrong and a pixel still be sorted by it."""


@dataclass(frozen=True)
class Clipped(ThresholdNoise):
    """The same independent Gaussian noise in every pixel and channel, and values cut off at white."""

    sigma: float
    """Standard deviation [radiance]."""
    white: float
    """The largest value [radiance]."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "sigma", positive(self.sigma, "sigma"))
        object.__setattr__(self, "white", positive(self.white, "white"))

    @property
    def description(self) -> str:
        """One short phrase for tables."""
        return f"Gaussian, sigma = {self.sigma:.4g}, clipped at {self.white:.4g}"

    @property
    def depends_on_mean(self) -> bool:
        """Yes: what is brighter than white tells nothing."""
        return True

    def check(self, height: int, width: int, channels: int) -> None:
        """Any image will do."""

    def weights(self, pixels: NDArray[np.integer], mean: Array) -> Array:
        """i(μ) for every value of `mean` (n, C)."""
        # Beyond the clip both ends are reached to the last bit.
        z = np.clip((self.white - np.asarray(mean, dtype=np.float64)) / self.sigma, -30.0, 30.0)
        density = normal_density(z)
        hazard = np.exp(-0.5 * z**2 - log_ndtr(-z)) / np.sqrt(2.0 * np.pi)
        information = ndtr(z) + density * (hazard - z)
        return np.asarray(np.where(z > -_REACH, information, 0.0) / self.sigma**2, dtype=np.float64)

    def near_threshold(self, lowest: Array, highest: Array) -> NDArray[np.bool_]:
        """(n,) whether white lies about between the two of any channel, or within reach of the noise."""
        reach = _REACH * self.sigma
        near = (_FACTOR * highest + reach > self.white) & (lowest / _FACTOR - reach < self.white)
        return np.asarray(near.any(axis=1))

    def excess(self, mean: Array) -> Array:
        """(n, C), what is cut off."""
        return np.maximum(mean - self.white, 0.0)

    def saturated(self, mean: Array) -> NDArray[np.bool_]:
        """(n, C), which lie so far above white that they keep less than half of what they would tell."""
        return np.asarray(mean > self.white + self.sigma)

    def to_dict(self) -> dict[str, Any]:
        """The model's parameters as JSON-able values."""
        return {"model": "clipped", "sigma": self.sigma, "white": self.white}
