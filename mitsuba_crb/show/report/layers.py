"""Pictures of a page: each a PNG to look at, and a grid of quantised numbers for what is under the pointer.

A grid has at most 256 x 192 cells, each the mean of the pixels in it (of information their sum, as in the
plots), in 16 bits: value = low + code (high - low) / 65533, of logarithms where the values span decades. Code
65535 is a cell that was not measured, 65534 one whose logarithm there is none of.
"""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps

from ...measure.outlook import Sight, to_srgb
from ..plot import column_limit, map_block

if TYPE_CHECKING:
    from ...measure.pictures import Pictures

GRID = (256, 192)
"""Columns and rows, at most."""
_SMALL_GRID = (96, 72)
"""Of one picture of many."""
_LEVELS = 65533
_NOT_POSITIVE, _UNMEASURED = 65534, 65535
_GREY = (150, 150, 150)
_LONGEST = 768
"""Pixels of a picture's longer side, at most: ten of them must not fill the page."""
_COLOURS = 255
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
_SPAN = 1e-4
_STOPS = 12

Values = npt.NDArray[np.floating[Any]]


def render_layer(
    image: Values, *, name: str, unit: str, displayed: bool, about: str = "", small: bool = False
) -> dict[str, Any]:
    """An image as it looks, its 99th percentile white unless its values are a display's.

    Args:
        image: (H, W, C), NaN where nothing was measured.
        name, unit, about: what it is.
        displayed: whether its values are those of a display, 1 is white.
        small: it is one of many, and may be compressed.
    """
    if image.shape[2] == 1:
        image = np.repeat(image, 3, axis=2)
    image = np.asarray(image, dtype=np.float64)
    cells = _means(image, _block(image.shape, _SMALL_GRID if small else GRID))
    size = [image.shape[1], image.shape[0]]
    image = _fit(image)
    measured = np.asarray(np.isfinite(image).all(axis=2))
    white = float(np.percentile(image[measured], 99)) if measured.any() and not displayed else 1.0
    shown = np.clip(np.nan_to_num(image) / (white if white > 0 else 1.0), 0.0, 1.0)
    if not displayed:
        shown = to_srgb(shown)
    shown = np.where(measured[..., None], 255 * shown, _GREY).round().astype(np.uint8)
    return {
        "name": name,
        "about": about or ("as it is displayed" if displayed else "sRGB, white at the 99th percentile"),
        "size": size,
        "png": (webp if small else png)(shown),
        "grid": {"unit": unit, "channels": ["R", "G", "B"], **_quantised(cells)},
    }


def sight_layers(sights: Sequence[Sight], *, small: bool = False) -> list[dict[str, Any]]:
    """The renders of those of some cameras that have one, by their names; `small` as for `render_layer`."""
    return [
        render_layer(
            sight.image,
            name=sight.name,
            unit="display value" if sight.displayed else "radiance",
            displayed=sight.displayed,
            about="a render of a few paths",
            small=small,
        )
        for sight in sights
        if sight.image is not None
    ]


def column_layer(column: Values, limit: float, *, name: str, unit: str, about: str) -> dict[str, Any]:
    """The luminance of one Jacobian column (H, W, C) in colours that are symmetric about white."""
    values = column @ _LUMINANCE if column.shape[2] == 3 else column[..., 0]
    cells = _means(values[..., None], _block(values.shape))
    return {
        "name": name,
        "about": about,
        "size": [values.shape[1], values.shape[0]],
        "png": coloured_png(_fit(values[..., None])[..., 0] / (2 * limit) + 0.5, "RdBu_r"),
        "grid": {"unit": unit, "channels": [""], **_quantised(cells)},
        "bar": {"colours": _stops("RdBu_r"), "low": -limit, "high": limit, "log": False},
    }


def map_layer(values: Values, *, name: str, unit: str, about: str, summed: bool) -> dict[str, Any]:
    """A map (H, W) of what is positive, on a logarithmic scale.

    Args:
        values: of pixels; NaN is not measured.
        name, unit, about: what it is.
        summed: whether cells are sums over their pixels, and not means.
    """
    height, width = values.shape
    block = max(map_block(width), -(-height // GRID[1])) if summed else _block(values.shape)
    cells = _means(values[..., None], block)
    if summed:
        cells = cells * _counts(values, block)[..., None]
    shown = cells[..., 0]
    positive = shown[np.isfinite(shown) & (shown > 0)]
    high = float(positive.max()) if positive.size else 1.0
    low = max(float(positive.min()), _SPAN * high) if positive.size else 0.1
    span = math.log(high / low) or 1.0
    with np.errstate(divide="ignore", invalid="ignore"):
        level = np.log(np.where(shown > low, shown, low) / low) / span
    level = np.where(np.isnan(shown), np.nan, level)
    return {
        "name": name,
        "about": f"{about}, {_cell(block, summed)}",
        "size": [width, height],
        "png": coloured_png(level, "magma"),
        "grid": {"unit": unit, "channels": [""], **_quantised(cells, log=True)},
        "bar": {"colours": _stops("magma"), "low": low, "high": high, "log": True},
    }


def picture_layers(pictures: Pictures, *, unit: str, displayed: bool) -> list[dict[str, Any]]:
    """The render, the six columns, where the information is, and where the paths went."""
    frame = "camera" if pictures.frame == "camera" else "world"
    axes = ("x (left)", "y (up)", "z (forward)") if frame == "camera" else ("x", "y", "z")
    layers = [render_layer(pictures.image, name="Render", unit=unit, displayed=displayed)]
    kinds = (("translation along", "scene unit", "ρ"), ("rotation about", "rad", "φ"))
    for kind, (motion, per, symbol) in enumerate(kinds):
        columns = pictures.columns[..., 3 * kind : 3 * kind + 3]
        limit = column_limit(columns) if columns.shape[2] == 3 else _limit(columns)
        for axis, letter in enumerate("xyz"):
            layers.append(
                column_layer(
                    columns[..., axis],
                    limit,
                    name=f"∂I/∂{symbol}{letter}",
                    unit=f"{unit} / {per}",
                    about=f"{motion} {frame} {axes[axis]}: red brightens, blue darkens",
                )
            )
    layers.append(
        map_layer(
            pictures.information,
            name="Information",
            unit="trace of F, translation in length scales",
            about="Fisher information",
            summed=True,
        )
    )
    if pictures.weakest is not None:
        layers.append(
            map_layer(
                pictures.weakest_share,
                name="Weakest direction",
                unit="of its information",
                about=f"shares of {pictures.weakest.description}",
                summed=True,
            )
        )
    if pictures.paths is not None:
        layers.append(
            map_layer(
                pictures.paths.astype(np.float64),
                name="Samples",
                unit="paths per pixel",
                about="sample density",
                summed=False,
            )
        )
    return layers


def _limit(columns: Values) -> float:
    magnitude = np.abs(columns[np.isfinite(columns)])
    return float(np.percentile(magnitude, 99)) or 1.0 if magnitude.size else 1.0


def _cell(block: int, summed: bool) -> str:
    return "per pixel" if block == 1 else f"{'sum' if summed else 'mean'} over {block}×{block} pixels"


def _block(shape: tuple[int, ...], grid: tuple[int, int] = GRID) -> int:
    """Side of the cells, in pixels, of an image's grid."""
    height, width = shape[:2]
    return max(-(-width // grid[0]), -(-height // grid[1]))


def _sums(values: Values, block: int) -> Values:
    rows, columns = (np.arange(0, n, block) for n in values.shape[:2])
    summed: Values = np.add.reduceat(np.add.reduceat(values, rows, axis=0), columns, axis=1)
    return summed


def _counts(values: Values, block: int) -> Values:
    return _sums(np.isfinite(values).astype(np.float64), block)


def _means(values: Values, block: int) -> Values:
    """(h, w, C) of what is measured in each cell; NaN where nothing is."""
    values = np.asarray(values, dtype=np.float64)
    counts = _counts(values.sum(axis=2), block)[..., None]
    with np.errstate(invalid="ignore"):
        return np.where(counts > 0, _sums(np.nan_to_num(values), block) / counts, np.nan)


def _quantised(cells: Values, *, log: bool = False) -> dict[str, Any]:
    """Codes of cells (h, w, C) in 16 bits, little end first, channel by channel within a cell."""
    good = np.isfinite(cells)
    positive = good & (cells > 0.0) if log else good
    with np.errstate(divide="ignore", invalid="ignore"):
        scaled = np.log(cells) if log else cells
    low = float(scaled[positive].min()) if positive.any() else 0.0
    high = float(scaled[positive].max()) if positive.any() else 1.0
    step = (high - low) / _LEVELS or 1.0
    codes = np.full(cells.shape, _UNMEASURED, dtype="<u2")
    codes[good] = _NOT_POSITIVE
    codes[positive] = np.clip(np.round((scaled[positive] - low) / step), 0, _LEVELS).astype("<u2")
    height, width = cells.shape[:2]
    data = base64.b64encode(codes.tobytes()).decode()
    return {"width": width, "height": height, "low": low, "step": step, "log": log, "codes": data}


def _stops(colours: str) -> list[str]:
    values = (255 * colormaps[colours](np.linspace(0, 1, _STOPS))[:, :3]).round().astype(int)
    return [f"rgb({r},{g},{b})" for r, g, b in values.tolist()]


def coloured_png(level: Values, colours: str) -> str:
    """A data address of levels from 0 to 1 (H, W) in colours, grey where there is none; a byte a pixel."""
    from PIL import Image

    table = (255 * colormaps[colours](np.linspace(0, 1, _COLOURS))[:, :3]).round().astype(np.uint8)
    codes = np.round(np.nan_to_num(level).clip(0.0, 1.0) * (_COLOURS - 1)).astype(np.uint8)
    codes[np.isnan(level)] = _COLOURS
    image = Image.fromarray(codes)
    image.putpalette([*table.ravel().tolist(), *_GREY])
    return _address(image, "PNG")


def png(pixels: npt.NDArray[np.uint8]) -> str:
    """A data address of an image (H, W, 3)."""
    from PIL import Image

    return _address(Image.fromarray(pixels), "PNG")


def webp(pixels: npt.NDArray[np.uint8]) -> str:
    """The same of many small photographs, a fifth of the size."""
    from PIL import Image

    return _address(Image.fromarray(pixels), "WEBP", quality=82)


def _fit(values: Values) -> Values:
    """An image (H, W, C) averaged until it is no larger than anybody looks at."""
    step = -(-max(values.shape[:2]) // _LONGEST)
    return values if step == 1 else _means(values, step)


def _address(image: Any, kind: str, **options: Any) -> str:
    file = io.BytesIO()
    image.save(file, kind, **options)
    return f"data:image/{kind.lower()};base64,{base64.b64encode(file.getvalue()).decode()}"
