"""Weights of an image that is known by a pilot render only, and what its noise does to them.

A pilot of half of the paths is √2 times as noisy. Where a weight w is smooth in the mean, that doubles the
bias of w; where means end, as at white, bias goes with the noise itself, and halves have √2 times that of the
whole. Then the bias is

    (½ w(μ_1) + ½ w(μ_2) − w(½ μ_1 + ½ μ_2)) / (√2 − 1),

what is taken: for smooth weights 2.4 times too much.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .protocol import Array, IndependentNoise


def pilot_weights(
    noise: IndependentNoise, pixels: NDArray[np.integer], mean: Array, error: Array | None
) -> tuple[Array, Array | None]:
    """Weights of a noise model, and of the same shape what their expectations may be off by.

    Args:
        pixels: (n, 2) columns and rows.
        mean: (n, C) the pilot [radiance].
        error: (n, C) half of what two halves of its paths differ by; None if it is exact, or none is known.

    Returns:
        The weights; what they may be biased by, of either sign, None if by nothing.
    """
    weights = noise.weights(pixels, mean)
    if error is None or not error.any():
        return weights, None
    halves = noise.weights(pixels, mean + error) + noise.weights(pixels, mean - error)
    return weights, np.asarray((0.5 * halves - weights) / (np.sqrt(2.0) - 1.0))
