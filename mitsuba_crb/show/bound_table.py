"""A bound on the terminal: its standard deviations, what they rest on, and the bound beyond it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.text import Text

from .misspecified_table import print_beside, print_kinds
from .terminal import (
    new_table,
    number_by_verdict,
    number_with_error,
    print_facts,
    print_line,
    print_notes,
)

if TYPE_CHECKING:
    from ..bound.cramer_rao import PoseBound
    from ..bound.hcr import HCRBound
    from ..measure.report import BoundReport

DETERMINISTIC = "deterministic: there are no paths, and the errors are those of rounding"
"""Of fields, in place of the number of paths."""

_POSITION = ("position x, world", "position y, world", "position z, world")
_ROTATION = ("pitch, about {} x", "yaw, about {} y", "roll, about {} z")


def print_report(console: Console, report: BoundReport) -> None:
    """The bound, and the one over finite displacements if there is one."""
    print_bound(console, report.bound)
    if report.misspecified is not None:
        print_line(console, "Beside the bound, which is ideal, what the map's error makes of it:")
        print_beside(console, report.misspecified.ideal, report.misspecified)
        print_kinds(console, report.misspecified)
    if report.hcr is not None:
        print_hcr(console, report.hcr)


def print_bound(console: Console, bound: PoseBound) -> None:
    """The six standard deviations with errors and units, the rank, and what the numbers rest on."""
    facts = bound.provenance
    width, height = facts["size"]
    across, down = facts["fov_deg"]
    print_line(
        console,
        Text(Path(str(facts["scene"])).name, style="bold"),
        f"  {width}×{height} pixels  {across:.1f}°×{down:.1f}° field of view{lens(facts)}",
    )
    for text in facts.get("no_bound", ()):
        print_line(console, Text("no bound: ", style="bold red"), text)
    print_not_resolved(console, bound)
    for text in facts.get("no_error", ()):
        print_line(console, Text("no error: ", style="bold red"), text)
    if facts.get("sampling", {}).get("interrupted"):
        print_line(
            console,
            Text("interrupted: ", style="bold red"),
            "this is the answer of the round before",
        )
    print_line(
        console, "No unbiased estimator of this camera's pose has smaller standard deviations than these:"
    )
    print_deviations(console, bound)
    if bound.if_known:
        _costs(console, bound)
    print_facts(console, _bound_facts(bound))
    above = [*facts.get("no_bound", ()), *facts.get("no_error", ()), f"not resolved: {bound.not_resolved}"]
    print_notes(console, [text for text in facts.get("warnings", ()) if text not in above])


def lens(facts: dict[str, Any]) -> str:
    """The lens model of a calibration, if it has one, behind two blanks."""
    model = (facts.get("camera") or {}).get("model", "pinhole")
    return "" if model == "pinhole" else f"  {model} lens"


def print_not_resolved(console: Console, bound: PoseBound) -> None:
    """What the paths are too few for, above the table that it overturns."""
    if bound.not_resolved is not None:
        print_line(console, Text("not resolved: ", style="bold red"), bound.not_resolved)


def print_hcr(console: Console, bound: HCRBound) -> None:
    """The bound over finite displacements beside the local one, and where the image repeats."""
    print_line(
        console,
        f"Unbiased at {len(bound.displacements)} displaced poses, too (Hammersley, Chapman and Robbins):",
    )
    table = new_table()
    for head in ("", "1σ bound", "/ local", "unit"):
        table.add_column(head, justify="right" if head in ("1σ bound", "/ local") else "left")
    local = bound.cramer_rao
    groups = (
        (_POSITION, bound.position_std, local.position_std, "scene unit"),
        (_ROTATION, bound.rotation_std_deg, local.rotation_std_deg, "deg"),
    )
    for names, deviations, locals_, unit in groups:
        for name, here, there in zip(names, deviations, locals_, strict=True):
            ratio = f"{here / there:.3g}" if math.isfinite(here) else ""
            table.add_row(name.format("camera"), number_with_error(float(here), math.nan)[0], ratio, unit)
        table.add_section()
    console.print(table)
    repeated = [", ".join(f"{value:.6g}" for value in xi) for xi in bound.displacements[bound.repeats]]
    rows = [("image repeats at", f"camera-frame twist ({twist})") for twist in repeated]
    print_facts(console, rows or [("image repeats at", "none of them")])


def print_deviations(console: Console, bound: PoseBound, owner: str = "camera") -> None:
    """The six standard deviations; `owner` is whose axes the rotations are about."""
    table = new_table()
    table.add_column("")
    table.add_column("1σ bound", justify="right")
    table.add_column("± its error", justify="right")
    table.add_column("unit")
    groups = (
        (
            _POSITION,
            bound.position_std,
            bound.position_std_standard_error,
            bound.position_verdict,
            bound.position_std_lower_limit,
            "scene unit",
        ),
        (
            _ROTATION,
            bound.rotation_std_deg,
            bound.rotation_std_deg_standard_error,
            bound.rotation_verdict,
            bound.rotation_std_deg_lower_limit,
            "deg",
        ),
    )
    for names, deviations, errors, verdicts, limits, unit in groups:
        for name, deviation, error, verdict, limit in zip(
            names, deviations, errors, verdicts, limits, strict=True
        ):
            number = number_by_verdict(float(deviation), float(error), verdict, float(limit))
            table.add_row(name.format(owner), *number, unit)
        table.add_section()
    console.print(table)


def _costs(console: Console, bound: PoseBound) -> None:
    """What each nuisance costs: the standard deviations over those if it were known."""
    print_line(
        console, "What not knowing a parameter costs: each 1σ over what it would be if that were known"
    )
    table = new_table()
    table.add_column("not known")
    for name in ("x", "y", "z", "pitch", "yaw", "roll"):
        table.add_column(name, justify="right")
    table.add_column("derivative by")
    how = bound.provenance.get("nuisances", {})
    values = [*bound.position_std, *bound.rotation_std_deg]
    verdicts = bound.verdicts
    for name, known in bound.if_known.items():
        without = [*known.position_std, *known.rotation_std_deg]
        table.add_row(Text(name), *map(_factor, values, without, verdicts), how.get(name, ""))
    console.print(table)


def _factor(value: float, known: float, verdict: str) -> str:
    if verdict == "seen":
        return f"× {value / known:.2f}"
    return "∞" if verdict == "unseen" and math.isinf(known) else verdict


def _bound_facts(bound: PoseBound) -> list[tuple[str, str]]:
    facts = bound.provenance
    rows = [("rank", f"{bound.rank} of 6")]
    rows += unobserved_facts(bound)
    if bound.weakest is not None:
        rows.append(("weakest seen", bound.weakest.description))
    scalars = bound.optimality
    rows.append(
        (
            "optimality",
            f"D: ln det F = {scalars.log_det:.4g}, A: tr F⁻¹ = {scalars.trace_inverse:.3g}, "
            f"E: λ_min = {scalars.smallest_eigenvalue:.3g}, with translation in length scales",
        )
    )
    rows.append(("length scale", _length_scale(bound.length_scale)))
    measures = facts.get("measures", {})
    rows += measured_facts(measures)
    taken = facts.get("photograph", {})
    if not math.isnan(taken.get("psnr_db", math.nan)):
        rows.append(("photograph", f"{taken['file']}: PSNR of the render {taken['psnr_db']:.1f} dB"))
    rows.append(("noise", _noise(facts["noise"])))
    if facts.get("depth"):
        rows.append(("noise of depth", _noise(facts["depth"]["noise"])))
    if facts.get("prior"):
        rows.append(("prior", f"{facts['prior']}, included"))
    inflation = facts.get("noise_inflation")
    if inflation is not None and not facts.get("deterministic"):
        if math.isinf(inflation):
            claim = "information where there is none"
        elif inflation >= 1:
            claim = f"{1 + inflation:.3g} times the information"
        else:
            claim = f"{100 * abs(inflation):.2g} % {'more' if inflation >= 0 else 'less'} information"
        rows.append(("Monte Carlo noise", f"removed; plain JᵀWJ would have claimed {claim}"))
    rows.append(("pixels", pixels_measured(facts["pixels"])))
    rows.append(
        (
            "method",
            f"{facts['method']}, {_paths(facts)}",
        )
    )
    differences = facts.get("finite_differences") or {}
    if differences.get("blocks"):
        rows.append(("finite differences", _differences(differences)))
    rows.append(("time", _seconds(facts["seconds"])))
    return rows


def measured_facts(measures: dict[str, Any]) -> list[tuple[str, str]]:
    """What is measured, if it is not colour's radiance, and which pixels tell a depth."""
    if measures.get("what", "colour") == "colour":
        unit = measures.get("unit", "radiance")
        return [] if unit == "radiance" else [("measures", f"colour, {unit}")]
    depth = measures.get("depth", measures)
    if "pixels" not in depth:
        return [("measures", f"{measures['what']}, one channel [{measures['unit']}]")]
    counts = {name: count for name, count in depth["pixels"].items() if count}
    rest = ", ".join(f"{name} {count}" for name, count in counts.items() if name != "measured")
    without = f", none at {rest}" if rest else ""
    what = "colour and depth" if "colour" in measures else "depth"
    return [
        (
            "measures",
            f"{what} along the optical axis [scene unit]: {counts.get('measured', 0)} pixels{without}",
        )
    ]


def _paths(facts: dict[str, Any]) -> str:
    """How many there were, and where they went."""
    if facts.get("deterministic"):
        return DETERMINISTIC
    sampling, seed = facts.get("sampling"), f"seed {facts['seed']}"
    if sampling is None:
        return f"{facts['spp']} paths per pixel in {facts['batches']} batches, {seed}"
    spp, rounds = sampling["spp"], len(sampling["rounds"])
    own = f"{spp['most']} paths per pixel"
    if spp["least"] < spp["most"]:
        own = f"{spp['least']} to {own} ({spp['mean']:.3g} on average)"
    before = f", after {rounds} round{'s' * (rounds > 1)} that decided on them" if rounds else ""
    return f"{own} in {facts['batches']} batches{before}, {seed}"


def unobserved_facts(bound: PoseBound) -> list[tuple[str, str]]:
    """The directions that are not seen, and how many paths decide those that are not resolved."""
    rows: list[tuple[str, str]] = []
    for direction in bound.unobserved:
        factor = direction.paths_factor
        how = "" if factor is None else f" (about {factor} times the paths decide)"
        rows.append((direction.verdict, f"{direction.description}{how}"))
    return rows


def _differences(found: dict[str, Any]) -> str:
    """Which part of the information finite differences measured, and why."""
    causes = ", ".join(f"{cause} in {n} block{'s' * (n > 1)}" for cause, n in sorted(found["blocks"].items()))
    return f"in flow's place: {_percent(found['share'])} of the information's trace, {causes}"


def _percent(share: float) -> str:
    """Two digits, but for a hundred."""
    return f"{100 * share:.0f} %" if share >= 0.095 else f"{100 * max(share, 0.0):.2g} %"


def _length_scale(length: float) -> str:
    if length == 1.0:
        return "1 scene unit (nothing at a finite distance is visible, or its median depth is 1)"
    return f"{length:.4g} scene units (median visible depth)"


def _noise(noise: dict[str, Any]) -> str:
    sigma, origin = noise.get("sigma"), noise.get("origin")
    named = str(noise.get("description", "given"))
    if sigma is not None:
        unit = noise.get("unit", "radiance")
        named = f"Gaussian, σ = {sigma:.4g}" + ("" if unit == "radiance" else f" {unit}")
    text = named if not origin else f"{named} (given)" if origin == "given" else f"{named}: {origin}"
    share = noise.get("saturated")
    if share is None:
        return text
    part = f"{100 * share:.2g} % of the values are saturated, which tells nothing"
    return f"{text}; {part if share else 'no value is saturated'}"


def pixels_measured(pixels: dict[str, Any]) -> str:
    """Which pixels a provenance says were measured, and what they stand for."""
    kind, selected, total = pixels["kind"], pixels["selected"], pixels["total"]
    if kind == "all":
        return f"all {total}"
    meaning = (
        "an estimate of the whole image's information"
        if kind == "random"
        else "for an estimator that sees only these"
    )
    return f"{selected} of {total} ({pixels['description']}): {meaning}"


def _seconds(seconds: dict[str, float]) -> str:
    parts = ", ".join(f"{name} {value:.2g}" for name, value in seconds.items() if name != "total")
    return f"{seconds['total']:.1f} s" + (f" ({parts})" if parts else "")
