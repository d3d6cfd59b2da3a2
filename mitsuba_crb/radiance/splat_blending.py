"""Splats laid over one another in a pixel, nearest first, and what a camera's motion does to the sum.

With d = m − v from the pixel's centre v, α = o exp(−½ |U d|²), at most 0.99, T = Π (1 − α) of what is nearer:

    C = Σ T α c + T_end background        dα = α (−w·dm + ½ wᵀ dΣ w + d ln o),  w = Σ'⁻¹ d
    s = Σ dα / (1 − α),  dT = −T s        dC = Σ T (c (dα − α s) + α dc) − T_end s background

(dα = 0 where α is held). That is order 0. Order 1 goes from the farthest to the nearest, with C what lies
behind: C ← C + α (c − C), dC ← (1 − α) dC + dα (c − C) + α dc. They differ by rounding.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import drjit as dr

from .splat_motion import swelling
from .splat_projection import DILATION, Lens, Records

if TYPE_CHECKING:
    import mitsuba as mi

HELD = 0.99
"""The most that a splat covers."""
_OPAQUE = 1e-8
"""What is covered but for so much hides the rest: below float32's rounding."""


@dataclass(frozen=True, eq=False)
class Drawing:
    """What a kernel blends."""

    records: Records
    members: mi.UInt32
    lens: Lens
    variant: str
    background: mi.Color3f


class _Laid(NamedTuple):
    """One splat in a pixel."""

    alpha: mi.Float
    colour: mi.Color3f
    z: mi.Float
    splat: mi.UInt32
    """Its place among the records."""
    movable: mi.Float
    """α, or 0 where it is held."""
    d: mi.Vector2f
    w: mi.Vector2f
    m: mi.Vector2f
    N: mi.Vector2f


def _laid(drawing: Drawing, place: mi.UInt32, film: mi.Vector2f) -> _Laid:
    import mitsuba as mi

    splat = dr.gather(mi.UInt32, drawing.members, place)
    mx, my, a, b = dr.gather(mi.Vector4f, drawing.records.film, splat)
    d, opacity, z, nx = dr.gather(mi.Vector4f, drawing.records.shape, splat)
    red, green, blue, ny = dr.gather(mi.Vector4f, drawing.records.colour, splat)
    away = mi.Vector2f(mx, my) - film
    ux, uy = dr.fma(a, away.x, b * away.y), d * away.y
    alpha = opacity * dr.exp(-0.5 * dr.fma(ux, ux, uy * uy))
    return _Laid(
        dr.minimum(alpha, HELD),
        mi.Color3f(red, green, blue),
        z,
        splat,
        dr.select(alpha > HELD, 0.0, alpha),
        away,
        mi.Vector2f(a * ux, dr.fma(b, ux, d * uy)),
        mi.Vector2f(mx, my),
        mi.Vector2f(nx, ny),
    )


def _motion(drawing: Drawing, lens: Sequence[mi.Vector2f], one: _Laid) -> tuple[list[Any], list[Any]]:
    """dα/dξ, and by twist component dc/dξ; none of those where no colour depends on direction."""
    import mitsuba as mi

    k, low, high = lens
    direction = one.m / k
    held = dr.clip(direction, low, high)
    spread = one.d - DILATION[drawing.variant] * one.w
    n = dr.dot(one.w, one.N)
    slope = [*swelling(direction, held, one.z, k, one.w, n, spread, -k * one.w)]
    six = [*slope[0], *slope[1]]
    if drawing.records.fading:
        fading = [dr.gather(mi.Vector4f, pack, one.splat) for pack in drawing.records.fading]
        six = [part + fade for part, fade in zip(six, [*fading[0], *fading[1]], strict=False)]
    light = []
    if drawing.records.slopes:
        first, second = (dr.gather(mi.Vector4f, pack, one.splat) for pack in drawing.records.slopes)
        x, y = mi.Color3f(first[0], first[2], second[0]), mi.Color3f(first[1], first[3], second[1])
        # Along the ray colours do not change.
        light = [x, y, -direction.x * x - direction.y * y]
    return [one.movable * part for part in six], light


@dr.syntax  # type: ignore[untyped-decorator]
def blended(
    drawing: Drawing, first: mi.UInt32, last: mi.UInt32, film: mi.Vector2f, order: int, columns: bool
) -> tuple[mi.Color3f, mi.Float, mi.Float, list[mi.Color3f]]:
    """Each lane's splats, of `Drawing.members` from `first` to before `last`, at a film point.

    Args:
        film: pixel centres, from the principal point [pixel].
        order: of summation.
        columns: whether slopes are wanted.

    Returns:
        C, the sum of T α z, T behind all, and dC/dξ, six or none.
    """
    import mitsuba as mi

    lens = [drawing.lens.pair(j) for j in range(3)]  # read before the loop, not in every round
    nearest_first = order == 0
    step = _under if nearest_first else _over
    state = [
        mi.Color3f(0.0 if nearest_first else drawing.background),
        mi.Float(0.0),
        mi.Float(1.0),
        [mi.Color3f(0.0) for _ in range(6 * columns)],
        [mi.Float(0.0) for _ in range(6 * columns * nearest_first)],
    ]
    i, number = mi.UInt32(0), last - first
    while dr.hint(
        (i < number) & (state[2] > (_OPAQUE if nearest_first else -1.0)),
        exclude=[drawing, lens, first, last, number, film, order, columns, nearest_first, step],
        label="splats",
    ):
        one = _laid(drawing, first + i if nearest_first else last - 1 - i, film)
        change, light = _motion(drawing, lens, one) if columns else ([], [])
        state = step(state, one, change, light)
        i += 1
    colour, depth, clear, slopes, covered = state
    if dr.hint(nearest_first, mode="scalar"):
        colour += clear * drawing.background
        for j, s in enumerate(covered):
            slopes[j] -= clear * s * drawing.background
    return colour, depth, clear, slopes


def _under(state: list[Any], one: _Laid, change: list[Any], light: list[Any]) -> list[Any]:
    """A splat laid under what is nearer."""
    colour, depth, clear, slopes, covered = state
    rest = 1.0 - one.alpha
    weight, shade, part = clear * one.alpha, clear * one.colour, dr.rcp(rest)
    slopes = [
        slope + shade * (da - one.alpha * s) for slope, da, s in zip(slopes, change, covered, strict=True)
    ]
    covered = [s + da * part for s, da in zip(covered, change, strict=True)]
    for j, shift in enumerate(light):
        slopes[j] += weight * shift
    return [colour + weight * one.colour, depth + weight * one.z, clear * rest, slopes, covered]


def _over(state: list[Any], one: _Laid, change: list[Any], light: list[Any]) -> list[Any]:
    """A splat laid over what is farther."""
    colour, depth, clear, slopes, covered = state
    rest, over = 1.0 - one.alpha, one.colour - colour
    slopes = [rest * slope + da * over for slope, da in zip(slopes, change, strict=True)]
    for j, shift in enumerate(light):
        slopes[j] += one.alpha * shift
    return [colour + one.alpha * over, rest * depth + one.alpha * one.z, clear * rest, slopes, covered]


@dr.syntax  # type: ignore[untyped-decorator]
def shares(
    drawing: Drawing,
    first: mi.UInt32,
    last: mi.UInt32,
    film: mi.Vector2f,
    start: mi.UInt32,
    size: int,
    total: mi.Color3f,
    opacities: bool,
) -> list[mi.Float]:
    """What each lane's value follows of each of its splats.

    Args:
        first, last, film: as in `blended`.
        start: where a lane's numbers begin.
        size: how many there are of all lanes.
        total: C of each lane, for opacities.
        opacities: with respect to ln o; else to c.

    Returns:
        dI/dc = T α, of every channel; or dI/d ln o of red, green and blue, each (size,).
    """
    import mitsuba as mi

    found = [dr.zeros(mi.Float, size) for _ in range(3 if opacities else 1)]
    colour, clear, i, number = mi.Color3f(0.0), mi.Float(1.0), mi.UInt32(0), last - first
    while dr.hint(
        (i < number) & (clear > _OPAQUE),
        exclude=[drawing, first, last, film, start, size, total, opacities, found, number],
        label="shares",
    ):
        one = _laid(drawing, first + i, film)
        rest = 1.0 - one.alpha
        colour += clear * one.alpha * one.colour
        if dr.hint(opacities, mode="scalar"):
            # What lies behind shows through by T (1 − α): total − colour.
            change = one.movable * (clear * one.colour - (total - colour) / rest)
            for j in range(3):
                dr.scatter(found[j], change[j], start + i)
        else:
            dr.scatter(found[0], clear * one.alpha, start + i)
        clear *= rest
        i += 1
    return found
