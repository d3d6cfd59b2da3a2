"""What an information or a derivative is about: whose pose, in which frame, at which pose, by which pixels.

Numbers about the same variable, in the same frame, linearised at the same pose may be added; all others are
refused. Conventions: `se3`.
"""

from __future__ import annotations

from dataclasses import dataclass
from dataclasses import replace as dataclass_replace
from typing import Any, Literal, Self

import numpy as np

from .. import se3
from ..errors import FrameError
from ..files import Record
from ..se3 import Array, Frame

_ROUNDING = 1e-9


@dataclass(frozen=True)
class PixelSelection(Record):
    """Which pixels were measured, and what that means for the information."""

    kind: Literal["all", "random", "only"]
    """`"random"` estimates the whole image's information; `"only"`: the estimator sees just those pixels."""
    total: int
    """Pixels of the whole image."""
    selected: int
    """Pixels chosen, including those dropped afterwards because they were invalid."""
    description: str
    """As the user gave it: `"all"`, `"random:0.1"`, `"gradient:0.1"`, `"mask.png"`."""

    def only(self, selected: int, description: str | None = None) -> PixelSelection:
        """So many of these pixels as all that an estimator has, whatever they were chosen to stand for."""
        if selected == self.total:
            return PixelSelection("all", self.total, selected, "all")
        words = self.description if description is None else description
        return PixelSelection("only", self.total, selected, words)

    def __add__(self, other: PixelSelection) -> PixelSelection:
        """Those of two measurements together, of the kind that promises less."""
        kinds: tuple[Literal["only", "random", "all"], ...] = ("only", "random", "all")
        return PixelSelection(
            next(kind for kind in kinds if kind in (self.kind, other.kind)),
            self.total + other.total,
            self.selected + other.selected,
            f"{self.description} + {other.description}",
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Linearisation(Record):
    """The pose that something is differentiated at, and all that its numbers need to be read.

    Raises:
        FrameError: an unknown frame, or a length scale that is not positive and finite.
        PoseError: the pose is no rigid motion.
    """

    variable: str
    """Which camera or body the pose belongs to."""
    frame: Frame
    """The twist's frame, `"camera"` or `"world"`."""
    pose: Array
    """(4, 4), world_from_camera, the linearisation point."""
    length_scale: float
    """Length [scene unit] that makes translation comparable with rotation: the median visible depth; 1 if
    nothing finite is visible."""
    selection: PixelSelection
    """Which pixels were measured, and what they stand for."""

    def __post_init__(self) -> None:
        _check_frame(self.frame)
        if not (np.isfinite(self.length_scale) and self.length_scale > 0.0):
            raise FrameError(f"the length scale must be positive and finite, not {self.length_scale}")
        pose = se3.as_pose(self.pose)
        pose.flags.writeable = False
        object.__setattr__(self, "pose", pose)

    @property
    def scale(self) -> Array:
        """(6,), camera-frame twist per twist in scaled units: the length scale three times, then ones."""
        return np.array([self.length_scale] * 3 + [1.0] * 3)

    def old_from_new(self, frame: Frame) -> Array | None:
        """A (6, 6) with ξ = A ξ_new for the twist in another frame, or None if it is this one.

        Raises:
            FrameError: `frame` is neither `"camera"` nor `"world"`.
        """
        _check_frame(frame)
        if frame == self.frame:
            return None
        return se3.adjoint(self.pose if self.frame == "world" else se3.inverse(self.pose))

    def refuse_to_mix(self, other: Linearisation, act: str) -> None:
        """Refuse to `act` on numbers about this and about another linearisation.

        Raises:
            FrameError: variable, frame or pose differ.
        """
        if self.variable != other.variable:
            raise FrameError(
                f"cannot {act} about {self.variable!r} and about {other.variable!r}; transport them to one "
                "common pose"
            )
        if self.frame != other.frame:
            raise FrameError(
                f"cannot {act} in the {self.frame} and in the {other.frame} frame; call to_frame on one of "
                "them"
            )
        tolerance = _ROUNDING * max(1.0, float(np.abs(self.pose[:3, 3]).max()))
        if not np.allclose(self.pose, other.pose, rtol=0.0, atol=tolerance):
            raise FrameError(f"cannot {act} linearised at two different poses")

    def with_pixels_of(self, other: Linearisation) -> Linearisation:
        """Of two independent measurements of one pose together: all pixels, and the larger length scale."""
        return dataclass_replace(
            self,
            length_scale=max(self.length_scale, other.length_scale),
            selection=self.selection + other.selection,
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Linearised(Record):
    """Numbers that know what they are about, and can be asked for it."""

    linearisation: Linearisation
    """What the numbers are about."""

    @property
    def variable(self) -> str:
        """Which camera or body the pose belongs to."""
        return self.linearisation.variable

    @property
    def frame(self) -> Frame:
        """The twist's frame, `"camera"` or `"world"`."""
        return self.linearisation.frame

    @property
    def pose(self) -> Array:
        """(4, 4), world_from_camera, the linearisation point."""
        return self.linearisation.pose

    @property
    def length_scale(self) -> float:
        """Length [scene unit] that makes translation comparable with rotation."""
        return self.linearisation.length_scale

    @property
    def selection(self) -> PixelSelection:
        """Which pixels were measured, and what they stand for."""
        return self.linearisation.selection

    @property
    def scale(self) -> Array:
        """(6,), camera-frame twist per twist in scaled units: the length scale three times, then ones."""
        return self.linearisation.scale

    def about(self, **changes: Any) -> Self:
        """The same numbers, said to be about something else: with other fields of `Linearisation`."""
        return dataclass_replace(self, linearisation=dataclass_replace(self.linearisation, **changes))


def _check_frame(frame: str) -> None:
    if frame not in ("camera", "world"):
        raise FrameError(f"unknown frame {frame!r}; expected 'camera' or 'world'")
