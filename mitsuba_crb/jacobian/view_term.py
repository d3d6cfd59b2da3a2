"""The view term: how radiance changes at a fixed surface point because the direction to the camera does.

    ∂L(p, ω)/∂ξ = (∂L/∂a)·(ρ + φ×a),    ω the direction from p to the lens point a

∂L/∂a has no component along ω, so one random tangent direction t (E[t tᵀ] = ½ of the tangent plane) gives it:

    ∂L/∂a = 2 E[ t (L(p, a + δt) − L(p, a)) / δ ],   δ = STEP_PIXELS of image motion at p's distance.

The random sign of t makes the difference a central one. Both sides use the same random numbers; the shifted
ray starts just before p, because occlusion between camera and p is the parallax term's. Diffuse surfaces have
no view term, except within reach of the shading horizon, where a shading normal turns away from the camera
before the surface does and radiance jumps.

Source: design section 4.1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from .pixels import radiance

if TYPE_CHECKING:
    import mitsuba as mi

    from ..scene import View

STEP_PIXELS = 0.1
"""Image motion of the step δ where radiance varies with direction [pixel]."""
HORIZON_STEP_PIXELS = 1.0
"""The same where it only jumps at the shading horizon: a longer step meets it more often."""
BEFORE = 1e-3
"""Where the shifted ray starts before p, over its distance."""

NONE, HORIZON, DIFFERENCE = range(3)
"""What a surface needs: nothing, a difference near its shading horizon, a difference everywhere."""


@dataclass(frozen=True)
class ViewTerm:
    """What the surfaces of a scene need, by material."""

    needs: mi.UInt32
    """By the material's index in Dr.Jit's registry."""
    smooth_normals: bool
    """Whether any surface's shading normals are interpolated between vertices."""
    step: mi.Float
    """δ over the distance of p, where radiance varies with direction [rad]."""
    horizon_step: mi.Float
    """The same at the shading horizon [rad]."""

    @staticmethod
    def of(view: View) -> ViewTerm | None:
        """What the scene needs; None if its materials are diffuse and its shading normals geometric."""
        import mitsuba as mi

        nodes = _contents(view.scene)
        bsdfs = [node for node in nodes if isinstance(node, mi.BSDF)]
        smooth_normals = any(_interpolates_normals(node) for node in nodes if isinstance(node, mi.Shape))
        index = [int(dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(bsdf))[0]) for bsdf in bsdfs]
        found = [_need(bsdf) for bsdf in bsdfs]
        if not smooth_normals and not any(found):
            return None
        needs = np.full(max(index) + 1, DIFFERENCE, dtype=np.uint32)
        needs[index] = found
        pixel = 1.0 / view.focal_pixels
        return ViewTerm(
            mi.UInt32(needs),
            smooth_normals,
            dr.opaque(mi.Float, STEP_PIXELS * pixel),
            dr.opaque(mi.Float, HORIZON_STEP_PIXELS * pixel),
        )

    def difference(
        self,
        view: View,
        sampler: mi.Sampler,
        ray: mi.Ray3f,
        hit: mi.SurfaceInteraction3f,
        distance: mi.Float,
        light: mi.Color3f,
        tangent: mi.Vector3f,
    ) -> mi.Color3f:
        """2 [L(p, a + δt) − L(p, a)]/δ [radiance / scene unit]; zero where nothing is needed.

        Args:
            sampler: in the state in which `light` was traced.
            ray: the camera ray in the world.
            distance: from the lens point to the hit [scene unit].
            light: radiance along `ray`.
            tangent: t, normal to the ray, in the world.
        """
        import mitsuba as mi

        index = dr.reinterpret_array(mi.UInt32, hit.bsdf())
        need = dr.gather(mi.UInt32, self.needs, index, hit.is_valid())
        everywhere = need == DIFFERENCE
        step = dr.select(everywhere, self.step, self.horizon_step)
        at_horizon = need == HORIZON
        if self.smooth_normals:
            turned = dr.abs(dr.dot(hit.sh_frame.n, hit.n)) < 1.0 - 1e-6
            near = dr.abs(dr.dot(hit.sh_frame.n, ray.d)) < 2.0 * step
            at_horizon |= turned & near
        needed = hit.is_valid() & (everywhere | at_horizon)
        direction = dr.normalize(ray.d - step * tangent)
        start = mi.Point3f(hit.p - direction * (BEFORE * distance))
        shifted = radiance(view, sampler, mi.Ray3f(start, direction), needed)
        return dr.select(needed, (shifted - light) * (2.0 * dr.rcp(step * distance)), 0.0)


def _need(bsdf: mi.BSDF) -> int:
    import mitsuba as mi

    smooth = mi.BSDFFlags.Diffuse | mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
    smooth |= mi.BSDFFlags.SpatiallyVarying | mi.BSDFFlags.Anisotropic | mi.BSDFFlags.NonSymmetric
    if int(bsdf.flags()) & ~int(smooth):
        return DIFFERENCE
    names = {node.class_name() for node in _contents(bsdf)}
    return HORIZON if names & {"BumpMap", "NormalMap"} else NONE


def _contents(root: mi.Object) -> list[mi.Object]:
    """A Mitsuba object and all it contains."""
    import mitsuba as mi

    found: dict[int, mi.Object] = {}

    class Collector(mi.TraversalCallback):  # type: ignore[misc]  # Mitsuba is untyped here
        def put(self, _name: str, value: Any, *_flags: Any) -> None:
            if isinstance(value, mi.Object):
                visit(value)

    def visit(node: mi.Object) -> None:
        if node.ptr not in found:
            found[node.ptr] = node
            node.traverse(Collector())

    visit(root)
    return list(found.values())


def _interpolates_normals(shape: mi.Shape) -> bool:
    return bool(shape.is_mesh() and shape.has_vertex_normals() and not shape.has_face_normals())
