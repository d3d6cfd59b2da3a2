"""What acts on the film alone: field of view and principal point, by the filter term.

Camera-frame directions (x, y, 1) meet the film at v = c + f (x, y), c the principal point, f the focal
lengths. Changing either moves the image of every material point by an affine flow w(v) = s v + o, however far
it is and whatever light it sends. So neither parallax nor view counts and, as in `flow`, with ∇·w = 2 s,

    ∂I_u/∂θ = ∫ (L − Ī_u) ∇·(h_u w) dv,   ∇·(h w) = ∇h·w + 2 s h.

Field of view α: f ∝ 1/tan(α/2), hence w = −(v − c) / sin α. Principal point: w is constant.
Source: design sections 4.1 and 5.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import mitsuba as mi

    from ..render.view import View


@dataclass(frozen=True)
class FilmFlow:
    """w(v) = s v + o, the motion of film points per unit of a parameter [pixel]."""

    scale: mi.Float
    """s."""
    offset: mi.Vector2f
    """o [pixel]."""

    @staticmethod
    def of(scale: float, offset: NDArray[np.float64]) -> FilmFlow:
        """As kernel input, so that other values need no new kernel."""
        import mitsuba as mi

        return FilmFlow(
            dr.opaque(mi.Float, scale), mi.Vector2f(*(dr.opaque(mi.Float, float(value)) for value in offset))
        )


def field_of_view(view: View) -> FilmFlow:
    """The flow per degree of the horizontal field of view; the aspect ratio stays."""
    import mitsuba as mi

    x_fov = float(np.asarray(mi.traverse(view.sensor)["x_fov"]).ravel()[0])
    scale = -np.radians(1.0) / np.sin(np.radians(x_fov))
    return FilmFlow.of(scale, -scale * view.camera.centre)


def principal_point() -> tuple[FilmFlow, FilmFlow]:
    """The flows per pixel of the principal point along x and along y."""
    return FilmFlow.of(0.0, np.array([1.0, 0.0])), FilmFlow.of(0.0, np.array([0.0, 1.0]))
