"""The image's derivative in the camera's intrinsics, by renders of the view through two other cameras.

Central differences with common random numbers, for methods that do not follow the film themselves, and the
oracle of those that do (`film_flow`). Whatever can be measured can be seen through another camera, see
`measure.measurable`. Source: design section 4.3.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from .method import Paths
from .parameter import STEP_PIXELS

if TYPE_CHECKING:
    from ..camera import Intrinsics

_TINY = 1e-6
"""A change of a parameter that its effect is read off."""
_PURPOSE = 0
"""Of the renders' random numbers."""


@dataclass(frozen=True)
class IntrinsicParameter:
    """One number of a camera, and the step of its differences."""

    name: str
    """As `film_flow.film_flows` knows it, but for "principal_point"."""
    step: float
    """[unit of the parameter]."""

    @staticmethod
    def of(view: Any, name: str, step_pixels: float = STEP_PIXELS) -> tuple[IntrinsicParameter, ...]:
        """Those of a name, with steps that move no point of the film by more than `step_pixels`."""
        if name == "principal_point":
            return tuple(IntrinsicParameter.of(view, axis, step_pixels)[0] for axis in ("cx", "cy"))
        size = np.asarray(view.size)
        x, y = np.meshgrid(*np.linspace([0.0, 0.0], size, 9).T)
        film = np.stack([x.ravel(), y.ravel()], axis=1)
        seen = view.camera.directions(film)
        moved = Camera.of(_moved(view, name, _TINY)).project(seen) - film
        fastest = np.linalg.norm(moved, axis=1).max() / _TINY
        return (IntrinsicParameter(name, float(step_pixels / fastest)),)

    @property
    def how(self) -> str:
        """In words, for provenance."""
        return f"finite differences, step {self.step:.3g}"

    def columns(self, view: Any, pixels: NDArray[np.int64], paths: Paths) -> NDArray[np.float64]:
        """(batches, n, 3, 1) ∂I/∂θ [radiance per unit of the parameter]."""
        images = [
            view.seen_through(_moved(view, self.name, step)).start_image(pixels, paths, purpose=_PURPOSE)()
            for step in (self.step, -self.step)
        ]
        return np.asarray((images[0] - images[1]) / (2.0 * self.step))[..., None]


def _moved(view: Any, name: str, by: float) -> Intrinsics:
    """The view's camera with another number."""
    now: Intrinsics = view.intrinsics
    if name != "fov":
        return now.moved(name, by)
    half = np.radians(0.5 * view.plain_fov_deg)
    longer = float(np.tan(half) / np.tan(half + np.radians(0.5 * by)))
    return dataclasses.replace(now, focal=(now.focal[0] * longer, now.focal[1] * longer))
