"""The covariance of residual images, taken for stationary: what a model gets wrong spans pixels and channels.

Of residuals r, measured minus expected, pooled over images and places x,

    C(d) = w(d) Σ r(x) r(x + d)ᵀ / Σ 1

over the pairs of pixels that both have a value, for distances d up to a reach, w falling to zero over the
outer half of it. About zero and not about the mean, for what all residuals have in common moves an estimate,
too. C's own errors may leave the matrices of its spectrum negative eigenvalues: they are set to zero on the
grid that it is applied on, so that no combination of values gets a negative variance.

Only images that the model was not fitted to say what it gets wrong, and only at poses that were not either.

References: Politis and Romano, "Bias-corrected nonparametric spectral estimation", 1995; McMurry and Politis,
"Banded and tapered estimates for autocovariance matrices", 2010.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft

from ..errors import NoiseError
from ..files import Record
from ..processes import cores
from .parameters import array
from .protocol import Array

_SHARE = 4
"""The default reach is this part of the images' shortest side, …"""
_FURTHEST = 64
"""… but at most this [pixel]."""
_COLUMNS = 8
"""Multiplied together; bounds the memory."""


@dataclass(frozen=True, eq=False)
class ResidualCovariance(Record):
    """S, the covariance of residuals, as a function of the distance between two pixels."""

    autocovariance: Array
    """(C, C, 2a + 1, 2b + 1) [value²]: entry (c, e, a + dy, b + dx) is of channel c at x and e at x + d."""
    images: int
    """How many it was estimated from."""

    def __post_init__(self) -> None:
        values = array(self.autocovariance, "ResidualCovariance")
        if values.ndim != 4 or values.shape[0] != values.shape[1] or not all(n % 2 for n in values.shape[2:]):
            raise NoiseError(
                f"a covariance of residuals has the shape (C, C, 2a + 1, 2b + 1), not {values.shape}"
            )
        mirrored = values.swapaxes(0, 1)[:, :, ::-1, ::-1]
        if not np.isfinite(values).all() or np.abs(values - mirrored).max() > 1e-9 * np.abs(values).max():
            raise NoiseError("a covariance of residuals must be finite, and C(−d) the transpose of C(d)")
        object.__setattr__(self, "autocovariance", values)

    @property
    def reach(self) -> tuple[int, int]:
        """Largest distance (dx, dy) [pixel]."""
        rows, columns = self.autocovariance.shape[2:]
        return columns // 2, rows // 2

    @property
    def covariance_of_channels(self) -> Array:
        """(C, C), of a pixel [value²]."""
        across, down = self.reach
        return np.asarray(self.autocovariance[:, :, down, across])

    @property
    def sigmas(self) -> Array:
        """(C,), standard deviations of the channels [value]."""
        return np.sqrt(np.diagonal(self.covariance_of_channels))

    @property
    def pixels_alike(self) -> float:
        """Over how many pixels residuals are alike: Σ_d tr C(d) / tr C(0); 1 of white ones."""
        traces = np.trace(self.autocovariance)
        return float(traces.sum() / np.trace(self.covariance_of_channels))

    @property
    def description(self) -> str:
        """One short phrase for tables."""
        sigmas = ", ".join(f"{sigma:.3g}" for sigma in self.sigmas)
        return f"of {self.images} images, sigma = {sigmas}, alike over {self.pixels_alike:.3g} pixels"

    def times(self, pixels: NDArray[np.integer], values: Array) -> Array:
        """S times columns (n, C, m) of some pixels (n, 2), of which all others are zero."""
        n, C, m = values.shape
        if len(self.autocovariance) != C:
            raise NoiseError(f"the residuals have {len(self.autocovariance)} channels, the columns {C}")
        corner = pixels.min(axis=0)
        sides = (pixels.max(axis=0) - corner + 1)[::-1]
        grid = _grid(sides, self.reach[::-1])
        spectrum = self._spectrum(grid)
        index = (pixels[:, 1] - corner[1]).astype(np.int64) * grid[1] + pixels[:, 0] - corner[0]
        products = np.empty((m, C, n))
        for start in range(0, m, _COLUMNS):
            part = values[..., start : start + _COLUMNS].transpose(2, 1, 0)
            film = np.zeros((*part.shape[:2], grid[0] * grid[1]))
            film[..., index] = part
            waves = fft.rfft2(film.reshape(*part.shape[:2], *grid), workers=cores())
            waves = np.einsum("yxce,meyx->mcyx", spectrum, waves)
            film = fft.irfft2(waves, s=tuple(grid), workers=cores()).reshape(film.shape)
            products[start : start + _COLUMNS] = film[..., index]
        return products.transpose(2, 1, 0)

    def _spectrum(self, grid: list[int]) -> NDArray[np.complex128]:
        """(rows, columns // 2 + 1, C, C), at each frequency Hermitian, without negative eigenvalues."""
        rows, columns = self.autocovariance.shape[2:]
        kernel = np.zeros((*self.autocovariance.shape[:2], *grid))
        kernel[..., :rows, :columns] = self.autocovariance
        kernel = np.roll(kernel, (-(rows // 2), -(columns // 2)), axis=(2, 3))
        # S v = Σ_d C(d) v(x + d) turns the other way round than a convolution.
        values, vectors = np.linalg.eigh(fft.rfft2(kernel).conj().transpose(2, 3, 0, 1))
        return np.asarray((vectors * np.maximum(values, 0.0)[..., None, :]) @ vectors.mT.conj())


def residual_covariance(
    residual_images: Sequence[ArrayLike], *, reach: int | None = None, renderer: ArrayLike | None = None
) -> ResidualCovariance:
    """Estimate the covariance of residuals from images that the model was not fitted to.

    Args:
        residual_images: (H, W, C) each, measured minus expected [value]; pixels that are not finite are left
            out.
        reach: largest distance [pixel] along rows and columns; None: a quarter of the shortest side, at most
            64. Residuals that are alike over larger distances are underestimated.
        renderer: (C, C), covariance of the expected images' own noise, white between pixels; it is taken off.

    Raises:
        NoiseError: no images, of different channels, smaller than the reach, nothing finite, or all zero.
    """
    images = [array(image, "residual_covariance") for image in residual_images]
    if not images or any(image.ndim != 3 or image.shape[2] != images[0].shape[2] for image in images):
        raise NoiseError(
            f"residual images must have shape (H, W, C); got {[image.shape for image in images] or 'none'}"
        )
    shortest = min(min(image.shape[:2]) for image in images)
    reach = min(shortest // _SHARE, _FURTHEST) if reach is None else reach
    if not 0 <= reach < shortest:
        raise NoiseError(
            f"the reach must be at least 0 and below the shortest side, {shortest} pixels: {reach}"
        )
    sums = [_pair_sums(image, reach) for image in images]
    products, counts = (np.sum(part, axis=0) for part in zip(*sums, strict=True))
    taper = np.minimum(1.0, 2.0 - 2.0 * np.abs(np.arange(-reach, reach + 1)) / (reach + 1))
    autocovariance = taper[:, None] * taper * products / np.maximum(counts, 1.0)
    if renderer is not None:
        autocovariance[:, :, reach, reach] -= array(renderer, "renderer")
    if not (np.diagonal(autocovariance[:, :, reach, reach]) > 0.0).all():
        raise NoiseError(
            "the residuals are all zero, nowhere finite, or no larger than the renderer's noise: they tell "
            "no covariance"
        )
    return ResidualCovariance(autocovariance, len(images))


def _pair_sums(image: Array, reach: int) -> tuple[Array, Array]:
    """Σ r(x) r(x + d)ᵀ (C, C, 2 reach + 1, 2 reach + 1), and over how many x (2 reach + 1, 2 reach + 1)."""
    finite = np.asarray(np.isfinite(image).all(axis=2))
    grid = _grid(image.shape[:2], (reach, reach))
    waves = fft.rfft2(np.where(finite[..., None], image, 0.0).transpose(2, 0, 1), s=grid, workers=cores())
    places = fft.rfft2(finite.astype(np.float64), s=grid)
    span = np.arange(-reach, reach + 1)

    def near(spectrum: NDArray[np.complex128]) -> Array:
        return np.asarray(fft.irfft2(spectrum, s=grid, workers=cores())[..., span[:, None], span])

    products = near(waves[:, None].conj() * waves)
    products = 0.5 * (products + products.swapaxes(0, 1)[:, :, ::-1, ::-1])  # rounding
    return products, np.rint(near(places.conj() * places))


def _grid(sides: Sequence[int] | NDArray[np.integer], reach: tuple[int, int]) -> list[int]:
    """Sides of a grid on which nothing within reach wraps around, nor the covariance's two ends overlap."""
    return [
        fft.next_fast_len(int(max(side, r + 1)) + r, real=True) for side, r in zip(sides, reach, strict=True)
    ]
