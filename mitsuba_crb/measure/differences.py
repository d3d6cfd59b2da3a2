"""Which part of an information finite differences measured, in the place of a method that could not."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..information.accumulate import InformationAccumulator
from ..information.blocks import BLOCK
from ..information.fisher import FisherInformation
from ..jacobian.closure import FilmBlocks
from .tile_jacobian import TileJacobian


@dataclass
class Differences:
    """Sums over the tiles of a measurement."""

    blocks: Counter[str] = field(default_factory=Counter)
    """How many of the film's blocks, by why."""
    matrix: NDArray[np.float64] = field(default_factory=lambda: np.zeros((6, 6)))
    """Their part of F̂, in the camera frame."""
    step_bias: float = 0.0
    """Relative error that their step may leave in it."""

    def add(self, tile: TileJacobian, weights: NDArray[np.float64]) -> None:
        """What of a tile under a noise model's weights was measured so."""
        if tile.causes is None:
            return
        rows = tile.causes != None  # noqa: E711  # an array
        if not rows.any():
            return
        pixels, causes = tile.pixels[rows], tile.causes[rows]
        first = np.unique(FilmBlocks.of(pixels).home, return_index=True)[1]
        self.blocks.update(causes[first].tolist())
        self.step_bias = tile.step_bias
        part = InformationAccumulator(batches=len(tile.batch_values), block=BLOCK)
        part.add(tile.batch_values[:, rows], weights[rows], pixels)
        self.matrix += part.added.matrix

    def to_dict(self, information: FisherInformation) -> dict[str, Any]:
        """Their share of an information's trace, in scaled units, JSON-able."""
        total = float(np.diagonal(information.matrix) @ information.scale**2)
        part = float(np.diagonal(self.matrix) @ information.scale**2)
        return {
            "share": part / total if total > 0.0 else 0.0,
            "step_bias": self.step_bias,
            "blocks": dict(self.blocks),
        }
