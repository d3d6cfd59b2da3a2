"""What in a view could spoil a number: discontinuities that `forward` cannot see, and float32.

A finding is about what this camera sees: rays through a coarse grid of pixels find the surfaces, their
textures, the depth jumps between neighbours and the partly blocked lights. A method that differentiates
radiance at fixed film points is blind to all four.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import PrecisionError
from ..render.rays import coarse_grid, film_rays, first_hits, move_ray
from .clip_planes import cuts_by_far_plane, cuts_by_near_plane
from .finite_difference import steps_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    import mitsuba as mi

    from ..render.view import View
    from .method import Seen

_GRID = 64
_LIGHT_SAMPLES = 8
_NOTICED, _USELESS = 0.01, 0.1
"""Spacing of positions over the finite-difference step that is warned of, and that is refused."""


def precision_findings(view: Seen) -> list[str]:
    """Where float32 positions at the camera are too coarse for the derivative.

    Renders are float32, as vertices of meshes are: at a distance |c| from the origin both are multiples
    of their spacing there, and another origin does not bring back what they lost. Standard deviations of a
    textured board before a wall differed from those at the origin, at places with a spacing of 1 % of the
    finite-difference step, by 1 % at most, of 7 % by 3 %, of 14 % by 7 % and of 28 % by 19 % (`flow`).

    Raises:
        PrecisionError: the spacing exceeds a tenth of the step.
    """
    distance = float(np.abs(view.pose[:3, 3]).max())
    spacing = float(np.spacing(np.float32(distance)))
    step = float(steps_of(view)[:3].min())
    if spacing <= _NOTICED * step:
        return []
    where = (
        f"the camera stands {distance:.3g} scene units from the origin, where float32 positions are "
        f"{spacing:.2g} apart, {spacing / step:.2g} of the finite-difference step {step:.2g}"
    )
    cure = "subtract what the coordinates have in common from scene and camera before the scene is written"
    if spacing > _USELESS * step:
        raise PrecisionError(
            f"{where}, and above {_USELESS:g} numbers would be wrong by more than 5 %: {cure}"
        )
    return [f"{where}: standard deviations may be wrong by 5 %; {cure}"]


def cut_surfaces(view: View, method: str) -> Iterator[str]:
    """That the near or the far plane cuts what is in view, for a method that follows surfaces only."""
    for name, clip, setting, cuts in (
        ("near", view.near_clip, "lower near_clip", cuts_by_near_plane),
        ("far", view.far_clip, "raise far_clip", cuts_by_far_plane),
    ):
        if len(cuts(view)):
            yield (
                f"the {name} plane at {clip:g} cuts surfaces in view, and method {method!r} misses that "
                f"the cut moves with the camera: any direction may be wrong; {setting} or use "
                "finite_difference"
            )


def discontinuities(view: View) -> list[str]:
    """Names of what jumps in this view: textures, silhouettes, shadows, each as a phrase."""
    grid = coarse_grid(view.size, _GRID)
    hit, depth = first_hits(view, grid.reshape(-1, 2))
    found = _textures(view.scene)
    if _has_silhouettes(view, hit, depth, grid):
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
    view: View, hit: mi.SurfaceInteraction3f, depth: NDArray[np.float64], grid: NDArray[np.int64]
) -> bool:
    """Whether depth jumps between neighbouring pixels: a gap that halving the distance does not close."""
    shape = grid.shape[:2]
    finite = np.isfinite(depth).reshape(shape)
    if not finite.all():
        return bool(finite.any())
    points = np.array(hit.p, dtype=np.float64).T.reshape(*shape, 3)
    normals = np.array(hit.n, dtype=np.float64).T.reshape(*shape, 3)
    film = grid + 0.5
    pairs = []
    for here, there in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        step = points[there] - points[here]
        off = np.minimum(
            np.abs(np.sum(step * normals[here], axis=-1)), np.abs(np.sum(step * normals[there], axis=-1))
        )
        # Off both tangent planes by much of the step: a jump, or a crease between the two.
        suspect = off > 0.3 * np.linalg.norm(step, axis=-1)
        pairs.append((film[here][suspect], film[there][suspect]))
    left, right = (np.concatenate(side) for side in zip(*pairs, strict=True))
    return len(left) > 0 and _gap_remains(view, left, right)


def _gap_remains(view: View, left: NDArray[np.float64], right: NDArray[np.float64]) -> bool:
    """Whether some pair of film points (n, 2) still sees far-apart surfaces when bisected to 1/64."""
    ends = [left, right]
    hits = [_surface(view, end) for end in ends]
    first = np.linalg.norm(hits[1] - hits[0], axis=1)
    for _ in range(6):
        middle = 0.5 * (ends[0] + ends[1])
        hit = _surface(view, middle)
        nearer = np.linalg.norm(hit - hits[0], axis=1) < np.linalg.norm(hit - hits[1], axis=1)
        for side, moved in ((0, nearer), (1, ~nearer)):
            ends[side] = np.where(moved[:, None], middle, ends[side])
            hits[side] = np.where(moved[:, None], hit, hits[side])
    return bool(np.any(np.linalg.norm(hits[1] - hits[0], axis=1) > 0.25 * first))


def _surface(view: View, film: NDArray[np.float64]) -> NDArray[np.float64]:
    """First surface points (n, 3) through film points (n, 2) [pixel], in the world."""
    hit: Any = view.scene.ray_intersect(move_ray(*film_rays(view, film)))
    return np.array(hit.p, dtype=np.float64).T


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
