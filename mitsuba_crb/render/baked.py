"""Surfaces whose colour is the radiance that leaves them, on both sides: photographs on scanned meshes.

Mitsuba's `area` shines from one side, and scans are seen from behind where they have holes. Paths towards
emitters do not choose it; those that meet it count in full.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import mitsuba as mi


@functools.cache
def _class(_variant: str) -> Any:
    """The emitter of a variant, whose classes Mitsuba has only once it is set."""
    import drjit as dr
    import mitsuba as mi

    class Baked(mi.Emitter):  # type: ignore[misc]  # Mitsuba is untyped here
        """Radiance of a texture in every direction."""

        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.radiance = props["radiance"]
            self.m_flags = mi.EmitterFlags.Surface | mi.EmitterFlags.SpatiallyVarying

        def traverse(self, callback: mi.TraversalCallback) -> None:
            callback.put("radiance", self.radiance, mi.ParamFlags.Differentiable)

        def eval(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Color3f:
            return self.radiance.eval(si, active)

        def sample_direction(
            self, _it: mi.Interaction3f, _sample: mi.Point2f, _active: mi.Bool = True
        ) -> tuple[mi.DirectionSample3f, mi.Color3f]:
            return dr.zeros(mi.DirectionSample3f), mi.Color3f(0.0)

        def pdf_direction(
            self, _it: mi.Interaction3f, _ds: mi.DirectionSample3f, _active: mi.Bool = True
        ) -> mi.Float:
            return mi.Float(0.0)

        def eval_direction(
            self, _it: mi.Interaction3f, _ds: mi.DirectionSample3f, _active: mi.Bool = True
        ) -> mi.Color3f:
            return mi.Color3f(0.0)

        def to_string(self) -> str:
            return f"Baked[{self.radiance}]"

    return Baked


def baked(radiance: mi.Texture) -> mi.Emitter:
    """An emitter for a shape, of a texture's radiance."""
    import mitsuba as mi

    props = mi.Properties("baked")
    props["radiance"] = radiance
    return _class(mi.variant())(props)
