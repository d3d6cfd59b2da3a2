"""What a noise model must offer.

A model is described by the Fisher information that a measured pixel carries about its noise-free mean, its
weight [1 / radiance²]; for Gaussian noise, Σ⁻¹. Independent pixels have one each, so that an image streams
tile by tile; correlated ones have Σ⁻¹ as a whole. Variances are in [radiance²].
"""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Describable(Protocol):
    """What every noise model has."""

    @property
    def description(self) -> str:
        """One short phrase for tables."""

    @property
    def depends_on_mean(self) -> bool:
        """Whether the noise depends on the image, whose mean then comes from a render of its own."""
        return False

    def check(self, height: int, width: int, channels: int) -> None:
        """Refuse an image that this model cannot describe, before anything is rendered.

        Raises:
            NoiseError: the number of channels or the image's size does not match.
        """

    def to_dict(self) -> dict[str, Any]:
        """The model's parameters as JSON-able values."""


@runtime_checkable
class IndependentNoise(Describable, Protocol):
    """Noise that is independent between pixels; inherit from it, or have its members, to add a model."""

    @property
    def couples_pixels(self) -> bool:
        """No: the information of pixels adds."""
        return False

    def weights(self, pixels: NDArray[np.integer], mean: NDArray[np.float64]) -> NDArray[np.float64]:
        """The Fisher information that measured pixels carry about their noise-free radiance.

        Args:
            pixels: (n, 2), column x and row y.
            mean: (n, C), the noise-free linear radiance there.

        Returns:
            (n, C) for independent channels, or (n, C, C) [1 / radiance²]; for Gaussian noise, Σ⁻¹.
        """


@runtime_checkable
class CoupledNoise(Describable, Protocol):
    """Gaussian noise that is correlated between pixels; inherit from it to add a model."""

    @property
    def couples_pixels(self) -> bool:
        """Yes: a pixel's information depends on which others are measured."""
        return True

    def solve(self, pixels: NDArray[np.integer], values: NDArray[np.float64]) -> NDArray[np.float64]:
        """(Σ_PP)⁻¹ times some columns, Σ_PP the covariance of the noise of the selected pixels P.

        Args:
            pixels: (n, 2), column x and row y, none twice.
            values: (n, C, m).

        Returns:
            (n, C, m), in units of `values` / [radiance²].
        """


@runtime_checkable
class ScalarNoise(IndependentNoise, Protocol):
    """Independent noise of every value, with a distribution that a camera can cut into codes."""

    def spread(self, pixels: NDArray[np.integer], mean: Array) -> Array:
        """(n, C), a scale [radiance]: values more than nine of it from the mean tell hardly anything."""

    def cumulative(self, thresholds: Array, pixels: NDArray[np.integer], mean: Array) -> tuple[Array, Array]:
        """P(value ≤ threshold) and its derivative in the mean.

        Args:
            thresholds: (n, C, B) [radiance].
            pixels: (n, 2), column x and row y.
            mean: (n, C) [radiance].

        Returns:
            Both (n, C, B), the derivative in [1 / radiance].
        """


@runtime_checkable
class ThresholdNoise(IndependentNoise, Protocol):
    """Independent noise that the mean changes near a threshold alone, so that few pixels need it exactly."""

    def near_threshold(self, lowest: Array, highest: Array) -> NDArray[np.bool_]:
        """(n,) where means between about these (n, C) may make a difference to the weights."""

    def excess(self, mean: Array) -> Array:
        """By how much values lie beyond the threshold, of the shape (n, C) or (n, 1) [radiance]; 0 if not."""

    def saturated(self, mean: Array) -> NDArray[np.bool_]:
        """(n, measured channels), which values lie beyond the threshold and tell hardly anything."""


NoiseModel = IndependentNoise | CoupledNoise
"""Either kind, for `isinstance` and annotations."""
