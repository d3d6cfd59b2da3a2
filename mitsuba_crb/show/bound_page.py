"""The page of `mitsuba-crb bound --plot`: everything about one bound, laid out by the inch."""

from __future__ import annotations

import dataclasses
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np
import numpy.typing as npt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from ..files import atomic
from ..measure.pictures import Pictures
from ..noise.measured import DISPLAY_REFERRED, RADIANCE
from .plot import (
    AXIS_NAMES,
    MUTED,
    column_limit,
    draw_column,
    draw_ellipsoid,
    draw_information,
    draw_picture,
    draw_render,
    map_block,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.image import AxesImage

    from ..bound.cramer_rao import PoseBound

_CAMERA_AXES = ("x (left)", "y (up)", "z (forward)")
_WORLD_AXES = ("world x", "world y", "world z")

# inches
_WIDTH, _LEFT, _RIGHT, _GAP, _BAR_GAP = 16.0, 0.4, 1.0, 0.2, 1.2
_BOX = (_WIDTH - _LEFT - _RIGHT - _BAR_GAP - 2 * _GAP) / 4  # a picture's width, at most
_HEADER, _CAPTION, _PANEL = 0.85, 0.55, 1.2
_HEADS = 1.0  # two lines above the ellipsoids
_WORDS = 0.75  # below the weakest direction's picture, and below the ellipsoids
_BAR = (0.12, 0.14)  # distance and width of a colour bar
_TALLEST = 1.2  # a picture's box, in its widths

_Real = TypeVar("_Real", np.float32, np.float64)
Place = Callable[[float, float, float, float], "Axes"]


def bound_figure(bound: PoseBound, pictures: Pictures, *, sigma: float = 1.0) -> Figure:
    """The whole story of a bound on one page.

    Render, information map and the pixels' shares in the weakest direction on the left, the six Jacobian
    columns beside them (one colour scale for translation, one for rotation), the position and rotation
    ellipsoids at `sigma` standard deviations below.
    """
    selection = bound.information.selection
    if selection.kind == "random":  # stands for the whole image
        pictures = _whole(pictures, selection.selected / selection.total)
    height, width = pictures.image.shape[:2]
    high = _BOX * min(height / width, _TALLEST)
    wide = high * width / height
    total = _HEADER + 2 * (high + _CAPTION) + max(_CAPTION + high, _HEADS + _PANEL) + _WORDS
    figure = Figure(figsize=(_WIDTH, total), facecolor="white")
    FigureCanvasAgg(figure)

    def place(left: float, top: float, wide: float, high: float) -> Axes:
        return figure.add_axes((left / _WIDTH, 1 - (top + high) / total, wide / _WIDTH, high / total))

    _title(figure, bound, pictures, total)
    lefts = [_LEFT, *(_LEFT + _BOX + _BAR_GAP + axis * (_BOX + _GAP) for axis in range(3))]
    lefts = [left + (_BOX - wide) / 2 for left in lefts]
    tops = [_HEADER + _CAPTION + row * (high + _CAPTION) for row in range(2)]
    grid = [[place(left, top, wide, high) for left in lefts] for top in tops]

    def place_bar(column: int, row: int) -> Axes:
        return place(lefts[column] + wide + _BAR[0], tops[row], _BAR[1], high)

    image, columns = pictures.image, pictures.columns
    measures = bound.provenance.get("measures", {})
    measures = measures.get("colour", measures)
    measured_unit = measures.get("unit", RADIANCE)
    displayed = measured_unit == DISPLAY_REFERRED
    draw_render(grid[0][0], image, displayed=displayed)
    white = "as it is displayed" if displayed else "sRGB, white at the 99th percentile"
    _caption(grid[0][0], "Render", white, wide)
    _caption(grid[1][0], "Fisher information", f"trace per {_cell(width)}", wide)
    if bound.rank:
        drawn = draw_information(grid[1][0], pictures.information)
        _map_bar(figure, drawn, place_bar(0, 1))
    else:
        _empty(grid[1][0], (height, width))

    names = _CAMERA_AXES if pictures.frame == "camera" else _WORLD_AXES
    motions = ((r"\rho", "translation along", "scene unit"), (r"\varphi", "rotation about", "rad"))
    for row, (symbol, motion, unit) in enumerate(motions):
        limit = column_limit(columns[..., 3 * row : 3 * row + 3])
        for axis, ax in enumerate(grid[row][1:]):
            drawn = draw_column(ax, columns[..., 3 * row + axis], limit=limit)
            name = rf"$\partial I / \partial {symbol}_{'xyz'[axis]}$"
            _caption(ax, name, f"{motion} {names[axis]}", wide)
        _signed_bar(figure, drawn, place_bar(3, row), f"{measured_unit} / {unit}")

    top = tops[1] + high
    _weakest(figure, place, pictures, (lefts[0], top + _CAPTION, wide, high))
    _ellipsoids(place, bound, _LEFT + _BOX + _BAR_GAP - 0.15, top, sigma)
    return figure


def write_plot(path: Path, bound: PoseBound, pictures: Pictures) -> None:
    """Write `bound_figure` as a PNG."""
    figure = bound_figure(bound, pictures)
    with atomic(path) as temporary:
        figure.savefig(temporary, format="png", dpi=130)


def _caption(ax: Axes, name: str, explanation: str, wide: float) -> None:
    ax.set_title(name, loc="left", fontsize=12, pad=5)
    if wide > 3.0:  # inches; in less the two would run into each other
        ax.set_title(explanation, loc="right", fontsize=9, color=MUTED, pad=5)


def _cell(width: int) -> str:
    """What one value of a map of an image of this width is for."""
    block = map_block(width)
    return f"{block}×{block} pixels" if block > 1 else "pixel"


def _map_bar(figure: Figure, drawn: AxesImage, cax: Axes) -> None:
    bar = figure.colorbar(drawn, cax=cax, extend="min", extendfrac=0.03)
    bar.ax.tick_params(which="both", labelsize=8)


def _signed_bar(figure: Figure, drawn: AxesImage, cax: Axes, label: str) -> None:
    # the power of ten goes into the label: matplotlib would put it where the next caption is
    limit = float(drawn.get_clim()[1])
    exponent = int(np.floor(np.log10(limit)))
    exponent = exponent if abs(exponent) > 2 else 0
    bar = figure.colorbar(drawn, cax=cax, extend="both", extendfrac=0.03)
    bar.formatter = FuncFormatter(lambda value, _: f"{value / 10.0**exponent:.3g}".replace("-", "−"))
    bar.ax.tick_params(labelsize=8)
    bar.set_label(rf"$10^{{{exponent}}}$ {label}" if exponent else label, fontsize=9)


def _whole(pictures: Pictures, fraction: float) -> Pictures:
    """A random subset, this fraction of all pixels, with the nearest one's values everywhere."""
    return dataclasses.replace(
        pictures,
        image=_filled(pictures.image),
        columns=_filled(pictures.columns),
        information=fraction * _filled(pictures.information),
        weakest_share=fraction * _filled(pictures.weakest_share),
    )


def _filled(values: npt.NDArray[_Real]) -> npt.NDArray[_Real]:
    """(H, W, ...) with every unmeasured pixel given its nearest measured one's value."""
    from scipy.ndimage import distance_transform_edt

    measured = np.isfinite(values).all(axis=tuple(range(2, values.ndim)))
    if measured.all() or not measured.any():
        return values
    rows, columns = distance_transform_edt(~measured, return_distances=False, return_indices=True)
    filled: npt.NDArray[_Real] = values[rows, columns]
    return filled


def _title(figure: Figure, bound: PoseBound, pictures: Pictures, total: float) -> None:
    facts = bound.provenance
    height, width = pictures.image.shape[:2]
    parts = [f"{width}×{height} pixels"]
    selection = bound.information.selection
    if selection.kind != "all":
        shown = ", the nearest one shown for the others" if selection.kind == "random" else ""
        parts.append(f"{selection.description} of them{shown}")
    if not np.isfinite(pictures.image).all():
        parts.append("grey: not measured")
    if "method" in facts:
        parts.append(
            facts["method"] if facts.get("deterministic") else f"{facts['method']}, {facts['spp']} spp"
        )
    if "sigma" in facts.get("noise", {}):
        parts.append(f"noise σ = {facts['noise']['sigma']:.3g}")
    parts += [f"rank {bound.rank} of 6", f"length scale {bound.length_scale:.3g} scene units"]
    name = Path(str(facts.get("scene", bound.information.variable))).stem
    left = _LEFT / _WIDTH
    figure.text(left, 1 - 0.2 / total, name, fontsize=17, weight="bold", va="top", parse_math=False)
    summary = "   ·   ".join(parts)
    figure.text(left, 1 - 0.58 / total, summary, fontsize=10.5, color=MUTED, va="top", parse_math=False)


def _weakest(
    figure: Figure, place: Place, pictures: Pictures, box: tuple[float, float, float, float]
) -> None:
    """Where the information about the weakest direction is, and that direction in words."""
    left, top, wide, high = box
    ax = place(left, top, wide, high)
    _caption(ax, "Weakest direction", f"share per {_cell(pictures.image.shape[1])}", wide)
    if pictures.weakest is None:
        _empty(ax, pictures.image.shape[:2])
        return
    drawn = draw_information(ax, pictures.weakest_share)
    _map_bar(figure, drawn, place(left + wide + _BAR[0], top, _BAR[1], high))
    words = textwrap.fill(pictures.weakest.description, int(18 * _BOX))
    ax.text(0, -0.03, words, transform=ax.transAxes, va="top", fontsize=8, color=MUTED)


def _empty(ax: Axes, shape: tuple[int, ...]) -> None:
    height, width = shape
    draw_picture(ax, np.full((height, width), np.nan))
    ax.text(width / 2, height / 2, "none", ha="center", va="center", color=MUTED)


def _ellipsoids(place: Place, bound: PoseBound, left: float, top: float, sigma: float) -> None:
    """Two groups of three square panels, each group under a line with its standard deviations."""
    step = (_WIDTH - left - 0.15) / 6
    position = (bound.position_std, bound.position_verdict, bound.position_std_lower_limit)
    rotation = (bound.rotation_std_deg, bound.rotation_verdict, bound.rotation_std_deg_lower_limit)
    heads: tuple[tuple[Literal["position", "rotation"], str, tuple[Any, ...], str], ...] = (
        ("position", "Position along world axes", position, ""),
        ("rotation", "Rotation about camera axes", rotation, "°"),
    )
    for group, (kind, head, numbers_of, unit) in enumerate(heads):
        lefts = [left + (3 * group + panel) * step + 0.4 for panel in range(3)]
        panels = [place(left, top + _HEADS, _PANEL, _PANEL) for left in lefts]
        draw_ellipsoid(panels, bound, kind, sigma=sigma)
        numbers = ", ".join(
            f"{name} {_deviation(value, verdict, limit, unit)}"
            for name, value, verdict, limit in zip(AXIS_NAMES[kind], *numbers_of, strict=True)
        )
        panels[0].set_title(f"{head}, {sigma:g}σ", loc="left", fontsize=12, pad=24)
        panels[0].annotate(
            f"σ: {numbers}", (0, 1), (0, 8), "axes fraction", "offset points", fontsize=9, color=MUTED
        )


def _deviation(value: float, verdict: str, limit: float, unit: str) -> str:
    if verdict == "seen":
        return f"{value:.2g}{unit}"
    return "∞ (unseen)" if verdict == "unseen" else f"> {limit:.2g}{unit}"
