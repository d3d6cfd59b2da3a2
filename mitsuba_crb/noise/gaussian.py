"""Independent Gaussian noise: one standard deviation, one per channel, or a variance per pixel."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from ..errors import NoiseError
from ..files import jsonable
from .parameters import at_pixels, check_map, positive, variance_map
from .protocol import Array, ScalarNoise


class IndependentGaussian(ScalarNoise):
    """Gaussian noise of independent values: a variance each, which does not depend on the mean."""

    @abstractmethod
    def variance_at(self, pixels: NDArray[np.integer], mean: Array) -> Array:
        """Variances of the values at some pixels, (n, C) [radiance²]."""

    def weights(self, pixels: NDArray[np.integer], mean: Array) -> Array:
        """1 / variance, (n, C)."""
        return np.asarray(1.0 / self.variance_at(pixels, mean), dtype=np.float64)

    def spread(self, pixels: NDArray[np.integer], mean: Array) -> Array:
        """Standard deviations, (n, C)."""
        return np.sqrt(self.variance_at(pixels, mean))

    def cumulative(self, thresholds: Array, pixels: NDArray[np.integer], mean: Array) -> tuple[Array, Array]:
        """Φ(z) and −φ(z)/σ for z = (threshold − mean)/σ."""
        sigma = self.spread(pixels, mean)[..., None]
        z = (thresholds - mean[..., None]) / sigma
        return ndtr(z), -normal_density(z) / sigma


def normal_density(z: Array) -> Array:
    """φ(z) of the standard normal distribution."""
    return np.asarray(np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi), dtype=np.float64)


@dataclass(frozen=True)
class Gaussian(IndependentGaussian):
    """The same independent Gaussian noise in every pixel and channel: Σ = σ² 1."""

    sigma: float
    """Standard deviation [radiance]."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "sigma", positive(self.sigma, "sigma"))

    @property
    def description(self) -> str:
        """One short phrase for tables."""
        return f"Gaussian, sigma = {self.sigma:.4g}"

    def check(self, height: int, width: int, channels: int) -> None:
        """Any image will do."""

    def variance_at(self, pixels: NDArray[np.integer], mean: Array) -> Array:
        """σ² for every value of `mean` (n, C)."""
        return np.full(np.shape(mean), self.sigma**2, dtype=np.float64)

    def to_dict(self) -> dict[str, Any]:
        """The model's parameters as JSON-able values."""
        return {"model": "gaussian", "sigma": self.sigma}


@dataclass(frozen=True)
class PerChannel(IndependentGaussian):
    """Independent Gaussian noise with a standard deviation for each channel."""

    sigmas: tuple[float, ...]
    """Standard deviations of the channels [radiance]."""

    def __init__(self, sigmas: Sequence[float] | Array) -> None:
        try:
            values = tuple(sigmas)
        except TypeError:
            raise NoiseError(
                f"PerChannel expects one sigma per channel, e.g. three, not {sigmas!r}"
            ) from None
        if not values:
            raise NoiseError("PerChannel expects one sigma per channel, not an empty list")
        checked = tuple(positive(value, f"sigma of channel {c}") for c, value in enumerate(values))
        object.__setattr__(self, "sigmas", checked)

    @property
    def description(self) -> str:
        """One short phrase for tables."""
        return "Gaussian, sigma per channel = " + ", ".join(f"{sigma:.4g}" for sigma in self.sigmas)

    def check(self, height: int, width: int, channels: int) -> None:
        """The image must have as many channels as there are sigmas."""
        if channels != len(self.sigmas):
            raise NoiseError(
                f"the noise model has {len(self.sigmas)} sigmas, but the image has {channels} channels"
            )

    def variance_at(self, pixels: NDArray[np.integer], mean: Array) -> Array:
        """σ_c² in channel c of `mean` (n, C)."""
        self.check(0, 0, mean.shape[-1])
        return np.broadcast_to(np.array(self.sigmas) ** 2, mean.shape).copy()

    def to_dict(self) -> dict[str, Any]:
        """The model's parameters as JSON-able values."""
        return {"model": "per_channel", "sigmas": list(self.sigmas)}


@dataclass(frozen=True, eq=False)
class PerPixel(IndependentGaussian):
    """Independent Gaussian noise with its own variance at every pixel, or at every pixel and channel."""

    variance: Array
    """(H, W) or (H, W, C) [radiance²]; an infinite variance makes the estimator ignore that value."""

    def __init__(self, variance: ArrayLike) -> None:
        object.__setattr__(self, "variance", variance_map(variance, "PerPixel"))

    @property
    def description(self) -> str:
        """One short phrase for tables."""
        return f"Gaussian, variance per pixel, median sigma = {self._sigmas()[1]:.4g}"

    def check(self, height: int, width: int, channels: int) -> None:
        """The map must have the image's size, and one or all of its channels."""
        check_map(self.variance.shape, height, width, channels, "variance map")

    def variance_at(self, pixels: NDArray[np.integer], mean: Array) -> Array:
        """variance[y, x] at each of `pixels` (n, 2), as (n, C)."""
        values = at_pixels(self.variance, pixels, "variance map")
        if values.ndim == 1:
            values = values[:, None]
        elif values.shape != mean.shape:
            raise NoiseError(
                f"the variance map has {values.shape[1]} channels, but the image has {mean.shape[1]}"
            )
        return np.broadcast_to(values, mean.shape).copy()

    def to_dict(self) -> dict[str, Any]:
        """Shape and quantiles: the map itself is too large for a report."""
        names = ("sigma_min", "sigma_median", "sigma_max")
        sigmas = jsonable(dict(zip(names, self._sigmas(), strict=True)))
        return {"model": "per_pixel", "shape": list(self.variance.shape), **sigmas}

    def _sigmas(self) -> tuple[float, float, float]:
        """Minimum, (upper) median and maximum; `numpy.quantile` would interpolate between infinities."""
        ordered = np.sqrt(np.sort(self.variance, axis=None))
        return float(ordered[0]), float(ordered[ordered.size // 2]), float(ordered[-1])
