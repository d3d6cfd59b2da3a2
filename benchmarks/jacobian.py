"""What the Jacobian and the bound cost, beside the renders and the methods that they stand for.

    python benchmarks/jacobian.py                      # everything; about twenty minutes on 2 quiet cores
    python benchmarks/jacobian.py --quick              # small images, a minute
    python benchmarks/jacobian.py --only sides cold    # some of: sides precision pixels subset cold
    python benchmarks/jacobian.py --sizes 64 512       # sides of the images of "sides"
    python benchmarks/jacobian.py --scenes boxes       # some of the scenes of "sides"; by default all four

sides: one `mi.render` with the film's gaussian filter and one with a box film, the paths alone
(`render_pixels`, the floor of any method), `pose_jacobian` and `pose_bound` by flow, and on small images
by the other methods; medians of five alternating warm rounds and their ratios to both renders, of elapsed
time and of CPU time (which other processes disturb less). precision: seconds until the standard error is 1 %
of the trace and of the smallest observed eigenvalue of F (camera frame, translation in length scales), from
one measured run, whose noise goes by 1/√spp and whose step of finite differences errs by as much whatever
the paths: never, where that alone is more. For flow, finite_difference, and forward where it is right;
medians of three alternating rounds; and, warm, of flow alone for a larger room. pixels, subset: cost
against the number of pixels, and its log-log slope. cold: one process, imports and compilation included.
All numbers also go to benchmarks/jacobian.json.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import re
import resource
import statistics
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from mitsuba_crb import load_scene, pose_bound, pose_jacobian
from mitsuba_crb.bound.cramer_rao import PoseBound
from mitsuba_crb.information.subset import tiles
from mitsuba_crb.render.pixels import render_pixels
from mitsuba_crb.render.view import open_view

ROOT = Path(__file__).parents[1]
PARTS = ("sides", "precision", "pixels", "subset", "cold")
DIFFUSE = ("textured_room", "textured_wall", "boxes")
GLOSSY = "textured_wall, rough conductor"
SCENES = (*DIFFUSE, GLOSSY)
SMOOTH = ("textured_wall", "striped_wall")
JUMPING = ("textured_room", "boxes", "checkerboard_wall", "shadows", "warehouse")
"""Scenes of "precision": without, and with, edges, silhouettes or shadows that `forward` cannot see."""
TARGET = 0.01
"""Relative standard error that "precision" asks for."""
ROUNDS = 5
console = Console(width=140)


def scene_file(name: str) -> Path:
    """A shipped scene's file."""
    return ROOT / "scenes" / name / f"{name}.xml"


def opened(name: str, size: int, *, box: bool = False) -> Any:
    """A square view of a shipped scene; `box` adds a second sensor, equal but for its box filter."""
    path = scene_file(name.split(",", maxsplit=1)[0])
    text = path.read_text()
    if box:
        text = re.sub(r'<include filename="(.*?)"/>', partial(_included, path), text)
        sensor = re.search(r"<sensor .*?</sensor>", text, re.DOTALL)
        other = sensor[0].replace('"gaussian"', '"box"', 1).replace(' id="camera"', "", 1)
        assert other.count('<rfilter type="box"/>') == 1
        text = text.replace("</scene>", f"{other}</scene>")
    if name == GLOSSY:
        text = text.replace(
            '<bsdf type="diffuse">', '<bsdf type="roughconductor"><float name="alpha" value="0.3"/>'
        )
        text = text.replace('name="reflectance"', 'name="specular_reflectance"')
    if text == path.read_text():
        return load_scene(path, width=str(size), height=str(size))
    # Beside the scene, because its files are named relative to it.
    changed = path.with_name(f".benchmark_{os.getpid()}.xml")
    changed.write_text(text)
    try:
        return load_scene(changed, width=str(size), height=str(size))
    finally:
        changed.unlink()


def _included(path: Path, include: re.Match[str]) -> str:
    """What another file holds."""
    text = path.with_name(include[1]).read_text()
    return text[text.index(">", text.index("<scene ")) + 1 : text.rindex("</scene>")]


def timed(function: Callable[[], object]) -> tuple[float, float]:
    """Elapsed and CPU seconds of one call."""
    start, cpu = time.perf_counter(), time.process_time()
    function()
    return time.perf_counter() - start, time.process_time() - cpu


def renders(scene: Any, spp: int, sensor: int) -> Callable[[], None]:
    """One render, waited for."""
    import drjit as dr
    import mitsuba as mi

    def render() -> None:
        dr.eval(mi.render(scene, sensor=sensor, spp=spp, seed=1))
        dr.sync_thread()

    return render


def paths_alone(scene: Any, size: int, spp: int) -> Callable[[], None]:
    """The same paths without derivatives, tile by tile."""
    parts = list(tiles(np.ones((size, size), dtype=bool), 256))

    def trace() -> None:
        with open_view(scene) as view:
            for part in parts:
                render_pixels(view, part, spp=spp // 4, batches=4, seed=1)

    return trace


def alone(measure: Callable[..., list[dict[str, Any]]], *arguments: Any) -> list[dict[str, Any]]:
    """A measurement with the scenes before it gone: kernels call what any scene in memory brings along."""
    gc.collect()
    return measure(*arguments)


def sides(name: str, size: int, spp: int) -> list[dict[str, Any]]:
    """Renders, paths, Jacobian and bound, in turns."""
    rows = []
    scene = opened(name, size, box=True)
    calls: dict[str, Callable[[], object]] = {
        "render, gaussian film": renders(scene, spp, 0),
        "render, box film": renders(scene, spp, 1),
        "paths alone": paths_alone(scene, size, spp),
        "pose_bound": lambda scene=scene: pose_bound(scene, spp=spp),
    }
    if size <= 512:  # the whole Jacobian of a larger image is gigabytes
        calls["pose_jacobian"] = lambda scene=scene: pose_jacobian(scene, spp=spp)
    if size <= 64:  # they take tens of renders
        for method in ("forward", "finite_difference"):
            calls[f"pose_bound, {method}"] = partial(pose_bound, scene, spp=spp, method=method)
    for call in calls.values():
        call()
    rounds = [{side: timed(call) for side, call in calls.items()} for _ in range(ROUNDS)]
    table = Table(
        "",
        "s",
        "x gaussian",
        "x box",
        "CPU s",
        "x gaussian",
        "x box",
        title=f"{name} {size}x{size}, {spp} spp",
    )
    for side in calls:
        row: dict[str, Any] = {"scene": name, "size": size, "spp": spp, "side": side}
        for kind, which in enumerate(("seconds", "cpu_seconds")):
            row[which] = statistics.median(r[side][kind] for r in rounds)
            for film in ("gaussian", "box"):
                row[f"{which}_per_{film}_render"] = statistics.median(
                    r[side][kind] / max(r[f"render, {film} film"][kind], 1e-3) for r in rounds
                )
        rows.append(row)
        table.add_row(side, *(f"{row[key]:.3f}" for key in list(row)[4:]))
    console.print(table)
    return rows


@dataclass(frozen=True)
class Error:
    """Relative standard error of something that was measured."""

    noise: float
    """Of its paths."""
    step: float
    """Of the step of finite differences."""

    def seconds_to_target(self, seconds: float) -> float:
        """How long to trace until both together are `TARGET`, if this took so many seconds."""
        left = TARGET**2 - self.step**2
        return seconds * self.noise**2 / left if left > 0.0 else np.inf

    def __str__(self) -> str:
        return f"{self.noise:.3%}, {self.step:.2%}"


def relative_errors(bound: PoseBound, rank: int = 6) -> tuple[Error, Error]:
    """Of the trace and of the smallest observed eigenvalue of the information, in scaled units.

    Args:
        rank: number of observed directions; the eigenvalue is the one of that place from above.
    """
    rows, columns = np.triu_indices(6)
    information, joint = bound.information, bound.joint
    assert joint is not None
    scale = np.outer(information.scale, information.scale)
    F, bias = information.matrix * scale, (joint.bias * scale)[rows, columns]
    cov = information.covariance_of_entries * np.outer(*2 * [scale[rows, columns]]) - np.outer(bias, bias)
    values, vectors = np.linalg.eigh(F)
    v = vectors[:, 6 - rank]
    found = []
    for target, gradient in [
        (float(np.trace(F)), (rows == columns).astype(float)),
        (float(values[6 - rank]), np.where(rows == columns, 1.0, 2.0) * v[rows] * v[columns]),
    ]:
        noise = float(np.sqrt(max(gradient @ cov @ gradient, 0.0)))
        step = abs(float(gradient @ bias))
        found.append(Error(noise / target, step / target) if target > 3.0 * noise else Error(np.inf, np.inf))
    return found[0], found[1]


def _or_never(number: float) -> str:
    return f"{number:.3g}" if np.isfinite(number) else "never"


def _bound_into(runs: list[Any], scene: Any, spp: int, method: str) -> None:
    runs.append(pose_bound(scene, spp=spp, method=method))


def precision(name: str, size: int, spp: int, with_forward: bool) -> list[dict[str, Any]]:
    """Seconds to 1 %, by every method that is right."""
    rows = []
    scene = opened(name, size)
    one = ("s to 1 %", "x flow", "of noise alone")
    table = Table(
        "method",
        "s",
        *("trace: noise, step", *one),
        *("λ_min: noise, step", *one),
        title=f"{name} {size}x{size}, {spp} spp",
    )
    methods = ("flow", "finite_difference", "forward")[: 3 if with_forward else 2]
    runs: dict[str, list[Any]] = {method: [] for method in methods}
    for method in methods:
        pose_bound(scene, spp=4, method=method)
    calls = {method: partial(_bound_into, runs[method], scene, spp, method) for method in methods}
    rounds = [{method: timed(call)[0] for method, call in calls.items()} for _ in range(3)]
    for method in methods:
        seconds = statistics.median(times[method] for times in rounds)
        rank = runs["flow"][-1].rank
        row: dict[str, Any] = {"scene": name, "size": size, "method": method, "seconds": seconds}
        cells = [method, f"{seconds:.2f}"]
        for what, error in zip(("", "smallest_"), relative_errors(runs[method][-1], rank), strict=True):
            to_go, noisy = f"{what}seconds_to_1_percent", f"{what}seconds_to_1_percent_of_noise"
            row |= {f"{what}noise": error.noise, f"{what}step": error.step}
            row |= {to_go: error.seconds_to_target(seconds), noisy: seconds * (error.noise / TARGET) ** 2}
            flow = rows[0] if rows else row
            cells += [str(error), *(_or_never(x) for x in (row[to_go], row[to_go] / flow[to_go]))]
            cells.append(_or_never(row[noisy] / flow[noisy]))
        rows.append(row)
        table.add_row(*cells)
    console.print(table)
    return rows


def warm(name: str, size: int, spp: int) -> list[dict[str, Any]]:
    """Seconds to 1 % of a bound, once its kernels are compiled."""
    scene = opened(name, size)
    found: list[Any] = []
    once = partial(_bound_into, found, scene, spp, "flow")
    once()
    seconds = statistics.median(timed(once)[0] for _ in range(4))
    trace, _ = relative_errors(found[-1])
    to_go = trace.seconds_to_target(seconds)
    console.print(
        f"bound on {name} {size}x{size}, warm: {seconds:.2f} s for {trace.noise:.3%} of the trace, "
        f"{to_go:.2f} s to 1 %"
    )
    return [{"scene": name, "size": size, "method": "flow", "seconds_to_1_percent": to_go}]


def scaling(title: str, counts: list[int], calls: list[Callable[[], object]]) -> list[dict[str, Any]]:
    """Cost against the number of pixels, with the slope of the log-log fit."""
    rows = []
    table = Table("pixels", "s", "CPU s", "peak MiB", title=title)
    calls[0]()
    for count, call in zip(counts, calls, strict=True):
        rounds = 3 if count <= 512**2 else 1
        seconds, cpu = (statistics.median(x) for x in zip(*(timed(call) for _ in range(rounds)), strict=True))
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        rows.append({"pixels": count, "seconds": seconds, "cpu_seconds": cpu, "peak_mib": peak})
        table.add_row(str(count), f"{seconds:.3f}", f"{cpu:.3f}", f"{peak:.0f}")
    console.print(table)
    large = [row for row in rows if row["pixels"] >= 128**2]
    for key in ("seconds", "cpu_seconds"):
        slope = np.polyfit(*(np.log([row[k] for row in large]) for k in ("pixels", key)), 1)[0]
        console.print(f"slope of {key} from 128² on: {slope:.3f}")
    return rows


def pixels(largest: int) -> list[dict[str, Any]]:
    """Cost against the image's size."""
    scene = opened("textured_wall", 64)
    sizes = [n for n in (64, 128, 256, 512, 1024, 2048) if n <= largest]
    calls: list[Callable[[], object]] = [lambda n=n: pose_bound(scene, size=(n, n), spp=64) for n in sizes]
    return scaling("pose_bound of textured_wall against pixels", [n * n for n in sizes], calls)


def subset(size: int) -> list[dict[str, Any]]:
    """Cost of random subsets of a large image."""
    scene = opened("textured_wall", 64)
    shares = [0.01, 0.03, 0.1, 0.3, 1.0]
    calls: list[Callable[[], object]] = [
        lambda s=s: pose_bound(scene, size=(size, size), spp=64, pixels=f"random:{s}") for s in shares
    ]
    return scaling(f"random:s of {size}x{size}", [round(s * size * size) for s in shares], calls)


def cold(size: int) -> list[dict[str, Any]]:
    """`bound` on textured_room in a process of its own, twice: the first may compile."""
    command = [str(Path(sys.executable).with_name("mitsuba-crb")), "bound", str(scene_file("textured_room"))]
    command += ["--size", f"{size}x{size}"]
    rows = []
    for run in ("first", "second"):
        start = time.perf_counter()
        subprocess.run(command, check=True, capture_output=True)
        rows.append({"run": run, "size": size, "seconds": time.perf_counter() - start})
        console.print(f"cold start, {run} process, textured_room {size}x{size}: {rows[-1]['seconds']:.1f} s")
    return rows


def main() -> None:
    """Run the parts asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="small images")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--sizes", nargs="+", type=int, default=None, help="default 64 256 512 1024")
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=SCENES, metavar="SCENE")
    parser.add_argument("--spp", type=int, default=64)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    size = 128 if options.quick else 512
    sizes = options.sizes or ([64, 128] if options.quick else [64, 256, 512, 1024])
    runs: dict[str, Callable[[], list[dict[str, Any]]]] = {
        "sides": lambda: [
            row for name in options.scenes for n in sizes for row in alone(sides, name, n, options.spp)
        ],
        "precision": lambda: [
            *(row for n in SMOOTH for row in alone(precision, n, size // 2, options.spp, True)),
            *(row for n in JUMPING for row in alone(precision, n, size // 2, options.spp, False)),
            *(row for n in SMOOTH for row in alone(precision, n, size, options.spp, False)),
            *alone(warm, "textured_room", size, options.spp),
        ],
        "pixels": lambda: alone(pixels, 256 if options.quick else 2048),
        "subset": lambda: alone(subset, 512 if options.quick else 2048),
        "cold": lambda: cold(size),
    }
    results: dict[str, Any] = {"load": os.getloadavg(), "cores": os.cpu_count()}
    for part in options.only:
        results[part] = runs[part]()
        (ROOT / "benchmarks" / "jacobian.json").write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
