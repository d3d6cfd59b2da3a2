"""Where paths go: every unit's part of the variance is what repetition shows, Neyman's allocation is met."""

from __future__ import annotations

import numpy as np
import pytest

from mitsuba_crb.information.accumulate import InformationAccumulator
from mitsuba_crb.information.allocation import Needs, allocate
from mitsuba_crb.information.block_variance import BlockProducts, BlockVariance

K = 4


def _needs(linear: np.ndarray, goal: np.ndarray, degenerate: np.ndarray | None = None) -> Needs:
    """Of cells of one pixel each, whose information is everywhere the same."""
    shape = linear.shape[1:]
    nothing = np.zeros_like(linear) if degenerate is None else degenerate
    return Needs(linear, nothing, np.zeros_like(linear), np.ones(shape, int), np.ones(shape), goal)


def _measured(rng: np.random.Generator, noise: np.ndarray, vectors: np.ndarray) -> BlockVariance:
    """The parts of two columns' information in 16 units of 4 x 4 pixels with noise of their own."""
    y, x = np.divmod(np.arange(256), 16)
    pixels = np.stack([x, y], axis=1)
    truth = np.random.default_rng(5).normal(size=(256, 1, 2))
    unit = y // 4 * 4 + x // 4
    values = truth + noise[unit][:, None, None] * rng.normal(size=(K, 256, 1, 2))
    kept = BlockProducts(K, 2)
    accumulator = InformationAccumulator(batches=K, columns=2, kept=kept)
    accumulator.add(values, np.ones((256, 1)), pixels)
    return kept.variance(vectors, np.full(len(vectors), 0.5))


@pytest.mark.slow
def test_parts_are_the_variances_of_repetitions() -> None:
    """With values = 1/2 a part is Var[bᵀ F̂_u b]; both of its components are unbiased, each by its own."""
    noise = np.linspace(0.2, 3.0, 16)
    vectors = np.array([[1.0, 0.0], [0.6, -0.8]])
    rng = np.random.default_rng(0)
    runs = [_measured(rng, noise, vectors) for _ in range(3000)]
    corner = runs[0].corner
    order = corner[:, 1] // 4 * 4 + corner[:, 0] // 4
    assert sorted(order) == list(range(16))
    effects = np.array([run.effect for run in runs])
    said = np.array([run.total for run in runs])
    error = said.std(axis=0) / np.sqrt(len(runs))
    spread = effects.var(axis=0, ddof=1)
    allowed = 4.5 * np.hypot(error, spread * np.sqrt(3.0 / len(runs)))
    assert (np.abs(said.mean(axis=0) - spread) < allowed).all()
    # Noise by noise alone: 16 pixels' products of two batches, 2/(K(K−1)) σ⁴ each.
    degenerate = np.mean([run.degenerate for run in runs], axis=0)
    np.testing.assert_allclose(degenerate[0], 16 * 2 / (K * (K - 1)) * noise[order] ** 4, rtol=0.1)
    # The control: without what is noise by noise the noisy units' would be far too small.
    assert (
        np.mean([run.linear for run in runs], axis=0)[:, order == 15] < 0.5 * spread[:, order == 15]
    ).all()


def test_one_direction_gets_neyman_s_allocation() -> None:
    variance = np.geomspace(1.0, 256.0, 64).reshape(1, 8, 8)
    needs = _needs(variance, np.array([1e-9]))
    spp = allocate(needs, 8, 64 * 1024)
    work = spp.sum()
    assert not (needs.variance(spp) <= needs.goal).all()
    assert 0.9 * 64 * 1024 < work <= 64 * 1024
    assert np.all(np.log2(spp / 8) % 1 == 0)
    ideal = np.sum(np.sqrt(variance)) ** 2 / work
    uniform = variance.sum() * 64 / work
    found = float(np.sum(variance[0] / spp))
    # Powers of two, and the fifth that all cells share, cost a few per cent of what the best would gain.
    assert ideal <= found < 1.1 * ideal
    assert found < 0.75 * uniform


def test_directions_reach_their_goals_together() -> None:
    """Each has its variance in cells of its own: with the same goal neither is left behind."""
    variance = np.ones((2, 8, 8))
    variance[0, 0] = np.geomspace(200.0, 400.0, 8)
    variance[1, 7] = np.geomspace(100.0, 800.0, 8)
    spp = allocate(_needs(variance, np.full(2, 1e-9)), 8, 64 * 512)
    both = np.sum(variance / spp, axis=(1, 2))
    assert both.max() < 1.4 * both.min()  # powers of two
    alone = allocate(_needs(variance[:1], np.full(1, 1e-9)), 8, 64 * 512)
    left = np.sum(variance / alone, axis=(1, 2))
    assert left[1] > 2.0 * both[1]  # what an allocation for the first alone does to the other


def test_it_spends_what_the_goal_takes_and_no_more() -> None:
    rng = np.random.default_rng(1)
    linear, degenerate = rng.exponential(size=(2, 3, 6, 9))
    needs = _needs(linear, np.array([0.02, 0.01, np.inf]), degenerate)
    spp = allocate(needs, 8, np.inf)
    assert (needs.variance(spp) <= needs.goal).all()
    reached = needs.variance(spp)[:2] / needs.goal[:2]
    assert 0.4 < reached.max() <= 0.65  # a margin of 0.8 in the error, in steps of powers of two
    few = allocate(needs, 8, 8 * 54)
    assert (few == 8).all()
    assert not (needs.variance(few) <= needs.goal).all()


def test_nothing_known_is_uniform() -> None:
    spp = allocate(_needs(np.zeros((2, 4, 4)), np.full(2, 1e-4)), 16, 1e9)
    assert (spp == 16).all()


@pytest.mark.parametrize("side", [8, 16])
def test_smoothing_keeps_what_there_is_in_all(side: int) -> None:
    rng = np.random.default_rng(2)
    corner = np.stack(np.meshgrid(np.arange(0, 96, 8), np.arange(0, 64, 8)), axis=-1).reshape(-1, 2)
    parts = rng.normal(1.0, 1.0, (2, len(corner)))
    found = BlockVariance(corner, parts, 0.1 * parts, np.zeros(2, bool), np.abs(parts))
    shape = (64 // side, 96 // side)
    pixels = np.full(shape, side * side)
    needs = Needs.of([(found, np.full(shape, 8))], side, pixels, np.ones(2))
    np.testing.assert_allclose(needs.linear.sum(axis=(1, 2)), 8 * parts.sum(axis=1))
    smooth = needs.smoothed()
    assert (smooth.linear >= 0.0).all()
    np.testing.assert_allclose(smooth.linear.sum(axis=(1, 2)), needs.linear.sum(axis=(1, 2)), rtol=0.1)


def _of_batches(rng: np.random.Generator, rare: float, batches: int) -> BlockVariance:
    """Of 60 units of 64 pixels whose Jacobians have, so rarely, errors a thousand times as large."""
    kept = BlockProducts(batches, 1)
    accumulator = InformationAccumulator(batches=batches, columns=1, block=8, kept=kept)
    y, x = np.divmod(np.arange(60 * 64), 80)
    noise = rng.normal(size=(batches, len(x), 1, 1))
    noise[rng.random(noise.shape) < rare] *= 1000.0
    accumulator.add(1.0 + noise, np.ones((len(x), 1)), np.stack([x, y], axis=1))
    return kept.variance(np.ones((1, 1)), np.ones(1))


@pytest.mark.parametrize("batches", [4, 8])
def test_a_rare_path_that_decides_alone_is_told_from_normal_errors(batches: int) -> None:
    rng = np.random.default_rng(8)
    assert not any(_of_batches(rng, 0.0, batches).rare for _ in range(200))
    # In 37 of 100 runs there is such a path, in 60 with twice the batches.
    assert np.mean([_of_batches(rng, 3e-5, batches).rare for _ in range(60)]) > 0.1
