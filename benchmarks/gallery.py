"""Every plugin of Mitsuba, alone in a small scene: does the bound by flow agree with finite differences?

    python benchmarks/gallery.py --quick              # to 5 % of the trace; twenty minutes on 2 cores
    python benchmarks/gallery.py                      # to 0.7 %; some hours
    python benchmarks/gallery.py --only shape sphere  # kinds, or names of plugins
    python benchmarks/gallery.py --minutes 9          # end in time; called again, it goes on
    python benchmarks/gallery.py --markdown           # write gallery.md from what was measured

Scenes are written by gallery_scenes.py into a folder for the time being (`--folder` keeps them). Each is
measured through a gaussian and through a box film, except those that are about a filter. Both methods' paths
are raised until the combined standard error of F's trace (camera frame, translation in length scales) is the
one asked for, or one measurement takes `--seconds`. Finite differences step as short as the filter demands.

Flow agrees if the trace and the six diagonal entries of F differ by no more than the larger of 2 % and four
combined standard errors; entries below 0.1 % of the largest count as if they were that large. What differs is
`told` if the scene's warnings say something, and `differs` if all was silent. `undecided` are those whose
standard error is above 5 % for want of time; of `refused` the one line stands in the table. All numbers go to
benchmarks/gallery.json after each scene; a scene that ended the process stands there as a crash.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import json
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from gallery_scenes import NOT_COVERED, SIZE, Picture, gallery, write
from rich.console import Console

from mitsuba_crb import PoseBound, load_scene, pose_bound
from mitsuba_crb.errors import MitsubaCRBError, SceneWarning
from mitsuba_crb.information.fisher import FisherInformation
from mitsuba_crb.jacobian.finite_difference import step_for
from mitsuba_crb.render.backend import use_mitsuba
from mitsuba_crb.render.view import open_view

HERE = Path(__file__).parent
BATCHES = 8
START = {"flow": 256, "finite_difference": 64}
"""Paths per pixel of the first measurement."""
SHARE, ERRORS, LEAST = 0.02, 4.0, 1e-3
"""Largest difference: relative, in standard errors, and of entries that are nearly none over the largest."""
UNDECIDED = 0.05
"""Relative standard error of the trace beyond which agreement says nothing."""
FILMS = ("gaussian", "box")
RUNNING = "the process ended"
NAMES = ("trace", "x", "y", "z", "pitch", "yaw", "roll")
console = Console(width=140)


def scaled(information: FisherInformation) -> tuple[np.ndarray, np.ndarray]:
    """(7,) trace and diagonal of F in scaled units, and their standard errors."""
    square = information.scale**2
    rows, columns = np.triu_indices(6)
    covariance = information.covariance_of_entries[np.ix_(rows == columns, rows == columns)]
    covariance = covariance * np.outer(square, square)
    diagonal = np.diagonal(information.matrix) * square
    variances = np.concatenate([[covariance.sum()], np.diagonal(covariance)])
    return np.concatenate([[diagonal.sum()], diagonal]), np.sqrt(np.maximum(variances, 0.0))


def to_precision(scene: Any, method: str, target: float, seconds: float, **options: Any) -> tuple[Any, int]:
    """A bound whose trace has a relative standard error, or that takes so many seconds; and its paths."""
    spp = START[method]
    for _ in range(4):
        start = time.perf_counter()
        bound = pose_bound(scene, method=method, spp=spp, batches=BATCHES, **options)
        took = time.perf_counter() - start
        value, error = scaled(bound.information)
        relative = error[0] / max(value[0], 1e-30)
        factor = min(1.2 * (relative / target) ** 2, 0.8 * seconds / took, 64.0)
        if relative <= target or factor < 1.5:
            break
        spp = BATCHES * round(spp * factor / BATCHES)
    return bound, spp


def compared(path: Path, defines: dict[str, str], target: float, seconds: float) -> dict[str, Any]:
    """Flow and finite differences on one film."""
    half = target / np.sqrt(2.0)
    scene = load_scene(path, **defines)
    with open_view(scene) as view:
        step = step_for(view.pixel_filter)
    flow, flow_spp = to_precision(scene, "flow", half, seconds, seed=1)
    # The same noise; other random numbers.
    white = flow.provenance["noise"]["white"]
    differences, difference_spp = to_precision(
        scene, "finite_difference", half, seconds, seed=2, exposure=white, step_pixels=step
    )
    return beside(flow, differences) | {"spp": [flow_spp, difference_spp], "step_pixels": step}


def beside(flow: PoseBound, differences: PoseBound) -> dict[str, Any]:
    """Flow's information and finite differences', and whether they agree."""
    value, error = scaled(flow.information)
    other, other_error = scaled(differences.information)
    methods = flow.provenance["finite_differences"]
    return judged(value, error, other, other_error) | {
        "flow": value.tolist(),
        "flow_errors": error.tolist(),
        "finite_difference": other.tolist(),
        "finite_difference_errors": other_error.tolist(),
        "by_differences": methods["share"],
        "causes": methods["blocks"],
    }


def judged(
    value: np.ndarray, error: np.ndarray, other: np.ndarray, other_error: np.ndarray
) -> dict[str, Any]:
    """Whether (7,) traces and diagonals agree, and by how much the trace and the worst of them differ."""
    difference, errors = value - other, np.hypot(error, other_error)
    size = np.maximum(np.abs(other), LEAST * np.max(np.abs(other[1:])))
    allowed = np.maximum(SHARE * size, ERRORS * errors)
    worst = int(np.argmax(np.abs(difference) / np.maximum(allowed, 1e-30)))
    verdict = "agrees" if errors[0] <= UNDECIDED * size[0] else "undecided"
    return {
        "verdict": "differs" if np.abs(difference[worst]) > allowed[worst] else verdict,
        "trace": difference[0] / size[0],
        "se": errors[0] / size[0],
        "worst": NAMES[worst],
        "worst_difference": difference[worst] / size[worst],
        "worst_se": errors[worst] / size[worst],
    }


def measured(path: Path, which: str | None, target: float, seconds: float) -> dict[str, Any]:
    """What comes of one scene on one film: numbers, or one line."""
    defines = {"width": str(SIZE[0]), "height": str(SIZE[1])} | ({"filter": which} if which else {})
    result = answered(lambda: compared(path, defines, target, seconds))
    if "says" in result:
        result["says"] = result["says"].replace(f"{path}: ", "")
    return result


def answered(compare: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """What a comparison comes to, or why it is refused; what was warned of, and how long it took."""
    start = time.perf_counter()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            result = compare()
        except MitsubaCRBError as error:
            result = {"verdict": "refused", "says": f"{type(error).__name__}: {error}"}
    # What a bound says of its own samples is no verdict on its picture.
    said = list(dict.fromkeys(str(w.message) for w in caught if issubclass(w.category, SceneWarning)))
    if result["verdict"] == "differs" and said:
        result["verdict"] = "told"
    return result | {"warnings": said, "seconds": time.perf_counter() - start}


def run(pictures: dict[Path, Picture], options: argparse.Namespace) -> None:
    """Measure what has no result yet, and write each at once."""
    end = time.perf_counter() + 60.0 * options.minutes
    target, seconds = (0.05, 4.0) if options.quick else (options.target, options.seconds)
    results = read(options.results)
    for film in FILMS:
        for path, picture in pictures.items():
            wanted = {picture.kind, picture.name, *picture.name.split(", ")} & set(options.only)
            key = f"{picture.kind} / {picture.name} / {'own' if picture.own_filter else film}"
            if (options.only and not wanted) or (key in results and not options.again):
                continue
            if picture.own_filter and film != FILMS[0]:
                continue
            if time.perf_counter() > end:
                return
            results[key] = {"verdict": "crash", "says": RUNNING}
            options.results.write_text(json.dumps(results, indent=1))
            gc.collect()  # kernels call what any scene in memory brings along
            results[key] = measured(path, None if picture.own_filter else film, target, seconds)
            options.results.write_text(json.dumps(results, indent=1))
            console.print(f"{key}: {line(results[key])}", highlight=False)


def read(file: Path) -> dict[str, Any]:
    """The results so far."""
    return json.loads(file.read_text()) if file.exists() else {}


def line(result: dict[str, Any]) -> str:
    """A result in one line."""
    if "trace" not in result:
        return f"{result['verdict']}: {result['says']}"
    text = f"{result['verdict']} {100 * result['trace']:+.2f} ± {100 * result['se']:.2f} %"
    text += f", worst {result['worst']} {100 * result['worst_difference']:+.2f} ± "
    text += f"{100 * result['worst_se']:.2f} %, {result['seconds']:.0f} s"
    if result["causes"]:
        text += f", by differences {shares(result)}"
    return "; ".join([text, *result["warnings"]])


def shares(result: dict[str, Any]) -> str:
    """What finite differences measured in flow's place, and why."""
    causes = ", ".join(result["causes"])
    return f"{100 * result['by_differences']:.0f} %: {causes}" if causes else ""


def markdown(results: dict[str, Any]) -> str:
    """The table of the documents."""
    counts = Counter(result["verdict"] for result in results.values())
    sums = ", ".join(f"{number} {verdict}" for verdict, number in counts.most_common())
    errors = [result["se"] for result in results.values() if "se" in result]
    lines = [
        "# Gallery",
        "",
        "Written by `python benchmarks/gallery.py --markdown`: flow against finite differences, each plugin",
        "alone. Differences and combined standard errors are relative, in percent: of F's trace, and of the",
        "diagonal entry (or the trace) worst for its error. Paths are those per pixel of flow, and of",
        "each of the twelve renders. By differences: the share of flow's information that finite differences",
        "measured, and why: where it is 100 %, two runs of one method are compared.",
        "",
        f"{len(results)} measurements: {sums}; the median standard error is {100 * np.median(errors):.1f} %.",
        "",
        "| kind | plugin | film | verdict | trace | worst | paths | by differences | it says |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    order = [f"{one.kind} / {one.name}" for one in gallery()]
    for key, result in sorted(results.items(), key=lambda item: order.index(item[0].rpartition(" / ")[0])):
        cells = [*key.split(" / "), result["verdict"]]
        if "trace" in result:
            cells += [
                f"{100 * result['trace']:+.2f} ± {100 * result['se']:.2f}",
                f"{result['worst']} {100 * result['worst_difference']:+.2f} ± {100 * result['worst_se']:.2f}",
                " / ".join(map(str, result["spp"])),
                f"{100 * result['by_differences']:.0f} %: {', '.join(result['causes'])}"
                if result["causes"]
                else "",
                "; ".join(result["warnings"]),
            ]
        else:
            cells += ["", "", "", "", result["says"].replace("|", "\\|")]
        lines.append(f"| {' | '.join(cells)} |")
    reasons: dict[str, list[str]] = {}
    for name, why in NOT_COVERED.items():
        reasons.setdefault(why, []).append(f"`{name}`")
    lines += ["", "Without a scene:", "", *(f"- {', '.join(names)}: {why}" for why, names in reasons.items())]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Write the scenes, and measure those asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="to 5 %%, four seconds a measurement")
    parser.add_argument("--target", type=float, default=0.007, help="combined relative standard error")
    parser.add_argument("--seconds", type=float, default=120.0, help="of one measurement")
    parser.add_argument("--minutes", type=float, default=np.inf, help="of all")
    parser.add_argument("--only", nargs="+", default=[], metavar="KIND_OR_NAME")
    parser.add_argument("--again", action="store_true", help="also what has a result")
    parser.add_argument("--folder", type=Path, default=None, help="where the scenes stay")
    parser.add_argument("--results", type=Path, default=HERE / "gallery.json")
    parser.add_argument("--markdown", action="store_true", help="only write the table beside the results")
    options = parser.parse_args()
    if options.markdown:
        (HERE / "gallery.md").write_text(markdown(read(options.results)))
        return
    with contextlib.ExitStack() as stack:
        folder = options.folder or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        folder.mkdir(parents=True, exist_ok=True)
        use_mitsuba()
        run(write(folder), options)


if __name__ == "__main__":
    main()
