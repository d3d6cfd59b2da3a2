"""While a field is trained: where there may be anything, of what cameras see, and what was found there."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..render.arrays import upload
from ..se3 import Array
from .network import Network
from .occupancy import Vertices, everywhere
from .scene_space import SceneSpace, expanded, stretch

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .field import Viewpoint

_DECAY = 0.8
"""Of density found earlier, from look to look."""
_THIN = 0.05
"""Optical thickness of a cell that is taken to be empty."""
_COARSE = 4
"""Vertices of the occupancy for each at which it is asked who sees it."""


class Exploration:
    """Optical thickness found around each vertex of the occupancy, lately."""

    def __init__(self, cells: int, space: SceneSpace, viewpoints: Sequence[Viewpoint]) -> None:
        """Before anything is known: everything that a camera sees may be full."""
        self.cells = cells
        self.seen: Vertices = everywhere(cells) & _seen(cells, space, viewpoints)
        z, y, x = np.nonzero(self.seen)
        self._vertices = np.stack([x, y, z], axis=1).astype(np.float32)
        width = 4.0 / cells * stretch(expanded(self._vertices.astype(np.float64) / cells))
        self._widths = width.astype(np.float32)
        self.thickness: NDArray[np.float32] = np.zeros(len(self._vertices), dtype=np.float32)

    def look(self, network: Network, rng: np.random.Generator) -> Vertices:
        """Evaluate density around each vertex, and return where something was found lately."""
        import mitsuba as mi

        aside = rng.uniform(-1.0, 1.0, self._vertices.shape).astype(np.float32)
        u = (self._vertices + aside) / np.float32(self.cells)
        outputs, _ = network.outputs(mi.Vector3f(*(upload(mi.Float, u[:, k]) for k in range(3))))
        found = np.array(network.density(outputs[0])) * self._widths
        self.thickness = np.maximum(np.float32(_DECAY) * self.thickness, found)
        vertices = np.zeros_like(self.seen)
        # A scene that is thin everywhere, as at the beginning, is not empty.
        vertices[self.seen] = self.thickness > min(_THIN, float(self.thickness.mean()))
        return vertices

    def recall(self, vertices: Vertices) -> None:
        """What there was, where only that is known of an earlier run."""
        self.thickness = np.where(vertices[self.seen], np.float32(_THIN), np.float32(0.0))


def _seen(cells: int, space: SceneSpace, viewpoints: Sequence[Viewpoint]) -> Vertices:
    """Vertices that a camera sees, or whose neighbours on a coarser grid one sees."""
    side = np.linspace(0.0, 1.0, max(2, cells // _COARSE + 1))
    z, y, x = np.meshgrid(side, side, side, indexing="ij")
    points = expanded(np.stack([x, y, z], axis=-1).reshape(-1, 3)) * space.scale + np.asarray(space.centre)
    padded = np.pad(_seen_by_any(viewpoints, points).reshape(z.shape), 1)
    n = len(side)
    wide = np.zeros(z.shape, dtype=np.bool_)
    for k in range(27):
        a, b, c = k % 3, k // 3 % 3, k // 9
        wide |= padded[a : a + n, b : b + n, c : c + n]
    near = np.rint(np.linspace(0, n - 1, cells + 1)).astype(np.int64)
    return np.asarray(wide[np.ix_(near, near, near)])


def _seen_by_any(viewpoints: Sequence[Viewpoint], points: Array) -> NDArray[np.bool_]:
    """(n,) whether one of the cameras has points (n, 3) within its image, or close to it."""
    found = np.zeros(len(points), dtype=np.bool_)
    for viewpoint in viewpoints:
        size = np.asarray(viewpoint.intrinsics.size)
        local = (points - viewpoint.pose[:3, 3]) @ viewpoint.pose[:3, :3]
        ahead = local[:, 2] > 0.0
        film = Camera.of(viewpoint.intrinsics).plain.project(local[ahead])
        slack = 0.05 * size.max()
        found[ahead] |= ((film > -slack) & (film < size + slack)).all(axis=1)
    return found
