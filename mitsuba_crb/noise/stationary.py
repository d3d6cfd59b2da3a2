"""Gaussian noise whose covariance depends on the distance between pixels only, alike in every channel.

Products with Σ are convolutions: the selected pixels are scattered on a grid, multiplied by the power
spectrum between two FFTs, and gathered. (Σ_PP)⁻¹ is solved by conjugate gradients, preconditioned by the
inverse spectrum in the same way; for all pixels of a periodic image that is already the solution. Without
periodicity the grid is wider than the image by the covariance's reach, so that nothing wraps around.

Reference: Chan and Ng, "Conjugate gradient methods for Toeplitz systems", SIAM Review 1996.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft

from ..errors import NoiseError
from ..processes import cores
from .parameters import array
from .protocol import Array, CoupledNoise

_TOLERANCE = 1e-12  # of the residual's norm, relative to the right-hand side
_ITERATIONS = 1000
_COLUMNS = 8  # solved together; bounds the memory


@dataclass(frozen=True, eq=False)
class Stationary(CoupledNoise):
    """Noise of an autocovariance with finite reach; the image's borders are nothing special."""

    autocovariance: Array
    """(2a + 1, 2b + 1) [radiance²]: entry (a + dy, b + dx) is for the distance (dx, dy) [pixel]."""

    def __init__(self, autocovariance: ArrayLike) -> None:
        values = array(autocovariance, "Stationary")
        if values.ndim != 2 or not all(side % 2 for side in values.shape):
            raise NoiseError(
                f"an autocovariance needs an odd number of rows and of columns, not {values.shape}"
            )
        _check_mirrored(values, values[::-1, ::-1])
        # Four times finer than the image's own frequencies.
        size = [max(64, 4 * side) for side in values.shape]
        _check_spectrum(_spectrum(values, size))
        object.__setattr__(self, "autocovariance", values)

    @classmethod
    def from_power_spectrum(cls, spectrum: ArrayLike) -> Stationary:
        """From the power at the frequencies of `numpy.fft.fftfreq`, (H, W) [radiance²]; H and W odd."""
        values = array(spectrum, "a power spectrum")
        if values.ndim != 2:
            raise NoiseError(f"a power spectrum has two dimensions, not the shape {values.shape}")
        _check_mirrored(values, np.roll(values[::-1, ::-1], 1, axis=(0, 1)))
        return cls(np.fft.fftshift(np.fft.ifft2(values).real))

    @property
    def description(self) -> str:
        """One short phrase for tables."""
        rows, columns = self.autocovariance.shape
        return (
            f"correlated over {columns // 2} x {rows // 2} pixels, "
            f"sigma = {np.sqrt(self.autocovariance[rows // 2, columns // 2]):.4g}"
        )

    def check(self, height: int, width: int, channels: int) -> None:
        """Any image will do."""

    def solve(self, pixels: NDArray[np.integer], values: Array) -> Array:
        """(Σ_PP)⁻¹ of columns (n, C, m), by conjugate gradients.

        Raises:
            NoiseError: Σ is so close to singular that they do not converge.
        """
        corner = pixels.min(axis=0)
        width, height = pixels.max(axis=0) - corner + 1
        reach = (self.autocovariance.shape[0] // 2, self.autocovariance.shape[1] // 2)
        # A grid that the covariance's two ends do not overlap on, either.
        grid = [
            fft.next_fast_len(int(max(side, r + 1)) + r, real=True)
            for side, r in zip((height, width), reach, strict=True)
        ]
        return _solve(_spectrum(self.autocovariance, grid), grid, pixels - corner, values)

    def to_dict(self) -> dict[str, Any]:
        """The model's parameters as JSON-able values."""
        return {"model": "stationary", "autocovariance": self.autocovariance.tolist()}


@dataclass(frozen=True, eq=False)
class Periodic(CoupledNoise):
    """Noise of an image whose opposite borders are neighbours: Σ is diagonal in the Fourier basis."""

    power_spectrum: Array
    """(H, W) [radiance²], eigenvalues of Σ at the frequencies of `numpy.fft.fftfreq`."""

    def __init__(self, power_spectrum: ArrayLike) -> None:
        values = array(power_spectrum, "Periodic")
        if values.ndim != 2 or values.size == 0:
            raise NoiseError(f"a power spectrum has the image's shape (H, W), not {values.shape}")
        _check_mirrored(values, np.roll(values[::-1, ::-1], 1, axis=(0, 1)))
        _check_spectrum(values)
        object.__setattr__(self, "power_spectrum", values)

    @classmethod
    def from_autocovariance(cls, autocovariance: ArrayLike) -> Periodic:
        """From the covariance (H, W) at the distances of rows and columns, which wrap around."""
        values = array(autocovariance, "an autocovariance")
        if values.ndim != 2 or values.size == 0:
            raise NoiseError(f"a periodic autocovariance has the image's shape (H, W), not {values.shape}")
        _check_mirrored(values, np.roll(values[::-1, ::-1], 1, axis=(0, 1)))
        return cls(np.fft.fft2(values).real)

    @property
    def description(self) -> str:
        """One short phrase for tables."""
        return f"correlated, periodic, sigma = {np.sqrt(self.power_spectrum.mean()):.4g}"

    def check(self, height: int, width: int, channels: int) -> None:
        """The spectrum must have the image's size."""
        if self.power_spectrum.shape != (height, width):
            raise NoiseError(
                f"the power spectrum has shape {self.power_spectrum.shape}, but the image is {height} rows x "
                f"{width} columns"
            )

    def solve(self, pixels: NDArray[np.integer], values: Array) -> Array:
        """(Σ_PP)⁻¹ of columns (n, C, m); one step for all pixels, conjugate gradients for some.

        Raises:
            NoiseError: Σ is so close to singular that they do not converge.
        """
        height, width = self.power_spectrum.shape
        half = self.power_spectrum[:, : width // 2 + 1]
        return _solve(half, [height, width], pixels, values)

    def to_dict(self) -> dict[str, Any]:
        """Shape and range of the spectrum."""
        return {
            "model": "periodic",
            "shape": list(self.power_spectrum.shape),
            "power_min": float(self.power_spectrum.min()),
            "power_max": float(self.power_spectrum.max()),
        }


def _spectrum(autocovariance: Array, grid: list[int]) -> Array:
    """(rows, columns // 2 + 1), the real spectrum of an autocovariance on a grid of at least its size."""
    rows, columns = autocovariance.shape
    kernel = np.zeros(grid)
    kernel[:rows, :columns] = autocovariance
    kernel = np.roll(kernel, (-(rows // 2), -(columns // 2)), axis=(0, 1))
    return np.asarray(fft.rfft2(kernel).real, dtype=np.float64)


def _check_mirrored(values: Array, mirrored: Array) -> None:
    if not np.isfinite(values).all():
        raise NoiseError("a covariance or spectrum has entries that are not finite")
    skew = float(np.abs(values - mirrored).max())
    if skew > 1e-9 * float(np.abs(values).max()):
        raise NoiseError(f"Σ is not symmetric: opposite distances or frequencies differ by {skew:.3g}")


def _check_spectrum(spectrum: Array) -> None:
    smallest, largest = float(spectrum.min()), float(np.abs(spectrum).max())
    if smallest <= 1e-12 * largest:
        raise NoiseError(
            f"Σ is not positive definite: its smallest eigenvalue is {smallest:.3g}; add more to the "
            "variance at distance 0, or taper the covariance"
        )


def _solve(spectrum: Array, grid: list[int], pixels: NDArray[np.integer], values: Array) -> Array:
    """(Σ_PP)⁻¹ of columns (n, C, m), Σ being the convolution with `spectrum` on a grid."""
    n, C, m = values.shape
    index = pixels[:, 1].astype(np.int64) * grid[1] + pixels[:, 0]
    floor = 1e-6 * spectrum.max()
    inverse = 1.0 / np.maximum(spectrum, floor)

    def filtered(columns: Array, transfer: Array) -> Array:
        image = np.zeros((len(columns), grid[0] * grid[1]))
        image[:, index] = columns
        waves = fft.rfft2(image.reshape(-1, *grid), workers=cores())
        image = fft.irfft2(waves * transfer, s=tuple(grid), workers=cores()).reshape(len(columns), -1)
        return np.asarray(image[:, index], dtype=np.float64)

    columns = values.reshape(n, C * m).T
    solved = np.empty((C * m, n))
    for start in range(0, C * m, _COLUMNS):
        part = slice(start, start + _COLUMNS)
        b = np.ascontiguousarray(columns[part])
        x, r = np.zeros_like(b), b.copy()
        z = filtered(r, inverse)
        p, rho = z, np.einsum("kn,kn->k", r, z)
        enough = _TOLERANCE**2 * np.einsum("kn,kn->k", b, b)
        for _ in range(_ITERATIONS):
            left = np.einsum("kn,kn->k", r, r) > enough
            if not left.any():
                break
            q = filtered(p, spectrum)
            curvature = np.einsum("kn,kn->k", p, q)
            alpha = np.where(left, rho / np.where(left, curvature, 1.0), 0.0)[:, None]
            x += alpha * p
            r -= alpha * q
            z = filtered(r, inverse)
            fresh = np.einsum("kn,kn->k", r, z)
            p = z + (fresh / np.where(left, rho, 1.0))[:, None] * p
            rho = fresh
        else:
            raise NoiseError(
                f"the noise's covariance is nearly singular: {_ITERATIONS} iterations did not solve it; "
                "add white noise to it"
            )
        solved[part] = x
    return solved.T.reshape(n, C, m)
