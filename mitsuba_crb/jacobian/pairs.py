"""Film offsets for the filter term: antithetic pairs drawn from the filter's derivative.

    ∫ ∂h/∂x g dv ≈ mean of ½ Σ_± (∂h/∂x)/p g(±x, y),   p(x, y) ∝ |h'(x)| (1 + 6|x|/r) q(y),   q ∝ |h|.

The two halves of a pair mirror each other in the pixel's axis: ∂h/∂x changes its sign and g hardly changes,
so all that they share (with the same random numbers: light, noise, baseline) cancels. Edges are best met by
p ∝ |h'|, slopes by p ∝ |x h'|, where every pair measures the same; p, r the filter's radius, lies between the
two and loses little to either. The same pairs give ∫ h g by the balance heuristic over both axes; one axis
alone would have infinite variance, because p vanishes with h' where h does not. A box filter's derivative is
two edges, so it also needs pairs inside the pixel.

Source: design section 4.1; antithetic sampling, Zhang et al. 2021; filter derivatives, Yu et al. 2022.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import drjit as dr
import numpy as np

from ..errors import FilmError
from ..render.arrays import upload
from ..render.film import PixelFilter

if TYPE_CHECKING:
    import mitsuba as mi

PIECES = 2048
RATIO_PIECES = 256
GRID = 1024
"""Pieces of [0, radius] that h is linear in."""
ASIDE = 1e-3
"""How far the pixels of a box filter are moved, right and down [pixel].

Symmetric models have seams, silhouettes and texels exactly on the borders of pixels, where rounding decides
what a ray sees, where it may slip through a seam, and where the derivative is one thing to the left and
another to the right. Moving all pixels alike asks for the same at a pose that nobody could tell apart.
"""


class PairSample(NamedTuple):
    """One half of a pair; weights include 1/(number of samples), so that estimates are plain sums."""

    offset: mi.Point2f
    """v − c_u [pixel]."""
    gradient: mi.Vector2f
    """∇h/p [1/pixel]; only the component of the pair's own axis."""
    value: mi.Float
    """h/p."""

    def mirrored(self, kind: mi.UInt32) -> PairSample:
        """The other half of a pair, mirrored in x (kind 0), in y (kind 1) or in the centre (kind 2)."""
        x, y = self.offset
        offset = type(self.offset)(dr.select(kind == 1, x, -x), dr.select(kind == 0, y, -y))
        return PairSample(offset, -self.gradient, self.value)


@dataclass(frozen=True)
class SmoothPairs:
    """Pairs along x and along y for filters that fall to zero continuously.

    h is replaced by its linear interpolant at nodes between which p has equal mass, so that drawing from p is
    exact and ∂h/∂x over its density constant between nodes (2048 nodes: h is met within 1e-4).
    """

    pixel_filter: PixelFilter
    nodes: mi.Float
    """0 = x_0 < … < x_N = radius [pixel]."""
    values: mi.Float
    """h(x_i) [1/pixel]."""
    ratio: mi.Float
    """p/q² up to a factor, on a uniform grid over [0, radius]; only steers the balance heuristic."""

    kinds = 2

    @staticmethod
    def of(pixel_filter: PixelFilter) -> SmoothPairs:
        """For one filter.

        Raises:
            FilmError: the filter jumps at its border.
        """
        import mitsuba as mi

        radius = pixel_filter.radius
        # Finer, the differences of float32 values would be noise in the tail, and p would send pairs there.
        grid = np.linspace(0.0, radius, GRID + 1)
        h = np.array(pixel_filter.eval(upload(mi.Float, grid)), dtype=np.float64)
        if abs(h[-2]) > 1e-3 * h[0]:
            raise FilmError(
                f"reconstruction filter {pixel_filter.rfilter.class_name()} jumps at its border; "
                "method 'flow' knows box, tent, gaussian, mitchell, catmullrom and lanczos"
            )
        h[-1] = 0.0
        far = 1.0 + 3.0 * (grid[1:] + grid[:-1]) / radius
        mass = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(h)) * far)])
        # Rounding makes h's flat parts noisy; a little uniform mass keeps the nodes apart.
        mass = mass / mass[-1] + 1e-4 * grid / radius
        nodes = np.interp(np.linspace(0.0, mass[-1], PIECES + 1), mass, grid)
        values = np.interp(nodes, grid, h)
        middle = (np.arange(RATIO_PIECES) + 0.5) * radius / RATIO_PIECES
        slope = np.abs(np.interp(middle, 0.5 * (grid[1:] + grid[:-1]), np.diff(h) / np.diff(grid) * far))
        size = np.abs(np.interp(middle, grid, h))
        ratio = (slope + 1e-3 * slope.max()) / (size + 1e-3 * size.max())
        return SmoothPairs(
            pixel_filter,
            upload(mi.Float, nodes),
            upload(mi.Float, values),
            upload(mi.Float, ratio),
        )

    def draw(self, kind: mi.UInt32, point: mi.Point2f, counts: list[mi.Float]) -> PairSample:
        """The first half of a pair along x (kind 0) or y (kind 1).

        Args:
            point: uniform in [0, 1)², along and across the axis.
            counts: (expected) number of pairs of each kind.
        """
        import mitsuba as mi

        along_x = kind == 0
        scaled = point.x * PIECES
        piece = dr.minimum(mi.UInt32(scaled), PIECES - 1)
        low, high = dr.gather(mi.Float, self.nodes, piece), dr.gather(mi.Float, self.nodes, piece + 1)
        h_low, h_high = (
            dr.gather(mi.Float, self.values, piece),
            dr.gather(mi.Float, self.values, piece + 1),
        )
        fraction = scaled - mi.Float(piece)
        r = dr.fma(fraction, high - low, low)
        h_r = dr.fma(fraction, h_high - h_low, h_low)
        s, q = self.pixel_filter.table.sample(point.y)
        h_s = self.pixel_filter.eval(s)
        # |x| has density 1/(N width), x half of it, and each of the two halves half the pair's weight.
        weight = h_s / q * (PIECES * dr.rcp(dr.select(along_x, counts[0], counts[1])))
        slope = (h_high - h_low) * weight
        ratio_r = self._ratio(r) * dr.select(along_x, counts[0], counts[1])
        ratio_s = self._ratio(dr.abs(s)) * dr.select(along_x, counts[1], counts[0])
        value = h_r * (high - low) * weight * ratio_r / (ratio_r + ratio_s)
        return PairSample(
            dr.select(along_x, mi.Point2f(r, s), mi.Point2f(s, r)),
            dr.select(along_x, mi.Vector2f(slope, 0.0), mi.Vector2f(0.0, slope)),
            value,
        )

    def _ratio(self, x: mi.Float) -> mi.Float:
        import mitsuba as mi

        piece = mi.UInt32(x * (RATIO_PIECES / self.pixel_filter.radius))
        return dr.gather(mi.Float, self.ratio, dr.minimum(piece, RATIO_PIECES - 1))


@dataclass(frozen=True)
class BoxPairs:
    """Pairs on the left and right edges, on the upper and lower edges, and inside, for the box filter."""

    radius: float
    """Half the pixel's side [pixel]."""

    kinds = 3

    def draw(self, kind: mi.UInt32, point: mi.Point2f, counts: list[mi.Float]) -> PairSample:
        """The first half of a pair on the edges that x (kind 0) or y (kind 1) crosses, or inside (kind 2)."""
        import mitsuba as mi

        side = 2.0 * self.radius
        x, y = (point.x - 0.5) * side, (point.y - 0.5) * side
        # ∂h/∂x is −h₀ on the right edge and +h₀ on the left, h₀ = 1/side; an edge is side long.
        slope = -1.0 / side * dr.rcp(dr.select(kind == 0, counts[0], counts[1]))
        return PairSample(
            dr.select(
                kind == 0,
                mi.Point2f(self.radius, y),
                dr.select(kind == 1, mi.Point2f(y, self.radius), mi.Point2f(x, y)),
            ),
            mi.Vector2f(dr.select(kind == 0, slope, 0.0), dr.select(kind == 1, slope, 0.0)),
            dr.select(kind == 2, 0.5 * dr.rcp(counts[2]), 0.0),
        )


def film_shift(pixel_filter: PixelFilter) -> float:
    """How far the film points of all pixels are moved, right and down [pixel]; see `ASIDE`."""
    return ASIDE if pixel_filter.rfilter.class_name() == "BoxFilter" else 0.0


def filter_pairs(pixel_filter: PixelFilter) -> SmoothPairs | BoxPairs:
    """The pairs of a filter.

    Raises:
        FilmError: the filter jumps at its border and is no box.
    """
    if pixel_filter.rfilter.class_name() == "BoxFilter":
        return BoxPairs(pixel_filter.radius)
    return SmoothPairs.of(pixel_filter)
