"""Camera paths that also tell what they met first: the surface, and the light that arrives there.

    L = L_e(p, ω) + Σ_i f(ω, ω_i) E_i,   i = towards a sampled emitter, along a sampled direction of the BSDF

f includes the cosine, E_i is radiance times multiple importance weight over density. With L in this form the
view term differentiates f alone, and the filter term needs no second intersection for depth and normal.

Russian roulette is `path`'s, but for the probability p to go on. With throughput T (of the first surface on),
what follows adds T²M/p to a path's variance V and p C to its cost C₀, M the second moment of the light there:

    (V + T²M/p) (C₀ + p C)   is least at   p = SPARING T,   SPARING = √(M C₀ / V C).

`path` has 1, for paths that vary as much as the light does. The halves of antithetic pairs share most of
what they vary by, so that V is far less than M.

Source: Mitsuba 3.9, integrators `path` and `prb`; Rath et al. 2022, EARS: Efficiency-Aware Russian Roulette
and Splitting.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import drjit as dr

from .pixels import depth_of, first_hit, known_integrator, radiance

if TYPE_CHECKING:
    import mitsuba as mi

    from .view import View

SPARING = 4.0
"""Probability to survive Russian roulette over throughput; variance times cost is flat from here to 8."""
_LEAST = 2.0**-23
"""Least probability that Russian roulette can have: its random numbers are multiples of this."""
_UNLIKELY = 1e-20
"""Density [1/sr] below which no direction is met, but radiance over it may be beyond float32."""

Numbers: TypeAlias = "tuple[mi.Point2f, mi.Point2f]"
"""Random numbers in [0, 1)² of a surface, for the emitter and for the direction in which the path goes on."""
Tracer: TypeAlias = "PathTracer | IntegratorTracer | DepthTracer"
"""What traces camera paths."""


@dataclass(frozen=True)
class Seen:
    """What camera rays find."""

    hit: mi.SurfaceInteraction3f
    light: mi.Color3f
    """L [radiance], or what else is measured."""
    incident: list[tuple[mi.Vector3f, mi.Color3f]]
    """ω_i in the hit's shading frame and E_i; empty if the integrator does not tell."""


def tracer(view: View) -> Tracer:
    """What traces the view's camera paths."""
    if view.measured.depth is not None:
        return DepthTracer.of(view)
    known = known_integrator(view.integrator)
    return IntegratorTracer() if known is None else PathTracer(*known[1:])


@dataclass(frozen=True)
class IntegratorTracer:
    """Calls the view's integrator, and intersects the first surface beside it."""

    def trace(self, view: View, sampler: mi.Sampler, ray: mi.Ray3f, _first: Numbers | None = None) -> Seen:
        """Radiance along camera rays in the world, and what they hit; integrators draw their own numbers."""
        hit = first_hit(view, ray)
        return Seen(hit, radiance(view, sampler, ray), [])

    def radiance(
        self, view: View, sampler: mi.Sampler, ray: mi.Ray3f, _first: Numbers | None, active: mi.Bool
    ) -> mi.Color3f:
        """As `trace`, from the same random numbers."""
        return radiance(view, sampler, ray, active)


@dataclass(frozen=True)
class White:
    """Everything that is seen is white: rays end at the first surface."""

    def trace(self, view: View, _sampler: mi.Sampler, ray: mi.Ray3f, _first: Numbers | None = None) -> Seen:
        """As the others, of radiance 1."""
        import mitsuba as mi

        return Seen(first_hit(view, ray), mi.Color3f(1.0), [])


@dataclass(frozen=True)
class DepthTracer:
    """What is seen of everything is its depth: rays end at the first surface."""

    axis: mi.Vector3f
    """The optical one, in the world."""
    start: mi.Float
    """Depth at which rays start [scene unit]."""
    hides_emitters: bool
    """Whether the integrator does, through which depth is measured then."""

    @staticmethod
    def of(view: View) -> DepthTracer:
        """Of a view's camera."""
        import mitsuba as mi

        axis = mi.Vector3f(*(dr.opaque(mi.Float, float(x)) for x in view.pose[:3, 2]))
        return DepthTracer(axis, dr.opaque(mi.Float, view.near_clip), bool(view.integrator.hide_emitters))

    def trace(self, view: View, _sampler: mi.Sampler, ray: mi.Ray3f, _first: Numbers | None = None) -> Seen:
        """As the others, with depth for light [scene unit]."""
        hit = first_hit(view, ray)
        return Seen(hit, depth_of(hit, ray, self.axis, self.start), [])


@dataclass(frozen=True)
class PathTracer:
    """Mitsuba's `path`, with Russian roulette for pairs."""

    max_depth: int
    rr_depth: int

    def trace(self, view: View, sampler: mi.Sampler, ray: mi.Ray3f, first: Numbers | None = None) -> Seen:
        """Radiance along camera rays in the world, and what they hit.

        Args:
            first: numbers of the first surface in place of the sampler's.
        """
        import mitsuba as mi

        hit = first_hit(view, ray)
        light, incident = self._trace(view, sampler, ray, hit, first, mi.Bool(True))
        return Seen(hit, light, incident)

    def radiance(
        self, view: View, sampler: mi.Sampler, ray: mi.Ray3f, first: Numbers | None, active: mi.Bool
    ) -> mi.Color3f:
        """As `trace`, from the same random numbers."""
        return self._trace(view, sampler, ray, first_hit(view, ray, active), first, active)[0]

    def _trace(
        self,
        view: View,
        sampler: mi.Sampler,
        ray: mi.Ray3f,
        hit: mi.SurfaceInteraction3f,
        first: Numbers | None,
        active: mi.Bool,
    ) -> tuple[mi.Color3f, list[tuple[mi.Vector3f, mi.Color3f]]]:
        import mitsuba as mi

        light = hit.emitter(view.scene, active).eval(hit, active)
        bounces = active & hit.is_valid() & (self.max_depth > 1)
        vertex = _scatter(view.scene, sampler, hit, ray, bounces, first)
        beyond = self._beyond(view, sampler, hit, vertex, bounces)
        light += vertex.towards_value * vertex.towards_weight + vertex.weight * beyond
        density = dr.select(vertex.density > _UNLIKELY, dr.rcp(vertex.density), 0.0)
        return light, [
            (vertex.towards, vertex.towards_weight),
            (vertex.direction, dr.select(vertex.delta, mi.Color3f(0.0), beyond * density)),
        ]

    @dr.syntax  # type: ignore[untyped-decorator]  # Dr.Jit is untyped here
    def _beyond(
        self,
        view: View,
        sampler: mi.Sampler,
        hit: mi.SurfaceInteraction3f,
        vertex: _Vertex,
        active: mi.Bool,
    ) -> mi.Color3f:
        """Radiance that arrives along the sampled direction, emitters weighted against their own sampling."""
        import mitsuba as mi

        scene = view.scene
        ray = mi.Ray3f(vertex.ray)
        previous = mi.Interaction3f(hit)
        density, delta = mi.Float(vertex.density), mi.Bool(vertex.delta)
        first, eta = mi.Color3f(vertex.weight), mi.Float(vertex.eta)
        light, throughput = mi.Color3f(0.0), mi.Color3f(1.0)
        depth = mi.UInt32(1)
        active = _survives(sampler, throughput, first, eta, depth, self.rr_depth, active)
        preliminary = scene.ray_intersect_preliminary(ray, coherent=False, reorder=False, active=active)
        while dr.hint(active, exclude=[self, view, scene], max_iterations=self.max_depth, label="bounces"):
            si = preliminary.compute_surface_interaction(ray, mi.RayFlags.All)
            towards = mi.DirectionSample3f(scene, si, previous)
            emitter_density = scene.pdf_emitter_direction(previous, towards, ~delta)
            weight = _power_heuristic(density, emitter_density)
            light += throughput * weight * towards.emitter.eval(si, density > 0.0)

            active = (depth + 1 < self.max_depth) & si.is_valid()
            step = _scatter(scene, sampler, si, ray, active)
            light += throughput * step.towards_value * step.towards_weight
            throughput *= step.weight
            eta *= step.eta
            ray = step.ray
            previous = mi.Interaction3f(si)
            density, delta = step.density, step.delta
            depth += 1
            active = _survives(sampler, throughput, first, eta, depth, self.rr_depth, active)
            preliminary = scene.ray_intersect_preliminary(ray, coherent=False, reorder=False, active=active)
        return light


@dataclass(frozen=True)
class _Vertex:
    """Next-event estimation and BSDF sampling at one surface point; directions in its shading frame."""

    towards: mi.Vector3f
    towards_value: mi.Color3f
    """f towards the sampled emitter."""
    towards_weight: mi.Color3f
    """Its radiance times multiple importance weight over density."""
    direction: mi.Vector3f
    weight: mi.Color3f
    """f over density of the sampled direction."""
    density: mi.Float
    delta: mi.Bool
    eta: mi.Float
    ray: mi.Ray3f
    """Along the sampled direction, in the world."""


def _scatter(
    scene: mi.Scene,
    sampler: mi.Sampler,
    si: mi.SurfaceInteraction3f,
    ray: mi.Ray3f,
    active: mi.Bool,
    numbers: Numbers | None = None,
) -> _Vertex:
    import mitsuba as mi

    bsdf = si.bsdf(ray)
    lit = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
    emitter, emitted = scene.sample_emitter_direction(
        si, numbers[0] if numbers else sampler.next_2d(), True, lit
    )
    lit &= emitter.pdf != 0.0
    towards = si.to_local(emitter.d)
    lobe = sampler.next_1d()
    value, density, sample, weight = bsdf.eval_pdf_sample(
        mi.BSDFContext(), si, towards, lobe, numbers[1] if numbers else sampler.next_2d(), active
    )
    heuristic = dr.select(emitter.delta, 1.0, _power_heuristic(emitter.pdf, density))
    lit &= heuristic > 0.0  # radiance over density may be infinite there
    return _Vertex(
        towards,
        value,
        dr.select(lit, emitted * heuristic, 0.0),
        sample.wo,
        # NaN of a blend of one-sided materials, seen from behind, and of what nobody can sample.
        dr.select(active & (sample.pdf > 0.0), weight, 0.0),
        sample.pdf,
        mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta),
        sample.eta,
        si.spawn_ray(si.to_world(sample.wo)),
    )


def _survives(
    sampler: mi.Sampler,
    throughput: mi.Color3f,
    first: mi.Color3f,
    eta: mi.Float,
    depth: mi.UInt32,
    rr_depth: int,
    active: mi.Bool,
) -> mi.Bool:
    """Russian roulette; divides the throughput by the probability."""
    largest = dr.max(throughput * first)
    probability = dr.clip(SPARING * largest * eta * eta, _LEAST, 0.95)
    plays = depth >= rr_depth
    survives = sampler.next_1d() < probability
    throughput[plays] *= dr.rcp(probability)
    return active & (~plays | survives) & (largest != 0.0)


def _power_heuristic(density: mi.Float, other: mi.Float) -> mi.Float:
    """d²/(d² + o²), which may be beyond float32 where this is not; 0 where it has no value."""
    ratio = other / density
    weight = dr.rcp(dr.fma(ratio, ratio, 1.0))
    return dr.select((density > 0.0) & dr.isfinite(weight), weight, 0.0)
