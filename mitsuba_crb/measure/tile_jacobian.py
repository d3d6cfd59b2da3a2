"""What one tile of an image contributes to its Jacobian."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray


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
    luminance: bool = False
    """Whether the noise is that of one channel, the luminance."""

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
        others = None if self.nuisance_values is None else self.nuisance_values[:, good]
        pilot = None if self.pilot is None else self.pilot[good]
        return replace(
            self,
            batch_values=self.batch_values[:, good],
            pixels=self.pixels[good],
            mean=self.mean[good],
            nuisance_values=others,
            pilot=pilot,
        )

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
