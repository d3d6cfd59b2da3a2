"""From how far away an alignment finds the truth, and how long it takes.

    python benchmarks/basin.py     # about 10 minutes on 2 cores; writes CSV and PNG into figures/

`textured_room` at 48x36 pixels, 32 paths per pixel, Gaussian noise of sigma 0.04 [radiance], a new noisy
image for each start. Gauss–Newton and Levenberg–Marquardt, on the image alone and after two images each
reduced by two (12x9 pixels the smallest), start

- within 2 degrees and 0.05 of the scene's depth, and within 5 degrees and 0.2: uniformly in both balls;
- up to twice the latter: at r times 5 degrees or 0.2 of the depth, whichever is reached first, r uniform.

A search has found the truth if it ends by itself and its error is one of those that the bound expects: ξᵀFξ
below the 99.99 % quantile of χ²_6, widened by `excess`. The camera stands 0.11 of the depth before a wall:
starts that are drawn behind it see nothing, are refused by `align` and counted apart. The time of one
alignment is the median of seven at 128x128 pixels from within 2 degrees and 0.05.
"""

from __future__ import annotations

import csv
import functools
import time
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy import stats

from mitsuba_crb import se3
from mitsuba_crb.errors import OutOfViewError
from mitsuba_crb.estimate.align import Alignment, align
from mitsuba_crb.estimate.misfit import Anchor
from mitsuba_crb.measure.measurement import measurement
from mitsuba_crb.noise import Gaussian
from mitsuba_crb.processes import in_processes
from mitsuba_crb.render.scene import load_scene

ROOT = Path(__file__).parents[1]
SCENE = ROOT / "scenes" / "textured_room" / "textured_room.xml"
FILE = ROOT / "benchmarks" / "figures" / "basin"
SIZE = (48, 36)
SPP = 32
NOISE = Gaussian(0.04)
LARGEST = float(stats.chi2.isf(1e-4, 6))
ITERATIONS = 20
"""On each level."""
NEAR, AIM = (2.0, 0.05), (5.0, 0.2)
"""Degrees and share of the depth."""
BALL_STARTS = 40
FAR_STARTS = 32
FARTHEST = 2.0
RINGS = np.linspace(0.0, FARTHEST, 5)
VARIANTS = {
    "Gauss–Newton": ("gauss_newton", 0, "#fdae6b"),
    "Levenberg–Marquardt": ("levenberg_marquardt", 0, "#92c5de"),
    "Gauss–Newton, 2 levels": ("gauss_newton", 2, "#e6550d"),
    "Levenberg–Marquardt, 2 levels": ("levenberg_marquardt", 2, "#2166ac"),
}
CLAIMED = {"near": "Gauss–Newton", "aim": "Gauss–Newton, 2 levels"}
"""The variant that is to reach from there."""
FIELDS = ("starts", "variant", "angle [deg]", "distance [depth]", "status", "iterations", "found")
LOST = "out of view"


@dataclass(frozen=True)
class Job:
    """Some searches of one variant."""

    starts: str
    variant: str
    indices: tuple[int, ...]


@functools.cache
def room() -> object:
    """The scene, loaded once in each process."""
    return load_scene(SCENE)


@functools.cache
def truth(size: tuple[int, int]) -> tuple[Anchor, float]:
    """The expected image at the scene's own pose, and the depth."""
    from mitsuba_crb.render.pixels import render_pixels

    with measurement(room(), size=size) as run:
        pixels = np.argwhere(run.mask)[:, ::-1]
        image = render_pixels(run.view, pixels, spp=1024, seed=77)
        return Anchor(run.view.pose, image.reshape(1, *run.mask.shape, 3)), run.length_scale


def start(starts: str, index: int) -> tuple[float, float]:
    """Angle [deg] and distance [depth] of a start."""
    rng = np.random.default_rng([1, index])
    if starts != "far":
        most = NEAR if starts == "near" else AIM
        radii = rng.uniform(size=2) ** (1.0 / 3.0)
        return most[0] * float(radii[0]), most[1] * float(radii[1])
    r = FARTHEST * (index + rng.uniform()) / FAR_STARTS
    shares = [r, r * float(rng.uniform())]
    rng.shuffle(shares)
    return AIM[0] * shares[0], AIM[1] * shares[1]


def search(
    angle: float, distance: float, index: int, variant: str, size: tuple[int, int]
) -> tuple[Alignment, bool]:
    """One alignment in a random direction, and whether it found the truth."""
    anchor, depth = truth(size)
    rng = np.random.default_rng([2, index])
    moved, turned = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    measured = anchor.batches[0] + NOISE.sigma * rng.standard_normal(anchor.batches[0].shape)
    estimator, levels, _ = VARIANTS[variant]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = align(
            room(),
            measured,
            NOISE,
            estimator=estimator,
            levels=levels,
            iterations=ITERATIONS,
            anchor=anchor,
            pose=anchor.pose
            @ se3.exp(np.concatenate([distance * depth * moved, np.radians(angle) * turned])),
            size=size,
            spp=SPP,
            seed=index,
        )
    error = se3.log(se3.inverse(anchor.pose) @ found.pose)
    nees = float(error @ found.bound.information.matrix @ error)
    return found, found.status == "converged" and nees < LARGEST * (1.0 + found.excess)


def work(job: Job) -> list[list[str]]:
    """Rows of the CSV."""
    rows = []
    for index in job.indices:
        angle, distance = start(job.starts, index)
        row = [job.starts, job.variant, f"{angle:.4f}", f"{distance:.5f}"]
        try:
            found, right = search(angle, distance, index, job.variant, SIZE)
            rows.append([*row, found.status, str(found.iterations), str(int(right))])
        except OutOfViewError:
            rows.append([*row, LOST, "0", "0"])
    return rows


def seconds() -> list[float]:
    """Times of alignments at 128x128, the first one, which compiles, left out."""
    times = []
    for index in range(8):
        angle, distance = start("near", index)
        truth((128, 128))
        before = time.perf_counter()
        search(angle, distance, index, "Gauss–Newton", (128, 128))
        times.append(time.perf_counter() - before)
    return times[1:]


def rate(rows: list[list[str]]) -> tuple[int, int, float, float, float]:
    """Found, tried, rate, and its 95 % Wilson interval; starts out of view left out."""
    tried = [row for row in rows if row[4] != LOST]
    found = sum(row[6] == "1" for row in tried)
    if not tried:
        return 0, 0, np.nan, np.nan, np.nan
    interval = stats.binomtest(found, len(tried)).proportion_ci(0.95, method="wilson")
    return found, len(tried), found / len(tried), float(interval.low), float(interval.high)


def draw(rows: list[list[str]]) -> Figure:
    """Where each variant's far starts ended; rates against r."""
    figure = Figure(figsize=(13.5, 7.0), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 3, width_ratios=[1.0, 1.0, 1.3])
    curves = figure.add_subplot(grid[:, 2])
    for k, (variant, (_, _, colour)) in enumerate(VARIANTS.items()):
        far = [row for row in rows if row[:2] == ["far", variant] and row[4] != LOST]
        angle, distance = (np.array([float(row[c]) for row in far]) for c in (2, 3))
        right = np.array([row[6] == "1" for row in far])
        ax = figure.add_subplot(grid[k // 2, k % 2])
        ax.scatter(
            angle[right], distance[right], s=34, color=colour, edgecolor="black", lw=0.5, label="found"
        )
        ax.scatter(angle[~right], distance[~right], s=26, color="#606060", marker="x", lw=1, label="lost")
        for most in (NEAR, AIM):
            ax.add_patch(_box(most))
        ax.set(xlabel="rotation of the start [deg]", ylabel="translation [scene depth]", title=variant)
        if k == 0:
            ax.legend(fontsize=8, loc="upper right")
        radius = np.maximum(angle / AIM[0], distance / AIM[1])
        ring = np.digitize(radius, RINGS)
        parts = [[row for row, at in zip(far, ring, strict=True) if at == n] for n in range(1, len(RINGS))]
        rates = np.array([rate(part)[2:] for part in parts])
        curves.errorbar(
            0.5 * (RINGS[1:] + RINGS[:-1]) + 0.02 * (k - 1.5),
            rates[:, 0],
            yerr=np.abs(rates[:, 1:] - rates[:, :1]).T,
            fmt="o-",
            capsize=3,
            color=colour,
            label=variant,
        )
    curves.set(
        xlabel="r: start at most r × (5°, 0.2 depth)", ylabel="share that finds the truth", ylim=(-0.03, 1.03)
    )
    curves.set_title("by distance, 95 % Wilson intervals")
    curves.grid(alpha=0.25)
    curves.legend(fontsize=9, frameon=False)
    return figure


def _box(most: tuple[float, float]) -> object:
    from matplotlib.patches import Rectangle

    return Rectangle((0, 0), *most, fill=False, ls="--", lw=0.9, ec="black")


def main() -> None:
    """All searches, in two processes; the time of one, alone; CSV and figure."""
    counts = {"near": BALL_STARTS, "aim": BALL_STARTS, "far": FAR_STARTS}
    jobs = [
        Job(starts, variant, tuple(range(first, min(first + 8, count))))
        for starts, count in counts.items()
        for variant in VARIANTS
        for first in range(0, count, 8)
        if starts == "far" or variant == CLAIMED[starts]
    ]
    done: dict[int, list[list[str]]] = {}
    for index, rows in in_processes(work, jobs, 2):
        done[index] = rows
        print(f"{len(done)}/{len(jobs)} {jobs[index].starts} {jobs[index].variant}", flush=True)
    rows = [row for index in sorted(done) for row in done[index]]
    with FILE.with_suffix(".csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(FIELDS)
        writer.writerows(rows)
    draw(rows).savefig(FILE.with_suffix(".png"), dpi=80)
    for starts in counts:
        for variant in VARIANTS:
            these = [row for row in rows if row[:2] == [starts, variant]]
            if these:
                found, tried, share, low, high = rate(these)
                print(
                    f"{starts:<6}{variant:<32}{found:>4} of {tried:<4}{share:7.3f}  95 % {low:.3f} to "
                    f"{high:.3f}   out of view {len(these) - tried}"
                )
    times = seconds()
    print(f"128x128: median {np.median(times):.2f} s, {min(times):.2f} to {max(times):.2f}")


if __name__ == "__main__":
    main()
