"""The measurement: what each pixel's filter integrates, sampled one lane per pixel and batch.

    I_u = ∫ h(v − c_u) L(v) dv,   h normalised to ∫h = 1,   L = radiance along the camera ray of film point v.

A depth camera measures z in the place of L, the depth of what the ray hits along the optical axis.

Each pixel draws its own offsets v − c_u from a density close to |h| and weighs by h/density, so there is no
splatting, no weight normalisation and no cut at the film's border; its samples are summed in a fixed order
inside the kernel, so equal calls give equal bits. Random numbers belong to (seed, purpose, pixel, batch),
whatever tile or subset the pixel is rendered in. Source: design section 4; Pharr et al., PBRT 4e, 8.8.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from .arrays import download, widened
from .film import PixelFilter
from .random import lane_sampler, resumed, seeding, sequence_seeds
from .rays import Lanes, camera_ray, move_ray, opaque_transform
from .recorded import join, split
from .sobol import sobol_point

if TYPE_CHECKING:
    import mitsuba as mi

    from .view import View


def radiance(view: View, sampler: mi.Sampler, ray: mi.Ray3f, active: mi.Bool | bool = True) -> mi.Color3f:
    """L along a ray, by the view's integrator, C++ (`sample`) or Python (`sample` with its AD arguments)."""
    import mitsuba as mi
    from mitsuba.python.ad.integrators.common import ADIntegrator

    integrator = view.integrator
    active = mi.Bool(active)
    if isinstance(integrator, ADIntegrator):
        result = integrator.sample(
            mode=dr.ADMode.Primal,
            scene=view.scene,
            sampler=sampler,
            ray=ray,
            depth=mi.UInt32(0),
            δL=None,
            δaovs=None,
            state_in=None,
            active=active,
        )
    else:
        result = integrator.sample(view.scene, sampler, ray, view.sensor.get_medium(), active)
    return mi.Color3f(result[0])


def sensed(
    view: View, sampler: mi.Sampler, ray: mi.Ray3f, transform: mi.Transform4f, active: mi.Bool | bool = True
) -> mi.Color3f:
    """What the camera measures along a ray in its own frame: radiance, or the depth of the first surface."""
    import mitsuba as mi

    world_ray = move_ray(ray, transform)
    if view.measured.depth is None:
        return radiance(view, sampler, world_ray, active)
    hit = first_hit(view, world_ray, active)
    return depth_of(hit, world_ray, transform @ mi.Vector3f(0.0, 0.0, 1.0), ray.o.z)


def depth_of(hit: mi.SurfaceInteraction3f, ray: mi.Ray3f, axis: mi.Vector3f, start: mi.Float) -> mi.Color3f:
    """Depth of what a ray in the world hits, 0 of what escapes [scene unit].

    Args:
        axis: the optical one, in the world.
        start: the ray's own depth there [scene unit].
    """
    import mitsuba as mi

    return mi.Color3f(dr.select(hit.is_valid(), start + dr.dot(hit.p - ray.o, axis), 0.0))


def first_hit(view: View, ray: mi.Ray3f, active: mi.Bool | bool = True) -> mi.SurfaceInteraction3f:
    """The first surface that the integrator sees along camera rays in the world."""
    import mitsuba as mi

    active = mi.Bool(active)
    hit = view.scene.ray_intersect_preliminary(ray, coherent=True, reorder=False, active=active)
    if view.integrator.hide_emitters:
        hidden = active & hit.is_valid() & (hit.shape.emitter() != None)  # noqa: E711  # an array
        lamp = hit.compute_surface_interaction(ray, mi.RayFlags.Minimal, hidden)
        hit[hidden] = view.integrator.skip_area_emitters(view.scene, lamp.spawn_ray(ray.d), True, hidden)
    return hit.compute_surface_interaction(ray, mi.RayFlags.All, active)


def kernel_key(view: View) -> tuple[Any, ...] | None:
    """What kernels that call `sensed` depend on beside the scene; None if that is not known."""
    if view.measured.depth is not None:
        return "depth", bool(view.integrator.hide_emitters)
    return known_integrator(view.integrator)


def known_integrator(integrator: mi.Integrator) -> tuple[str, int, int] | None:
    """Class, max_depth and rr_depth of Mitsuba's path tracers, of which that is all; None of others.

    Only what is known to the type is one of them; what a Python integrator calls itself is no matter. Those
    of C++ tell their settings in their description alone.
    """
    from mitsuba.python.ad.integrators.prb import PRBIntegrator

    if integrator.hide_emitters:
        return None
    if type(integrator) is PRBIntegrator:
        return "PRBIntegrator", integrator.max_depth, integrator.rr_depth
    name = str(integrator.class_name())
    settings = [int(number) for number in re.findall(r"_(?:depth|samples) = (\d+)", str(integrator))]
    if name == "PathIntegrator":
        return name, settings[0], settings[1]
    return (name, 2, 2) if name == "DirectIntegrator" and settings == [1, 1] else None


def render_pixels(
    view: View,
    pixels: NDArray[np.int64],
    *,
    spp: int,
    seed: int,
    batches: int = 1,
    pose: NDArray[np.float64] | None = None,
    purpose: int = 0,
    even: bool = False,
) -> NDArray[np.float64]:
    """Estimate I_u at some pixels.

    Args:
        pixels: (n, 2) columns and rows.
        spp: paths per pixel and batch.
        pose: `world_from_camera`; the view's own if None.
        even: film offsets from a pixel's own Sobol' points instead of independent ones: still unbiased; and
            every path in step with its twin of the same seed at another pose.

    Returns:
        (batches, n, 3) float64, linear RGB radiance; of a depth camera three times the depth [scene unit].
    """
    total = start_pixels(
        view, pixels, spp=spp, seed=seed, batches=batches, pose=pose, purpose=purpose, even=even
    )
    return summed(total, spp, batches, len(pixels))


def summed(total: mi.Color3f, spp: int, batches: int, count: int) -> NDArray[np.float64]:
    """(batches, count, 3) the image, of what `start_pixels` returned."""
    values = download(total).reshape(3, batches, -1).transpose(1, 2, 0) / spp
    return values[:, :count]


def start_pixels(
    view: View,
    pixels: NDArray[np.int64],
    *,
    spp: int,
    seed: int,
    batches: int = 1,
    pose: NDArray[np.float64] | None = None,
    purpose: int = 0,
    even: bool = False,
) -> mi.Color3f:
    """As `render_pixels`, but the sum over the paths of each lane (see `Lanes`), traced in the background."""
    import mitsuba as mi

    own, key = split(view.pixel_filter)
    arrays = {
        "lanes": tuple(Lanes.of(view, widened(pixels), batches)),
        "seeds": seeding(seed, purpose),
        "transform": opaque_transform(view.pose if pose is None else pose),
        "spp": dr.opaque(mi.UInt32, spp),
        "filter": own,
        "film": view.film_arrays,
    }

    def body(arrays: dict[str, Any]) -> mi.Color3f:
        lanes = Lanes(*arrays["lanes"])
        return sum_samples(
            view.with_film_arrays(arrays["film"]),
            join(view.pixel_filter, iter(arrays["filter"])),
            lane_sampler(lanes.pixel, lanes.batch, arrays["seeds"]),
            lanes.centre,
            arrays["transform"],
            arrays["spp"],
            even,
        )

    known = kernel_key(view)
    total = view.recorder.ready("pixels", body, view, arrays, known and (known, key, even))()
    return mi.Color3f(total)


@dr.syntax  # type: ignore[untyped-decorator]
def sum_samples(
    view: View,
    pixel_filter: PixelFilter,
    sampler: mi.Sampler,
    centre: mi.Point2f,
    transform: mi.Transform4f,
    spp: mi.UInt32,
    even: bool,
) -> mi.Color3f:
    """Sum of weighted radiance over each lane's samples; equal kernels for all tiles, seeds and poses."""
    import mitsuba as mi

    total = mi.Color3f(0.0)
    i = mi.UInt32(0)
    seeds = [mi.UInt32(0)] * 3
    if dr.hint(even, mode="scalar"):
        seeds = sequence_seeds(sampler, 2)
    state = mi.UInt64(sampler.rng.state)
    while dr.hint(
        i < spp,
        exclude=[view, pixel_filter, sampler, seeds, centre, transform, spp, even],
        label="pixel samples",
    ):
        own = resumed(sampler, state)
        if dr.hint(even, mode="scalar"):
            # Each path has its own start, however many numbers those before it used: where one of two poses'
            # paths misses what the other's hits, the paths after it still agree.
            start = own.rng.next_uint64()
            state = own.rng.state
            own = resumed(sampler, start)
            offset, weight = pixel_filter.sample(mi.Point2f(*sobol_point(i, seeds)))
        else:
            offset, weight = pixel_filter.sample(own.next_2d())
        aperture = own.next_2d()
        ray, importance = camera_ray(view, centre + mi.Vector2f(offset), aperture)
        total += weight * importance * sensed(view, own, ray, transform)
        if dr.hint(not even, mode="scalar"):
            state = own.rng.state
        i += 1
    return total
