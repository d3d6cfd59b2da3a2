"""The reports of `mitsuba-crb next-view` and `path`: what was chosen, among all places of the field."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...measure.outlook import Sight
from ...planning.marks import marks_of
from ...planning.next_view import ONE_BODY
from ..plan_table import next_views_facts, next_views_notes, no_path, path_facts, path_notes
from .charts import RED, along_path
from .field import about_marks, mark_traces, place_button
from .markup import Markup, tag
from .page import Origin, Page, section, side_by_side, write_page
from .space import space
from .tables import facts, significant, table
from .traces import lines
from .viewers import chart_place, space_viewer

if TYPE_CHECKING:
    from ...measure.outlook import Outlook
    from ...planning.next_view import NextViews
    from ...planning.path_search import PathPlan
    from ...planning.view_field import ViewField


def write_next_views_report(
    path: Path, store: Path, field: ViewField, result: NextViews, outlook: Outlook, origin: Origin
) -> None:
    """Write the page of chosen views.

    Args:
        path: the file.
        store: where the field is, for the title.
        field, result: what was chosen from, and what was.
        outlook: of `field_outlook`.
        origin: the command.

    Raises:
        OutputError: plotly is not installed.
    """
    names = [f"{k}: view {view}" for k, view in enumerate(result.chosen, 1)]
    names += [f"taken: view {view}" for view in result.have]
    view = _space(field, (*result.chosen, *result.have), names, outlook)
    rows = []
    for k, rank in enumerate(result.rank):
        first = tag("th", "before", scope="row")
        which = ["", ""]
        if k:
            chosen = result.chosen[k - 1]
            first = tag("th", place_button(str(k), k - 1), scope="row")
            which = [str(chosen), str(field.place[chosen])]
        numbers = (
            (result.position_bound[k], result.position_bound_standard_error[k]),
            (result.rotation_bound_deg[k], result.rotation_bound_deg_standard_error[k]),
        )
        rows.append(
            [
                first,
                *(tag("td", word, class_="number") for word in which),
                *(tag("td", _with_error(*each), class_="number") for each in numbers),
                tag("td", f"{rank} of 6", class_="number"),
            ]
        )
    caption = f"Bounds of {ONE_BODY}, with the views up to each: position [scene unit], rotation [deg]"
    heads = ("", "view", "place", "position", "rotation", "rank")
    sections = [
        side_by_side(
            [section("Next views", table(heads, rows, caption=caption, id_="poses"))],
            [section("What is certain", facts(next_views_facts(result)))],
        ),
        section("In the world", space_viewer(view), kind="wide"),
    ]
    notes = [("bad", text) for text in next_views_notes(field, result)]
    summary = [f"{len(result.chosen)} of {result.usable} usable views", f"{len(result.have)} taken before"]
    write_page(path, Page(store.name, summary, sections, notes, {"space": view, "images": {}}), origin)


def write_path_report(
    path: Path, store: Path, field: ViewField, result: PathPlan, outlook: Outlook, origin: Origin
) -> None:
    """Write the page of a path, or that there is none; arguments as of `write_next_views_report`."""
    names = [f"place {place}" for place in result.places]
    view = _space(field, result.views, names, outlook, [_line(result)])
    charts: dict[str, Any] = {}
    notes = [("note", text) for text in path_notes(field, result)]
    steps: list[Markup] = []
    if result.found:
        steps = [section("Steps", _steps(field, result))]
        charts["bound"] = along_path(
            range(len(names)), names, result.after.tolist(), label="position [scene unit]"
        )
    else:
        notes.insert(0, ("bad", no_path(result)))
    drawn = [chart_place(key, each["alt"]) for key, each in charts.items()]
    sections = [
        side_by_side([section("What it keeps to", *drawn, facts(path_facts(result)))], steps),
        section("In the world", space_viewer(view), kind="wide"),
    ]
    summary = [
        f"from place {result.start} to place {result.goal}",
        f"position bound at most {result.limit:.4g} scene units",
    ]
    data = {"space": view, "charts": charts, "images": {}}
    write_page(path, Page(store.name, summary, sections, notes, data), origin)


def _steps(field: ViewField, result: PathPlan) -> Markup:
    rows = []
    for k, (place, view) in enumerate(zip(result.places, result.views, strict=True)):
        at = ", ".join(f"{value:.3g}" for value in field.poses[view, :3, 3])
        bounds = (significant(float(result.before[k])), significant(float(result.after[k])))
        rows.append(
            [
                tag("th", place_button(str(place), k), scope="row"),
                *(tag("td", word, class_="number") for word in (str(view), at, *bounds)),
            ]
        )
    caption = "Position bound on arrival and with the view taken there [scene unit]; –: none by itself"
    return table(("place", "view", "at", "on arrival", "with the view"), rows, caption=caption, id_="poses")


def _line(result: PathPlan) -> Any:
    return lines(result.poses[:, :3, 3], {"color": RED, "width": 8}, name="path")


def _with_error(value: float, error: float) -> str:
    return f"{significant(value)} ± {significant(error, 1)}" if math.isfinite(error) else significant(value)


def _space(
    field: ViewField, views: Sequence[int], names: Sequence[str], outlook: Outlook, more: Sequence[Any] = ()
) -> dict[str, Any]:
    """Some views as cameras, then all places as marks."""
    marks = marks_of(field)
    corners = outlook.sights[0].corners
    sights = [Sight(name, field.poses[view], corners) for name, view in zip(names, views, strict=True)]
    sights += [Sight(f"view {view}", field.poses[view], corners) for view in marks.views]
    return space(
        replace(outlook, sights=tuple(sights)),
        [],
        drawn=len(views),
        more=[*mark_traces(field, marks, first=len(views)), *more],
        about=about_marks(marks),
    )
