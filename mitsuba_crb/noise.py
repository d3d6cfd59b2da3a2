"""Noise models: what the camera adds to each pixel's linear radiance.

A model is described by the Fisher information that a measured pixel carries about its noise-free mean, its
weight [1 / radiance²]; for Gaussian noise, Σ⁻¹. Independent pixels have one each, so that an image streams
tile by tile; correlated ones have Σ⁻¹ as a whole. Variances are in [radiance²].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import NoiseError


class _Describable(Protocol):
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
class IndependentNoise(_Describable, Protocol):
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
class CoupledNoise(_Describable, Protocol):
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


NoiseModel = IndependentNoise | CoupledNoise
"""Either kind, for `isinstance` and annotations."""


@dataclass(frozen=True)
class Gaussian(IndependentNoise):
    """The same independent Gaussian noise in every pixel and channel: Σ = σ² 1."""

    sigma: float
    """Standard deviation [radiance]."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "sigma", _standard_deviation(self.sigma, "sigma"))

    @property
    def description(self) -> str:
        """One short phrase for tables."""
        return f"Gaussian, sigma = {self.sigma:.4g}"

    def check(self, height: int, width: int, channels: int) -> None:
        """Any image will do."""

    def weights(self, pixels: NDArray[np.integer], mean: NDArray[np.float64]) -> NDArray[np.float64]:
        """1 / σ² for every value of `mean` (n, C)."""
        return np.full(np.shape(mean), self.sigma**-2, dtype=np.float64)

    def to_dict(self) -> dict[str, Any]:
        """The model's parameters as JSON-able values."""
        return {"model": "gaussian", "sigma": self.sigma}


@dataclass(frozen=True)
class PerChannel(IndependentNoise):
    """Independent Gaussian noise with a standard deviation for each channel."""

    sigmas: tuple[float, ...]
    """Standard deviations of the channels [radiance]."""

    def __init__(self, sigmas: Sequence[float] | NDArray[np.float64]) -> None:
        try:
            values = tuple(sigmas)
        except TypeError:
            raise NoiseError(
                f"PerChannel expects one sigma per channel, e.g. three, not {sigmas!r}"
            ) from None
        if not values:
            raise NoiseError("PerChannel expects one sigma per channel, not an empty list")
        checked = tuple(_standard_deviation(value, f"sigma of channel {c}") for c, value in enumerate(values))
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

    def weights(self, pixels: NDArray[np.integer], mean: NDArray[np.float64]) -> NDArray[np.float64]:
        """1 / σ_c² in channel c of `mean` (n, C)."""
        self.check(0, 0, mean.shape[-1])
        return np.broadcast_to(np.array(self.sigmas) ** -2.0, mean.shape).copy()

    def to_dict(self) -> dict[str, Any]:
        """The model's parameters as JSON-able values."""
        return {"model": "per_channel", "sigmas": list(self.sigmas)}


@dataclass(frozen=True, eq=False)
class PerPixel(IndependentNoise):
    """Independent Gaussian noise with its own variance at every pixel, or at every pixel and channel."""

    variance: NDArray[np.float64]
    """(H, W) or (H, W, C) [radiance²]; an infinite variance makes the estimator ignore that value."""

    def __init__(self, variance: ArrayLike) -> None:
        try:
            values = np.array(variance, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise NoiseError(f"PerPixel expects an array of variances: {error}") from None
        if values.ndim not in (2, 3) or values.size == 0:
            raise NoiseError(f"PerPixel expects variances of shape (H, W) or (H, W, C), not {values.shape}")
        bad = int(np.count_nonzero(~(values > 0.0)))
        if bad:
            raise NoiseError(
                f"{bad} of {values.size} variances are zero, negative or NaN; they must be positive"
            )
        values.flags.writeable = False
        object.__setattr__(self, "variance", values)

    @property
    def description(self) -> str:
        """One short phrase for tables."""
        return f"Gaussian, variance per pixel, median sigma = {self._sigmas()[1]:.4g}"

    def check(self, height: int, width: int, channels: int) -> None:
        """The map must have the image's size, and one or all of its channels."""
        if self.variance.shape not in ((height, width), (height, width, channels)):
            raise NoiseError(
                f"the variance map has shape {self.variance.shape}, but the image is {height} rows x {width} "
                f"columns x {channels} channels"
            )

    def weights(self, pixels: NDArray[np.integer], mean: NDArray[np.float64]) -> NDArray[np.float64]:
        """1 / variance[y, x] at each of `pixels` (n, 2), as (n, C)."""
        x, y = np.asarray(pixels).T
        height, width = self.variance.shape[:2]
        if x.size and (min(x.min(), y.min()) < 0 or x.max() >= width or y.max() >= height):
            raise NoiseError(
                f"the variance map covers {width} x {height} pixels, but not pixel ({x.max()}, {y.max()})"
            )
        weights = 1.0 / self.variance[y, x]
        if weights.ndim == 1:
            weights = weights[:, None]
        elif weights.shape != mean.shape:
            raise NoiseError(
                f"the variance map has {weights.shape[1]} channels, but the image has {mean.shape[1]}"
            )
        return np.broadcast_to(weights, mean.shape).copy()

    def to_dict(self) -> dict[str, Any]:
        """Shape and quantiles: the map itself is too large for a report."""
        names = ("sigma_min", "sigma_median", "sigma_max")
        values = {n: q if np.isfinite(q) else "inf" for n, q in zip(names, self._sigmas(), strict=True)}
        return {"model": "per_pixel", "shape": list(self.variance.shape), **values}

    def _sigmas(self) -> tuple[float, float, float]:
        """Minimum, (upper) median and maximum; `numpy.quantile` would interpolate between infinities."""
        ordered = np.sqrt(np.sort(self.variance, axis=None))
        return float(ordered[0]), float(ordered[ordered.size // 2]), float(ordered[-1])


def _standard_deviation(value: float, name: str) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise NoiseError(f"{name} must be a positive number [radiance], not {value!r}") from None
    # Outside of this range the inverse variance overflows or vanishes.
    if not 1e-150 < number < 1e150:
        raise NoiseError(f"{name} must be positive and finite [radiance], not {number:g}")
    return number
