"""Sobol' points: SciPy's own, scrambled, and what is even about them."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import qmc

from mitsuba_crb.jacobian import sobol
from mitsuba_crb.jacobian.sobol import SEEDS, sobol_point

mi.set_variant("llvm_ad_rgb")


def _points(count: int, sequences: int, seed: int, *, ordered: bool = False) -> NDArray[np.float64]:
    """(sequences, count, 2), the first points of sequences of their own seeds; or of one order all."""
    chosen = np.random.default_rng(seed).integers(0, 1 << 32, (SEEDS, sequences), dtype=np.uint64)
    if ordered:
        chosen[0] = 0
    seeds = [mi.UInt32(np.repeat(row, count).astype(np.uint32)) for row in chosen]
    number = mi.UInt32(np.tile(np.arange(count, dtype=np.uint32), sequences))
    return np.array(sobol_point(number, seeds), dtype=np.float64).T.reshape(sequences, count, 2)


def _is_net(points: NDArray[np.float64]) -> bool:
    """Whether every box of 2^−a by 2^(a−m) holds one of the 2^m points."""
    m = len(points).bit_length() - 1
    boxes = [(points * [1 << a, 1 << m - a]).astype(int) @ [1 << m - a, 1] for a in range(m + 1)]
    return all(len(np.unique(box)) == len(points) for box in boxes)


def test_unscrambled_they_are_scipys(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same 2⁸ points, in whatever order."""
    monkeypatch.setattr(sobol, "_FACTORS", ())
    zero = [mi.UInt32(np.zeros(256, np.uint32))] * SEEDS
    ours = np.array(sobol_point(mi.UInt32(np.arange(256, dtype=np.uint32)), zero), dtype=np.float64).T
    theirs = qmc.Sobol(2, scramble=False).random(256)
    assert sorted(map(tuple, ours)) == sorted(map(tuple, theirs))


@pytest.mark.parametrize("m", [0, 1, 2, 3, 5])
def test_points_that_follow_one_another_have_one_in_each_box(m: int) -> None:
    """Of all elementary boxes; the control pairs the same coordinates at random."""
    for points in _points(64, 8, 1):
        assert all(map(_is_net, points.reshape(-1, 1 << m, 2)))
    rng = np.random.default_rng(0)
    if m > 2:
        mixed = np.stack([points[:, 0], rng.permutation(points[:, 1])], axis=1)
        assert not all(map(_is_net, mixed.reshape(-1, 1 << m, 2)))


def test_every_point_is_uniform() -> None:
    """Each of 16 points over 4096 sequences, in 8 x 8 cells: χ² within 5 standard deviations."""
    points = _points(16, 4096, 2)
    cell = (points * 8).astype(int) @ [8, 1]
    for k in range(16):
        counts = np.bincount(cell[:, k], minlength=64)
        chi2 = ((counts - 64.0) ** 2 / 64.0).sum()
        assert abs(chi2 - 63.0) < 5.0 * np.sqrt(2.0 * 63.0)


def test_means_are_unbiased_and_vary_less_than_those_of_independent_points() -> None:
    """Of x² y and sin⁴ πx sin² πy over 16 points, 4096 times, to 5 standard errors."""
    x, y = np.moveaxis(_points(16, 4096, 3), -1, 0)
    for values, mean, square, share in (
        (x * x * y, 1 / 6, 1 / 15, 0.05),
        (np.sin(np.pi * x) ** 4 * np.sin(np.pi * y) ** 2, 3 / 16, 105 / 1024, 0.2),
    ):
        means = values.mean(axis=1)
        assert means.mean() == pytest.approx(mean, abs=5.0 * means.std() / 64.0)
        assert means.var() < share * (square - mean**2) / 16


def test_two_uses_are_not_paired_in_order() -> None:
    """Products over two uses vary about as over independent points; paired in order, far more."""
    independent = 1.0 / 144.0 / 16
    for ordered, least, most in ((False, 0.3, 2.0), (True, 4.0, 16.0)):
        one, other = (_points(16, 4096, seed, ordered=ordered)[..., 0] - 0.5 for seed in (4, 5))
        assert least * independent < (one * other).mean(axis=1).var() < most * independent
