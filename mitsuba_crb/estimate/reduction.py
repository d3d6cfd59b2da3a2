"""An image reduced by a factor: what a film with larger pixels measures, about, and the noise of that.

Every value of the reduced image is a weighted mean Σ a_i y_i / Σ a_i of the finite ones around it. Of
independent noise with variances v_i it has the variance Σ a_i² v_i / (Σ a_i)².
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy import ndimage, sparse

from ..errors import NoiseError
from ..information.subset import selected
from ..noise import IndependentNoise, PerPixel
from ..se3 import Array

_COARSEST = 8
"""Smallest side of a reduced image [pixel]."""
_COVERED = 0.5
"""Share of a mean's weight that must lie on finite values, over that of the mean with most: of scattered
pixels none has much."""


def pyramid(image: Array, noise: IndependentNoise, levels: int) -> Iterator[tuple[Array, IndependentNoise]]:
    """Reduced images (h, w, 3) and their noise, by 2^levels first, then by half as much, down to 2.

    Those that are too small, or have nothing finite, are left out. Noise of images of any size stays as it
    is, too large by one factor for all values.

    Args:
        image: (H, W, 3) [radiance]; NaN where it is not measured.
        noise: of it, independent between pixels and channels.
        levels: how many.

    Raises:
        NoiseError: the noise belongs to an image of this size, and changes with the mean.
    """
    variance = _variance(noise, image) if levels else None
    if variance is not None:
        image = np.where(np.isfinite(variance), image, np.nan)
    for level in range(levels, 0, -1):
        small = reduced(image, 2**level)
        finite = np.isfinite(small)
        if min(small.shape[:2]) < _COARSEST or not finite.any():
            continue
        if variance is None:
            yield small, noise
        else:
            own = reduced_variance(np.where(np.isfinite(image), variance, np.inf), 2**level)
            # A value that is ignored must not take the pixel's others with it.
            yield np.where(finite | ~finite.any(axis=2, keepdims=True), small, 0.0), PerPixel(own)


def reduced(image: Array, factor: int) -> Array:
    """The image that a film with pixels `factor` times as large measures, about; NaN where nothing is finite.

    Mitsuba's Gaussian filter has a standard deviation of half a pixel, of the large pixels as of the small.
    """
    finite = np.isfinite(image)
    rows, columns = (_means(side, factor) for side in image.shape[:2])
    share = _along(rows, columns, finite.astype(np.float64))
    with np.errstate(invalid="ignore", divide="ignore"):
        small = _along(rows, columns, np.where(finite, image, 0.0)) / share
    return np.where(share > _COVERED * share.max(), small, np.nan)


def reduced_variance(variance: Array, factor: int) -> Array:
    """(h, w, C), the noise's variances in a reduced image, from those in the image (H, W, C).

    Values of infinite variance are those that `reduced` finds not finite, and has none for.
    """
    finite = np.isfinite(variance)
    rows, columns = (_means(side, factor) for side in variance.shape[:2])
    share = _along(rows, columns, finite.astype(np.float64))
    sums = _along(rows.power(2), columns.power(2), np.where(finite, variance, 0.0))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(share > _COVERED * share.max(), sums / share**2, np.inf)


def _means(side: int, factor: int) -> sparse.csr_array:
    """(n, side), the weights along one axis, by rows with sum 1."""
    n = max(1, side // factor)
    sigma = 0.5 * float(np.sqrt(factor**2 - 1.0))
    smooth = ndimage.gaussian_filter1d(np.eye(side), sigma, axis=0, mode="nearest")
    at = (np.arange(n) + 0.5) * side / n - 0.5
    low = np.floor(at).astype(np.int64)
    share = (at - low)[:, None]
    high = np.minimum(low + 1, side - 1)
    return sparse.csr_array((1.0 - share) * smooth[low] + share * smooth[high])


def _along(rows: sparse.csr_array, columns: sparse.csr_array, image: Array) -> Array:
    """Both axes' weights applied to an image (H, W, C)."""
    height, width, channels = image.shape
    half = (rows @ image.reshape(height, -1)).reshape(-1, width, channels)
    whole = columns @ half.transpose(1, 0, 2).reshape(width, -1)
    return np.asarray(whole.reshape(-1, len(half), channels).transpose(1, 0, 2), dtype=np.float64)


def _variance(noise: IndependentNoise, image: Array) -> Array | None:
    """(H, W, C), the variances of noise that belongs to images of this size; None if any size will do."""
    height, width, channels = image.shape
    try:
        noise.check(max(1, height // 2), max(1, width // 2), channels)
    except NoiseError:
        pass
    else:
        return None
    if noise.depends_on_mean:
        raise NoiseError(
            "levels need noise that is the same in all pixels, or that does not depend on the image; this is "
            f"neither ({noise.description}): leave out levels"
        )
    pixels = selected(np.ones((height, width), dtype=bool))
    weights = noise.weights(pixels, np.zeros((len(pixels), channels)))
    with np.errstate(divide="ignore"):
        return np.asarray(1.0 / weights.reshape(image.shape), dtype=np.float64)
