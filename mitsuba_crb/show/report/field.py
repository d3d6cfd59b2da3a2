"""The report of `mitsuba-crb field`: how the bounds are spread, over the floor plan, and in the world."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...measure.outlook import Sight
from ...planning.marks import Marks, marks_of
from ...planning.plan_values import SHOWN, WORDS
from ..field_table import PERCENTILE_HEADS, field_facts, percentile_rows
from .field_colours import MARKS, colour_scale, logarithms
from .field_maps import MOST_CELLS, field_maps
from .markup import Markup, tag
from .page import Origin, Page, section, side_by_side, write_page
from .space import space
from .tables import cells, facts, significant, table
from .traces import lines, scatter
from .viewers import chart_place, space_viewer

if TYPE_CHECKING:
    from ...measure.outlook import Outlook
    from ...planning.floor_plan import FloorPlan
    from ...planning.view_field import ViewField

_ENDS = 8
"""Of the best and of the worst places, in the table."""
_ARROW = 0.4
"""Of the distance to the next mark."""
_DIGITS = 6


def write_field_report(
    path: Path, field: ViewField, outlook: Outlook, outlines: FloorPlan | None, origin: Origin
) -> None:
    """Write the page of a field of views.

    Args:
        path: the file.
        field: at least one view.
        outlook: of `field_outlook`.
        outlines: of what stands there; None: nothing is known.
        origin: the command.

    Raises:
        OutputError: plotly is not installed.
    """
    write_page(path, field_page(field, outlook, outlines), origin)


def field_page(field: ViewField, outlook: Outlook, outlines: FloorPlan | None) -> Page:
    """The page of a field of views; arguments as of `write_field_report`."""
    marks = marks_of(field)
    corners = outlook.sights[0].corners
    sights = tuple(Sight(f"view {view}", field.poses[view], corners) for view in marks.views)
    view = space(
        replace(outlook, sights=sights), [], drawn=0, more=mark_traces(field, marks), about=about_marks(marks)
    )
    charts = field_maps(field, outlines)
    words = "Best of all directions and heights at each position."
    if not charts:
        words = f"More than {MOST_CELLS} positions are too many for a page; --plot draws them."
    maps = [chart_place(key, each["alt"]) for key, each in charts.items()]
    sections = [
        side_by_side(
            [section("How the bounds are spread", _percentiles(field), facts(field_facts(field)))],
            [section("Best and worst places", _ends(field, marks))],
        ),
        section(
            "Over the floor plan",
            tag("p", words, class_="muted"),
            tag("div", *maps, class_="maps") if maps else None,
            kind="wide",
        ),
        section("In the world", space_viewer(view), kind="wide"),
    ]
    name = Path(str(field.settings.get("scene", ""))).name
    done = int(field.done.sum())
    summary = [f"{len(field)} views", f"{marks.places} places", f"{int(field.usable.sum())} measured"]
    notes = []
    if field.interrupted:
        notes.append(("bad", f"{done} of {len(field)} views are done; the same command goes on from there"))
    blind = int((field.values("no_bound")[field.usable] == 1).sum())
    if blind:
        notes.append(("bad", f"no bound: at {blind} views the method cannot see something of the scene"))
    return Page(name, summary, sections, notes, {"space": view, "charts": charts, "images": {}})


def mark_traces(field: ViewField, marks: Marks, first: int = 0) -> list[Any]:
    """The marks, coloured by the best position bound, and where the best view of each looks.

    Args:
        field: the views.
        marks: of them.
        first: of the page's cameras, which one is the first mark's.
    """
    best = marks.best
    levels = logarithms(best.values)
    traces = []
    for kind, (symbol, colour) in {SHOWN: ("circle", ""), **MARKS}.items():
        (which,) = np.nonzero(best.kind == kind)
        if not len(which):
            continue
        style: dict[str, Any] = {"symbol": symbol, "color": colour, "size": 5}
        if kind == SHOWN:
            scale = colour_scale(levels, "1σ bound of position, best direction [scene unit]")
            low, high = scale.pop("ends")
            scale["colorbar"] |= {"len": 0.7}
            style = {"color": levels[which], "cmin": low, "cmax": high, "size": 7.5, **scale}
        traces.append(
            scatter(
                best.positions[which],
                mode="markers",
                name=WORDS.get(kind, "places"),
                marker={**style, "line": {"width": 0}},
                text=[_hover(field, marks, int(k)) for k in which],
                customdata=[[first + int(k)] for k in which],
                hovertemplate="%{text}<extra></extra>",
            )
        )
    (shown,) = np.nonzero(best.kind == SHOWN)
    if len(shown):
        start = best.positions[shown]
        ends = start + _ARROW * _apart(best.positions) * field.poses[best.view[shown], :3, 2]
        arrows = np.stack([start, ends, np.full_like(start, np.nan)], axis=1).reshape(-1, 3)
        traces.append(lines(arrows, {"color": "#64748b", "width": 2}, name="best direction to look"))
    return traces


def _apart(positions: Any) -> float:
    """How far marks are from the nearest other one, in the middle."""
    from scipy.spatial import cKDTree

    if len(positions) < 2:
        return 1.0
    return float(np.median(cKDTree(positions).query(positions, k=2)[0][:, 1]))


def _hover(field: ViewField, marks: Marks, k: int) -> str:
    """What is said of a mark, of its best view if there is one."""
    view, count = int(marks.views[k]), int(marks.count[k])
    x, y, z = (f"{value:.4g}" for value in marks.best.positions[k])
    here = f"place {field.place[view]} at ({x}, {y}, {z}), {count} view{'s' * (count > 1)}"
    if marks.best.kind[k] != SHOWN:
        return f"{here}<br>{WORDS[int(marks.best.kind[k])]}"
    return (
        f"{here}<br>best: view {view}, heading {field.heading[view]}"
        f"<br>position {significant(field.position_bound[view], _DIGITS)} scene units"
        f"<br>rotation {significant(field.rotation_bound_deg[view], _DIGITS)}°"
        f"<br>rank {field.rank[view]} of 6"
    )


def about_marks(marks: Marks) -> str:
    """What they are, a sentence without its full stop."""
    drawn = len(marks.views)
    if marks.side == 0.0:
        return f"{drawn} places, coloured by the best direction's position bound"
    return (
        f"{drawn} of {marks.places} places, coloured by the best direction's position bound: of those in one "
        f"cube of {marks.side:.3g} scene units the best is drawn"
    )


def _percentiles(field: ViewField) -> Markup:
    rows = [cells([name, *(significant(float(v)) for v in found)]) for name, found in percentile_rows(field)]
    caption = "Bounds of the views that were measured, all three axes together; ∞: not finite"
    return table(("", *PERCENTILE_HEADS), rows, caption=caption)


def _ends(field: ViewField, marks: Marks) -> Markup:
    """The first and the last of the marks that have a number."""
    known = int((marks.best.kind == SHOWN).sum())
    if not known:
        return tag("p", "No place has a view with a finite position bound.")
    chosen = [*range(min(_ENDS, known)), *range(max(known - _ENDS, min(_ENDS, known)), known)]
    rows = []
    for k in chosen:
        view = int(marks.views[k])
        button = place_button(str(field.place[view]), k)
        position, rotation = field.position_bound[view], field.rotation_bound_deg[view]
        at = ", ".join(f"{value:.3g}" for value in marks.best.positions[k])
        rows.append(
            [
                tag("th", button, scope="row"),
                tag("td", at, class_="number"),
                *(tag("td", significant(float(v)), class_="number") for v in (position, rotation)),
                tag("td", f"{field.rank[view]} of 6", class_="number"),
            ]
        )
    caption = (
        f"The {_ENDS} best and {_ENDS} worst by the position bound of the best direction there [scene unit], "
        "with its rotation bound [deg]; choose one to show it in the world"
    )
    return table(("place", "at", "position", "rotation", "rank"), rows, caption=caption, id_="poses")


def place_button(words: str, sight: int) -> Markup:
    """What shows one of the page's cameras in the world."""
    return tag("button", words, type="button", class_="pose", data_pose=sight, aria_pressed="false")
