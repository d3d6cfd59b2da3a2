"""Cameras that mix the channels of a pixel: correlated colours, and one channel in place of three.

A pixel's weight is then a matrix over its channels. For y = l·μ + e with one measured value of information
i(l·μ), it is i l lᵀ.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import NoiseError
from .covariance import positive_matrix
from .parameters import array, at_pixels
from .protocol import Array, CoupledNoise, IndependentNoise, ThresholdNoise

REC709 = (0.2126, 0.7152, 0.0722)
"""Luminance of linear RGB with the primaries of ITU-R BT.709."""


@dataclass(frozen=True, eq=False)
class ColourBlocks(IndependentNoise):
    """Gaussian noise that is correlated between the channels of a pixel, but not between pixels."""

    covariance: Array
    """(C, C), or (H, W, C, C) for every pixel [radiance²]."""

    def __init__(self, covariance: ArrayLike) -> None:
        values = array(covariance, "ColourBlocks")
        if values.ndim not in (2, 4) or values.shape[-1] != values.shape[-2] or values.size == 0:
            raise NoiseError(
                f"ColourBlocks expects covariances of shape (C, C) or (H, W, C, C), not {values.shape}"
            )
        positive_matrix(values, "the covariance of the channels", NoiseError, definite=True)
        object.__setattr__(self, "covariance", values)

    @property
    def description(self) -> str:
        """One short phrase for tables."""
        diagonal = np.diagonal(self.covariance, axis1=-2, axis2=-1).reshape(
            -1, len(self.covariance[..., 0, :].T)
        )
        sigmas = np.sqrt(np.median(diagonal, axis=0))
        return "Gaussian, correlated channels, sigma = " + ", ".join(f"{sigma:.4g}" for sigma in sigmas)

    def check(self, height: int, width: int, channels: int) -> None:
        """The blocks must have as many channels as the image, and one or all of its pixels."""
        if self.covariance.shape not in ((channels, channels), (height, width, channels, channels)):
            raise NoiseError(
                f"the colour blocks have shape {self.covariance.shape}, but the image is {height} rows x "
                f"{width} columns x {channels} channels"
            )

    def weights(self, pixels: NDArray[np.integer], mean: Array) -> Array:
        """The inverse covariance of each pixel's channels, (n, C, C)."""
        if self.covariance.ndim == 2:
            inverse = np.linalg.inv(self.covariance)
            return np.broadcast_to(inverse, (len(mean), *inverse.shape)).copy()
        blocks = at_pixels(self.covariance, pixels, "map of colour blocks")
        return np.asarray(np.linalg.inv(blocks), dtype=np.float64)

    def to_dict(self) -> dict[str, Any]:
        """The model's parameters as JSON-able values; of a map, only its shape."""
        if self.covariance.ndim == 2:
            return {"model": "colour_blocks", "covariance": self.covariance.tolist()}
        return {"model": "colour_blocks", "shape": list(self.covariance.shape)}


@dataclass(frozen=True)
class Luminance(ThresholdNoise):
    """A camera with one channel y = l·μ; l = (0, 1, 0) measures green alone."""

    noise: IndependentNoise
    """Noise of the one measured channel, possibly behind a `Sensor`."""
    coefficients: tuple[float, ...] = REC709
    """l, of linear R, G and B."""

    def __init__(self, noise: IndependentNoise, coefficients: Sequence[float] = REC709) -> None:
        if isinstance(noise, CoupledNoise) or not isinstance(noise, IndependentNoise):
            raise NoiseError(f"Luminance needs noise of independent pixels, not {noise!r}")
        values = array(coefficients, "Luminance")
        if values.ndim != 1 or not np.isfinite(values).all() or not values.any():
            raise NoiseError(f"Luminance expects one finite coefficient per channel, not {coefficients!r}")
        object.__setattr__(self, "noise", noise)
        object.__setattr__(self, "coefficients", tuple(values.tolist()))

    @property
    def description(self) -> str:
        """One short phrase for tables."""
        return f"one channel; {self.noise.description}"

    @property
    def depends_on_mean(self) -> bool:
        """As the channel's noise."""
        return self.noise.depends_on_mean

    def check(self, height: int, width: int, channels: int) -> None:
        """The image must have as many channels as there are coefficients."""
        if channels != len(self.coefficients):
            raise NoiseError(
                f"the luminance has {len(self.coefficients)} coefficients, but the image has {channels} "
                "channels"
            )
        self.noise.check(height, width, 1)

    def weights(self, pixels: NDArray[np.integer], mean: Array) -> Array:
        """i(l·μ) l lᵀ, (n, C, C)."""
        mix = np.array(self.coefficients)
        information = self.noise.weights(pixels, self._measured(mean)).reshape(-1, 1, 1)
        return np.asarray(information * np.outer(mix, mix), dtype=np.float64)

    def near_threshold(self, lowest: Array, highest: Array) -> NDArray[np.bool_]:
        """(n,) as the channel's noise; without a threshold, wherever it depends on the mean."""
        if isinstance(self.noise, ThresholdNoise):
            return self.noise.near_threshold(self._measured(lowest), self._measured(highest))
        return np.full(len(lowest), self.noise.depends_on_mean)

    def excess(self, mean: Array) -> Array:
        """(n, 1), as the channel's noise."""
        if isinstance(self.noise, ThresholdNoise):
            return self.noise.excess(self._measured(mean))
        return np.zeros((len(mean), 1))

    def saturated(self, mean: Array) -> NDArray[np.bool_]:
        """(n, 1), as the channel's noise."""
        if isinstance(self.noise, ThresholdNoise):
            return self.noise.saturated(self._measured(mean))
        return np.zeros((len(mean), 1), dtype=np.bool_)

    def _measured(self, mean: Array) -> Array:
        """(n, 1), l·μ."""
        return np.asarray(mean @ np.array(self.coefficients), dtype=np.float64)[:, None]

    def to_dict(self) -> dict[str, Any]:
        """The model's parameters as JSON-able values."""
        return {
            "model": "luminance",
            "coefficients": list(self.coefficients),
            "noise": self.noise.to_dict(),
        }
