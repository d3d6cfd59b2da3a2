"""What one tile of an image contributes to its Jacobian."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..noise import IndependentNoise
from ..noise.pilot import pilot_weights


@dataclass(frozen=True)
class TileJacobian:
    """What one tile contributes, before it is folded into the information."""

    batch_values: NDArray[np.float64]
    """(K, n, 3, 6) estimates of dI/dξ in the camera frame."""
    pixels: NDArray[np.int64]
    """(n, 2) columns and rows."""
    mean: NDArray[np.float64]
    """(n, 3) the image there, by the derivative's own paths [radiance]."""
    nuisance_values: NDArray[np.float64] | None = None
    """(K, n, 3, m) estimates of the derivatives in the nuisance parameters; None without any."""
    pilot: NDArray[np.float64] | None = None
    """(n, 3) the image there by other random numbers; None where no noise depends on it."""
    pilot_error: NDArray[np.float64] | None = None
    """(n, 3) half of what two halves of the pilot's paths differ by; None where there are none."""
    causes: NDArray[np.object_] | None = None
    """None, or (n,) why finite differences measured a pixel, "" where they did not."""
    step_bias: float = 0.0
    """Relative error that their step may leave in the information of those pixels; without causes, of all."""
    weights: NDArray[np.float64] | None = None
    """(n, 3) or (n, 3, 3), those of the noise [1 / radiance²]; None where none was told."""
    weight_bias: NDArray[np.float64] | None = None
    """As `weights`, what the pilot's noise may do to their expectations; None where none depends on it."""
    spp: int = 0
    """Paths of each of its pixels; 0 where there are none, or nobody said."""

    def finite(self) -> TileJacobian:
        """Without the pixels at which anything is NaN or infinite."""
        found = [self.batch_values, self.mean[None]]
        if self.nuisance_values is not None:
            found.append(self.nuisance_values)
        if all(np.isfinite(values.sum()) for values in found):
            return self
        good = np.logical_and.reduce(
            [np.isfinite(values).all(axis=(0, *range(2, values.ndim))) for values in found]
        )
        return self.part(good)

    def part(self, rows: NDArray[np.bool_]) -> TileJacobian:
        """Some of its pixels (n,)."""
        given = {
            name: getattr(self, name) for name in ("pilot", "pilot_error", "causes", "weights", "weight_bias")
        }
        chosen: dict[str, Any] = {name: v if v is None else v[rows] for name, v in given.items()}
        others = self.nuisance_values
        return replace(
            self,
            batch_values=self.batch_values[:, rows],
            pixels=self.pixels[rows],
            mean=self.mean[rows],
            nuisance_values=None if others is None else others[:, rows],
            **chosen,
        )

    def weighed(self, noise: IndependentNoise, told: NDArray[np.bool_] | None = None) -> TileJacobian:
        """With a noise model's weights, and what they may be biased by.

        Args:
            noise: of independent pixels.
            told: (H, W) which pixels tell anything; None: all. The columns of the others are zero whatever
                their weight, which depth's noise has none of where there is no depth.
        """
        weights, bias = pilot_weights(noise, self.pixels, self.expected, self.pilot_error)
        if told is not None:
            x, y = self.pixels.T
            weights = np.where(told[y, x].reshape(-1, *(weights.ndim - 1) * [1]), weights, 1.0)
        return replace(self, weights=weights, weight_bias=bias)

    @property
    def bias(self) -> NDArray[np.float64]:
        """(n,) relative error of their information by the step of finite differences, 0 without any."""
        if self.causes is None:
            return np.full(len(self.pixels), self.step_bias)
        return np.where(self.causes != "", self.step_bias, 0.0)

    @property
    def expected(self) -> NDArray[np.float64]:
        """(n, 3), what noise may depend on: the pilot, or the image where there is none."""
        return self.mean if self.pilot is None else self.pilot

    @property
    def all_values(self) -> NDArray[np.float64]:
        """(K, n, 3, 6 + m), the pose's and the nuisances' columns."""
        if self.nuisance_values is None:
            return self.batch_values
        return np.concatenate([self.batch_values, self.nuisance_values], axis=-1)
