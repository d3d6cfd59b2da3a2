"""What in a view could spoil a number: discontinuities that `forward` cannot see, and float32.

A finding is about what this camera sees: rays through a coarse grid of pixels find the surfaces, their
textures, the depth jumps between neighbours and the partly blocked lights. A method that differentiates
radiance at fixed film points is blind to all four.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .jacobian import finite_difference
from .jacobian.pixels import first_hits

if TYPE_CHECKING:
    import mitsuba as mi

    from .scene import View

_GRID = 64
_LIGHT_SAMPLES = 8


def precision_findings(view: View, length_scale: float) -> list[str]:
    """Where float32 positions at the camera are too coarse for the derivative.

    Renders are float32: at a distance |c| from the origin, positions are multiples of their spacing there. A
    finding is raised when that exceeds 1 % of the finite-difference step.
    """
    distance = float(np.abs(view.pose[:3, 3]).max())
    spacing = float(np.spacing(np.float32(distance)))
    step = float(finite_difference.steps(view, length_scale)[:3].min())
    if spacing <= 0.01 * step:
        return []
    return [
        f"the camera stands {distance:.3g} scene units from the origin, where float32 positions are "
        f"{spacing:.2g} apart, more than 1 % of the finite-difference step {step:.2g}: move scene and "
        "camera nearer to the origin"
    ]


def discontinuities(view: View) -> list[str]:
    """Names of what jumps in this view: textures, silhouettes, shadows, each as a phrase."""
    columns, rows = (np.unique(np.linspace(0, n - 1, min(n, _GRID)).astype(np.int64)) for n in view.size)
    grid = np.stack(np.meshgrid(columns, rows), axis=-1)
    hit, depth = first_hits(view, grid.reshape(-1, 2))
    found = _textures(view.scene)
    if _has_silhouettes(hit, depth, (len(rows), len(columns))):
        found.append("silhouettes (depth jumps between neighbouring pixels)")
    if _has_shadows(view.scene, hit):
        found.append("shadows (lights that are blocked from part of what is visible)")
    return found


def _textures(scene: mi.Scene) -> list[str]:
    import mitsuba as mi

    nodes: dict[int, Any] = {}
    for key in mi.traverse(scene).properties.values():
        node = key[2]
        nodes[id(node)] = node
    found = []
    for node in nodes.values():
        name = node.class_name()
        if name == "Checkerboard":
            found.append("a checkerboard texture")
        elif name.startswith("BitmapTexture") and _is_nearest(node):
            found.append("a bitmap with filter_type=nearest")
    return sorted(set(found))


def _is_nearest(texture: mi.Texture) -> bool:
    """Whether a bitmap is constant within texels whose neighbours differ."""
    import drjit as dr
    import mitsuba as mi

    width, height = texture.resolution()
    rng = np.random.default_rng(0)
    texel = np.stack([rng.integers(0, width, 1024), rng.integers(0, height, 1024)])
    texture_from_uv = np.array(mi.traverse(texture)["to_uv"].matrix, dtype=np.float64).reshape(3, 3)
    uv_from_texture = np.linalg.inv(texture_from_uv)

    def value(inside: float) -> NDArray[np.float64]:
        point = (texel + inside) / np.array([[width], [height]])
        uv = (uv_from_texture[:2, :2] @ point + uv_from_texture[:2, 2:]).astype(np.float32)
        si = dr.zeros(mi.SurfaceInteraction3f, uv.shape[1])
        si.uv = mi.Point2f(uv[0], uv[1])
        return np.array(texture.eval(si), dtype=np.float64)

    def differ(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.bool_]:
        return np.asarray(np.abs(a - b).max(axis=0) > 1e-5)

    below, low, high, above = (value(inside) for inside in (-0.5, 0.4, 0.6, 1.5))
    telling = differ(below, low) & differ(high, above)
    return bool(telling.any() and not np.any(differ(low, high) & telling))


def _has_silhouettes(
    hit: mi.SurfaceInteraction3f, depth: NDArray[np.float64], shape: tuple[int, int]
) -> bool:
    """Whether a hit lies off the tangent planes of its neighbours by more than their spacing explains."""
    points = np.array(hit.p, dtype=np.float64).T.reshape(*shape, 3)
    normals = np.array(hit.n, dtype=np.float64).T.reshape(*shape, 3)
    finite = np.isfinite(depth).reshape(shape)
    if finite.any() and not finite.all():
        return True
    if not finite.any():
        return False
    for axis in (0, 1):
        a, b = (np.take(points, range(k, shape[axis] - 1 + k), axis) for k in (0, 1))
        na, nb = (np.take(normals, range(k, shape[axis] - 1 + k), axis) for k in (0, 1))
        step = b - a
        length = np.linalg.norm(step, axis=-1)
        off_a = np.abs(np.sum(step * na, axis=-1))
        off_b = np.abs(np.sum(step * nb, axis=-1))
        # A convex or concave edge leaves one of the two offsets small only where its faces meet; across a
        # depth jump both neighbours' planes are missed by much of the step.
        if np.any(np.minimum(off_a, off_b) > 0.5 * length):
            return True
    return False


def _has_shadows(scene: mi.Scene, hit: mi.SurfaceInteraction3f) -> bool:
    """Whether a light that faces the visible surfaces reaches only some of them."""
    import drjit as dr
    import mitsuba as mi

    if not scene.emitters():
        return False
    rng = mi.PCG32(dr.width(hit.t))
    blocked = np.zeros(dr.width(hit.t), dtype=int)
    lit = np.zeros_like(blocked)
    for _ in range(_LIGHT_SAMPLES):
        sample = mi.Point2f(rng.next_float32(), rng.next_float32())
        ds, weight = scene.sample_emitter_direction(hit, sample, False, hit.is_valid())
        facing = hit.is_valid() & (dr.dot(ds.d, hit.n) * dr.dot(hit.wi, mi.Vector3f(0, 0, 1)) > 0.05)
        facing &= dr.max(weight) > 0
        occluded = scene.ray_test(hit.spawn_ray_to(ds.p), facing)
        blocked += np.array(facing & occluded)
        lit += np.array(facing & ~occluded)
    return bool(blocked.any() and lit.any())
