"""Plain charts of a page as figures of plotly: along a path, of trials, of budgets."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from .page import plotly_library
from .traces import plain

BLUE, ORANGE, GREEN, PURPLE, GREY, RED = "#3b82f6", "#ea580c", "#16a34a", "#9333ea", "#64748b", "#db2777"


def chart(figure: Any, *, alt: str, height: int = 300) -> dict[str, Any]:
    """What the script needs: the figure, and what it shows in words."""
    figure.update_layout(
        template="none",
        margin={"l": 64, "r": 16, "t": 30, "b": 52},
        height=height,
        legend={"orientation": "h", "y": 1.02, "yanchor": "bottom"},
        hovermode="closest",
    )
    figure.update_xaxes(automargin=True, zeroline=False)
    figure.update_yaxes(automargin=True, zeroline=False)
    return {"figure": json.loads(figure.to_json()), "alt": alt}


def along_path(
    places: Sequence[int], names: Sequence[str], values: Sequence[float], *, label: str
) -> dict[str, Any]:
    """One bound from pose to pose, on a logarithmic scale; marks at the top where it is not finite."""
    go = plotly_library()
    numbers = np.asarray(values, dtype=np.float64)
    seen = np.isfinite(numbers)
    figure = go.Figure()
    figure.add_trace(
        go.Scatter(
            x=list(places),
            y=np.where(seen, numbers, np.nan),
            mode="lines+markers",
            name=label,
            line={"color": BLUE, "width": 1.5},
            marker={"size": 5},
            customdata=[[index] for index in range(len(names))],
            text=[plain(name) for name in names],
            hovertemplate="%{text}: %{y:.3g}<extra></extra>",
            showlegend=False,
        )
    )
    top = float(numbers[seen].max()) * 1.5 if seen.any() else 1.0
    if not seen.all():
        hidden = np.flatnonzero(~seen).tolist()
        figure.add_trace(
            go.Scatter(
                x=[places[k] for k in hidden],
                y=[top] * len(hidden),
                mode="markers",
                name="not finite",
                marker={"symbol": "x", "color": RED, "size": 8},
                customdata=[[k] for k in hidden],
                text=[plain(names[k]) for k in hidden],
                hovertemplate="%{text}: not finite<extra></extra>",
            )
        )
    figure.update_layout(xaxis_title="pose", yaxis_title=label, yaxis_type="log" if seen.any() else "linear")
    alt = f"{label} along {len(names)} poses"
    if seen.any():
        alt += f", from {numbers[seen].min():.3g} to {numbers[seen].max():.3g}"
    return chart(figure, alt=f"{alt}; not finite at {int((~seen).sum())}", height=230)


def calibration(nominal: Sequence[float], coverage: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Share of the errors inside the confidence region against its level.

    Args:
        nominal: the level at which each error is on the region's edge.
        coverage: levels with their bands.
    """
    go = plotly_library()
    ordered = np.sort(np.asarray(nominal))
    share = np.arange(1, len(ordered) + 1) / max(len(ordered), 1)
    figure = go.Figure()
    ideal = {"color": GREY, "dash": "dash", "width": 1}
    figure.add_trace(go.Scatter(x=[0, 1], y=[0, 1], mode="lines", line=ideal, name="as the bound says"))
    line = {"color": BLUE, "shape": "hv"}
    figure.add_trace(go.Scatter(x=ordered, y=share, mode="lines", line=line, name="found"))
    for each in coverage:
        x, y = [each["nominal"]] * 2, [each["low"], each["high"]]
        style = {"color": ORANGE, "width": 5}
        figure.add_trace(go.Scatter(x=x, y=y, mode="lines", line=style, showlegend=False, name="band"))
    figure.update_layout(xaxis_title="nominal confidence", yaxis_title="empirical coverage")
    return chart(figure, alt="Share of errors inside the confidence region against its level, with bands")


def ratios(values: Sequence[float], bands: Sequence[Sequence[float]]) -> dict[str, Any]:
    """Variances of the errors over the bound, with the bands in which they are if it is attained."""
    go = plotly_library()
    figure = go.Figure()
    for place, (low, high) in enumerate(bands, 1):
        style = {"color": GREY, "width": 12}
        figure.add_trace(
            go.Scatter(
                x=[place, place],
                y=[low, high],
                mode="lines",
                line=style,
                opacity=0.4,
                name="band, if the bound is met",
                showlegend=place == 1,
            )
        )
    x = list(range(1, len(values) + 1))
    style = {"color": BLUE, "size": 9}
    figure.add_trace(go.Scatter(x=x, y=list(values), mode="markers", marker=style, name="found"))
    figure.update_layout(
        xaxis_title="direction, from the worst", yaxis_title="variance / bound", yaxis_rangemode="tozero"
    )
    written = ", ".join(f"{value:.2f}" for value in values)
    return chart(figure, alt=f"Variance over bound in six directions: {written}")


def budgets(document: dict[str, Any], counts: str) -> dict[str, Any]:
    """Worth against budget: the choice, simpler rules, and what no choice exceeds."""
    go = plotly_library()
    curve = document["curve"]
    x = [point[counts] for point in curve]
    rules = {
        "chosen": [point["value"] for point in curve],
        "chosen, held out": [point["value_heldout"] for point in curve],
        **{
            name.replace("_", " "): [point["baselines"][name]["value"] for point in curve]
            for name in document["baselines"]
        },
    }
    figure = go.Figure()
    bound = {"color": GREY, "dash": "dot", "width": 1.5}
    upper = [_finite(point["upper_bound"]) for point in curve]
    figure.add_trace(go.Scatter(x=x, y=upper, mode="lines", line=bound, name="no choice exceeds"))
    marks = ("circle", "square", "triangle-up", "triangle-down", "diamond")
    for (name, values), colour, mark in zip(
        rules.items(), (ORANGE, GREEN, BLUE, PURPLE, GREY), marks, strict=False
    ):
        figure.add_trace(
            go.Scatter(
                x=x,
                y=[_finite(value) for value in values],
                mode="lines+markers",
                name=name,
                line={"color": colour},
                marker={"symbol": mark, "size": 7},
            )
        )
    named = {"logdet": "ln det F", "trace": "tr F", "lambda_min": "λ_min of F"}[document["objective"]]
    figure.update_layout(xaxis_title=f"budget [{counts}]", yaxis_title=named)
    return chart(figure, alt=f"{named} against the budget in {counts}, of {', '.join(rules)}", height=380)


def _finite(value: Any) -> float | None:
    number = float(value) if value is not None else float("nan")
    return number if np.isfinite(number) else None
