"""The interactive view: the world as points, cameras as frusta, errors of position as `ellipsoids`.

Surfaces that turn away from the viewer are hidden by the script (`facing`), so that rooms can be looked into.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ...measure.outlook import Outlook, Sight
from .ellipsoids import (
    MANY,
    Ellipsoid,
    add_ellipsoids,
    add_open_lines,
    add_scattered,
    enlargement,
    enlargements,
)
from .page import plotly_library
from .traces import lines, plain, scatter

_OPEN = 0.16
"""Of the world's extent, half of the line along a direction that is not seen."""
_FRUSTUM = 0.11
_CAMERA = "#3b82f6"
Floats = npt.NDArray[np.float64]


def space(
    outlook: Outlook,
    ellipsoids: Sequence[Ellipsoid],
    *,
    scattered: Floats | None = None,
    path: bool = False,
    unit: str = "scene unit",
    value_title: str = "",
    drawn: int | None = None,
    more: Sequence[Any] = (),
    about: str = "",
) -> dict[str, Any]:
    """The view for the script: a figure, and what of it changes with the viewer and the factor.

    Args:
        outlook: the world.
        ellipsoids: errors.
        scattered: (n, 3) errors of trials about the first ellipsoid's centre [scene unit].
        path: whether the cameras are along a path, which is drawn.
        unit: of length.
        value_title: what the ellipsoids' colours say.
        drawn: how many of the cameras are drawn, the first ones; None: all.
        more: further traces.
        about: what these are, a sentence without its full stop.
    """
    centre, extent = _region(outlook, ellipsoids)
    up = _up(outlook.sights)
    factor = enlargement(ellipsoids, extent)
    figure = plotly_library().Figure()
    facing: list[dict[str, Any]] = []
    scaled: list[dict[str, Any]] = []
    _add_points(figure, outlook, facing)
    cameras = outlook.sights[:drawn]
    reach = _FRUSTUM * extent * (0.5 if len(cameras) > MANY else 1.0)
    if cameras:
        _add_cameras(figure, cameras, reach, path)
    _add_names(figure, cameras, ellipsoids)
    figure.add_traces(list(more))
    add_ellipsoids(figure, ellipsoids, factor, scaled, value_title)
    add_open_lines(figure, ellipsoids, _OPEN * extent * (0.4 if len(ellipsoids) > MANY else 1.0))
    if scattered is not None and len(scattered):
        add_scattered(figure, ellipsoids[0].centre, scattered, factor, scaled)
    names = ("x", "y", "z")
    axes = {
        f"{name}axis": {
            "title": {"text": f"{name} [{unit}]"},
            "range": [centre[k] - 0.5 * extent, centre[k] + 0.5 * extent],
            "showbackground": False,
            "showspikes": False,
        }
        for k, name in enumerate(names)
    }
    figure.update_layout(
        template="none",
        margin={"l": 0, "r": 0, "t": 0, "b": 0},
        showlegend=True,
        legend={"orientation": "h", "y": 0.0, "yanchor": "top", "itemsizing": "constant"},
        scene={
            **axes,
            "aspectmode": "cube",
            "dragmode": "orbit",
            "camera": _first_view(outlook.sights, centre, extent, up),
        },
        uirevision="keep",
        hoverlabel={"namelength": -1},
    )
    return {
        "figure": json.loads(figure.to_json()),
        "facing": facing,
        "scaled": scaled,
        "factor": factor,
        "factors": enlargements(factor),
        "centre": centre.tolist(),
        "extent": extent,
        "up": up.tolist(),
        "sights": [
            {"name": s.name, "pose": s.pose.tolist(), "corners": s.corners.tolist()} for s in outlook.sights
        ],
        "reach": reach,
        "words": _words(outlook, ellipsoids, about),
        "alt": _alt(cameras, ellipsoids, about),
        "first": _first_view(outlook.sights, centre, extent, up),
    }


def _region(outlook: Outlook, ellipsoids: Sequence[Ellipsoid]) -> tuple[Floats, float]:
    """Centre and side of a cube that holds nearly all."""
    places = np.array([*(sight.pose[:3, 3] for sight in outlook.sights), *(e.centre for e in ellipsoids)])
    low, high = places.min(axis=0), places.max(axis=0)
    if len(outlook.points):
        near, far = np.percentile(outlook.points, (0.5, 99.5), axis=0)
        low, high = np.minimum(low, near), np.maximum(high, far)
    side = float((high - low).max())
    return 0.5 * (low + high), 1.04 * side if side > 0.0 else 1.0


def _up(sights: Sequence[Sight]) -> Floats:
    """The cameras' own up on average, or the world's axis that is nearly that."""
    mean = np.mean([sight.pose[:3, 1] for sight in sights], axis=0)
    length = float(np.linalg.norm(mean))
    if length < 0.1:
        return np.array([0.0, 0.0, 1.0])
    axis = int(np.argmax(np.abs(mean)))
    if abs(mean[axis]) > 0.8 * length:
        return np.where(np.arange(3) == axis, np.sign(mean), 0.0)
    up: Floats = mean / length
    return up


def _first_view(sights: Sequence[Sight], centre: Floats, extent: float, up: Floats) -> dict[str, Any]:
    """From behind the cameras, to their right and above, in plotly's coordinates."""
    forward = np.mean([sight.pose[:3, 2] for sight in sights], axis=0)
    forward = forward - (forward @ up) * up
    if np.linalg.norm(forward) < 0.2:
        forward = np.cross(up, [0.3, 0.9, 0.4])
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, up)
    eye = -1.2 * forward + 0.85 * right + 0.95 * up
    return {"eye": _xyz(eye), "center": _xyz(-0.08 * up), "up": _xyz(up)}


def _xyz(vector: Floats) -> dict[str, float]:
    x, y, z = vector.tolist()
    return {"x": x, "y": y, "z": z}


def _add_points(figure: Any, outlook: Outlook, facing: list[dict[str, Any]]) -> None:
    """In groups that face about the same way; each is one trace that the script can hide."""
    if not len(outlook.points):
        return
    surface = np.linalg.norm(outlook.normals, axis=1) > 0.5
    main = np.argmax(np.abs(outlook.normals), axis=1)
    sign = np.take_along_axis(outlook.normals, main[:, None], axis=1)[:, 0] > 0
    group = np.where(surface, 2 * main + sign, 6)
    palette, codes = _palette(outlook.colours)
    for which in np.unique(group):
        mask = group == which
        mean = outlook.normals[mask].mean(axis=0) if which < 6 else np.zeros(3)
        facing.append(
            {
                "trace": len(figure.data),
                "normal": mean.tolist(),
                "place": np.median(outlook.points[mask], axis=0).tolist(),
            }
        )
        figure.add_trace(
            scatter(
                outlook.points[mask].astype(np.float32),
                mode="markers",
                name="the world",
                showlegend=False,
                hoverinfo="skip",
                marker={
                    "size": 2.6,
                    "color": codes[mask],
                    "colorscale": palette,
                    "cmin": 0,
                    "cmax": 255,
                    "line": {"width": 0},
                },
            )
        )


def _palette(colours: Floats) -> tuple[list[tuple[float, str]], npt.NDArray[np.uint8]]:
    """At most 256 colours as a scale of plotly's, and which one each point has."""
    from PIL import Image

    pixels = (255 * colours).round().astype(np.uint8)[None]
    image = Image.fromarray(pixels).quantize(256, Image.Quantize.MEDIANCUT)
    table = np.array(image.getpalette() or [0, 0, 0], dtype=int).reshape(-1, 3)[:256]
    table = np.concatenate([table, np.repeat(table[-1:], 256 - len(table), axis=0)])
    scale = [(k / 255, f"rgb({r},{g},{b})") for k, (r, g, b) in enumerate(table.tolist())]
    return scale, np.asarray(image, dtype=np.uint8)[0]


def _add_cameras(figure: Any, sights: Sequence[Sight], reach: float, path: bool) -> None:
    if path:
        style = {"color": "#64748b", "width": 2}
        figure.add_trace(lines(np.array([sight.pose[:3, 3] for sight in sights]), style, name="path"))
    edges = np.concatenate([frustum(sight.pose, sight.corners, reach) for sight in sights])
    style = {"color": _CAMERA, "width": 3 if len(sights) <= MANY else 1.5}
    figure.add_trace(lines(edges, style, name="camera" if len(sights) == 1 else "cameras"))


def _add_names(figure: Any, sights: Sequence[Sight], ellipsoids: Sequence[Ellipsoid]) -> None:
    """Whose camera is whose, and whose an ellipsoid is that is no camera's."""
    places = {e.name: e.centre for e in ellipsoids} | {s.name: s.pose[:3, 3] for s in sights}
    if not 1 < len(places) <= MANY:
        return
    figure.add_trace(
        scatter(
            np.array(list(places.values())),
            mode="text",
            text=[plain(name) for name in places],
            textfont={"size": 14},
            textposition="top center",
            showlegend=False,
            hoverinfo="skip",
            name="names",
        )
    )


def frustum(pose: Floats, corners: Floats, reach: float) -> Floats:
    """(n, 3) ends of lines, NaN between them: a pyramid over the image, and a mark where it is up."""
    apex = pose[:3, 3]
    size = float(np.linalg.norm(corners, axis=1).max())
    a, b, c, d = apex + reach / size * corners @ pose[:3, :3].T
    tip = 0.5 * (a + b) + 0.35 * (0.5 * (a + b) - 0.5 * (c + d))
    gap = np.full(3, np.nan)
    mark = (0.8 * a + 0.2 * b, tip, 0.2 * a + 0.8 * b)
    return np.array([apex, a, b, c, d, a, gap, apex, b, gap, apex, c, gap, apex, d, gap, *mark, gap])


def _words(outlook: Outlook, ellipsoids: Sequence[Ellipsoid], about: str) -> str:
    """What is drawn, and what it does not say."""
    parts = [text for text in (about, outlook.words) if text]
    if any(np.isfinite(e.semi_axes).any() for e in ellipsoids):
        parts.append("Ellipsoids at 1σ and at 95 % of the probability")
    if not all(e.is_finite for e in ellipsoids):
        parts.append(
            "Open line: a direction that is unseen; dashed: one that is not resolved; how long these lines "
            "are says nothing"
        )
    if outlook.normals.any():
        parts.append("Surfaces that turn away are hidden")
    return ". ".join(parts) + "."


def _alt(cameras: Sequence[Sight], ellipsoids: Sequence[Ellipsoid], about: str) -> str:
    """What the view shows, for those who do not see it."""
    count = len(cameras)
    parts = [f"{count} camera{'s' * (count > 1)} in the world"] if count else []
    parts += [about] if about else []
    for e in ellipsoids[:MANY]:
        known = [f"{value:.3g}" for value in e.semi_axes if math.isfinite(value)]
        hidden = [verdict for verdict in e.verdicts if verdict != "seen"]
        parts.append(
            f"{e.name}: semi-axes at one standard deviation {', '.join(known) or 'none'}"
            + (f", {', '.join(hidden)}" if hidden else "")
        )
    return "; ".join(parts)
