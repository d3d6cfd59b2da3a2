"""Evenly spread points: SciPy's Sobol' points, plain polynomial division, and what is even about them."""

from __future__ import annotations

import itertools

import mitsuba as mi
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import qmc

from mitsuba_crb.render import sobol
from mitsuba_crb.render.sobol import sobol_point

mi.set_variant("llvm_ad_rgb")

BITS = (1, 1, 2, 3)
"""Of a digit of each coordinate."""


def _points(
    count: int, sequences: int, seed: int, *, ordered: bool = False, quarters: bool = False
) -> NDArray[np.float64]:
    """(sequences, count, 4), the first points of sequences of their own seeds; or of one order all."""
    chosen = np.random.default_rng(seed).integers(0, 1 << 32, (5, sequences), dtype=np.uint64)
    if ordered:
        chosen[0] = 0
    seeds = [mi.UInt32(np.repeat(row, count).astype(np.uint32)) for row in chosen]
    number = mi.UInt32(np.tile(np.arange(count, dtype=np.uint32), sequences))
    points = np.array(sobol_point(number, seeds, quarters=quarters), dtype=np.float64)
    return points.T.reshape(sequences, count, 4)


def _unscrambled(number: NDArray[np.uint32], dimensions: int) -> NDArray[np.float64]:
    zero = [mi.UInt32(np.zeros(len(number), np.uint32))] * (1 + dimensions)
    return np.array(sobol_point(mi.UInt32(number), zero), dtype=np.float64).T


def _are_even(points: NDArray[np.float64], bits: tuple[int, ...]) -> bool:
    """Whether every box of the 2^m points' volume, its sides whole digits wide, holds one of them."""
    m = len(points).bit_length() - 1
    sides = itertools.product(*(range(0, m + 1, b) for b in bits))
    boxes = [np.floor(points * 2.0 ** np.array(side)) for side in sides if sum(side) == m]
    return all(len(np.unique(box, axis=0)) == len(points) for box in boxes)


def test_unscrambled_the_first_two_coordinates_are_scipys(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same 2⁸ points, in whatever order."""
    monkeypatch.setattr(sobol, "_FACTORS", ())
    ours = _unscrambled(np.arange(256, dtype=np.uint32), 2)[:, ::-1]
    theirs = qmc.Sobol(2, scramble=False).random(256)
    assert sorted(map(tuple, ours)) == sorted(map(tuple, theirs))


def test_unscrambled_they_are_digits_by_polynomial_division(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 256 random 32-bit numbers, to the 24 bits of the points."""
    monkeypatch.setattr(sobol, "_FACTORS", ())
    numbers = np.random.default_rng(0).integers(0, 1 << 32, 256, dtype=np.uint64).astype(np.uint32)
    expected = np.zeros((256, 4))
    for row, number in enumerate(numbers):
        for column, (base, bits) in enumerate(zip((0b11, 0b10, 0b111, 0b1011), BITS, strict=True)):
            quotient, place = int(number), 1.0
            while quotient:
                rest, divided = quotient, 0
                while rest.bit_length() > bits:
                    shift = rest.bit_length() - bits - 1
                    rest, divided = rest ^ base << shift, divided | 1 << shift
                first = [rest >> bit & 1 for bit in range(bits)]
                for bit in [*first[1::-1], *first[2:]]:
                    place /= 2.0
                    expected[row, column] += bit * place
                quotient = divided
    assert _unscrambled(numbers, 4) == pytest.approx(expected, abs=2.0**-24)


@pytest.mark.parametrize("quarters", [False, True])
@pytest.mark.parametrize("m", [0, 1, 2, 3, 5, 6])
def test_points_that_follow_one_another_have_one_in_each_box(m: int, quarters: bool) -> None:
    """In the first two coordinates and in all four; the controls pair the same coordinates at random."""
    rng = np.random.default_rng(0)
    for points in _points(64, 8, 1, quarters=quarters):
        for part in points.reshape(-1, 1 << m, 4):
            assert _are_even(part[:, :2], BITS[:2])
            assert _are_even(part, BITS)
        if m > 2:
            mixed = np.column_stack([points[:, :3], rng.permutation(points[:, 3])]).reshape(-1, 1 << m, 4)
            assert not all(_are_even(part, BITS) for part in mixed)
            mixed = np.column_stack([points[:, 0], rng.permutation(points[:, 1])]).reshape(-1, 1 << m, 2)
            assert not all(_are_even(part, BITS[:2]) for part in mixed)


def test_four_points_are_one_in_each_quarter() -> None:
    """Of every pair of coordinates but the last two, whose digits begin alike."""
    halves = np.floor(2.0 * _points(64, 64, 1).reshape(-1, 4, 4))
    for a, b in itertools.combinations(range(4), 2):
        quarters = np.sort(2.0 * halves[..., a] + halves[..., b], axis=1)
        assert np.all(quarters == np.arange(4)) == ((a, b) != (2, 3))


def test_numbers_equal_modulo_4_lie_in_one_quarter_if_so_asked() -> None:
    """A random one from sequence to sequence; the control asks for nothing."""
    for quarters in (False, True):
        halves = np.floor(2.0 * _points(64, 256, 1, quarters=quarters)[..., :2]).reshape(256, 16, 4, 2)
        assert np.all(halves == halves[:, :1]) == quarters
    assert np.all(np.abs(halves.mean(axis=(0, 1)) - 0.5) < 5.0 * 0.5 / 16.0)


@pytest.mark.parametrize("quarters", [False, True])
def test_every_point_is_uniform(quarters: bool) -> None:
    """Each of 16 points over 4096 sequences, in 8 x 8 cells of each pair: χ² within 5 standard deviations."""
    points = _points(16, 4096, 2, quarters=quarters)
    for pair in itertools.combinations(range(4), 2):
        cell = (points[..., pair] * 8).astype(int) @ [8, 1]
        for k in range(16):
            counts = np.bincount(cell[:, k], minlength=64)
            chi2 = ((counts - 64.0) ** 2 / 64.0).sum()
            assert abs(chi2 - 63.0) < 5.0 * np.sqrt(2.0 * 63.0)


def test_means_are_unbiased_and_vary_less_than_those_of_independent_points() -> None:
    """Of x² y and sin⁴ πx sin² πy over 16 points, 4096 times, to 5 standard errors."""
    x, y, *_ = np.moveaxis(_points(16, 4096, 3), -1, 0)
    for values, mean, square, share in (
        (x * x * y, 1 / 6, 1 / 15, 0.05),
        (np.sin(np.pi * x) ** 4 * np.sin(np.pi * y) ** 2, 3 / 16, 105 / 1024, 0.2),
    ):
        means = values.mean(axis=1)
        assert means.mean() == pytest.approx(mean, abs=5.0 * means.std() / 64.0)
        assert means.var() < share * (square - mean**2) / 16


def test_what_depends_on_all_coordinates_varies_less_than_over_two_sequences() -> None:
    """Products of one of the first two and one of the others: less than half the variance."""
    one, other = (_points(64, 4096, seed) - 0.5 for seed in (4, 5))
    for a, b in itertools.product((0, 1), (2, 3)):
        together = (one[..., a] * one[..., b]).mean(axis=1)
        apart = (one[..., a] * other[..., b]).mean(axis=1)
        assert abs(together.mean()) < 5.0 * together.std() / 64.0
        assert together.var() < 0.5 * apart.var()


def test_two_uses_are_not_paired_in_order() -> None:
    """Products over two uses vary about as over independent points; paired in order, far more."""
    independent = 1.0 / 144.0 / 16
    for ordered, least, most in ((False, 0.3, 2.0), (True, 4.0, 16.0)):
        one, other = (_points(16, 4096, seed, ordered=ordered)[..., 0] - 0.5 for seed in (4, 5))
        assert least * independent < (one * other).mean(axis=1).var() < most * independent
