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
from ..render.arrays import upload, widened
from ..render.rays import camera_ray, coarse_grid, first_hits, move_ray, opaque_transform
from .finite_difference import steps_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    import mitsuba as mi

    from ..render.view import View
    from .method import Seen

_GRID = 64
_FAR = 100.0
"""Depth over the median visible depth."""
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
    for name, clip, setting, is_cut in (
        ("near", view.near_clip, "lower near_clip", is_cut_by_near_plane),
        ("far", view.far_clip, "raise far_clip", is_cut_by_far_plane),
    ):
        if is_cut(view):
            yield (
                f"the {name} plane at {clip:g} cuts surfaces in view, and method {method!r} misses that "
                f"the cut moves with the camera: any direction may be wrong; {setting} or use "
                "finite_difference"
            )


def is_cut_by_near_plane(view: View) -> bool:
    """Whether a surface crosses the near plane in view: neighbours, one blocked before it, one seen at it."""
    return _is_cut(view, _before_near, lambda depth: depth < 1.02 * view.near_clip)


def is_cut_by_far_plane(view: View) -> bool:
    """Whether a surface crosses the far plane in view: neighbours, one seen beyond it, one seen at it.

    A cut `_FAR` times as far as what is visible moves as the horizon does, and tells no more than that.
    """
    depth = view.visible_depth
    if not depth.size or view.far_clip > _FAR * np.median(depth):
        return False
    return _is_cut(view, _beyond_far, lambda depth: (depth > 0.98 * view.far_clip) & np.isfinite(depth))


def _is_cut(
    view: View,
    probe: Callable[[View, NDArray[np.float64]], tuple[NDArray[np.bool_], NDArray[np.float64]]],
    at_plane: Callable[[NDArray[np.float64]], NDArray[np.bool_]],
) -> bool:
    """Whether film points between neighbours that a plane cuts off and does not see a surface at the plane.

    Args:
        probe: which film points (n, 2) [pixel] see something that is cut off, and the depth of what they see.
    """
    grid = np.asarray(coarse_grid(view.size, _GRID) + 0.5, dtype=np.float64)
    off = probe(view, grid.reshape(-1, 2))[0].reshape(grid.shape[:2])
    if off.all() or not off.any():
        return False
    across, down = off[:, :-1] != off[:, 1:], off[:-1] != off[1:]
    low = widened(np.concatenate([grid[:, :-1][across], grid[:-1][down]]))
    high = widened(np.concatenate([grid[:, 1:][across], grid[1:][down]]))
    first = probe(view, low)[0]
    for _ in range(12):
        middle = 0.5 * (low + high)
        same = (probe(view, middle)[0] == first)[:, None]
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return bool(np.any(at_plane(probe(view, low)[1]) | at_plane(probe(view, high)[1])))


def _before_near(view: View, film: NDArray[np.float64]) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Whether anything lies before the near plane at film points (n, 2) [pixel], and the depth behind it."""
    ray, transform, depth = _depth(view, film)
    return meets_before_near(view, ray, transform), np.array(depth, dtype=np.float64)


def _beyond_far(view: View, film: NDArray[np.float64]) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Whether film points (n, 2) [pixel] see something beyond the far plane only, and the depth before it."""
    ray, transform, found = _depth(view, film)
    depth = np.array(found, dtype=np.float64)
    return meets_anything(view, ray, transform) & ~np.isfinite(depth), depth


def meets_before_near(view: View, ray: mi.Ray3f, transform: mi.Transform4f) -> NDArray[np.bool_]:
    """(n,) whether camera rays of the camera's frame would meet anything before the near plane."""
    import mitsuba as mi

    to_lens = ray.o.z / ray.d.z
    before = mi.Ray3f(mi.Point3f(ray.o - to_lens * ray.d), ray.d, to_lens, 0.0, ray.wavelengths)
    return np.array(view.scene.ray_test(move_ray(before, transform)), dtype=bool)


def meets_anything(view: View, ray: mi.Ray3f, transform: mi.Transform4f) -> NDArray[np.bool_]:
    """(n,) whether camera rays of the camera's frame would meet anything if no far plane ended them."""
    import drjit as dr
    import mitsuba as mi

    whole = mi.Ray3f(ray.o, ray.d, dr.largest(mi.Float), 0.0, ray.wavelengths)
    return np.array(view.scene.ray_test(move_ray(whole, transform)), dtype=bool)


def _depth(view: View, film: NDArray[np.float64]) -> tuple[mi.Ray3f, mi.Transform4f, mi.Float]:
    """Rays through film points (n, 2) [pixel], the pose, and the depth of what they see, inf for nothing."""
    import drjit as dr
    import mitsuba as mi

    x, y = (upload(mi.Float, coordinate) for coordinate in film.T)
    ray, _ = camera_ray(view, mi.Point2f(x, y), mi.Point2f(0.5, 0.5))
    transform = opaque_transform(view.pose)
    hit = view.scene.ray_intersect_preliminary(move_ray(ray, transform))
    return ray, transform, dr.select(hit.is_valid(), dr.fma(hit.t, ray.d.z, ray.o.z), dr.inf)


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
    import mitsuba as mi

    x, y = film.astype(np.float32).T
    ray, _ = camera_ray(view, mi.Point2f(x, y), mi.Point2f(0.5, 0.5))
    hit = view.scene.ray_intersect(move_ray(ray, opaque_transform(view.pose)))
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
