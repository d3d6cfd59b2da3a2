"""A photograph as an image to compare with: decoded, without what says nothing, in as many pixels as wanted.

What a file stores are values of an encoding, sRGB in nearly all photographs. Scenes have linear radiance, and
a photograph is decoded for them; what it shows as white, or nearly, may be any amount brighter, and says
nothing. Radiance fields have the values that they were trained with, sRGB's own.

Pixels are averaged over areas, in the values that are compared; one that its mask, its opacity or white cover
in part says nothing either.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import AlignmentError
from ..files import Record, read_colours, read_grey
from ..noise.curves import SRGB, Curve, Linear
from ..se3 import Array

Encoding = Literal["srgb", "linear"]
ENCODINGS: dict[str, Curve] = {"srgb": SRGB, "linear": Linear()}
"""Stored values of linear ones, by the name of what was done to them."""

_WHITE = 0.985
"""Stored values above are saturated: the curve of cameras flattens before its end."""
_WHOLE = 0.99
"""Share of a pixel's area that must say something."""
_CONTRAST = 2.0 / 255.0
"""Of an image that shows anything, at least, between its darkest and its brightest value."""


@dataclass(frozen=True, eq=False)
class Picture(Record):
    """A photograph's file, upright."""

    file: str
    """Its name."""
    stored: Array
    """(H, W, 3) red, green and blue, from 0 to 1."""
    opacity: Array
    """(H, W) from 0, where it shows nothing of the scene, to 1: its alpha times its mask."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [pixel]."""
        height, width = self.opacity.shape
        return width, height


@dataclass(frozen=True, eq=False)
class Comparable(Record):
    """A photograph's values, of which those that say nothing are NaN."""

    values: Array
    """(H, W, 3), linear, or display-referred; white is 1."""
    masked: int
    """Pixels that show nothing of the scene."""
    saturated: int
    """Other pixels that are white or nearly, in a channel at least, of linear values."""


def read_picture(file: Path, mask: Path | None = None) -> Picture:
    """A photograph, turned as its EXIF orientation says, and its mask, whose black pixels show nothing.

    Raises:
        AlignmentError: a file is missing or no image, or they are of different sizes.
    """
    colours = read_colours(file, AlignmentError, upright=True).astype(np.float64)
    opacity = colours[:, :, 3]
    if mask is not None:
        own = read_grey(mask, AlignmentError, upright=True) > 127
        if own.shape != opacity.shape:
            (down, across), (height, width) = own.shape, opacity.shape
            raise AlignmentError(f"the mask {mask} has {across}x{down} pixels, {file} {width}x{height}")
        opacity = np.where(own, opacity, 0.0)
    return Picture(str(file), colours[:, :, :3], opacity)


def comparable(
    picture: Picture, size: tuple[int, int], *, encoding: Encoding = "srgb", display: bool = False
) -> Comparable:
    """The values to compare a render with.

    Args:
        picture: a photograph.
        size: width and height [pixel] of the same shape.
        encoding: of what is stored.
        display: compare display-referred values and not linear ones.

    Raises:
        AlignmentError: another shape, an unknown encoding, or an image that shows nothing.
    """
    (width, height), (across, down) = size, picture.size
    if not same_shape(size, picture.size):
        raise AlignmentError(
            f"{picture.file} has {across}x{down} pixels, which is another shape than the camera's "
            f"{width}x{height}: crop it, or give its camera (--camera)"
        )
    if encoding not in ENCODINGS:
        raise AlignmentError(f"unknown encoding {encoding!r} of a photograph; known: {', '.join(ENCODINGS)}")
    white = (picture.stored >= (np.inf if display else _WHITE)).any(axis=2)
    linear = np.asarray(ENCODINGS[encoding].inverse(picture.stored))
    values = np.asarray(SRGB(linear)) if display else linear
    share = averaged(picture.opacity, size)
    kept = averaged(np.where(white, 0.0, picture.opacity), size)
    channels = [averaged(picture.opacity * values[:, :, c], size) for c in range(3)]
    shown = np.stack(channels, axis=2) / np.maximum(share, 1e-6)[..., None]
    whole = kept >= _WHOLE
    if not whole.any():
        raise AlignmentError(f"{picture.file} shows nothing: every pixel is masked, transparent or white")
    if np.ptp(SRGB(shown[whole]) if not display else shown[whole], axis=0).max() < _CONTRAST:
        raise AlignmentError(f"{picture.file} is of one colour all over: there is nothing to align with")
    return Comparable(
        np.where(whole[..., None], shown, np.nan),
        masked=int(np.count_nonzero(share < _WHOLE)),
        saturated=int(np.count_nonzero((share >= _WHOLE) & ~whole)),
    )


def same_shape(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether two sizes are of one shape, as nearly as whole pixels can be."""
    (width, height), (across, down) = size, other
    return abs(width * down - height * across) < max(across, down, width, height)


def averaged(values: NDArray[Any], size: tuple[int, int]) -> Array:
    """Values (H, W) in other pixels, each the mean of the area that it covers."""
    from PIL import Image

    picture = Image.fromarray(np.asarray(values, dtype=np.float32))
    return np.asarray(picture.resize(size, Image.Resampling.BOX), dtype=np.float64)
