"""Response curves r between exposed linear radiance x and measured value y = r(x): strictly increasing.

They are not clipped: values below black and above white continue, because noise reaches there; clipping is
part of the quantisation. Each has r, r' and r⁻¹.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
from scipy.interpolate import PchipInterpolator

from ..errors import NoiseError
from .parameters import array, positive
from .protocol import Array


@runtime_checkable
class Curve(Protocol):
    """A strictly increasing response."""

    def __call__(self, x: Array) -> Array:
        """r(x)."""

    def derivative(self, x: Array) -> Array:
        """r'(x)."""

    def inverse(self, y: Array) -> Array:
        """r⁻¹(y)."""

    def to_dict(self) -> dict[str, Any]:
        """The curve's parameters as JSON-able values."""


@dataclass(frozen=True)
class Linear:
    """r(x) = x."""

    def __call__(self, x: Array) -> Array:
        """x."""
        return x

    def derivative(self, x: Array) -> Array:
        """1."""
        return np.ones_like(x)

    def inverse(self, y: Array) -> Array:
        """y."""
        return y

    def to_dict(self) -> dict[str, Any]:
        """The curve's name."""
        return {"curve": "linear"}


@dataclass(frozen=True)
class Power:
    """y = (1 + offset) x^(1/gamma) − offset above `toe`, and a straight line through black below."""

    gamma: float = 2.2
    """The exponent's inverse, above 0."""
    toe: float = 1e-3
    """x below which the curve is straight: a power's slope at black is zero or infinite."""
    offset: float = 0.0
    """What the power is shifted by, as in sRGB."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "gamma", positive(self.gamma, "gamma", "1"))
        object.__setattr__(self, "toe", positive(self.toe, "toe"))
        if not (np.isfinite(self.offset) and self._power(np.array(self.toe)) > 0.0):
            raise NoiseError(f"the toe {self.toe:g} must lie where the power curve is positive")

    def __call__(self, x: Array) -> Array:
        """r(x)."""
        bright = np.maximum(x, self.toe)
        return np.where(x < self.toe, x * self._slope, self._power(bright))

    def derivative(self, x: Array) -> Array:
        """r'(x); at the toe itself that of the power."""
        bright = np.maximum(x, self.toe)
        power = (1.0 + self.offset) / self.gamma * bright ** (1.0 / self.gamma - 1.0)
        return np.where(x < self.toe, self._slope, power)

    def inverse(self, y: Array) -> Array:
        """r⁻¹(y)."""
        knee = self._power(np.array(self.toe))
        bright = ((np.maximum(y, knee) + self.offset) / (1.0 + self.offset)) ** self.gamma
        return np.where(y < knee, y / self._slope, bright)

    def to_dict(self) -> dict[str, Any]:
        """The curve's parameters; of sRGB its name."""
        if self == SRGB:
            return {"curve": "srgb"}
        return {"curve": "power", "gamma": self.gamma, "toe": self.toe, "offset": self.offset}

    @property
    def _slope(self) -> float:
        return float(self._power(np.array(self.toe))) / self.toe

    def _power(self, x: Array) -> Array:
        return np.asarray((1.0 + self.offset) * x ** (1.0 / self.gamma) - self.offset, dtype=np.float64)


SRGB = Power(gamma=2.4, toe=0.0031308, offset=0.055)
"""The sRGB transfer curve, IEC 61966-2-1."""


@dataclass(frozen=True, eq=False)
class Tabulated:
    """Any increasing curve by points, joined by monotone cubics and continued by straight lines."""

    x: tuple[float, ...]
    """Exposed radiance, increasing."""
    y: tuple[float, ...]
    """Measured values there, increasing."""
    _cubic: PchipInterpolator = field(init=False, repr=False)
    _slopes: Array = field(init=False, repr=False)

    def __init__(self, x: Sequence[float] | Array, y: Sequence[float] | Array) -> None:
        xs, ys = array(x, "a curve"), array(y, "a curve")
        if xs.ndim != 1 or xs.shape != ys.shape or len(xs) < 2:
            raise NoiseError(f"a curve needs as many x as y, at least two; got {xs.shape} and {ys.shape}")
        for name, values in (("x", xs), ("y", ys)):
            if not (np.isfinite(values).all() and (np.diff(values) > 0.0).all()):
                raise NoiseError(f"a curve must increase strictly; its {name} do not")
        object.__setattr__(self, "x", tuple(xs.tolist()))
        object.__setattr__(self, "y", tuple(ys.tolist()))
        object.__setattr__(self, "_cubic", PchipInterpolator(xs, ys))
        object.__setattr__(self, "_slopes", np.diff(ys)[[0, -1]] / np.diff(xs)[[0, -1]])

    def __call__(self, x: Array) -> Array:
        """r(x)."""
        inside = np.clip(x, self.x[0], self.x[-1])
        return np.asarray(self._cubic(inside) + (x - inside) * self._outer(x), dtype=np.float64)

    def derivative(self, x: Array) -> Array:
        """r'(x)."""
        outside = (x < self.x[0]) | (x > self.x[-1])
        inner = self._cubic(np.clip(x, self.x[0], self.x[-1]), 1)
        return np.asarray(np.where(outside, self._outer(x), inner), dtype=np.float64)

    def inverse(self, y: Array) -> Array:
        """r⁻¹(y), by bisection to rounding."""
        values = np.asarray(y, dtype=np.float64)
        low, high = np.full(values.shape, self.x[0]), np.full(values.shape, self.x[-1])
        for _ in range(80):
            middle = 0.5 * (low + high)
            below = self._cubic(middle) < values
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        beyond = values - np.clip(values, self.y[0], self.y[-1])
        first, last = self._slopes
        return np.asarray(0.5 * (low + high) + beyond / np.where(beyond < 0.0, first, last), dtype=np.float64)

    def to_dict(self) -> dict[str, Any]:
        """The curve's points."""
        return {"curve": "tabulated", "x": list(self.x), "y": list(self.y)}

    def _outer(self, x: Array) -> Array:
        """The slope of the line that continues the curve on x's side."""
        first, last = self._slopes
        return np.asarray(np.where(x < self.x[0], first, last), dtype=np.float64)
