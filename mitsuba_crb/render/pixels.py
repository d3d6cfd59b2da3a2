"""The measurement: what each pixel's filter integrates, sampled one lane per pixel and batch.

    I_u = ∫ h(v − c_u) L(v) dv,   h normalised to ∫h = 1,   L = radiance along the camera ray of film point v.

Each pixel draws its own offsets v − c_u from a density close to |h| and weighs by h/density, so there is no
splatting, no weight normalisation and no cut at the film's border; its samples are summed in a fixed order
inside the kernel, so equal calls give equal bits. Random numbers belong to (seed, purpose, pixel, batch),
whatever tile or subset the pixel is rendered in. Source: design section 4; Pharr et al., PBRT 4e, 8.8.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..information.fisher import BLOCK
from .recorded import join, split
from .sobol import sobol_point

if TYPE_CHECKING:
    import mitsuba as mi

    from .scene import View

PILOT, EVEN = 0x50494C4F, 0x4556454E
"""Purposes of the random numbers of pilot renders, and of what a block's pixels share; Jacobians use 0, but
for lanes that are told apart by something else than the batch."""


@functools.cache
def _sampler_class() -> Any:
    """The sampler that gives every lane its own stream; made late, because `mi` needs a variant."""
    import mitsuba as mi

    class PixelSampler(mi.Sampler):  # type: ignore[misc]  # Mitsuba is untyped here
        """Independent random numbers from one PCG32 stream per lane."""

        def __init__(self, rng: mi.PCG32) -> None:
            super().__init__(mi.Properties())
            self.rng = rng

        def next_1d(self, active: mi.Bool = True) -> mi.Float:
            return self.rng.next_float32()

        def next_2d(self, active: mi.Bool = True) -> mi.Point2f:
            x = self.rng.next_float32()
            return mi.Point2f(x, self.rng.next_float32())

        def clone(self) -> PixelSampler:
            return PixelSampler(mi.PCG32(self.rng))

    return PixelSampler


def upload(kind: Any, values: NDArray[Any]) -> Any:
    """An array as kernel input of type `kind` (mi.Float, mi.UInt32), in aligned memory.

    Dr.Jit shares NumPy's memory, and compiles one kernel for aligned and another for unaligned inputs.
    NumPy's alignment is a matter of chance, so that kernels would be compiled again at random.
    """
    import mitsuba as mi

    dtype = np.float32 if kind is mi.Float else np.uint32
    memory = np.empty(4 * values.size + 64, dtype=np.uint8)
    start = -memory.ctypes.data % 64
    aligned = memory[start : start + 4 * values.size].view(dtype)
    aligned[:] = values
    return kind(aligned)


def widened(rows: NDArray[Any]) -> NDArray[Any]:
    """Rows (n, …) of n lanes, a lone one twice: Dr.Jit makes one entry a scalar, in a new kernel."""
    return np.repeat(rows, 2, axis=0) if len(rows) == 1 else rows


def download(value: Any) -> NDArray[np.float64]:
    """A Dr.Jit array of d components as (d, n) float64.

    Evaluated first, and by component: NumPy's conversion of the whole compiles its width into the kernel.
    """
    dr.eval(value)
    return np.array([np.array(component) for component in value], dtype=np.float64)


def seeding(seed: int, purpose: int = 0) -> tuple[mi.UInt32, mi.UInt32]:
    """A seed and what the random numbers are for, as kernel input."""
    import mitsuba as mi

    key = dr.opaque(mi.UInt32, (seed ^ purpose) & 0xFFFFFFFF)
    return key, dr.opaque(mi.UInt32, (purpose + 0x9E3779B9 * ((seed >> 32) + 1)) & 0xFFFFFFFF)


def lane_sampler(pixel: mi.UInt32, batch: mi.UInt32, seeds: tuple[mi.UInt32, mi.UInt32]) -> mi.Sampler:
    """A sampler whose lane streams depend on (pixel, batch, seed, purpose) and on nothing else.

    Args:
        pixel: index of the lane's pixel in the whole image.
        batch: the lane's batch; a purpose under which it means something else must not be used for batches.
        seeds: seed and purpose, from `seeding`.
    """
    import mitsuba as mi

    key, salt = seeds
    state = mi.sample_tea_64(pixel, key)
    stream = mi.sample_tea_64(batch ^ salt, pixel)
    return _sampler_class()(mi.PCG32(1, state, stream))


def resumed(sampler: mi.Sampler, state: mi.UInt64) -> mi.Sampler:
    """A sampler from `lane_sampler` elsewhere in its streams.

    Loops carry the state alone: whatever they carry and leave unchanged makes Dr.Jit trace them twice.
    """
    import mitsuba as mi

    rng = mi.PCG32(sampler.rng)
    rng.state = mi.UInt64(state)
    return type(sampler)(rng)


@dataclass(frozen=True)
class EvenNumbers:
    """Random points of [0, 1)^d that the pixels of a film block share out evenly among them, batch by batch.

    The pixels' errors then cancel in the block's information, and first of all those of neighbours, whose
    points follow one another in the sequence: they stand in z-order (Ahmed and Wonka 2020). Every block and
    batch has seeds of its own, so that batches are independent.
    """

    rank: mi.UInt32
    """Of the lane's pixel in its block."""
    seeds: list[list[mi.UInt32]]
    """Of the sequence of each use."""

    @staticmethod
    def of(lanes: Lanes, seeds: tuple[mi.UInt32, mi.UInt32], dimensions: Sequence[int]) -> EvenNumbers:
        """For independent uses of so many coordinates each; `seeds` are for the purpose `EVEN`."""
        columns = (lanes.width + (BLOCK - 1)) // BLOCK
        block = lanes.row // BLOCK * columns + lanes.column // BLOCK
        sampler = lane_sampler(block, lanes.batch, seeds)
        x, y = lanes.column % BLOCK, lanes.row % BLOCK
        rank = x & 0
        for bit in range((BLOCK - 1).bit_length()):
            rank |= (x >> bit & 1) << 2 * bit | (y >> bit & 1) << 2 * bit + 1
        return EvenNumbers(rank, [_sequence_seeds(sampler, d) for d in dimensions])


def _sequence_seeds(sampler: mi.Sampler, dimensions: int) -> list[mi.UInt32]:
    return [sampler.rng.next_uint32() for _ in range(1 + dimensions)]


@dataclass(frozen=True)
class OffsetTable:
    """Draws x from a tabulated density on [−radius, radius] by its inverse distribution function."""

    nodes: mi.Float
    """Quantiles x_0 < … < x_N at u = 0, 1/N, …, 1 [pixel]."""
    count: int
    """N."""

    @staticmethod
    def of(density: NDArray[np.float64], radius: float, count: int = 1024) -> OffsetTable:
        """From samples of an unnormalised non-negative density on a uniform grid over [−radius, radius]."""
        import mitsuba as mi

        grid = np.linspace(-radius, radius, density.size)
        # A floor keeps the density positive wherever the filter is, so that h/density stays bounded.
        density = np.maximum(density, 1e-3 * density.max())
        mass = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]))])
        nodes = np.interp(np.linspace(0.0, 1.0, count + 1), mass / mass[-1], grid)
        return OffsetTable(upload(mi.Float, nodes), count)

    def sample(self, u: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Offset x [pixel] and its density [1/pixel]."""
        import mitsuba as mi

        scaled = u * self.count
        cell = dr.minimum(mi.UInt32(scaled), self.count - 1)
        low = dr.gather(mi.Float, self.nodes, cell)
        width = dr.gather(mi.Float, self.nodes, cell + 1) - low
        return dr.fma(scaled - mi.Float(cell), width, low), dr.rcp(width * self.count)


@dataclass(frozen=True)
class PixelFilter:
    """The film's separable reconstruction filter h(x) h(y), normalised, and how to draw from |h|."""

    rfilter: mi.ReconstructionFilter
    radius: float
    """Half width [pixel]."""
    norm: float
    """∫ of Mitsuba's unnormalised one-dimensional filter."""
    table: OffsetTable
    values: NDArray[np.float64]
    """h in the middle of even cells of [−radius, radius] [1/pixel]."""

    @staticmethod
    def of(rfilter: mi.ReconstructionFilter) -> PixelFilter:
        """For one filter."""
        import mitsuba as mi

        radius = float(rfilter.radius())
        # Midpoints: a filter's value exactly on its border (box) is a matter of convention.
        edges = np.linspace(-radius, radius, 8193)
        middle = 0.5 * (edges[1:] + edges[:-1])
        values = np.array(rfilter.eval(upload(mi.Float, middle)), dtype=np.float64)
        norm = float(values.sum() * (edges[1] - edges[0]))
        density = np.abs(np.interp(edges, middle, values))
        return PixelFilter(rfilter, radius, norm, OffsetTable.of(density, radius), values / norm)

    def eval(self, x: mi.Float) -> mi.Float:
        """h(x) [1/pixel] in one dimension."""
        return self.rfilter.eval(x) / self.norm

    def interpolate(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """h(x) [1/pixel] in one dimension, to what float32 leaves of it (3e-5); zero beyond the radius."""
        place = (x / self.radius + 1.0) * (0.5 * len(self.values)) - 0.5
        cell = np.clip(place.astype(np.int64), 0, len(self.values) - 2)
        low = self.values[cell]
        h = low + (place - cell) * (self.values[cell + 1] - low)
        return np.where(np.abs(x) <= self.radius, h, 0.0)

    def sample(self, u: mi.Point2f) -> tuple[mi.Point2f, mi.Float]:
        """Offset from the pixel's centre [pixel] and its weight h/density, of mean one."""
        import mitsuba as mi

        x, density_x = self.table.sample(u.x)
        y, density_y = self.table.sample(u.y)
        return mi.Point2f(x, y), self.eval(x) * self.eval(y) / (density_x * density_y)


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


def camera_ray(view: View, film: mi.Point2f, aperture: mi.Point2f) -> tuple[mi.Ray3f, mi.Color3f]:
    """Ray in the camera frame through a film point [pixel], and the sensor's weight."""
    import mitsuba as mi

    width, height = view.size
    position = mi.Point2f(film.x / width, film.y / height)
    ray, weight = view.sensor.sample_ray(0.0, 0.5, position, aperture)
    return ray, mi.Color3f(weight)


def move_ray(ray: mi.Ray3f, transform: mi.Transform4f) -> mi.Ray3f:
    """The ray in the world, its interval kept."""
    import mitsuba as mi

    # Point3f + Vector3f may come back as a vector, whose translation a transform would drop.
    return mi.Ray3f(
        transform @ mi.Point3f(ray.o), transform @ mi.Vector3f(ray.d), ray.maxt, ray.time, ray.wavelengths
    )


def opaque_transform(matrix: NDArray[np.float64]) -> mi.Transform4f:
    """A 4x4 rigid motion as kernel input, so that a new pose needs no new kernel."""
    import mitsuba as mi

    transform = mi.Transform4f(mi.Matrix4f(matrix.astype(np.float32)))
    dr.make_opaque(transform)
    return transform


class Lanes(NamedTuple):
    """The lanes of some pixels and batches; the pixel runs fastest."""

    pixel: mi.UInt32
    """Index in the whole image."""
    batch: mi.UInt32
    width: mi.UInt32
    """Of the image [pixel]."""

    @staticmethod
    def of(view: View, pixels: NDArray[np.int64], batches: int) -> Lanes:
        """Of pixels (n, 2), columns and rows."""
        import mitsuba as mi

        index = pixels[:, 1] * view.size[0] + pixels[:, 0]
        return Lanes(
            upload(mi.UInt32, np.tile(index, batches)),
            upload(mi.UInt32, np.repeat(np.arange(batches), len(pixels))),
            dr.opaque(mi.UInt32, view.size[0]),
        )

    @property
    def row(self) -> mi.UInt32:
        """Of the pixel."""
        return self.pixel // self.width

    @property
    def column(self) -> mi.UInt32:
        """Of the pixel."""
        return self.pixel - self.row * self.width

    @property
    def centre(self) -> mi.Point2f:
        """Of the pixel [pixel]."""
        import mitsuba as mi

        return mi.Point2f(mi.Float(self.column) + 0.5, mi.Float(self.row) + 0.5)


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
        even: film offsets from a pixel's own Sobol' points instead of independent ones: still unbiased.

    Returns:
        (batches, n, 3) float64, linear RGB radiance.
    """
    total = start_pixels(
        view, pixels, spp=spp, seed=seed, batches=batches, pose=pose, purpose=purpose, even=even
    )
    values = download(total).reshape(3, batches, -1).transpose(1, 2, 0) / spp
    return values[:, : len(pixels)]


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
    }

    def body(arrays: dict[str, Any]) -> mi.Color3f:
        lanes = Lanes(*arrays["lanes"])
        return sum_samples(
            view,
            join(view.pixel_filter, iter(arrays["filter"])),
            lane_sampler(lanes.pixel, lanes.batch, arrays["seeds"]),
            lanes.centre,
            arrays["transform"],
            arrays["spp"],
            even,
        )

    known = known_integrator(view.integrator)
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
        seeds = _sequence_seeds(sampler, 2)
    state = mi.UInt64(sampler.rng.state)
    while dr.hint(
        i < spp,
        exclude=[view, pixel_filter, sampler, seeds, centre, transform, spp, even],
        label="pixel samples",
    ):
        own = resumed(sampler, state)
        if dr.hint(even, mode="scalar"):
            offset, weight = pixel_filter.sample(mi.Point2f(*sobol_point(i, seeds)))
        else:
            offset, weight = pixel_filter.sample(own.next_2d())
        aperture = own.next_2d()
        ray, importance = camera_ray(view, centre + mi.Vector2f(offset), aperture)
        total += weight * importance * radiance(view, own, move_ray(ray, transform))
        state = own.rng.state
        i += 1
    return total


def coarse_grid(size: tuple[int, int], most: int) -> NDArray[np.int64]:
    """At most `most` x `most` pixels, evenly over a width x height image: (rows, columns, 2)."""
    columns, rows = (np.unique(np.linspace(0, n - 1, min(n, most)).astype(np.int64)) for n in size)
    return np.stack(np.meshgrid(columns, rows), axis=-1)


def first_hits(view: View, pixels: NDArray[np.int64]) -> tuple[mi.SurfaceInteraction3f, NDArray[np.float64]]:
    """First surface through each pixel's centre, and its depth along the optical axis [scene unit]."""
    import mitsuba as mi

    ray, _ = camera_ray(view, Lanes.of(view, pixels, 1).centre, mi.Point2f(0.5, 0.5))
    hit = view.scene.ray_intersect(move_ray(ray, opaque_transform(view.pose)))
    depth = dr.select(hit.is_valid(), ray.o.z + hit.t * ray.d.z, dr.inf)
    return hit, np.array(depth, dtype=np.float64)
