"""Central differences of the image in the pose, with common random numbers: the oracle.

    dI/dξ_i ≈ [I(world_from_camera·exp(h_i e_i)) − I(world_from_camera·exp(−h_i e_i))] / (2 h_i)

Both renders use the same random numbers, so their noise cancels where the image is smooth. The step h_i is
given in pixels of image motion (0.15, a fraction of the reconstruction filter, which is what smooths the
image in the pose), for translation at the near end of what is visible, and at most 0.05 length scales. The
bias is h²/6 times a third derivative. Almost assumption-free, at the price of twelve renders.
Source: design section 4.3.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..render.pixels import render_pixels

if TYPE_CHECKING:
    from ..render.scene import View

STEP_PIXELS = 0.15
"""Image motion of one step [pixel]."""
NEAR_PERCENTILE = 5.0
"""Percentile of the visible depth at which a translation step moves the image by that much."""


@dataclass(frozen=True)
class Prepared:
    """What all tiles of one view share."""

    steps: NDArray[np.float64]
    """(6,) step of each twist component, translation [scene unit] then rotation [rad]."""
    even: bool = False
    """Whether film offsets are Sobol' points, which resolve edges with far fewer paths."""
    block: int = 1
    """Side of the film blocks whose errors are independent [pixel]: every pixel has its own samples."""


def prepare(view: View, step_pixels: float = STEP_PIXELS, even: bool = False) -> Prepared:
    """The steps that move the image by `step_pixels`."""
    focal = view.focal_pixels
    radius = float(np.hypot(*view.size)) / np.sqrt(12.0)
    angle = step_pixels / np.array([focal, focal, max(radius, 1.0)])
    depth = view.visible_depth
    near, median = np.percentile(depth, [NEAR_PERCENTILE, 50.0]) if depth.size else (1.0, 1.0)
    shift = np.minimum(angle * near, 0.05 * median)
    return Prepared(np.concatenate([shift, angle]), even)


def jacobian(
    view: View,
    pixels: NDArray[np.int64],
    *,
    spp: int,
    seed: int,
    batches: int,
    prepared: Prepared | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """dI/dξ in the camera frame by twelve renders.

    Args:
        pixels: (n, 2) columns and rows.
        spp: paths per pixel over all batches, of each of the twelve renders.
        prepared: what `prepare` returned for this view, so that many tiles prepare once.

    Returns:
        (batches, n, 3, 6) Jacobians [radiance / scene unit, radiance / rad], and the image (batches, n, 3),
        the mean of the twelve renders.
    """
    prepared = prepared or prepare(view)
    values = np.empty((batches, len(pixels), 3, 6))
    image = np.zeros((batches, len(pixels), 3))
    for axis in range(6):
        values[..., axis], mean = column(
            view,
            pixels,
            axis,
            prepared.steps[axis],
            spp=spp,
            seed=seed,
            batches=batches,
            even=prepared.even,
        )
        image += mean / 6.0
    return values, image


def column(
    view: View,
    pixels: NDArray[np.int64],
    axis: int,
    step: float,
    *,
    spp: int,
    seed: int,
    batches: int,
    even: bool = False,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """dI/dξ_axis (batches, n, 3) in the camera frame, and the mean of its two renders, likewise."""
    twist = np.zeros(6)
    twist[axis] = step
    plus, minus = (
        render_pixels(
            view,
            pixels,
            spp=spp // batches,
            seed=seed,
            batches=batches,
            pose=view.pose @ se3.exp(xi),
            even=even,
        )
        for xi in (twist, -twist)
    )
    return (plus - minus) / (2.0 * step), 0.5 * (plus + minus)
