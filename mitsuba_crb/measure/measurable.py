"""What can be measured: an image of a world, as a function of its camera's pose.

A Mitsuba scene is one (`mitsuba_view`), a radiance field is (`field_view`); whatever else has these members
comes under the same bound, by the same functions and commands. `opening` tells them apart.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from ..errors import OptionError
from ..jacobian.method import Method, Paths, Reference

if TYPE_CHECKING:
    from ..camera import Camera, Intrinsics
    from ..noise import Measured
    from .nuisances import Nuisance


class Measurable(Protocol):
    """One camera in one world."""

    @property
    def label(self) -> str:
        """The world's file, or what kind of object it came from."""

    @property
    def variable(self) -> str:
        """The camera's name."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image [pixel]."""

    @property
    def pose(self) -> NDArray[np.float64]:
        """`world_from_camera`, 4x4, rigid."""

    @property
    def measured(self) -> Measured:
        """What the camera measures of the image."""

    @property
    def white(self) -> float | None:
        """What its values call white; None of radiance, which a camera is exposed for."""

    @property
    def camera(self) -> Camera:
        """Intrinsics, ready to project."""

    @property
    def intrinsics(self) -> Intrinsics:
        """What a calibration says of the camera, or would."""

    @property
    def visible_depth(self) -> NDArray[np.float64]:
        """Finite depths along the optical axis through a coarse grid of pixels [scene unit]."""

    @property
    def methods(self) -> Mapping[str, type[Method]]:
        """Ways to measure the columns of its pixels, by name; the first is the default."""

    @property
    def reference(self) -> type[Reference]:
        """The one that the others are checked against."""

    @property
    def deterministic(self) -> bool:
        """Whether no random number is drawn: then all batches show the same, but for rounding."""

    def telling(self) -> NDArray[np.bool_] | None:
        """(H, W) the pixels that measure anything; None: all."""

    def at(self, pose: NDArray[np.float64]) -> Self:
        """The same camera at another pose (4, 4)."""

    def seen_through(self, intrinsics: Intrinsics) -> Self:
        """The same world through another camera.

        Raises:
            CameraError: it cannot be.
        """

    def start_image(
        self,
        pixels: NDArray[np.int64],
        paths: Paths,
        *,
        purpose: int,
        pose: NDArray[np.float64] | None = None,
        even: bool = False,
    ) -> Callable[[], NDArray[np.float64]]:
        """Start to render some pixels (n, 2) in the background, by random numbers of a purpose of their own.

        Args:
            pose: in place of the camera's own.
            even: film points that fill each pixel evenly, where that is possible.

        Returns:
            What waits, and gives the image (batches, n, 3) [radiance].
        """

    def open_nuisances(self, names: Sequence[str], method: type[Method]) -> tuple[Nuisance, ...]:
        """What is not known beside the pose, by name.

        Raises:
            NuisanceError: there is none of a name, it has no derivative, or a name comes twice.
        """

    def precision_limits(self) -> Sequence[str]:
        """Where the arithmetic is too coarse for the derivative, each in a sentence."""

    def nothing_visible(self, *, black: bool = False) -> str:
        """Why the image shows nothing, in a sentence; empty if it shows something.

        Args:
            black: it is known to be black; then the answer is not empty.
        """

    def provenance(self) -> dict[str, Any]:
        """What else the numbers depend on, JSON-able."""


def method_of(methods: Mapping[str, type[Method]], name: str | None) -> type[Method]:
    """The way to measure a view that users call so; None: the default.

    Args:
        methods: see `Measurable.methods`.
        name: one of theirs.

    Raises:
        OptionError: there is none; names the near one.
    """
    if name is None:
        return next(iter(methods.values()))
    if name not in methods:
        near = get_close_matches(str(name), methods, 1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise OptionError(f"unknown method {name!r}; {hint}methods: {', '.join(methods)}")
    return methods[name]
