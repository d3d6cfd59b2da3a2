"""The baseline Ī_u that the terms of `flow` take off the radiance, from a coarse render of its own.

Any constant of a pixel will do, as long as all batches have the same and no path of theirs decides on it.
Source: design section 4.1.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..information.subset import selected
from ..render.arrays import download, upload
from ..render.pixels import start_pixels
from ..render.random import PILOT
from ..render.rays import Lanes

if TYPE_CHECKING:
    import mitsuba as mi

    from ..render.view import View

PILOT_SPP = 2
PILOT_CELL = 4
"""The baseline Ī_u comes from this many paths through one pixel of every cell [pixel]: antithetic pairs leave
it so little to do that more would cost more than they save."""


@dataclass(frozen=True)
class Pilot:
    """Ī_u in cells of the film, by paths of their own; a pixel's is the same whoever else is asked for."""

    place: NDArray[np.int32]
    """(rows, columns) of each cell among those that hold pixels."""
    total: mi.Color3f
    """Sums over their paths, traced in the background."""

    @staticmethod
    def of(view: View, mask: NDArray[np.bool_], seed: int) -> Pilot:
        """For the pixels of a mask (H, W)."""
        missing = [(0, -n % PILOT_CELL) for n in mask.shape]
        whole = np.pad(mask, missing) if np.any(missing) else mask
        rows = functools.reduce(np.logical_or, [whole[i::PILOT_CELL] for i in range(PILOT_CELL)])
        held = functools.reduce(np.logical_or, [rows[:, i::PILOT_CELL] for i in range(PILOT_CELL)])
        probed = PILOT_CELL * selected(held)
        place = (np.cumsum(held, dtype=np.int32) - 1).reshape(held.shape)
        return Pilot(place, start_pixels(view, probed, spp=PILOT_SPP, seed=seed, purpose=PILOT))

    @functools.cached_property
    def arrays(self) -> tuple[mi.UInt32, mi.UInt32, mi.Color3f]:
        """What `baseline` reads."""
        import mitsuba as mi

        place = upload(mi.UInt32, self.place.ravel())
        return place, dr.opaque(mi.UInt32, self.place.shape[1]), self.total

    @staticmethod
    def baseline(arrays: tuple[mi.UInt32, mi.UInt32, mi.Color3f], lanes: Lanes) -> mi.Color3f:
        """Ī_u of the lanes of some of the pixels, finite whatever the radiance."""
        import mitsuba as mi

        place, columns, total = arrays
        cell = lanes.row // PILOT_CELL * columns + lanes.column // PILOT_CELL
        image = dr.gather(mi.Color3f, total, dr.gather(mi.UInt32, place, cell)) / PILOT_SPP
        return mi.Color3f(*(dr.select(dr.isfinite(channel), channel, 0.0) for channel in image))

    def values(self, pixels: NDArray[np.int64]) -> NDArray[np.float64]:
        """Ī_u of some of the pixels (n, 3)."""
        column, row = (pixels // PILOT_CELL).T
        return np.asarray(self._image[self.place[row, column]])

    @functools.cached_property
    def _image(self) -> NDArray[np.float64]:
        image = download(self.total).T / PILOT_SPP
        return np.where(np.isfinite(image), image, 0.0)


class Black:
    """No baseline, in the place of a `Pilot`."""

    arrays = ()

    @staticmethod
    def baseline(_arrays: tuple[()], _lanes: Lanes) -> mi.Color3f:
        """Zero."""
        import mitsuba as mi

        return mi.Color3f(0.0)
