"""Columns of a radiance field: in closed form (`exact`), or by central differences (`finite_difference`).

Nothing here is random but rounding, of which two orders of summation give two samples a and b of each column.
With m = (a + b)/2 and d = (a − b)/2, the K batches are

    J_k = m + c_k d,   Σ c_k = 0,   Σ c_k² = K (K − 1),

c_k of one value for one order's batches, and of another for the other's: they scatter as K independent
batches of that mean would. Whatever the weights W, the mean of J_kᵀ W J_l over k ≠ l is then the symmetric
part of aᵀ W b, to which rounding adds nothing on average: a direction that the field does not see has no
information, whatever the number of pixels. (Batches that were a and b in turn would give it a third of the
rounding's variance in every pixel.)

Differences keep the pose's discrete choices, such as the order of depth, as the closed form does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..jacobian.finite_difference import steps_of
from ..jacobian.method import AtOnce, Estimates, Method, Paths, Reference, Seen, Stepping
from ..render.rays import coarse_grid
from .field import ORDERS, Field, Floats, Pixels

STEP_PIXELS = 0.05
"""Image motion of a difference's longest step [pixel]: of a splat that is as narrow as rasterisers let it be,
0.55 pixels, it hides 0.3 % of the information."""

_SHORTER = 4.0
"""From one step to the next that is tried."""
_TRIED = 3
"""Steps that are tried; the shortest is 1 / 320 of a pixel, where rounding is a percent."""
_KINKED = 1e-4
"""Misfit of the best step above which kinks decide."""
_GRID = 16
"""Pixels across and down on which they are."""
_LEAST = 1e-3
"""Of the information, the least scatter: no order of summation shows what is rounded before it is summed."""
_LITTLE = 0.01
"""Of the largest column, scaled to motions of the image, what a smaller one tells of steps is nothing."""


class FieldSeen(Seen, Protocol):
    """What the methods need of a view."""

    @property
    def field(self) -> Field:
        """What is seen."""


@dataclass(frozen=True)
class Exact:
    """The field's own columns."""

    name: ClassVar[str] = "exact"
    follows_film: ClassVar[bool] = False
    step_pixels: ClassVar[None] = None
    block = 1

    view: FieldSeen

    @classmethod
    def open(
        cls,
        view: FieldSeen,
        mask: NDArray[np.bool_],
        seed: int,
        *,
        step_pixels: float | None = None,
        film_flows: tuple[Any, ...] = (),
    ) -> Self:
        """See `Method.open`."""
        return cls(view)

    @classmethod
    def limits(cls, view: FieldSeen) -> tuple[str, ...]:
        """Nothing: see `Method.limits`."""
        return ()

    def prepare(self, pixels: Pixels, paths: Paths) -> AtOnce:
        """See `Method.prepare`."""
        return AtOnce(lambda: self._all(pixels, paths.batches))

    def _all(self, pixels: Pixels, batches: int) -> Estimates:
        view = self.view
        found = [view.field.columns(view.camera, view.pose, pixels, order=order) for order in range(ORDERS)]
        images, columns = (np.stack(parts) for parts in zip(*found, strict=True))
        return Estimates(as_batches(columns, batches), as_batches(images, batches), images.mean(axis=0))


@dataclass(frozen=True)
class FieldDifference:
    """Central differences of what the field shows; twelve images."""

    name: ClassVar[str] = "finite_difference"
    follows_film: ClassVar[bool] = False
    block = 1

    view: FieldSeen
    step_pixels: float
    """Image motion of a step [pixel]."""

    @classmethod
    def open(
        cls,
        view: FieldSeen,
        mask: NDArray[np.bool_],
        seed: int,
        *,
        step_pixels: float | None = None,
        film_flows: tuple[Any, ...] = (),
    ) -> Self:
        """See `Method.open`."""
        return cls(view, cls.stepping(view).pixels if step_pixels is None else step_pixels)

    @classmethod
    def stepping(cls, view: FieldSeen) -> Stepping:
        """That of those tried which the next shorter one agrees with best; see `Reference.stepping`.

        A field that is looked at through points has details finer than a pixel, and kinks: there the step is
        shorter than where pixels are smooth, until rounding is worse, and the bias goes as the share of
        pixels in which a kink is crossed, which is in proportion to the step.
        """
        pixels = coarse_grid(view.camera.size, _GRID).reshape(-1, 2)
        share = len(pixels) / np.prod(view.camera.size)
        lengths = [STEP_PIXELS / _SHORTER**k for k in range(_TRIED + 1)]
        columns = [cls(view, length).moved(pixels) for length in lengths]
        found = [_apart(longer, shorter, share) for longer, shorter in pairwise(columns)]
        best = int(np.argmin([misfit for misfit, _ in found]))
        misfit, scatter = found[best]
        return Stepping(lengths[best], 1 if misfit > _KINKED else 2, misfit, max(scatter, _LEAST))

    @classmethod
    def limits(cls, view: FieldSeen) -> tuple[str, ...]:
        """Nothing: see `Method.limits`."""
        return ()

    def prepare(self, pixels: Pixels, paths: Paths) -> AtOnce:
        """See `Method.prepare`."""
        return AtOnce(lambda: self._all(pixels, paths.batches))

    def moved(self, pixels: Pixels) -> Floats:
        """(n, 3, 6) the columns times the steps, per pixel of motion, in the first order of summation."""
        sides = [
            [self._shown(pixels, self.view.pose @ se3.exp(signed * axis), 1)[0] for signed in (step, -step)]
            for axis, step in zip(np.eye(6), steps_of(self.view, self.step_pixels), strict=True)
        ]
        return np.stack([plus - minus for plus, minus in sides], axis=-1) / (2.0 * self.step_pixels)

    def _all(self, pixels: Pixels, batches: int) -> Estimates:
        """Six columns and the image of both orders.

        With the relative error that the step leaves in the information, by second differences of the first
        order: of motions by ±h it is h²/3 ‖I''‖² / ‖I'‖², as ∫ I' I''' = −∫ I''² along a motion.
        """
        here = self._shown(pixels, self.view.pose)
        columns = np.empty((*here.shape, 6))
        bent = moved = 0.0
        for axis, step in enumerate(steps_of(self.view, self.step_pixels)):
            plus, minus = (
                self._shown(pixels, self.view.pose @ se3.exp(signed * np.eye(6)[axis]))
                for signed in (step, -step)
            )
            columns[..., axis] = (plus - minus) / (2.0 * step)
            bent += float(np.nansum((plus + minus - 2.0 * here)[0] ** 2))
            moved += float(np.nansum((0.5 * (plus - minus))[0] ** 2))
        bias = bent / (3.0 * moved) if moved else 0.0
        images = as_batches(here, batches)
        return Estimates(as_batches(columns, batches), images, here.mean(axis=0), step_bias=bias)

    def _shown(self, pixels: Pixels, pose: Floats, orders: int = ORDERS) -> Floats:
        """(orders, n, 3) the image in orders of summation, with the view's own discrete choices."""
        view = self.view
        shown = [
            view.field.show(view.camera, pose, pixels, order=order, kept=view.pose) for order in range(orders)
        ]
        return np.stack([each.values for each in shown])


def _apart(columns: Floats, others: Floats, share: float) -> tuple[float, float]:
    """How far one step's columns (n, 3, 6) are from another's, of the worst column; see `Stepping`.

    Args:
        columns: of the step in question.
        others: of a better one.
        share: of the image's pixels.

    Returns:
        The misfit, and the scatter over all pixels, with what it makes of squares.
    """
    square = np.sum(columns**2, axis=(0, 1))
    told = square > _LITTLE**2 * square.max()
    apart = (columns - others)[..., told]
    misfit = np.sum(apart**2, axis=(0, 1)) / square[told]
    products = np.sum(columns[..., told] * apart, axis=1)
    scatter = 2.0 * np.sqrt(share * np.sum(products**2, axis=0)) / square[told]
    return float(misfit.max(initial=0.0)), float(np.hypot(scatter, misfit).max(initial=0.0))


FIELD_METHODS: dict[str, type[Method]] = {method.name: method for method in (Exact, FieldDifference)}
"""The methods for fields; the first is the default."""

FIELD_REFERENCE: type[Reference] = FieldDifference
"""What the others are checked against."""


def as_batches(orders: Floats, batches: int) -> Floats:
    """(K, ...) of the same mean as both orders of summation (2, ...), and with scatter to match."""
    middle, half = 0.5 * (orders[0] + orders[1]), 0.5 * (orders[0] - orders[1])
    even = -(-batches // 2)
    odd = batches - even
    factors = np.empty(batches)
    factors[0::2] = math.sqrt((batches - 1) * odd / even)
    factors[1::2] = -math.sqrt((batches - 1) * even / odd)
    return np.asarray(middle + factors.reshape(-1, *(1,) * middle.ndim) * half)
