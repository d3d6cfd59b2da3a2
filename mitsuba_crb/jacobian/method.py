"""What a way to measure the Jacobian offers.

A method is opened for one view and the pixels that will be asked for, and is then asked for one tile of them
after the other. A tile goes through `launch`, `wait`, `settle`, again `wait`, and `result`, so that the next
one can be prepared, and those before summed up, while its light paths are traced in the background.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from ..camera import Camera
    from .film_flow import FilmFlow

Floats = NDArray[np.float64]
Pixels = NDArray[np.int64]


class Estimates(NamedTuple):
    """What a method says of some pixels."""

    columns: Floats
    """(batches, n, 3, 6 + m) dI/dξ in the camera frame [radiance / scene unit, radiance / rad], then the m
    film parameters' columns [radiance per unit]."""
    images: Floats
    """(batches, n, 3) each batch's own image, without bias [radiance]."""
    image: Floats
    """(n, 3) the image of all batches, the least noisy one at hand [radiance]."""
    causes: NDArray[np.object_] | None = None
    """None, or (n,) why finite differences took the method's place at a pixel, "" where they did not."""
    step_bias: float = 0.0
    """Relative error that their step may leave in the information of those pixels; without causes, of all."""


@dataclass(frozen=True)
class Paths:
    """How many light paths, and with which random numbers."""

    spp: int
    """Per pixel over all batches."""
    seed: int
    """Of all random numbers."""
    batches: int
    """Independent estimates."""


Part = tuple[Pixels, Paths]
"""Pixels (n, 2) of a tile, and the paths of each of them."""


class Tile(Protocol):
    """Some pixels on their way; whole blocks of them."""

    def launch(self) -> None:
        """Start what runs in the background."""

    def wait(self) -> None:
        """Until that has ended."""

    def settle(self) -> SettledTile:
        """Sum up; start in the background what the sums call for."""


class SettledTile(Protocol):
    """What became of some pixels, but for what is still on its way."""

    def wait(self) -> None:
        """Until that has ended."""

    def result(self) -> Estimates:
        """What came of it."""


class Method(Protocol):
    """A way to measure the Jacobian, open for one view."""

    name: ClassVar[str]
    """As users call it."""
    follows_film: ClassVar[bool]
    """Whether it can differentiate in parameters that move the film alone, beside the pose."""

    @property
    def step_pixels(self) -> float | None:
        """Image motion of the step that all of its columns come from [pixel]; None where there is none."""

    @property
    def block(self) -> int:
        """Side of the film blocks whose errors are independent [pixel]; 1: each pixel has its own samples."""

    @classmethod
    def open(
        cls,
        view: Any,
        mask: NDArray[np.bool_],
        seed: int,
        *,
        step_pixels: float | None,
        film_flows: tuple[FilmFlow, ...] = (),
    ) -> Self:
        """Prepare what all tiles share.

        Args:
            view: what this method can measure; stays open as long as the method is used.
            mask: (H, W), the pixels that will be asked for.
            seed: of the random numbers of what all tiles share.
            step_pixels: image motion of a finite difference's step, where there is one [pixel]; None leaves
                that to the method.
            film_flows: of parameters that act on the film alone; only for those that `follows_film`.

        Raises:
            MitsubaCRBError: the method cannot measure this view, by name.

        Warns:
            BlindSpotWarning: by name, of what it will miss.
        """

    @classmethod
    def limits(cls, view: Any) -> Iterable[str]:
        """What the method cannot see in this view; each sentence says what the numbers are worth."""

    def prepare(self, pixels: Pixels, paths: Paths) -> Tile:
        """Ready some pixels (n, 2), columns and rows; those of one block must come in one call."""


class Seen(Protocol):
    """What the steps of a difference in the pose are chosen by."""

    @property
    def camera(self) -> Camera:
        """Intrinsics."""

    @property
    def pose(self) -> Floats:
        """(4, 4) `world_from_camera`."""

    @property
    def visible_depth(self) -> Floats:
        """(n,) depths along the optical axis of what is seen [scene unit]."""


class Stepping(NamedTuple):
    """How a central difference steps, and what that does to its columns."""

    pixels: float
    """Image motion of a step [pixel]."""
    order: int
    """The power of the step that the bias goes by."""
    misfit: float
    """‖J_h − J‖² / ‖J‖² of the sharpest thing that may be seen."""
    scatter: float = 0.0
    """Relative standard error of the information by what a step does in one pixel and not in the next."""


class Reference(Method, Protocol):
    """Central differences, which other methods of the same views are checked against."""

    @classmethod
    def stepping(cls, view: Any) -> Stepping:
        """As it steps in a view by itself."""


@dataclass(frozen=True)
class AtOnce:
    """A tile of a method that does all its work at the end."""

    work: Callable[[], Estimates]

    def launch(self) -> None:
        """Nothing."""

    def wait(self) -> None:
        """Nothing."""

    def settle(self) -> AtOnce:
        """Itself."""
        return self

    def result(self) -> Estimates:
        """All of it."""
        return self.work()


def estimates(method: Method, pixels: Pixels, paths: Paths) -> Estimates:
    """A method's result for some pixels, in one go."""
    tile = method.prepare(pixels, paths)
    tile.launch()
    tile.wait()
    settled = tile.settle()
    settled.wait()
    return settled.result()


def tile_by_tile(method: Method, parts: Sequence[Part]) -> Iterator[tuple[Part, Estimates]]:
    """Each tile's pixels with their paths, and what the method says of them.

    One tile is prepared, and the two before it summed up, while paths are traced.
    """
    running: tuple[Part, Tile] | None = None
    settled: tuple[Part, SettledTile] | None = None
    for part in chain(parts, (None, None)):
        tile = None if part is None else method.prepare(*part)
        # To look at arrays is to wait for all that was launched, so before the next tile is.
        for earlier in (running, settled):
            if earlier is not None:
                earlier[1].wait()
        if tile is not None:
            tile.launch()
        if settled is not None:
            yield settled[0], settled[1].result()
        settled = None if running is None else (running[0], running[1].settle())
        running = None if part is None or tile is None else (part, tile)
