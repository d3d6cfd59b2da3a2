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
from typing import Any, ClassVar, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..jacobian.finite_difference import steps_of
from ..jacobian.method import AtOnce, Estimates, Method, Paths, Reference, Seen, Stepping
from .field import ORDERS, Field, Floats, Pixels

STEP_PIXELS = 0.05
"""Image motion of a difference's step [pixel]: of a splat that is as narrow as rasterisers let it be, 0.55
pixels, it hides 0.3 % of the information."""


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
        """See `Reference.stepping`."""
        return Stepping(STEP_PIXELS, 2, 0.0)

    @classmethod
    def limits(cls, view: FieldSeen) -> tuple[str, ...]:
        """Nothing: see `Method.limits`."""
        return ()

    def prepare(self, pixels: Pixels, paths: Paths) -> AtOnce:
        """See `Method.prepare`."""
        return AtOnce(lambda: self._all(pixels, paths.batches))

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

    def _shown(self, pixels: Pixels, pose: Floats) -> Floats:
        """(2, n, 3) the image in both orders of summation, with the view's own discrete choices."""
        view = self.view
        shown = [
            view.field.show(view.camera, pose, pixels, order=order, kept=view.pose) for order in range(ORDERS)
        ]
        return np.stack([each.values for each in shown])


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
