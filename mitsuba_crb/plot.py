"""Pictures of a bound: the render, the Jacobian's columns, where the information is, the ellipsoids.

Every function draws into the axes that it is given and returns what it drew; `bound_figure` composes
them. Figures are built without pyplot, so that no global state of matplotlib's is read or changed.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.ticker import MaxNLocator, ScalarFormatter

from .export import Pictures, atomic
from .information import BLOCK

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.image import AxesImage

    from .bound import PoseBound

_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # ITU-R BT.709, of linear RGB
_UNMEASURED = "#c9c9c9"
_MUTED = "#606060"
_COLOURS = {"position": "#2166ac", "rotation": "#b2182b"}
_AXES = {"position": ("x", "y", "z"), "rotation": ("pitch", "yaw", "roll")}
_UNITS = {"position": "scene unit", "rotation": "deg"}
_CAMERA_AXES = ("x (left)", "y (up)", "z (forward)")
_WORLD_AXES = ("world x", "world y", "world z")
_PLANES = ((0, 1), (0, 2), (1, 2))

# An unseen axis tilted out of a plane by less than this leaves the plane's picture finite; the same share
# (0.1² = 0.01) decides which standard deviations are infinite.
_TILT = 0.1

# inches
_WIDTH, _LEFT, _RIGHT, _GAP, _BAR_GAP = 16.0, 0.4, 1.0, 0.2, 1.2
_HEADER, _CAPTION, _PANEL, _PANEL_GAP = 0.85, 0.55, 1.85, 0.75


def draw_render(ax: Axes, image: npt.NDArray[np.floating[Any]]) -> AxesImage:
    """The image, with its 99th percentile as white, in sRGB.

    Args:
        ax: where to draw.
        image: (H, W, 3) linear RGB [radiance]; NaN (not measured) is drawn grey.
    """
    measured = np.isfinite(image).all(axis=-1)
    white = np.percentile(image[measured], 99) if measured.any() else 1.0
    linear = np.clip(np.nan_to_num(image) / (white if white > 0 else 1.0), 0.0, 1.0)
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    srgb[~measured] = int(_UNMEASURED[1:3], 16) / 255
    return _picture(ax, srgb)


def draw_column(ax: Axes, column: npt.NDArray[np.floating[Any]], *, limit: float | None = None) -> AxesImage:
    """One Jacobian column's luminance: red brightens, blue darkens as the camera moves, white is no change.

    Args:
        ax: where to draw.
        column: (H, W, 3) dI/dξ_i; NaN (not measured) is drawn grey.
        limit: the symmetric colour limit, in the column's unit; default: `column_limit`.
    """
    limit = column_limit(column[..., None]) if limit is None else limit
    return _picture(ax, column @ _LUMINANCE, cmap="RdBu_r", vmin=-limit, vmax=limit)


def column_limit(columns: npt.NDArray[np.floating[Any]]) -> float:
    """The 99.5th percentile of the columns' absolute luminance, (H, W, 3, n) -> scalar; 1 where all is 0."""
    magnitude = np.abs(np.moveaxis(columns, -1, 0) @ _LUMINANCE)
    magnitude = magnitude[np.isfinite(magnitude)]
    limit = float(np.percentile(magnitude, 99.5)) if magnitude.size else 0.0
    return limit or float(magnitude.max(initial=0.0)) or 1.0


def draw_information(
    ax: Axes, information: npt.NDArray[np.floating[Any]], *, block: int = BLOCK
) -> AxesImage:
    """The trace of the scaled Fisher information of every block of pixels, on a logarithmic scale.

    Args:
        ax: where to draw.
        information: (H, W) the pixels' shares of the trace (`Pictures.information`), in the noise
            model's units; NaN (not measured) counts as nothing. Blocks whose estimate is not positive
            are drawn grey.
        block: the side of a block [pixel].
    """
    height, width = information.shape
    rows, columns = np.arange(0, height, block), np.arange(0, width, block)
    trace = np.add.reduceat(np.add.reduceat(np.nan_to_num(information), rows, axis=0), columns, axis=1)
    top = float(trace.max(initial=0.0)) or 1.0
    return _picture(
        ax,
        np.where(trace > 0, trace, np.nan),
        cmap="magma",
        norm=LogNorm(max(float(trace[trace > 0].min(initial=top)), 1e-4 * top) * 0.999, top, clip=True),
        extent=(-0.5, len(columns) * block - 0.5, len(rows) * block - 0.5, -0.5),
    )


def draw_ellipse(
    ax: Axes,
    semi_axes: npt.NDArray[np.float64],
    directions: npt.NDArray[np.float64],
    plane: tuple[int, int],
    *,
    reach: float,
    colour: str = "black",
) -> list[Artist]:
    """The shadow of an ellipsoid on a coordinate plane; a band, or all of it, where an axis is unseen.

    Args:
        ax: where to draw.
        semi_axes: (3,) lengths; infinite along unseen axes.
        directions: (3, 3) unit vectors, one a column.
        plane: the two coordinates to draw.
        reach: half the side of the drawn square, in the unit of `semi_axes`.
        colour: of outline and fill.
    """
    unseen = ~np.isfinite(semi_axes)
    shadow = directions[list(plane)]
    finite = shadow[:, ~unseen] * semi_axes[~unseen]
    lines, stretch, _ = np.linalg.svd(shadow[:, unseen]) if unseen.any() else (np.eye(2), np.zeros(0), None)
    blind = int(np.sum(stretch > _TILT))
    if blind == 2:
        outline = reach * np.array([[-2, -2], [2, -2], [2, 2], [-2, 2]], float)
    elif blind == 1:
        along, across = lines[:, 0], lines[:, 1]
        half_width = float(np.linalg.norm(across @ finite))
        corners = ((-1, -1), (1, -1), (1, 1), (-1, 1))
        outline = np.array([4 * reach * a * along + half_width * b * across for a, b in corners])
    else:
        # the ellipse M·(cos, sin) with M Mᵀ the projected shape matrix
        values, vectors = np.linalg.eigh(finite @ finite.T)
        angle = np.linspace(0, 2 * np.pi, 181)
        outline = (vectors * np.sqrt(np.clip(values, 0, None)) @ [np.cos(angle), np.sin(angle)]).T
    hatch = "////" if blind else None
    drawn: list[Artist] = [
        ax.add_patch(Polygon(outline, facecolor=colour, edgecolor="none", alpha=0.16)),
        ax.add_patch(Polygon(outline, fill=False, edgecolor=colour, linewidth=1.6)),
    ]
    if blind:
        drawn[0].set(hatch=hatch, edgecolor=colour)
        badge = {"boxstyle": "round,pad=0.25", "facecolor": "white", "edgecolor": colour, "linewidth": 0.8}
        drawn.append(ax.text(0, 0, "unseen", color=colour, ha="center", va="center", fontsize=9, bbox=badge))
        if blind == 1:
            tip = 0.92 * reach * lines[:, 0] / np.abs(lines[:, 0]).max()
            style = {"arrowstyle": "<->", "color": colour, "linewidth": 1.2, "shrinkA": 0, "shrinkB": 0}
            drawn.append(ax.annotate("", tip, -tip, arrowprops=style))
            drawn[-2].set_zorder(drawn[-1].get_zorder() + 1)
    return drawn


def draw_ellipsoid(
    axes: Sequence[Axes], bound: PoseBound, kind: Literal["position", "rotation"], *, sigma: float = 1.0
) -> list[Artist]:
    """The uncertainty ellipsoid's three shadows, to one scale, in world axes or about camera axes.

    Args:
        axes: three axes, for the planes xy, xz, yz.
        bound: whose ellipsoid.
        kind: "position" [scene unit], or "rotation" [deg].
        sigma: the level, in standard deviations; stated in the first axes' title.
    """
    semi_axes, directions = bound.ellipsoid(kind, sigma=sigma)
    seen = np.isfinite(semi_axes)
    extent = np.linalg.norm(directions[:, seen] * semi_axes[seen], axis=1).max(initial=0.0)
    exponent = int(np.floor(np.log10(extent))) if extent > 0 else 0
    reach = 1.3 * extent / 10.0**exponent if extent > 0 else 1.0
    unit = _UNITS[kind] if exponent == 0 else rf"$10^{{{exponent}}}$ {_UNITS[kind]}"
    drawn: list[Artist] = []
    for ax, plane in zip(axes, _PLANES, strict=True):
        drawn += draw_ellipse(
            ax, semi_axes / 10.0**exponent, directions, plane, reach=reach, colour=_COLOURS[kind]
        )
        ax.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
        ax.axhline(0, color=_MUTED, linewidth=0.5, alpha=0.5, zorder=0)
        ax.axvline(0, color=_MUTED, linewidth=0.5, alpha=0.5, zorder=0)
        ax.xaxis.set_major_locator(MaxNLocator(4, symmetric=True))
        ax.yaxis.set_major_locator(MaxNLocator(4, symmetric=True))
        ax.tick_params(labelsize=8, colors=_MUTED)
        for spine in ax.spines.values():
            spine.set(color=_MUTED, linewidth=0.6)
        names = _AXES[kind]
        ax.set_xlabel(f"{names[plane[0]]} [{unit}]", fontsize=9)
        ax.set_ylabel(names[plane[1]], fontsize=9, labelpad=1)
    return drawn


def bound_figure(bound: PoseBound, pictures: Pictures, *, sigma: float = 1.0) -> Figure:
    """The whole story of a bound on one page.

    Render and information map on the left, the six Jacobian columns beside them (one colour scale for
    translation, one for rotation), the position and rotation ellipsoids at `sigma` standard deviations
    below.
    """
    height, width = pictures.image.shape[:2]
    picture_width = (_WIDTH - _LEFT - _RIGHT - _BAR_GAP - 2 * _GAP) / 4
    picture_height = picture_width * float(np.clip(height / width, 0.3, 1.5))
    ellipses = _PANEL + 1.35
    total = _HEADER + 2 * (picture_height + _CAPTION) + ellipses
    figure = Figure(figsize=(_WIDTH, total), facecolor="white")
    FigureCanvasAgg(figure)

    def place(left: float, top: float, wide: float, high: float) -> Axes:
        return figure.add_axes((left / _WIDTH, 1 - (top + high) / total, wide / _WIDTH, high / total))

    _title(figure, bound, pictures, total)
    image, columns = pictures.image, pictures.columns
    if bound.information.selection.kind == "random":  # stands for the whole image, so show it whole
        image, columns = _filled(image), _filled(columns)
    tops = [_HEADER + _CAPTION + row * (picture_height + _CAPTION) for row in range(2)]
    ax = place(_LEFT, tops[0], picture_width, picture_height)
    draw_render(ax, image)
    _caption(ax, "Render", "sRGB, white at the 99th percentile")

    ax = place(_LEFT, tops[1], picture_width, picture_height)
    _caption(ax, "Fisher information", f"trace per {BLOCK}×{BLOCK} block")
    if bound.rank:
        bar = place(_LEFT + picture_width + 0.12, tops[1], 0.14, picture_height)
        drawn = draw_information(ax, pictures.information)
        figure.colorbar(drawn, cax=bar).ax.tick_params(which="both", labelsize=8)
    else:
        _picture(ax, np.full((1, 1), np.nan))
        ax.text(0, 0, "none", ha="center", va="center", color=_MUTED)

    axes_names = (
        ("left", "up", "forward") if pictures.frame == "camera" else ("world x", "world y", "world z")
    )
    for row, (symbol, motion, unit) in enumerate(
        ((r"\rho", "translation along", "scene unit"), (r"\varphi", "rotation about", "rad"))
    ):
        limit = column_limit(columns[..., 3 * row : 3 * row + 3])
        for axis in range(3):
            left = _LEFT + picture_width + _BAR_GAP + axis * (picture_width + _GAP)
            ax = place(left, tops[row], picture_width, picture_height)
            drawn = draw_column(ax, columns[..., 3 * row + axis], limit=limit)
            _caption(ax, rf"$\partial I / \partial {symbol}_{'xyz'[axis]}$", f"{motion} {axes_names[axis]}")
        bar = place(left + picture_width + 0.12, tops[row], 0.14, picture_height)
        _signed_bar(figure, drawn, bar, f"radiance / {unit}")

    _ellipsoids(figure, place, bound, tops[1] + picture_height, sigma)
    return figure


def write_plot(path: Path, bound: PoseBound, pictures: Pictures) -> None:
    """Write `bound_figure` as a PNG."""
    figure = bound_figure(bound, pictures)
    with atomic(path) as temporary:
        figure.savefig(temporary, format="png", dpi=130)


def _picture(ax: Axes, values: npt.NDArray[np.floating[Any]], **style: Any) -> AxesImage:
    ax.set(xticks=[], yticks=[], facecolor=_UNMEASURED)
    for spine in ax.spines.values():
        spine.set(color=_MUTED, linewidth=0.6)
    return ax.imshow(values, interpolation="nearest", **style)


def _caption(ax: Axes, name: str, explanation: str) -> None:
    ax.set_title(name, loc="left", fontsize=12, pad=5)
    ax.set_title(explanation, loc="right", fontsize=9, color=_MUTED, pad=5)


def _signed_bar(figure: Figure, drawn: AxesImage, cax: Axes, label: str) -> None:
    formatter = ScalarFormatter(useMathText=True)
    formatter.set_powerlimits((-2, 3))
    bar = figure.colorbar(drawn, cax=cax, format=formatter, extend="both", extendfrac=0.03)
    bar.ax.tick_params(labelsize=8)
    bar.ax.yaxis.get_offset_text().set(fontsize=8)
    bar.set_label(label, fontsize=9)


def _filled(values: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.floating[Any]]:
    """(H, W, ...) with every unmeasured pixel given its nearest measured one's value."""
    from scipy.ndimage import distance_transform_edt

    measured = np.isfinite(values).all(axis=tuple(range(2, values.ndim)))
    if measured.all() or not measured.any():
        return values
    rows, columns = distance_transform_edt(~measured, return_distances=False, return_indices=True)
    filled: npt.NDArray[np.floating[Any]] = values[rows, columns]
    return filled


def _title(figure: Figure, bound: PoseBound, pictures: Pictures, total: float) -> None:
    facts = bound.provenance
    height, width = pictures.image.shape[:2]
    parts = [f"{width}×{height} pixels"]
    if bound.information.selection.kind != "all":
        parts.append(f"{bound.information.selection.description} of them")
    if "method" in facts:
        parts.append(f"{facts['method']}, {facts['spp']} spp")
    if "sigma" in facts.get("noise", {}):
        parts.append(f"noise σ = {facts['noise']['sigma']:.3g}")
    parts += [f"rank {bound.rank} of 6", f"length scale {bound.length_scale:.3g} scene units"]
    name = Path(str(facts.get("scene", bound.information.variable))).stem
    left = _LEFT / _WIDTH
    figure.text(left, 1 - 0.2 / total, name, fontsize=17, weight="bold", va="top")
    summary = "   ·   ".join(parts)
    figure.text(left, 1 - 0.58 / total, summary, fontsize=10.5, color=_MUTED, va="top")


def _ellipsoids(figure: Figure, place: Any, bound: PoseBound, top: float, sigma: float) -> None:
    """Two groups of three square panels, each group under a line with its standard deviations."""
    step = (_WIDTH - _LEFT - 0.15) / 6
    heads: tuple[tuple[Literal["position", "rotation"], str, npt.NDArray[np.float64], str], ...] = (
        ("position", "Position along world axes", bound.position_std, ""),
        ("rotation", "Rotation about camera axes", bound.rotation_std_deg, "°"),
    )
    for group, (kind, head, deviations, unit) in enumerate(heads):
        lefts = [_LEFT + (3 * group + panel) * step + _PANEL_GAP - 0.2 for panel in range(3)]
        panels = [place(left, top + 0.75, _PANEL, _PANEL) for left in lefts]
        draw_ellipsoid(panels, bound, kind, sigma=sigma)
        numbers = ", ".join(
            f"{name} {f'{value:.2g}{unit}' if np.isfinite(value) else '∞ (unseen)'}"
            for name, value in zip(_AXES[kind], deviations, strict=True)
        )
        title = panels[0].set_title(f"{head}, {sigma:g}σ", loc="left", fontsize=12, pad=8)
        title.set_x(0)
        panels[2].set_title(f"σ: {numbers}", loc="right", fontsize=9, color=_MUTED, pad=8)
