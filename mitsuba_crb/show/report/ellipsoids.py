"""Errors of position in the interactive view: ellipsoids, and lines where there is none.

Ellipsoids are drawn at one standard deviation and at 95 % of the probability, both enlarged by a round factor
that the page states and the reader may change. A direction that is unseen is an open line, one that is not
resolved a dashed line, both of a length without a meaning.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from .page import plotly_library
from .tables import number
from .traces import lines, scatter

LEVELS = (("1σ", 1.0), ("95 %", 2.795483482915))  # root of the 95 % quantile of χ²_3
"""Names of the ellipsoids, and their semi-axes in standard deviations."""
MANY = 12
"""Ellipsoids from which on they are drawn of fewer triangles."""

_SHOWN = 0.09
"""Of the world's extent, what the 95 % ellipsoid's largest semi-axis is drawn as."""
_COLOUR = {
    "1σ": "#ea580c",
    "95 %": "#f59e0b",
    "unseen": "#db2777",
    "not resolved": "#8b5cf6",
}
_RINGS, _SPOKES = 13, 24
_SMALL_RINGS, _SMALL_SPOKES = 7, 12

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


def enlargement(ellipsoids: Sequence[Ellipsoid], extent: float) -> float:
    """A round number by which a typical ellipsoid becomes large enough to be seen."""
    largest = [float(e.semi_axes[np.isfinite(e.semi_axes)].max(initial=0.0)) for e in ellipsoids]
    known = [value for value in largest if value > 0.0]
    if not known:
        return 1.0
    wanted = _SHOWN * extent / (LEVELS[1][1] * float(np.median(known)))
    power = 10.0 ** math.floor(math.log10(wanted))
    return float(power * max(step for step in (1, 2, 5) if step * power <= wanted * 1.0000001))


def enlargements(factor: float) -> list[float]:
    """Round numbers about a factor, 1 (as large as they are) among them."""
    exponent = math.floor(math.log10(factor) + 1e-9)
    steps = [step * 10.0**power for power in range(min(exponent - 2, 0), exponent + 2) for step in (1, 2, 5)]
    return [float(f"{step:.3g}") for step in steps if step >= min(1.0, factor / 100) * 0.999]


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


def add_ellipsoids(
    figure: Any,
    ellipsoids: Sequence[Ellipsoid],
    factor: float,
    scaled: list[dict[str, Any]],
    value_title: str,
) -> None:
    """All of one level as one mesh; of what is seen along two axes only a disc, along one a line."""
    solid = [e for e in ellipsoids if np.isfinite(e.semi_axes).sum() >= 2]
    many = len(solid) > MANY
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
            plotly_library().Mesh3d(
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
        style = {"color": _COLOUR["95 %"], "width": 7}
        figure.add_trace(lines(middles + factor * offset, style, name="95 %, the one axis that is seen"))


def _stretched(unit: Floats, ellipsoid: Ellipsoid, level: float) -> Floats:
    """(n, 3) from the centre; flat along what is not seen."""
    lengths = np.where(np.isfinite(ellipsoid.semi_axes), level * ellipsoid.semi_axes, 0.0)
    stretched: Floats = unit * lengths @ ellipsoid.directions
    return stretched


def _scaled(trace: int, centres: Floats, offsets: Floats) -> dict[str, Any]:
    return {"trace": trace, "centres": _packed(centres), "offsets": _packed(offsets)}


def _packed(values: Floats) -> str:
    return base64.b64encode(values.astype("<f4").tobytes()).decode()


def add_open_lines(figure: Any, ellipsoids: Sequence[Ellipsoid], half: float) -> None:
    """A line through the centre along each direction without an ellipsoid; its length says nothing."""
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
            style = {"color": _COLOUR[verdict], "width": 6 if len(ellipsoids) <= MANY else 3, "dash": dash}
            figure.add_trace(lines(np.array(ends), style, name=words))


def add_scattered(
    figure: Any, centre: Floats, errors: Floats, factor: float, scaled: list[dict[str, Any]]
) -> None:
    """Errors (n, 3) of trials about a centre [scene unit], enlarged as the ellipsoids."""
    centres = np.broadcast_to(centre, errors.shape)
    scaled.append(_scaled(len(figure.data), centres, errors))
    figure.add_trace(
        scatter(
            centres + factor * errors,
            mode="markers",
            name="estimates",
            marker={"size": 3.5, "color": "#0891b2", "line": {"width": 0}},
            hovertemplate="trial %{pointNumber}<extra></extra>",
        )
    )
