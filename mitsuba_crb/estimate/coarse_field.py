"""A radiance field as a reduced image shows it: its own image, reduced as the measured one was.

Drawn in larger pixels a field is another one: splats are widened to a pixel's size, and what is finer than
pixels is not averaged over. So a reduced photograph is compared with reduced renders, and with their columns.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..information.subset import selected
from ..radiance.field import Field, Floats, Pixels, Shown, Viewpoint
from .reduction import reduced


@dataclass(frozen=True, eq=False)
class CoarseField:
    """A `Field` for the camera of a reduced image."""

    field: Field
    camera: Camera
    """Of the image itself."""
    mask: NDArray[np.bool_]
    """(H, W), of which pixels the image is reduced."""
    factor: int

    @property
    def label(self) -> str:
        """See `Field.label`."""
        return self.field.label

    @property
    def viewpoints(self) -> tuple[Viewpoint, ...]:
        """See `Field.viewpoints`."""
        return self.field.viewpoints

    def refuse(self, camera: Camera) -> None:
        """See `Field.refuse`."""
        self.field.refuse(self.camera)

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
        own = self.field.show(camera, pose, pixels, order=order, kept=kept)
        fine = self.field.show(self.camera, pose, selected(self.mask), order=order, kept=kept)
        return dataclasses.replace(own, values=self._reduced(fine.values, pixels))

    def columns(
        self, camera: Camera, pose: Floats, pixels: Pixels, *, order: int = 0
    ) -> tuple[Floats, Floats]:
        """See `Field.columns`."""
        values, columns = self.field.columns(self.camera, pose, selected(self.mask), order=order)
        slopes = self._reduced(columns.reshape(len(columns), -1), pixels)
        return self._reduced(values, pixels), slopes.reshape(-1, *columns.shape[1:])

    def provenance(self) -> Mapping[str, Any]:
        """See `Field.provenance`."""
        return {**self.field.provenance(), "reduced_by": self.factor}

    def _reduced(self, values: Floats, pixels: Pixels) -> Floats:
        """Of values (n, m) at the image's pixels, those at some of the reduced image's."""
        image = np.full((*self.mask.shape, values.shape[1]), np.nan)
        image[self.mask] = values
        return reduced(image, self.factor)[pixels[:, 1], pixels[:, 0]]
