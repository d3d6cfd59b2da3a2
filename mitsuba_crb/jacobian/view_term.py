"""The view term: how radiance changes at a fixed surface point because the direction to the camera does.

    ∂L(p, ω)/∂ξ = (∂L/∂a)·(ρ + φ×a),    ω the direction from p to the lens point a

∂L/∂a has no component along ω, so one random tangent direction t (E[t tᵀ] = ½ of the tangent plane) gives it:

    ∂L/∂a = 2 E[ t (L(p, a + δt) − L(p, a)) / δ ],   δ = STEP_PIXELS of image motion at p's distance.

The random sign of t makes the difference a central one. Both sides use the same random numbers; the shifted
ray starts just before p, because occlusion between camera and p is the parallax term's. Diffuse surfaces have
no view term, except within reach of the shading horizon, where a shading normal turns away from the camera
before the surface does and radiance jumps. Depth has another, of rotation, too (`DepthTerm`).

Source: design section 4.1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from ..render.arrays import upload
from ..render.paths import DepthTracer, IntegratorTracer, Numbers, PathTracer, Seen, Tracer
from ..render.scene import contents

if TYPE_CHECKING:
    import mitsuba as mi

    from ..render.view import View

STEP_PIXELS = 0.1
"""Image motion of the step δ where radiance varies with direction [pixel]."""
HORIZON_STEP_PIXELS = 0.25
"""The same where it only jumps at the shading horizon: a longer step meets it more often, and at one pixel
bump maps bias F by 3 %."""
BEFORE = 1e-3
"""Where the shifted ray starts before p, over its distance."""

NONE, HORIZON, LOBES, DIFFERENCE = range(4)
"""What a material needs: nothing, a difference across its shading horizon, the derivative of its lobes (and a
difference across its horizon), a difference everywhere."""


@dataclass(frozen=True)
class ViewTerm:
    """What the surfaces of a scene need."""

    needs: mi.UInt32
    """By the material's index in Dr.Jit's registry."""
    lobes: bool
    """Whether any material needs the derivative of its lobes."""
    jumps: bool
    """Whether any surface needs differences."""
    frames: bool
    """Whether any diffuse material has a shading normal of its own."""
    step: mi.Float
    """δ over the distance of p, where radiance varies with direction [rad]."""
    horizon_step: mi.Float
    """The same at the shading horizon [rad]."""

    @staticmethod
    def of(view: View, tracer: PathTracer | IntegratorTracer) -> ViewTerm | None:
        """What the scene needs; None if its materials are diffuse and its shading normals geometric."""
        import mitsuba as mi

        nodes = contents(view.scene)
        bsdfs = [node for node in nodes if isinstance(node, mi.BSDF)]
        smooth_normals = any(_interpolates_normals(node) for node in nodes if isinstance(node, mi.Shape))
        index = [int(dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(bsdf))[0]) for bsdf in bsdfs]
        # Without the light that arrives, a difference is all there is.
        found = [_need(bsdf, DIFFERENCE if isinstance(tracer, IntegratorTracer) else LOBES) for bsdf in bsdfs]
        lobes = LOBES in found
        jumps = smooth_normals or HORIZON in found or DIFFERENCE in found
        if not lobes and not jumps:
            return None
        needs = np.full(max(index) + 1, DIFFERENCE, dtype=np.uint32)
        needs[index] = found
        pixel = 1.0 / view.camera.focal_length
        return ViewTerm(
            upload(mi.UInt32, needs),
            lobes,
            jumps,
            HORIZON in found,
            dr.opaque(mi.Float, STEP_PIXELS * pixel),
            dr.opaque(mi.Float, HORIZON_STEP_PIXELS * pixel),
        )

    def columns(
        self,
        view: View,
        tracer: PathTracer | IntegratorTracer,
        sampler: mi.Sampler,
        first: Numbers | None,
        ray: mi.Ray3f,
        seen: Seen,
        distance: mi.Float,
        lens: mi.Point3f,
        direction: mi.Vector3f,
        tangent: mi.Vector3f,
        transform: mi.Transform4f,
        weight: mi.Color3f,
    ) -> list[mi.Color3f]:
        """The term of one path in the six twist components.

        Args:
            view, tracer, sampler, first, ray, seen, distance: as for `along`.
            lens, direction: a and the ray's direction, in the camera frame.
            tangent: t, normal to the ray, in the camera frame.
            transform: world from camera.
            weight: of the path, h over the density that it was drawn from.
        """
        across = transform @ tangent
        change = self.along(view, tracer, sampler, first, ray, seen, distance, across) * weight
        turning = dr.cross(lens, tangent)
        return [change * axis for axis in (*tangent, *turning)]

    def along(
        self,
        view: View,
        tracer: PathTracer | IntegratorTracer,
        sampler: mi.Sampler,
        first: Numbers | None,
        ray: mi.Ray3f,
        seen: Seen,
        distance: mi.Float,
        tangent: mi.Vector3f,
    ) -> mi.Color3f:
        """2 ∂L/∂a·t [radiance / scene unit]; zero where nothing is needed.

        Args:
            sampler, first: in the state in which `seen` was traced.
            ray: the camera ray in the world.
            seen: what `tracer` found along it.
            distance: from the lens point to the hit [scene unit].
            tangent: t, normal to the ray, in the world.
        """
        import mitsuba as mi

        hit = seen.hit
        index = dr.reinterpret_array(mi.UInt32, hit.bsdf())
        need = dr.gather(mi.UInt32, self.needs, index, hit.is_valid())
        change = mi.Color3f(0.0)
        if self.lobes:
            turned = _turn_of_lobes(seen, tangent, hit.is_valid() & (need == LOBES))
            change = turned * (2.0 * dr.rcp(distance))
        if self.jumps:
            everywhere = need == DIFFERENCE
            step = dr.select(everywhere, self.step, self.horizon_step)
            direction = dr.normalize(ray.d - step * tangent)
            crosses = dr.dot(hit.sh_frame.n, ray.d) * dr.dot(hit.sh_frame.n, direction) <= 0.0
            needed = hit.is_valid() & (everywhere | crosses)
            if self.frames:
                needed |= _frame_flips(hit, direction, hit.is_valid() & (need == HORIZON))
            start = mi.Point3f(hit.p - direction * (BEFORE * distance))
            shifted = _radiance_where(needed, view, tracer, sampler, first, mi.Ray3f(start, direction))
            change[needed] = (shifted - seen.light) * (2.0 * dr.rcp(step * distance))
        return dr.select(hit.is_valid(), change, 0.0)


@dataclass(frozen=True)
class DepthTerm:
    """How depth changes at a fixed surface point p: ṗ_z = −(ρ + φ×p)_z, in rotation, too."""

    @staticmethod
    def columns(
        _view: View,
        _tracer: DepthTracer,
        _sampler: mi.Sampler,
        _first: Numbers | None,
        _ray: mi.Ray3f,
        seen: Seen,
        distance: mi.Float,
        lens: mi.Point3f,
        direction: mi.Vector3f,
        _tangent: mi.Vector3f,
        _transform: mi.Transform4f,
        weight: mi.Color3f,
    ) -> list[mi.Color3f]:
        """As `ViewTerm.columns` [1, scene unit / rad]."""
        import mitsuba as mi

        point = mi.Vector3f(lens) + direction * distance
        weight = dr.select(seen.hit.is_valid(), weight, 0.0)
        nothing = mi.Color3f(0.0)
        return [nothing, nothing, -weight, -weight * point.y, weight * point.x, nothing]


def view_term(view: View, tracer: Tracer) -> ViewTerm | DepthTerm | None:
    """What a view needs; None if what it measures at a surface point is the same from everywhere."""
    return DepthTerm() if isinstance(tracer, DepthTracer) else ViewTerm.of(view, tracer)


@dr.syntax  # type: ignore[untyped-decorator]  # Dr.Jit is untyped here
def _radiance_where(
    needed: mi.Bool,
    view: View,
    tracer: PathTracer | IntegratorTracer,
    sampler: mi.Sampler,
    first: Numbers | None,
    ray: mi.Ray3f,
) -> mi.Color3f:
    """Radiance where needed; a branch, because most scenes need it nearly nowhere."""
    import mitsuba as mi

    light = mi.Color3f(0.0)
    if dr.hint(needed, exclude=[view, tracer, sampler, first]):
        light = tracer.radiance(view, sampler, ray, first, mi.Bool(True))
    return light


def _turn_of_lobes(seen: Seen, tangent: mi.Vector3f, active: mi.Bool) -> mi.Color3f:
    """Derivative of Σ f(ω, ω_i) E_i as ω turns towards a unit tangent [radiance / rad]."""
    import mitsuba as mi

    si = mi.SurfaceInteraction3f(seen.hit)
    bsdf = si.bsdf()
    total = mi.Color3f(0.0)
    with dr.resume_grad():
        angle = mi.Float(0.0)
        dr.enable_grad(angle)
        si.wi = dr.normalize(si.wi + angle * si.to_local(tangent))
        for direction, light in seen.incident:
            value = bsdf.eval(mi.BSDFContext(), si, direction, active)
            total += value * light
        dr.forward_from(angle)
        turned = mi.Color3f(dr.grad(total))
        # Lobes seen from within 1e-9 of their plane have slopes beyond float32, and no film.
        return dr.select(dr.isfinite(turned), turned, 0.0)


def _frame_flips(hit: mi.SurfaceInteraction3f, direction: mi.Vector3f, active: mi.Bool) -> mi.Bool:
    """Whether a diffuse material's own shading normal (normal, bump map) sees the camera from another side.

    The normal is the material's secret, but f towards fixed directions is constant until the view crosses it.
    """
    import mitsuba as mi

    bsdf = hit.bsdf()
    turned = mi.SurfaceInteraction3f(hit)
    turned.wi = hit.to_local(-direction)
    flips = mi.Bool(False)
    for side in (1.0, -1.0):
        probe = dr.normalize(mi.Vector3f(0.5 * side, 0.3 * side, dr.sign(hit.wi.z)))
        before = bsdf.eval(mi.BSDFContext(), hit, probe, active)
        flips |= dr.any(before != bsdf.eval(mi.BSDFContext(), turned, probe, active))
    return active & flips


def _need(bsdf: mi.BSDF, glossy: int) -> int:
    import mitsuba as mi

    flags = int(bsdf.flags())
    mapped = {"BumpMap", "NormalMap"} & {node.class_name() for node in contents(bsdf)}
    if flags & int(mi.BSDFFlags.Delta | mi.BSDFFlags.Delta1D | mi.BSDFFlags.Null):
        return DIFFERENCE
    if flags & int(mi.BSDFFlags.Glossy):
        return DIFFERENCE if mapped else glossy
    return HORIZON if mapped else NONE


def _interpolates_normals(shape: mi.Shape) -> bool:
    """Whether a mesh's shading normals differ from its faces' (flat shapes carry vertex normals, too)."""
    import mitsuba as mi

    if not shape.is_mesh() or not shape.has_vertex_normals() or shape.has_face_normals():
        return False
    face = dr.arange(mi.UInt32, shape.face_count())
    corners = shape.face_indices(face)
    a, b, c = (shape.vertex_position(corner) for corner in corners)
    normal = dr.normalize(dr.cross(b - a, c - a))
    turned = [dr.abs(dr.dot(shape.vertex_normal(corner), normal)) < 1.0 - 1e-6 for corner in corners]
    return bool(dr.any(turned[0] | turned[1] | turned[2]))
