"""The picture of `mitsuba-crb align --residual`: photograph, render, and what they differ by."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ..files import atomic
from ..noise import SRGB
from .align_table import verdict_line
from .plot import DIVERGING, draw_picture

if TYPE_CHECKING:
    from ..estimate.photograph import PhotographAlignment
    from ..se3 import Array

_SIDE = 4.0
"""Width of a picture [inch]."""
_GREY = 0.788
"""Display value of what is not compared."""


def residual_figure(result: PhotographAlignment) -> Figure:
    """The photograph, the render at the estimated pose, and the signed difference of their channels' mean."""
    measured, render = result.measured.values, result.alignment.image
    height, width = measured.shape[:2]
    figure = Figure(
        figsize=(3.0 * _SIDE + 1.6, _SIDE * min(max(height / width, 0.4), 2.2) + 1.0),
        facecolor="white",
        layout="constrained",
    )
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 3)
    for ax, image, title in zip(axes, (measured, render), ("photograph", "render"), strict=False):
        draw_picture(ax, _shown(image, display=result.display))
        ax.set_title(title, loc="left", fontsize=10)
    difference = (measured - render).mean(axis=2)
    seen = np.abs(difference[np.isfinite(difference)])
    limit = float(np.percentile(seen, 99)) if seen.size else 0.0
    limit = limit or float(seen.max(initial=0.0)) or 1.0
    drawn = draw_picture(axes[2], difference, cmap=DIVERGING, vmin=-limit, vmax=limit)
    axes[2].set_title("photograph − render, mean of the channels", loc="left", fontsize=10)
    # as high as the picture, which a bar of its own axes is not where the picture keeps its shape
    bar = figure.colorbar(drawn, cax=axes[2].inset_axes((1.03, 0.0, 0.04, 1.0)), extend="both")
    bar.set_label("display values" if result.display else "linear values, white is 1", fontsize=9)
    bar.ax.tick_params(labelsize=8)
    names = (Path(str(result.settings[key])).name for key in ("photograph", "scene"))
    figure.suptitle(
        f"{' in '.join(names)}: {verdict_line(result)}; RMS {result.alignment.rms:.3g}",
        fontsize=10,
        parse_math=False,
        wrap=True,
    )
    return figure


def _shown(image: Array, *, display: bool) -> Array:
    """Display values of an image, NaN grey."""
    inside = np.clip(np.nan_to_num(image), 0.0, 1.0)
    values = inside if display else np.asarray(SRGB(inside))
    values[~np.isfinite(image).all(axis=2)] = _GREY
    return values


def write_residual_picture(path: Path, result: PhotographAlignment) -> None:
    """Write the figure as PNG."""
    with atomic(path) as temporary:
        residual_figure(result).savefig(temporary, format="png", dpi=130)
