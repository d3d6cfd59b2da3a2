"""Where a photograph was taken from, on the terminal: the pose, what it is worth, and what else was tried."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.text import Text

from ..bound.cramer_rao import ALL_NUISANCES
from ..se3 import vector_from_pose
from .bound_table import pixels_measured, unobserved_facts
from .misspecified_table import print_beside, print_kinds
from .terminal import new_table, paths_said, print_facts, print_line, print_notes

if TYPE_CHECKING:
    from ..estimate.photograph import PhotographAlignment
    from ..se3 import Array

_COLOURS = ("red", "green", "blue")
_ORIGINS = {
    "given": "given",
    "residuals": "as large as the residuals",
    "held out": "as large as the residuals of the photographs held out",
}
"""Of the noise, by what the settings say."""
_LISTED = 12
"""Starts that are listed."""


def print_alignment(console: Console, result: PhotographAlignment, warnings: Iterable[str] = ()) -> None:
    """The verdict, the pose with its standard deviations, and what they rest on."""
    found, settings = result.alignment, result.settings
    (width, height), (across, down) = settings["size"], settings["photograph_size"]
    reduced = "" if (width, height) == (across, down) else f" of {across}×{down}"
    print_line(
        console,
        Text(Path(settings["photograph"]).name, style="bold"),
        f" in {Path(str(settings['scene'])).name}  {width}×{height}{reduced} pixels",
    )
    good = result.verdict == "aligned"
    print_line(console, Text(verdict_line(result), style="green" if good else "bold yellow"))
    print_beside(console, found.bound, found.misspecified, found.pose)
    print_facts(console, _facts(result))
    print_kinds(console, found.misspecified)
    if len(result.candidates) > 1:
        _print_candidates(console, result)
    print_notes(console, warnings)


def verdict_line(result: PhotographAlignment) -> str:
    """What became of the search, in a sentence."""
    found = result.alignment
    psnr = f"PSNR {result.psnr_db:.1f} dB, that of an even colour {result.even_psnr_db:.1f}"
    if result.verdict == "aligned":
        return f"aligned after {found.iterations} steps: {psnr}"
    cure = "start nearer (--pose), from several places (--poses), or with more --levels"
    if result.verdict == "unlike":
        return f"converged where the scene is unlike the photograph ({psnr}): {cure}"
    ended = f"{found.status} after {found.iterations} steps; {psnr}"
    return f"not converged ({ended}), so that nothing is known of the pose: {cure}"


def pose_words(pose: Array) -> str:
    """Position and quaternion as `--pose` takes them."""
    return " ".join(f"{value:.9g}" for value in vector_from_pose(pose))


def _facts(result: PhotographAlignment) -> list[tuple[str, str]]:
    found, settings, measured = result.alignment, result.settings, result.measured
    rows = [("pose", f"{pose_words(found.pose)}  (x y z qx qy qz qw, world_from_camera)")]
    rows += unobserved_facts(found.bound)
    white = "display values, white is 1" if result.display else "linear values, white is 1"
    rows.append(("residual", f"RMS {found.rms:.4g} [{white}]"))
    rows += _tone(result)
    rows.append(("noise", f"{found.noise['description']}: {_ORIGINS[settings['noise']]}"))
    if result.held_out is not None:
        held = result.held_out
        rms = f"RMS {held.rms.min():.3g} to {held.rms.max():.3g}"
        rows.append(("held out", f"{len(held.names)} photographs at their given poses, {rms}"))
    if found.misspecified is not None:
        rows.append(("residuals", found.misspecified.residuals))
    counts = {"masked": measured.masked, "saturated": measured.saturated, "invalid": found.invalid}
    without = ", ".join(f"{name} {count}" for name, count in counts.items() if count)
    pixels = pixels_measured(vars(found.bound.information.selection))
    rows.append(("pixels", pixels + (without and f"; left out: {without}")))
    rows.append(
        (
            "estimator",
            f"{settings['estimator']}, {settings['levels']} reduced images, {_renders(result)}",
        )
    )
    return rows


def _renders(result: PhotographAlignment) -> str:
    spp = result.settings["spp"]
    noise = f", whose noise adds {result.alignment.excess:.1%} to the covariance" if spp else ""
    return paths_said(spp) + noise


def _tone(result: PhotographAlignment) -> list[tuple[str, str]]:
    """Gain and black, and what not knowing them costs."""
    tone = result.alignment.tone
    if tone.kind == "known":
        return []
    if tone.kind == "common":
        values = f"gain {tone.gain[0]:.4g}, black {tone.black[0]:.4g}, of all channels"
    else:
        pairs = zip(_COLOURS, tone.gain, tone.black, strict=True)
        values = ", ".join(f"{name} {gain:.4g} and {black:.4g}" for name, gain, black in pairs)
        values = f"gain and black: {values}"
    known = result.alignment.bound.if_known
    both = (result.alignment.bound, known[ALL_NUISANCES])
    unknown, without = ([*bound.position_std, *bound.rotation_std_deg] for bound in both)
    ratios = [a / b for a, b in zip(unknown, without, strict=True) if math.isfinite(a) and b > 0.0]
    cost = f"; not knowing them costs up to × {max(ratios):.2f} in 1σ" if ratios else ""
    return [("tone", values + cost)]


def _print_candidates(console: Console, result: PhotographAlignment) -> None:
    print_line(console, f"Starts, by what is left on the last reduced image; of {len(result.candidates)}:")
    table = new_table()
    table.add_column("start")
    for head in ("residual RMS", "moved by", "turned by"):
        table.add_column(head, justify="right")
    table.add_column("search")
    for candidate in result.candidates[:_LISTED]:
        distance, angle = candidate.moved
        rms = f"{candidate.rms:.4g}" if math.isfinite(candidate.rms) else ""
        table.add_row(Text(candidate.name), rms, f"{distance:.3g}", f"{angle:.3g}°", candidate.status)
    console.print(table)
    if len(result.candidates) > _LISTED:
        print_line(console, f"and {len(result.candidates) - _LISTED} more, in the file of --json")
