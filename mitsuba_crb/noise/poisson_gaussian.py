"""Photon counts with Gaussian read noise, y = a N + e, N ~ Poisson(μ/a), e ~ N(0, σ²): exact information.

In photo-electrons, λ = μ/a and s = σ/a, the score is E[N | y]/λ − 1, so that

    i_λ = E[(E[N | y]/λ − 1)²],    i(μ) = i_λ(μ/a)/a²,    1/(aμ + σ²) ≤ i(μ) ≤ 1/(aμ).

The expectation is a trapezoidal sum over y, tabulated over log λ to a relative 1e-5. Above 1000
photo-electrons i · (λ + s²) − 1 falls as 1/λ. Black is not infinitely informative, i_λ(0) = exp(1/s²) − 1,
but with read noise below about 0.3 photo-electrons that is more than a real camera's dark current leaves.

Reference: Foi et al., "Practical Poissonian–Gaussian noise modeling and fitting", IEEE TIP 2008 (the model).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.special import gammaln as log_gamma
from scipy.special import ndtr, pdtr, xlogy

from ..errors import NoiseError
from .heteroscedastic import Heteroscedastic
from .parameters import positive
from .protocol import Array, ScalarNoise

_BRIGHT = 1000.0  # photo-electrons, the end of the table
_DARK = 1e-15  # photo-electrons that no exposure collects; less counts as this
_REACH = 9.0  # standard deviations; what lies farther has a probability below 1e-18
_STEPS_PER_DECADE = 16
# More than this follows a Gaussian: its skewness of 1/√λ is worth 0.3 % of the probability three spreads out.
_GAUSSIAN = 1e6  # photo-electrons


@dataclass(frozen=True)
class PoissonGaussian(ScalarNoise):
    """Poisson noise of photons and Gaussian noise of the read-out."""

    gain: float
    """a [radiance per photo-electron]."""
    read_noise: float
    """σ, standard deviation [radiance]."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "gain", positive(self.gain, "gain", "radiance per photo-electron"))
        object.__setattr__(self, "read_noise", positive(self.read_noise, "read_noise"))
        if not self._read >= 0.02:
            raise NoiseError(
                f"the read noise is {self._read:.3g} photo-electrons; at least 0.02 are needed: "
                "no camera has less, and a black pixel would tell everything"
            )

    @property
    def description(self) -> str:
        """One short phrase for tables."""
        return f"photons, gain = {self.gain:.4g}, read noise = {self.read_noise:.4g}"

    @property
    def depends_on_mean(self) -> bool:
        """Yes."""
        return True

    def check(self, height: int, width: int, channels: int) -> None:
        """Any image will do."""

    def weights(self, pixels: NDArray[np.integer], mean: Array) -> Array:
        """i(μ) for every value of `mean` (n, C); negative means count as 0."""
        electrons = np.asarray(mean, dtype=np.float64) / self.gain
        dark, ratio = _table(self._read)
        variance = np.maximum(electrons, 0.0) + self._read**2
        inside = np.clip(electrons, dark, _BRIGHT)
        excess = np.exp(ratio(np.log(inside))) - 1.0
        # Darker than the table the information stays, brighter the excess over 1/v falls as 1/λ.
        information = np.where(
            electrons > dark,
            (1.0 + excess * inside / np.maximum(electrons, inside)) / variance,
            (1.0 + excess) / (dark + self._read**2),
        )
        bounded = np.minimum(information, 1.0 / np.maximum(electrons, dark))
        return np.asarray(bounded, dtype=np.float64) / self.gain**2

    def spread(self, pixels: NDArray[np.integer], mean: Array) -> Array:
        """√(a (μ + a) + σ²), (n, C): in the dark, too, some photons are within reach."""
        return np.sqrt(self.gain * (np.maximum(mean, 0.0) + self.gain) + self.read_noise**2)

    def cumulative(self, thresholds: Array, pixels: NDArray[np.integer], mean: Array) -> tuple[Array, Array]:
        """Σ_n P(n; λ) Φ(z_n), and its derivative −Σ_n P(n; λ) (Φ(z_n) − Φ(z_{n+1}))/a, z_n = (t/a − n)/s.

        By parts the first is Σ_n P(N ≤ n; λ) (Φ(z_n) − Φ(z_{n+1})), whose terms matter within reach of the
        threshold rather than of λ: the shorter sum is taken. Thousands of photons are counted, too: their
        skewness, and a threshold between two of them, change what the tail about white tells by a tenth.
        """
        electrons = np.maximum(np.asarray(mean, dtype=np.float64), 0.0) / self.gain
        bright = electrons > _GAUSSIAN
        narrow = ~bright & (electrons > self._read**2)
        wide = ~bright & ~narrow
        P = np.zeros(thresholds.shape)
        D = np.zeros(thresholds.shape)
        if bright.any():
            limit = Heteroscedastic((self.read_noise**2, self.gain))
            P[bright], D[bright] = limit.cumulative(thresholds[bright], pixels, mean[bright])
        for part, summed in ((narrow, self._around_threshold), (wide, self._around_mean)):
            if part.any():
                P[part], D[part] = summed(thresholds[part] / self.gain, electrons[part][:, None])
        return P, D / self.gain

    def nodes(self, highest: float) -> Array:
        """Means up to `highest` between which what depends on the mean alone may be interpolated.

        A sixteenth of a standard deviation apart, and denser in the dark. The darkest has no neighbour at 0,
        where a single photon tells everything.
        """
        electrons = max(highest / self.gain, 1e-3)
        bright = np.linspace(0.0, np.sqrt(electrons), int(32.0 * np.sqrt(electrons)) + 2)[1:] ** 2
        dark = np.geomspace(1e-10, min(electrons, 1.0), 160)
        return self.gain * np.union1d(bright, dark)

    def to_dict(self) -> dict[str, Any]:
        """The model's parameters as JSON-able values."""
        return {"model": "poisson_gaussian", "gain": self.gain, "read_noise": self.read_noise}

    @property
    def _read(self) -> float:
        """s, the read noise in photo-electrons."""
        return self.read_noise / self.gain

    def _around_mean(self, thresholds: Array, electrons: Array) -> tuple[Array, Array]:
        """`cumulative` of values (m, 1) with thresholds (m, B), both in photo-electrons: Σ P(n) Φ(z_n)."""
        reach = _REACH * np.sqrt(electrons) + _REACH**2 / 2.0
        first = np.floor(np.maximum(electrons - reach, 0.0))
        last = int(np.ceil(np.max(electrons + reach - first)))
        P, D = np.zeros(thresholds.shape), np.zeros(thresholds.shape)
        for offset in range(last + 1):
            count = first + offset
            probability = _poisson(count, electrons)
            z = (thresholds - count) / self._read
            below = ndtr(z)
            P += probability * below
            D -= probability * (below - ndtr(z - 1.0 / self._read))
        return P, D

    def _around_threshold(self, thresholds: Array, electrons: Array) -> tuple[Array, Array]:
        """The same by parts, Σ P(N ≤ n) (Φ(z_n) − Φ(z_{n+1})).

        Terms are as smooth as the read noise: of many, every so manieth tells the sum to 1e-9.
        """
        stride = max(1, int(self._read / 1.5))
        first = np.floor(thresholds - _REACH * self._read)
        P, D = np.zeros(thresholds.shape), np.zeros(thresholds.shape)
        cumulated = np.zeros(thresholds.shape)
        for offset in range(0, int(np.ceil(2.0 * _REACH * self._read)) + 1, stride):
            count = np.maximum(first + offset, 0.0)
            probability = np.where(first + offset < 0.0, 0.0, _poisson(count, electrons))
            if offset and stride == 1:
                cumulated += probability
            else:
                cumulated = np.where(first + offset < 0.0, 0.0, pdtr(count, electrons))
            z = (thresholds - first - offset) / self._read
            weight = stride * (ndtr(z) - ndtr(z - 1.0 / self._read))
            P += weight * cumulated
            D -= weight * probability
        return P, D


def photon_information(electrons: float, read: float) -> float:
    """i_λ [1 / photo-electron²] of λ = `electrons` > 0 with read noise s = `read`, by quadrature."""
    reach = _REACH * np.sqrt(electrons) + _REACH**2 / 2.0
    first, last = max(0, int(electrons - reach)), int(np.ceil(electrons + reach))
    # Between the peaks of single photons E[N | y] steps within s² where s is small.
    per_electron = int(np.ceil(max(3.0 / min(read, 1.0), 3.0 / max(read, 0.15) ** 2)))
    step = 1.0 / per_electron if read < 3.0 else read / 4.0
    y = np.arange(first - _REACH * read, last + _REACH * read, step)
    window = int(np.ceil(_REACH * read)) + 3
    p, m = np.zeros_like(y), np.zeros_like(y)
    nearest = np.rint(y)
    for offset in range(-window, window + 1):
        n = nearest + offset
        inside = (n >= first) & (n <= last)
        term = np.where(inside, _poisson(np.maximum(n, 0.0), electrons), 0.0)
        term *= np.exp(-0.5 * ((y - n) / read) ** 2)
        p += term
        m += n * term
    seen = p > 0.0
    score = m[seen] / p[seen] / electrons - 1.0
    return float(np.sum(p[seen] * score**2) * step / (read * np.sqrt(2.0 * np.pi)))


@lru_cache(maxsize=64)
def _table(read: float) -> tuple[float, PchipInterpolator]:
    """The table's darkest λ, and log(i_λ · (λ + s²)) as a function of log λ."""
    # Where exp(1/s²) λ ≪ 1 nothing changes any more.
    dark = max(_DARK, 1e-4 * np.exp(-1.0 / read**2))
    count = int(np.ceil(_STEPS_PER_DECADE * np.log10(_BRIGHT / dark))) + 1
    electrons = np.geomspace(dark, _BRIGHT, count)
    information = np.array([photon_information(float(each), read) for each in electrons])
    return dark, PchipInterpolator(np.log(electrons), np.log(information * (electrons + read**2)))


def _poisson(count: Array, electrons: Array | float) -> Array:
    """P(n; λ)."""
    return np.asarray(np.exp(xlogy(count, electrons) - electrons - log_gamma(count + 1.0)), dtype=np.float64)
