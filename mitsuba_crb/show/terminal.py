"""What a run says on the terminal, piece by piece: lines, tables, facts, notes, numbers, a progress bar."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from ..measure.adaptive import Round

_UNSEEN = "∞ (unseen)"
_DIGITS = 6
"""After the first, the most that a value with a small error is given."""


def new_table() -> Table:
    """An empty table in the look that all have."""
    return Table(box=box.SIMPLE_HEAD, pad_edge=False, header_style="bold")


def print_line(console: Console, *parts: str | Text) -> None:
    """One line of some parts."""
    # soft_wrap: a long line stays one line for grep and for the terminal's own wrapping
    console.print(Text.assemble(*parts), soft_wrap=True, highlight=False)


def print_facts(console: Console, rows: list[tuple[str, str]]) -> None:
    """Names and values, a line each, the values below each other."""
    width = max(len(name) for name, _ in rows)
    for name, value in rows:
        print_line(console, Text(f"{name:<{width}}  ", style="dim"), value)


def paths_said(spp: float) -> str:
    """How many paths an estimator's renders have; none where nothing is random."""
    return f"{spp} paths per pixel" if spp else "deterministic renders"


def print_notes(console: Console, warnings: Iterable[str]) -> None:
    """What was warned of, a line each."""
    for warning in warnings:
        print_line(console, Text("note: ", style="bold yellow"), " ".join(str(warning).split()))


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
    small = last < exponent - _DIGITS  # nobody reads so many digits
    digits = max(0, min(12, shift - (exponent - _DIGITS if small else last)))
    suffix = f"e{shift:+03d}" if shift else ""
    written = f"{value / 10.0**shift:.{digits}f}{suffix}"
    if small:
        return written, f"± {error:.1e}"
    return written, f"± {error / 10.0**shift:.{digits}f}{suffix}" if known else "± unknown"


class Bar:
    """A bar of progress that is shown."""

    def __init__(self, bar: Progress, task: TaskID) -> None:
        """At its beginning."""
        self._bar, self._task, self._doing = bar, task, "measuring"

    def __call__(self, done: int, total: int) -> None:
        """So much of so much is done."""
        self._bar.update(self._task, description=self._doing, completed=done, total=total)

    def say(self, doing: str) -> None:
        """What is being done, from the next advance on."""
        self._doing = doing

    def after(self, found: Round) -> None:
        """What a round came to, while the next one is on its way."""
        known = f"± {100 * found.precision:.2g} %" if math.isfinite(found.precision) else "nothing"
        hidden = f", {found.hidden} not resolved" if found.hidden else ""
        self._doing = f"{known} so far{hidden}; measuring"


def number_by_verdict(value: float, error: float, verdict: str, limit: float) -> tuple[str, str]:
    """The same of a standard deviation that may be unseen or not resolved: its lower limit then."""
    if verdict == "seen":
        return number_with_error(value, error)
    least = "" if math.isinf(limit) else f"> {limit:.3g}"
    return (_UNSEEN, least) if verdict == "unseen" else (least, verdict)


@contextmanager
def progress() -> Iterator[Bar]:
    """A bar on standard error, on a terminal only."""
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
        yield Bar(bar, task)
