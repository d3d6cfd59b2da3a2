"""Plans over a field of views on the terminal: the views to take next, and a path under a limit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.text import Text

from ..planning.next_view import ONE_BODY
from ..planning.path_search import STANDARD_ERRORS
from .terminal import new_table, print_facts, print_line, print_notes

if TYPE_CHECKING:
    from ..planning.next_view import NextViews
    from ..planning.path_search import PathPlan
    from ..planning.view_field import ViewField
    from ..se3 import Array

_SHOWN = 40
"""Steps of a path that the table has, at most."""


def print_next_views(console: Console, store: Path, field: ViewField, result: NextViews) -> None:
    """The views in their order with the bound after each, and what is certain of the choice."""
    print_line(
        console,
        Text(store.name, style="bold"),
        f"  {len(result.chosen)} of {result.usable} usable views, {len(result.have)} taken before",
    )
    print_line(console, f"Bounds are of {ONE_BODY}.")
    table = new_table()
    table.add_column("")
    for head in ("view", "place", "at", "position", "rotation", "rank"):
        table.add_column(head, justify="right", no_wrap=True)
    for k in range(len(result.chosen) + 1):
        which = ["before", "", "", ""]
        if k:
            view, pose = result.chosen[k - 1], result.poses[k - 1]
            which = [str(k), str(view), str(field.place[view]), _point(pose[:3, 3])]
        table.add_row(
            *which,
            _with_error(result.position_bound[k], result.position_bound_standard_error[k]),
            _with_error(result.rotation_bound_deg[k], result.rotation_bound_deg_standard_error[k]),
            str(result.rank[k]),
        )
    console.print(table)
    print_facts(console, next_views_facts(result))
    print_notes(console, next_views_notes(field, result))


def next_views_facts(result: NextViews) -> list[tuple[str, str]]:
    """What the numbers of the table are, and what is certain of the choice."""
    guarantee = "nothing" if result.guarantee is None else f"{result.guarantee:.1%}"
    facts = [
        ("position", "root of the trace, at the centroid of the cameras so far [scene unit]"),
        ("rotation", "likewise, of the body [deg]"),
        (
            result.objective,
            f"{_number(result.value_empty)} before, {_number(result.value)} with them; no choice has more "
            f"than {_number(result.upper_bound)}",
        ),
        ("certificate", f"{result.certificate:.1%} of the best gain; beforehand certain: {guarantee}"),
        (
            "length scale",
            f"{result.length_scale:.4g} scene units, the usable views' median; a ridge of {result.ridge:.3g} "
            "is added to what is known, in the choice alone",
        ),
    ]
    if result.objective != "logdet":
        facts.append(("about", f"the centroid of the usable views' cameras, {_point(result.body[:3, 3])}"))
    return facts


def print_path(console: Console, store: Path, field: ViewField, result: PathPlan) -> None:
    """The path step by step and what it keeps to, or that there is none and which limit would have one."""
    print_line(
        console,
        Text(store.name, style="bold"),
        f"  from place {result.start} to place {result.goal}, position bound at most {result.limit:.4g} "
        "[scene unit]",
    )
    if not result.found:
        print_line(console, Text(no_path(result), style="bold red"))
    else:
        _print_steps(console, result)
    print_facts(console, path_facts(result))
    print_notes(console, path_notes(field, result))


def path_facts(result: PathPlan) -> list[tuple[str, str]]:
    """How long it is, and what its bounds are."""
    longer = f", {result.length / result.shortest - 1.0:.1%} longer" if result.shortest > 0.0 else ""
    facts = []
    if result.found:
        facts.append(
            ("length", f"{result.length:.4g} scene units; without the limit {result.shortest:.4g}{longer}")
        )
        facts.append(("largest bound", f"{result.smallest_limit:.4g} scene units"))
    elif math.isfinite(result.shortest):
        facts.append(("shortest", f"{result.shortest:.4g} scene units without any limit"))
    facts.append(("bound", _rule(result)))
    facts.append(
        ("neighbours", f"{result.neighbourhood}; walls thinner than that between two places are not known of")
    )
    return facts


def next_views_notes(field: ViewField, result: NextViews) -> list[str]:
    """What is to be known of the views."""
    return _no_bound(field, (*result.have, *result.chosen))


def path_notes(field: ViewField, result: PathPlan) -> list[str]:
    """What is to be known of the search, and of the views."""
    return [*_notes(result), *_no_bound(field, result.views)]


def _print_steps(console: Console, result: PathPlan) -> None:
    centres = result.poses[:, :3, 3]
    gone = _distances(centres)
    table = new_table()
    heads = ["place", "view", "x", "y", "z", "gone"]
    heads += ["position"] if result.odometry is None else ["on arrival", "with the view"]
    for head in heads:
        table.add_column(head, justify="right")
    count = len(result.views)
    skipped = range(_SHOWN // 2, count - _SHOWN // 2)
    for k in range(count):
        if k in skipped and len(skipped) > 1:
            if k == skipped[0]:
                table.add_row("…", *[""] * (len(heads) - 1))
            continue
        bounds = [result.after[k]] if result.odometry is None else [result.before[k], result.after[k]]
        table.add_row(
            str(result.places[k]),
            str(result.views[k]),
            *(f"{value:.4g}" for value in (*centres[k], gone[k])),
            *map(_number, bounds),
        )
    console.print(table)


def _distances(centres: Array) -> Array:
    """(m,), how far each point of a path is from its start along it."""
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    return np.concatenate([np.zeros(1), np.cumsum(steps)])


def no_path(result: PathPlan) -> str:
    """That there is none, and which limit has one."""
    if not math.isfinite(result.smallest_limit):
        return "No path at any limit."
    none = "No path with this limit was found" if result.dropped else "No path with this limit"
    least = (
        "one that has one, though a smaller one may" if result.dropped_below else "the smallest that has one"
    )
    return f"{none}; {least}: {result.smallest_limit:.6g} scene units."


def _rule(result: PathPlan) -> str:
    if result.odometry is None:
        return (
            f"root of the trace of each view's own position covariance, {STANDARD_ERRORS:g} standard errors "
            "added, of the best direction at each place; what is not resolved is not passed"
        )
    known = result.odometry
    turns = f", {known.turn_deg:g}°/√rad of turns" if known.turn_deg else ""
    return (
        "root of the trace of the position covariance, predicted from place to place and updated by one view "
        f"at each; odometry {known.translation:g} scene units and {known.rotation_deg:g}° per root of a "
        f"scene unit{turns}"
    )


def _notes(result: PathPlan) -> list[str]:
    if not result.dropped:
        return []
    if result.found:
        return [
            f"a heuristic: {result.dropped} labels were left out, and a path may be shorter, though not than "
            f"{result.length_lower_limit:.4g} scene units; --labels keeps more"
        ]
    return [f"a heuristic: {result.dropped} labels were left out, and a path may exist; --labels keeps more"]


def _no_bound(field: ViewField, views: Sequence[int]) -> list[str]:
    """What is to be said of views that a method does not see wholly."""
    blind = [view for view in views if field.values("no_bound")[view]]
    if not blind:
        return []
    return [
        f"no bound: the method cannot see something at {len(blind)} of these views, the first is {blind[0]}"
    ]


def _point(point: Array) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in point) + ")"


def _with_error(value: float, error: float) -> str:
    return _number(value) if math.isnan(error) else f"{value:#.3g} ± {error:.1g}"


def _number(value: float) -> str:
    if math.isnan(value):
        return ""
    return f"{value:.4g}" if math.isfinite(value) else str(value).replace("inf", "∞")
