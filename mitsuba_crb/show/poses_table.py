"""The bounds of many poses on the terminal: a row each, and what they have in common."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from ..bound.cramer_rao import LARGEST_RELATIVE_ERROR
from ..measure.exposure import RELATIVE_SIGMA
from ..measure.likeness import Likeness, unlike
from ..measure.options import PRECISION
from ..measure.pose_table import ranks
from ..measure.sensing import COLOUR, DEPTH
from .bound_table import DETERMINISTIC, lens
from .terminal import new_table, print_facts, print_line, print_notes

if TYPE_CHECKING:
    from ..measure.pose_table import PoseRow, PoseTable

_NAMED = 4
"""Names that a line lists."""
_WIDEST = 10_000
_LEAST_NAME = 6
_GAP = 3
_LEAST_WORDS = 20
"""Letters of a direction that are worth a column."""
_FILED_WORDS = 60
"""As many has it where the table goes into a file."""
_RARE = "rare paths decide"
_IN_ROWS = ("not resolved", "the bound on ", _RARE)
"""How the notes begin that the rows' numbers and the facts say as well."""


def print_poses(
    console: Console, table: PoseTable, source: str = "", scene_notes: Sequence[str] = ()
) -> None:
    """A row for every pose, then how they differ and what they rest on.

    Args:
        console: where to.
        table: of at least one row.
        source: lines on where the poses come from and in which convention, above it all.
        scene_notes: what was warned of before the first pose.
    """
    for line in source.splitlines():
        print_line(console, line)
    compared = [row for row in table.rows if not math.isnan(row.psnr_db)]
    if compared:
        print_line(console, *_likeness(compared, len(table.rows)))
    scene = Text(str(table.settings.get("scene", "")).rpartition("/")[2], style="bold")
    print_line(console, scene, _camera(table.rows), lens(table.settings), f"  {_poses(table.asked)}")
    for text, n in Counter(text for row in table.rows for text in row.no_bound).items():
        print_line(console, Text("no bound: ", style="bold red"), f"{text}{_times(n, len(table.rows))}")
    if table.interrupted:
        words = (
            f"{len(table.rows)} of {table.asked} poses are done; a file of --json or --csv goes on from them"
        )
        print_line(console, Text("interrupted: ", style="bold red"), words)
    print_line(
        console,
        "No unbiased estimator of a pose has smaller standard deviations than these (1σ): of position along "
        "world axes [scene unit], of rotation about camera axes [deg]",
    )
    _print_rows(console, table.rows)
    print_facts(console, _facts(table))
    notes = Counter(note for row in table.rows for note in row.notes if not note.startswith(_IN_ROWS))
    print_notes(console, scene_notes)
    print_notes(console, [f"{note}{_times(n, len(table.rows))}" for note, n in notes.most_common()])


def likeness_fault(found: list[Likeness]) -> str:
    """Why renders may be so unlike their photographs, in words; empty if they are not."""
    if not unlike(found):
        return ""
    psnr, even = (np.nanmedian(values) for values in zip(*found, strict=True))
    return (
        f"the renders are unlike the photographs (median PSNR {psnr:.1f} dB, an even colour's {even:.1f}): "
        "the poses may be inverted, have other axes (--convention), or be of another world or scale"
    )


def _likeness(rows: list[PoseRow], of: int) -> list[str | Text]:
    """The PSNR of the poses that have a photograph."""
    worst, median = min(rows, key=lambda row: row.psnr_db), np.median([row.psnr_db for row in rows])
    text = (
        f"PSNR of the render against the photograph: median {median:.1f} dB, worst {worst.psnr_db:.1f} dB at "
        f"{worst.name}"
    )
    if len(rows) < of:
        text += f" ({len(rows)} of {of} poses have one of the render's shape)"
    fault = likeness_fault([row.likeness for row in rows])
    return [text] if not fault else [text, Text(f"\n{fault}", style="bold red")]


def _print_rows(console: Console, rows: tuple[PoseRow, ...]) -> None:
    letters = max(len(row.name) for row in rows)
    shown = _rows(rows, letters, 3)
    needed = _width(console, shown)
    # What is not a terminal has no width: there names and numbers are whole, and words about a line of text.
    room = console.width if console.is_terminal else needed + _GAP + _FILED_WORDS
    if needed > room:
        needed = _width(console, _rows(rows, letters, 2, narrow=True))
        shown = _rows(rows, max(_LEAST_NAME, letters + room - needed), 2, narrow=True)
    elif room - needed - _GAP >= _LEAST_WORDS:
        shown = _rows(rows, letters, 3, room - needed - _GAP)
    own = console.width
    try:
        console.width = max(own, _width(console, shown))  # rather than numbers that are cut
        console.print(shown)
    finally:
        console.width = own


def _width(console: Console, table: Table) -> int:
    return console.measure(table, options=console.options.update(max_width=_WIDEST)).maximum


def _rows(
    rows: tuple[PoseRow, ...], letters: int, digits: int, words: int = 0, *, narrow: bool = False
) -> Table:
    """The table.

    Args:
        letters: that names have, the last ones.
        digits: of numbers.
        words: letters of the directions; 0 for no such column.
        narrow: whether columns stand close together.
    """
    shown = new_table()
    if narrow:
        shown.padding = (0, 0)
    shown.add_column("pose", no_wrap=True)
    for name in ("x", "y", "z", "pitch", "yaw", "roll", "±", "rank", "depth"):
        shown.add_column(name, justify="right", no_wrap=True)
    if words:
        shown.add_column("not seen, or weakest", no_wrap=True, overflow="ellipsis", max_width=words)
    for row in rows:
        values = [*row.position_std.tolist(), *row.rotation_std_deg.tolist()]
        limits = [*row.position_std_lower_limit.tolist(), *row.rotation_std_deg_lower_limit.tolist()]
        error = row.relative_standard_error
        cells = [
            Text(row.name if len(row.name) <= letters else f"…{row.name[1 - letters :]}"),
            *(_deviation(*one, digits) for one in zip(values, row.verdicts, limits, strict=True)),
            f"{100 * error:.2g} %" if math.isfinite(error) else "",
            str(row.rank) if row.rank == 6 else Text(str(row.rank), style="bold red"),
            f"{row.length_scale:.{digits}g}",
        ]
        shown.add_row(*cells, *([_direction(row)] if words else ()))
    return shown


def _deviation(value: float, verdict: str, limit: float, digits: int) -> str:
    if verdict == "seen":
        return f"{value:#.{digits}g}"
    return "∞" if verdict == "unseen" or not math.isfinite(limit) else f">{limit:.2g}"


def _direction(row: PoseRow) -> Text:
    if row.rank == 0:
        return Text("nothing" if set(row.verdicts) == {"unseen"} else "all not resolved", style="red")
    return Text(row.not_seen, style="red") if row.not_seen else Text(row.weakest.removeprefix("a "))


def _facts(table: PoseTable) -> list[tuple[str, str]]:
    rows, settings = table.rows, table.settings
    facts = [("rank", ranks(rows))]
    unresolved = [row.name for row in rows if "not resolved" in row.verdicts]
    unseen = [row.name for row in table.lost if "not resolved" not in row.verdicts]
    if unseen:
        facts.append(("not all seen", _listed(unseen)))
    if unresolved:
        facts.append(("not resolved", f"{_listed(unresolved)}: more paths would tell"))
    for name, unit, values in (
        ("position", "scene units", np.array([row.position for row in rows])),
        ("rotation", "deg", np.array([row.rotation_deg for row in rows])),
    ):
        seen = np.flatnonzero(np.isfinite(values))
        if seen.size:
            best, worst = seen[np.argmin(values[seen])], seen[np.argmax(values[seen])]
            facts.append(
                (
                    name,
                    f"median {np.median(values[seen]):.3g} {unit} (the three axes together), best "
                    f"{values[best]:.3g} at {rows[best].name}, worst finite {values[worst]:.3g} at "
                    f"{rows[worst].name}",
                )
            )
    rough = [row.name for row in rows if row.relative_standard_error > LARGEST_RELATIVE_ERROR]
    if rough:
        facts.append((f"± above {100 * LARGEST_RELATIVE_ERROR:.0f} %", _listed(rough)))
    rare = [row.name for row in rows if any(note.startswith(_RARE) for note in row.notes)]
    if rare:
        facts.append(("no error", f"{_listed(rare)}: rare paths decide there; more would tell"))
    facts.append(("noise", _noise(settings)))
    if settings.get("prior"):
        facts.append(("prior", "included"))
    if settings.get("nuisances"):
        facts.append(("not known either", ", ".join(settings["nuisances"])))
    if "method" in settings:
        facts.append(("method", f"{settings['method']}, {_paths(settings)}"))
    seconds = [row.seconds for row in rows if math.isfinite(row.seconds)]
    if seconds:
        facts.append(("time", f"{sum(seconds):.1f} s, {np.median(seconds):.2g} s for a pose (median)"))
    return facts


def _noise(settings: dict[str, Any]) -> str:
    measure = settings.get("measure", COLOUR)
    if measure == COLOUR:
        return _noise_of_colour(settings)
    given = settings.get("depth_sigma")
    text = "of depth: 0.01 of the depth" if given is None else f"of depth [scene unit]: {given}"
    return text if measure == DEPTH else f"{_noise_of_colour(settings)}; {text}"


def _noise_of_colour(settings: dict[str, Any]) -> str:
    white, given = settings.get("white"), settings.get("noise")
    if given is not None:
        return f"given: {', '.join(f'{name} {value}' for name, value in given.items())}"
    if white is None:
        white = settings.get("exposure")
    if not isinstance(white, float):
        return "an exposure for each pose"
    above = ", what is above is saturated" if settings.get("clip", True) else ""
    sigma = f"Gaussian, σ = {RELATIVE_SIGMA * white:.4g}: {RELATIVE_SIGMA:g} of white {white:.3g}"
    return f"{sigma}, one exposure for all poses{above}"


def _paths(settings: dict[str, Any]) -> str:
    if settings.get("deterministic"):
        return DETERMINISTIC
    seed = f"seed {settings['seed']}"
    if settings.get("spp") is not None:
        return f"{settings['spp']} paths per pixel in {settings['batches']} batches, {seed}"
    return f"as many paths as {100 * (settings.get('precision') or PRECISION):.3g} % take, {seed}"


def _listed(names: list[str]) -> str:
    more = ", …" if len(names) > _NAMED else ""
    return f"{_poses(len(names))} ({', '.join(names[:_NAMED])}{more})"


def _camera(rows: Sequence[PoseRow]) -> str:
    """Pixels and field of view, behind two blanks; what all have in common."""
    views = {(row.size, tuple(round(angle, 1) for angle in row.fov_deg)) for row in rows}
    if len(views) > 1:
        return "  several cameras"
    (((width, height), (across, down)),) = views
    return f"  {width}×{height} pixels  {across:.1f}°×{down:.1f}° field of view"


def _poses(n: int) -> str:
    return f"{n} pose{'s' * (n != 1)}"


def _times(n: int, of: int) -> str:
    return "" if of == 1 else f" (at {'all' if n == of else n} poses)" if n > 1 else " (at one pose)"
