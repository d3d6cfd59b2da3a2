"""What a photograph's values are of the scene's radiance: a gain and a black level, fitted to a render.

    y ≈ gain R + black,

of each channel by itself (white balance), common to all, or known. The fit is linear least squares. The
render R̂ has errors of its own, whose square would make the gain too small (errors in variables): R̂'s second
moment comes from products of different batches. The image's derivatives in what is fitted are ∂y/∂gain = R
and ∂y/∂black = 1.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from ..files import Record
from ..se3 import Array

ToneKind = Literal["known", "common", "channels"]
"""Whether gain and black are fitted, and to what."""
TONES: tuple[ToneKind, ...] = ("known", "common", "channels")

_LEAST_CORRELATION = 0.3
"""Of a render and an image that differ much, a fit finds hardly any gain, and steps would be as much too
long: a gain is at least this times the ratio of their standard deviations."""
_CONSTANT = 1e-6
"""A render whose standard deviation is a smaller part of its mean has none, and no gain."""


@dataclass(frozen=True, eq=False)
class Tone(Record):
    """A gain and a black level of each channel."""

    kind: ToneKind
    """Whether they are fitted, and to what."""
    gain: Array = field(default_factory=lambda: np.ones(3))
    """(3,) [value / radiance]."""
    black: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) [value]."""

    def __call__(self, image: Array) -> Array:
        """Values (..., 3) of an image's radiance (..., 3)."""
        return np.asarray(self.gain * image + self.black, dtype=np.float64)

    @property
    def parameters(self) -> tuple[str, ...]:
        """The name of each column."""
        return ("gain",) * len(self._groups) + ("black",) * len(self._groups)

    def columns(self, image: Array) -> Array:
        """Derivatives (..., 3, m) of the values in what is fitted, from the radiance (..., 3)."""
        parts = [np.isin(np.arange(3), group).astype(np.float64) for group in self._groups]
        gains, blacks = (
            [image * part for part in parts],
            [np.broadcast_to(part, image.shape) for part in parts],
        )
        return np.stack([*gains, *blacks], axis=-1) if parts else np.empty((*image.shape, 0))

    def fitted(self, measured: Array, batches: Array, weights: Array) -> Tone:
        """The same kind, fitted to an image.

        Args:
            measured: (n, 3) [value].
            batches: (K, n, 3), independent renders of it [radiance].
            weights: (n, 3), of the measured values; zero of those that say nothing.
        """
        gain, black = self.gain.copy(), self.black.copy()
        for group in self._groups:
            gain[group], black[group] = _line(measured[:, group], batches[..., group], weights[:, group])
        return Tone(self.kind, gain, black)

    @property
    def _groups(self) -> list[list[int]]:
        """Channels that have their gain and black in common."""
        return {"known": [], "common": [[0, 1, 2]], "channels": [[0], [1], [2]]}[self.kind]


def _line(measured: Array, batches: Array, weights: Array) -> tuple[float, float]:
    """Gain and black of some channels: the line of least squares, if there is one."""
    total, K = weights.sum(), len(batches)
    if not total > 0.0:
        return 0.0, 0.0
    share = weights / total
    render = batches.mean(axis=0)
    level, shown = float(np.sum(share * measured)), float(np.sum(share * render))
    off, offs = measured - level, batches - shown
    square = float(np.sum(share * offs.sum(axis=0) ** 2) - np.sum(share * offs**2)) / (K * (K - 1))
    if not square > (_CONSTANT * shown) ** 2:
        return 0.0, level
    least = _LEAST_CORRELATION * np.sqrt(np.sum(share * off**2) / square)
    gain = max(float(np.sum(share * off * (render - shown))) / square, float(least))
    return gain, level - gain * shown
