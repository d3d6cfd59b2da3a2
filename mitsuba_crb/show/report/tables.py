"""Tables of a page, from the documents: standard deviations with verdicts, facts, rows of anything."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ..terminal import number_by_verdict
from .markup import Markup, joined, tag

_POSITION = ("x", "y", "z")
_ROTATION = ("pitch", "yaw", "roll")
_ABOUT = ("x", "y", "z")


def number(value: Any) -> float:
    """Of a document, in which infinities are texts and what is no number is None."""
    return math.nan if value is None else float(value)


def verdict_mark(verdict: str) -> Markup:
    """A verdict as a badge."""
    return tag("span", verdict, class_=f"verdict {verdict.replace(' ', '-')}")


def deviations(document: Mapping[str, Any], owner: str = "camera") -> Markup:
    """The six standard deviations of a bound's document, with errors, units, frames and verdicts.

    Args:
        document: has `position_std` and its companions.
        owner: whose axes the rotations are about.
    """
    rows = []
    for kind, names, unit in (("position", _POSITION, "scene unit"), ("rotation", _ROTATION, "deg")):
        key = f"{kind}_std" if kind == "position" else f"{kind}_std_deg"
        columns = (key, f"{key}_standard_error", f"{kind}_verdict", f"{key}_lower_limit")
        for axis, (name, value, error, verdict, limit) in enumerate(
            zip(names, *(document[column] for column in columns), strict=True)
        ):
            written, beside = number_by_verdict(number(value), number(error), verdict, number(limit))
            words = f"position {name}" if kind == "position" else f"{name}, about {_ABOUT[axis]}"
            if verdict == "not resolved":
                beside = "at 99 %"
            rows.append(
                (
                    tag("th", words, scope="row"),
                    tag("td", "∞" if verdict == "unseen" else written, class_="number"),
                    tag("td", beside, class_="number"),
                    tag("td", unit),
                    tag("td", verdict_mark(verdict)),
                )
            )
    heads = ("", "1σ bound", "± its error", "unit", "verdict")
    caption = (
        "No unbiased estimator has smaller standard deviations than these: position along the world's axes, "
        f"rotation about the {owner}'s own (x left, y up, z forward)."
    )
    return table(heads, rows, caption=caption)


def table(heads: Sequence[str], rows: Sequence[Sequence[Markup]], *, caption: str, id_: str = "") -> Markup:
    """A table of cells; `caption` says what it is. Heads stand over numbers as these do, at the right."""
    below = rows[0] if rows else [Markup("")] * len(heads)
    columns = [
        (head, {"class_": "number"} if 'class="number"' in cell else {})
        for head, cell in zip(heads, below, strict=True)
    ]
    return tag(
        "div",
        tag(
            "table",
            tag("caption", caption),
            tag("thead", tag("tr", *(tag("th", head, scope="col", **where) for head, where in columns))),
            tag("tbody", *(tag("tr", *row) for row in rows)),
            id=id_ or None,
            class_="dense" if len(heads) > 6 else None,
        ),
        class_="scroll",
        tabindex=0,
        role="region",
        aria_label=caption,
    )


def cells(values: Sequence[object], *, numbers: bool = True) -> list[Markup]:
    """A row: its first value is a heading, the others are numbers or texts."""
    first, *rest = values
    return [
        tag("th", first, scope="row"),
        *(tag("td", value, class_="number" if numbers else None) for value in rest),
    ]


def facts(rows: Sequence[tuple[str, str]]) -> Markup:
    """Names and values."""
    return tag(
        "dl", joined(*(joined(tag("dt", name), tag("dd", value)) for name, value in rows)), class_="facts"
    )


def significant(value: float, digits: int = 3) -> str:
    """A number as one writes it."""
    if math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    return f"{value:.{digits}g}".replace("e-0", "e-").replace("-", "−")
