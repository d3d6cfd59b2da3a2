"""What a run says on the terminal: progress, tables of a bound, a check of methods, a diagnosis."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from ..se3 import TWIST_ORDER

if TYPE_CHECKING:
    from ..agents.team import Team
    from ..bound.cramer_rao import PoseBound
    from ..bound.hcr import HCRBound
    from ..estimate.trials import Validation
    from ..measure.check import JacobianCheck
    from ..measure.diagnosis import Diagnosis
    from ..measure.teams import TeamFusion, TeamSelection

_POSITION = ("position x, world", "position y, world", "position z, world")
_ROTATION = ("pitch, about {} x", "yaw, about {} y", "roll, about {} z")
_UNSEEN = "∞ (unseen)"


def print_bound(console: Console, bound: PoseBound) -> None:
    """The six standard deviations with errors and units, the rank, and what the numbers rest on."""
    facts = bound.provenance
    width, height = facts["size"]
    _line(console, Text(Path(str(facts["scene"])).name, style="bold"), f"  {width}×{height} pixels")
    _line(console, "No unbiased estimator of this camera's pose has smaller standard deviations than these:")
    _deviations(console, bound)
    if bound.if_known:
        _costs(console, bound)
    _facts(console, _bound_facts(bound))
    _notes(console, facts.get("warnings", ()))


def print_hcr(console: Console, bound: HCRBound) -> None:
    """The bound over finite displacements beside the local one, and where the image repeats."""
    _line(
        console,
        f"Unbiased at {len(bound.displacements)} displaced poses, too (Hammersley, Chapman and Robbins):",
    )
    table = _table()
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
    _facts(console, rows or [("image repeats at", "none of them")])


def _deviations(console: Console, bound: PoseBound, owner: str = "camera") -> None:
    """The six standard deviations; `owner` is whose axes the rotations are about."""
    table = _table()
    table.add_column("")
    table.add_column("1σ bound", justify="right")
    table.add_column("± its error", justify="right")
    table.add_column("unit")
    groups = (
        (_POSITION, bound.position_std, bound.position_std_standard_error, "scene unit"),
        (_ROTATION, bound.rotation_std_deg, bound.rotation_std_deg_standard_error, "deg"),
    )
    for names, deviations, errors, unit in groups:
        for name, deviation, error in zip(names, deviations, errors, strict=True):
            table.add_row(name.format(owner), *number_with_error(float(deviation), float(error)), unit)
        table.add_section()
    console.print(table)


def _costs(console: Console, bound: PoseBound) -> None:
    """What each nuisance costs: the standard deviations over those if it were known."""
    _line(console, "What not knowing a parameter costs: each 1σ over what it would be if that were known")
    table = _table()
    table.add_column("not known")
    for name in ("x", "y", "z", "pitch", "yaw", "roll"):
        table.add_column(name, justify="right")
    table.add_column("derivative by")
    how = bound.provenance.get("nuisances", {})
    values = [*bound.position_std, *bound.rotation_std_deg]
    for name, known in bound.if_known.items():
        without = [*known.position_std, *known.rotation_std_deg]
        table.add_row(Text(name), *map(_factor, values, without), how.get(name, ""))
    console.print(table)


def _factor(value: float, known: float) -> str:
    if math.isinf(value):
        return "∞" if math.isinf(known) else "unseen"
    return f"× {value / known:.2f}"


def number_with_error(value: float, error: float) -> tuple[str, str]:
    """`value` and its standard error, rounded to the error's second digit, in one notation."""
    if math.isinf(value):
        return _UNSEEN, ""
    if math.isnan(value):
        return "undefined", ""
    known = math.isfinite(error) and error > 0
    exponent = math.floor(math.log10(abs(value))) if value else 0
    shift = 0 if -5 <= exponent < 5 else exponent
    last = math.floor(math.log10(error)) - 1 if known else exponent - 3
    digits = max(0, min(12, shift - last))
    suffix = f"e{shift:+03d}" if shift else ""
    written = f"{value / 10.0**shift:.{digits}f}{suffix}"
    return written, f"± {error / 10.0**shift:.{digits}f}{suffix}" if known else "± unknown"


def _bound_facts(bound: PoseBound) -> list[tuple[str, str]]:
    facts = bound.provenance
    rows = [("rank", f"{bound.rank} of 6")]
    rows += [("unseen", direction.description) for direction in bound.unobserved]
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
    rows.append(("noise", _noise(facts["noise"])))
    if facts.get("prior"):
        rows.append(("prior", f"{facts['prior']}, included"))
    inflation = facts.get("noise_inflation")
    if inflation is not None:
        if math.isinf(inflation):
            claim = "information where there is none"
        elif inflation >= 1:
            claim = f"{1 + inflation:.3g} times the information"
        else:
            claim = f"{100 * abs(inflation):.2g} % {'more' if inflation >= 0 else 'less'} information"
        rows.append(("Monte Carlo noise", f"removed; plain JᵀWJ would have claimed {claim}"))
    rows.append(("pixels", _pixels(facts["pixels"])))
    rows.append(
        (
            "method",
            f"{facts['method']}, {facts['spp']} paths per pixel in {facts['batches']} batches, "
            f"seed {facts['seed']}",
        )
    )
    rows.append(("time", _seconds(facts["seconds"])))
    return rows


def _length_scale(length: float) -> str:
    if length == 1.0:
        return "1 scene unit (nothing at a finite distance is visible, or its median depth is 1)"
    return f"{length:.4g} scene units (median visible depth)"


def _noise(noise: dict[str, Any]) -> str:
    sigma, origin = noise.get("sigma"), noise.get("origin")
    named = f"Gaussian, σ = {sigma:.4g}" if sigma is not None else str(noise.get("description", "given"))
    return f"{named} ({origin})" if origin else named


def _pixels(pixels: dict[str, Any]) -> str:
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


def print_check(console: Console, check: JacobianCheck, warnings: Iterable[str] = ()) -> None:
    """Each method's columns beside those of finite differences, the verdict, and warnings on the way."""
    from ..measure.check import AGREEMENT  # late: it imports Dr.Jit

    for row in check.rows:
        _line(console, Text(row.method, style="bold"), " beside finite_difference, column by column:")
        table = _table()
        table.add_column("")
        for head in ("F / F_fd", "‖J − J_fd‖ / ‖J_fd‖", "would have seen"):
            table.add_column(head, justify="right")
        table.add_column("")
        for axis, name in enumerate(TWIST_ORDER):
            if row.disagrees[axis]:
                verdict = Text("differs", style="bold red")
            elif not math.isfinite(row.ratio[axis]):
                verdict = Text("unseen", style="green")
            elif row.detectable[axis] <= AGREEMENT:
                verdict = Text("equal", style="green")
            else:
                verdict = Text("undecided", style="yellow")
            table.add_row(
                name,
                _pair(row.ratio[axis], row.ratio_standard_error[axis], "z.3f"),
                _pair(row.difference[axis], row.difference_standard_error[axis], ".1%"),
                _pair(row.detectable[axis], math.nan, ".2g" if math.isinf(row.detectable[axis]) else ".1%"),
                verdict,
            )
        console.print(table)
    if math.isinf(check.detectable):
        _line(console, Text(f"{check.verdict}: there is no column to compare", style="bold yellow"))
    else:
        seen = f"{check.detectable:.1%}"
        verb = "disagrees" if len(check.disagreeing) == 1 else "disagree"
        sentence = {
            "agree": f"the methods agree; a disagreement in information of {seen} would have been seen",
            "disagree": f"{' and '.join(check.disagreeing)} {verb} with finite_difference; a disagreement of "
            f"{seen} would have been seen in any column",
            "inconclusive": f"inconclusive: only one above {seen} would have been seen; raise --spp",
        }[check.verdict]
        _line(console, Text(sentence, style="green" if check.verdict == "agree" else "bold yellow"))
    _notes(console, warnings)


def _pair(value: float, error: float, form: str) -> str:
    if math.isnan(value):
        return ""
    return f"{value:{form}}" + (f" ± {error:{form}}" if math.isfinite(error) else "")


def print_fusion(console: Console, team: Team, result: TeamFusion) -> None:
    """What each agent sees and brings, and the joint bound."""
    _line(console, Text(team.path.name, style="bold"), f"  {len(team.members)} agents")
    table = _table()
    for head in ("agent", "rank", "share", "unseen alone"):
        table.add_column(head, justify="right" if head in ("rank", "share") else "left")
    for share, bound in zip(result.fusion.agents, result.bounds, strict=True):
        unseen = "; ".join(direction.description for direction in bound.unobserved)
        table.add_row(Text(share.name), f"{share.rank} of 6", f"{share.share:.1%}", unseen or "nothing")
    console.print(table)
    bound = result.fusion.bound
    _line(console, f"No unbiased estimator of the pose of {team.body!r} from all images has less than these:")
    _deviations(console, bound, "body")
    rows = [("rank", f"{bound.rank} of 6")]
    rows += [("unseen", direction.description) for direction in bound.unobserved]
    rows.append(("length scale", f"{bound.length_scale:.4g} scene units (the largest of the agents')"))
    _facts(console, rows)
    _notes(console, result.warnings)


def print_selection(console: Console, team: Team, result: TeamSelection) -> None:
    """How many tiles each agent sends, what they are worth beside simpler rules, and other budgets."""
    selection = result.selection
    counts = Counter(chosen.agent for chosen in selection.chosen)
    _line(
        console,
        Text(team.path.name, style="bold"),
        f"  {len(selection.chosen)} of {sum(len(a.tiles) for a in result.agents)} tiles chosen, "
        f"{selection.total_bytes} bytes",
    )
    table = _table()
    table.add_column("agent")
    for head in ("tiles", "of", "bytes each"):
        table.add_column(head, justify="right")
    for agent in result.agents:
        costs = sorted(set(agent.cost_bytes.tolist()))
        table.add_row(
            Text(agent.agent),
            str(counts[agent.agent]),
            str(len(agent.tiles)),
            "–".join(map(str, costs[:: max(1, len(costs) - 1)])),
        )
    console.print(table)
    table = _table()
    table.add_column(selection.objective)
    for head in ("on the half chosen by", "held out"):
        table.add_column(head, justify="right")
    table.add_row("nothing sent", *2 * (_number(selection.value_empty),))
    for name, base in selection.baselines.items():
        table.add_row(name.replace("_", " "), _number(base.value), _number(base.value_heldout))
    table.add_row(
        Text("chosen", style="bold"),
        Text(_number(selection.value), style="bold"),
        Text(_number(selection.value_heldout), style="bold"),
    )
    table.add_row("upper bound", _number(selection.upper_bound), "")
    console.print(table)
    guarantee = "nothing" if selection.guarantee is None else f"{selection.guarantee:.1%}"
    rows = [("certificate", f"{selection.certificate:.1%} of the best gain; beforehand certain: {guarantee}")]
    length = result.agents[0].length_scale
    rows.append(("length scale", f"{length:.4g} scene units (the largest of the agents')"))
    _facts(console, rows)
    table = _table()
    for head in (result.counts, "chosen", *selection.baselines, "upper bound"):
        table.add_column(head.replace("_", " "), justify="right")
    for budget, other in result.curve:
        values = (other.value, *(base.value for base in other.baselines.values()), other.upper_bound)
        table.add_row(str(budget), *map(_number, values))
    console.print(table)
    _notes(console, result.warnings)


def _number(value: float) -> str:
    return f"{value:.5g}" if math.isfinite(value) else str(value).replace("inf", "∞")


def print_validation(console: Console, result: Validation, warnings: Iterable[str] = ()) -> None:
    """Errors beside the bound, their covariance and coverage with their bands, and the verdict."""
    found, settings = result.consistency, result.settings
    width, height = settings["size"]
    _line(console, Text(Path(settings["scene"]).name, style="bold"), f"  {width}×{height} pixels")
    table = _table()
    for head in ("", "errors", "bound", "unit"):
        table.add_column(head, justify="left" if head in ("", "unit") else "right")
    position, angle = result.bound_position, result.bound_rotation_deg
    table.add_row("position, RMS", f"{result.rmse_position:.4g}", f"{position:.4g}", "scene unit")
    table.add_row("rotation, RMS", f"{result.rmse_rotation_deg:.4g}", f"{angle:.4g}", "deg")
    console.print(table)
    table = _table()
    for head in ("", "found", "expected", "band", ""):
        table.add_column(head, justify="right" if head in ("found", "expected") else "left")
    table.add_row("NEES, mean", *_in_band(found.nees, 6.0, *found.nees_band))
    table.add_section()
    for k, (value, band) in enumerate(
        zip(found.generalized_eigenvalues, found.wishart_band, strict=True), start=1
    ):
        table.add_row(f"variance ratio {k}", *_in_band(float(value), 1.0, *band))
    table.add_section()
    for c in found.coverage:
        table.add_row(
            f"coverage at {c.nominal:.0%}", *_in_band(c.empirical, c.nominal, c.low, c.high, c.nominal)
        )
    console.print(table)
    more = f"; the file holds {len(result.further)} more" if result.further else ""
    _facts(
        console,
        [
            ("trials", f"{len(result.trials)}, of which {len(result.failed)} failed{more}"),
            ("noise", f"Gaussian, σ = {settings['sigma']:.4g}"),
            ("pixels", _pixels(settings["pixels"])),
            ("starts", f"within {settings['perturb_deg']:g} deg, {settings['perturb_trans']:g} scene units"),
            ("estimator", f"{settings['estimator']}, {settings['spp']} paths per pixel"),
            ("efficiency", f"{result.efficiency:.1%}"),
            ("renderer's noise", f"adds {result.excess:.1%} to the errors' covariance"),
        ],
    )
    if found.consistent:
        _line(console, Text("the errors are as the bound says", style="green"))
    else:
        _line(console, Text("the errors are not as the bound says", style="bold yellow"))
    _notes(console, warnings)


def _in_band(
    value: float, expected: float, low: float, high: float, inside: float | None = None
) -> tuple[str, str, str, Text]:
    """A value, what is expected, and whether it (or what should be inside) lies in a band."""
    good = low <= (value if inside is None else inside) <= high
    mark = Text("inside", style="green") if good else Text("outside", style="bold red")
    return f"{value:.3f}", f"{expected:g}", f"{low:.3f} to {high:.3f}", mark


def print_diagnosis(console: Console, diagnosis: Diagnosis) -> None:
    """What is installed and whether it works, a line each."""
    table = _table()
    table.show_header = False
    for name, value, good in diagnosis.rows:
        mark = Text("ok", style="green") if good else Text("FAILS", style="bold red")
        table.add_row(name, Text(str(value)), mark)
    console.print(table)
    if diagnosis.ok:
        _line(console, Text("everything needed works", style="green"))
    else:
        _line(console, Text("something needed does not work; see the lines that fail", style="bold red"))


@contextmanager
def progress() -> Iterator[Callable[[int, int], None]]:
    """A bar on standard error, on a terminal only; yields what to call with (done, total) pixels."""
    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("loading", total=None)
        yield lambda done, total: bar.update(task, description="measuring", completed=done, total=total)


def _table() -> Table:
    return Table(box=box.SIMPLE_HEAD, pad_edge=False, header_style="bold")


def _facts(console: Console, rows: list[tuple[str, str]]) -> None:
    width = max(len(name) for name, _ in rows)
    for name, value in rows:
        _line(console, Text(f"{name:<{width}}  ", style="dim"), value)


def _notes(console: Console, warnings: Iterable[str]) -> None:
    for warning in warnings:
        _line(console, Text("note: ", style="bold yellow"), " ".join(str(warning).split()))


def _line(console: Console, *parts: str | Text) -> None:
    # soft_wrap: a long line stays one line for grep and for the terminal's own wrapping
    console.print(Text.assemble(*parts), soft_wrap=True, highlight=False)
