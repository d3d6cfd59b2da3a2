"""What Russian roulette that spares more paths than `path` does is worth to the information.

    python benchmarks/variance.py     # about four minutes on 2 quiet cores; writes variance.md

Rooms without a limit of depth, by flow, under Gaussian noise of 1 % of white, what exceeds white left out.
For each `SPARING` (1 is `path`'s), over seeds: the noise Σ Var(J)/σ² of the six columns, and the empirical
variance of F's diagonal over F², both as geometric means and relative to those of 1, and the CPU time of a
measurement, the least of the seeds. F's variance grows as the noise where it is small, and as its square
where it is not. So few seeds give the ratio of two variances to 60 %, that of the noise to a few percent.
"""

from __future__ import annotations

import time
import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mitsuba_crb.jacobian.method import Paths, estimates
from mitsuba_crb.measure.measurement import measurement
from mitsuba_crb.render import paths
from mitsuba_crb.render.pixels import render_pixels

ROOT = Path(__file__).parents[1]
OTHERS = ROOT.parent / "shared" / "data" / "mitsuba"
SCENES = {
    "textured_room": (ROOT / "scenes" / "textured_room" / "textured_room.xml", (96, 72)),
    "cornell-box": (OTHERS / "cornell-box" / "scene_m39.xml", (80, 80)),
    "cornell-picture": (OTHERS / "cornell-picture" / "scene_picture.xml", (80, 80)),
    "sponza": (OTHERS / "sponza" / "scene_m39.xml", (80, 80)),
    "staircase2": (OTHERS / "staircase2" / "scene.xml", (80, 80)),
}
SPARING = (1.0, 4.0)
SPP, BATCHES, SEEDS = 32, 4, 12


def measure(path: Path, size: tuple[int, int]) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Noise and relative variance of the six columns, and CPU seconds."""
    noise, found, seconds = [], [], []
    with measurement(path, size=size, integrator={"type": "path"}) as run:
        pixels = np.argwhere(run.mask)[:, ::-1].copy()
        image = render_pixels(run.view, pixels, spp=256, seed=99)[0]
        white = run.exposure.white
        weights = np.sqrt(image < white) / (0.01 * white)
        for seed in range(-1, SEEDS):
            start = time.process_time()
            method = type(run.method).open(run.view, run.mask, seed + 1, step_pixels=None)
            columns = estimates(method, pixels, Paths(SPP, seed + 1, BATCHES)).columns
            seconds.append(time.process_time() - start)
            if seed < 0:  # kernels are compiled
                continue
            columns = columns * weights[..., None]
            total = np.sum(columns.sum(axis=0) ** 2, axis=(0, 1))
            own = np.sum(columns**2, axis=(0, 1, 2))
            found.append((total - own) / (BATCHES * (BATCHES - 1)))
            noise.append(columns.var(axis=0, ddof=1).sum(axis=(0, 1)))
    mean = np.mean(found, axis=0)
    return np.mean(noise, axis=0), np.var(found, axis=0, ddof=1) / mean**2, min(seconds[1:])


def main() -> None:
    """Write the table."""
    warnings.simplefilter("ignore")
    lines = [
        "# Russian roulette that spares more",
        "",
        f"By `benchmarks/variance.py`: {SPP} paths per pixel, {BATCHES} batches, {SEEDS} seeds; noise and",
        "variance relative to `path`'s roulette (sparing 1), geometric means of the six directions. The",
        "ratio of two variances is known to 60 %, that of the noise to a few percent.",
        "",
        "| scene | sparing | noise of J | variance of F | CPU [s] |",
        "|---|---|---|---|---|",
    ]
    for name, (path, size) in SCENES.items():
        if not path.exists():
            continue
        usual: list[NDArray[np.float64]] = []
        for sparing in SPARING:
            paths.SPARING = sparing
            *found, seconds = measure(path, size)
            usual = usual or found
            noise, variance = (np.exp(np.mean(np.log(a / b))) for a, b in zip(found, usual, strict=True))
            lines.append(f"| {name} | {sparing:g} | {noise:.2f} | {variance:.2f} | {seconds:.2f} |")
            print(lines[-1], flush=True)
    (ROOT / "benchmarks" / "variance.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
