"""Forward-mode automatic differentiation of the rendering: the paper's Algorithm 1.

    to_world(ξ) = world_from_camera·exp(ξ),   dI/dξ_i = one forward pass from ξ_i through the integrator.

Right for radiance that is smooth along the camera rays (radiance fields, smooth textures under smooth light).
Blind to everything that jumps: it differentiates L at fixed film points, so checkerboards, nearest-filtered
bitmaps, silhouettes and shadows contribute nothing.
Source: Muthukkumar 2025, Algorithm 1; design section 4.2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Self

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..errors import IntegratorError
from ..render.pixels import sensed
from ..render.random import lane_sampler, seeding
from ..render.rays import Lanes, camera_ray
from . import lint
from .method import AtOnce, Estimates, Paths

if TYPE_CHECKING:
    from collections.abc import Iterator

    import mitsuba as mi

    from ..render.view import View
    from .film_flow import FilmFlow


MAX_LANES = 1 << 18
"""Paths per kernel launch; bounds the memory."""
FORWARD = 0x464F5257
"""Purpose of the random numbers of paths with a lane each: their place among a pixel's paths stands where
other kernels have the batch, so that under one purpose a path would share those of another batch's."""


@dataclass(frozen=True)
class Forward:
    """The method, open for one view; six forward passes."""

    name: ClassVar[str] = "forward"
    follows_film: ClassVar[bool] = False
    step_pixels: ClassVar[None] = None
    block = 1

    view: View

    @classmethod
    def open(
        cls,
        view: View,
        mask: NDArray[np.bool_],
        seed: int,
        *,
        step_pixels: float | None,
        film_flows: tuple[FilmFlow, ...] = (),
    ) -> Self:
        """See `Method.open`.

        Raises:
            IntegratorError: by name, of an integrator that detaches camera rays, whose derivative would be a
                silent zero.
        """
        from mitsuba.python.ad.integrators.common import ADIntegrator

        if isinstance(view.integrator, ADIntegrator) and view.measured.depth is None:
            raise IntegratorError(
                f"integrator {type(view.integrator).__name__} detaches camera rays, so method 'forward' "
                "would see nothing: use path, direct or volpath, or another method"
            )
        return cls(view)

    @classmethod
    def limits(cls, view: View) -> Iterator[str]:
        """See `Method.limits`."""
        if view.measured.depth is not None and not view.measured.depth.edges:
            return  # what jumps is depth at edges alone, and no pixel with one is measured
        yield from lint.cut_surfaces(view, cls.name)
        for finding in lint.discontinuities(view):
            yield (
                f"method 'forward' cannot see {finding}: its information is too small and its bound no "
                "bound; use flow"
            )

    def prepare(self, pixels: NDArray[np.int64], paths: Paths) -> AtOnce:
        """See `Method.prepare`."""
        return AtOnce(lambda: self._all(pixels, paths))

    def _all(self, pixels: NDArray[np.int64], paths: Paths) -> Estimates:
        spp, batches = paths.spp, paths.batches
        values = np.empty((batches, len(pixels), 3, 6))
        image = np.empty((batches, len(pixels), 3))
        count = max(1, MAX_LANES // spp)
        for start in range(0, len(pixels), count):
            part = slice(start, start + count)
            for axis in range(6):
                column, primal = _column(self.view, pixels[part], spp, paths.seed, axis)
                values[:, part, :, axis] = per_batch(column, batches)
            image[:, part] = per_batch(primal, batches)
        return Estimates(values, image, image.mean(axis=0))


def _column(
    view: View, pixels: NDArray[np.int64], spp: int, seed: int, axis: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """One derivative and the radiance, per pixel and path: (n, spp, 3) each.

    One lane per path: Dr.Jit 1.5 cannot differentiate a loop over samples around the integrator's own loop.
    """
    import mitsuba as mi

    sampler, ray, weight = camera_paths(view, pixels, spp, seed)
    twist = [mi.Float(0.0) for _ in range(6)]
    dr.enable_grad(twist[axis])
    value = weight * sensed(view, sampler, ray, _attached_transform(view.pose, twist))
    dr.forward_from(twist[axis])
    return per_path(dr.grad(value), spp), per_path(dr.detach(value), spp)


def camera_paths(
    view: View, pixels: NDArray[np.int64], spp: int, seed: int
) -> tuple[mi.Sampler, mi.Ray3f, mi.Color3f]:
    """All paths of some pixels, a lane each: their samplers, rays in the camera frame, and weights."""
    import mitsuba as mi

    lanes = Lanes.of(view, pixels, spp)
    sampler = lane_sampler(lanes.pixel, lanes.batch, seeding(seed, FORWARD))
    offset, weight = view.pixel_filter.sample(sampler.next_2d())
    ray, importance = camera_ray(view, lanes.centre + mi.Vector2f(offset), sampler.next_2d())
    return sampler, ray, weight * importance


def per_batch(paths: NDArray[np.float64], batches: int) -> NDArray[np.float64]:
    """Means (batches, n, 3) of (n, spp, 3)."""
    means: NDArray[np.float64] = paths.reshape(len(paths), batches, -1, 3).mean(axis=2).swapaxes(0, 1)
    return means


def per_path(color: mi.Color3f, spp: int) -> NDArray[np.float64]:
    """(n, spp, 3) of one lane per path."""
    return np.array(color, dtype=np.float64).reshape(3, spp, -1).transpose(2, 1, 0)


def _attached_transform(pose: NDArray[np.float64], twist: list[mi.Float]) -> mi.Transform4f:
    """world_from_camera·(1 + ξ^), which has the value and the derivative of exp at ξ = 0."""
    import mitsuba as mi

    x, y, z, a, b, c = twist
    generator = mi.Matrix4f(1, -c, b, x, c, 1, -a, y, -b, a, 1, z, 0, 0, 0, 1)
    base = mi.Matrix4f(pose.astype(np.float32))
    dr.make_opaque(base)
    return mi.Transform4f(base @ generator)
