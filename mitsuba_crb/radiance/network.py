"""The field itself: density and colour at a point, and their gradients, by a hash grid and a small network.

    (s, k) = W₂ relu(W₁ features(u) + b₁) + b₂       s: 1, k: 3 x 9
    σ = window(u) exp(s + haze)                      density [1 / scale of the scene]
    c = sigmoid(Σ_j k_j Y_j(d))                      display-referred

The network sees no direction: colours' harmonics do, so that all derivatives follow from three tangents in u.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..render.arrays import upload
from .harmonics import harmonics
from .interpolation import encode

if TYPE_CHECKING:
    import mitsuba as mi

Weights = dict[str, NDArray[np.float32]]

COUNT = 9
"""Harmonics of the direction that a colour has, degrees 0 to 2."""
OUTPUTS = 1 + 3 * COUNT
_HIGHEST = 11.0
"""Of that logarithm: denser is opaque within any step, and exp stays far from overflow."""


@dataclass(frozen=True)
class Design:
    """Sizes of a field's parts."""

    levels: int = 7
    """Of the hash grid."""
    features: int = 4
    """Per level: 2 or 4."""
    coarsest: int = 16
    """Vertices along a side of the cube on the first level."""
    finest: int = 512
    """On the last: cells as large as what a pixel sees hold all that photographs tell."""
    table: int = 2**18
    """Most entries of a level."""
    hidden: int = 64
    """Units of the network's hidden layer."""
    cells: int = 128
    """Of the occupancy, along a side of the cube."""
    steps: int = 640
    """Places along a ray while training, each ray's shifted by chance."""
    near: float = 0.1
    """Where the first of them is [scale of the scene]."""
    haze: float = -3.0
    """Logarithm of an untrained scene's density: a fog so thin that what is behind is learned too."""
    far: float = 33.0
    """Where the last is: beyond the last cell whose window is not 0."""

    def ratio(self, finer: int = 1) -> float:
        """Of the distances of two neighbouring places along a ray, with so many times as many of them."""
        return float((self.far / self.near) ** (1.0 / (finer * self.steps)))

    def encoding(self, seed: int) -> Any:
        """A new hash grid, filled with small random numbers."""
        import mitsuba as mi
        from drjit import nn

        growth = (self.finest / self.coarsest) ** (1.0 / max(1, self.levels - 1))
        return nn.HashGridEncoding(
            mi.Float,
            3,
            n_levels=self.levels,
            n_features_per_level=self.features,
            hashmap_size=self.table,
            base_resolution=self.coarsest,
            per_level_scale=growth,
            rng=dr.rng(seed=seed),
        )

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Of the arrays in `Weights`."""
        inputs = self.levels * self.features
        return {
            "w1": (self.hidden, inputs),
            "b1": (self.hidden,),
            "w2": (OUTPUTS, self.hidden),
            "b2": (OUTPUTS,),
        }


def new_weights(design: Design, seed: int) -> Weights:
    """An untrained network's."""
    rng = np.random.default_rng((seed, 1))
    weights = {}
    for name, shape in design.shapes().items():
        limit = np.sqrt(6.0 / sum(shape)) if len(shape) == 2 else 0.0
        weights[name] = rng.uniform(-limit, limit, shape).astype(np.float32)
    return weights


class Network:
    """A hash grid and the network behind it, where kernels can read them."""

    def __init__(self, design: Design, encoding: Any, weights: Weights, *, turned: bool = False) -> None:
        """Of a hash grid and weights.

        Args:
            turned: sums of the network run from their other end: the same but for rounding.
        """
        import mitsuba as mi
        from drjit import nn

        weights = _turned(weights) if turned else weights
        self.encoding, self.turned, self._haze = encoding, turned, design.haze
        tensors = [
            mi.TensorXf(upload(mi.Float, weights[name].ravel()), weights[name].shape)
            for name in ("w1", "b1", "w2", "b2")
        ]
        self._views = nn.pack(*tensors, layout="training")
        self.packed = self._views[0].buffer
        """All of them in one array, which may be written to."""

    def weights(self) -> Weights:
        """What it was made of, and has become."""
        import mitsuba as mi
        from drjit import nn

        found = {}
        for name, view in zip(("w1", "b1", "w2", "b2"), nn.unpack(*self._views), strict=True):
            values = np.array(mi.TensorXf(view), dtype=np.float32)
            found[name] = values.reshape(-1) if name.startswith("b") else values
        return _turned(found) if self.turned else found

    def outputs(self, u: mi.Vector3f, *, slopes: bool = False) -> tuple[list[Any], list[list[Any]]]:
        """S and k at u, and if asked their derivatives along the three axes."""
        from drjit import nn

        w1, b1, w2, b2 = self._views
        features, along = encode(self.encoding, u, slopes=slopes)
        before = nn.matvec(w1, nn.CoopVec(*self._ordered(features)), b1)
        values = list(nn.matvec(w2, dr.maximum(before, 0.0), b2))
        tangents = []
        if slopes:
            lit = [value > 0.0 for value in before]
            for slope in along:
                hidden = list(nn.matvec(w1, nn.CoopVec(*self._ordered(slope))))
                kept = [dr.select(on, value, 0.0) for on, value in zip(lit, hidden, strict=True)]
                tangents.append(list(nn.matvec(w2, nn.CoopVec(*kept))))
        return values, tangents

    def density(self, s: mi.Float) -> mi.Float:
        """exp(s + haze), before the window."""
        return dr.exp(dr.minimum(s + self._haze, _HIGHEST))

    def density_rises(self, s: mi.Float) -> mi.Bool:
        """Whether density depends on s: not where it is as high as it gets."""
        return s + self._haze < _HIGHEST

    def _ordered(self, features: list[Any]) -> list[Any]:
        return features[::-1] if self.turned else features


def _turned(weights: Weights) -> Weights:
    """The same network with inputs and hidden units in reverse."""
    w1, b1, w2, b2 = (weights[name] for name in ("w1", "b1", "w2", "b2"))
    return {"w1": w1[::-1, ::-1], "b1": b1[::-1], "w2": w2[:, ::-1], "b2": b2}


def colour(outputs: list[Any], Y: list[Any]) -> mi.Color3f:
    """C at a point, of what `Network.outputs` gave there, and harmonics of the direction."""
    import mitsuba as mi

    raw = [weighted(outputs, Y, channel) for channel in range(3)]
    return mi.Color3f(*(1.0 / (1.0 + dr.exp(-value)) for value in raw))


def basis(d: mi.Vector3f) -> tuple[list[mi.Float], list[mi.Vector3f]]:
    """Y of a direction, and their gradients in it."""
    import mitsuba as mi

    values, gradients = harmonics(d, COUNT)
    return [mi.Float(value) for value in values], [mi.Vector3f(*gradient) for gradient in gradients]


def weighted(outputs: list[Any], Y: list[Any], channel: int) -> Any:
    """Σ_j k_j Y_j of a channel; Y numbers or vectors."""
    k = outputs[1 + channel * COUNT : 1 + (channel + 1) * COUNT]
    total = k[0] * Y[0]
    for a, b in zip(k[1:], Y[1:], strict=True):
        total += a * b
    return total
