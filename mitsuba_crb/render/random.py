"""Random numbers that belong to (seed, purpose, pixel, batch), whatever tile or subset a pixel is part of."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from ..information.blocks import BLOCK
from .rays import Lanes

if TYPE_CHECKING:
    import mitsuba as mi


PILOT, EVEN = 0x50494C4F, 0x4556454E
"""Purposes of the random numbers of pilot renders, and of what a block's pixels share; Jacobians use 0, but
for lanes that are told apart by something else than the batch."""


def derived_seed(seed: int, *purpose: int) -> int:
    """Another seed, below 2^64, of what is a run of its own under a user's."""
    return int(np.random.SeedSequence([seed, *purpose]).generate_state(1, np.uint64)[0])


@functools.cache
def _sampler_class() -> Any:
    """The sampler that gives every lane its own stream; made late, because `mi` needs a variant."""
    import mitsuba as mi

    class PixelSampler(mi.Sampler):  # type: ignore[misc]  # Mitsuba is untyped here
        """Independent random numbers from one PCG32 stream per lane."""

        def __init__(self, rng: mi.PCG32) -> None:
            super().__init__(mi.Properties())
            self.rng = rng

        def next_1d(self, active: mi.Bool = True) -> mi.Float:
            return self.rng.next_float32()

        def next_2d(self, active: mi.Bool = True) -> mi.Point2f:
            x = self.rng.next_float32()
            return mi.Point2f(x, self.rng.next_float32())

        def clone(self) -> PixelSampler:
            return PixelSampler(mi.PCG32(self.rng))

    return PixelSampler


def seeding(seed: int, purpose: int = 0) -> tuple[mi.UInt32, mi.UInt32]:
    """A seed and what the random numbers are for, as kernel input."""
    import mitsuba as mi

    key = dr.opaque(mi.UInt32, (seed ^ purpose) & 0xFFFFFFFF)
    return key, dr.opaque(mi.UInt32, (purpose + 0x9E3779B9 * ((seed >> 32) + 1)) & 0xFFFFFFFF)


def lane_sampler(pixel: mi.UInt32, batch: mi.UInt32, seeds: tuple[mi.UInt32, mi.UInt32]) -> mi.Sampler:
    """A sampler whose lane streams depend on (pixel, batch, seed, purpose) and on nothing else.

    Args:
        pixel: index of the lane's pixel in the whole image.
        batch: the lane's batch; a purpose under which it means something else must not be used for batches.
        seeds: seed and purpose, from `seeding`.
    """
    import mitsuba as mi

    key, salt = seeds
    state = mi.sample_tea_64(pixel, key)
    stream = mi.sample_tea_64(batch ^ salt, pixel)
    return _sampler_class()(mi.PCG32(1, state, stream))


def resumed(sampler: mi.Sampler, state: mi.UInt64) -> mi.Sampler:
    """A sampler from `lane_sampler` elsewhere in its streams.

    Loops carry the state alone: whatever they carry and leave unchanged makes Dr.Jit trace them twice.
    """
    import mitsuba as mi

    rng = mi.PCG32(sampler.rng)
    rng.state = mi.UInt64(state)
    return type(sampler)(rng)


@dataclass(frozen=True)
class EvenNumbers:
    """Random points of [0, 1)^d that the pixels of a film block share out evenly among them, batch by batch.

    The pixels' errors then cancel in the block's information, and first of all those of neighbours, whose
    points follow one another in the sequence: they stand in z-order (Ahmed and Wonka 2020). Every block and
    batch has seeds of its own, so that batches are independent.
    """

    rank: mi.UInt32
    """Of the lane's pixel in its block."""
    seeds: list[list[mi.UInt32]]
    """Of the sequence of each use."""

    @staticmethod
    def of(lanes: Lanes, seeds: tuple[mi.UInt32, mi.UInt32], dimensions: Sequence[int]) -> EvenNumbers:
        """For independent uses of so many coordinates each; `seeds` are for the purpose `EVEN`."""
        columns = (lanes.width + (BLOCK - 1)) // BLOCK
        block = lanes.row // BLOCK * columns + lanes.column // BLOCK
        sampler = lane_sampler(block, lanes.batch, seeds)
        x, y = lanes.column % BLOCK, lanes.row % BLOCK
        rank = x & 0
        for bit in range((BLOCK - 1).bit_length()):
            rank |= (x >> bit & 1) << 2 * bit | (y >> bit & 1) << 2 * bit + 1
        return EvenNumbers(rank, [sequence_seeds(sampler, d) for d in dimensions])


def sequence_seeds(sampler: mi.Sampler, dimensions: int) -> list[mi.UInt32]:
    """Of one Sobol' sequence of so many coordinates."""
    return [sampler.rng.next_uint32() for _ in range(1 + dimensions)]
