"""Posed photographs: of each where its image is, its camera and its pose; images are read when asked for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..camera import Intrinsics
from ..errors import CaptureError
from ..files import Record, read_colours, read_grey
from ..se3 import Array


@dataclass(frozen=True, eq=False)
class Photograph(Record):
    """A photograph whose camera and pose are known."""

    name: str
    """What the capture calls it."""
    image: str
    """Its file."""
    intrinsics: Intrinsics
    """Of its camera, for the image's size."""
    pose: Array
    """(4, 4) world_from_camera [scene unit], in our axes (`se3`)."""
    mask: str | None = None
    """A file whose black pixels show nothing of the scene."""
    depth: str | None = None
    """A file of depths, in the capture's own unit."""

    def colours(self) -> NDArray[np.float32]:
        """(H, W, 3) red, green and blue from 0 to 1, as the file stores them: mostly sRGB.

        Raises:
            CaptureError: the file is no image, or of another size than its intrinsics.
        """
        return self._read()[:, :, :3]

    def opacity(self) -> NDArray[np.float32]:
        """(H, W) from 0, where the image shows nothing of the scene, to 1: its alpha times its mask.

        Raises:
            CaptureError: a file is no image, or of another size than its intrinsics.
        """
        alpha = self._read()[:, :, 3]
        if self.mask is None:
            return alpha
        mask = read_grey(Path(self.mask), CaptureError).astype(np.float32) / np.float32(255.0)
        self._check(self.mask, mask.shape)
        return alpha * mask

    def _read(self) -> NDArray[np.float32]:
        values = read_colours(Path(self.image), CaptureError)
        self._check(self.image, values.shape)
        return values

    def _check(self, file: str, shape: tuple[int, ...]) -> None:
        width, height = self.intrinsics.size
        if shape[:2] != (height, width):
            raise CaptureError(f"{file} has {shape[1]}x{shape[0]} pixels, and its camera {width}x{height}")


@dataclass(frozen=True, eq=False)
class Capture(Record):
    """Posed photographs of one scene."""

    photographs: tuple[Photograph, ...]
    """In the order of the file, or of their names where the file has none."""
    train: tuple[int, ...]
    """Which of them a scene may be trained on."""
    test: tuple[int, ...]
    """Which of them are held out."""
    split: str
    """Who says so."""
    format: str
    """The format's name."""
    convention: str
    """What was read of the poses, in a sentence."""
    points: Array | None = None
    """(n, 3) of the scene's surfaces [scene unit], if the capture has any."""
    point_colours: NDArray[np.uint8] | None = None
    """(n, 3), from 0 to 255."""
    notes: tuple[str, ...] = ()
    """What is missing, or was mended, in words."""

    def __len__(self) -> int:
        return len(self.photographs)

    def __str__(self) -> str:
        known = "no points" if self.points is None else f"{len(self.points)} points"
        head = f"{len(self)} photographs, {known}; {self.format}"
        parts = f"{len(self.train)} to train on, {len(self.test)} held out: {self.split}"
        return "\n".join([head, parts, self.convention, *self.notes])

    def needed_points(self) -> Array:
        """`points`, for what cannot do without.

        Raises:
            CaptureError: there are none.
        """
        if self.points is None or not len(self.points):
            raise CaptureError(
                f"this capture ({self.format}) has no points; give a COLMAP model with its points3D.txt or "
                "points3D.bin"
            )
        return self.points
