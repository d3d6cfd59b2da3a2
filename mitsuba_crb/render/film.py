"""The film's reconstruction filter, normalised, and how film points are drawn from it.

Weights are h/density, so there is no splatting, no weight normalisation and no cut at the film's border.
Source: design section 4; Pharr et al., PBRT 4e, 8.8.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from .arrays import upload

if TYPE_CHECKING:
    import mitsuba as mi


@dataclass(frozen=True)
class OffsetTable:
    """Draws x from a tabulated density on [−radius, radius] by its inverse distribution function."""

    nodes: mi.Float
    """Quantiles x_0 < … < x_N at u = 0, 1/N, …, 1 [pixel]."""
    count: int
    """N."""

    @staticmethod
    def of(density: NDArray[np.float64], radius: float, count: int = 1024) -> OffsetTable:
        """From samples of an unnormalised non-negative density on a uniform grid over [−radius, radius]."""
        import mitsuba as mi

        grid = np.linspace(-radius, radius, density.size)
        # A floor keeps the density positive wherever the filter is, so that h/density stays bounded.
        density = np.maximum(density, 1e-3 * density.max())
        mass = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]))])
        nodes = np.interp(np.linspace(0.0, 1.0, count + 1), mass / mass[-1], grid)
        return OffsetTable(upload(mi.Float, nodes), count)

    def sample(self, u: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Offset x [pixel] and its density [1/pixel]."""
        import mitsuba as mi

        scaled = u * self.count
        interval = dr.minimum(mi.UInt32(scaled), self.count - 1)
        low = dr.gather(mi.Float, self.nodes, interval)
        width = dr.gather(mi.Float, self.nodes, interval + 1) - low
        return dr.fma(scaled - mi.Float(interval), width, low), dr.rcp(width * self.count)


@dataclass(frozen=True)
class PixelFilter:
    """The film's separable reconstruction filter h(x) h(y), normalised, and how to draw from |h|."""

    rfilter: mi.ReconstructionFilter
    radius: float
    """Half width [pixel]."""
    norm: float
    """∫ of Mitsuba's unnormalised one-dimensional filter."""
    table: OffsetTable
    values: NDArray[np.float64]
    """h in the middle of even intervals of [−radius, radius] [1/pixel]."""

    @staticmethod
    def of(rfilter: mi.ReconstructionFilter) -> PixelFilter:
        """For one filter."""
        import mitsuba as mi

        radius = float(rfilter.radius())
        # Midpoints: a filter's value exactly on its border (box) is a matter of convention.
        edges = np.linspace(-radius, radius, 8193)
        middle = 0.5 * (edges[1:] + edges[:-1])
        values = np.array(rfilter.eval(upload(mi.Float, middle)), dtype=np.float64)
        norm = float(values.sum() * (edges[1] - edges[0]))
        density = np.abs(np.interp(edges, middle, values))
        return PixelFilter(rfilter, radius, norm, OffsetTable.of(density, radius), values / norm)

    def eval(self, x: mi.Float) -> mi.Float:
        """h(x) [1/pixel] in one dimension."""
        return self.rfilter.eval(x) / self.norm

    def interpolate(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """h(x) [1/pixel] in one dimension, to what float32 leaves of it (3e-5); zero beyond the radius."""
        place = (x / self.radius + 1.0) * (0.5 * len(self.values)) - 0.5
        interval = np.clip(place.astype(np.int64), 0, len(self.values) - 2)
        low = self.values[interval]
        h = low + (place - interval) * (self.values[interval + 1] - low)
        return np.where(np.abs(x) <= self.radius, h, 0.0)

    def sample(self, u: mi.Point2f) -> tuple[mi.Point2f, mi.Float]:
        """Offset from the pixel's centre [pixel] and its weight h/density, of mean one."""
        import mitsuba as mi

        x, density_x = self.table.sample(u.x)
        y, density_y = self.table.sample(u.y)
        return mi.Point2f(x, y), self.eval(x) * self.eval(y) / (density_x * density_y)
