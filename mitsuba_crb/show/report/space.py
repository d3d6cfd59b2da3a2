"""The interactive view: the world as points, cameras as frusta, errors of position as ellipsoids.

Ellipsoids are drawn at one standard deviation and at 95 % of the probability, both enlarged by a round factor
that the page states and the reader may change. A direction that is unseen is an open line, one that is not
resolved a dashed line, both of a length without a meaning. Surfaces that turn away from the viewer are hidden
by the script (`facing`), so that rooms can be looked into.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...measure.outlook import Outlook, Sight
from .page import plotly_library
from .tables import number

LEVELS = (("1σ", 1.0), ("95 %", 2.795483482915))  # root of the 95 % quantile of χ²_3
"""Names of the ellipsoids, and their semi-axes in standard deviations."""
_SHOWN = 0.09
"""Of the world's extent, what the 95 % ellipsoid's largest semi-axis is drawn as."""
_OPEN = 0.16
"""Of the world's extent, half of the line along a direction that is not seen."""
_FRUSTUM = 0.11
_COLOUR = {
    "camera": "#3b82f6",
    "1σ": "#ea580c",
    "95 %": "#f59e0b",
    "unseen": "#db2777",
    "not resolved": "#8b5cf6",
}
_RINGS, _SPOKES = 13, 24
_SMALL_RINGS, _SMALL_SPOKES = 7, 12
_MANY = 12
"""Ellipsoids from which on they are drawn of fewer triangles."""

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Ellipsoid:
    """An error of position, at one standard deviation."""

    name: str
    """Whose."""
    centre: Floats
    """(3,) [scene unit]."""
    semi_axes: Floats
    """(3,), infinite where there is none [scene unit]."""
    directions: Floats
    """(3, 3) unit vectors, one a row."""
    verdicts: Sequence[str]
    """Of each."""
    value: float = math.nan
    """What its colour says; NaN: nothing."""

    @staticmethod
    def of(name: str, pose: Sequence[Sequence[float]], document: Mapping[str, Any]) -> Ellipsoid:
        """Of a pose, and what a bound's document says in `ellipsoids.position`."""
        return Ellipsoid(
            name,
            np.array(pose, dtype=np.float64)[:3, 3],
            np.array([number(value) for value in document["semi_axes"]]),
            np.array([[number(value) for value in row] for row in document["directions"]]),
            document["verdicts"],
        )

    @property
    def is_finite(self) -> bool:
        """Whether it is seen along every axis."""
        return bool(np.isfinite(self.semi_axes).all())


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
    factor = _factor(ellipsoids, extent)
    figure = plotly_library().Figure()
    facing: list[dict[str, Any]] = []
    scaled: list[dict[str, Any]] = []
    _add_points(figure, outlook, facing)
    cameras = outlook.sights[:drawn]
    reach = _FRUSTUM * extent * (0.5 if len(cameras) > _MANY else 1.0)
    if cameras:
        _add_cameras(figure, cameras, reach, path)
    _add_names(figure, cameras, ellipsoids)
    figure.add_traces(list(more))
    _add_ellipsoids(figure, ellipsoids, factor, scaled, value_title)
    _add_open_lines(figure, ellipsoids, _OPEN * extent * (0.4 if len(ellipsoids) > _MANY else 1.0))
    if scattered is not None and len(scattered):
        _add_scattered(figure, ellipsoids[0].centre, scattered, factor, scaled)
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
        "factors": _factors(factor),
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


def _factor(ellipsoids: Sequence[Ellipsoid], extent: float) -> float:
    """A round number by which a typical ellipsoid becomes large enough to be seen."""
    largest = [float(e.semi_axes[np.isfinite(e.semi_axes)].max(initial=0.0)) for e in ellipsoids]
    known = [value for value in largest if value > 0.0]
    if not known:
        return 1.0
    wanted = _SHOWN * extent / (LEVELS[1][1] * float(np.median(known)))
    power = 10.0 ** math.floor(math.log10(wanted))
    return float(power * max(step for step in (1, 2, 5) if step * power <= wanted * 1.0000001))


def _factors(factor: float) -> list[float]:
    """Round numbers about a factor, 1 (as large as they are) among them."""
    exponent = math.floor(math.log10(factor) + 1e-9)
    steps = [step * 10.0**power for power in range(min(exponent - 2, 0), exponent + 2) for step in (1, 2, 5)]
    return [float(f"{step:.3g}") for step in steps if step >= min(1.0, factor / 100) * 0.999]


def _add_points(figure: Any, outlook: Outlook, facing: list[dict[str, Any]]) -> None:
    """In groups that face about the same way; each is one trace that the script can hide."""
    if not len(outlook.points):
        return
    go = plotly_library()
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
        x, y, z = outlook.points[mask].T.astype(np.float32)
        figure.add_trace(
            go.Scatter3d(
                x=x,
                y=y,
                z=z,
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
    go = plotly_library()
    if path:
        x, y, z = np.array([sight.pose[:3, 3] for sight in sights]).T
        style = {"color": "#64748b", "width": 2}
        figure.add_trace(go.Scatter3d(x=x, y=y, z=z, mode="lines", name="path", line=style, hoverinfo="skip"))
    lines = np.concatenate([frustum(sight.pose, sight.corners, reach) for sight in sights])
    x, y, z = lines.T
    figure.add_trace(
        go.Scatter3d(
            x=x,
            y=y,
            z=z,
            mode="lines",
            name="camera" if len(sights) == 1 else "cameras",
            line={"color": _COLOUR["camera"], "width": 3 if len(sights) <= _MANY else 1.5},
            hoverinfo="skip",
        )
    )


def _add_names(figure: Any, sights: Sequence[Sight], ellipsoids: Sequence[Ellipsoid]) -> None:
    """Whose camera is whose, and whose an ellipsoid is that is no camera's."""
    places = {e.name: e.centre for e in ellipsoids} | {s.name: s.pose[:3, 3] for s in sights}
    if not 1 < len(places) <= _MANY:
        return
    x, y, z = np.array(list(places.values())).T
    figure.add_trace(
        plotly_library().Scatter3d(
            x=x,
            y=y,
            z=z,
            mode="text",
            text=[_plain(name) for name in places],
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


def _sphere(rings: int, spokes: int) -> tuple[Floats, npt.NDArray[np.int32]]:
    """Vertices on the unit sphere, and triangles."""
    polar = np.linspace(0, np.pi, rings)[:, None]
    around = np.linspace(0, 2 * np.pi, spokes, endpoint=False)[None]
    vertices = np.stack(
        [np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar) + 0 * around], axis=-1
    ).reshape(-1, 3)
    row, column = np.meshgrid(np.arange(rings - 1), np.arange(spokes), indexing="ij")
    here, right = row * spokes + column, row * spokes + (column + 1) % spokes
    upper = np.stack([here, right, here + spokes], axis=-1)
    lower = np.stack([right, right + spokes, here + spokes], axis=-1)
    return vertices, np.concatenate([upper, lower]).reshape(-1, 3).astype(np.int32)


def _add_ellipsoids(
    figure: Any,
    ellipsoids: Sequence[Ellipsoid],
    factor: float,
    scaled: list[dict[str, Any]],
    value_title: str,
) -> None:
    """All of one level as one mesh; of what is seen along two axes only a disc, along one a line."""
    go = plotly_library()
    solid = [e for e in ellipsoids if np.isfinite(e.semi_axes).sum() >= 2]
    many = len(solid) > _MANY
    unit, triangles = _sphere(*((_SMALL_RINGS, _SMALL_SPOKES) if many else (_RINGS, _SPOKES)))
    coloured = [e.value for e in solid if math.isfinite(e.value)]
    for name, level in LEVELS if solid else ():
        offsets = np.concatenate([_stretched(unit, e, level) for e in solid])
        centres = np.repeat([e.centre for e in solid], len(unit), axis=0)
        faces = np.concatenate([triangles + k * len(unit) for k in range(len(solid))])
        style: dict[str, Any] = {"color": _COLOUR[name]}
        if coloured:
            values = np.repeat(
                [math.log10(e.value) if math.isfinite(e.value) else math.nan for e in solid], len(unit)
            )
            low, high = math.log10(min(coloured)), math.log10(max(coloured))
            ticks = np.linspace(low, max(high, low + 1e-3), 5)
            style = {
                "intensity": values,
                "colorscale": "Viridis",
                "reversescale": True,
                "cmin": low,
                "cmax": max(high, low + 1e-3),
                "showscale": name == LEVELS[0][0],
                "colorbar": {
                    "title": {"text": value_title, "side": "right"},
                    "tickvals": ticks.tolist(),
                    "ticktext": [f"{10.0**tick:.2g}" for tick in ticks],
                    "thickness": 12,
                    "len": 0.7,
                },
            }
        x, y, z = (centres + factor * offsets).T.astype(np.float32)
        i, j, k = faces.T
        scaled.append(_scaled(len(figure.data), centres, offsets))
        figure.add_trace(
            go.Mesh3d(
                x=x,
                y=y,
                z=z,
                i=i,
                j=j,
                k=k,
                name=f"{name} ellipsoid" + ("s" if len(solid) > 1 else ""),
                showlegend=True,
                opacity=1.0 if level == 1.0 else 0.35,
                hoverinfo="skip",
                lighting={"ambient": 0.6, "diffuse": 0.6, "specular": 0.1},
                **style,
            )
        )
    thin = [e for e in ellipsoids if np.isfinite(e.semi_axes).sum() == 1]
    if thin:
        ends: list[Floats] = []
        arms: list[Floats] = []
        for e in thin:
            axis = int(np.flatnonzero(np.isfinite(e.semi_axes))[0])
            along = LEVELS[1][1] * e.semi_axes[axis] * e.directions[axis]
            ends += [e.centre, e.centre, np.full(3, np.nan)]
            arms += [-along, along, np.zeros(3)]
        middles, offset = np.array(ends), np.array(arms)
        scaled.append(_scaled(len(figure.data), middles, offset))
        x, y, z = (middles + factor * offset).T
        style = {"color": _COLOUR["95 %"], "width": 7}
        figure.add_trace(
            go.Scatter3d(
                x=x,
                y=y,
                z=z,
                mode="lines",
                line=style,
                name="95 %, the one axis that is seen",
                hoverinfo="skip",
            )
        )


def _stretched(unit: Floats, ellipsoid: Ellipsoid, level: float) -> Floats:
    """(n, 3) from the centre; flat along what is not seen."""
    lengths = np.where(np.isfinite(ellipsoid.semi_axes), level * ellipsoid.semi_axes, 0.0)
    stretched: Floats = unit * lengths @ ellipsoid.directions
    return stretched


def _scaled(trace: int, centres: Floats, offsets: Floats) -> dict[str, Any]:
    return {"trace": trace, "centres": _packed(centres), "offsets": _packed(offsets)}


def _packed(values: Floats) -> str:
    return base64.b64encode(values.astype("<f4").tobytes()).decode()


def _add_open_lines(figure: Any, ellipsoids: Sequence[Ellipsoid], half: float) -> None:
    """A line through the centre along each direction without an ellipsoid; its length says nothing."""
    go = plotly_library()
    for verdict, words, dash in (
        ("unseen", "unseen direction (open line)", "solid"),
        ("not resolved", "direction not resolved (dashed)", "dash"),
    ):
        ends = []
        for e in ellipsoids:
            for length, direction, own in zip(e.semi_axes, e.directions, e.verdicts, strict=True):
                if not math.isfinite(length) and own == verdict:
                    ends += [e.centre - half * direction, e.centre + half * direction, np.full(3, np.nan)]
        if ends:
            x, y, z = np.array(ends).T
            style = {"color": _COLOUR[verdict], "width": 6 if len(ellipsoids) <= _MANY else 3, "dash": dash}
            figure.add_trace(
                go.Scatter3d(x=x, y=y, z=z, mode="lines", line=style, name=words, hoverinfo="skip")
            )


def _add_scattered(
    figure: Any, centre: Floats, errors: Floats, factor: float, scaled: list[dict[str, Any]]
) -> None:
    centres = np.broadcast_to(centre, errors.shape)
    scaled.append(_scaled(len(figure.data), centres, errors))
    x, y, z = (centres + factor * errors).T
    figure.add_trace(
        plotly_library().Scatter3d(
            x=x,
            y=y,
            z=z,
            mode="markers",
            name="estimates",
            marker={"size": 3.5, "color": "#0891b2", "line": {"width": 0}},
            hovertemplate="trial %{pointNumber}<extra></extra>",
        )
    )


def _plain(name: str) -> str:
    """A name in plotly's texts, which know a few tags."""
    return name.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


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
    for e in ellipsoids[:_MANY]:
        known = [f"{value:.3g}" for value in e.semi_axes if math.isfinite(value)]
        hidden = [verdict for verdict in e.verdicts if verdict != "seen"]
        parts.append(
            f"{e.name}: semi-axes at one standard deviation {', '.join(known) or 'none'}"
            + (f", {', '.join(hidden)}" if hidden else "")
        )
    return "; ".join(parts)
