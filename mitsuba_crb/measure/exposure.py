"""The default camera: exposed for what is lit, so that its noise follows from the image.

White is the smaller of two values, over the lit part of the image:

    white = min(99th percentile, exp(mean ln I) / 0.18),      σ = 0.01 white;

the first leaves a hundredth of the image to highlights, the second puts the average at middle grey where
bright things cover more than that (Reinhard et al. 2002). Lit is what exceeds 1e-4 of the 99th percentile of
all that is not black: a star field is exposed for its stars. What exceeds white is saturated and tells
nothing.

Values are those of the channels, each of which saturates by itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..jacobian.method import Paths
from ..noise import Clipped, Gaussian, Luminance, Measured, NoiseModel, ThresholdNoise
from ..render.random import PILOT
from ..render.rays import coarse_grid

if TYPE_CHECKING:
    from collections.abc import Callable

    from .measurable import Measurable

RELATIVE_SIGMA = 0.01
"""Standard deviation of the default noise, as a fraction of white."""
MIDDLE_GREY = 0.18
"""What the log-average is exposed to, as a fraction of white."""
GRID = 64
"""Pixels across and down that are metered."""

_LIT = 1e-4
_PERCENTILE = 99.0
_SPP = 64
_BATCHES = 4


@dataclass(frozen=True)
class Exposure:
    """How bright a value the camera can measure."""

    white: float
    """The largest value [radiance]."""
    rule: str
    """What decided it."""

    @property
    def sigma(self) -> float:
        """Standard deviation of the noise [radiance]."""
        return RELATIVE_SIGMA * self.white

    def noise(self, *, clip: bool) -> Clipped | Gaussian:
        """Of the default camera, or of one that goes on above white."""
        return Clipped(self.sigma, self.white) if clip else Gaussian(self.sigma)

    @property
    def origin(self) -> str:
        """Where the noise comes from, for tables."""
        return f"{RELATIVE_SIGMA:g} of white {self.white:.3g} ({self.rule})"


def exposed(values: NDArray[np.float64], variances: NDArray[np.float64] | None = None) -> Exposure | None:
    """The exposure for some of the image's values; None if all are black.

    Args:
        values: of any shape [radiance].
        variances: of their errors, of the same shape, which spread them and so raise a percentile.
    """
    shown = np.isfinite(values) & (values > 0.0)
    if not shown.any():
        return None
    lit = shown & (values > _LIT * np.percentile(values[shown], _PERCENTILE))
    logs = np.log(values[lit])
    mean, top = logs.mean(), np.percentile(logs, _PERCENTILE)
    if variances is not None and logs.var() > 0.0:
        bright = lit & (values >= np.median(values[lit]))
        noise = np.median(variances[bright] / values[bright] ** 2)
        top = mean + (top - mean) * np.sqrt(max(0.0, 1.0 - noise / logs.var()))
    whites = {f"{_PERCENTILE:g}th percentile": np.exp(top), "log-average": np.exp(mean) / MIDDLE_GREY}
    rule = min(whites, key=whites.__getitem__)
    return Exposure(float(whites[rule]), rule)


def start_metering(view: Measurable, seed: int, side: int = GRID) -> Callable[[], NDArray[np.float64]]:
    """Start to render a coarse grid of pixels.

    Args:
        side: pixels across and down, at most `GRID`, where the image has so many.

    Returns:
        What waits for its values [radiance] and the variances of their errors, (2, n, channels).
    """
    grid = coarse_grid(view.size, min(side, GRID)).reshape(-1, 2)
    finish = view.start_image(grid, Paths(_SPP, seed, _BATCHES), purpose=PILOT, even=True)

    def metered() -> NDArray[np.float64]:
        image = finish()
        image = view.measured.values(image)
        return np.stack([image.mean(axis=0), image.var(axis=0, ddof=1) / _BATCHES])

    return metered


@dataclass
class Saturation:
    """How much of a measurement lies above white: sums over its tiles."""

    values: int = 0
    saturated: int = 0

    def add(self, expected: NDArray[np.float64], noise: NoiseModel) -> None:
        """The expected image (n, C) of a tile."""
        limited = noise.noise if isinstance(noise, Luminance) else noise
        if isinstance(noise, ThresholdNoise) and isinstance(limited, ThresholdNoise):
            found = noise.saturated(expected)
            self.values += found.size
            self.saturated += int(found.sum())

    @property
    def share(self) -> float | None:
        """Of the measured values; None of noise that has no white."""
        return self.saturated / self.values if self.values else None


def noise_facts(noise: NoiseModel, origin: str, measured: Measured, saturation: Saturation) -> dict[str, Any]:
    """What a provenance says of the noise that was measured under, JSON-able."""
    if measured.depth is not None and isinstance(noise, Luminance):
        noise = noise.noise  # of the one depth of the image's three
    facts = {**noise.to_dict(), "description": noise.description, "origin": origin, "unit": measured.unit}
    return facts if saturation.share is None else {**facts, "saturated": saturation.share}
