"""Where there is anything: vertices of a grid in the cube, and the window that their neighbours make of them.

Density is multiplied by a window that is 1 in a cell whose eight corners are occupied, 0 in one of which none
is, and smooth between. So nothing is lost where empty cells are skipped, nothing switches on or off as a
camera moves, and a derivative that follows the window misses nothing. The border of the cube is never
occupied: what is farther away than its last cell is background.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import mitsuba as mi

Vertices = NDArray[np.bool_]


def everywhere(cells: int) -> Vertices:
    """(n+1, n+1, n+1) all but the border; the first axis is z."""
    vertices = np.zeros((cells + 1,) * 3, dtype=np.bool_)
    vertices[1:-1, 1:-1, 1:-1] = True
    return vertices


def bytes_of(vertices: Vertices) -> NDArray[np.uint8]:
    """(n³,) a bit for each corner of a cell that is occupied; bit k is at (k & 1, k >> 1 & 1, k >> 2 & 1)."""
    n = len(vertices) - 1
    found = np.zeros((n, n, n), dtype=np.uint8)
    for k in range(8):
        x, y, z = k & 1, k >> 1 & 1, k >> 2 & 1
        found |= vertices[z : z + n, y : y + n, x : x + n].astype(np.uint8) << np.uint8(k)
    return found.ravel()


class Cells:
    """The occupancy where kernels can read it."""

    def __init__(self, vertices: Vertices) -> None:
        """Of its vertices."""
        import mitsuba as mi

        self.count = len(vertices) - 1
        self.bytes = dr.uint8_array_t(mi.Float)(bytes_of(vertices))

    def at(self, u: mi.Vector3f, active: Any = True) -> tuple[mi.UInt32, mi.Vector3f]:
        """The byte of the cell that holds u, and the place in it, on each axis from 0 to 1."""
        import mitsuba as mi

        place = u * float(self.count)
        lower = dr.clip(dr.floor(place), 0.0, self.count - 1.0)
        cell = mi.Vector3u(lower)
        index = (cell.z * self.count + cell.y) * self.count + cell.x
        byte = dr.gather(type(self.bytes), self.bytes, index, active)
        return mi.UInt32(byte), mi.Vector3f(place - lower)
