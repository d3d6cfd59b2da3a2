"""The sensor's response between radiance and measurement: exposure, a curve, clipping and quantisation.

With exposure k, x = kμ and a curve r, noise enters *before* the curve, y = r(x + e), or *after* it,
y = r(x) + e. Before it, an increasing curve loses nothing: i(μ) = k² i_e(kμ). After it, by the chain rule,
i(μ) = k² r'(kμ)² i_e(r(kμ)). Clipping and quantisation turn y into one of the codes 0 .. L−1, the first and
last of which hold everything below black and above white; with bins B_j that is one categorical model,

    i = Σ_j (∂P(B_j)/∂m)² / P(B_j),

where m is the noise's mean, x or r(x), and where noise comes first the bins' edges are carried back by r⁻¹.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from ..errors import NoiseError
from .curves import Curve, Linear
from .parameters import positive
from .poisson_gaussian import PoissonGaussian
from .protocol import Array, CoupledNoise, IndependentNoise, ScalarNoise

NoiseAt = Literal["before", "after"]

# A bin is skipped if its probability is rounding; what the remaining bins lose is far below rounding.
_IMPROBABLE = 1e-14
_REACH = 9.0
# More codes than this within reach are lumped together: 18 spreads in 1024 bins lose (18/1024)²/12 = 3e-5 of
# a Gaussian's information, and at most 1 % at the kink of a Laplace density.
_MOST_BINS = 1024
# Fewer of photons, whose density is smooth and whose sums are long: (18/192)²/12 = 7e-4.
_PHOTON_BINS = 192
_SPARSER = 16  # nodes of a table to one where it is smooth
_CHUNK = 1 << 21  # numbers held at once


@dataclass(frozen=True)
class Quantisation:
    """Codes 0 .. levels − 1 for the values from black to white, the nearest code; beyond, it is clipped."""

    levels: int = 256
    """L, at least 2."""
    black: float = 0.0
    """The value of code 0 [measured units]."""
    white: float = 1.0
    """The value of code L − 1 [measured units]."""

    def __post_init__(self) -> None:
        if (
            isinstance(self.levels, bool)
            or self.levels != int(self.levels)
            or not 2 <= self.levels <= 1 << 16
        ):
            raise NoiseError(f"levels must be a whole number between 2 and 65536, not {self.levels!r}")
        object.__setattr__(self, "levels", int(self.levels))
        if not (np.isfinite([self.black, self.white]).all() and self.black < self.white):
            raise NoiseError(f"black must lie below white, not at {self.black!r} and {self.white!r}")

    @property
    def thresholds(self) -> Array:
        """(L − 1,), the values halfway between codes."""
        step = (self.white - self.black) / (self.levels - 1)
        return np.asarray(self.black + step * (np.arange(self.levels - 1) + 0.5), dtype=np.float64)


@dataclass(frozen=True)
class Sensor(IndependentNoise):
    """A camera's response around a noise model of independent pixels."""

    noise: IndependentNoise
    """Its parameters are in units of x if the noise is before the curve, of y if after."""
    noise_at: NoiseAt
    """`"before"` or `"after"` the curve."""
    curve: Curve = field(default_factory=Linear)
    """r."""
    exposure: float = 1.0
    """k, exposed radiance per radiance."""
    quantisation: Quantisation | None = None
    """None measures y itself."""

    def __post_init__(self) -> None:
        if isinstance(self.noise, CoupledNoise) or not isinstance(self.noise, IndependentNoise):
            raise NoiseError(f"Sensor needs noise of independent pixels, not {self.noise!r}")
        if self.noise_at not in ("before", "after"):
            raise NoiseError(f"noise_at must be 'before' or 'after' the curve, not {self.noise_at!r}")
        if not isinstance(self.curve, Curve):
            raise NoiseError(f"curve must be a response curve such as noise.SRGB, not {self.curve!r}")
        object.__setattr__(self, "exposure", positive(self.exposure, "exposure", "1"))
        if self.quantisation is not None and not isinstance(self.noise, ScalarNoise):
            raise NoiseError(
                "quantisation needs noise of independent values with a distribution (Gaussian, photons, "
                f"Student's t, Laplace), not {type(self.noise).__name__}"
            )

    @property
    def description(self) -> str:
        """One short phrase for tables."""
        curve = self.curve.to_dict()["curve"]
        codes = "" if self.quantisation is None else f", {self.quantisation.levels} codes"
        article = "an" if curve == "srgb" else "a"
        return f"{self.noise.description}, {self.noise_at} {article} {curve} curve{codes}"

    @property
    def depends_on_mean(self) -> bool:
        """Unless the noise does not, and the curve is straight or behind it, and nothing is quantised."""
        bent = self.noise_at == "after" and not isinstance(self.curve, Linear)
        return self.noise.depends_on_mean or bent or self.quantisation is not None

    def check(self, height: int, width: int, channels: int) -> None:
        """As the noise."""
        self.noise.check(height, width, channels)

    def weights(self, pixels: NDArray[np.integer], mean: Array) -> Array:
        """k² i(kμ), with the curve's slope squared if the noise comes after it; (n, C) or (n, C, C)."""
        m = self.exposure * np.asarray(mean, dtype=np.float64)
        slope = np.full(m.shape, self.exposure)
        thresholds = None if self.quantisation is None else self.quantisation.thresholds
        if self.noise_at == "after":
            slope = slope * self.curve.derivative(m)
            m = self.curve(m)
        elif thresholds is not None:
            thresholds = self.curve.inverse(thresholds)
        if thresholds is not None and isinstance(self.noise, ScalarNoise):
            return slope**2 * categorical_information(self.noise, thresholds, pixels, m)
        information = self.noise.weights(pixels, m)
        if information.ndim == 3:
            return np.asarray(slope[:, :, None] * information * slope[:, None, :], dtype=np.float64)
        return np.asarray(slope**2 * information, dtype=np.float64)

    def to_dict(self) -> dict[str, Any]:
        """The model's parameters as JSON-able values."""
        codes = {} if self.quantisation is None else {"quantisation": vars(self.quantisation).copy()}
        return {
            "model": "sensor",
            "noise": self.noise.to_dict(),
            "noise_at": self.noise_at,
            "curve": self.curve.to_dict(),
            "exposure": self.exposure,
            **codes,
        }


def categorical_information(
    noise: ScalarNoise, thresholds: Array, pixels: NDArray[np.integer], mean: Array
) -> Array:
    """(n, C), the information about its mean that a value keeps when only its bin is told.

    Sums over photon counts are long: of photon noise the kept fraction is tabulated, once for all values.

    Args:
        noise: of the value.
        thresholds: (B,), increasing, the edges between bins; the first and last bin are half infinite.
        pixels: (n, 2), column x and row y.
        mean: (n, C).
    """
    if isinstance(noise, PoissonGaussian):
        lowest, highest, fraction = _kept(noise, tuple(thresholds.tolist()))
        root = np.sqrt(np.clip(mean, lowest, highest))
        return np.asarray(fraction(root) * noise.weights(pixels, mean), dtype=np.float64)
    return _binned(noise, thresholds, pixels, mean)


@lru_cache(maxsize=8)
def _kept(noise: PoissonGaussian, thresholds: tuple[float, ...]) -> tuple[float, float, PchipInterpolator]:
    """The mean below which the kept fraction stays, that above which nothing is kept, and it, of the root."""
    top, half = max(thresholds[-1], 0.0), 0.5 * _REACH**2 * noise.gain
    # The last threshold lies `_REACH` spreads below: (mean − top)² = reach² (gain (mean + gain) + read²).
    spread = np.hypot(np.sqrt(noise.gain * (top + noise.gain)), noise.read_noise)
    highest = top + half + float(np.hypot(half, _REACH * spread))
    edges = np.array(thresholds)
    nodes = noise.nodes(highest)
    nodes = nodes[_oscillates(noise, edges, nodes) | (np.arange(len(nodes)) % _SPARSER == 0)][:, None]
    pixels = np.zeros((len(nodes), 2), dtype=np.int64)
    told = _binned(noise, edges, pixels, nodes, _PHOTON_BINS) / noise.weights(pixels, nodes)
    fraction = PchipInterpolator(np.sqrt(nodes[:, 0]), np.minimum(told[:, 0], 1.0))
    return float(nodes[0, 0]), highest, fraction


def _oscillates(noise: PoissonGaussian, thresholds: Array, means: Array) -> NDArray[np.bool_]:
    """Where the kept fraction varies within a spread: a code is as wide as two, or an end is within reach."""
    spread = noise.spread(np.zeros((len(means), 2), dtype=np.int64), means)
    near = [means - _REACH * spread, means, means + _REACH * spread]
    below = np.searchsorted(thresholds, near)
    ends = (below[0] == 0) | (below[2] == len(thresholds))
    gaps = np.diff(thresholds, append=np.inf)[np.minimum(below, len(thresholds) - 1)]
    return np.asarray(ends | (gaps.max(axis=0) > 0.5 * spread), dtype=np.bool_)


def _binned(
    noise: ScalarNoise, thresholds: Array, pixels: NDArray[np.integer], mean: Array, most: int = _MOST_BINS
) -> Array:
    reach = _REACH * noise.spread(pixels, mean)
    first = np.searchsorted(thresholds, mean - reach)
    count = np.searchsorted(thresholds, mean + reach) - first
    bins = min(int(count.max(initial=1)), most)
    information = np.empty(mean.shape)
    rows = max(1, _CHUNK // (max(bins, 1) * mean.shape[1]))
    for start in range(0, len(mean), rows):
        part = slice(start, start + rows)
        # Equal thresholds give bins of no probability, which count nothing.
        last = np.maximum(count[part, :, None] - 1, 0)
        steps = np.arange(max(bins, 1)) * last // max(bins - 1, 1)  # by floats the last step may be missed
        near = thresholds[np.minimum(first[part, :, None] + steps, len(thresholds) - 1)]
        P, D = noise.cumulative(near, pixels[part], mean[part])
        p = np.diff(P, axis=-1, prepend=0.0, append=1.0)
        d = np.diff(D, axis=-1, prepend=0.0, append=0.0)
        seen = p > _IMPROBABLE
        information[part] = np.sum(np.where(seen, d**2, 0.0) / np.where(seen, p, 1.0), axis=-1)
    # Far beyond black or white not even rounding is left.
    return np.where(count > 0, information, 0.0)
