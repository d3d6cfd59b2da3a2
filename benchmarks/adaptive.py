"""Sampling to a precision beside uniform sampling.

    python benchmarks/adaptive.py                       # all parts
    python benchmarks/adaptive.py --only gains times    # some of: gains times price verdicts coverage figure
    python benchmarks/adaptive.py --only gains --scenes textured_room --seeds 10

gains: at 160x120 the variance of ln σ over seeds, uniform over adaptive, at equal paths in all (of every
round), worst and best of the directions that every run resolves. times: seconds until the default
answers, each scene at its own size, the error that it states, and what it says of the six. price: the default
over --spp 64, textured_wall at 512x512, alternating. verdicts: at 64x48 and 4, 16, 64 and 256 paths per
pixel, how large what is called unseen is in a run of 4,096 paths (its information over the largest
eigenvalue: 1e-3 is the most), and how many lower limits exceed that run's standard deviations. coverage: at
160x120, to 10 %, beside two runs of 1,024 paths per pixel, how often the 95 % intervals of the six hold
their deviation, in the worst direction and pooled, and the largest |z| of the mean of F's 21 entries: of the
answers; and, as controls, of the last two rounds mixed by what they turned out to know, and of 8 paths
repeated until they say 10 % by themselves. figure: where the paths went in a room, error against time, into
figures/adaptive.png.

Tables go to adaptive.csv. Scenes by others are read from ../shared/data/mitsuba, where that is.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from mitsuba_crb import pose_bound
from mitsuba_crb.bound.cramer_rao import cramer_rao_bound
from mitsuba_crb.errors import MitsubaCRBError
from mitsuba_crb.information.symmetric import pack
from mitsuba_crb.measure.adaptive import Rounds
from mitsuba_crb.measure.measurement import measurement

ROOT = Path(__file__).parents[1]
OTHERS = ROOT.parent / "shared" / "data" / "mitsuba"
FILE = Path(__file__).with_suffix(".csv")
FIGURE = Path(__file__).parent / "figures" / "adaptive.png"
PARTS = ("gains", "times", "price", "verdicts", "coverage", "figure")

SMALL = (160, 120)
COVERED = {
    "boxes": ROOT / "scenes" / "boxes" / "boxes.xml",
    "staircase2": OTHERS / "staircase2" / "scene.xml",
}
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
    start, cpu = time.perf_counter(), time.process_time()
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
        "CPU seconds": time.process_time() - cpu,
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


def coverage(name: str, seeds: int) -> list[dict[str, Any]]:
    """Intervals, and the mean of the information, of the answers and of two ways to do it wrong."""
    goal = 0.1
    options: dict[str, Any] = {"size": SMALL}
    with measurement(COVERED[name], **options) as run:
        options["exposure"] = run.exposure.white
    many = [pose_bound(COVERED[name], spp=1024, seed=(1 << 20) + seed, **options) for seed in range(2)]
    truth = Found.mean([Found.of(bound) for bound in many])
    kinds: dict[str, list[Found]] = {"answer": [], "rounds mixed": [], "stopped": []}
    for seed in range(seeds):
        with measurement(COVERED[name], precision=goal, seed=seed, **options) as run:
            noise, _ = run.noise(None)
            rounds = Rounds(run, noise)
            own = rounds.decided().information(noise)
            kinds["answer"].append(Found.of(cramer_rao_bound(own)))
            if rounds.last is not None:
                pilot = rounds.last.joint.information
                kinds["rounds mixed"].append(Found.of(cramer_rao_bound(mixed([own, pilot]))))
        parts = []
        for turn in range(64):
            with measurement(COVERED[name], spp=8, seed=1000 * (seed + 1) + turn, **options) as run:
                parts.append(run.information(run.noise(None)[0]))
            found = cramer_rao_bound(averaged(parts))
            if turn and np.nan_to_num(found.relative_standard_error, nan=np.inf).max() < goal:
                break
        kinds["stopped"].append(Found.of(found))
    return [
        {"part": "coverage", "scene": name, "how": how, "runs": len(all_), **Found.beside(all_, truth)}
        for how, all_ in kinds.items()
        if len(all_) > 1
    ]


@dataclasses.dataclass(frozen=True)
class Found:
    """What a bound says, and how sure it is."""

    entries: np.ndarray
    """(21,) of F."""
    variances: np.ndarray
    """(21,) of their errors."""
    stds: np.ndarray
    """(6,)."""
    errors: np.ndarray
    """(6,) of the standard deviations."""

    @staticmethod
    def of(bound: Any) -> Found:
        """Of a bound."""
        F, stds = bound.information.to_frame("camera"), deviations(bound)
        errors = stds * bound.relative_standard_error
        return Found(pack(F.matrix), np.diagonal(F.covariance_of_entries), stds, errors)

    @staticmethod
    def mean(all_: list[Found]) -> Found:
        """Of independent runs."""
        n = len(all_)
        return Found(
            np.mean([each.entries for each in all_], axis=0),
            np.mean([each.variances for each in all_], axis=0) / n,
            np.mean([each.stds for each in all_], axis=0),
            np.sqrt(np.mean([each.errors**2 for each in all_], axis=0) / n),
        )

    @staticmethod
    def beside(all_: list[Found], truth: Found) -> dict[str, float]:
        """How many intervals hold the truth, and how far the mean is from it."""
        stds, errors = (np.array([getattr(each, name) for each in all_]) for name in ("stds", "errors"))
        holds = np.abs(stds - truth.stds) <= 1.96 * np.hypot(errors, truth.errors)
        entries = np.array([each.entries for each in all_])
        error = np.sqrt(entries.var(axis=0, ddof=1) / len(all_) + truth.variances)
        return {
            "worst": float(holds.mean(axis=0).min()),
            "pooled": float(holds.mean()),
            "largest z": float(np.abs((entries.mean(axis=0) - truth.entries) / error).max()),
        }


def averaged(parts: list[Any], weights: np.ndarray | None = None) -> Any:
    """The information that independent estimates say together."""
    shares = np.full(len(parts), 1.0 / len(parts)) if weights is None else weights / weights.sum()
    return dataclasses.replace(
        parts[0],
        matrix=sum(w * part.matrix for w, part in zip(shares, parts, strict=True)),
        covariance_of_entries=sum(
            w**2 * part.covariance_of_entries for w, part in zip(shares, parts, strict=True)
        ),
        plain_matrix=sum(w * part.plain_matrix for w, part in zip(shares, parts, strict=True)),
    )


def mixed(parts: list[Any]) -> Any:
    """By weights that their own stated errors decide: what is low by chance says that it is sure."""
    scale = pack(np.outer(parts[0].scale, parts[0].scale))
    own = [float(np.sum(np.diagonal(part.covariance_of_entries) * scale**2)) for part in parts]
    return averaged(parts, 1.0 / np.array(own))


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
    if "coverage" in options.only:
        there = [name for name, path in COVERED.items() if path.exists() and (not wanted or name in wanted)]
        jobs += [lambda name=name: coverage(name, options.seeds) for name in there]
    if "price" in options.only:
        jobs.append(lambda: price(5))
    for job in jobs:
        found = job()
        for row in found if isinstance(found, list) else [found]:
            rows.append(row)
            words = (f"{k} {v:.3g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items())
            print("  ".join(words), flush=True)
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
