"""COLMAP's points, from its text and its binary files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import CaptureError
from ..files import read_bytes, read_text
from ..se3 import Array
from .binary import Cursor, is_binary
from .entries import number, whole
from .rows import rows_of


def read_points(path: Path) -> tuple[Array, NDArray[np.uint8]]:
    """Positions (n, 3) [scene unit] and colours (n, 3) of a `points3D.txt` or a `points3D.bin`.

    Raises:
        CaptureError: the file is neither, or is damaged.
    """
    data = read_bytes(path, CaptureError)
    # an empty model's binary file is eight null bytes, its text one of comments only
    positions, colours = _binary(Cursor(data, path, CaptureError)) if is_binary(data) else _text(path)
    points = np.array(positions, dtype=np.float64).reshape(-1, 3)
    if not np.isfinite(points).all():
        raise CaptureError(f"{path} has points that are NaN or infinite")
    return points, np.array(colours, dtype=np.uint8).reshape(-1, 3)


def _text(path: Path) -> tuple[list[list[float]], list[list[int]]]:
    positions, colours = [], []
    for line, words in rows_of(read_text(path, CaptureError)).rows:
        where = f"{path}, line {line}"
        if len(words) < 8:
            raise CaptureError(f"{where}: expected POINT3D_ID X Y Z R G B ERROR, got {len(words)} words")
        positions.append([number(word, f"{where}: the point", CaptureError) for word in words[1:4]])
        colour = [whole(word, f"{where}: the colour", CaptureError) for word in words[4:7]]
        if not all(0 <= value < 256 for value in colour):
            raise CaptureError(f"{where}: a colour is three numbers from 0 to 255, not {colour}")
        colours.append(colour)
    return positions, colours


def _binary(cursor: Cursor) -> tuple[list[list[float]], list[list[int]]]:
    (count,) = cursor.take("Q")
    positions, colours = [], []
    for _ in range(count):
        _, x, y, z, red, green, blue, _, track = cursor.take("Q3d3BdQ")
        cursor.skip(8 * track)
        positions.append([x, y, z])
        colours.append([red, green, blue])
    cursor.end()
    return positions, colours
