"""The picture of `mitsuba-crb validate --plot`: coverage, NEES and ratios of variances, with bands."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy import stats

from ..files import atomic
from ..se3 import Array
from .plot import MUTED
from .trials_table import verdict_line

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

    from ..estimate.trials import Validation

_FOUND, _EXPECTED = "tab:blue", "black"
_LINE = 130
"""Letters of a title's line."""


def validation_figure(result: Validation) -> Figure:
    """Three panels: calibration, the distribution of ξᵀFξ, ratios of variances."""
    figure = Figure(figsize=(12.0, 4.2), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 3)
    squares = result.squares
    draw_calibration(axes[0], squares)
    for c in result.consistency.coverage:
        axes[0].plot([c.nominal] * 2, [c.low, c.high], color=_FOUND, lw=3, alpha=0.4, solid_capstyle="butt")
    draw_squares(axes[1], squares)
    draw_ratios(axes[2], result.consistency.generalized_eigenvalues, result.consistency.wishart_band)
    figure.suptitle(
        f"{Path(result.settings['scene']).name}: {len(squares)} alignments, {len(result.failed)} failed, "
        f"efficiency {result.efficiency:.0%}\n{textwrap.fill(verdict_line(result), _LINE)}",
        fontsize=11,
        parse_math=False,
    )
    return figure


def draw_calibration(
    ax: Axes, squares: Array, *, label: str | None = None, color: str = _FOUND, linestyle: str = "-"
) -> list[Artist]:
    """Share of errors inside the confidence region against its nominal level, beside what is expected.

    Args:
        ax: where to draw.
        squares: (n,) ξᵀFξ of the errors.
        label: for a legend.
        color: of the line.
        linestyle: of the line, which tells several apart where colours do not.
    """
    nominal = np.sort(stats.chi2.cdf(squares, 6))
    empirical = np.arange(1, len(nominal) + 1) / len(nominal)
    drawn: list[Artist] = []
    drawn += ax.plot([0, 1], [0, 1], color=_EXPECTED, lw=1, ls="--")
    drawn += ax.step(nominal, empirical, where="post", color=color, ls=linestyle, label=label)
    ax.set(xlim=(0, 1), ylim=(0, 1), aspect="equal", xlabel="nominal confidence", ylabel="empirical coverage")
    ax.set_title("calibration", loc="left", fontsize=10)
    return drawn


def draw_squares(ax: Axes, squares: Array) -> list[Artist]:
    """The histogram of ξᵀFξ (n,) beside its density if the bound is attained."""
    top = max(20.0, float(squares.max()))
    density, edges = np.histogram(squares, bins=24, range=(0.0, top), density=True)
    drawn: list[Artist] = [ax.stairs(density, edges, fill=True, color=_FOUND, alpha=0.5)]
    grid = np.linspace(0.0, top, 200)
    drawn += ax.plot(grid, stats.chi2.pdf(grid, 6), color=_EXPECTED, lw=1, label="χ², 6 degrees of freedom")
    ax.set(xlabel="ξᵀFξ", ylabel="density")
    ax.set_title("squared errors in units of the bound", loc="left", fontsize=10)
    drawn.append(ax.legend(frameon=False, fontsize=8))
    return drawn


def draw_ratios(ax: Axes, ratios: Array, band: Array) -> list[Artist]:
    """Variances of the errors over the bound's (6,), and the bands (6, 2) where they lie if it is met."""
    place = np.arange(1, 7)
    drawn: list[Artist] = [ax.axhline(1.0, color=_EXPECTED, lw=1, ls="--")]
    bars = ax.vlines(place, band[:, 0], band[:, 1], color=MUTED, lw=8, alpha=0.35)
    bars.set_label("band, if the bound is met")
    drawn.append(bars)
    drawn += ax.plot(place, ratios, "o", color=_FOUND, label="found")
    ax.set(xlabel="direction, from the worst", ylabel="variance / bound", ylim=(0, None))
    ax.set_title("variances of the errors over the bound", loc="left", fontsize=10)
    drawn.append(ax.legend(frameon=False, fontsize=8))
    return drawn


def write_validation_plot(path: Path, result: Validation) -> None:
    """Write the figure as PNG."""
    with atomic(path) as temporary:
        validation_figure(result).savefig(temporary, format="png", dpi=130)
