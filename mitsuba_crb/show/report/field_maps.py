"""Charts of a field of views seen from above: of each position in the plan the best of all directions.

The colour is the logarithm, what is under the pointer the store's number.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ...planning.plan_values import SHOWN, WORDS, PlanValues, Quantity, lattice, plan_values
from ...planning.plan_view import PlanView
from ...se3 import Array
from .charts import chart
from .field_colours import MARKS, colour_scale, logarithms
from .page import plotly_library

if TYPE_CHECKING:
    from ...planning.floor_plan import FloorPlan
    from ...planning.view_field import ViewField

MOST_CELLS = 40_000
"""Positions of a map, at most: three of them must not fill the page."""
_QUANTITIES: tuple[tuple[Quantity, str, str, str], ...] = (
    ("position", "Position bound", "scene unit", ".6g"),
    ("rotation", "Rotation bound", "deg", ".6g"),
    ("rank", "Rank", "of 6", ".0f"),
)
_WIDE = 300
"""Of a chart's plane, about [pixel]."""


def field_maps(field: ViewField, outlines: FloorPlan | None) -> dict[str, dict[str, Any]]:
    """Charts by their keys; none if there are too many positions for a page.

    Args:
        field: at least one view.
        outlines: of what stands there; None: nothing is known.
    """
    found: dict[str, dict[str, Any]] = {}
    for quantity, name, unit, form in _QUANTITIES:
        shown = plan_values(field, quantity)
        if len(shown.positions) > MOST_CELLS:
            return {}
        found[quantity] = _map(field, shown, name, unit, form, outlines)
    return found


def _map(
    field: ViewField, shown: PlanValues, name: str, unit: str, form: str, outlines: FloorPlan | None
) -> dict[str, Any]:
    go = plotly_library()
    plan = PlanView.of(field.up)
    first, second, _ = plan.names
    where = f"{first} %{{x:.4g}}, {second} %{{y:.4g}}"
    figure = go.Figure()
    number = shown.kind == SHOWN
    if number.any():
        hover = f"{where}: %{{customdata:{form}}} [{unit}]<extra></extra>"
        _add_numbers(figure, shown, unit == "of 6", f"1σ [{unit}]" if unit != "of 6" else "rank", hover)
    for kind, (symbol, colour) in MARKS.items():
        which = shown.kind == kind
        if which.any():
            x, y = shown.positions[which].T
            style = {"symbol": symbol, "color": colour, "size": 7}
            hover = f"{where}: {WORDS[kind]}<extra></extra>"
            figure.add_trace(
                go.Scatter(x=x, y=y, mode="markers", name=WORDS[kind], marker=style, hovertemplate=hover)
            )
    if outlines is not None:
        _add_outlines(figure, outlines.pieces)
    extent = np.ptp(shown.positions, axis=0)
    shape = float(extent[1] / extent[0]) if extent[0] > 0.0 else 2.0
    figure.update_xaxes(title=f"{first} [scene unit]", constrain="domain", showgrid=False)
    figure.update_yaxes(title=f"{second} [scene unit]", constrain="domain", showgrid=False)
    figure.update_yaxes(scaleanchor="x", autorange="reversed" if plan.mirrored(field.up) else True)
    figure.update_layout(title={"text": f"{name}, best direction", "font": {"size": 14}, "x": 0.02})
    alt = f"{name} over the floor plan, best direction at each of {len(number)} positions"
    if number.any():
        known = shown.values[number]
        alt += f", from {known.min():.3g} to {known.max():.3g} {unit}"
    counts = [(WORDS[kind], int((shown.kind == kind).sum())) for kind in MARKS]
    alt += "".join(f"; {words} at {count}" for words, count in counts if count)
    made = chart(figure, alt=alt, height=round(min(max(_WIDE * shape, 160), 560)) + 130)
    made["figure"]["layout"]["legend"] |= {"y": -0.25, "yanchor": "top"}
    made["figure"]["layout"]["margin"]["t"] = 40
    return made


def _add_numbers(figure: Any, shown: PlanValues, counts: bool, title: str, hover: str) -> None:
    """Cells of a grid, or marks where there is none."""
    go = plotly_library()
    number = shown.kind == SHOWN
    levels = np.where(number, shown.values, np.nan) if counts else logarithms(shown.values)
    style: dict[str, Any]
    if counts:
        bar = {"title": {"text": title}, "tickvals": list(range(7)), "thickness": 12}
        style = {"ends": (-0.5, 6.5), "colorscale": _steps(7), "colorbar": bar}
    else:
        style = colour_scale(levels, title)
    low, high = style.pop("ends")
    spacing = lattice(shown.positions)
    if spacing is None:
        x, y = shown.positions[number].T
        style |= {"color": levels[number], "cmin": low, "cmax": high, "size": 9}
        values = shown.values[number]
        figure.add_trace(
            go.Scatter(
                x=x,
                y=y,
                mode="markers",
                marker=style,
                customdata=values,
                hovertemplate=hover,
                showlegend=False,
            )
        )
        return
    low_end, high_end = shown.positions.min(axis=0), shown.positions.max(axis=0)
    column, row = np.rint((shown.positions - low_end) / spacing).astype(int).T
    cells = np.full((2, row.max() + 1, column.max() + 1), np.nan)
    cells[0, row, column], cells[1, row, column] = levels, np.where(number, shown.values, np.nan)
    x, y = (np.linspace(low_end[k], high_end[k], cells.shape[2 - k]) for k in (0, 1))
    figure.add_trace(
        go.Heatmap(
            x=x,
            y=y,
            z=cells[0],
            customdata=cells[1],
            zmin=low,
            zmax=high,
            hovertemplate=hover,
            hoverongaps=False,
            **style,
        )
    )


def _steps(count: int) -> list[tuple[float, str]]:
    """Colours without anything between them."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    colours = [to_hex(colour) for colour in colormaps["viridis"](np.linspace(0.0, 1.0, count))]
    return [(end / count, colour) for k, colour in enumerate(colours) for end in (k, k + 1)]


def _add_outlines(figure: Any, pieces: Sequence[Array]) -> None:
    """What stands at the cameras' height, and lower."""
    go = plotly_library()
    for some, width in zip(pieces, (1.6, 0.7), strict=False):
        ends = np.concatenate([some, np.full((len(some), 1, 2), np.nan)], axis=1).reshape(-1, 2)
        x, y = ends.T.astype(np.float32)
        style = {"color": "#111827" if width > 1.0 else "#4b5563", "width": width}
        figure.add_trace(
            go.Scatter(x=x, y=y, mode="lines", line=style, hoverinfo="skip", showlegend=False, name="outline")
        )
