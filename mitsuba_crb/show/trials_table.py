"""What trials say of the bound, on the terminal."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.text import Text

from .bound_table import pixels_measured
from .terminal import new_table, paths_said, print_facts, print_line, print_notes

if TYPE_CHECKING:
    from ..estimate.trials import Validation


def print_validation(console: Console, result: Validation, warnings: Iterable[str] = ()) -> None:
    """Errors beside the bound, their covariance and coverage with their bands, and the verdict."""
    found, settings = result.consistency, result.settings
    width, height = settings["size"]
    print_line(console, Text(Path(settings["scene"]).name, style="bold"), f"  {width}×{height} pixels")
    verdict = Text(verdict_line(result), style="green" if result.exit_code == 0 else "bold yellow")
    overturned = result.verdict != ("consistent" if found.consistent else "inconsistent")
    if overturned:
        print_line(console, verdict)
    table = new_table()
    for head in ("", "errors", "bound", "unit"):
        table.add_column(head, justify="left" if head in ("", "unit") else "right")
    position, angle = result.bound_position, result.bound_rotation_deg
    table.add_row("position, RMS", f"{result.rmse_position:.4g}", f"{position:.4g}", "scene unit")
    table.add_row("rotation, RMS", f"{result.rmse_rotation_deg:.4g}", f"{angle:.4g}", "deg")
    console.print(table)
    table = new_table()
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
    print_facts(
        console,
        [
            ("trials", f"{len(result.trials)}, of which {len(result.failed)} failed{more}"),
            ("noise", f"Gaussian, σ = {settings['sigma']:.4g}, of a camera that never saturates"),
            ("pixels", pixels_measured(settings["pixels"])),
            ("starts", f"within {settings['perturb_deg']:g} deg, {settings['perturb_trans']:g} scene units"),
            ("estimator", f"{settings['estimator']}, {paths_said(settings['spp'])}"),
            ("efficiency", f"{result.efficiency:.1%}"),
            (
                "renderer's noise",
                f"adds {result.excess:.1%} to the errors' covariance; freed of it: NEES "
                f"{result.renderer.freed.nees:.3f}; the bound's own: ± {result.renderer.uncertainty:.1%}",
            ),
        ],
    )
    if not overturned:
        print_line(console, verdict)
    print_notes(console, warnings)


def verdict_line(result: Validation) -> str:
    """What the errors say of the bound, in a sentence."""
    return {
        "consistent": "the errors are as the bound says",
        "inconsistent": "the errors are not as the bound says",
        "inconclusive": "inconclusive: the renderer's noise hides whether the errors are as the bound says; "
        + result.cure,
    }[result.verdict]


def _in_band(
    value: float, expected: float, low: float, high: float, inside: float | None = None
) -> tuple[str, str, str, Text]:
    """A value, what is expected, and whether it (or what should be inside) lies in a band."""
    good = low <= (value if inside is None else inside) <= high
    mark = Text("inside", style="green") if good else Text("outside", style="bold red")
    return f"{value:.3f}", f"{expected:g}", f"{low:.3f} to {high:.3f}", mark
