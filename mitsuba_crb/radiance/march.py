"""Along rays: the image that a field shows, and its derivative in the camera's motion.

    C = Σ_k w_k c_k + T_n bg,   w_k = T_k − T_{k+1},   T_{k+1} = T_k exp(−σ_k Δ_k)

at fixed places t_k = near qᵏ⁺¹ᐟ² along a ray, Δ_k = t_k (√q − 1/√q), measured from the camera: a lattice
that moves with it, so that the image is differentiable in the pose. In the camera's frame, with τ_k the sum
of σ Δ before k,

    dx = ρ + φ × t d,   dd = φ × d
    dC = Σ_k c_k dw_k + w_k dc_k − T_n dτ_n bg,   dw_k = −w_k dτ_k + T_{k+1} Δ_k dσ_k

Cells without anything are skipped, which changes nothing (`occupancy`), and a ray ends where less than
`DARK` of what is behind would come through.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr

from .interpolation import window
from .network import Network, basis, colour, weighted
from .occupancy import Cells
from .scene_space import contracted, pulled

if TYPE_CHECKING:
    import mitsuba as mi

DARK = 1e-5
"""Transmittance at which a ray ends."""


@dataclass(frozen=True, eq=False)
class Matter:
    """What rays march through."""

    network: Network
    cells: Cells
    places: mi.Float
    """(steps,) t_k [scale of the scene]."""
    width: mi.Float
    """Δ_k / t_k."""


@dataclass(frozen=True, eq=False)
class Sample:
    """What is at one place along a ray."""

    z: mi.Vector3f
    step: mi.Float
    """Δ [scale of the scene]."""
    sigma: mi.Float
    colour: mi.Color3f
    dsigma: mi.Vector3f | None
    """∇σ in z."""
    dcolour: list[Any]
    """∇c of each channel in z, and in the direction."""


@dr.syntax  # type: ignore[untyped-decorator]
def next_place(
    matter: Matter, o: mi.Vector3f, d: mi.Vector3f, late: mi.Float, k: mi.UInt32, active: mi.Bool
) -> tuple[mi.UInt32, mi.Bool]:
    """The first place from k on where there is something, and whether there is one."""
    import mitsuba as mi

    count = dr.opaque(mi.UInt32, dr.width(matter.places))
    k = mi.UInt32(k)
    empty = mi.Bool(active) & (k < count)
    found = mi.Bool(False)
    while dr.hint(empty, exclude=[matter, o, d, late, count, active], label="empty cells"):
        t = dr.gather(mi.Float, matter.places, k) * late
        byte, _ = matter.cells.at(contracted(o + t * d))
        found = byte != 0
        k = dr.select(found, k, k + 1)
        empty = ~found & (k < count)
    return k, found & active


def sample(
    matter: Matter, z: mi.Vector3f, step: mi.Float, Y: list[Any], slopes: list[Any] | None = None
) -> Sample:
    """What is at z; with the harmonics' slopes, gradients too."""
    import mitsuba as mi

    u = contracted(z)
    byte, f = matter.cells.at(u)
    inside, edge = window(byte, f)
    outputs, along = matter.network.outputs(u, slopes=slopes is not None)
    full, c = matter.network.density(outputs[0]), colour(outputs, Y)
    if slopes is None:
        return Sample(z, step, inside * full, c, None, [])
    rise = dr.select(matter.network.density_rises(outputs[0]), inside * full, 0.0)
    s = mi.Vector3f(*(tangent[0] for tangent in along))
    dsigma = pulled(z, mi.Vector3f(rise * s + (full * float(matter.cells.count)) * edge))
    dcolour = []
    for channel in range(3):
        steep = c[channel] * (1.0 - c[channel])
        raw = mi.Vector3f(*(weighted(tangent, Y, channel) for tangent in along))
        turned = mi.Vector3f(weighted(outputs, slopes, channel))
        dcolour.append((pulled(z, mi.Vector3f(steep * raw)), mi.Vector3f(steep * turned)))
    return Sample(z, step, inside * full, c, dsigma, dcolour)


@dr.syntax  # type: ignore[untyped-decorator]
def look(
    matter: Matter, o: mi.Vector3f, far: mi.Vector3f, d: mi.Vector3f, background: mi.Color3f, turned: bool
) -> tuple[mi.Color3f, mi.Float, mi.Float]:
    """C, Σ w t and T_n along rays from o; `far` is o + d, from where places are reckoned if `turned`."""
    import mitsuba as mi

    total, distance, through, depth = mi.Color3f(0.0), mi.Float(0.0), mi.Float(1.0), mi.Float(0.0)
    k, active = mi.UInt32(0), mi.Bool(True)
    Y, _ = basis(d)
    while dr.hint(active, exclude=[matter, o, far, d, background, turned, Y], label="places"):
        k, active = next_place(matter, o, d, mi.Float(1.0), k, active)
        t = dr.gather(mi.Float, matter.places, k, active)
        here = sample(matter, place(o, far, d, t, turned), t * matter.width, Y)
        a = dr.select(active, here.sigma * here.step, 0.0)
        behind = transmitted(through, depth, a, turned)
        w = through - behind
        total += w * here.colour
        distance += w * t
        depth += a
        through = behind
        k += 1
        active &= through > DARK
    return total + through * background, distance, through


def transmitted(through: mi.Float, depth: mi.Float, a: mi.Float, turned: bool) -> mi.Float:
    """T behind a place of optical thickness a; turned: of the whole optical depth, which rounds otherwise."""
    return dr.exp(-(depth + a)) if turned else through * dr.exp(-a)


def place(o: mi.Vector3f, far: mi.Vector3f, d: mi.Vector3f, t: mi.Float, turned: bool) -> mi.Vector3f:
    """O + t d; as far + (t − 1) d if turned, which rounds otherwise."""
    import mitsuba as mi

    return mi.Vector3f(dr.fma(d, t - 1.0, far) if turned else dr.fma(d, t, o))


@dr.syntax  # type: ignore[untyped-decorator]
def look_and_differentiate(
    matter: Matter,
    o: mi.Vector3f,
    far: mi.Vector3f,
    d: mi.Vector3f,
    seen: mi.Vector3f,
    camera_from_world: mi.Matrix3f,
    background: mi.Color3f,
    turned: bool,
) -> tuple[mi.Color3f, list[Any]]:
    """C, and of each channel (∂C/∂ρ, ∂C/∂φ).

    Args:
        seen: d in the camera's frame.
    """
    import mitsuba as mi

    total, through, depth = mi.Color3f(0.0), mi.Float(1.0), mi.Float(0.0)
    k, active = mi.UInt32(0), mi.Bool(True)
    Y, slopes = basis(d)
    moved, turning = mi.Vector3f(0.0), mi.Vector3f(0.0)  # dτ by ρ and φ
    by_motion = [mi.Vector3f(0.0), mi.Vector3f(0.0), mi.Vector3f(0.0)]
    by_turn = [mi.Vector3f(0.0), mi.Vector3f(0.0), mi.Vector3f(0.0)]
    while dr.hint(
        active,
        exclude=[matter, o, far, d, seen, camera_from_world, background, turned, Y, slopes],
        label="places with derivatives",
    ):
        k, active = next_place(matter, o, d, mi.Float(1.0), k, active)
        t = dr.gather(mi.Float, matter.places, k, active)
        here = sample(matter, place(o, far, d, t, turned), t * matter.width, Y, slopes)
        a = dr.select(active, here.sigma * here.step, 0.0)
        behind = transmitted(through, depth, a, turned)
        w = through - behind
        total += w * here.colour
        da = dr.select(active, here.step, 0.0) * (camera_from_world @ here.dsigma)
        da_turn = dr.cross(t * seen, da)
        dw = behind * da - w * moved
        dw_turn = behind * da_turn - w * turning
        for channel in range(3):
            across, aside = here.dcolour[channel]
            dc = camera_from_world @ across
            dc_turn = dr.cross(seen, t * dc + camera_from_world @ aside)
            by_motion[channel] += mi.Vector3f(here.colour[channel] * dw + w * dc)
            by_turn[channel] += mi.Vector3f(here.colour[channel] * dw_turn + w * dc_turn)
        moved += mi.Vector3f(da)
        turning += mi.Vector3f(da_turn)
        depth += a
        through = behind
        k += 1
        active &= through > DARK
    columns = [
        (
            by_motion[channel] - (through * background[channel]) * moved,
            by_turn[channel] - (through * background[channel]) * turning,
        )
        for channel in range(3)
    ]
    return total + through * background, columns
