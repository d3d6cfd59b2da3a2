"""The material form of the image's derivative in the pose: follow what the rays hit, not the film.

A surface point p with geometric normal n, seen from the lens point a (camera frame; 0 for a pinhole), has the
film point v = π(q) + const, q = p − a. The twist moves it by ṗ = −ρ − φ×p, that is q̇ = −ρ_a − φ×q with
ρ_a = ρ + φ×a, its image by the flow f = (∂π/∂q) q̇. The film area of a surface element is |n·q|/q_z³ dA and
n·q changes by −n·ρ_a only, hence ∇·f = −(n·ρ_a)/(n·q) − 3 q̇_z/q_z, on the tangent plane as in pixels
(the map between them is affine). Written over material points, I_u = ∫ h(v(ξ)) L (film area) dA, so

    ∂I_u/∂ξ =  ∫ (L − Ī_u) ∇·(h_u f) dv       filter term,  ∇·(h f) = ∇h·f + h ∇·f
             + ∫ h_u (∂L/∂ξ at fixed p) dv      view term
             + parallax term                    at occluding contours (contours.py)

The filter term needs radiance only, not its derivative, so it is exact for edges, textures and shadows of any
kind and for every integrator. Rays that escape see points at infinity, ρ_a = 0. The constant Ī_u (from a
pilot render, the same for all batches) costs no bias: the three terms of L = 1 add up to zero. The pixels of
a block share out their random numbers evenly (`EvenNumbers`), so it is blocks whose errors are independent.
At rims ∇·f grows as 1/√distance: finite mean, no clamping; only where float32 decides how nearly a sphere is
edge-on, its mean there is taken. Participating media and the ellipsoids of radiance
fields have no points to follow: rotation needs none, translation is left to finite differences.

Source: design section 4.1; Zhang et al. 2020, Path-Space Differentiable Rendering, for the material form.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..errors import SensorError
from ..information.fisher import BLOCK
from ..information.subset import selected
from ..render.film import FilmFlow, FilmMap
from ..render.paths import IntegratorTracer, PathTracer, tracer
from ..render.pixels import (
    EVEN,
    PILOT,
    EvenNumbers,
    Lanes,
    camera_ray,
    download,
    lane_sampler,
    move_ray,
    opaque_transform,
    resumed,
    seeding,
    start_pixels,
    upload,
)
from ..render.recorded import join, split
from ..render.sobol import sobol_point
from . import finite_difference
from .contours import Contours, find_contours, parallax_steps
from .pairs import BoxPairs, PairSample, SmoothPairs, filter_pairs
from .view_term import ViewTerm

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    import mitsuba as mi

    from ..render.scene import View

_DIMENSIONS = (4, 4)
"""What `EvenNumbers` are for: film offset and emitter, whose products are what edges of shadows show; and
direction at the first surface and lens point."""
_TRACED = ("pairs", "view_term", "tracer", "transform", "focal", "film_flows")
"""What the kernel reads of `Prepared`."""
RIM = 1e-3
"""n·q/|q| of a curved surface below which rounding decides: a tangent hit is exact to its root only."""
PILOT_SPP = 2
PILOT_CELL = 4
"""The baseline Ī_u comes from this many paths through one pixel of every cell [pixel]: antithetic pairs leave
it so little to do that more would cost more than they save."""


@dataclass(frozen=True)
class Pilot:
    """Ī_u in cells of the film, by paths of their own; a pixel's is the same whoever else is asked for."""

    place: NDArray[np.int32]
    """(rows, columns) of each cell among those that hold pixels."""
    total: mi.Color3f
    """Sums over their paths, traced in the background."""

    @staticmethod
    def of(view: View, mask: NDArray[np.bool_], seed: int) -> Pilot:
        """For the pixels of a mask (H, W)."""
        missing = [(0, -n % PILOT_CELL) for n in mask.shape]
        whole = np.pad(mask, missing) if np.any(missing) else mask
        rows = functools.reduce(np.logical_or, [whole[i::PILOT_CELL] for i in range(PILOT_CELL)])
        held = functools.reduce(np.logical_or, [rows[:, i::PILOT_CELL] for i in range(PILOT_CELL)])
        probed = PILOT_CELL * selected(held)
        place = (np.cumsum(held, dtype=np.int32) - 1).reshape(held.shape)
        return Pilot(place, start_pixels(view, probed, spp=PILOT_SPP, seed=seed, purpose=PILOT))

    @functools.cached_property
    def arrays(self) -> tuple[mi.UInt32, mi.UInt32, mi.Color3f]:
        """What `baseline` reads."""
        import mitsuba as mi

        place = upload(mi.UInt32, self.place.ravel())
        return place, dr.opaque(mi.UInt32, self.place.shape[1]), self.total

    @staticmethod
    def baseline(arrays: tuple[mi.UInt32, mi.UInt32, mi.Color3f], lanes: Lanes) -> mi.Color3f:
        """Ī_u of the lanes of some of the pixels, finite whatever the radiance."""
        import mitsuba as mi

        place, columns, total = arrays
        cell = lanes.row // PILOT_CELL * columns + lanes.column // PILOT_CELL
        image = dr.gather(mi.Color3f, total, dr.gather(mi.UInt32, place, cell)) / PILOT_SPP
        return mi.Color3f(*(dr.select(dr.isfinite(channel), channel, 0.0) for channel in image))

    def values(self, pixels: NDArray[np.int64]) -> NDArray[np.float64]:
        """Ī_u of some of the pixels (n, 3)."""
        column, row = (pixels // PILOT_CELL).T
        return np.asarray(self._image[self.place[row, column]])

    @functools.cached_property
    def _image(self) -> NDArray[np.float64]:
        image = download(self.total).T / PILOT_SPP
        return np.where(np.isfinite(image), image, 0.0)


@dataclass(frozen=True)
class Prepared:
    """What all tiles of one view share."""

    pairs: SmoothPairs | BoxPairs
    view_term: ViewTerm | None
    contours: Contours | finite_difference.Prepared
    """Of the surfaces; or, where the integrator sees volumes, the steps of translation's differences."""
    tracer: PathTracer | IntegratorTracer
    transform: mi.Transform4f
    """World from camera."""
    focal: mi.Vector2f
    """d(film point)/d(q_x/q_z, q_y/q_z), the focal lengths with their signs [pixel]."""
    film_flows: tuple[FilmFlow, ...] = ()
    """Of parameters that act on the film alone; each adds a column after the twist's six."""
    block: int = BLOCK
    """Side of the film blocks whose errors are independent [pixel]."""


def prepare(view: View, film_flows: tuple[FilmFlow, ...] = ()) -> Prepared:
    """Tables of the filter, materials that need a view term, and contours.

    Args:
        film_flows: of parameters that act on the film alone, each for a further column.

    Raises:
        FilmError: the reconstruction filter is not known.
        SensorError: a thin lens among participating media or radiance fields.

    Warns:
        BlindSpotWarning: by name, of shapes whose contours are not known.
    """
    import mitsuba as mi

    camera_paths = tracer(view)
    volumes = _sees_volumes(view, camera_paths)
    if volumes and view.sensor.needs_aperture_sample():
        raise SensorError(
            "a thin lens among participating media or radiance fields shows method 'flow' no surface points "
            "to follow: use method finite_difference, or a perspective sensor"
        )
    # First, because the others wait for what runs in the background.
    contours = finite_difference.prepare(view) if volumes else find_contours(view)
    return Prepared(
        filter_pairs(view.pixel_filter),
        None if volumes else ViewTerm.of(view, camera_paths),
        contours,
        camera_paths,
        opaque_transform(view.pose),
        mi.Vector2f(*(dr.opaque(mi.Float, float(value)) for value in FilmMap.of(view).focal)),
        film_flows,
    )


def _sees_volumes(view: View, camera_paths: PathTracer | IntegratorTracer) -> bool:
    """Whether radiance may come from what is no surface; `path` and its like pass media by."""
    volumes = any(
        shape.is_medium_transition() or shape.class_name() in ("Ellipsoids", "EllipsoidsMesh")
        for shape in view.scene.shapes()
    )
    inside = view.sensor.get_medium() is not None
    return isinstance(camera_paths, IntegratorTracer) and (inside or volumes)


def jacobian(
    view: View,
    pixels: NDArray[np.int64],
    *,
    spp: int,
    seed: int,
    batches: int,
    prepared: Prepared | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """dI/dξ in the camera frame.

    Args:
        pixels: (n, 2) columns and rows; those of one film block must come in one call.
        spp: paths per pixel over all batches. Paths come in pairs, alternately along x and y, and share
            their random numbers out best by powers of two: 4, 8, 16, … per batch. An odd last path of a
            batch is not traced, a batch of one path traces two.
            Where the integrator sees volumes, translation traces six times as many besides.
        prepared: what `prepare` returned for this view, so that many tiles prepare once.

    Returns:
        (batches, n, 3, 6 + m) Jacobians [radiance / scene unit, radiance / rad, and per unit of the m film
        parameters], and each batch's image (batches, n, 3), unbiased.
    """
    prepared = prepare(view) if prepared is None else prepared
    mask = np.zeros(view.size[::-1], dtype=bool)
    mask[pixels[:, 1], pixels[:, 0]] = True
    pilot = Pilot.of(view, mask, seed)
    *_, (values, images, _) = steps(view, pixels, prepared, pilot, spp=spp, seed=seed, batches=batches)
    return values, images


def steps(
    view: View,
    pixels: NDArray[np.int64],
    prepared: Prepared,
    pilot: Pilot,
    *,
    spp: int,
    seed: int,
    batches: int,
) -> Iterator[Any]:
    """As `jacobian`, in four steps; the last one's item is its result, and the image (n, 3) of all batches.

    The first readies paths, the second starts them in the background, the third waits for what runs there,
    the fourth sums up. So one tile can be readied, and the one before summed up, while paths are traced.
    """
    options = {"spp": spp, "seed": seed, "batches": batches}
    start = filter_and_view_terms(view, prepared, pixels, pilot, **options)
    yield
    contours = prepared.contours
    beside: Iterator[Any]
    if isinstance(contours, Contours):
        baseline = pilot.values(pixels) if len(contours.piece) else np.empty((len(pixels), 3))
        beside = parallax_steps(view, contours, pixels, baseline, **options)
    else:
        beside = _differences(view, contours, pixels, **options)
    columns, image, shown = start()
    next(beside)
    yield
    # Shares Dr.Jit's memory, but to look there later would be to wait for the next tile's paths.
    colors = [[np.asarray(channel) for channel in color] for color in (*columns, image)]
    sums = np.array([np.asarray(channel).reshape(batches, -1).mean(axis=0) for channel in shown])
    baseline = pilot.values(pixels)
    next(beside)
    yield
    jacobians, images = as_arrays(colors, batches)
    rows, terms = next(beside)
    if not isinstance(contours, Contours):
        jacobians[..., :3] = 0.0
    jacobians[:, rows, :, : terms.shape[-1]] += terms
    # A few weights of a filter with negative lobes may add up to nothing: then the pilot is what is left.
    yield jacobians, images, baseline + (sums[:3] / np.maximum(sums[3], 0.5)).T


def _differences(
    view: View,
    prepared: finite_difference.Prepared,
    pixels: NDArray[np.int64],
    *,
    spp: int,
    seed: int,
    batches: int,
) -> Iterator[Any]:
    """Translation's columns by finite differences, in the steps of `parallax_steps`."""
    columns = [
        finite_difference.column(view, pixels, axis, step, spp=spp, seed=seed, batches=batches)[0]
        for axis, step in enumerate(prepared.steps[:3])
    ]
    yield
    yield
    yield np.arange(len(pixels)), np.stack(columns, axis=-1)


def filter_and_view_terms(
    view: View,
    prepared: Prepared,
    pixels: NDArray[np.int64],
    pilot: Pilot,
    *,
    spp: int,
    seed: int,
    batches: int,
) -> Callable[[], tuple[list[mi.Color3f], mi.Color3f, mi.Vector4f]]:
    """What starts the paths of some pixels in the background, without the contours' part.

    Returns:
        A function that gives the columns, the image, and what `_sum_pairs` makes to be shown, of each lane.
    """
    import mitsuba as mi

    pairs = prepared.pairs
    number = max(1, spp // batches // 2)
    # Fewer pairs than kinds: which kinds, a random number decides, and the expected counts are the weights.
    few = number < pairs.kinds
    counts = [
        number / pairs.kinds if few else (number - kind - 1) // pairs.kinds + 1 for kind in range(pairs.kinds)
    ]
    parts = [getattr(prepared, name) for name in _TRACED]
    own, key = split(parts)
    arrays = {
        "lanes": tuple(Lanes.of(view, pixels, batches)),
        "seeds": [seeding(seed), seeding(seed, EVEN)],
        "pilot": pilot.arrays,
        "counts": [dr.opaque(mi.Float, count) for count in counts],
        "number": dr.opaque(mi.UInt32, number),
        "starts": dr.opaque(mi.UInt32, pairs.kinds if few else 1),
        "most": dr.opaque(mi.Float, np.sqrt(2 * number * batches) / (2 * number)),
        "parts": own,
    }

    def body(arrays: dict[str, Any]) -> tuple[list[mi.Color3f], mi.Color3f, mi.Vector4f]:
        lanes = Lanes(*arrays["lanes"])
        seeds, even_seeds = arrays["seeds"]
        given = dict(zip(_TRACED, join(parts, iter(arrays["parts"])), strict=True))
        columns, image, shown = _sum_pairs(
            view,
            replace(prepared, **given),
            lane_sampler(lanes.pixel, lanes.batch, seeds),
            EvenNumbers.of(lanes, even_seeds, _DIMENSIONS),
            lanes.centre,
            pilot.baseline(arrays["pilot"], lanes),
            arrays["counts"],
            arrays["number"],
            arrays["starts"],
            arrays["most"],
        )
        return columns, image, shown

    own_integrator = isinstance(prepared.tracer, IntegratorTracer)
    return view.recorder.ready("pairs", body, view, arrays, None if own_integrator else key)


def as_arrays(colors: Any, batches: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What `jacobian` returns, of the columns and, last, the image; the pixels' numbers beside each other."""
    values = np.empty((len(colors), 3, batches, len(colors[0][0]) // batches))
    for row, color in zip(values, colors, strict=True):
        for own, channel in zip(row, color, strict=True):
            own[...] = np.asarray(channel).reshape(own.shape)
    return values[:-1].transpose(2, 3, 1, 0), values[-1].transpose(1, 2, 0)


@dr.syntax  # type: ignore[untyped-decorator]  # Dr.Jit is untyped here
def _sum_pairs(
    view: View,
    prepared: Prepared,
    sampler: mi.Sampler,
    even: EvenNumbers,
    centre: mi.Point2f,
    baseline: mi.Color3f,
    counts: list[mi.Float],
    number: mi.UInt32,
    starts: mi.UInt32,
    most: mi.Float,
) -> tuple[list[mi.Color3f], mi.Color3f, mi.Vector4f]:
    """The columns and the image of each lane; equal kernels for all tiles, seeds and poses.

    And Σ w (L − Ī) and Σ w, of which Ī + Σ w (L − Ī) / Σ w is an image to be shown: the image itself is
    unbiased, but few of its weights are so large, and the coarse Ī is so far off, that it has specks. These w
    are no larger than `most`, √n times the mean of n paths': truncated importance sampling (Ionides 2008).
    """
    import mitsuba as mi

    pairs, transform = prepared.pairs, prepared.transform
    view_term: Any = prepared.view_term
    world_to_camera = transform.inverse()
    columns = [mi.Color3f(0.0) for _ in range(6 + len(prepared.film_flows))]
    image, shown = mi.Color3f(0.0), mi.Vector4f(0.0)
    turns = (number + (pairs.kinds - 1)) // pairs.kinds
    start = mi.UInt32(sampler.next_1d() * mi.Float(starts))
    state = mi.UInt64(sampler.rng.state)
    pair_state = mi.UInt64(state)
    drawn = (mi.Point2f(0.0), mi.Vector2f(0.0), mi.Float(0.0))
    aperture, emitter, direction = (mi.Point2f(0.0) for _ in range(3))
    i = mi.UInt32(0)
    while dr.hint(
        i < 2 * number,
        exclude=[
            view,
            prepared,
            pairs,
            view_term,
            counts,
            even,
            sampler,
            centre,
            baseline,
            number,
            start,
            most,
            turns,
            transform,
            world_to_camera,
        ],
        label="antithetic pairs",
    ):
        # Both halves of a pair trace their paths with the same random numbers.
        mirrored = (i & 1) == 1
        pair_state = dr.select(mirrored, pair_state, state)
        path_sampler = resumed(sampler, pair_state)

        index = (i >> 1) + start
        turn, kind = index // pairs.kinds, index % pairs.kinds
        if dr.hint(mirrored, exclude=[pairs, counts, even, turns]):
            drawn = tuple(PairSample(*drawn).mirrored(kind))
        else:
            # A pixel's points of a kind, of which a column is made, follow one another, then its neighbour's.
            place = (kind * (BLOCK * BLOCK) + even.rank) * turns + turn
            at_film = sobol_point(place, even.seeds[0])
            # Neighbours' paths, traced together, then go on in the same quarter of directions.
            on_path = sobol_point(place, even.seeds[1], quarters=(turns & 3) == 0)
            drawn = tuple(pairs.draw(kind, mi.Point2f(*at_film[:2]), counts))
            emitter = mi.Point2f(*at_film[2:])
            direction, aperture = mi.Point2f(*on_path[:2]), mi.Point2f(*on_path[2:])
        half = PairSample(*drawn)
        film = centre + mi.Vector2f(half.offset)
        ray, importance = camera_ray(view, film, aperture)
        world_ray = move_ray(ray, transform)
        if dr.hint(view_term is not None, mode="scalar"):
            angle = path_sampler.next_1d()
            shifted_sampler = path_sampler.clone()
        seen = prepared.tracer.trace(view, path_sampler, world_ray, (emitter, direction))
        state = mi.UInt64(path_sampler.rng.state)
        light = importance * seen.light

        to_lens = ray.o.z / ray.d.z
        lens = mi.Point3f(ray.o - to_lens * ray.d)
        # Not hit.t: where the integrator skips emitters it counts from the last one.
        distance = to_lens + dr.dot(seen.hit.p - world_ray.o, world_ray.d)
        normal = world_to_camera @ mi.Vector3f(seen.hit.n)
        valid = seen.hit.is_valid()
        curved = valid & ~seen.hit.shape.is_mesh()
        weights = _divergences(half, ray, lens, valid, curved, distance, normal, prepared.focal)
        weights += [_film_divergence(half, film, flow) for flow in prepared.film_flows]
        for k in range(len(weights)):
            columns[k] += (light - baseline) * weights[k]
        # With the baseline: the weights' own noise, whose mean is 1, would otherwise scale the whole image.
        image += (light - baseline) * half.value
        bounded = dr.clip(half.value, -most, most)
        shown += bounded * mi.Vector4f(*(light - baseline), 1.0)

        if dr.hint(view_term is not None, mode="scalar"):
            tangent = _tangent(ray.d, angle, mirrored)
            change = view_term.along(
                view,
                prepared.tracer,
                shifted_sampler,
                (emitter, direction),
                world_ray,
                seen,
                distance,
                transform @ tangent,
            )
            change *= importance * half.value
            turning = dr.cross(lens, tangent)
            for k in range(3):
                columns[k] += change * tangent[k]
                columns[k + 3] += change * turning[k]
        i += 1
    return columns, image + baseline, shown


def _tangent(direction: mi.Vector3f, turn: mi.Float, mirrored: mi.Bool) -> mi.Vector3f:
    """A unit vector normal to the ray; those of a pair's halves are normal to each other."""
    import mitsuba as mi

    sin, cos = dr.sincos(dr.two_pi * (turn + dr.select(mirrored, 0.25, 0.0)))
    return mi.Vector3f(mi.Frame3f(direction).to_world(mi.Vector3f(cos, sin, 0.0)))


def _film_divergence(half: PairSample, film: mi.Point2f, flow: FilmFlow) -> mi.Float:
    """∇·(h w) over the sample's density."""
    x, y = flow.scale * film.x + flow.offset.x, flow.scale * film.y + flow.offset.y
    return half.gradient.x * x + half.gradient.y * y + 2.0 * flow.scale * half.value


def _divergences(
    half: PairSample,
    ray: mi.Ray3f,
    lens: mi.Point3f,
    valid: mi.Bool,
    curved: mi.Bool,
    distance: mi.Float,
    normal: mi.Vector3f,
    focal: mi.Vector2f,
) -> list[mi.Float]:
    """∇·(h f) over the sample's density, for the six twist components.

    Args:
        ray, lens, normal: in the camera frame.
        valid, distance: whether the ray hits, and how far from the lens point [scene unit].
        curved: whether what it hits may be curved, so that its normal is as inexact as the hit.
        focal: d(film)/d(tangent plane), so that focal·∇h is the gradient on the tangent plane.
    """
    h = half.value
    gx, gy = half.gradient.x * focal.x, half.gradient.y * focal.y
    x, y = ray.d.x / ray.d.z, ray.d.y / ray.d.z
    inverse_depth = dr.select(valid, dr.rcp(ray.d.z * distance), 0.0)
    # n q_z/(n·q); a plane through the lens point has no film area, so its value does not matter.
    slant = dr.dot(normal, ray.d) / ray.d.z
    m = dr.select(dr.abs(slant) > 0.0, normal / slant, 0.0)
    # Film distance from a rim grows as slant²: below RIM the mean of 1/slant is 2/RIM.
    m = dr.select(curved & (dr.abs(slant) < RIM), normal * dr.mulsign(2.0 / RIM, slant), m)
    rho = [
        -inverse_depth * (gx + h * m.x),
        -inverse_depth * (gy + h * m.y),
        inverse_depth * (gx * x + gy * y + h * (3.0 - m.z)),
    ]
    phi = [
        gx * x * y + gy * (1.0 + y * y) + 3.0 * h * y,
        -gx * (1.0 + x * x) - gy * x * y - 3.0 * h * x,
        gx * y - gy * x,
    ]
    # ρ_a = ρ + φ×a: rotating about the camera's origin also shifts the lens point.
    return [
        *rho,
        phi[0] + lens.y * rho[2],
        phi[1] - lens.x * rho[2],
        phi[2] - lens.y * rho[0] + lens.x * rho[1],
    ]
