"""Lazy greedy beside plain greedy and beside apricot's lazy greedy: 1,000 agents x 256 tiles, 2,000 sent.

    python benchmarks/selection.py            # about two minutes on 2 cores
    python benchmarks/selection.py --quick    # 100 agents, 200 tiles sent

First table: log det of dense 6 x 6 blocks. Plain greedy evaluates every tile in every round: a few rounds are
timed and checked to send the same tile, its total is extrapolated, its evaluations follow from n and k.

Second table, if `apricot-select` is installed (only this benchmark needs it; its lazy greedy also imports
scikit-learn): the same n and k with diagonal blocks, for which log det is apricot's feature-based function
Σ_d log(1 + Σ_i x_id). Both maximise the same function, so the gains must agree. numba compiles apricot's
kernels beforehand; its evaluations are counted by wrapping its gain function in a run of its own.
"""

from __future__ import annotations

import argparse
import os
import time

import numpy as np

from mitsuba_crb.agents.greedy import greedy
from mitsuba_crb.agents.relaxation import upper_bound
from mitsuba_crb.agents.tiles import Limits, Problem
from mitsuba_crb.bound.criteria import LogDet

TILES = 256
SAMPLED_ROUNDS = 5


def problem_of(blocks: np.ndarray, budget: int) -> Problem:
    """Tiles in total are limited, nothing else."""
    agents = len(blocks) // TILES
    unlimited = np.full(agents, np.inf)
    limits = Limits(unlimited, unlimited, float(budget), np.inf)
    return Problem(
        np.eye(6), blocks, np.repeat(np.arange(agents), TILES), np.full(len(blocks), 200.0), limits
    )


def dense_blocks(rng: np.random.Generator, agents: int) -> np.ndarray:
    """Every agent sees some directions better than others, every tile with its own strength."""
    blocks = []
    for _ in range(agents):
        directions = rng.normal(size=(6, 6)) * np.exp(rng.normal(size=6))
        J = rng.normal(size=(TILES, 8, 6)) * rng.lognormal(0.0, 1.0, (TILES, 1, 1)) @ directions
        blocks.append(J.swapaxes(1, 2) @ J)
    return np.concatenate(blocks)


def sampled_plain_seconds(problem: Problem, chosen: tuple[int, ...]) -> float:
    """Seconds of all rounds of plain greedy, from a few rounds spread over the run."""
    rounds = np.linspace(0, len(chosen) - 1, SAMPLED_ROUNDS).astype(int)
    seconds = []
    for sent in rounds:
        M = problem.information(chosen[:sent])
        left = np.delete(np.arange(len(problem)), chosen[:sent])
        start = time.perf_counter()
        best = left[np.argmax(LogDet().gains(M, problem.blocks[left]))]
        seconds.append(time.perf_counter() - start)
        if best != chosen[sent]:
            raise SystemExit(f"plain greedy sends tile {best} in round {sent}, lazy greedy {chosen[sent]}")
    return float(np.mean(seconds)) * len(chosen)


def beside_plain(blocks: np.ndarray, budget: int) -> None:
    """Print evaluations and seconds of lazy and plain greedy, and the certificate."""
    problem = problem_of(blocks, budget)
    start = time.perf_counter()
    lazy = greedy(problem, LogDet())
    lazy_seconds = time.perf_counter() - start
    plain_evaluations = sum(len(problem) - sent for sent in range(budget))
    plain_seconds = sampled_plain_seconds(problem, lazy.tiles)
    value = float(LogDet().value(problem.information(lazy.tiles)))
    start = time.perf_counter()
    bound = upper_bound(problem, LogDet(), value)
    bound_seconds = time.perf_counter() - start
    print(f"dense blocks, {len(problem)} tiles, {budget} sent")
    print(f"  {'':<14}{'evaluations':>14}{'seconds':>10}")
    print(f"  {'lazy greedy':<14}{lazy.evaluations:>14,}{lazy_seconds:>10.2f}")
    print(f"  {'plain greedy':<14}{plain_evaluations:>14,}{plain_seconds:>10.0f}  (sampled, the same tiles)")
    print(
        f"  {'ratio':<14}{plain_evaluations / lazy.evaluations:>14.0f}{plain_seconds / lazy_seconds:>10.0f}"
    )
    print(f"  gain {value:.4f}, upper bound {bound:.4f} in {bound_seconds:.1f} s, ratio {value / bound:.4f}")


def beside_apricot(rng: np.random.Generator, agents: int, budget: int) -> None:
    """Print evaluations and seconds of both lazy greedy algorithms for the same function."""
    try:
        import apricot
    except ImportError as error:
        print(
            f"apricot is not installed ({error}); pip install apricot-select scikit-learn for the comparison"
        )
        return
    features = rng.exponential(size=(agents * TILES, 6)) * rng.lognormal(0.0, 1.0, (agents * TILES, 1))

    def selector(n: int) -> apricot.FeatureBasedSelection:
        return apricot.FeatureBasedSelection(n, concave_func="log", optimizer="lazy")

    selector(2).fit(features[:100])  # compiles
    theirs = selector(budget)
    start = time.perf_counter()
    theirs.fit(features)
    their_seconds = time.perf_counter() - start

    counted = selector(budget)
    gains, count = counted._calculate_gains, 0

    def counting(X: np.ndarray, idxs: np.ndarray | None = None) -> np.ndarray:
        nonlocal count
        count += len(counted.idxs if idxs is None else idxs)
        return np.asarray(gains(X, idxs))

    counted._calculate_gains = counting
    counted.fit(features)

    blocks = features[:, :, None] * np.eye(6)
    start = time.perf_counter()
    ours = greedy(problem_of(blocks, budget), LogDet())
    our_seconds = time.perf_counter() - start
    our_gain = float(np.log1p(features[list(ours.tiles)].sum(axis=0)).sum())
    their_gain = float(np.log1p(features[theirs.ranking].sum(axis=0)).sum())
    print(f"diagonal blocks, {len(features)} tiles, {budget} sent, one function")
    print(f"  {'':<14}{'evaluations':>14}{'seconds':>10}{'gain':>14}")
    print(f"  {'mitsuba_crb':<14}{ours.evaluations:>14,}{our_seconds:>10.2f}{our_gain:>14.8f}")
    print(f"  {'apricot':<14}{count:>14,}{their_seconds:>10.2f}{their_gain:>14.8f}")


def main() -> None:
    """Run both comparisons."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true")
    agents, budget = (100, 200) if parser.parse_args().quick else (1000, 2000)
    rng = np.random.default_rng(0)
    print(f"load before {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    beside_plain(dense_blocks(rng, agents), budget)
    beside_apricot(rng, agents, budget)
    print(f"load after {os.getloadavg()[0]:.1f}")


if __name__ == "__main__":
    main()
