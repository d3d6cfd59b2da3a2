"""What flow takes off depth: the tangent plane through each pixel's middle, whose derivative is known.

In the place of a constant Ī_u there is ℓ(v) = z₀ + g·(v − c_u), linear on the film. By Gauss' theorem

    0 = ∫ ℓ ∇·(h f) dv + ∫ h ∇ℓ·f dv + Σ_contours ∮ h ℓ (f_fg − f_bg)·m dl,

so that with the view term ż, and e any constant (∫ h = 1),

    ∂I_u/∂ξ = ∫ (z − ℓ) ∇·(h f) dv + e + ∫ h (ż − ∇ℓ·f − e) dv + Σ_contours ∮ h (L_bg − ℓ) (f_fg − f_bg)·m dl.

Of the plane n·p = 1 through the middle's p = z s the depth at a fixed film point moves by

    e = (n·ṗ)/(n·s) = −z (n, p×n)·ξ,

which is what is left of the sum before a plane: depth is nearly free of noise. Where the middle sees nothing,
or a surface edge-on, ℓ = e = 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..render.arrays import upload
from ..render.depth import tangent_planes
from ..render.rays import Lanes

if TYPE_CHECKING:
    import mitsuba as mi

    from ..render.view import View

Floats = NDArray[np.float64]

_STEEP = 0.5
"""Change of depth within the filter's radius, over the depth, beyond which a plane is of no use."""


@dataclass(frozen=True)
class DepthPilot:
    """ℓ and e of every pixel, in the place of a `Pilot`; exact, without random numbers."""

    table: Floats
    """(H, W, 9) z₀ [scene unit], g [scene unit / pixel], e [1, scene unit / rad]."""

    @staticmethod
    def of(view: View) -> DepthPilot:
        """Of a view's pixels."""
        x, y = (np.arange(n, dtype=np.float64) + 0.5 for n in view.size)
        seen, s, z, plane = tangent_planes(view, x, y)
        with np.errstate(all="ignore"):  # where nothing is seen
            slope = -(z**2)[..., None] * plane[..., :2] * view.camera.scale
            e = -z[..., None] * np.concatenate([plane, np.cross(z[..., None] * s, plane)], axis=-1)
            table = np.concatenate([z[..., None], slope, e], axis=-1)
            flat = np.abs(slope).max(axis=-1) * view.pixel_filter.radius < _STEEP * z
        good = seen & flat & np.isfinite(table).all(axis=-1)
        return DepthPilot(np.where(good[..., None], table, 0.0))

    @property
    def arrays(self) -> list[mi.Float]:
        """What kernels read."""
        import mitsuba as mi

        return [upload(mi.Float, column) for column in self.table.reshape(-1, 9).T]

    @staticmethod
    def baseline(arrays: list[mi.Float], lanes: Lanes) -> mi.Color3f:
        """z₀ of each lane's pixel."""
        import mitsuba as mi

        return mi.Color3f(dr.gather(mi.Float, arrays[0], lanes.pixel))

    @staticmethod
    def plane(arrays: list[mi.Float], lanes: Lanes) -> tuple[mi.Vector2f, list[mi.Float]]:
        """g and e of each lane's pixel."""
        import mitsuba as mi

        slope = mi.Vector2f(*(dr.gather(mi.Float, array, lanes.pixel) for array in arrays[1:3]))
        return slope, [dr.gather(mi.Float, array, lanes.pixel) for array in arrays[3:]]

    def values(self, pixels: NDArray[np.int64]) -> Floats:
        """(n, 3) z₀ of some of the pixels."""
        return np.repeat(self.table[pixels[:, 1], pixels[:, 0], :1], 3, axis=1)

    def slopes(self, pixels: NDArray[np.int64]) -> Floats:
        """(n, 2) g of some of the pixels."""
        return np.asarray(self.table[pixels[:, 1], pixels[:, 0], 1:3])
