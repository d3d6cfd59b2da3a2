"""A field of views on the terminal: how many views see how much, and how the bounds are spread."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.text import Text

from ..planning.layout import MEASUREMENTS
from ..planning.view_field import ViewField
from ..se3 import Array
from .terminal import new_table, print_facts, print_line, print_notes

_PERCENTILES = (5, 25, 50, 75, 95)
PERCENTILE_HEADS = tuple("median" if p == 50 else f"{p} %" for p in _PERCENTILES)
"""Of what `percentile_rows` has."""


def print_field(console: Console, field: ViewField, source: str = "", notes: Sequence[str] = ()) -> None:
    """What became of the views, their ranks, and percentiles of the bounds.

    Args:
        console: where to.
        field: all of it, or what has been measured.
        source: a line on where the views come from, above it all.
        notes: what was warned of.
    """
    if source:
        print_line(console, source)
    scene = Text(str(field.settings.get("scene", "")).rpartition("/")[2], style="bold")
    done, usable = field.done, field.usable
    print_line(
        console,
        scene,
        f"  {int(done.sum())} of {len(field)} views" if field.interrupted else f"  {len(field)} views",
    )
    blind = int((field.values("no_bound")[usable] == 1).sum())
    if blind:
        print_line(
            console,
            Text("no bound: ", style="bold red"),
            f"at {blind} of {int(usable.sum())} views the method cannot see something of the scene",
        )
    print_facts(console, field_facts(field))
    table = new_table()
    table.add_column("all three together")
    for head in PERCENTILE_HEADS:
        table.add_column(head, justify="right")
    for name, found in percentile_rows(field):
        table.add_row(name, *(f"{value:.3g}" if np.isfinite(value) else "∞" for value in found))
    if usable.any():
        console.print(table)
    print_notes(console, notes)


def percentile_rows(field: ViewField) -> list[tuple[str, Array]]:
    """How the bounds of the views that were measured are spread; nothing if there are none."""
    usable = field.usable
    return [
        # Of the sorted, not in between: beside an infinite bound there is no number.
        (name, np.percentile(values[usable], _PERCENTILES, method="lower"))
        for name, values in (
            ("position std [scene unit]", field.position_bound),
            ("rotation std [deg]", field.rotation_bound_deg),
        )
        if usable.any()
    ]


def field_facts(field: ViewField) -> list[tuple[str, str]]:
    """What became of the views, the ranks, the share below the limit, and what it took."""
    done = field.done
    words = MEASUREMENTS["status"].flags
    count = max(1, int(done.sum()))
    status = [
        f"{word} {n} ({n / count:.0%})"
        for code, word in enumerate(words)
        if code and (n := int((field.status[done] == code).sum()))
    ]
    ranks = [
        f"{rank} at {n}" for rank in range(6, -1, -1) if (n := int((field.rank[field.usable] == rank).sum()))
    ]
    paths, seconds = _total(field, "paths"), _total(field, "seconds")
    spent = f"{seconds:.3g} s of all workers together" + (f", {paths:.3g} paths" if paths else "")
    facts = [("views", ", ".join(status) or "none done"), ("rank", ", ".join(ranks) or "of none")]
    limit: Any = field.settings.get("limit")
    if limit is not None:
        below = int((field.position_bound[field.usable] < limit).sum())
        facts.append(
            ("limit", f"position std below {limit:g} at {below} of {int(field.usable.sum())} measured")
        )
    return [*facts, ("spent", spent)]


def _total(field: ViewField, name: str) -> float:
    return float(np.sum(field.values(name)[field.done]))
