"""What the film flow cannot follow, by block: no points, no contours, or a cut that moves with the camera.

Participating media and radiance fields, even those of meshes, have no points; of curves, signed distance
fields, smooth shapes that are scaled unevenly and instances of very many faces nobody lists the contours;
where the near or the far plane cuts a surface, the edge is the camera's and not the surface's. Rays through
every pixel's middle and around it, as far as its filter reaches, find the blocks; what slips through between
them is left to `closure`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..render.arrays import upload, widened
from ..render.paths import IntegratorTracer, Tracer, White
from ..render.rays import camera_ray, opaque_transform
from .clip_planes import cuts_by_far_plane, cuts_by_near_plane, meets_anything, meets_before_near
from .silhouettes import first_seen
from .surfaces import has_contours, surface_key, surfaces

if TYPE_CHECKING:
    from ..render.view import View
    from .closure import FilmBlocks

Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

_OFFSETS = np.array([[0.0, 0.0], [-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])
"""Of a pixel's rays from its centre, over the filter's radius."""
_CAUSES = {
    "Instance": "instances",
    "SDFGrid": "signed distance fields",
    "BSplineCurve": "curves",
    "LinearCurve": "curves",
    "Ellipsoids": "radiance fields",
    "EllipsoidsMesh": "radiance fields",
}
MEDIA, NEAR, FAR = "media", "near plane", "far plane"
CLIPPED = (NEAR, FAR)
"""Causes that turn with the camera."""


@dataclass(frozen=True)
class Unfollowed:
    """What in one view may be in the way of the flow."""

    view: View
    shapes: dict[int, str]
    """Causes by the shape's key, see `surfaces.Surface`."""
    everywhere: bool
    """Whether the camera stands in a medium that the integrator sees."""
    near: NDArray[np.float64]
    """(n, 2) film points where the near plane cuts something [pixel]."""
    far: NDArray[np.float64]
    """(n, 2) those where the far plane does."""

    @staticmethod
    def of(view: View, tracer: Tracer | White) -> Unfollowed:
        """Of a view and what traces its paths: `path` and its like pass media by."""
        volumes = isinstance(tracer, IntegratorTracer)
        found = {}
        for surface in surfaces(view.scene):
            shape, name = surface.shape, surface.shape.class_name()
            if volumes and shape.is_medium_transition():
                found[surface.key] = MEDIA
            elif (volumes and name == "EllipsoidsMesh") or not has_contours(surface):
                found[surface.key] = _CAUSES.get(name, f"{name.lower()}s scaled unevenly")
        return Unfollowed(
            view,
            found,
            volumes and view.sensor.get_medium() is not None,
            cuts_by_near_plane(view),
            cuts_by_far_plane(view),
        )

    def causes(self, pixels: Ints, blocks: FilmBlocks) -> NDArray[np.object_]:
        """(blocks,) what is in the way there, or "".

        Args:
            pixels: (n, 2) of the blocks.
        """
        found = np.full(len(blocks.number), MEDIA if self.everywhere else "", dtype=object)
        if self.everywhere or not (self.shapes or len(self.near) or len(self.far)):
            return found
        for offset, lens in zip(_OFFSETS * self.view.pixel_filter.radius, 0.5 + 0.35 * _OFFSETS, strict=True):
            film = widened(pixels + 0.5 + offset)
            for cause, there in self._seen(film, lens):
                found[blocks.any(there[: len(pixels)])] = cause
        return found

    def _seen(self, film: NDArray[np.float64], lens: NDArray[np.float64]) -> list[tuple[str, Bools]]:
        """Causes, and where rays through film points (n, 2) [pixel] and a lens sample (2,) meet them."""
        import mitsuba as mi

        aperture = mi.Point2f(*(dr.opaque(mi.Float, float(x)) for x in lens))
        ray, _ = camera_ray(self.view, mi.Point2f(*(upload(mi.Float, x) for x in film.T)), aperture)
        transform = opaque_transform(self.view.pose)
        _, *numbers, _ = first_seen(self.view, ray, transform)
        instance, shape = (np.array(number, dtype=np.int64) for number in numbers)
        # Of an instance whose shapes are not listed its own number is all that is known.
        keys = surface_key(instance, shape), surface_key(0, instance)
        found = []
        for cause in sorted(set(self.shapes.values())):
            own = [key for key, its in self.shapes.items() if its == cause]
            found.append((cause, np.isin(keys[0], own) | np.isin(keys[1], own)))
        if len(self.far):
            found.append((FAR, (shape == 0) & meets_anything(self.view, ray, transform)))
        if len(self.near):
            found.append((NEAR, meets_before_near(self.view, ray, transform)))
        return found
