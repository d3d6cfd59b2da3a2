"""Pages of a field of views: where a camera is located well, where to look next, which way to go.

All are plans seen from above, also of views around something (rings) and of a file's poses (a path): each
position has the best, or the worst, of all directions and heights there. On a grid a position is a cell, else
a disc.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ..files import atomic
from ..planning.floor_plan import FloorPlan, floor_plan
from ..planning.plan_values import PlanValues, Quantity, lattice, plan_values
from ..planning.plan_view import PlanView
from ..planning.world_at_hand import world_at_hand
from .field_map import (
    colours_of,
    draw_arrows,
    draw_next_views,
    draw_outlines,
    draw_path,
    draw_values,
    frame_plan,
    legend_of,
)
from .plot import MUTED

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ..planning.view_field import ViewField
    from ..se3 import Array

_QUANTITIES: tuple[tuple[Quantity, str, str], ...] = (
    ("position", "Position", "1σ bound of position [scene unit]"),
    ("rotation", "Rotation", "1σ bound of rotation [deg]"),
    ("rank", "Rank", "directions that are seen"),
)
_MARGIN = 0.1
"""Of the extent, beyond the outermost positions."""
_APART = 0.15
"""Of a colour bar: its ticks are as far apart."""
_PATHS = (("#d6006e", "-"), ("black", "--"), ("#1b7837", ":"), ("#e6550d", "-."))


def outlines_of(field: ViewField, world: Any = None) -> FloorPlan | None:
    """What stands among a field's positions, at the cameras' height and lower; None if nothing is known.

    Args:
        field: the views.
        world: that they are in; default: the one that they were measured in, if it is at hand.
    """
    shown = world_at_hand(field) if world is None else world
    if shown is None:
        return None
    heights = PlanView.of(field.up).height(field.poses[:, :3, 3])
    return floor_plan(shown, field.up, *_limits(field), float(np.median(heights)))


def field_figure(field: ViewField, outlines: FloorPlan | None = None) -> Figure:
    """Maps of the bounds on position and rotation and of the rank: above the best at each position, below the
    worst; arrows: where the best view looks.

    Args:
        field: at least one view.
        outlines: of what stands there, from `outlines_of`.
    """
    low, high = _limits(field)
    shape = (high[1] - low[1]) / (high[0] - low[0])
    width = 4.5 if shape < 1.4 else 3.6
    figure = _figure(3 * width, 2 * (width * min(max(shape, 0.35), 2.2) * 0.86 + 0.75) + 1.2)
    axes = figure.subplots(2, 3, sharex=True, sharey=True)
    everything: list[PlanValues] = []
    for column, (quantity, name, label) in enumerate(_QUANTITIES):
        best, worst = plan_values(field, quantity), plan_values(field, quantity, worst=True)
        cmap, norm = colours_of(quantity, np.concatenate([best.values, worst.values]))
        for ax, shown, words in zip(axes[:, column], (best, worst), ("best", "worst"), strict=True):
            _map(ax, field, shown, cmap, norm, outlines)
            ax.set_title(f"{name}, {words} direction", loc="left", fontsize=11)
        if quantity != "rank":
            draw_arrows(axes[0, column], field, best)
        everything += [best, worst]
        _colour_bar(figure, axes[:, column], cmap, norm, label)
    for ax in axes.flat:
        frame_plan(ax, field, low, high)
        ax.label_outer()
    arrow = Line2D([], [], marker=r"$\rightarrow$", ls="none", color="black", markersize=13)
    arrow.set_label("best direction to look")
    _legend(figure, [*legend_of(everything), arrow, *_outline_marks(outlines, field)])
    _title(figure, field)
    return figure


def next_views_figure(
    field: ViewField,
    chosen: Sequence[int],
    *,
    have: Sequence[int] = (),
    outlines: FloorPlan | None = None,
    fov_deg: float = 60.0,
) -> Figure:
    """The chosen views on the map of the best position bound.

    Args:
        field, outlines: as for `field_figure`.
        chosen, have, fov_deg: as for `draw_next_views`.
    """
    figure, ax, handles = _one_map(field, outlines)
    draw_next_views(ax, field, chosen, have=have, fov_deg=fov_deg)
    handles.append(_mark("o", _PATHS[0][0], "next views, in this order"))
    if len(have):
        handles.append(_mark("o", "#1a1a1a", "views at hand"))
    _legend(figure, handles, 3)
    return figure


def paths_figure(
    field: ViewField, paths: Mapping[str, Sequence[int]], *, outlines: FloorPlan | None = None
) -> Figure:
    """Paths on the map of the best position bound.

    Args:
        field, outlines: as for `field_figure`.
        paths: by what the legend calls them, indices of their views in order; the first is drawn on top.
    """
    figure, ax, handles = _one_map(field, outlines)
    styles = list(zip(paths.items(), _PATHS, strict=False))
    for (label, views), (colour, style) in reversed(styles):
        draw_path(ax, field, views, label=label, colour=colour, style=style)
    handles += [Line2D([], [], color=c, ls=s, lw=2.2, label=label) for (label, _), (c, s) in styles]
    handles += [_mark("o", MUTED, "from"), _mark("s", MUTED, "to")]
    _legend(figure, handles, 3)
    return figure


def write_field_page(path: Path, field: ViewField, world: Any = None) -> None:
    """Write `field_figure` as a PNG; arguments as `outlines_of`."""
    _write(path, field_figure(field, outlines_of(field, world)))


def write_next_views_page(
    path: Path, field: ViewField, chosen: Sequence[int], *, have: Sequence[int] = (), world: Any = None
) -> None:
    """Write `next_views_figure` as a PNG; arguments as there and of `outlines_of`."""
    _write(path, next_views_figure(field, chosen, have=have, outlines=outlines_of(field, world)))


def write_paths_page(
    path: Path, field: ViewField, paths: Mapping[str, Sequence[int]], *, world: Any = None
) -> None:
    """Write `paths_figure` as a PNG; arguments as there and of `outlines_of`."""
    _write(path, paths_figure(field, paths, outlines=outlines_of(field, world)))


def _one_map(field: ViewField, outlines: FloorPlan | None) -> tuple[Figure, Axes, list[Any]]:
    low, high = _limits(field)
    shape = (high[1] - low[1]) / (high[0] - low[0])
    figure = _figure(8.2, 8.2 * min(max(shape, 0.4), 1.5) * 0.82 + 1.6)
    ax = figure.add_subplot()
    shown = plan_values(field, "position")
    cmap, norm = colours_of("position", shown.values)
    _map(ax, field, shown, cmap, norm, outlines)
    frame_plan(ax, field, low, high)
    _colour_bar(figure, ax, cmap, norm, "1σ bound of position, best direction [scene unit]")
    _title(figure, field)
    return figure, ax, [*legend_of([shown]), *_outline_marks(outlines, field)]


def _map(
    ax: Axes, field: ViewField, shown: PlanValues, cmap: Any, norm: Any, outlines: FloorPlan | None
) -> None:
    draw_values(ax, shown, cmap, norm)
    if outlines is not None:
        draw_outlines(ax, outlines)


def _colour_bar(figure: Figure, axes: Any, cmap: Any, norm: Any, label: str) -> None:
    if norm is None:
        return
    logarithmic = isinstance(norm, LogNorm)
    bar = figure.colorbar(
        ScalarMappable(norm, cmap),
        ax=axes,
        location="bottom",
        fraction=0.05,
        pad=0.02,
        aspect=32,
        shrink=0.92,
        extend="both" if logarithmic else "neither",
    )
    ticks = round_ticks(norm.vmin, norm.vmax) if logarithmic else list(range(7))
    bar.ax.minorticks_off()
    bar.set_ticks(ticks, labels=[f"{tick:.3g}" for tick in ticks])
    bar.set_label(label, fontsize=9)
    bar.ax.tick_params(labelsize=8)


def round_ticks(low: float, high: float) -> list[float]:
    """Numbers of one digit from `low` to `high`, so far apart on a logarithmic scale that labels fit."""
    apart = _APART * math.log(high / low)
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for digits in ((1, 2, 3, 4, 5, 6, 7, 8, 9), (1, 2, 3, 5, 7), (1, 2, 3, 5), (1, 2, 5), (1, 3), (1,)):
        ticks = [digit * 10.0**power for power in powers for digit in digits]
        ticks = [tick for tick in ticks if low <= tick <= high]
        if all(math.log(b / a) >= apart for a, b in itertools.pairwise(ticks)):
            return ticks
    return ticks[:: math.ceil(apart / math.log(10.0))]


def _legend(figure: Figure, handles: list[Any], columns: int = 4) -> None:
    ncols = min(columns, len(handles))
    figure.legend(handles=handles, loc="outside lower center", ncols=ncols, fontsize=9, frameon=False)


def _mark(marker: str, colour: str, label: str) -> Line2D:
    return Line2D(
        [], [], marker=marker, ls="none", color=colour, markeredgecolor="white", markersize=8, label=label
    )


def _outline_marks(outlines: FloorPlan | None, field: ViewField) -> list[Line2D]:
    if outlines is None:
        return []
    name = PlanView.of(field.up).names[2]
    styles = (("black", 1.4), ("#4d4d4d", 0.7))
    return [
        Line2D([], [], color=colour, lw=width, label=f"what stands at {name} = {height:.3g}")
        for height, (colour, width) in zip(outlines.heights, styles, strict=False)
    ]


def _title(figure: Figure, field: ViewField) -> None:
    scene = Path(str(field.settings.get("scene", ""))).name
    places = len(np.unique(field.place))
    heights = PlanView.of(field.up).height(field.poses[:, :3, 3])
    low, high = float(heights.min()), float(heights.max())
    name = PlanView.of(field.up).names[2]
    where = (
        f"{name} = {low:.3g}"
        if high - low < 1e-6 * max(1.0, abs(high))
        else f"{name} {low:.3g} to {high:.3g}"
    )
    missing = f"   ·   {int((~field.done).sum())} not measured yet" if field.interrupted else ""
    figure.suptitle(
        f"{scene}\n{len(field)} views, {places} places, {where}, seen from above{missing}",
        x=0.01,
        ha="left",
        fontsize=11.5,
    )


def _limits(field: ViewField, margin: float = _MARGIN) -> tuple[Array, Array]:
    """(2,) corners of what is drawn, in the plan's coordinates."""
    positions = PlanView.of(field.up).flat(field.poses[:, :3, 3])
    low, high = positions.min(axis=0), positions.max(axis=0)
    extent = float((high - low).max()) or float(np.median(field.values("length_scale"))) or 1.0
    spacing = lattice(np.unique(positions.round(9), axis=0))
    beyond = margin * extent + (0.0 if spacing is None else 0.5 * spacing)
    # A row of positions is drawn with something on both sides.
    narrow = np.maximum(0.2 * extent - 0.5 * (high - low), 0.0)
    return low - beyond - narrow, high + beyond + narrow


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), facecolor="white")
    FigureCanvasAgg(figure)
    figure.set_layout_engine("constrained", h_pad=0.08, w_pad=0.06)
    return figure


def _write(path: Path, figure: Figure) -> None:
    with atomic(path) as temporary:
        figure.savefig(temporary, format="png", dpi=130)
