"""How like a photograph the render at its pose is: poses read in another convention show something else.

The photograph, decoded from sRGB and averaged down to few pixels, is y; the render there is R. Exposure,
white balance and haze are not known, so that each channel is fitted by least squares,

    y ≈ gain R + black,   PSNR = −10 lg mean (s(y) − s(gain R + black))² [dB],

s being the curve of sRGB, whose values are what is seen; of what is darker than black, or lighter than white,
that of black and white. What is saturated in the photograph takes no part in the fit, for the render goes on
above white; what the photograph masks by its opacity takes no part at all, nor what is black in the render:
scans have holes. Renders that are display-referred are decoded likewise.

A photograph without contrast is like anything: beside it stands the PSNR of an even colour, gain = 0.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..datasets.pictures import averaged, same_shape
from ..errors import CaptureError
from ..files import read_colours
from ..jacobian.method import Paths
from ..noise import SRGB
from ..se3 import Array

if TYPE_CHECKING:
    from .measurable import Measurable

POOR_DB = 18.0
"""Below this the render and the photograph show different things."""
LEAST_GAIN_DB = 3.0
"""Likewise, where the render explains less than half of what an even colour leaves."""

_SIDE = 128
"""Pixels of the longer side that are compared, where there are so many."""
_SPP = 64
_BATCHES = 4
_SATURATED = 0.98
_LIKENESS = 0x4C494B45
"""Purpose of the render's random numbers."""


class Likeness(NamedTuple):
    """Of a render and the photograph at its pose; NaN where there is none."""

    psnr_db: float = math.nan
    """Infinite where they are the same [dB]."""
    even_psnr_db: float = math.nan
    """That of an even colour in the render's place [dB]."""


UNKNOWN = Likeness()
"""Where there is nothing to compare."""


def unlike(found: Sequence[Likeness]) -> bool:
    """Whether most renders, at the median, show something else than their photographs."""
    values = np.array([one for one in found if not math.isnan(one.psnr_db)]).reshape(-1, 2)
    if not len(values):
        return False
    return bool(np.median(values[:, 0]) < POOR_DB or np.median(values[:, 0] - values[:, 1]) < LEAST_GAIN_DB)


def likeness(image: Array, photograph: Array, opacity: Array) -> Likeness:
    """Of a render and a photograph.

    Args:
        image: (H, W, 3) [radiance].
        photograph: (H, W, 3), linear, from 0 to 1.
        opacity: (H, W), from 0, where the photograph shows nothing of the scene, to 1.
    """
    shown = np.isfinite(image).all(axis=2) & (image > 0.0).any(axis=2)
    weight = np.where(shown, opacity, 0.0).ravel()
    if not weight.any():
        return UNKNOWN
    errors: tuple[list[Array], list[Array]] = ([], [])
    for values, seen in zip(image.reshape(-1, 3).T, photograph.reshape(-1, 3).T, strict=True):
        rows = np.stack([np.nan_to_num(values), np.ones(len(values))], axis=1)
        root = np.sqrt(np.where(seen < _SATURATED, weight, 0.0))
        for kind, columns in zip(errors, (rows, rows[:, 1:]), strict=True):
            fitted = columns @ np.linalg.lstsq(root[:, None] * columns, root * seen, rcond=None)[0]
            kind.append(SRGB(np.clip(fitted, 0.0, 1.0)) - SRGB(seen))
    means = [float(np.average(np.mean(np.square(kind), axis=0), weights=weight)) for kind in errors]
    return Likeness(*map(psnr_db, means))


def psnr_db(mean_square: float) -> float:
    """Of values from 0 to 1, by their mean squared difference; infinite where there is none [dB]."""
    return -10.0 * math.log10(mean_square) if mean_square > 0.0 else math.inf


def compared(view: Measurable, file: Path, seed: int) -> Likeness:
    """How like a photograph's file the render of a view is; of NaN if it has another shape.

    Raises:
        CaptureError: the file is no image.
    """
    colours = read_colours(file, CaptureError).astype(np.float64)
    (down, across), (width, height) = colours.shape[:2], view.size
    if not same_shape((width, height), (across, down)):
        return UNKNOWN
    factor = min(1.0, min(_SIDE, max(across, down)) / max(width, height))
    size = max(1, round(width * factor)), max(1, round(height * factor))
    few = view.seen_through(view.intrinsics.scaled(size))
    pixels = np.stack(np.meshgrid(*(np.arange(n) for n in size)), axis=-1).reshape(-1, 2)
    image = few.start_image(pixels, Paths(_SPP, seed, _BATCHES), purpose=_LIKENESS, even=True)().mean(axis=0)
    if view.white is not None:
        image = np.asarray(SRGB.inverse(np.clip(image / view.white, 0.0, 1.0)))
    opacity = averaged(colours[:, :, 3], size)
    linear = [averaged(colours[:, :, 3] * SRGB.inverse(colours[:, :, k]), size) for k in range(3)]
    photograph = np.stack(linear, axis=2) / np.maximum(opacity, 1e-6)[:, :, None]
    return likeness(image.reshape(size[1], size[0], 3), np.clip(photograph, 0.0, 1.0), opacity)
