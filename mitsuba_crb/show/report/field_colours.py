"""The colours of a field of views on a page: bright is well located, and what has no number is a mark of grey
or red with its reason, never a colour of the scale."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...planning.plan_values import INSIDE_SOLID, NOT_RESOLVED, NOTHING, TO_DO, UNSEEN
from ...se3 import Array
from .charts import GREY, PURPLE, RED

MARKS = {
    UNSEEN: ("x", RED),
    NOT_RESOLVED: ("diamond-open", PURPLE),
    INSIDE_SOLID: ("square", GREY),
    NOTHING: ("circle-open", GREY),
    TO_DO: ("cross", GREY),
}
"""Symbol and colour of those without a number, by their kind."""
_SPREAD = (2.0, 98.0)
"""Percentiles at the ends of the scale."""
_LEAST_SPAN = 1.25
"""Of the scale's ends, their ratio at least."""
_TICKS = 5


def logarithms(values: Array) -> Array:
    """Of what is positive and finite, to the base of 10; NaN of the rest."""
    known = np.isfinite(values) & (values > 0.0)
    return np.log10(np.where(known, values, 1.0), where=known, out=np.full(values.shape, np.nan))


def colour_scale(levels: Array, title: str) -> dict[str, Any]:
    """Ends, colours and bar for `logarithms`, some of which are finite."""
    low, high = np.percentile(levels[np.isfinite(levels)], _SPREAD)
    lacking = max(0.0, math.log10(_LEAST_SPAN) - (high - low))
    low, high = float(low - 0.5 * lacking), float(high + 0.5 * lacking)
    ticks = np.linspace(low, high, _TICKS)
    return {
        "ends": (low, high),
        "colorscale": "Viridis",
        "reversescale": True,
        "colorbar": {
            "title": {"text": title, "side": "right"},
            "tickvals": ticks.tolist(),
            "ticktext": [f"{10.0**tick:.2g}" for tick in ticks],
            "thickness": 12,
        },
    }
