"""The kernel of `flow`: filter and view terms, summed over the antithetic pairs of each lane.

The derivation is in `flow`; here h is a pair half's value of the filter, (gx, gy) its gradient on the tangent
plane, both over the density that the half was drawn from.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr

from ..information.blocks import BLOCK
from ..render.random import EvenNumbers, resumed
from ..render.rays import camera_ray, move_ray
from ..render.sobol import sobol_point
from .pairs import PairSample

if TYPE_CHECKING:
    import mitsuba as mi

    from ..render.film_map import Bend
    from ..render.view import View
    from .flow import Prepared

RIM = 1e-3
"""n·q/|q| of a curved surface below which rounding decides: a tangent hit is exact to its root only."""
EDGE_ON = 1e-12
"""n·q/q_z below which a plane goes through the lens point: far below what float32 directions resolve."""


@dr.syntax  # type: ignore[untyped-decorator]  # Dr.Jit is untyped here
def sum_pairs(
    view: View,
    prepared: Prepared,
    sampler: mi.Sampler,
    even: EvenNumbers,
    centre: mi.Point2f,
    baseline: mi.Color3f,
    plane: tuple[mi.Vector2f, list[mi.Float]] | None,
    counts: list[mi.Float],
    number: mi.UInt32,
    starts: mi.UInt32,
    most: mi.Float,
) -> tuple[list[mi.Color3f], mi.Color3f, mi.Vector4f, mi.Vector3f]:
    """The columns and the image of each lane; equal kernels for all tiles, seeds and poses.

    And Σ w (L − Ī) and Σ w, of which Ī + Σ w (L − Ī) / Σ w is an image to be shown: the image itself is
    unbiased, but few of its weights are so large, and the coarse Ī is so far off, that it has specks. These w
    are no larger than `most`, √n times the mean of n paths': truncated importance sampling (Ionides 2008).

    Depth has a `plane` besides, of `DepthPilot`, on top of its baseline.

    And translation's three columns of the picture L = 1 without baseline, for `closure`.
    """
    import mitsuba as mi

    pairs, transform = prepared.pairs, prepared.transform
    view_term: Any = prepared.view_term
    world_to_camera = transform.inverse()
    slope, known = plane or (None, [])
    columns = [mi.Color3f(0.0) for _ in range(6 + len(prepared.film_flows))]
    image, shown, closing = mi.Color3f(0.0), mi.Vector4f(0.0), mi.Vector3f(0.0)
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
            plane,
            slope,
            known,
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
        weights = divergences(half, ray, lens, valid, curved, distance, normal, prepared.focal, view.bend)
        closing += mi.Vector3f(weights[:3])
        plain = mi.Point2f(-ray.d.x / ray.d.z, -ray.d.y / ray.d.z)
        weights += [flow.divergence(half, film, plain) for flow in prepared.film_flows]
        rest = light - baseline
        if dr.hint(plane is not None, mode="scalar"):
            rest -= dr.dot(slope, mi.Vector2f(half.offset))
            tilted = PairSample(half.offset, slope * half.value, mi.Float(0.0))
            carried = divergences(
                tilted, ray, lens, valid, curved, distance, normal, prepared.focal, view.bend
            )
            carried += [flow.divergence(tilted, film, plain) for flow in prepared.film_flows]
            for k in range(len(carried)):
                columns[k] -= mi.Color3f(carried[k])
            for k in range(6):
                columns[k] -= mi.Color3f(half.value * known[k])
        for k in range(len(weights)):
            columns[k] += rest * weights[k]
        # With the baseline: the weights' own noise, whose mean is 1, would otherwise scale the whole image.
        image += rest * half.value
        bounded = dr.clip(half.value, -most, most)
        shown += bounded * mi.Vector4f(*rest, 1.0)

        if dr.hint(view_term is not None, mode="scalar"):
            tangent = _tangent(ray.d, angle, mirrored)
            changes = view_term.columns(
                view,
                prepared.tracer,
                shifted_sampler,
                (emitter, direction),
                world_ray,
                seen,
                distance,
                lens,
                ray.d,
                tangent,
                transform,
                importance * half.value,
            )
            for k in range(6):
                columns[k] += changes[k]
        i += 1
    if dr.hint(plane is not None, mode="scalar"):
        for k in range(6):
            columns[k] += mi.Color3f(known[k])
    return columns, image + baseline, shown, closing


def _tangent(direction: mi.Vector3f, turn: mi.Float, mirrored: mi.Bool) -> mi.Vector3f:
    """A unit vector normal to the ray; those of a pair's halves are normal to each other."""
    import mitsuba as mi

    sin, cos = dr.sincos(dr.two_pi * (turn + dr.select(mirrored, 0.25, 0.0)))
    return mi.Vector3f(mi.Frame3f(direction).to_world(mi.Vector3f(cos, sin, 0.0)))


def divergences(
    half: PairSample,
    ray: mi.Ray3f,
    lens: mi.Point3f,
    valid: mi.Bool,
    curved: mi.Bool,
    distance: mi.Float,
    normal: mi.Vector3f,
    focal: mi.Vector2f,
    bend: Bend | None = None,
) -> list[mi.Float]:
    """∇·(h f) over the sample's density, for the six twist components.

    Args:
        ray, lens, normal: in the camera frame.
        valid, distance: whether the ray hits, and how far from the lens point [scene unit].
        curved: whether what it hits may be curved, so that its normal is as inexact as the hit.
        focal: d(plain film)/d(tangent plane), so that focal·∇h is the gradient on the tangent plane.
        bend: of a lens that distorts: its D' turns that gradient, and of the divergence on its film there is
            f·∇ ln det D' beside that on the tangent plane, as if h had the gradient h ∇ ln det D' more.
    """
    import mitsuba as mi

    h = half.value
    gx, gy = half.gradient.x * focal.x, half.gradient.y * focal.y
    x, y = ray.d.x / ray.d.z, ray.d.y / ray.d.z
    if bend is not None:
        # Its u has axes right and down, against those of the tangent plane.
        u = mi.Point2f(-x, -y)
        turned, swelling = bend.stretched(u, mi.Vector2f(gx, gy)), bend.swelling(u)
        gx, gy = turned.x - h * swelling.x, turned.y - h * swelling.y
    inverse_depth = dr.select(valid & (distance > 0.0), dr.rcp(ray.d.z * distance), 0.0)
    # n q_z/(n·q); a plane through the lens point has no film area, so its value does not matter.
    slant = dr.dot(normal, ray.d) / ray.d.z
    m = dr.select(dr.abs(slant) > EDGE_ON, normal / slant, 0.0)
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
