"""Noise models from residual images, measured minus expected, with the uncertainty of the estimate.

With T images of residuals r about a known mean the variance of a value is v̂ = Σ r²/T; about the images' own
mean (`ddof=1`), Σ r²/(T−1). Of Gaussian noise v̂ has the standard error v √(2/(T − ddof)), used per pixel. Per
channel, where many pixels are pooled, it is that of the sample mean of r², whatever the distribution. As a
function of intensity, v = c₀ + c₁ μ (+ c₂ μ²) is fitted by least squares with weights 1/v², repeated until
they are consistent; its errors come from the scatter about the fit. Values are taken for independent.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ..errors import NoiseError
from .gaussian import PerChannel, PerPixel
from .heteroscedastic import Heteroscedastic
from .parameters import array
from .protocol import Array, IndependentNoise

_ROUNDS = 50


@dataclass(frozen=True, eq=False)
class NoiseEstimate:
    """A noise model and how well it is known."""

    model: IndependentNoise
    """`PerPixel`, `PerChannel` or `Heteroscedastic`."""
    estimate: Array
    """What was estimated: variances (H, W, C) or (C,) [radiance²], or the coefficients c_k."""
    standard_error: Array
    """The standard error of each number of `estimate`."""


def estimate_noise(
    residual_images: ArrayLike,
    *,
    by: Literal["pixel", "channel", "intensity"],
    mean: ArrayLike | None = None,
    degree: int = 1,
    ddof: Literal[0, 1] = 0,
) -> NoiseEstimate:
    """Estimate noise from T images of residuals.

    Args:
        residual_images: (T, H, W, C), measured minus expected [radiance].
        by: what the variance may depend on.
        mean: (H, W, C), the expected image, for `by="intensity"`.
        degree: of the polynomial in the intensity.
        ddof: 1 if the images' own mean has been taken off, 0 if an expected image.

    Raises:
        NoiseError: shapes do not fit, a residual is not finite, too few images, or variances that vanish.
    """
    r = array(residual_images, "estimate_noise")
    if r.ndim != 4 or r.size == 0:
        raise NoiseError(f"residual images must have shape (T, H, W, C), not {r.shape}")
    if not np.isfinite(r).all():
        raise NoiseError(f"{np.count_nonzero(~np.isfinite(r))} residuals are not finite: leave them out")
    degrees = len(r) - ddof
    if degrees < 1:
        raise NoiseError(f"{len(r)} residual image with ddof = {ddof} leaves nothing to estimate from")
    squares = r**2 * (len(r) / degrees)
    if by == "pixel":
        variance = squares.mean(axis=0)
        return NoiseEstimate(PerPixel(variance), variance, variance * np.sqrt(2.0 / degrees))
    if by == "channel":
        variance = squares.mean(axis=(0, 1, 2))
        count = r[..., 0].size * degrees / len(r)
        error = squares.std(axis=(0, 1, 2)) / np.sqrt(count)
        return NoiseEstimate(PerChannel(np.sqrt(variance)), variance, error)
    if by == "intensity":
        if mean is None:
            raise NoiseError("the variance as a function of intensity needs mean, the expected image")
        return _by_intensity(squares.mean(axis=0), array(mean, "mean"), degrees, degree)
    raise NoiseError(f"by must be 'pixel', 'channel' or 'intensity', not {by!r}")


def _by_intensity(variance: Array, mean: Array, degrees: int, degree: int) -> NoiseEstimate:
    if mean.shape != variance.shape:
        raise NoiseError(f"the mean has shape {mean.shape}, but the residual images are {variance.shape}")
    if degree < 1:
        raise NoiseError(f"the degree in the intensity must be at least 1, not {degree}")
    if len(np.unique(mean)) <= degree:
        raise NoiseError(f"a polynomial of degree {degree} needs more than {degree} different intensities")
    v, powers = variance.ravel(), np.maximum(mean.ravel(), 0.0)[:, None] ** np.arange(degree + 1)
    fitted = np.full(v.shape, v.mean())
    for _ in range(_ROUNDS):
        rows = powers / fitted[:, None]
        coefficients = np.linalg.lstsq(rows, v / fitted, rcond=None)[0]
        # Rounds must start from positive variances; the last one's are checked by the model.
        fresh = np.maximum(powers @ coefficients, 1e-3 * v.mean())
        if np.allclose(fresh, fitted, rtol=1e-10):
            break
        fitted = fresh
    scatter = np.mean((v / fitted - 1.0) ** 2)
    rows = powers / fitted[:, None]
    error = np.sqrt(np.diagonal(np.linalg.inv(rows.T @ rows)) * scatter)
    return NoiseEstimate(Heteroscedastic(coefficients), coefficients, error)
