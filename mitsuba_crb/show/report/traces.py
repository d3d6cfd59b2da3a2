"""Traces of the interactive views: points and lines in space, and names as plotly can show them."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from .page import plotly_library


def scatter(points: npt.NDArray[np.floating[Any]], **style: Any) -> Any:
    """A trace through points (n, 3), by the keywords of plotly's `Scatter3d`."""
    x, y, z = points.T
    return plotly_library().Scatter3d(x=x, y=y, z=z, **style)


def lines(points: npt.NDArray[np.floating[Any]], line: dict[str, Any], *, name: str) -> Any:
    """Lines along points (n, 3), NaN between them, that say nothing under the pointer."""
    return scatter(points, mode="lines", line=line, name=name, hoverinfo="skip")


def plain(name: str) -> str:
    """A name in plotly's texts, which know a few tags."""
    return name.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
