"""How many paths which block of the film should get, for standard deviations of a relative precision.

A block's part of σ_i's relative variance is l_bi r + d_bi r², r its paths in the round that measured it over
those to come (`block_variance`). For weights μ_i over the directions, the least Σ_b c_b n_b at a given
Σ_i μ_i Σ_b v_bi / n_b has n_b ∝ (Σ_i μ_i v_bi / c_b)^½ (Neyman 1934), c_b the cost of a path; μ is such that
the directions reach their goals together (multiplicative weights; Arora, Hazan and Kale 2012). The parts are
estimates with heavy tails: few paths have not met what decides. So they are smoothed over neighbouring
blocks, a share of each is taken to be as the block's information, and a share of the paths goes to all blocks
alike; all in powers of two of the least number. An allocation is never wrong, only more or less good, and
independent of the random numbers that come after it.

Source: Neyman, "On the two different aspects of the representative method", 1934; design section 11.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ..se3 import Array
from .block_variance import BlockVariance

UNIFORM = 0.2
"""Share of the paths that goes to all blocks alike."""
INFORMED = 0.25
"""Share of the relative variances that is taken to be as the blocks' information."""

_SMOOTH = 0.7  # blocks
_MARGIN = 0.8
"""Of the precision asked for, what is aimed at: the parts are estimates."""
_TURNS = 12
_STEP = 1.02
_FINEST = 1 << 14  # times the least paths
_TINY = 1e-30
_KEPT = 0.1
"""Least of the parts' positive halves that are kept, where noise makes their sum negative."""


@dataclass(frozen=True, eq=False)
class Needs:
    """What is known of some cells of the film, and what is wanted."""

    linear: Array
    """(m, rows, columns) parts of relative variances at one path per pixel, of what goes with 1/n."""
    degenerate: Array
    """(m, rows, columns) likewise, of what goes with 1/n²."""
    effect: Array
    """(m, rows, columns) of their information on the standard deviations."""
    pixels: NDArray[np.int64]
    """(rows, columns) how many pixels are measured there."""
    cost: Array
    """(rows, columns) of a pixel's path."""
    goal: Array
    """(m,) relative variances that are wanted."""

    @staticmethod
    def of(
        rounds: Sequence[tuple[BlockVariance, NDArray[np.int64]]],
        side: int,
        pixels: NDArray[np.int64],
        goal: Array,
    ) -> Needs:
        """What some rounds have shown, each weighed by its paths.

        Args:
            rounds: what each found, by how many paths per pixel (rows, columns).
            side: of the cells [pixel].
            pixels: (rows, columns) how many of a cell's are measured.
            goal: (m,) relative variances that are wanted.
        """
        total = np.zeros((3, len(goal), *pixels.shape))
        for found, spp in rounds:
            cell = found.corner[:, 1] // side * pixels.shape[1] + found.corner[:, 0] // side
            for power, part in enumerate((found.effect, found.linear, found.degenerate)):
                sums = np.array([np.bincount(cell, row, pixels.size) for row in part])
                total[power] += sums.reshape(total.shape[1:]) * spp.astype(float) ** (power + 1)
        effect, linear, degenerate = total / sum(spp for _, spp in rounds)
        return Needs(linear, degenerate, effect, pixels, np.ones(pixels.shape), goal)

    def smoothed(self) -> Needs:
        """With the parts shared out among neighbours, none of them negative."""
        held = (self.pixels > 0).astype(np.float64)
        weight = ndimage.gaussian_filter(held, _SMOOTH, mode="constant")

        def smooth(parts: Array) -> Array:
            spread = ndimage.gaussian_filter(parts, (0.0, _SMOOTH, _SMOOTH), mode="constant")
            mean = np.divide(spread, weight, out=np.zeros_like(parts), where=weight > 0.0) * held
            positive = np.maximum(mean, 0.0)
            # What the sum over all blocks says is more certain than what was cut off.
            total, whole = (part.sum(axis=(1, 2), keepdims=True) for part in (mean, positive))
            ratio = np.divide(total, whole, out=np.zeros_like(total), where=whole > 0.0)
            return np.asarray(positive * np.clip(ratio, _KEPT, 1.0))

        return replace(
            self,
            linear=smooth(self.linear),
            degenerate=smooth(self.degenerate),
            effect=smooth(np.abs(self.effect)),
        )

    def variance(self, spp: NDArray[np.int64]) -> Array:
        """(m,) relative variances that are to be expected of so many paths (rows, columns)."""
        n = spp.astype(np.float64)
        return np.asarray((self.linear / n + self.degenerate / n**2).sum(axis=(1, 2)))


def allocate(needs: Needs, least: int, most: float) -> NDArray[np.int64]:
    """Paths per pixel of each cell, (rows, columns), to reach the goal or to spend what may be spent.

    Args:
        needs: of each cell, `smoothed`.
        least: paths per pixel of every cell; some get this times a power of two.
        most: Σ pixels · cost · paths that may be spent.
    """
    work = needs.pixels * needs.cost
    weights = 1.0 / np.maximum(needs.goal, _TINY)
    aim = _MARGIN**2 * needs.goal
    spp = np.full(needs.pixels.shape, least, dtype=np.int64)
    found: list[tuple[float, float, NDArray[np.int64]]] = []
    for _ in range(_TURNS):
        density = _density(needs, weights, spp)

        def reaches(scale: float, density: Array = density) -> bool:
            return bool((needs.variance(_rounded(scale * density, least)) <= aim).all())

        def dear(scale: float, density: Array = density) -> bool:
            return bool(np.sum(work * _rounded(scale * density, least)) > most)

        largest = least * _FINEST / float(density.max())
        scale = _threshold(reaches, largest)
        if dear(scale):
            scale = _threshold(dear, largest) / _STEP
        spp = _rounded(scale * density, least)
        reached = needs.variance(spp) / np.maximum(aim, _TINY)
        found.append((max(float(reached.max()), 1.0), float(np.sum(work * spp)), spp))
        weights *= np.clip(reached / max(float(reached.max()), _TINY), 0.05, 1.0) ** 0.5
    return min(found, key=lambda each: each[:2])[2]


def _density(needs: Needs, weights: Array, spp: NDArray[np.int64]) -> Array:
    """(rows, columns) paths per pixel, 1 on average, at which all blocks gain alike by one more."""
    own = needs.linear + 2.0 * needs.degenerate / spp
    sums = own.sum(axis=(1, 2)) / np.maximum(needs.effect.sum(axis=(1, 2)), _TINY)
    parts = np.einsum("m,mij->ij", (1.0 - INFORMED) * weights, own)
    parts += np.einsum("m,mij->ij", INFORMED * weights * sums, needs.effect)
    work = needs.pixels * needs.cost
    wanted = np.sqrt(np.divide(parts, work, out=np.zeros_like(parts), where=work > 0.0))
    mean = np.sum(wanted * work) / np.sum(work)
    if not mean > 0.0:
        return np.ones_like(wanted)
    return np.asarray(UNIFORM + (1.0 - UNIFORM) * wanted / mean)


def _rounded(spp: Array, least: int) -> NDArray[np.int64]:
    """To the nearest power of two times `least`."""
    power = np.round(np.log2(np.maximum(spp / least, 1.0)))
    return least << np.minimum(power, np.log2(_FINEST)).astype(np.int64)


def _threshold(passed: Callable[[float], bool], largest: float) -> float:
    """The least scale, to a step, that something is true of; the largest if it is true of none."""
    low, high = np.log2(largest) - 40.0, np.log2(largest)
    while high - low > np.log2(_STEP):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if passed(2.0**middle) else (middle, high)
    return float(2.0**high)
