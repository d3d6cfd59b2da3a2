"""The report of `mitsuba-crb bound` at many poses: the path in the world, and a row for each pose."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...files import jsonable
from ..terminal import number_by_verdict
from .charts import along_path
from .ellipsoids import Ellipsoid
from .layers import sight_layers
from .markup import Markup, tag
from .page import Origin, Page, section, side_by_side, write_page
from .space import space
from .tables import number, table
from .viewers import chart_place, picture_viewer, space_viewer

if TYPE_CHECKING:
    from ...measure.outlook import Outlook
    from ...measure.pose_table import PoseTable

_AXES = (
    *(f"position_std_{axis}" for axis in "xyz"),
    *(f"rotation_std_deg_{axis}" for axis in ("pitch", "yaw", "roll")),
)
_DRAWN = 400
"""Ellipsoids, at most."""
_ROWS = 2000
"""Of the table, at most."""


def write_poses_report(path: Path, table: PoseTable, outlook: Outlook, origin: Origin) -> None:
    """Write the page of many bounds.

    Args:
        path: the file.
        table: of at least one row.
        outlook: the world and the cameras of the rows, in their order.
        origin: the command.

    Raises:
        OutputError: plotly is not installed.
    """
    write_page(path, poses_page(table, outlook), origin)


def poses_page(table_: PoseTable, outlook: Outlook) -> Page:
    """The page of many bounds; arguments as of `write_poses_report`."""
    rows = [jsonable(row.columns()) for row in table_.rows]
    step = -(-len(rows) // _DRAWN)
    ellipsoids = [_ellipsoid(row) for index, row in enumerate(rows) if index % step == 0]
    view = space(outlook, ellipsoids, path=True, value_title="1σ of position, all axes together [scene unit]")
    position = [_norm(row, _AXES[:3]) for row in rows]
    rotation = [_norm(row, _AXES[3:]) for row in rows]
    names = [row["name"] for row in rows]
    charts = {
        "position": along_path(table_.places, names, position, label="position [scene unit]"),
        "rotation": along_path(table_.places, names, rotation, label="rotation [deg]"),
    }
    layers = sight_layers(outlook.sights, small=True)
    pictured = [index for index, sight in enumerate(outlook.sights) if sight.image is not None]
    lost = len(table_.lost)
    summary = [f"{len(rows)} poses", f"{lost} not of rank 6" if lost else "all of rank 6"]
    words = "" if step == 1 else f" Every {step}th ellipsoid is drawn."
    cut = f" The first {_ROWS} of {len(rows)} rows; --csv has all." if len(rows) > _ROWS else ""
    left = [section("Along the path", *(chart_place(key, each["alt"]) for key, each in charts.items()))]
    right = []
    if layers:
        right.append(section("Renders", picture_viewer("path", layers, label="Render at a pose")))
    sections = [
        side_by_side(left, right),
        section(
            "In the world",
            space_viewer(view),
            tag("p", words, class_="muted") if words else None,
            kind="wide",
        ),
        section(
            "Poses",
            tag("p", f"Choose a pose to show it in the world.{cut}", class_="muted"),
            _table(rows[:_ROWS]),
            kind="wide",
        ),
    ]
    blind = dict.fromkeys(text for row in table_.rows for text in row.no_bound)
    other = dict.fromkeys(text for row in table_.rows for text in row.notes)
    notes = [("bad", f"no bound: {text}") for text in blind] + [("note", text) for text in other]
    if table_.interrupted:
        notes.insert(0, ("bad", f"interrupted: {len(rows)} of {table_.asked} poses are done"))
    name = Path(str(table_.settings.get("scene", ""))).name
    data = {"space": view, "charts": charts, "images": {"path": layers}, "pictured": pictured}
    return Page(name, summary, sections, notes, data)


def _ellipsoid(row: dict[str, Any]) -> Ellipsoid:
    keys = [f"ellipsoid_{k}" for k in (1, 2, 3)]
    return Ellipsoid(
        row["name"],
        np.array([row[axis] for axis in "xyz"], dtype=np.float64),
        np.array([number(row[key]) for key in keys]),
        np.array([[number(row[f"{key}_{axis}"]) for axis in "xyz"] for key in keys]),
        [row[f"{key}_verdict"] for key in keys],
        _norm(row, _AXES[:3]),
    )


def _norm(row: dict[str, Any], keys: tuple[str, ...]) -> float:
    return math.hypot(*(number(row[key]) for key in keys))


def _table(rows: list[dict[str, Any]]) -> Markup:
    heads = ("pose", "rank", "x", "y", "z", "pitch", "yaw", "roll", "not seen")
    written = []
    for index, row in enumerate(rows):
        button = tag(
            "button", row["name"], type="button", class_="pose", data_pose=index, aria_pressed="false"
        )
        written.append(
            [
                tag("th", button, scope="row"),
                tag("td", f"{row['rank']} of 6", class_="number"),
                *(_cell(row, axis) for axis in _AXES),
                tag("td", row["not_seen"], class_="words"),
            ]
        )
    caption = (
        "1σ bounds with their errors: position [scene unit] along world axes, rotation [deg] about camera "
        "axes; ∞: unseen, > X: not resolved, larger than X at 99 %"
    )
    return table(heads, written, caption=caption, id_="poses")


def _cell(row: dict[str, Any], axis: str) -> Markup:
    verdict = row[f"{axis}_verdict"]
    value, beside = number_by_verdict(
        number(row[axis]), number(row[f"{axis}_error"]), verdict, number(row[f"{axis}_lower_limit"])
    )
    if verdict == "seen":
        return tag("td", value, tag("small", f" {beside}"), class_="number")
    words = "∞" if verdict == "unseen" else value
    return tag("td", words, title=verdict, class_=f"number {verdict.replace(' ', '-')}")
