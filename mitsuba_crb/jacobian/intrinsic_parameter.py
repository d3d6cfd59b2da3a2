"""The image's derivative in the camera's intrinsics, by renders of the view through two other cameras.

Central differences with common random numbers, for methods that do not follow the film themselves, and the
oracle of those that do (`film_flow`). Source: design section 4.3.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..render.pixels import render_pixels
from .film_flow import plain_fov_deg
from .method import Paths
from .parameter import STEP_PIXELS

if TYPE_CHECKING:
    from ..camera import Intrinsics
    from ..render.view import View

_TINY = 1e-6
"""A change of a parameter that its effect is read off."""


@dataclass(frozen=True)
class IntrinsicParameter:
    """One number of a camera, and the step of its differences."""

    name: str
    """As `film_flow.film_flows` knows it, but for "principal_point"."""
    step: float
    """[unit of the parameter]."""

    @staticmethod
    def of(view: View, name: str) -> tuple[IntrinsicParameter, ...]:
        """Those of a name, with steps that move no point of the film by more than `STEP_PIXELS`."""
        if name == "principal_point":
            return IntrinsicParameter.of(view, "cx") + IntrinsicParameter.of(view, "cy")
        size = np.asarray(view.size)
        x, y = np.meshgrid(*np.linspace([0.0, 0.0], size, 9).T)
        film = np.stack([x.ravel(), y.ravel()], axis=1)
        seen = view.camera.directions(film)
        moved = Camera.of(_moved(view, name, _TINY)).project(seen) - film
        fastest = np.linalg.norm(moved, axis=1).max() / _TINY
        return (IntrinsicParameter(name, float(STEP_PIXELS / fastest)),)

    @property
    def how(self) -> str:
        """In words, for provenance."""
        return f"finite differences, step {self.step:.3g}"

    def columns(self, view: View, pixels: NDArray[np.int64], paths: Paths) -> NDArray[np.float64]:
        """(batches, n, 3, 1) ∂I/∂θ [radiance per unit of the parameter]."""
        spp = paths.spp // paths.batches
        images = [
            render_pixels(
                view.seen_through(_moved(view, self.name, step)),
                pixels,
                spp=spp,
                seed=paths.seed,
                batches=paths.batches,
            )
            for step in (self.step, -self.step)
        ]
        return np.asarray((images[0] - images[1]) / (2.0 * self.step))[..., None]


def _moved(view: View, name: str, by: float) -> Intrinsics:
    """The view's camera with another number."""
    now = view.intrinsics
    if name != "fov":
        return now.moved(name, by)
    half = np.radians(0.5 * plain_fov_deg(view))
    longer = float(np.tan(half) / np.tan(half + np.radians(0.5 * by)))
    return dataclasses.replace(now, focal=(now.focal[0] * longer, now.focal[1] * longer))
