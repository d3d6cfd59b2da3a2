"""Central differences of the image in the pose, with common random numbers: the oracle.

    dI/dξ_i ≈ [I(world_from_camera·exp(h_i e_i)) − I(world_from_camera·exp(−h_i e_i))] / (2 h_i)

Both renders use the same random numbers, so their noise cancels where the image is smooth; film offsets are
Sobol' points, which resolve edges with far fewer paths than independent ones. The step h_i is given in pixels
of image motion (a fraction of the reconstruction filter, which is what smooths the image in the pose:
`step_for`): of a turn where the film moves fastest, of translation at the near end of what is visible and at
most 0.05 length scales, and of edges that the near or the far plane cuts. The bias is h²/6 times a third
derivative; of an edge it is the filter's, averaged over the step (`edge_bias`).
Almost assumption-free, at the price of twelve renders.
Source: design section 4.3.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..errors import BlindSpotWarning
from ..render.pixels import render_pixels
from .clip_planes import cut_speeds, cuts_by_far_plane, cuts_by_near_plane
from .method import AtOnce, Estimates, Paths, Seen, Stepping

if TYPE_CHECKING:
    from ..camera import Camera
    from ..render.film import PixelFilter
    from ..render.view import View
    from .film_flow import FilmFlow

STEP_PIXELS = 0.15
"""Image motion of the longest step that is chosen for a filter [pixel]."""
NEAR_PERCENTILE = 5.0
"""Percentile of the visible depth at which a translation step moves the image by that much."""
_PLACES = 9
"""Along each side of the film, at which its motion is looked at."""
BIAS = 0.02
"""Relative error of an edge's information that a step chosen for a filter may have."""


def steps_of(
    view: Seen,
    step_pixels: float = STEP_PIXELS,
    depth: NDArray[np.float64] | None = None,
    cuts: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """(6,) the steps that move the image by `step_pixels`, translation [scene unit] then rotation [rad].

    Args:
        depth: (n,) of what is to move by that much; by default of all that is visible [scene unit].
        cuts: (n, 6) film motion of edges that a clip plane makes, see `clip_planes.cut_speeds`.
    """
    angle = view.camera.angles(step_pixels)
    visible = view.visible_depth
    median = np.median(visible) if visible.size else 1.0
    seen = visible if depth is None or not depth.size else depth
    near = np.percentile(seen, NEAR_PERCENTILE) if seen.size else 1.0
    steps = np.concatenate([np.minimum(angle * near, 0.05 * median), angle / _turning(view.camera)])
    if cuts is None or not len(cuts):
        return steps
    fast = np.percentile(cuts, 100.0 - NEAR_PERCENTILE, axis=0)
    return np.asarray(np.minimum(steps, step_pixels / np.maximum(fast, np.finfo(float).tiny)))


def _turning(camera: Camera) -> NDArray[np.float64]:
    """(3,) how many times as fast pitch, yaw and roll move the film's fastest point as `angles` has it.

    At the corners of a film about the principal point a roll moves it √3 times as fast as on the average.
    """
    x, y = (np.linspace(0.0, side, _PLACES) for side in camera.size)
    film = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    turn = camera.flow(camera.directions(film))[:, :, 3:]
    fastest = np.linalg.norm(turn, axis=1).max(axis=0) * camera.angles(1.0)
    return np.asarray(np.maximum(fastest / [1.0, 1.0, np.sqrt(3.0)], 1.0))


def edge_bias(pixel_filter: PixelFilter, step_pixels: float) -> float:
    """How much of an edge's information a step hides: 1 − ∫ (h * b)² / ∫ h², b the box of twice the step.

    The derivative of an edge's image is h at its distance; a central difference averages that over the step.
    What is smoother than an edge loses less.
    """
    h, averaged = _averaged(pixel_filter, step_pixels)
    return float(1.0 - np.sum(averaged**2) / np.sum(h**2))


def edge_misfit(pixel_filter: PixelFilter, step_pixels: float) -> float:
    """How far a step takes an edge's derivative from the true one: ∫ (h * b − h)² / ∫ h², see `edge_bias`."""
    h, averaged = _averaged(pixel_filter, step_pixels)
    return float(np.sum((averaged - h) ** 2) / np.sum(h**2))


def _averaged(pixel_filter: PixelFilter, step_pixels: float) -> tuple[NDArray[np.float64], ...]:
    """h, between zeros, and h * b at the same places."""
    h = pixel_filter.values
    # Odd, so that the average's middle is at one of the places.
    width = 2 * round(0.5 * step_pixels / pixel_filter.radius * len(h)) + 1
    averaged = np.convolve(h, np.full(width, 1.0 / width))
    return np.pad(h, width // 2), averaged


def step_for(pixel_filter: PixelFilter) -> float:
    """The longest step of at most `STEP_PIXELS` that hides no more than `BIAS` of an edge's information."""
    step = STEP_PIXELS
    while edge_bias(pixel_filter, step) > BIAS:
        step *= 0.5
    return step


def order_of(pixel_filter: PixelFilter, step_pixels: float) -> int:
    """The power p of the step that an edge's bias goes by: 1 if the filter jumps (a box), else 2."""
    shorter, longer = (edge_bias(pixel_filter, factor * step_pixels) for factor in (1.0, 2.0))
    return round(math.log2(longer / shorter))


@dataclass(frozen=True)
class FiniteDifference:
    """The method, open for one view; it traces twelve times the paths that it is asked for."""

    name: ClassVar[str] = "finite_difference"
    follows_film: ClassVar[bool] = False
    block = 1

    view: View
    step_pixels: float
    """Image motion of a step [pixel]."""
    steps: NDArray[np.float64]
    """(6,) [scene unit, rad]."""

    @classmethod
    def open(
        cls,
        view: View,
        mask: NDArray[np.bool_],
        seed: int,
        *,
        step_pixels: float | None = None,
        film_flows: tuple[FilmFlow, ...] = (),
    ) -> Self:
        """See `Method.open`.

        Warns:
            BlindSpotWarning: a step takes the camera through something that is seen.
        """
        step_pixels = step_for(view.pixel_filter) if step_pixels is None else step_pixels
        cuts = np.concatenate([cuts_by_near_plane(view), cuts_by_far_plane(view)])
        steps = steps_of(view, step_pixels, cuts=cut_speeds(view, cuts))
        step = float(steps[:3].max())
        nearest = float(view.visible_depth.min(initial=np.inf))
        if nearest <= step:
            warnings.warn(
                f"a step of finite differences moves the camera by {step:.3g} scene units, through what is "
                f"seen at depth {nearest:.3g}: lower step_pixels, or move the camera away from it",
                BlindSpotWarning,
                stacklevel=2,
            )
        return cls(view, step_pixels, steps)

    @classmethod
    def stepping(cls, view: View) -> Stepping:
        """See `Reference.stepping`."""
        step = step_for(view.pixel_filter)
        return Stepping(step, order_of(view.pixel_filter, step), edge_misfit(view.pixel_filter, step))

    @classmethod
    def limits(cls, view: View) -> tuple[str, ...]:
        """Nothing: see `Method.limits`."""
        return ()

    def prepare(self, pixels: NDArray[np.int64], paths: Paths) -> AtOnce:
        """See `Method.prepare`."""
        return AtOnce(lambda: self._all(pixels, paths))

    def _all(self, pixels: NDArray[np.int64], paths: Paths) -> Estimates:
        """Six columns, and the mean of the twelve renders."""
        values = np.empty((paths.batches, len(pixels), 3, 6))
        image = np.zeros((paths.batches, len(pixels), 3))
        for axis, step in enumerate(self.steps):
            values[..., axis], mean = column(self.view, pixels, axis, step, paths)
            image += mean / 6.0
        bias = edge_bias(self.view.pixel_filter, self.step_pixels)
        return Estimates(values, image, image.mean(axis=0), step_bias=bias)


def column(
    view: View,
    pixels: NDArray[np.int64],
    axis: int,
    step: float,
    paths: Paths,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """dI/dξ_axis (batches, n, 3) in the camera frame, and the mean of its two renders, likewise."""
    twist = np.zeros(6)
    twist[axis] = step
    plus, minus = (
        render_pixels(
            view,
            pixels,
            spp=paths.spp // paths.batches,
            seed=paths.seed,
            batches=paths.batches,
            pose=view.pose @ se3.exp(xi),
            even=True,
        )
        for xi in (twist, -twist)
    )
    return (plus - minus) / (2.0 * step), 0.5 * (plus + minus)
