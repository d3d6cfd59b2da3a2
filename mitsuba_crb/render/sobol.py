"""Points of [0, 1)^d, d up to 4: each one uniform, and those that follow one another evenly spread.

The bits of i = Σ i_k 2^k are a polynomial i(x) over GF(2). Written in powers of a base b(x) of degree e, its
digits, e bits each, mirrored at the binary point make one coordinate: 2^m points from a multiple of 2^m on
then have one in each box of sides 2^(−e a) with Σ e a = m, by the Chinese remainder theorem. The bases are
x + 1 and x (Sobol's points, each box of 2^−a by 2^(a−m)), then x² + x + 1 and x³ + x + 1. In digits of
several bits the first two change places: else the leading bit would be i_0, as it is for x, and pairs not
even. Flipping each bit, or not, as chance and the bits above it decide (nested scrambling) keeps all this
and makes every point uniform: estimates are unbiased, and their variance falls faster than 1/n. The numbers i
are scrambled from the top as well: that keeps such points together but shuffles them, so that those of two
uses, of the same i but other seeds, are not paired in order.

Source: Sobol' 1967; Tezuka 1993, Polynomial arithmetic analogue of Halton sequences; Owen 1995; Burley 2020,
Practical Hash-based Owen Scrambling, JCGT 9(4).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr

if TYPE_CHECKING:
    import mitsuba as mi

_FACTORS = (0x6C50B47C, 0xB82F1E52)
"""Even: a bit must not decide about itself."""


def sobol_point(
    number: mi.UInt32, seeds: list[mi.UInt32], *, quarters: mi.Bool | bool = False
) -> list[mi.Float]:
    """The point of this number in the sequence that random seeds choose.

    Args:
        seeds: 32 random bits for the order, then as many for each coordinate, of which there are up to four.
        quarters: whether the order's last two bits are such that all numbers that are equal modulo 4 lie in
            one quarter of the first two coordinates, whichever. Only one of several uses may have that, and
            only if each sum takes whole groups of four: else sums would have whole quarters for others.
    """
    import mitsuba as mi

    order, *scrambles = seeds
    i = dr.brev(_scrambled(dr.brev(number), order))
    # The leading bits are i(1), the sum of all i_k, in the base x + 1, and i_0 in the base x.
    group = i & 0xFFFFFFFC
    last = (number & 1) | (((number >> 1) ^ dr.popcnt(group)) & 1) << 1
    i = dr.select(quarters, group | last, i)
    digits = (dr.brev(_scrambled(_digits(i, k), seed)) for k, seed in enumerate(scrambles))
    return [mi.Float(digit >> 8) * 2.0**-24 for digit in digits]


def _digits(i: mi.UInt32, coordinate: int) -> mi.UInt32:
    """Of i(x) in the base of a coordinate, the first digit's first bit lowest."""
    if coordinate == 1:
        return i
    degree = max(1, coordinate)
    i = _in_base(i, degree)
    if degree == 1:
        return i
    swap = (i ^ (i >> 1)) & _mask(1, degree)
    return i ^ swap ^ (swap << 1)


def _in_base(i: mi.UInt32, degree: int) -> mi.UInt32:
    """Digits of i(x) in powers of b = x + 1, x² + x + 1 or x³ + x + 1.

    Halving: b^s(x) = b(x^s) for s a power of two, so h x^(e s) + l = h b^s + h (x^s + 1) + l, without x^s if
    e = 1; what h x^s has beyond x^(e s) is divided once more.
    """
    for s in (16, 8, 4, 2, 1):
        half = degree * s
        if half >= 32:
            continue
        low = _mask(half, 2 * half)
        high = (i >> half) & low
        i = i ^ high
        if degree > 1:
            over = (high >> (half - s)) & _mask(s, 2 * half)
            i ^= ((high << s) & low) ^ over ^ (over << s) ^ (over << half)
    return i


def _mask(width: int, period: int) -> int:
    """32 bits, the lowest so many of each period set."""
    return sum(1 << bit for bit in range(32) if bit % period < width)


def _scrambled(bits: mi.UInt32, seed: mi.UInt32) -> mi.UInt32:
    """Each bit flipped, or not, as the seed and the lower bits decide: sums and products carry upwards."""
    import mitsuba as mi

    bits = bits + seed
    for factor in _FACTORS:
        bits ^= bits * mi.UInt32(factor)
    return bits
