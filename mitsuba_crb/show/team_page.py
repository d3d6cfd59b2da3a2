"""The pictures of `mitsuba-crb select --plot`: each agent's chosen tiles, and worth against budget."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ..files import atomic
from .plot import MUTED, draw_budget_curve, draw_tiles

if TYPE_CHECKING:
    from ..measure.teams import TeamSelection

CURVE_FILE = "budget.png"

_UNITS = {"logdet": "ln det F", "trace": "tr F", "lambda_min": "λ_min of F"}


def agent_figure(result: TeamSelection, index: int) -> Figure:
    """One agent's image with its chosen tiles, numbered in the order of choice among all agents' tiles."""
    agent, image = result.agents[index], result.images[index]
    chosen = [
        (chosen.tile, place)
        for place, chosen in enumerate(result.selection.chosen, 1)
        if chosen.agent == agent.agent
    ]
    height, width = image.shape[:2]
    figure = _figure(6.4, 6.4 * min(height / width, 1.5) + 0.7)
    ax = figure.add_subplot()
    draw_tiles(ax, image, agent.tiles, chosen)
    ax.set_title(agent.agent, loc="left", fontsize=13, weight="bold", parse_math=False)
    size = sum(int(agent.cost_bytes[tile]) for tile, _ in chosen)
    sent = f"{len(chosen)} of {len(agent.tiles)} tiles, {size} bytes"
    ax.set_title(sent, loc="right", fontsize=10, color=MUTED)
    return figure


def budget_figure(result: TeamSelection) -> Figure:
    """Information against budget: the choice, simpler rules, and what no choice exceeds."""
    selections = [selection for _, selection in result.curve]
    values = {"chosen": [selection.value for selection in selections]}
    values["chosen, held out"] = [selection.value_heldout for selection in selections]
    for name in result.selection.baselines:
        values[name.replace("_", " ")] = [selection.baselines[name].value for selection in selections]
    figure = _figure(7.5, 5.0)
    ax = figure.add_subplot()
    bound = [selection.upper_bound for selection in selections]
    draw_budget_curve(ax, [budget for budget, _ in result.curve], values, bound=bound)
    ax.set_xlabel(f"budget [{result.counts.removesuffix('s')}]" if result.counts == "bytes" else "tiles sent")
    ax.set_ylabel(f"{_UNITS[result.selection.objective]}, translation in length scales")
    return figure


def write_selection_plots(folder: Path, result: TeamSelection) -> None:
    """Write a PNG per agent, named by its place and name, and `CURVE_FILE`, into an existing folder."""
    safe = [re.sub(r"[^\w.-]", "_", agent.agent) for agent in result.agents]
    figures = {f"{k:02d}_{name}.png": agent_figure(result, k - 1) for k, name in enumerate(safe, 1)}
    for name, figure in {**figures, CURVE_FILE: budget_figure(result)}.items():
        with atomic(folder / name) as temporary:
            figure.savefig(temporary, format="png", dpi=130)


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    return figure
