"""Sobol' points: each one uniform in [0, 1)², and those that follow one another evenly spread.

The first coordinate of point i = Σ i_k 2^k mirrors its bits at the binary point, Σ i_k 2^(−k−1). The second
mirrors j = Σ i_k P_k, P_k row k of Pascal's triangle modulo 2: as a polynomial over GF(2) row k is (x + 1)^k,
hence j(x) = i(x + 1), five exclusive ors. Then the 2^m points from a multiple of 2^m on have one in each box
of 2^−a by 2^(a−m). Flipping each digit, or not, as chance and the digits above it decide (nested scrambling)
keeps that and makes every point uniform: estimates are unbiased, and their variance falls faster than 1/n.
The numbers i are scrambled from the top as well: that keeps such points together but shuffles them, so that
those of two uses, of the same i but other seeds, are not paired in order.

Source: Sobol' 1967; Owen 1995; Burley 2020, Practical Hash-based Owen Scrambling, JCGT 9(4).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr

if TYPE_CHECKING:
    import mitsuba as mi

SEEDS = 3
"""32-bit random numbers that choose a sequence: its order, and what scrambles either coordinate."""
_FOLDS = ((16, 0x0000FFFF), (8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555))
_FACTORS = (0x6C50B47C, 0xB82F1E52)
"""Even: a bit must not decide about itself."""


def sobol_point(number: mi.UInt32, seeds: list[mi.UInt32]) -> mi.Point2f:
    """The point of this number in the sequence that `SEEDS` random seeds choose."""
    import mitsuba as mi

    i = dr.brev(_scrambled(dr.brev(number), seeds[0]))
    j = mi.UInt32(i)
    for distance, mask in _FOLDS:
        j ^= (j >> distance) & mi.UInt32(mask)
    digits = (dr.brev(_scrambled(bits, seed)) for bits, seed in zip((i, j), seeds[1:], strict=True))
    return mi.Point2f(*(mi.Float(digit >> 8) * 2.0**-24 for digit in digits))


def _scrambled(bits: mi.UInt32, seed: mi.UInt32) -> mi.UInt32:
    """Each bit flipped, or not, as the seed and the lower bits decide: sums and products carry upwards."""
    import mitsuba as mi

    bits = bits + seed
    for factor in _FACTORS:
        bits ^= bits * mi.UInt32(factor)
    return bits
