"""What a radiance field offers: its image, and the image's derivative in the camera's motion in closed form.

No random number is drawn: what two evaluations differ by is rounding, which two orders of summation show.
Values are display-referred: what the photographs had that the field was trained on, 1 their white.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from ..camera import Camera, Intrinsics

Floats = NDArray[np.float64]
Pixels = NDArray[np.int64]

ORDERS = 2
"""Orders of summation that a field has."""


@dataclass(frozen=True, eq=False)
class Shown:
    """What a field shows at some pixels."""

    values: Floats
    """(n, 3) [display-referred, 1 is white]."""
    depth: Floats
    """(n,) expected depth along the optical axis [unit of the field]; NaN where nothing is seen."""
    opacity: Floats
    """(n,) how much of the background is covered."""


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """A camera that a field comes with."""

    name: str
    intrinsics: Intrinsics
    pose: Floats
    """(4, 4) `world_from_camera`, in the field's own frame."""


@runtime_checkable
class Field(Protocol):
    """A radiance field."""

    @property
    def label(self) -> str:
        """Its file, or what kind of object it came from."""

    @property
    def viewpoints(self) -> tuple[Viewpoint, ...]:
        """Cameras that it comes with; empty if it has none."""

    def refuse(self, camera: Camera) -> None:
        """Whether it can be seen by a camera.

        Raises:
            FieldError: it cannot, in one line that names the cure.
        """

    def show(
        self,
        camera: Camera,
        pose: Floats,
        pixels: Pixels,
        *,
        order: int = 0,
        kept: Floats | None = None,
    ) -> Shown:
        """The image at the centres of some pixels.

        Args:
            camera: intrinsics.
            pose: (4, 4) `world_from_camera` in the library's axes, x left, y up, z forward (`se3`).
            pixels: (n, 2) columns and rows, any of the image's.
            order: of summation, below `ORDERS`.
            kept: (4, 4) pose whose discrete choices, such as the order of depth, are kept; its own by
                default.
        """

    def columns(
        self, camera: Camera, pose: Floats, pixels: Pixels, *, order: int = 0
    ) -> tuple[Floats, Floats]:
        """Values (n, 3) and dI/dξ (n, 3, 6) in the camera frame [1 / unit of the field, 1 / rad].

        Arguments as of `show`; its discrete choices are held fixed.
        """

    def provenance(self) -> Mapping[str, Any]:
        """What else its image depends on, JSON-able."""
