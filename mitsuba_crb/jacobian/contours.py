"""The parallax term: what a moving camera changes where one surface ends in front of another.

    Σ_contours ∮ h_u (L_bg − Ī_u) (f_fg − f_bg)·m dl

dl is arc length on the film, m the film normal from background to foreground, L_bg the radiance just outside
the contour, Ī_u any constant per pixel, f the film flow of what lies on either side. With inverse depths w
and (x, y, 1) the camera-frame direction from the lens point a,

    f_fg − f_bg = −(w_fg − w_bg) diag(1/s) [[1, 0, −x], [0, 1, −y]] (ρ + φ × a),

s the scale of `curves.Lens`. It is Reynolds' transport theorem: the contour moves with the foreground, so
that a patch of background gains or loses film that its own flow does not account for. A pinhole (a = 0) that
rotates sees none of it.

Samples are drawn per block of the film with random numbers of (seed, block, batch), and reach that block's
pixels only: blocks are independent of one another and of what else is processed. Surfaces are what rays hit
first, masked and null materials like any other. Source: design section 4.1; Zhang et al. 2020, Path-Space
Differentiable Rendering; Zhang et al. 2023, Projective Sampling.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import warnings
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from ..errors import BlindSpotWarning
from ..information import BLOCK
from .curves import CIRCLE, EDGE, RIM, TANGENT, Curves, Lens, Placed, bounds, cut, place
from .edges import EdgeTable
from .pixels import (
    PixelFilter,
    camera_ray,
    download,
    lane_sampler,
    move_ray,
    opaque_transform,
    radiance,
    upload,
)

if TYPE_CHECKING:
    import mitsuba as mi

    from ..scene import View

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

POINTS, PATHS = 0x434F4E54, 0x50415448
"""Purposes of the random numbers: where on the contours, and which light paths."""

_ASIDE = 4e-3
"""How far to either side of a contour its two surfaces are looked for [pixel]."""
_FLOOR = 0.1
"""Share of samples for pieces that two probes found hidden: they may be visible in between."""
_RATE = 0.125
"""Samples per pixel of visible contour, per path and pixel."""
_CHUNK = 1 << 19
"""Samples held at once."""


@dataclass(frozen=True, eq=False)
class _Meshes:
    """All meshes of a scene as one; equal where their bits are, so that the edge table can be cached."""

    vertices: NDArray[np.float32]
    """(V, 3) world positions [scene unit]."""
    faces: Ints
    """(F, 3)"""
    digest: bytes

    def __hash__(self) -> int:
        return hash(self.digest)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Meshes) and self.digest == other.digest


@functools.lru_cache(maxsize=2)
def _edge_table(meshes: _Meshes) -> EdgeTable:
    return EdgeTable.of(meshes.vertices, meshes.faces)


def edge_table(scene: mi.Scene) -> EdgeTable:
    """The edges of all meshes of a scene; made once per geometry, whatever the pose."""
    return _edge_table(_read_meshes(scene))


def _read_meshes(scene: mi.Scene) -> _Meshes:
    vertices, faces, count = [np.empty((0, 3), np.float32)], [np.empty((0, 3), np.int64)], 0
    digest = hashlib.blake2b()
    for shape in scene.shapes():
        if shape.is_mesh():
            vertices.append(np.array(shape.vertex_positions_buffer(), dtype=np.float32).reshape(-1, 3))
            index = np.array(shape.faces_buffer(), dtype=np.uint32).reshape(-1, 3)
            digest.update(vertices[-1].tobytes() + b"|" + index.tobytes() + b"|")
            faces.append(index.astype(np.int64) + count)
            count += len(vertices[-1])
    return _Meshes(np.concatenate(vertices), np.concatenate(faces), digest.digest())


def _smooth_curves(scene: mi.Scene, camera_from_world: Floats) -> tuple[list[Curves], list[str]]:
    """Curves of spheres, cylinders and disks in the camera frame, and the shapes that have none here."""
    import mitsuba as mi

    found: dict[str, list[Floats]] = {"Sphere": [], "Cylinder": [], "Disk": []}
    others: list[str] = []
    for shape in scene.shapes():
        name = shape.class_name()
        if name in found:
            to_world = np.array(mi.traverse(shape)["to_world"].matrix, dtype=np.float64).reshape(4, 4, -1)
            found[name].append(camera_from_world @ to_world[..., 0])
        elif not shape.is_mesh():
            others.append(name)
    sphere, cylinder, disk = (np.array(m).reshape(-1, 4, 4) for m in found.values())
    curves = [Curves.of(CIRCLE, sphere[:, :3, 3], sphere[:, :3, 0])]
    base, x, y, axis = (cylinder[:, :3, j] for j in (3, 0, 1, 2))
    for sign in (1, -1):
        curves.append(Curves.of(TANGENT, base, axis, x, np.full(len(base), sign)))
    curves.append(Curves.of(RIM, base, x, y, inward=axis))
    curves.append(Curves.of(RIM, base + axis, x, y, inward=-axis))
    curves.append(Curves.of(RIM, disk[:, :3, 3], disk[:, :3, 0], disk[:, :3, 1]))
    return curves, others


@dataclass(frozen=True)
class Contours:
    """The pieces of curves that may be contours in one view, and how each film block samples them."""

    table: EdgeTable
    pose: Floats
    """`world_from_camera`, as the renderer has it: in float32."""
    lens: Lens
    pieces: Curves
    columns: int
    """Blocks per row of blocks."""
    first: Ints
    """(blocks + 1,) where each block's pieces start in the two lists below."""
    piece: Ints
    """(q,) pieces that reach each block's pixels."""
    cumulative: Floats
    """(q + 1,) running sum of their sampling weights."""
    samples: Floats
    """(blocks,) samples per path and pixel."""
    without: tuple[str, ...]
    """Shapes whose contours are not known, by kind."""

    def place(self, piece: Ints, u: Floats, point: Floats, box: Floats) -> Placed:
        """Points on pieces, see `curves.place`."""
        return place(self.pieces.part(piece), u, point, box, self.lens, self._edge_side)

    def _edge_side(self, edges: Ints, point: Floats) -> Floats:
        return self.table.sides(edges, self.pose[:3, 3] + point @ self.pose[:3, :3].T).astype(np.float64)


def find_contours(view: View) -> Contours:
    """What may be a contour in this view, and how to sample it.

    Warns:
        BlindSpotWarning: by name, of shapes whose contours are not known.
    """
    pose = view.pose.astype(np.float32).astype(np.float64)
    rotation, centre = pose[:3, :3], pose[:3, 3]
    table = edge_table(view.scene)
    lens = _lens(view)
    edges = table.candidates(centre, rotation[:, 2], lens.radius)
    ends = (table.ends[edges] - centre) @ rotation
    camera_from_world = np.eye(4)
    camera_from_world[:3] = np.column_stack([rotation.T, -rotation.T @ centre])
    smooth, without = _smooth_curves(view.scene, camera_from_world)
    curves = Curves.join([Curves.of(EDGE, ends[:, 0], ends[:, 1] - ends[:, 0], tag=edges), *smooth])
    radius = PixelFilter.of(view).radius
    size = np.array(view.size)
    pieces = cut(curves, lens, np.concatenate([[-radius, -radius], size + radius]))
    columns, rows = -(-size // BLOCK)
    box, length = bounds(pieces, lens)
    block, piece = _pairs(box, radius, size)
    contours = Contours(
        table,
        pose,
        lens,
        pieces,
        int(columns),
        np.searchsorted(block, np.arange(columns * rows + 1)),
        piece,
        np.zeros(1),
        np.zeros(columns * rows),
        tuple(f"{n} x {name}" for name, n in sorted(Counter(without).items())),
    )
    if without:
        warnings.warn(
            f"the contours of {', '.join(contours.without)} are not known to method 'flow': the parallax of "
            "their silhouettes is missing, so translation directions may be under-informed (with a thin lens "
            "rotation, too); use finite_difference",
            BlindSpotWarning,
            stacklevel=2,
        )
    return _weighted(view, contours, block, length, radius)


def _lens(view: View) -> Lens:
    """The sensor's map from directions to the film, read off its own rays."""
    import mitsuba as mi

    grid = np.stack(np.meshgrid(*(np.linspace(0.0, n, 9) for n in view.size)), axis=-1).reshape(-1, 2)
    film = mi.Point2f(*(upload(mi.Float, x) for x in grid.T))
    ray, _ = camera_ray(view, film, mi.Point2f(0.5, 0.5))
    direction = download(ray.d)
    fits = [np.polyfit(grid[:, j], direction[j] / direction[2], 1) for j in range(2)]
    scale, offset = np.array(fits).T
    params = mi.traverse(view.sensor)
    if "aperture_radius" not in params:
        return Lens(scale, offset, view.near_clip)
    radius, focus = (float(np.asarray(params[k]).ravel()[0]) for k in ("aperture_radius", "focus_distance"))
    return Lens(scale, offset, view.near_clip, radius, focus)


def _pairs(box: Floats, radius: float, size: Ints) -> tuple[Ints, Ints]:
    """Blocks and the pieces whose filter footprint reaches their pixels, sorted by block."""
    low = np.ceil(np.maximum(box[:, :2] - radius - 0.5, 0.0)).astype(np.int64) // BLOCK
    high = np.floor(np.minimum(box[:, 2:] + radius - 0.5, size - 1)).astype(np.int64) // BLOCK
    extent = np.maximum(high - low + 1, 0)
    count = extent.prod(axis=1)
    piece = np.repeat(np.arange(len(box)), count)
    j = np.arange(len(piece)) - np.repeat(np.cumsum(count) - count, count)
    wide = np.maximum(extent[piece, 0], 1)
    block = (low[piece, 1] + j // wide) * -(-size[0] // BLOCK) + low[piece, 0] + j % wide
    order = np.argsort(block, kind="stable")
    return block[order], piece[order]


def _weighted(view: View, contours: Contours, block: Ints, length: Floats, radius: float) -> Contours:
    """Sampling weights of the pairs and sample counts of the blocks, from two probes of each piece."""
    n, piece = len(contours.pieces), contours.piece
    box = np.broadcast_to([-np.inf, -np.inf, np.inf, np.inf], (n, 4))
    seen, near = np.zeros(n), np.zeros(n)
    for u in (0.25, 0.75):
        placed = contours.place(np.arange(n), np.full(n, u), np.zeros((n, 3)), box)
        inverse_depth = 1.0 / placed.seen[:, 2]
        jump = _look(view, contours, placed, np.full((n, 2), 0.5))
        near = np.maximum(near, inverse_depth)
        seen += 0.5 * jump / inverse_depth
    if contours.lens.radius == 0.0:
        box = _reach(block, contours.columns, radius, np.array(view.size))
        arc = contours.place(piece, np.full(len(piece), 0.5), np.zeros((len(piece), 3)), box).length
    else:
        arc = length[piece]
    weight = arc * near[piece] * (_FLOOR + seen[piece])
    visible = np.bincount(block, arc * np.where(seen[piece] > 0.0, 1.0, _FLOOR), len(contours.first) - 1)
    return dataclasses.replace(
        contours,
        cumulative=np.concatenate([[0.0], np.cumsum(weight)]),
        samples=np.minimum(_RATE * visible, BLOCK * BLOCK),
    )


def _reach(block: Ints, columns: int, radius: float, size: Ints) -> Floats:
    """Film rectangle (n, 4) from which samples reach the pixels of blocks."""
    low = np.stack([block % columns, block // columns], axis=1) * BLOCK
    high = np.minimum(low + BLOCK, size)
    return np.concatenate([low + 0.5 - radius, high - 0.5 + radius], axis=1)


def _look(view: View, contours: Contours, placed: Placed, aperture: Floats) -> Floats:
    """Jump of inverse depth from background to foreground (n,), 0 where there is no contour or it is hidden.

    Args:
        aperture: (n, 2) lens samples in [0, 1]².
    """
    if not len(placed.length):
        return np.empty(0)  # Dr.Jit does not divide empty arrays
    transform = opaque_transform(contours.pose)
    inner, outer = (
        _inverse_depth(view, transform, placed.film + side * placed.normal, aperture)
        for side in (_ASIDE, -_ASIDE)
    )
    contour = 1.0 / placed.seen[:, 2]
    visible = (inner > outer) & (np.abs(inner - contour) < np.abs(outer - contour)) & (placed.length > 0.0)
    return np.where(visible, np.maximum(contour - outer, 0.0), 0.0)


def _inverse_depth(view: View, transform: mi.Transform4f, film: Floats, aperture: Floats) -> Floats:
    ray, _ = _ray(view, film, aperture)
    hit = view.scene.ray_intersect_preliminary(move_ray(ray, transform))
    depth = dr.fma(hit.t, ray.d.z, ray.o.z)
    return np.array(dr.select(hit.is_valid(), dr.rcp(depth), 0.0), dtype=np.float64)


def _ray(view: View, film: Floats, aperture: Floats) -> tuple[mi.Ray3f, mi.Color3f]:
    import mitsuba as mi

    x, y, s, t = (upload(mi.Float, a) for a in (*film.T, *aperture.T))
    return camera_ray(view, mi.Point2f(x, y), mi.Point2f(s, t))


def parallax_term(
    view: View,
    contours: Contours,
    pixels: Ints,
    baseline: Floats,
    *,
    spp: int,
    seed: int,
    batches: int,
) -> Floats:
    """Estimate the parallax term of dI/dξ in the camera frame.

    Args:
        contours: of this view, from `find_contours`.
        pixels: (n, 2) columns and rows; those of one block must come in one call.
        baseline: (n, 3) Ī_u, any constants near the image that do not come from these random numbers.
        spp: paths per pixel over all batches that the other terms trace; sets the number of samples here.

    Returns:
        (batches, n, 3, 6), independent from batch to batch and from block to block
        [radiance / scene unit, radiance / rad].
    """
    n = len(pixels)
    terms = np.zeros((batches, n, 3, 6))
    of_pixel = pixels[:, 1] // BLOCK * contours.columns + pixels[:, 0] // BLOCK
    blocks = np.unique(of_pixel)
    count = np.ceil(contours.samples[blocks] * (spp / batches)).astype(np.int64)
    blocks, count = blocks[count > 0], count[count > 0]
    chunk = np.cumsum(count * batches) // _CHUNK
    for which in np.unique(chunk):
        part = blocks[chunk == which]
        mine = np.flatnonzero(np.isin(of_pixel, part))
        terms[:, mine] = _sum_blocks(
            view, contours, part, count[chunk == which], pixels[mine], baseline[mine], seed, batches
        )
    return terms


def _sum_blocks(
    view: View,
    contours: Contours,
    blocks: Ints,
    count: Ints,
    pixels: Ints,
    baseline: Floats,
    seed: int,
    batches: int,
) -> Floats:
    """The term of some blocks' pixels (batches, n, 3, 6), from `count` samples per block and batch."""
    pixel_filter = PixelFilter.of(view)
    n, lens = len(pixels), contours.lens

    # Samples: one in each stratum of a block's weight, per block and batch.
    total = count * batches
    owner = np.repeat(np.arange(len(blocks)), total)
    number = np.arange(len(owner)) - np.repeat(np.cumsum(total) - total, total)
    batch, stratum = number % batches, number // batches
    block = blocks[owner]
    jitter, aperture, point = _draw(block, number, seed, lens)
    first, last = contours.first[block], contours.first[block + 1]
    whole = contours.cumulative[last] - contours.cumulative[first]
    target = contours.cumulative[first] + whole * (stratum + jitter) / count[owner]
    pair = np.clip(np.searchsorted(contours.cumulative, target, side="right") - 1, first, last - 1)
    share = np.diff(contours.cumulative)[pair]
    u = np.clip((target - contours.cumulative[pair]) / share, 0.0, 1.0)
    box = _reach(block, contours.columns, pixel_filter.radius, np.array(view.size))
    placed = contours.place(contours.piece[pair], u, point, box)

    # Footprint: the selected pixels of its own block that each sample reaches.
    rows, height = _footprint(placed.film, owner, blocks, contours.columns, pixels, pixel_filter)
    kept = np.flatnonzero((rows >= 0).any(axis=1) & (placed.length > 0.0))
    jump = _look(view, contours, placed.part(kept), aperture[kept])
    kept, jump = kept[jump > 0.0], jump[jump > 0.0]
    if not len(kept):
        return np.zeros((batches, n, 3, 6))
    placed, rows, height = placed.part(kept), rows[kept], height[kept]
    outside = _radiance(view, contours, placed, aperture[kept], block[kept], number[kept], seed)

    # (f_fg − f_bg)·m per twist component, times the film length of each sample.
    slope = placed.normal / lens.scale
    gradient = np.column_stack([-slope, np.sum(slope * placed.seen[:, :2], axis=1) / placed.seen[:, 2]])
    gradient = np.concatenate([gradient, np.cross(point[kept], gradient)], axis=1)
    length = placed.length * whole[kept] / (share[kept] * count[owner[kept]])
    gradient *= (jump * length)[:, None]
    moments = np.concatenate([gradient[:, None], outside[:, :, None] * gradient[:, None]], axis=1)

    inside = rows >= 0
    sample = np.nonzero(inside)[0]
    matrix = csr_array(
        (height[inside], (batch[kept][sample] * n + rows[inside], sample)), shape=(batches * n, len(kept))
    )
    sums = (matrix @ moments.reshape(-1, 24)).reshape(batches, n, 4, 6)
    return np.asarray(sums[:, :, 1:] - baseline[:, :, None] * sums[:, :, :1])


def _footprint(
    film: Floats, owner: Ints, blocks: Ints, columns: int, pixels: Ints, pixel_filter: PixelFilter
) -> tuple[Ints, Floats]:
    """Rows of `pixels` that film points reach in their own block, −1 for none, and h there; both (n, r²)."""
    import mitsuba as mi

    corner = np.stack([blocks % columns, blocks // columns], axis=1) * BLOCK
    home = np.searchsorted(blocks, pixels[:, 1] // BLOCK * columns + pixels[:, 0] // BLOCK)
    slot = np.full((len(blocks), BLOCK, BLOCK), -1)
    slot[home, *(pixels - corner[home]).T] = np.arange(len(pixels))
    width = int(np.ceil(2.0 * pixel_filter.radius))
    pixel = np.ceil(film - pixel_filter.radius - 0.5).astype(np.int64)[:, None] + np.arange(width)[:, None]
    offset = upload(mi.Float, (pixel + 0.5 - film[:, None]).ravel())
    h = np.array(pixel_filter.eval(offset), dtype=np.float64).reshape(-1, width, 2)
    local = pixel - corner[owner][:, None]
    within = (local >= 0) & (local < BLOCK)
    local = np.clip(local, 0, BLOCK - 1)
    rows = slot[owner[:, None, None], local[:, :, None, 0], local[:, None, :, 1]]
    rows = np.where(within[:, :, None, 0] & within[:, None, :, 1], rows, -1)
    return rows.reshape(-1, width**2), (h[:, :, None, 0] * h[:, None, :, 1]).reshape(-1, width**2)


def _draw(block: Ints, number: Ints, seed: int, lens: Lens) -> tuple[Floats, Floats, Floats]:
    """Of each sample: where in its stratum (n,), its lens sample (n, 2) and lens point (n, 3)."""
    import mitsuba as mi

    sampler = lane_sampler(upload(mi.UInt32, block), upload(mi.UInt32, number), seed, POINTS)
    jitter, aperture = sampler.next_1d(), sampler.next_2d()
    point = mi.warp.square_to_uniform_disk_concentric(aperture)
    dr.eval(jitter, aperture, point)
    on_lens = np.column_stack([lens.radius * download(point).T, np.zeros(len(block))])
    return np.array(jitter, dtype=np.float64), download(aperture).T, on_lens


def _radiance(
    view: View, contours: Contours, placed: Placed, aperture: Floats, block: Ints, number: Ints, seed: int
) -> Floats:
    """L_bg of each sample (n, 3), one path each."""
    import mitsuba as mi

    sampler = lane_sampler(upload(mi.UInt32, block), upload(mi.UInt32, number), seed, PATHS)
    ray, importance = _ray(view, placed.film - _ASIDE * placed.normal, aperture)
    color = importance * radiance(view, sampler, move_ray(ray, opaque_transform(contours.pose)))
    return download(color).T
