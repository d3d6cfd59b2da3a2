"""Many-sample references of F by finite differences, for tests/jacobian/test_flow_table.py.

    python benchmarks/reference.py sphere mirror --seeds 0 1 2 3     # or --all
    python benchmarks/reference.py --all --compare                   # flow beside them, a few minutes

Central differences at steps h and 2h with the same random numbers, dI/dξ = (4 D(h) − D(2h))/3 + O(h⁴): for
white texture under the default filter the information is low by about 4 h⁴, 0.1 % at 0.12 pixels. Box and
tent filters have corners, where the error is linear in h: 2 % at 0.12 and 0.2 % at 0.06 pixels in a scene
that is one long edge. How much the extrapolation changes is in the file (`step_effect`), so that the rest can
be judged. Film offsets are Sobol' points, which saves a factor of 25 or more in paths where edges make the
noise. Runs with further seeds are averaged into the file; one that was made with other settings, by other
versions, or of another scene, is refused.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
import warnings
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from mitsuba_crb.errors import PrecisionWarning
from mitsuba_crb.files import atomic
from mitsuba_crb.information.fisher import FisherInformation
from mitsuba_crb.information.image_information import fisher_information
from mitsuba_crb.measure.measurement import measurement
from mitsuba_crb.measure.versions import versions
from mitsuba_crb.noise import Gaussian

TESTS = Path(__file__).parents[1] / "tests"
sys.path[:0] = [str(TESTS), str(TESTS / "jacobian")]

from flow_scenes import OTHERS, ROWS  # noqa: E402
from test_flow_table import compared  # noqa: E402

FOLDER = TESTS / "jacobian" / "references"
SIGMA = 0.01
BATCHES = 16


def extrapolated(name: str, *, spp: int, seed: int, step: float) -> tuple[FisherInformation, np.ndarray]:
    """F by Richardson's extrapolation, and diag F(h) / diag F − 1."""
    row, jacobians = ROWS[name], []
    options = {**row.options, "spp": spp, "seed": seed, "batches": BATCHES}
    for pixels in (step, 2.0 * step):
        with measurement(row.scene(), method="finite_difference", step_pixels=pixels, **options) as measured:
            jacobians.append(measured.jacobian())
    fine, coarse = jacobians
    values = (4.0 * fine.batch_values - coarse.batch_values) / 3.0
    F, F_fine = (
        fisher_information(jacobian, Gaussian(SIGMA))
        for jacobian in (dataclasses.replace(fine, batch_values=values), fine)
    )
    return F, np.diag(F_fine.matrix) / np.diag(F.matrix) - 1.0


def run(name: str, *, spp: int, seed: int, step: float) -> None:
    """One more seed in the scene's file."""
    file = FOLDER / f"{name}.json"
    settings = {
        "scene": name,
        "digest": ROWS[name].digest(),
        "method": "finite_difference, (4 D(h) - D(2h)) / 3",
        "frame": "camera, translation first",
        "units": "matrix [1/scene unit^2, 1/(scene unit rad), 1/rad^2]",
        "noise_sigma": SIGMA,
        "size": list(ROWS[name].size),
        "step_pixels": step,
        "spp": spp,
        "batches": BATCHES,
        "versions": versions(),
    }
    known = json.loads(file.read_text(encoding="utf-8")) if file.exists() else settings | {"seeds": []}
    different = [
        f"{key} {known[key]}, not {settings[key]}" for key in settings if known[key] != settings[key]
    ]
    if different:
        sys.exit(f"{file} was made with {', '.join(different)}: remove it first")
    if seed in known["seeds"]:
        return
    start = time.perf_counter()
    F, effect = extrapolated(name, spp=spp, seed=seed, step=step)
    n = len(known["seeds"])
    zeros = np.zeros((6, 6))
    matrix = (n * np.array(known.get("matrix", zeros)) + F.matrix) / (n + 1)
    error = np.hypot(n * np.array(known.get("standard_error", zeros)), F.standard_error) / (n + 1)
    effect = (n * np.array(known.get("step_effect", np.zeros(6))) + effect) / (n + 1)
    seeds = [*known["seeds"], seed]
    record = settings | {
        "seeds": seeds,
        "seconds": round(known.get("seconds", 0.0) + time.perf_counter() - start, 1),
        "command": f"python benchmarks/reference.py {name} --spp {spp} --step {step} --seeds "
        + " ".join(map(str, seeds)),
        "step_effect": [float(f"{x:.2g}") for x in effect],
        "matrix": [[float(f"{x:.7g}") for x in row] for row in matrix],
        "standard_error": [[float(f"{x:.3g}") for x in row] for row in error],
    }
    lines = ",\n".join(f" {json.dumps(key)}: {json.dumps(value)}" for key, value in record.items())
    with atomic(file) as temporary:
        temporary.write_text("{\n" + lines + "\n}\n", encoding="utf-8")
    relative = 100.0 * np.diag(error) / np.diag(matrix)
    print(
        f"{name:16s} {n + 1:3d} seeds {record['seconds']:7.1f} s   standard errors [%]",
        " ".join(f"{x:5.2f}" for x in relative),
        "  step effect [%]",
        " ".join(f"{100.0 * x:5.2f}" for x in effect),
        flush=True,
    )


def compare(names: list[str]) -> None:
    """Flow beside the references, in per cent, as the test of the table has it; and its preparation."""
    table = Table("scene", "paths", "error", "diagonal", "off-diagonal", "prepare s")
    for name in names:
        with measurement(ROWS[name].scene(), **ROWS[name].options) as measured:
            start = time.perf_counter()
            prepared = measured.method
            seconds = time.perf_counter() - start
        del measured, prepared  # whose scene would otherwise be part of the next one's kernels
        difference, error = compared(name, ROWS[name].spp)
        worst = np.abs(difference)
        off = worst[~np.eye(6, dtype=bool)].max()
        numbers = (np.diag(error).max(), np.diag(worst).max(), off)
        table.add_row(
            name, str(ROWS[name].spp), *(f"{100.0 * number:.2f}" for number in numbers), f"{seconds:.2f}"
        )
    Console(width=80).print(table)


def main() -> None:
    """Make, continue or use references."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("names", nargs="*", choices=[[], *ROWS], metavar="NAME")
    parser.add_argument("--all", action="store_true", help="every scene of the table")
    parser.add_argument("--compare", action="store_true", help="make none, compare flow with them")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--spp", type=int, default=16384)
    parser.add_argument("--step", type=float, default=0.12, help="h [pixel]")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", PrecisionWarning)
    if arguments.compare:
        known = [name for name in ROWS if OTHERS.is_dir() or not name.startswith("real_")]
        compare(known if arguments.all else arguments.names)
        return
    FOLDER.mkdir(exist_ok=True)
    for seed in arguments.seeds:
        for name in ROWS if arguments.all else arguments.names:
            run(name, spp=arguments.spp, seed=seed, step=arguments.step)


if __name__ == "__main__":
    main()
