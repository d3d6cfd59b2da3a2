"""From splats in space to splats on the film: elliptic weighted averaging, colour, and which tile sees which.

With p a centre in the camera's frame, X = x/z and Y = y/z, V = W R diag(s) the splat's axes there (Σ = V Vᵀ)
and k = 1 / `Camera.scale` = −focal,

    m = (k_x X, k_y Y)                            centre on the film, from the principal point [pixel]
    B = J V,  J = (1/z) [[k_x, 0, −k_x X'], [0, k_y, −k_y Y']]
    Σ' = B Bᵀ + dilation                          X' and Y' held 0.3 of the half field beyond the image
    Σ'⁻¹ = Uᵀ U,  U = [[a, b], [0, d]]            of needles U keeps the digits that Σ'⁻¹ loses in float32

Colour's direction is centre − camera. A splat is drawn out to where its opacity is `NEGLECTED`: that is the
window, and its tiles are those whose pixel centres it reaches. Sources: Zwicker et al. 2002, EWA Splatting;
Kerbl et al. 2023; Yu et al. 2024, Mip-Splatting.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..datasets.splats import Splats
from ..render.arrays import upload, widened
from .harmonics import harmonic, powers_of
from .splat_motion import swelling

if TYPE_CHECKING:
    import mitsuba as mi

Floats = NDArray[np.float64]

DILATION = {"classic": 0.3, "antialiased": 0.3, "mip": 0.1}
"""Variants, and what each adds to a splat's variance on the film [pixel²]; all but the first keep its sum."""

NEGLECTED = 1e-6
"""Opacity at which a splat's window ends."""
TILE = 8
"""Pixels across and down that share a list of splats."""


@dataclass(frozen=True, eq=False)
class Cloud:
    """Splats as kernel input."""

    means: Floats
    """(n, 3), which are made relative to the camera in float64."""
    opacities: Floats
    factors: list[mi.Float]
    """The nine numbers of M by rows, Σ = M Mᵀ."""
    coefficients: list[list[mi.Float]]
    """Of spherical harmonics, by number and channel."""

    @staticmethod
    def of(splats: Splats) -> Cloud:
        """From NumPy."""
        import mitsuba as mi

        factors = widened(splats.factors).reshape(-1, 9)
        coefficients = widened(splats.coefficients)
        return Cloud(
            widened(splats.means),
            # Of a lone splat's double nothing is seen.
            splats.opacities if len(splats) > 1 else np.array([splats.opacities[0], 0.0]),
            [upload(mi.Float, column) for column in factors.T],
            [[upload(mi.Float, row[:, j]) for j in range(3)] for row in coefficients.transpose(1, 0, 2)],
        )


@dataclass(frozen=True, eq=False)
class Records:
    """What is drawn of each splat, as kernel input: four numbers after another, splat by splat."""

    film: mi.Float
    """m_x, m_y, a, b."""
    shape: mi.Float
    """d, opacity, z, and N_x of N = Σ_z Jᵀ."""
    colour: mi.Float
    """Red, green, blue, and N_y."""
    slopes: tuple[mi.Float, ...]
    """∂colour/∂ρ along x and y, by channel, in two records; none where no colour depends on direction."""
    fading: tuple[mi.Float, ...]
    """∂ ln opacity/∂ξ in two records; none for the variant `classic`."""


@dataclass(frozen=True)
class Lens:
    """A pinhole as kernel input."""

    numbers: mi.Float
    """k, the lowest and the highest x/z and y/z of the affine map, the principal point, the size."""

    @staticmethod
    def of(camera: Camera) -> Lens:
        """From a camera without distortion or aperture."""
        import mitsuba as mi

        ends = np.sort([camera.offset, camera.offset + camera.scale * camera.size], axis=0)
        reach = 0.15 * (ends[1] - ends[0])
        values = [1.0 / camera.scale, ends[0] - reach, ends[1] + reach, camera.centre, camera.size]
        return Lens(upload(mi.Float, np.concatenate(values)))

    def pair(self, k: int) -> mi.Vector2f:
        """The k-th pair of numbers."""
        import mitsuba as mi

        return mi.Vector2f(*(dr.gather(mi.Float, self.numbers, mi.UInt32(2 * k + j)) for j in range(2)))


def project(
    cloud: Cloud, relative: mi.Vector3f, opacity: mi.Float, axes: mi.Float, lens: Lens, variant: str
) -> tuple[Records, mi.UInt32, mi.UInt32]:
    """Splats on the film.

    Args:
        relative: means less the camera's centre, along the world's axes.
        opacity: 0 of splats that are left out.
        axes: W = camera_from_world, by rows.

    Returns:
        Records, the box of tiles of each splat (x, y, tiles across, 0), and how many tiles it holds.
    """
    import mitsuba as mi

    W = [mi.Vector3f(*(dr.gather(mi.Float, axes, mi.UInt32(3 * i + j)) for j in range(3))) for i in range(3)]
    k, low, high, centre, size = (lens.pair(i) for i in range(5))

    # Centre
    x, y, z = (dr.dot(row, relative) for row in W)
    before = z > 1e-20
    inverse = dr.rcp(dr.select(before, z, 1.0))
    X, Y = x * inverse, y * inverse
    m = mi.Vector2f(k.x * X, k.y * Y)

    # Footprint
    M = [mi.Vector3f(*cloud.factors[j::3]) for j in range(3)]
    V = [mi.Vector3f(*(dr.dot(row, column) for column in M)) for row in W]
    tx, ty = dr.clip(X, low.x, high.x), dr.clip(Y, low.y, high.y)
    bx, by = (k.x * inverse) * (V[0] - tx * V[2]), (k.y * inverse) * (V[1] - ty * V[2])
    dilation = DILATION[variant]
    sxx, sxy, syy, bare = dr.dot(bx, bx), dr.dot(bx, by), dr.dot(by, by), dr.squared_norm(dr.cross(bx, by))
    cxx, cyy = sxx + dilation, syy + dilation
    det = bare + dilation * (sxx + syy + dilation)
    a, d = dr.sqrt(cyy / det), dr.rsqrt(cyy)
    b = -a * sxy / cyy
    N = mi.Vector2f(dr.dot(V[2], bx), dr.dot(V[2], by))

    # Opacity
    fading: tuple[mi.Float, ...] = ()
    if variant != "classic":
        ratio = dr.select(bare < 1e30, bare / det, 1.0)
        opacity = opacity * dr.sqrt(ratio)
        # d ln √(det Σ / det Σ') = ½ tr(Q dΣ) with Q = Σ⁻¹ − Σ'⁻¹ = Σ wwᵀ, Σ here without the dilation
        safe = dr.maximum(bare, 1e-30)
        q = [syy / safe - cyy / det, sxy / det - sxy / safe, sxx / safe - cxx / det]
        edge = dr.sqrt(dr.maximum(q[0], 1e-30))
        fades = [mi.Vector3f(0.0), mi.Vector3f(0.0)]
        for w in (
            mi.Vector2f(edge, q[1] / edge),
            mi.Vector2f(0.0, dr.sqrt(dr.maximum(q[2] - dr.square(q[1] / edge), 0.0))),
        ):
            spread = mi.Vector2f(sxx * w.x + sxy * w.y, sxy * w.x + syy * w.y)
            parts = swelling(mi.Vector2f(X, Y), mi.Vector2f(tx, ty), z, k, w, dr.dot(w, N), spread)
            fades = [one + part for one, part in zip(fades, parts, strict=True)]
        fading = _packed(*fades[0], *fades[1])

    # Window
    reach = dr.sqrt(2.0 * dr.log(dr.maximum(opacity / NEGLECTED, 1.0)))
    half = mi.Vector2f(dr.sqrt(cxx), dr.sqrt(cyy)) * reach
    first, last = dr.ceil(m + centre - half - 0.5), dr.floor(m + centre + half - 0.5)
    inside = before & (opacity > NEGLECTED) & dr.all((first <= last) & (first < size) & (last >= 0.0))
    first, last = (mi.Vector2u(dr.clip(end, 0.0, size - 1.0)) // TILE for end in (first, last))
    across, down = last.x - first.x + 1, last.y - first.y + 1
    box = dr.ravel(mi.Vector4u(first.x, first.y, across, 0))

    colour, slopes = _coloured(cloud.coefficients, relative, W, X, Y)
    return (
        Records(
            dr.ravel(mi.Vector4f(m.x, m.y, a, b)),
            dr.ravel(mi.Vector4f(d, opacity, z, N.x)),
            dr.ravel(mi.Vector4f(colour.x, colour.y, colour.z, N.y)),
            slopes,
            fading,
        ),
        box,
        dr.select(inside, across * down, 0),
    )


def _coloured(
    coefficients: Sequence[Sequence[mi.Float]],
    relative: mi.Vector3f,
    W: Sequence[mi.Vector3f],
    X: mi.Float,
    Y: mi.Float,
) -> tuple[mi.Color3f, tuple[mi.Float, ...]]:
    """Colours, and `Records.slopes`."""
    import mitsuba as mi

    nearness = dr.rsqrt(dr.maximum(dr.squared_norm(relative), 1e-30))
    direction = relative * nearness
    powers = powers_of(direction)
    colour, gradients = mi.Color3f(0.5), [mi.Vector3f(0.0) for _ in range(3)]
    for k, row in enumerate(coefficients):
        value, gradient = harmonic(k, powers)
        colour += mi.Color3f(*row) * value
        for j in range(3):
            gradients[j] += row[j] * mi.Vector3f(*gradient)
    if len(coefficients) == 1:
        return dr.maximum(colour, 0.0), ()
    slopes = []
    for value, gradient in zip(colour, gradients, strict=True):
        # The camera moves by W⁻¹ρ, the direction by −(1 − direction directionᵀ) W⁻¹ρ / distance.
        across = (direction * dr.dot(direction, gradient) - gradient) * nearness
        across = dr.select(value > 0.0, across, 0.0)
        slopes += [dr.dot(W[0], across), dr.dot(W[1], across)]
    return dr.maximum(colour, 0.0), _packed(*slopes)


def _packed(*six: mi.Float) -> tuple[mi.Float, ...]:
    """Six numbers as two records of four."""
    import mitsuba as mi

    return dr.ravel(mi.Vector4f(*six[:4])), dr.ravel(mi.Vector4f(*six[4:], 0.0, 0.0))
