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
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..jacobian.method import Paths
from ..noise import Clipped, Gaussian, NoiseModel, ThresholdNoise
from ..noise.colour import REC709
from ..render.random import PILOT
from ..render.rays import coarse_grid

if TYPE_CHECKING:
    from collections.abc import Callable

    from .measurable import Measurable

RELATIVE_SIGMA = 0.01
"""Standard deviation of the default noise, as a fraction of white."""
MIDDLE_GREY = 0.18
"""What the log-average is exposed to, as a fraction of white."""

_LIT = 1e-4
_PERCENTILE = 99.0
_GRID = 64
_SPP = 64  # at less, the noise of soft shadows raises the percentile by some per cent


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


def exposed(values: NDArray[np.float64]) -> Exposure | None:
    """The exposure for some of the image's values, of any shape [radiance]; None if all are black."""
    shown = values[np.isfinite(values) & (values > 0.0)]
    if not shown.size:
        return None
    lit = shown[shown > _LIT * np.percentile(shown, _PERCENTILE)]
    whites = {
        f"{_PERCENTILE:g}th percentile": float(np.percentile(lit, _PERCENTILE)),
        "log-average": float(np.exp(np.log(lit).mean())) / MIDDLE_GREY,
    }
    rule = min(whites, key=whites.__getitem__)
    return Exposure(whites[rule], rule)


def start_metering(view: Measurable, seed: int) -> Callable[[], NDArray[np.float64]]:
    """Start to render a coarse grid of pixels; what waits for its values (n, channels) [radiance]."""
    grid = coarse_grid(view.size, _GRID).reshape(-1, 2)
    finish = view.start_image(grid, Paths(_SPP, seed, 1), purpose=PILOT, even=True)

    def values() -> NDArray[np.float64]:
        image = finish()[0]
        return np.asarray(image @ np.array(REC709)[:, None] if view.luminance else image)

    return values


@dataclass
class Saturation:
    """How much of a measurement lies above white: sums over its tiles."""

    values: int = 0
    saturated: int = 0

    def add(self, expected: NDArray[np.float64], noise: NoiseModel) -> None:
        """The expected image (n, C) of a tile."""
        if isinstance(noise, ThresholdNoise):
            found = noise.saturated(expected)
            self.values += found.size
            self.saturated += int(found.sum())

    @property
    def share(self) -> float | None:
        """Of the measured values; None of noise that has no white."""
        return self.saturated / self.values if self.values else None
