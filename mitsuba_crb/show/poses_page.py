"""The page of `mitsuba-crb bound --poses --plot`: where along the path the camera is lost.

The path from above and from the side, coloured by the bound on position, with the 3σ ellipsoids' outlines,
enlarged by a factor that is stated; below, the bounds from pose to pose. Up is the world axis next to which
the cameras' own up points on average.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ..files import atomic
from ..noise.covariance import symmetric_root
from .plot import MUTED

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

    from ..measure.pose_table import PoseRow, PoseTable
    from ..se3 import Array

_SIGMA = 3.0
_SHOWN = 0.035
"""Of the path's extent, what the typical ellipsoid's largest semi-axis is drawn as."""
_OPEN = 0.05
"""Of the path's extent, half the length of the line of a direction that is not seen."""
_LOOK = 0.06
"""The same of the line along which a camera looks."""
_DRAWN = 60
"""Ellipsoids and lines of sight that a picture holds, at most."""
_TILT = 0.1
_LOST = "#b2182b"
_AXES = "xyz"
COLOURS = "viridis_r"
"""Colour map of the bound on position: the darker, the less is known."""


def poses_figure(table: PoseTable, *, sigma: float = _SIGMA) -> Figure:
    """The path from above and from the side, and the bounds along it.

    Args:
        table: of at least one row.
        sigma: of the ellipsoids, in standard deviations.
    """
    figure = Figure(figsize=(13, 9), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(3, 2, height_ratios=(3.2, 1, 1))
    rows = table.rows
    centres = np.array([row.pose[:3, 3] for row in rows])
    up, across, away = _world_axes(rows, centres)
    extent = float(np.ptp(centres, axis=0).max()) or float(np.median([row.length_scale for row in rows]))
    factor = _enlarged(rows, sigma, extent)
    finite = [row.position for row in rows if math.isfinite(row.position)]
    norm = LogNorm(min(finite), max(*finite, 1.001 * min(finite))) if finite else None
    views = (("from above", (across, away)), ("from the side", (across, up)))
    for column, (words, plane) in enumerate(views):
        ax = figure.add_subplot(grid[0, column])
        draw_path(ax, rows, plane, sigma=sigma, factor=factor, extent=extent, norm=norm)
        ax.set_title(f"Seen {words}", loc="left", fontsize=12)
        ax.set_xlabel(f"{_AXES[plane[0]]} [scene unit]", fontsize=9)
        ax.set_ylabel(f"{_AXES[plane[1]]} [scene unit]", fontsize=9)
    if norm is not None:
        bar = figure.colorbar(ScalarMappable(norm, COLOURS), ax=figure.axes[1], pad=0.02)
        bar.set_label("1σ of position, all axes together [scene unit]", fontsize=9)
        bar.ax.tick_params(which="both", labelsize=8)
    size = f", drawn {factor:g} times as large" if factor != 1.0 else ""
    figure.axes[1].set_title(f"outlines: {sigma:g}σ ellipsoids{size}", loc="right", fontsize=9, color=MUTED)
    top = figure.add_subplot(grid[1, :])
    draw_along(top, table, [row.position for row in rows], "position\n[scene unit]")
    low = figure.add_subplot(grid[2, :], sharex=top)
    draw_along(low, table, [row.rotation_deg for row in rows], "rotation\n[deg]")
    low.set_xlabel(_place_label(table), fontsize=9)
    figure.align_ylabels([top, low])
    top.tick_params(labelbottom=False)
    top.set_title("1σ bound along the path, the three axes together", loc="left", fontsize=12)
    if table.lost:
        shades = "shaded: not finite, darker at rank 0"
        top.set_title(shades, loc="right", fontsize=9, color=MUTED)
    _legend(figure.axes[0], rows)
    scene = Path(str(table.settings.get("scene", ""))).name
    lost = f"   ·   {len(table.lost)} not of rank 6" if table.lost else "   ·   all of rank 6"
    figure.suptitle(f"{scene}   ·   {len(rows)} poses{lost}", x=0.01, ha="left", fontsize=14, weight="bold")
    return figure


def write_poses_plot(path: Path, table: PoseTable) -> None:
    """Write `poses_figure` as a PNG."""
    figure = poses_figure(table)
    with atomic(path) as temporary:
        figure.savefig(temporary, format="png", dpi=130)


def draw_path(
    ax: Axes,
    rows: tuple[PoseRow, ...],
    plane: tuple[int, int],
    *,
    sigma: float,
    factor: float,
    extent: float,
    norm: LogNorm | None,
) -> list[Artist]:
    """The camera centres in two of the world's coordinates, coloured by the bound on position.

    Args:
        ax: where to draw.
        rows: in the order of the path.
        plane: the two coordinates.
        sigma: of the ellipsoids, in standard deviations.
        factor: by which these are enlarged.
        extent: of the path, to which lines are scaled [scene unit].
        norm: of the colours; None if no position is seen.
    """
    both = list(plane)
    places = np.array([row.pose[:3, 3][both] for row in rows])
    values = np.array([row.position for row in rows])
    seen, blank = np.isfinite(values), np.array([row.rank == 0 for row in rows])
    drawn: list[Artist] = []
    drawn += ax.plot(*places.T, color="black", lw=0.6, alpha=0.35, zorder=1)
    x, y = places.T
    marks = ax.scatter(x[seen], y[seen], c=values[seen], cmap=COLOURS, norm=norm, s=24, zorder=4)
    marks.set(linewidth=0.4, edgecolor="black")  # the lightest would hardly be seen on white
    part = ~seen & ~blank
    drawn.append(marks)
    drawn.append(ax.scatter(x[part], y[part], facecolor="white", edgecolor=_LOST, s=26, zorder=4))
    drawn.append(ax.scatter(x[blank], y[blank], marker="x", color=_LOST, s=42, zorder=5))
    step = -(-len(rows) // _DRAWN)
    for index, (row, place) in enumerate(zip(rows, places, strict=True)):
        if index % step == 0:
            look = np.array([place, place + _LOOK * extent * row.pose[:3, 2][both]])
            drawn += ax.plot(*look.T, color=MUTED, lw=0.8, alpha=0.7, zorder=2)
        if row.rank and (index % step == 0 or not seen[index]):
            colour = marks.to_rgba(values[index]) if seen[index] else _LOST
            drawn += _outline(ax, row, place, both, sigma * factor, _OPEN * extent, colour)
    ax.set_aspect("equal", adjustable="datalim")
    ax.margins(0.08)
    ax.grid(alpha=0.2)
    ax.tick_params(labelsize=8, colors=MUTED)
    return drawn


def _outline(
    ax: Axes, row: PoseRow, place: Array, plane: list[int], scale: float, reach: float, colour: Any
) -> list[Artist]:
    """The shadow of what is seen, and an open line along each direction that is not."""
    hidden = ~np.isfinite(row.ellipsoid)
    drawn: list[Artist] = []
    for axis in np.flatnonzero(hidden):
        along = row.ellipsoid_axes[plane, axis]
        if np.linalg.norm(along) > _TILT:
            ends = place + reach * np.array([-along, along])
            style = "-" if row.ellipsoid_verdict[axis] == "unseen" else "--"
            drawn += ax.plot(*ends.T, color=colour, lw=1.6, ls=style, zorder=3)
    shadow = scale * row.ellipsoid_axes[plane][:, ~hidden] * row.ellipsoid[~hidden]
    if not hidden.any():
        angle = np.linspace(0, 2 * np.pi, 73)
        ring = place[:, None] + symmetric_root(shadow @ shadow.T) @ [np.cos(angle), np.sin(angle)]
        drawn += ax.plot(*ring, color=colour, lw=1.0, zorder=3, scalex=False, scaley=False)
    return drawn


def draw_along(ax: Axes, table: PoseTable, values: list[float], label: str) -> list[Artist]:
    """One bound from pose to pose, on a logarithmic scale; where it is not finite, a mark at the top."""
    places, numbers = np.array(table.places), np.array(values)
    seen = np.isfinite(numbers)
    drawn: list[Artist] = []
    drawn += ax.plot(places, np.where(seen, numbers, np.nan), "o-", color="#2166ac", ms=3, lw=1)
    if seen.any():
        ax.set_yscale("log")
    for index in np.flatnonzero(~seen):
        strength = 0.3 if table.rows[index].rank == 0 else 0.14
        ends = places[index] - 0.5, places[index] + 0.5
        drawn.append(ax.axvspan(*ends, color=_LOST, alpha=strength, lw=0))
    ax.set_xlim(-0.5, table.asked - 0.5)
    ax.set_ylabel(label, fontsize=9)
    ax.grid(alpha=0.25, which="both")
    ax.tick_params(which="both", labelsize=8, colors=MUTED)
    return drawn


def _world_axes(rows: tuple[PoseRow, ...], centres: Array) -> tuple[int, int, int]:
    """Up, and of the other two that along which the path is longer, and the third."""
    mean = np.mean([row.pose[:3, 1] for row in rows], axis=0)
    up = int(np.argmax(np.abs(mean)))
    others = [axis for axis in range(3) if axis != up]
    across, away = sorted(others, key=lambda axis: -float(np.ptp(centres[:, axis])))
    return up, across, away


def _enlarged(rows: tuple[PoseRow, ...], sigma: float, extent: float) -> float:
    """A round number by which the typical ellipsoid becomes large enough to be seen."""
    largest = [row.ellipsoid[0] for row in rows if np.isfinite(row.ellipsoid).all()]
    if not largest:
        return 1.0
    wanted = _SHOWN * extent / (sigma * float(np.median(largest)))
    power = 10.0 ** math.floor(math.log10(wanted))
    return float(power * max(step for step in (1, 2, 5) if step * power <= wanted))


def _place_label(table: PoseTable) -> str:
    first, last = table.rows[0].name, table.rows[-1].name
    if first == str(table.places[0]) and last == str(table.places[-1]):
        return "pose"
    return f"pose, from {first} to {last}"


def _legend(ax: Axes, rows: tuple[PoseRow, ...]) -> None:
    """What the marks mean that are there."""
    handles = [Line2D([], [], color=MUTED, lw=0.8, label="line of sight")]
    verdicts = {v for row in rows if row.rank for v in row.ellipsoid_verdict}
    for verdict, style in (("unseen", "-"), ("not resolved", "--")):
        if verdict in verdicts:
            handles.append(Line2D([], [], color=_LOST, lw=1.6, ls=style, label=f"direction {verdict}"))
    if any(row.rank and not math.isfinite(row.position) for row in rows):
        mark = Line2D([], [], marker="o", ls="none", label="position not seen in some direction")
        mark.set(markerfacecolor="white", markeredgecolor=_LOST)
        handles.append(mark)
    if any(row.rank == 0 for row in rows):
        handles.append(Line2D([], [], marker="x", color=_LOST, ls="none", label="rank 0"))
    ax.legend(handles=handles, fontsize=8, frameon=False, loc="best")
