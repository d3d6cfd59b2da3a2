"""The parallax term: what a moving camera changes where one surface ends in front of another.

    Σ_contours ∮ h_u (L_bg − Ī_u) (f_fg − f_bg)·m dl

dl is arc length on the film, m the film normal from background to foreground, L_bg the radiance just outside
the contour, Ī_u any constant per pixel, f the film flow of what lies on either side. With inverse depths w
and (x, y, 1) the camera-frame direction from the lens point a,

    f_fg − f_bg = −(w_fg − w_bg) diag(1/s) [[1, 0, −x], [0, 1, −y]] (ρ + φ × a),

s the scale of `camera.Camera`. It is Reynolds' transport theorem: the contour moves with the foreground, so
that a patch of background gains or loses film that its own flow does not account for. A pinhole (a = 0) that
rotates sees none of it.

Samples are drawn per block of the film with random numbers of (seed, block, batch), and reach that block's
pixels only: blocks are independent of one another and of what else is processed. Surfaces are what rays hit
first, masked and null materials like any other. Source: design section 4.1; Zhang et al. 2020, Path-Space
Differentiable Rendering; Zhang et al. 2023, Projective Sampling.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from ..information.blocks import BLOCK
from ..render.arrays import download, upload, widened
from ..render.pixels import kernel_key, sensed
from ..render.random import lane_sampler, seeding
from .pairs import film_shift
from .silhouettes import Contours, Sides, find_contours, look

if TYPE_CHECKING:
    import mitsuba as mi

    from ..render.view import View
    from .curves import Placed
    from .method import Paths

__all__ = ["Contours", "ParallaxTerm", "find_contours"]

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

POINTS, PATHS = 0x434F4E54, 0x50415448
"""Purposes of the random numbers: where on the contours, and which light paths."""
_STEPS = np.array([0.7548776662466927, 0.5698402909980532])
"""1/g and 1/g², g³ = g + 1: multiples modulo 1 fill the lens evenly (Roberts 2018)."""
_CHUNK = 1 << 19
"""Samples held at once, about."""


class ParallaxTerm:
    """The parallax term of dI/dξ in the camera frame at some pixels, on its way (see `method.Tile`)."""

    def __init__(
        self,
        view: View,
        contours: Contours,
        pixels: Ints,
        baseline: Floats,
        paths: Paths,
        *,
        slopes: Floats | None = None,
    ) -> None:
        """Of the view's contours, nothing started yet.

        Args:
            contours: of this view, from `find_contours`.
            pixels: (n, 2) columns and rows; those of one block must come in one call.
            baseline: (n, 3) Ī_u, any constants near the image that do not come from these random numbers.
            paths: those of the other terms; they set the number of samples here.
            slopes: (n, 2) of a baseline that is linear on the film, Ī_u at the pixel's middle [1/pixel].
        """
        of_pixel = pixels[:, 1] // BLOCK * contours.columns + pixels[:, 0] // BLOCK
        blocks = np.unique(of_pixel[contours.samples[of_pixel] > 0.0])
        count = np.ceil(contours.samples[blocks] * (paths.spp / paths.batches)).astype(np.int64)
        chunk = np.cumsum(count * paths.batches) // _CHUNK
        self._parts: list[tuple[Ints, _BlocksTerm]] = []
        for which in np.unique(chunk):
            part = blocks[chunk == which]
            mine = np.flatnonzero(np.isin(of_pixel, part))
            term = _BlocksTerm(
                view,
                contours,
                part,
                count[chunk == which],
                pixels[mine],
                baseline[mine],
                None if slopes is None else slopes[mine],
                paths,
            )
            self._parts.append((mine, term))
        self._found = [_nothing(contours, paths.batches)]

    def launch(self) -> None:
        """Start paths in the background; of more samples than are held at once, all but the last are done."""
        while len(self._parts) > 1:
            self._start()
            self.wait()
            self._finish()
        self._start()

    def wait(self) -> None:
        """Until they are traced."""
        for _, term in self._parts[:1]:
            term.wait()

    def result(self) -> tuple[Ints, Floats, Floats]:
        """Which pixels contours touch (t,), the term there (batches, t, 3, q), and that of the picture L = 1.

        Of the twist's first q = `Contours.twists` components. The last without baseline, of translation only
        (3, batches, t), for `closure`. Independent from batch to batch and from block to block
        [radiance / scene unit, radiance / rad].
        """
        self._finish()
        rows, terms, closing = zip(*self._found, strict=True)
        return np.concatenate(rows), np.concatenate(terms, axis=1), np.concatenate(closing, axis=2)

    def _start(self) -> None:
        for _, term in self._parts[:1]:
            term.launch()

    def _finish(self) -> None:
        for mine, term in self._parts[:1]:
            touched, sums, closing = term.result()
            self._found.append((mine[touched], sums, closing))
        del self._parts[:1]


@dataclass(frozen=True)
class _Samples:
    """Points to be placed on contours."""

    owner: Ints
    """(n,) place of the block among those processed."""
    number: Ints
    """(n,) of each sample in its block; the batch runs fastest."""
    pair: Ints
    """(n,) block and piece, an index into `Contours.piece`."""
    target: Floats
    """(n,) where in `Contours.cumulative`."""
    aperture: Floats
    """(n, 2) the sensor's lens sample in [0, 1]²."""
    point: Floats
    """(n, 3) lens point [scene unit]."""

    def part(self, index: Ints) -> _Samples:
        """Some of the samples."""
        return _Samples(*(getattr(self, field.name)[index] for field in fields(self)))


class _BlocksTerm:
    """The parallax term of some blocks' pixels, of as many samples as are held at once."""

    def __init__(
        self,
        view: View,
        contours: Contours,
        blocks: Ints,
        count: Ints,
        pixels: Ints,
        baseline: Floats,
        slopes: Floats | None,
        paths: Paths,
    ) -> None:
        """Of `count` samples per block and batch."""
        self._view, self._contours, self._paths = view, contours, paths
        self._blocks, self._count, self._baseline, self._slopes = blocks, count, baseline, slopes
        self._slot = _slots(contours, blocks, pixels)
        self._looked: Any = None

    def launch(self) -> None:
        """Where samples land, which of them touch a selected pixel, and what rays beside those see."""
        contours, blocks, slot = self._contours, self._blocks, self._slot
        samples = _draw(contours, blocks, self._count, self._paths.seed, self._paths.batches)
        samples = samples.part(_near(contours, slot, blocks, samples))
        piece, start = contours.piece[samples.pair], contours.cumulative[samples.pair]
        share = contours.cumulative[samples.pair + 1] - start
        u = np.clip((samples.target - start) / np.maximum(share, np.finfo(float).tiny), 0.0, 1.0)
        placed = contours.place(piece, u, samples.point, contours.plain_reach(blocks[samples.owner]))
        film = placed.film - film_shift(contours.view.pixel_filter)
        rows, offset = _footprint(contours, slot, blocks, samples.owner, film)
        kept = np.flatnonzero((rows >= 0).any(axis=1) & (placed.length > 0.0) & (share > 0.0))
        self._samples, self._placed = samples.part(kept), placed.part(kept)
        self._piece, self._share = piece[kept], share[kept]
        self._rows, self._offset = rows[kept], offset[kept]
        if len(kept):  # Dr.Jit does not divide empty arrays
            self._looked = _look(
                self._view, contours, self._placed, self._piece, self._samples, blocks, self._paths.seed
            )

    def wait(self) -> None:
        """Until they have been traced."""
        if self._looked is not None:
            sides, outside = self._looked
            self._looked = Sides(*map(np.asarray, sides)), [np.asarray(channel) for channel in outside]

    def result(self) -> tuple[Ints, Floats, Floats]:
        """As `ParallaxTerm.result`, of these blocks' pixels."""
        contours, blocks, batches = self._contours, self._blocks, self._paths.batches
        if self._looked is None:
            return _nothing(contours, batches)
        sides, outside = self._looked
        jump = contours.jump(sides, self._placed, self._piece, self._samples.point)
        shown = np.flatnonzero(jump > 0.0)
        samples, placed = self._samples.part(shown), self._placed.part(shown)
        jump, share = jump[shown], self._share[shown]
        rows, offset = self._rows[shown], self._offset[shown]
        light = np.stack([channel[shown] for channel in outside], axis=1, dtype=np.float64)

        # (f_fg − f_bg)·m per twist component, times the film length that each sample stands for.
        slope = contours.camera.pulled(placed.seen, placed.normal) / contours.camera.scale
        gradient = np.column_stack([-slope, np.sum(slope * placed.seen[:, :2], axis=1) / placed.seen[:, 2]])
        if contours.twists == 6:
            gradient = np.concatenate([gradient, np.cross(samples.point, gradient)], axis=1)
        whole = contours.cumulative[contours.first[blocks + 1]] - contours.cumulative[contours.first[blocks]]
        gradient *= (jump * placed.length * (whole / self._count)[samples.owner] / share)[:, None]
        moments = np.concatenate([gradient[:, None], light[:, :, None] * gradient[:, None]], axis=1)
        moments = moments.reshape(len(shown), 4 * contours.twists)

        h = contours.view.pixel_filter.interpolate(offset)
        height = (h[:, :, None, 0] * h[:, None, :, 1]).reshape(rows.shape)
        inside = rows >= 0
        counted = np.zeros(len(self._baseline), dtype=bool)
        counted[rows[inside]] = True
        touched = np.flatnonzero(counted)
        n, row = len(touched), np.cumsum(counted) - 1
        place = (samples.number % batches * n)[:, None] + row[rows]
        ends = np.concatenate([[0], np.cumsum(np.count_nonzero(inside, axis=1))])
        matrix = csr_array((height[inside], place[inside], ends), shape=(len(shown), batches * n))
        sums = (matrix.T @ moments).reshape(batches, n, 4, contours.twists)
        terms = sums[:, :, 1:] - self._baseline[touched, :, None] * sums[:, :, :1]
        if self._slopes is not None:
            # `offset` is from the film point to the pixel's middle.
            away = np.broadcast_arrays(offset[:, :, None, 0], offset[:, None, :, 1])
            for axis in (0, 1):
                matrix.data = (height * away[axis].reshape(rows.shape))[inside]
                tilt = (matrix.T @ moments[:, : contours.twists]).reshape(batches, n, 1, contours.twists)
                terms += self._slopes[touched, axis, None, None] * tilt
        return touched, np.asarray(terms), np.asarray(sums[:, :, 0, :3].transpose(2, 0, 1))


def _nothing(contours: Contours, batches: int) -> tuple[Ints, Floats, Floats]:
    """The result where no contour touches any pixel."""
    term, closing = np.empty((batches, 0, 3, contours.twists)), np.empty((3, batches, 0))
    return np.empty(0, dtype=np.int64), term, closing


def _draw(contours: Contours, blocks: Ints, count: Ints, seed: int, batches: int) -> _Samples:
    """Evenly in a block's weight, and over the lens, from a random start per block and batch."""
    total = count * batches
    owner = np.repeat(np.arange(len(blocks)), total)
    number = np.arange(len(owner)) - np.repeat(np.cumsum(total) - total, total)
    # Of all blocks, because a block's must not depend on which others are asked for.
    start = np.random.default_rng((seed, POINTS)).random((len(contours.samples), batches, 3))
    start = start[blocks[owner], number % batches]
    turn = number // batches
    first, last = contours.first[blocks], contours.first[blocks + 1]
    low, high = contours.cumulative[first], contours.cumulative[last]
    target = low[owner] + ((high - low) / count)[owner] * (turn + start[:, 0])
    pair = np.searchsorted(contours.cumulative, target, side="right") - 1
    aperture = (start[:, 1:] + turn[:, None] * _STEPS) % 1.0
    return _Samples(
        owner=owner,
        number=number,
        pair=np.clip(pair, first[owner], last[owner] - 1),
        target=target,
        aperture=aperture,
        point=_lens_points(contours, aperture),
    )


def _lens_points(contours: Contours, aperture: Floats) -> Floats:
    """Where the sensor's lens samples (n, 2) lie on its lens (n, 3) [scene unit]."""
    import mitsuba as mi

    point = np.zeros((len(aperture), 3))
    if contours.camera.radius > 0.0:
        sample = mi.Point2f(*(upload(mi.Float, x) for x in widened(aperture).T))
        disk = mi.warp.square_to_uniform_disk_concentric(sample)
        point[:, :2] = contours.camera.radius * download(disk).T[: len(aperture)]
    return point


def _slots(contours: Contours, blocks: Ints, pixels: Ints) -> Ints:
    """Which of `pixels` is at each column and row of each block, with a rim of one pixel; −1 for none."""
    home = np.searchsorted(blocks, pixels[:, 1] // BLOCK * contours.columns + pixels[:, 0] // BLOCK)
    local = pixels - contours.corner(blocks)[home]
    slot = np.full((len(blocks), BLOCK + 2, BLOCK + 2), -1)
    slot[home, local[:, 0] + 1, local[:, 1] + 1] = np.arange(len(pixels))
    return slot


def _near(contours: Contours, slot: Ints, blocks: Ints, samples: _Samples) -> Ints:
    """Which samples lie on pieces that reach selected pixels of their block."""
    owner, selected = samples.owner, slot[:, 1:-1, 1:-1] >= 0
    if selected.all():
        return np.arange(len(owner))
    below = np.zeros((len(blocks), BLOCK + 1, BLOCK + 1), dtype=np.int64)
    below[:, 1:, 1:] = np.cumsum(np.cumsum(selected, axis=1), axis=2)
    box, radius = contours.box[contours.piece[samples.pair]], contours.view.pixel_filter.radius
    corner = contours.corner(blocks)[owner]
    x0, y0 = np.clip(np.ceil(box[:, :2] - radius - 0.5) - corner, 0, BLOCK).astype(np.int64).T
    x1, y1 = np.clip(np.floor(box[:, 2:] + radius + 0.5) - corner, 0, BLOCK).astype(np.int64).T
    count = below[owner, x1, y1] - below[owner, x0, y1] - below[owner, x1, y0] + below[owner, x0, y0]
    return np.flatnonzero(count > 0)


def _footprint(
    contours: Contours, slot: Ints, blocks: Ints, owner: Ints, film: Floats
) -> tuple[Ints, Floats]:
    """Selected pixels that film points reach in their own block (n, r²), −1 for none.

    And how far the centres of the pixels' r columns and r rows are from the points (n, r, 2) [pixel].
    """
    radius = contours.view.pixel_filter.radius
    width = int(np.ceil(2.0 * radius))
    pixel = np.ceil(film - radius - 0.5).astype(np.int64)[:, None] + np.arange(width)[:, None]
    local = np.clip(pixel - contours.corner(blocks)[owner][:, None], -1, BLOCK) + 1
    rows = slot[owner[:, None, None], local[:, :, None, 0], local[:, None, :, 1]]
    return rows.reshape(-1, width**2), pixel + 0.5 - film[:, None]


def _look(
    view: View, contours: Contours, placed: Placed, piece: Ints, samples: _Samples, blocks: Ints, seed: int
) -> tuple[tuple[Any, ...], mi.Color3f]:
    """What rays just beside each sample see (`Sides`), and L_bg, one path each; a lone sample's twice.

    Evaluated in the background.
    """
    import mitsuba as mi

    arrays = contours.side_points(placed, piece, samples.aperture) | {
        "block": upload(mi.UInt32, widened(blocks[samples.owner])),
        "number": upload(mi.UInt32, widened(samples.number)),
        "seeds": seeding(seed, PATHS),
    }

    def body(arrays: dict[str, Any]) -> tuple[tuple[Any, ...], mi.Color3f]:
        sides, ray, importance = look(view, arrays)
        active = sides.jump > 0.0
        sampler = lane_sampler(arrays["block"], arrays["number"], arrays["seeds"])
        light = sensed(view, sampler, ray, arrays["transform"], active)
        return tuple(sides), dr.select(active, importance * light, 0.0)

    known = kernel_key(view)
    sides, light = view.recorder.ready("contours", body, view, arrays, known)()
    return sides, light
