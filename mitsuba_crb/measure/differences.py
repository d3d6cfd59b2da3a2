"""Which part of an information finite differences measured, in the place of a method that could not."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..information.joint import JointInformation
from ..jacobian.closure import FilmBlocks
from .tile_jacobian import TileJacobian


@dataclass
class Differences:
    """Counts over the tiles of a measurement."""

    blocks: Counter[str] = field(default_factory=Counter)
    """How many of the film's blocks, by why."""
    step_bias: float = 0.0
    """Relative error that their step may leave in their part of F̂."""

    def add(self, tile: TileJacobian) -> None:
        """What of a tile was measured so."""
        if tile.causes is None:
            return
        rows = np.flatnonzero(tile.causes != "")
        if not len(rows):
            return
        pixels, causes = tile.pixels[rows], tile.causes[rows]
        first = np.unique(FilmBlocks.of(pixels).home, return_index=True)[1]
        self.blocks.update(causes[first].tolist())
        self.step_bias = tile.step_bias

    def to_dict(self, joint: JointInformation) -> dict[str, Any]:
        """Their share of the trace of the pose's information, in scaled units, JSON-able.

        Args:
            joint: of all these tiles and no others; its bias is that of the step, of their part alone.
        """
        matrix, squared = joint.information.matrix, joint.scale**2
        part, total = (float(np.diagonal(found) @ squared) for found in (joint.bias, matrix))
        return {
            "share": part / (self.step_bias * total) if self.step_bias and total > 0.0 else 0.0,
            "step_bias": self.step_bias,
            "blocks": dict(self.blocks),
        }
