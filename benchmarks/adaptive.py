"""Sampling to a precision beside uniform sampling.

    python benchmarks/adaptive.py                       # all parts
    python benchmarks/adaptive.py --only gains times    # some of: gains times price verdicts figure
    python benchmarks/adaptive.py --only gains --scenes textured_room --seeds 10

gains: at 160x120 the variance of ln σ over seeds, uniform over adaptive, at equal paths in all (of every
round), worst and best of the directions that every run resolves. times: seconds until the default
answers, each scene at its own size, the error that it states, and what it says of the six. price: the default
over --spp 64, textured_wall at 512x512, alternating. verdicts: at 64x48 and 4, 16, 64 and 256 paths per
pixel, how large what is called unseen is in a run of 4,096 paths (its information over the largest
eigenvalue: 1e-3 is the most), and how many lower limits exceed that run's standard deviations. figure: where
the paths went in a room, error against time, into figures/adaptive.png.

Tables go to adaptive.csv. Scenes by others are read from ../shared/data/mitsuba, where that is.
"""

from __future__ import annotations

import argparse
import csv
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from mitsuba_crb import pose_bound
from mitsuba_crb.errors import MitsubaCRBError
from mitsuba_crb.measure.adaptive import Rounds
from mitsuba_crb.measure.measurement import measurement

ROOT = Path(__file__).parents[1]
OTHERS = ROOT.parent / "shared" / "data" / "mitsuba"
FILE = Path(__file__).with_suffix(".csv")
FIGURE = Path(__file__).parent / "figures" / "adaptive.png"
PARTS = ("gains", "times", "price", "verdicts", "figure")

SMALL = (160, 120)
GAINS = {
    "textured_room": ROOT / "scenes" / "textured_room" / "textured_room.xml",
    "staircase2": OTHERS / "staircase2" / "scene.xml",
    "sponza": OTHERS / "sponza" / "scene_m39.xml",
    "matpreview": OTHERS / "matpreview" / "matpreview.xml",
    "cornell-picture": OTHERS / "cornell-picture" / "scene_picture.xml",
}
REAL = (
    "cbox/cbox.xml",
    "cornell-box/scene_m39.xml",
    "cornell-picture/scene_picture.xml",
    "matpreview/matpreview.xml",
    "sponza/scene_m39.xml",
    "staircase2/scene.xml",
)


def deviations(bound: Any) -> np.ndarray:
    """(6,) position [scene unit] and rotation [deg]."""
    return np.concatenate([bound.position_std, bound.rotation_std_deg])


def paths(bound: Any) -> float:
    """Per pixel, of all rounds."""
    width, height = bound.provenance["size"]
    sampling = bound.provenance.get("sampling")
    return float(sampling["paths"] / (width * height) if sampling else bound.provenance["spp"])


def gains(name: str, seeds: int, precision: float) -> dict[str, Any]:
    """The ratio of variances over seeds."""
    scene = GAINS[name]
    with measurement(scene, size=SMALL) as run:  # one exposure for all, as for the views of one run
        options: dict[str, Any] = {"size": SMALL, "exposure": run.exposure.white}
    adaptive = [pose_bound(scene, precision=precision, seed=seed, **options) for seed in range(seeds)]
    spent = float(np.mean([paths(bound) for bound in adaptive]))
    spp = max(8, 8 * round(spent / 8))
    uniform = [pose_bound(scene, spp=spp, seed=1000 + seed, **options) for seed in range(seeds)]
    logs = [np.log([deviations(bound) for bound in side]) for side in (uniform, adaptive)]
    resolved = np.isfinite(logs[0]).all(axis=0) & np.isfinite(logs[1]).all(axis=0)
    one, other = (side[:, resolved].var(axis=0, ddof=1) for side in logs)
    ratios = one * spp / (other * spent)
    seconds = [
        float(np.mean([b.provenance["seconds"]["render"] for b in side])) for side in (uniform, adaptive)
    ]
    return {
        "part": "gains",
        "scene": name,
        "seeds": seeds,
        "spp": spent,
        "resolved": int(resolved.sum()),
        "worst": float(ratios.min(initial=np.inf)),
        "best": float(ratios.max(initial=0.0)),
        "infinite uniform": float(np.isinf(logs[0]).mean()),
        "infinite adaptive": float(np.isinf(logs[1]).mean()),
        "seconds over uniform": seconds[1] / seconds[0],
    }


def scenes() -> list[Path]:
    """All that there are."""
    own = sorted(path for path in (ROOT / "scenes").glob("*/*.xml") if path.stem == path.parent.name)
    return own + [OTHERS / name for name in REAL if (OTHERS / name).exists()]


def times(scene: Path) -> dict[str, Any]:
    """Until the default answers."""
    start = time.perf_counter()
    try:
        bound = pose_bound(scene)
    except MitsubaCRBError as error:
        return {"part": "times", "scene": scene.parent.name, "refused": str(error)}
    width, height = bound.provenance["size"]
    return {
        "part": "times",
        "scene": scene.parent.name,
        "pixels": f"{width}x{height}",
        "seconds": time.perf_counter() - start,
        "spp": paths(bound),
        "error": float(np.nanmax(bound.relative_standard_error, initial=0.0)),
        **{name: bound.verdicts.count(name) for name in ("seen", "unseen", "not resolved")},
    }


def price(rounds: int) -> dict[str, Any]:
    """The default over 64 paths, where those were enough."""
    scene = ROOT / "scenes" / "textured_wall" / "textured_wall.xml"
    sides: dict[str, list[float]] = {"default": [], "64": []}
    for turn in range(rounds + 1):
        for name, options in (("default", {}), ("64", {"spp": 64})):
            start = time.perf_counter()
            pose_bound(scene, size=(512, 512), **options)
            if turn:  # the first compiles
                sides[name].append(time.perf_counter() - start)
    default, many = (float(np.median(sides[name])) for name in ("default", "64"))
    return {
        "part": "price",
        "scene": "textured_wall",
        "pixels": "512x512",
        "seconds": default,
        "ratio": default / many,
    }


def verdicts(scene: Path, seeds: int) -> dict[str, Any]:
    """What is called unseen, and lower limits, beside a run of many paths."""
    options: dict[str, Any] = {"size": (64, 48)}
    with measurement(scene, **options) as run:
        options["exposure"] = run.exposure.white
    truth = pose_bound(scene, spp=4096, seed=1 << 20, **options)
    scale = truth.inverse.scale
    F = truth.information.to_frame("camera").matrix * np.outer(scale, scale)
    stds = deviations(truth)
    largest, called, wrong, limits = 0.0, 0, 0, 0
    for spp in (4, 16, 64, 256):
        for seed in range(seeds):
            bound = pose_bound(scene, spp=spp, seed=seed, **options)
            unseen = bound.inverse.resolution.unseen
            called += unseen.shape[1]
            if unseen.shape[1]:
                shown = np.linalg.eigvalsh(unseen.T @ F @ unseen)[-1] / np.linalg.eigvalsh(F)[-1]
                largest = max(largest, float(shown))
            low = np.concatenate([bound.position_std_lower_limit, bound.rotation_std_deg_lower_limit])
            limits += int(np.isfinite(stds).sum())
            wrong += int((low[np.isfinite(stds)] > stds[np.isfinite(stds)]).sum())
    return {
        "part": "verdicts",
        "scene": scene.parent.name,
        "rank": truth.rank,
        "called unseen": called,
        "largest called unseen": largest,
        "limits": limits,
        "limits above": wrong,
    }


def figure() -> None:
    """Where the paths went in a room, and the error against time."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.colors import LogNorm

    scene, size = GAINS["textured_room"], (240, 180)
    with measurement(scene, size=size, precision=0.01) as run:
        noise, _ = run.noise(None)
        final = Rounds(run, noise).decided()
        assert final.plan is not None
        spp = final.plan.of_pixels(run.mask)
        image = run.jacobian().image
    drawn, axes = plt.subplots(1, 3, figsize=(13, 3.4), layout="constrained", width_ratios=(1, 1.16, 1.1))
    shown = np.clip(image / np.percentile(image, 99), 0.0, 1.0) ** (1 / 2.2)
    axes[0].imshow(shown)
    axes[0].set_title("textured_room")
    map_ = axes[1].imshow(spp, norm=LogNorm(), cmap="viridis")
    axes[1].set_title("paths per pixel for 1 %")
    drawn.colorbar(map_, ax=axes[1])
    for axis in axes[:2]:
        axis.set_axis_off()
    for label, runs, style in (
        ("uniform", [{"spp": n} for n in (16, 32, 64, 128, 256)], "s--"),
        ("to a precision", [{"precision": p} for p in (0.04, 0.02, 0.01, 0.007)], "o-"),
    ):
        points = []
        for options in runs:
            pose_bound(scene, size=size, **options)  # compiled, loaded
            bound = pose_bound(scene, size=size, **options)
            points.append((bound.provenance["seconds"]["total"], 100 * bound.relative_standard_error.max()))
        axes[2].loglog(*np.transpose(points), style, label=label)
    axes[2].set_xlabel("time [s]")
    axes[2].set_ylabel("largest standard error [%]")
    axes[2].grid(visible=True, which="both", alpha=0.3)
    axes[2].legend()
    drawn.savefig(FIGURE, dpi=80)


def main() -> None:
    """Runs the parts that are asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--scenes", nargs="+", help="some of those of gains, or folders of times")
    parser.add_argument("--seeds", type=int, default=30)
    parser.add_argument("--precision", type=float, default=0.01, help="of gains")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    rows: list[dict[str, Any]] = []
    jobs: list[Any] = []
    wanted = options.scenes
    if "gains" in options.only:
        there = [name for name, path in GAINS.items() if path.exists() and (not wanted or name in wanted)]
        jobs += [lambda name=name: gains(name, options.seeds, options.precision) for name in there]
    if "times" in options.only:
        there = [path for path in scenes() if not wanted or path.parent.name in wanted]
        jobs += [lambda path=path: times(path) for path in there]
    if "verdicts" in options.only:
        there = [path for path in scenes() if not wanted or path.parent.name in wanted]
        jobs += [lambda path=path: verdicts(path, min(options.seeds, 20)) for path in there]
    if "price" in options.only:
        jobs.append(lambda: price(5))
    for job in jobs:
        rows.append(job())
        print(
            "  ".join(f"{k} {v:.3g}" if isinstance(v, float) else f"{k} {v}" for k, v in rows[-1].items()),
            flush=True,
        )
    if "figure" in options.only:
        figure()
    if rows and not wanted:
        names = list(dict.fromkeys(name for row in rows for name in row))
        with FILE.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, names)
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main()
