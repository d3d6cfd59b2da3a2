"""What acts on the film alone: focal lengths, principal point, a lens' distortion, by the filter term.

A camera-frame direction that meets the plane at depth one in u (axes x right, y down) meets the film at
v = c + f D(u), c the principal point, f the focal lengths, D the lens. Changing any of these moves the image
of every material point by a flow w(v) = ∂v/∂θ at fixed u, however far it is and whatever light it sends. So
neither parallax nor view counts and, as in `flow`,

    ∂I_u/∂θ = ∫ (L − Ī_u) ∇·(h_u w) dv,   ∇·(h w) = ∇h·w + h ∇·w

    fx, fy           w = (v − c)/f along one axis                 ∇·w = 1/f
    cx, cy           w = 1 along one axis                         ∇·w = 0
    field of view α  w = −(v − c) / sin α, for f ∝ 1/tan(α/2)     ∇·w = −2 / sin α
    coefficient k    w = f ∂D/∂k                                  ∇·w = ∂ ln det D'/∂k

The last line holds because det D' is what the film makes of area: Liouville's formula. The field of view is
that of the film without the lens' distortion. Source: design sections 4.1, 5 and 12.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike

from ..camera import LENS_MODELS, lens

if TYPE_CHECKING:
    import mitsuba as mi

    from ..render.view import View
    from .pairs import PairSample


@dataclass(frozen=True)
class AffineFlow:
    """w(v) = s v + o, the motion of film points per unit of a parameter [pixel]."""

    scale: mi.Vector2f
    """s, along x and along y."""
    offset: mi.Vector2f
    """o [pixel]."""

    @staticmethod
    def of(scale: ArrayLike, offset: ArrayLike) -> AffineFlow:
        """As kernel input, so that other values need no new kernel."""
        return AffineFlow(_opaque(scale), _opaque(offset))

    def divergence(self, half: PairSample, film: mi.Point2f, u: mi.Point2f) -> mi.Float:
        """∇·(h w) over the sample's density."""
        x, y = self.scale.x * film.x + self.offset.x, self.scale.y * film.y + self.offset.y
        return half.gradient.x * x + half.gradient.y * y + (self.scale.x + self.scale.y) * half.value


@dataclass(frozen=True)
class CoefficientFlow:
    """w(v) = f ∂D/∂k, the motion of film points per unit of a coefficient of the lens [pixel]."""

    model: str
    index: int
    """Of the coefficient."""
    coefficients: tuple[mi.Float, ...]
    focal: mi.Vector2f
    """f [pixel]."""

    def divergence(self, half: PairSample, film: mi.Point2f, u: mi.Point2f) -> mi.Float:
        """∇·(h w) over the sample's density."""
        x, y, spread = lens.motion(dr, self.model, self.coefficients, self.index, u.x, u.y)
        return half.gradient.x * self.focal.x * x + half.gradient.y * self.focal.y * y + spread * half.value


FilmFlow = AffineFlow | CoefficientFlow


def film_flows(view: View, name: str) -> tuple[FilmFlow, ...]:
    """The flows per unit of "fov" [deg], "principal_point" [pixel], or one of `Intrinsics.parameters`."""
    import mitsuba as mi

    intrinsics = view.intrinsics
    focal, centre = np.array(intrinsics.focal), np.array(intrinsics.centre)
    if name == "principal_point":
        return film_flows(view, "cx") + film_flows(view, "cy")
    if name == "fov":
        scale = -np.radians(1.0) / np.sin(np.radians(view.plain_fov_deg))
        return (AffineFlow.of([scale, scale], -scale * centre),)
    if name in ("cx", "cy"):
        return (AffineFlow.of([0.0, 0.0], np.eye(2)["xy".index(name[1])]),)
    if name in ("fx", "fy"):
        axis = np.eye(2)["xy".index(name[1])] / focal
        return (AffineFlow.of(axis, -axis * centre),)
    k = tuple(dr.opaque(mi.Float, value) for value in intrinsics.distortion)
    index = LENS_MODELS[intrinsics.model].index(name)
    return (CoefficientFlow(intrinsics.model, index, k, _opaque(focal)),)


def _opaque(vector: ArrayLike) -> mi.Vector2f:
    import mitsuba as mi

    return mi.Vector2f(*(dr.opaque(mi.Float, float(value)) for value in np.asarray(vector)))
