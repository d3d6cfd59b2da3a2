"""Layers of a map of a field of views: the heat map, outlines of what stands there, arrows, views, paths.

Every function draws into the axes that it is given, in the plan's coordinates (`PlanView`), and returns what
it drew. Bright is well located; what has no number is no colour of the scale, but white or grey and hatched.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import colormaps
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.colors import BoundaryNorm, ListedColormap, LogNorm
from matplotlib.patches import Circle, Patch, Rectangle, Wedge
from matplotlib.patheffects import withStroke

from ..planning.plan_values import (
    INSIDE_SOLID,
    NOT_RESOLVED,
    NOTHING,
    SHOWN,
    TO_DO,
    UNSEEN,
    WORDS,
    PlanValues,
    Quantity,
    lattice,
)
from ..planning.plan_view import PlanView
from .plot import MUTED

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

    from ..planning.floor_plan import FloorPlan
    from ..planning.view_field import ViewField
    from ..se3 import Array

_LOST = "#b2182b"
_CHOSEN = "#d6006e"
_HAD = "#1a1a1a"
_STYLES: dict[int, dict[str, Any]] = {
    UNSEEN: {"facecolor": "white", "edgecolor": _LOST, "hatch": "////"},
    NOT_RESOLVED: {"facecolor": "white", "edgecolor": _LOST, "hatch": "...."},
    INSIDE_SOLID: {"facecolor": "#c4c4c4", "edgecolor": "#4d4d4d", "hatch": "\\\\\\\\"},
    NOTHING: {"facecolor": "white", "edgecolor": "#8f8f8f", "hatch": "xx"},
    TO_DO: {"facecolor": "white", "edgecolor": "#8f8f8f", "hatch": "--"},
}
_RANKS = 7
_SPREAD = (2.0, 98.0)
"""Percentiles of the bounds at the ends of the scale."""
_LEAST_SPAN = 1.25
"""Of the scale's ends, their ratio at least."""
_ARROWS = 24
"""Arrows along the longer side, at most."""
_MARK = 0.02
"""Of the extent: the radius of positions that lie on no grid."""
_VIEW = 0.16
"""Of the extent: how far a view's wedge reaches."""


def colours_of(quantity: Quantity, values: Array) -> tuple[Any, Any]:
    """Colour map and norm, bright where a camera is well located; no norm where there is no number.

    Args:
        quantity: of the map.
        values: all that the scale shall be of.
    """
    if quantity == "rank":
        ranks = ListedColormap(colormaps["viridis"](np.linspace(0.0, 1.0, _RANKS)))
        return ranks, BoundaryNorm(np.arange(-0.5, _RANKS), _RANKS)
    finite = values[np.isfinite(values) & (values > 0.0)]
    if not len(finite):
        return colormaps["viridis_r"], None
    low, high = np.percentile(finite, _SPREAD)
    if high < _LEAST_SPAN * low:
        low, high = low / np.sqrt(_LEAST_SPAN), high * np.sqrt(_LEAST_SPAN)
    return colormaps["viridis_r"], LogNorm(low, high)


def draw_values(ax: Axes, shown: PlanValues, cmap: Any, norm: Any) -> list[Artist]:
    """A cell for each position, or a disc where they lie on no grid.

    Args:
        ax: where to draw.
        shown: what there is at each.
        cmap, norm: from `colours_of`.
    """
    spacing = lattice(shown.positions)
    drawn: list[Artist] = []
    number = shown.kind == SHOWN
    if number.any() and norm is not None:
        cells = PatchCollection(_patches(shown.positions[number], spacing, _extent(shown.positions)))
        cells.set(array=shown.values[number], cmap=cmap, norm=norm, edgecolor="none", linewidth=0, zorder=1)
        cells.set_antialiased(False)
        drawn.append(ax.add_collection(cells))
    for kind, style in _STYLES.items():
        which = shown.kind == kind
        if which.any():
            cells = PatchCollection(_patches(shown.positions[which], spacing, _extent(shown.positions)))
            cells.set(**style, linewidth=0, zorder=1)
            drawn.append(ax.add_collection(cells))
    return drawn


def legend_of(shown: Sequence[PlanValues]) -> list[Patch]:
    """What the hatches mean that are there."""
    kinds = {int(kind) for values in shown for kind in values.kind}
    return [Patch(**style, label=WORDS[kind]) for kind, style in _STYLES.items() if kind in kinds]


def draw_outlines(ax: Axes, plan: FloorPlan) -> list[Artist]:
    """What stands at the heights of a floor plan, the first one bold."""
    drawn: list[Artist] = []
    for k, pieces in enumerate(plan.pieces):
        style: dict[str, Any] = (
            {"color": "black", "linewidth": 1.1, "zorder": 4}
            if k == 0
            else {"color": "#4d4d4d", "linewidth": 0.5, "zorder": 3}
        )
        drawn.append(ax.add_collection(LineCollection(list(pieces), capstyle="round", **style)))
    return drawn


def draw_arrows(ax: Axes, field: ViewField, shown: PlanValues) -> list[Artist]:
    """At each position the direction in which the view looks that has the number; a dot: up or down."""
    plan = PlanView.of(field.up)
    which = np.flatnonzero(shown.view >= 0)
    spacing = lattice(shown.positions)
    length = 0.07 * _extent(shown.positions)
    if spacing is not None:
        first = np.rint((shown.positions[which] - shown.positions.min(axis=0)) / spacing).astype(int)
        step = max(1, int(np.ceil((first.max(initial=0) + 1) / _ARROWS)))
        which = which[(first % step == step // 2).all(axis=1)] if step > 1 else which
        length = 0.72 * step * float(spacing.min())
    if not len(which):
        return []
    looks = plan.flat(field.poses[shown.view[which], :3, 2])
    along = looks * length
    start = shown.positions[which] - 0.5 * along if spacing is not None else shown.positions[which]
    arrows = ax.quiver(
        *start.T,
        *along.T,
        angles="xy",
        scale_units="xy",
        scale=1.0,
        units="xy",
        width=0.09 * length,
        headwidth=3.6,
        headlength=3.4,
        headaxislength=3.0,
        minlength=0.4,
        color="white",
        edgecolor="black",
        linewidth=0.5,
        zorder=6,
    )
    return [arrows]


def draw_next_views(
    ax: Axes,
    field: ViewField,
    chosen: Sequence[int],
    *,
    have: Sequence[int] = (),
    fov_deg: float = 60.0,
) -> list[Artist]:
    """Chosen views, numbered in their order, as wedges of what they look at; those at hand in black.

    Args:
        ax: where to draw.
        field: the views.
        chosen: their indices.
        have: indices of views that there are already.
        fov_deg: of the wedges.
    """
    drawn: list[Artist] = []
    for view in have:
        drawn += _wedge(ax, field, view, fov_deg, _HAD, "")
    for order, view in enumerate(chosen, 1):
        drawn += _wedge(ax, field, view, fov_deg, _CHOSEN, str(order))
    return drawn


def draw_path(
    ax: Axes, field: ViewField, views: Sequence[int], *, label: str, colour: str = _CHOSEN, style: str = "-"
) -> list[Artist]:
    """A path from view to view, with where it starts and ends, and where each looks.

    Args:
        ax: where to draw.
        field: the views.
        views: their indices, in order.
        label: of the legend.
        colour, style: of the line.
    """
    if not len(views):
        return []
    plan = PlanView.of(field.up)
    indices = np.asarray(views, dtype=np.int64)
    positions = plan.flat(field.poses[indices, :3, 3])
    around = [withStroke(linewidth=4.2, foreground="white")]
    drawn: list[Artist] = []
    drawn += ax.plot(
        *positions.T,
        style,
        color=colour,
        lw=2.2,
        label=label,
        zorder=7,
        path_effects=around,
        solid_capstyle="round",
    )
    looks = plan.flat(field.poses[indices, :3, 2]) * 0.035 * _extent(plan.flat(field.poses[:, :3, 3]))
    ticks = LineCollection(list(np.stack([positions, positions + looks], axis=1)), colors=colour, zorder=7)
    ticks.set(linewidth=1.1)
    drawn.append(ax.add_collection(ticks))
    for end, marker in ((positions[0], "o"), (positions[-1], "s")):
        drawn += ax.plot(*end, marker, color=colour, markeredgecolor="white", markersize=9, zorder=8)
    return drawn


def frame_plan(ax: Axes, field: ViewField, low: Array, high: Array) -> None:
    """Equal scales, limits (2,) and names of the axes, as seen from above."""
    plan = PlanView.of(field.up)
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", facecolor="white")
    if plan.mirrored(field.up):
        ax.invert_yaxis()
    ax.set_xlabel(f"{plan.names[0]} [scene unit]", fontsize=9)
    ax.set_ylabel(f"{plan.names[1]} [scene unit]", fontsize=9)
    ax.tick_params(labelsize=8, colors=MUTED)


def _wedge(ax: Axes, field: ViewField, view: int, fov_deg: float, colour: str, text: str) -> list[Artist]:
    plan = PlanView.of(field.up)
    (position,) = plan.flat(field.poses[[view], :3, 3])
    (look,) = plan.flat(field.poses[[view], :3, 2])
    reach = _VIEW * _extent(plan.flat(field.poses[:, :3, 3]))
    turn = float(np.degrees(np.arctan2(look[1], look[0])))
    wedge = Wedge(position, reach, turn - 0.5 * fov_deg, turn + 0.5 * fov_deg)
    wedge.set(facecolor=colour, alpha=0.28, linewidth=0, zorder=7)
    rim = Wedge(position, reach, turn - 0.5 * fov_deg, turn + 0.5 * fov_deg)
    rim.set(facecolor="none", edgecolor=colour, linewidth=1.2, zorder=7)
    drawn: list[Artist] = [ax.add_patch(wedge), ax.add_patch(rim)]
    drawn += ax.plot(*position, "o", color=colour, markeredgecolor="white", markersize=6, zorder=9)
    if text:
        # In the wedge, for several views may stand in one place.
        x, y = position + 0.68 * reach * look / max(float(np.linalg.norm(look)), 1e-9)
        words = ax.text(
            x, y, text, color=colour, fontsize=11, weight="bold", ha="center", va="center", zorder=10
        )
        words.set_path_effects([withStroke(linewidth=2.6, foreground="white")])
        drawn.append(words)
    return drawn


def _patches(positions: Array, spacing: Array | None, extent: float) -> list[Any]:
    if spacing is None:
        return [Circle(tuple(position), _MARK * extent) for position in positions]
    return [Rectangle(tuple(position - 0.5 * spacing), *spacing) for position in positions]


def _extent(positions: Array) -> float:
    return float(np.ptp(positions, axis=0).max()) or 1.0
