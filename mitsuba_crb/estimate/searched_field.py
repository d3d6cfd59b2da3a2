"""Radiance fields as a search sees them: reduced as the photograph was, and with half of the work.

Drawn in larger pixels a field is another one: splats are widened to a pixel's size, and what is finer than
pixels is not averaged over. So a reduced photograph is compared with reduced renders, and with their columns.
Two orders of summation tell rounding, which a search need not know: it has one.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..information.subset import selected
from ..radiance.field import Field, Floats, Pixels, Shown, Viewpoint
from .reduction import reduced


@dataclass(frozen=True, eq=False)
class SearchedField:
    """A `Field` with one order of summation, whose last columns are kept for the other one."""

    whole: Field
    """Whose image it is."""
    _last: dict[bytes, tuple[Floats, Floats]] = field(default_factory=dict, init=False, repr=False)

    @property
    def label(self) -> str:
        """See `Field.label`."""
        return self.whole.label

    @property
    def viewpoints(self) -> tuple[Viewpoint, ...]:
        """See `Field.viewpoints`."""
        return self.whole.viewpoints

    def refuse(self, camera: Camera) -> None:
        """See `Field.refuse`."""
        self.whole.refuse(camera)

    def show(
        self,
        camera: Camera,
        pose: Floats,
        pixels: Pixels,
        *,
        order: int = 0,
        kept: Floats | None = None,
    ) -> Shown:
        """See `Field.show`."""
        return self.whole.show(camera, pose, pixels, kept=kept)

    def columns(
        self, camera: Camera, pose: Floats, pixels: Pixels, *, order: int = 0
    ) -> tuple[Floats, Floats]:
        """See `Field.columns`; of any order they are the same."""
        key = pose.tobytes() + pixels.tobytes()
        if key not in self._last:
            self._last.clear()
            self._last[key] = self._columns(camera, pose, pixels)
        return self._last[key]

    def provenance(self) -> Mapping[str, Any]:
        """See `Field.provenance`."""
        return self.whole.provenance()

    def _columns(self, camera: Camera, pose: Floats, pixels: Pixels) -> tuple[Floats, Floats]:
        return self.whole.columns(camera, pose, pixels)


@dataclass(frozen=True, eq=False)
class ReducedField(SearchedField):
    """One for the camera of an image that is reduced by two."""

    camera: Camera
    """Of the image before."""
    mask: NDArray[np.bool_]
    """(H, W), the pixels before that say something."""

    def show(
        self,
        camera: Camera,
        pose: Floats,
        pixels: Pixels,
        *,
        order: int = 0,
        kept: Floats | None = None,
    ) -> Shown:
        """Arguments as of `Field.show`; depth and opacity are those at the large pixels' centres."""
        own = self.whole.show(camera, pose, pixels, kept=kept)
        fine = self.whole.show(self.camera, pose, selected(self.mask), kept=kept)
        return dataclasses.replace(own, values=self._reduced(fine.values, pixels))

    def _columns(self, camera: Camera, pose: Floats, pixels: Pixels) -> tuple[Floats, Floats]:
        values, columns = self.whole.columns(self.camera, pose, selected(self.mask))
        slopes = self._reduced(columns.reshape(len(columns), -1), pixels)
        return self._reduced(values, pixels), slopes.reshape(-1, *columns.shape[1:])

    def _reduced(self, values: Floats, pixels: Pixels) -> Floats:
        """Of values (n, m) before, those at some of the reduced image's pixels."""
        image = np.full((*self.mask.shape, values.shape[1]), np.nan)
        image[self.mask] = values
        return reduced(image, 2)[pixels[:, 1], pixels[:, 0]]


def reduced_world(
    world: Field, camera: Camera, measured: NDArray[np.float64]
) -> tuple[ReducedField, NDArray[np.float64]]:
    """A field for an image reduced by two, and that image (h, w, 3).

    Args:
        world: the field.
        camera: of the image before.
        measured: (H, W, 3), NaN where it says nothing.
    """
    mask = np.asarray(np.isfinite(measured).all(axis=2))
    return ReducedField(world, camera, mask), reduced(np.where(mask[..., None], measured, np.nan), 2)
