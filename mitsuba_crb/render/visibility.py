"""Why an image shows nothing: what its rays would meet without clip planes, and whether anything shines."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from .rays import Lanes, camera_ray, coarse_grid, move_ray, opaque_transform

if TYPE_CHECKING:
    from .view import View

_GRID = 32


def nothing_visible(view: View) -> str:
    """Why no ray of a view meets anything, in a sentence; empty if one does, or sees an environment."""
    if view.visible_depth.size or view.scene.environment() is not None:
        return ""
    import mitsuba as mi

    pixels = coarse_grid(view.size, _GRID).reshape(-1, 2)
    ray, _ = camera_ray(view, Lanes.of(view, pixels, 1).centre, mi.Point2f(0.5, 0.5))
    # From the lens itself and without an end.
    ray.o, ray.maxt = mi.Point3f(ray.o - ray.d * (ray.o.z / ray.d.z)), mi.Float(dr.inf)
    hit = view.scene.ray_intersect(move_ray(ray, opaque_transform(view.pose)))
    depth = np.array(dr.select(hit.is_valid(), hit.t * ray.d.z, dr.nan), dtype=np.float64)
    met, total = depth[np.isfinite(depth)], len(depth)
    far, near = float(view.sensor.far_clip()), view.near_clip
    beyond, before = met[met >= far], met[met <= near]
    if beyond.size:
        return (
            f"nothing is visible: {beyond.size} of {total} rays would meet surfaces at depths from "
            f"{beyond.min():.6g}, beyond far_clip {far:g}: raise far_clip"
        )
    if before.size:
        return (
            f"nothing is visible: {before.size} of {total} rays would meet surfaces at depths up to "
            f"{before.max():.6g}, before near_clip {near:g}: lower near_clip"
        )
    return (
        f"nothing is visible: none of {total} rays meets a surface; the camera looks away from the scene (it "
        "looks along its own z, see --pose)"
    )


def nothing_lit(view: View) -> str:
    """Why a black image is black, in a sentence."""
    unlit = "the scene has no emitter" if not view.scene.emitters() else "no light reaches what is visible"
    unlit += "; of a world's file, --light baked lets its colours shine"
    return nothing_visible(view) or unlit
