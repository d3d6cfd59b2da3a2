"""Pictures of a bound: the render, the Jacobian's columns, where the information is, the ellipsoids.

Every function draws into the axes that it is given and returns what it drew; `bound_page` composes them.
Nothing here uses pyplot, so that no global state of matplotlib's is read or changed. Colour maps have a
luminance that rises, or that falls from the middle to both sides, in hues that colour-blind people tell
apart; what else is told by colour is told by a marker or a line's style as well.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt
from matplotlib.colors import LogNorm
from matplotlib.patches import Polygon, Rectangle
from matplotlib.ticker import MaxNLocator, NullLocator

from ..noise.covariance import symmetric_root

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.image import AxesImage

    from ..bound.cramer_rao import PoseBound

MAP_CELLS = 64
"""Cells that the information map is wide, at least, where the image has so many pixels."""

SEQUENTIAL = "magma"
"""Colour map of what is not negative: its luminance rises from black to white."""
DIVERGING = "RdBu_r"
"""Colour map of what has a sign: blue is negative, red positive, and the brighter the nearer to zero."""

_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # ITU-R BT.709, of linear RGB
_UNMEASURED = "#c9c9c9"
MUTED = "#606060"
_COLOURS = {"position": "#2166ac", "rotation": "#b2182b"}
_CHOSEN = "#e6550d"
_RULES = (("#e6550d", "o-"), ("#1b7837", "s--"), ("#2166ac", "^-."), ("#762a83", "v:"), ("#606060", "D-"))
"""Colour, marker and line of each rule."""
AXIS_NAMES = {"position": ("x", "y", "z"), "rotation": ("pitch", "yaw", "roll")}
_UNITS = {"position": "scene unit", "rotation": "deg"}
_PLANES = ((0, 1), (0, 2), (1, 2))

_SPAN = 1e-4  # of a map's largest value; what is less has the darkest colour

# An unseen axis tilted out of a plane by less than this leaves the plane's picture finite; the same share
# (0.1² = 0.01) decides which standard deviations are infinite.
_TILT = 0.1


def draw_render(ax: Axes, image: npt.NDArray[np.floating[Any]], *, displayed: bool = False) -> AxesImage:
    """The image, with its 99th percentile as white, in sRGB.

    Args:
        ax: where to draw.
        image: (H, W, 3) linear RGB [radiance]; NaN (not measured) is drawn grey.
        displayed: its values are those of a display, 1 is white: drawn as they are.
    """
    measured = np.isfinite(image).all(axis=-1)
    white = np.percentile(image[measured], 99) if measured.any() and not displayed else 1.0
    shown = np.clip(np.nan_to_num(image) / (white if white > 0 else 1.0), 0.0, 1.0)
    if not displayed:
        shown = np.where(shown <= 0.0031308, 12.92 * shown, 1.055 * shown ** (1 / 2.4) - 0.055)
    shown[~measured] = int(_UNMEASURED[1:3], 16) / 255
    return draw_picture(ax, shown)


def draw_column(ax: Axes, column: npt.NDArray[np.floating[Any]], *, limit: float | None = None) -> AxesImage:
    """One Jacobian column's luminance: red brightens, blue darkens as the camera moves, white is no change.

    Args:
        ax: where to draw.
        column: (H, W, 3) dI/dξ_i; NaN (not measured) is drawn grey.
        limit: the symmetric colour limit, in the column's unit; default: `column_limit`.
    """
    limit = column_limit(column[..., None]) if limit is None else limit
    return draw_picture(ax, column @ _LUMINANCE, cmap=DIVERGING, vmin=-limit, vmax=limit)


def column_limit(columns: npt.NDArray[np.floating[Any]]) -> float:
    """The 99th percentile of the columns' absolute luminance, (H, W, 3, n) -> scalar; 1 where all is 0."""
    magnitude = np.abs(np.moveaxis(columns, -1, 0) @ _LUMINANCE)
    magnitude = magnitude[np.isfinite(magnitude)]
    limit = float(np.percentile(magnitude, 99)) if magnitude.size else 0.0
    return limit or float(magnitude.max(initial=0.0)) or 1.0


def map_block(width: int) -> int:
    """Side of the square blocks of which a map of an image of this width shows one value each [pixel]."""
    return max(1, width // MAP_CELLS)


def draw_information(
    ax: Axes, information: npt.NDArray[np.floating[Any]], *, block: int | None = None
) -> AxesImage:
    """The trace of the scaled Fisher information of every block of pixels, on a logarithmic scale.

    Args:
        ax: where to draw.
        information: (H, W) the pixels' shares of the trace (`Pictures.information`), in the noise
            model's units; NaN (not measured) counts as nothing, and blocks of nothing else are drawn grey.
            Blocks whose estimate is not positive have the darkest colour.
        block: the side of a block [pixel]; default: `map_block`.
    """
    height, width = information.shape
    side = map_block(width) if block is None else block
    corners = np.arange(0, height, side), np.arange(0, width, side)

    def sums(values: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.floating[Any]]:
        return np.add.reduceat(np.add.reduceat(values, corners[0], axis=0), corners[1], axis=1)

    trace = sums(np.nan_to_num(information))
    top = float(trace.max(initial=0.0)) or 1.0
    low = max(float(trace[trace > 0].min(initial=top)), _SPAN * top) * 0.999
    trace = np.where(sums(np.isfinite(information).astype(np.float64)) > 0, np.maximum(trace, low), np.nan)
    rows, columns = trace.shape
    drawn = draw_picture(
        ax,
        trace,
        cmap=SEQUENTIAL,
        norm=LogNorm(low, top, clip=True),
        extent=(-0.5, columns * side - 0.5, rows * side - 0.5, -0.5),
    )
    ax.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))  # the last blocks may reach beyond
    return drawn


def draw_ellipse(
    ax: Axes,
    semi_axes: npt.NDArray[np.float64],
    directions: npt.NDArray[np.float64],
    plane: tuple[int, int],
    *,
    reach: float,
    colour: str = "black",
    unresolved: bool = False,
) -> list[Artist]:
    """The shadow of an ellipsoid on a coordinate plane; a band, or all of it, where an axis is unseen.

    Args:
        ax: where to draw.
        semi_axes: (3,) lengths; infinite along unseen axes.
        directions: (3, 3) unit vectors, one a column.
        plane: the two coordinates to draw.
        reach: half the side of the drawn square, in the unit of `semi_axes`.
        colour: of outline and fill.
        unresolved: whether an infinite axis is not resolved, and not proven unseen: dashed, without hatching.
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
        angle = np.linspace(0, 2 * np.pi, 181)
        outline = (symmetric_root(finite @ finite.T) @ [np.cos(angle), np.sin(angle)]).T
    dashes = "--" if blind and unresolved else "-"
    drawn: list[Artist] = [
        ax.add_patch(Polygon(outline, facecolor=colour, edgecolor="none", alpha=0.16)),
        ax.add_patch(Polygon(outline, fill=False, edgecolor=colour, linewidth=1.6, linestyle=dashes)),
    ]
    if blind:
        if not unresolved:
            drawn[0].set(hatch="////", edgecolor=colour)
        badge = {"boxstyle": "round,pad=0.25", "facecolor": "white", "edgecolor": colour, "linewidth": 0.8}
        name = "not resolved" if unresolved else "unseen"
        drawn.append(ax.text(0, 0, name, color=colour, ha="center", va="center", fontsize=9, bbox=badge))
        if blind == 1:
            tip = 0.92 * reach * lines[:, 0] / np.abs(lines[:, 0]).max()
            style = {
                "arrowstyle": "<->",
                "color": colour,
                "linewidth": 1.2,
                "linestyle": dashes,
                "shrinkA": 0,
                "shrinkB": 0,
            }
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
    unresolved = np.array([v == "not resolved" for v in bound.verdicts_along(kind, directions)])
    extent = np.linalg.norm(directions[:, seen] * semi_axes[seen], axis=1).max(initial=0.0)
    exponent = int(np.floor(np.log10(extent))) if extent > 0 else 0
    reach = 1.3 * extent / 10.0**exponent if extent > 0 else 1.0
    unit = _UNITS[kind] if exponent == 0 else rf"$10^{{{exponent}}}$ {_UNITS[kind]}"
    drawn: list[Artist] = []
    for ax, plane in zip(axes, _PLANES, strict=True):
        drawn += draw_ellipse(
            ax,
            semi_axes / 10.0**exponent,
            directions,
            plane,
            reach=reach,
            colour=_COLOURS[kind],
            unresolved=bool(np.any(unresolved & (np.linalg.norm(directions[list(plane)], axis=0) > _TILT))),
        )
        ax.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
        ax.axhline(0, color=MUTED, linewidth=0.5, alpha=0.5, zorder=0)
        ax.axvline(0, color=MUTED, linewidth=0.5, alpha=0.5, zorder=0)
        for ruler in (ax.xaxis, ax.yaxis):  # no numbers where everything is unseen: there is no scale
            ruler.set_major_locator(MaxNLocator(4, symmetric=True) if extent > 0 else NullLocator())
        ax.tick_params(labelsize=8, colors=MUTED)
        for spine in ax.spines.values():
            spine.set(color=MUTED, linewidth=0.6)
        names = AXIS_NAMES[kind]
        ax.set_xlabel(f"{names[plane[0]]} [{unit}]", fontsize=9)
        ax.set_ylabel(names[plane[1]], fontsize=9, labelpad=1)
    return drawn


def draw_tiles(
    ax: Axes,
    image: npt.NDArray[np.floating[Any]],
    tiles: npt.NDArray[np.int64],
    chosen: Sequence[tuple[int, int]],
) -> list[Artist]:
    """An agent's image, the tiles that are sent as they are and the others dimmed.

    Args:
        ax: where to draw.
        image: (H, W, 3) linear RGB [radiance].
        tiles: (T, 4), x, y, width, height [pixel].
        chosen: index of each tile that is sent, and its place in the order of choice, which is written on it.
    """
    drawn: list[Artist] = [draw_render(ax, image)]
    order = dict(chosen)
    for index, (x, y, width, height) in enumerate(tiles.tolist()):
        corner = (x - 0.5, y - 0.5)
        if index in order:
            drawn.append(ax.add_patch(Rectangle(corner, width, height, fill=False, color=_CHOSEN, lw=1.4)))
            place = (x + width / 2 - 0.5, y + height / 2 - 0.5)
            badge = {"boxstyle": "round,pad=0.2", "fc": "white", "ec": _CHOSEN, "lw": 0.8}
            label = ax.text(*place, str(order[index]), ha="center", va="center", fontsize=8, bbox=badge)
            drawn.append(label)
        else:
            drawn.append(ax.add_patch(Rectangle(corner, width, height, color="white", alpha=0.62, lw=0)))
    return drawn


def draw_budget_curve(
    ax: Axes, budgets: Sequence[int], values: Mapping[str, Sequence[float]], *, bound: Sequence[float]
) -> list[Artist]:
    """What several rules are worth against the budget; what no rule exceeds is shaded.

    Args:
        ax: where to draw.
        budgets: ascending.
        values: by rule, one per budget; infinite ones are left out.
        bound: the upper bound for each budget.
    """
    limit = np.asarray(bound, dtype=np.float64)
    finite = [np.where(np.isfinite(v), v, np.nan) for v in (np.asarray(v, float) for v in values.values())]
    low = float(np.nanmin([*(np.nanmin(v) for v in finite), limit.min()]))
    high = float(limit.max())
    margin = 0.06 * (high - low or 1.0)
    drawn: list[Artist] = [
        ax.fill_between(
            budgets, limit, high + margin, color=_UNMEASURED, alpha=0.6, lw=0, label="out of reach"
        )
    ]
    for name, numbers, (colour, style) in zip(values, finite, cycle(_RULES), strict=False):
        drawn += ax.plot(budgets, numbers, style, markersize=4, lw=1.4, color=colour, label=name)
    ends = np.array([min(budgets), max(budgets)])
    ax.set(ylim=(low - margin, high + margin), xlim=ends + 0.02 * np.ptp(ends) * np.array([-1, 1]))
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.grid(alpha=0.25)
    ax.tick_params(labelsize=9, colors=MUTED)
    drawn.append(ax.legend(fontsize=9, frameon=False, loc="lower right"))
    return drawn


def draw_picture(ax: Axes, values: npt.NDArray[np.floating[Any]], **style: Any) -> AxesImage:
    """An image without ticks, one value or colour a pixel; NaN is drawn grey.

    Where the axes have fewer dots than the image has pixels, these are averaged: leaving some out would make
    specks and broken lines of what is fine.
    """
    ax.set(xticks=[], yticks=[], facecolor=_UNMEASURED)
    for spine in ax.spines.values():
        spine.set(color=MUTED, linewidth=0.6)
    dots = ax.get_window_extent()
    fits = values.shape[0] <= dots.height and values.shape[1] <= dots.width
    return ax.imshow(values, interpolation="nearest" if fits else "antialiased", **style)
