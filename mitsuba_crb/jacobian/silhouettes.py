"""Which curves may be contours in one view, how each film block samples them, and what a ray says of them.

Curves are cut into pieces that are short on the film. A block draws from the pieces that reach its pixels, in
proportion to film length, to the largest jump of inverse depth they can make, and to what two probes of each
piece saw of it; pieces that both probes found hidden keep a share, for they may show in between. A point
counts if rays just beside it say so: the nearer hit lies on the surface's side, its inverse depth and the
curve's are closer to one another than to the other hit's, and what is hit is the curve's own: a smooth
surface itself, a face around the edge or next to one of those, or what is no nearer than their planes. Else
another surface ends so close by that rays do not get between the two curves. Of such curves the innermost
counts, by all that lies between its surface and what is seen beyond them: each jump once. Source: design
section 4.1; Zhang et al. 2023, Projective Sampling.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..information.blocks import BLOCK
from ..render.arrays import upload, widened
from ..render.pixels import first_hit
from ..render.rays import camera_ray, move_ray, opaque_transform
from .curves import EDGE, Curves, Placed, bounds, cut, place
from .edges import EdgeTable
from .pairs import film_shift
from .surfaces import edge_table, first_faces, has_instances, smooth_curves, surface_key

if TYPE_CHECKING:
    import mitsuba as mi

    from ..render.view import View

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

ASIDE = 4e-3
"""How far to either side of a contour its two surfaces are looked for, at most [pixel]."""
_ROUNDINGS = 4.0
"""The same over what float32 leaves undecided of where a ray meets the film."""
_TOLERANCE = 1e-5
"""Relative depth that float32 does not tell apart."""
_FLOOR = 0.1
"""Sampling weight, as a relative jump of depth, of pieces that both probes found hidden."""
_RATE = 0.2
"""Samples per pixel of contour and unit of its relative jump of depth, per path and pixel: their noise is
below 2 % of the filter term's in lit rooms, and their time below 5 %."""
_HIDDEN_RATE = 0.05
"""Least relative jump of depth that counts there."""


class Sides(NamedTuple):
    """What rays just beside points of contours see; Dr.Jit's arrays, or NumPy's of the same memory."""

    jump: Any
    """Inverse depth of the foreground minus the background's, 0 where nothing shows [1/scene unit]."""
    instance: Any
    """Number of the instance on the foreground's side, 0 for none."""
    shape: Any
    """Number of the shape there, 0 for none."""
    face: Any
    """The face of it."""
    seen: Any
    """Inverse depth there [1/scene unit]."""


@dataclass(frozen=True)
class Contours:
    """The pieces of curves that may be contours in one view, and how each film block samples them."""

    view: View
    table: EdgeTable
    first_face: tuple[Ints, Ints]
    """See `surfaces.first_faces`."""
    pose: Floats
    """`world_from_camera`, rounded to float32 as the renderer has it."""
    camera: Camera
    pieces: Curves
    box: Floats
    """(p, 4) film rectangle x0 y0 x1 y1 that holds each piece [pixel]."""
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

    @property
    def twists(self) -> int:
        """How many components of the twist, from the first, see contours: none of a pinhole's rotation."""
        return 6 if self.camera.radius > 0.0 else 3

    def place(self, piece: Ints, u: Floats, point: Floats, box: Floats) -> Placed:
        """Points on pieces, see `curves.place`."""
        return place(self.pieces.part(piece), u, point, box, self.camera, self._edge_side)

    def _edge_side(self, edges: Ints, point: Floats) -> Floats:
        return self.table.sides(edges, self.pose[:3, 3] + point @ self.pose[:3, :3].T).astype(np.float64)

    def corner(self, block: Ints) -> Ints:
        """First pixel (n, 2) of blocks."""
        return np.stack([block % self.columns, block // self.columns], axis=1) * BLOCK

    def reach(self, block: Ints) -> Floats:
        """Film rectangle (n, 4) from which samples reach the pixels of blocks."""
        low = self.corner(block) + film_shift(self.view.pixel_filter)
        high = np.minimum(self.corner(block) + BLOCK, self.view.size) + film_shift(self.view.pixel_filter)
        radius = self.view.pixel_filter.radius
        return np.concatenate([low + 0.5 - radius, high - 0.5 + radius], axis=1)

    def plain_reach(self, block: Ints) -> Floats:
        """Rectangle (n, 4) of the plain film that holds their `reach`."""
        if self.camera.distortion is None:
            return self.reach(block)
        own, of_own = np.unique(block, return_inverse=True)
        return self.camera.plain_boxes(self.reach(own))[of_own]

    def aside(self, placed: Placed, piece: Ints) -> Floats:
        """How far beside points of pieces their two surfaces are looked for (n, 1) [pixel].

        Next to edges that is as near as float32 lets rays come, for other edges may be near, too. Where rays
        begin to miss a sphere or a cylinder is less certain, and behind a hidden emitter they go on a little
        beside their path.
        """
        reach = np.abs(self.pose[:3, 3]).max() + np.abs(placed.seen).max(axis=1, initial=0.0)
        focal = np.abs(self.camera.focal).max()
        rounding = 2.0**-24 * (max(self.camera.size) + 2.0 * focal * (1.0 + reach / placed.seen[:, 2]))
        exact = (self.pieces.kind[piece] == EDGE) & (not self.view.integrator.hide_emitters)
        return np.where(exact, np.minimum(_ROUNDINGS * rounding, ASIDE), ASIDE)[:, None]

    def side_points(self, placed: Placed, piece: Ints, aperture: Floats) -> dict[str, Any]:
        """Points just beside those on contours, as kernel input; a lone one twice.

        Args:
            piece: (n,) what was placed.
            aperture: (n, 2) the sensor's lens samples in [0, 1]² that give the points' lens points.
        """
        import mitsuba as mi

        aside = self.aside(placed, piece) * placed.normal
        inner, outer = placed.film + aside, placed.film - aside
        return {
            "inner": [upload(mi.Float, x) for x in widened(inner).T],
            "outer": [upload(mi.Float, x) for x in widened(outer).T],
            "aperture": [upload(mi.Float, x) for x in widened(aperture).T],
            "depth": upload(mi.Float, widened(placed.seen[:, 2])),
            "transform": opaque_transform(self.pose),
            "film": self.view.film_arrays,
        }

    def jump(self, sides: Sides, placed: Placed, piece: Ints, point: Floats) -> Floats:
        """Inverse depth of the foreground minus the background's (n,), 0 where nothing shows.

        Args:
            sides: from `look`, in NumPy's arrays.
            piece: (n,) what was placed.
            point: (n, 3) lens points.
        """
        jump, instance, shape, face, seen = (lanes[: len(piece)] for lanes in sides)
        own, key = self.pieces.surface[piece], surface_key(instance.astype(np.int64), shape.astype(np.int64))
        shows = (placed.length > 0.0) & ((own < 0) | (own == key))
        jump = np.where(shows, jump, 0.0).astype(np.float64)
        edge = np.flatnonzero((jump > 0.0) & (self.pieces.kind[piece] == EDGE))
        keys, first = self.first_face
        mesh = np.minimum(np.searchsorted(keys, key[edge]), len(keys) - 1)
        hit = np.where(keys[mesh] == key[edge], first[mesh] + face[edge], -1)
        # An edge that shows a face of its own, as nearly all do, is neither hidden nor another's.
        strange = np.flatnonzero(~self.table.around(self.pieces.tag[piece[edge]], hit))
        edge, hit = edge[strange], hit[strange]
        rotation = self.pose[:3, :3]
        centre = self.pose[:3, 3] + point[edge] @ rotation.T
        aside = 2.0 * ASIDE / self.camera.least_stretch(placed.seen[edge])
        tolerance = aside * np.abs(self.camera.scale).max() * placed.seen[edge, 2]
        tag, world = self.pieces.tag[piece[edge]], centre + placed.seen[edge] @ rotation.T
        hidden = self._hidden(tag, hit, seen[edge], placed.part(edge), piece[edge], point[edge])
        jump[edge[hidden | self.table.repeats(tag, hit, world, tolerance, centre)]] = 0.0
        return jump

    def _hidden(
        self, tag: Ints, hit: Ints, seen: Floats, placed: Placed, piece: Ints, point: Floats
    ) -> NDArray[np.bool_]:
        """Which edges lie behind what is seen just inside of them: it is nearer than their own faces' planes.

        What it shows is another edge's, of which this is too near to see past it. Of edges so close to one
        another the innermost counts, by all that lies between its surface and what is seen beyond them.
        """
        inside = placed.film + self.aside(placed, piece) * placed.normal
        direction = self.camera.directions(inside) - point * [1.0, 1.0, 0.0] / self.camera.focus
        centre, rotation = self.pose[:3, 3], self.pose[:3, :3]
        own = self.table.nearest(tag, centre + point @ rotation.T, direction @ rotation.T)
        contour = 1.0 / placed.seen[:, 2]
        nearer = seen > contour * (1.0 + _TOLERANCE) + 2.0 * np.maximum(own - contour, 0.0)
        return np.asarray(nearer & ~self.table.next_to(tag, hit))


def look(view: View, arrays: dict[str, Any]) -> tuple[Sides, mi.Ray3f, mi.Color3f]:
    """What rays just beside points of contours see, and those on the background's side and their weights.

    Args:
        arrays: from `Contours.side_points`.

    Returns:
        The rays in the camera frame; all of it to be evaluated.
    """
    import mitsuba as mi

    view = view.with_film_arrays(arrays["film"])
    (inner, _), (outer, importance) = (
        camera_ray(view, mi.Point2f(*arrays[side]), mi.Point2f(*arrays["aperture"]))
        for side in ("inner", "outer")
    )
    seen, instance, shape, face = first_seen(view, inner, arrays["transform"])
    beyond, *_ = first_seen(view, outer, arrays["transform"])
    contour = dr.rcp(arrays["depth"])
    shows = dr.abs(seen - contour) < dr.minimum(seen - beyond, dr.abs(contour - beyond))
    sides = Sides(dr.select(shows, dr.maximum(contour - beyond, 0.0), 0.0), instance, shape, face, seen)
    return sides, outer, importance


def first_seen(
    view: View, ray: mi.Ray3f, transform: mi.Transform4f
) -> tuple[mi.Float, mi.UInt32, mi.UInt32, mi.UInt32]:
    """Inverse depth of what is seen, 0 at infinity, instance's and shape's numbers, 0 for none, and face."""
    import mitsuba as mi

    world_ray = move_ray(ray, transform)
    hit: Any
    if view.integrator.hide_emitters:
        hit = first_hit(view, world_ray)
        distance = dr.dot(hit.p - world_ray.o, world_ray.d)
    else:
        hit = view.scene.ray_intersect_preliminary(world_ray)
        distance = hit.t
        if has_instances(view.scene):  # whose shapes are not known before
            hit = hit.compute_surface_interaction(world_ray, mi.RayFlags.Minimal)
    depth = dr.fma(distance, ray.d.z, ray.o.z)
    inverse_depth = dr.select(hit.is_valid(), dr.rcp(depth), 0.0)
    instance, shape = (
        dr.select(hit.is_valid(), dr.reinterpret_array(mi.UInt32, pointer), 0)
        for pointer in (hit.instance, hit.shape)
    )
    return inverse_depth, instance, shape, hit.prim_index


def find_contours(view: View) -> Contours:
    """What may be a contour in this view, and how to sample it."""
    pose = view.pose.astype(np.float32).astype(np.float64)
    rotation, centre = pose[:3, :3], pose[:3, 3]
    camera_from_world = np.eye(4)
    camera_from_world[:3] = np.column_stack([rotation.T, -rotation.T @ centre])
    table, camera = edge_table(view.scene), view.camera
    edges = table.candidates(centre, rotation[:, 2], camera.radius)
    ends = (table.ends.take(edges, axis=0) - centre) @ rotation
    curves = [Curves.of(EDGE, ends[:, 0], ends[:, 1] - ends[:, 0], tag=edges)]
    curves += smooth_curves(view.scene, camera_from_world)
    size, radius = np.array(view.size), view.pixel_filter.radius
    pieces = cut(Curves.join(curves), camera, np.concatenate([[-radius, -radius], size + radius]))
    box, length = bounds(pieces, camera)
    block, piece = _pairs(box, radius, size)
    columns, rows = -(-size // BLOCK)
    contours = Contours(
        view=view,
        table=table,
        first_face=first_faces(view.scene),
        pose=pose,
        camera=camera,
        pieces=pieces,
        box=box,
        columns=int(columns),
        first=np.zeros(columns * rows + 1, dtype=np.int64),
        piece=piece,
        cumulative=np.zeros(1),
        samples=np.zeros(columns * rows),
    )
    return _weighted(contours, block, length)


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


def _weighted(contours: Contours, block: Ints, length: Floats) -> Contours:
    """Sampling weights of the pairs and sample counts of the blocks, from two probes of each piece.

    Args:
        block: (q,) of each pair, ascending.
        length: (p,) of each piece on the film, about [pixel].
    """
    n, piece = len(contours.pieces), contours.piece
    everywhere = np.broadcast_to([-np.inf, -np.inf, np.inf, np.inf], (n, 4))
    centre = np.zeros((n, 3))
    seen, near = np.zeros(n), np.zeros(n)
    view = contours.view

    def body(arrays: dict[str, Any]) -> tuple[Any, ...]:
        return tuple(look(view, arrays)[0])

    for u in (0.25, 0.75):
        placed = contours.place(np.arange(n), np.full(n, u), centre, everywhere)
        near = np.maximum(near, 1.0 / placed.seen[:, 2])
        if n:  # Dr.Jit does not divide empty arrays
            arrays = contours.side_points(placed, np.arange(n), np.full((n, 2), 0.5))
            sides = view.recorder.ready("probes", body, view, arrays, (view.integrator.hide_emitters,))()
            jump = contours.jump(Sides(*map(np.asarray, sides)), placed, np.arange(n), centre)
            seen += 0.5 * jump * placed.seen[:, 2]
    arc = length[piece]
    if contours.camera.radius == 0.0:
        # A pinhole knows how much of each piece lies in the block's reach.
        box, middle = contours.plain_reach(block), np.full(len(piece), 0.5)
        arc = contours.place(piece, middle, np.zeros((len(piece), 3)), box).length
    kept = arc > 0.0
    block, piece, arc = block[kept], piece[kept], arc[kept]
    weight = arc * near[piece] * (_FLOOR + seen[piece])
    blocks = len(contours.samples)
    worth = np.bincount(block, arc * (_HIDDEN_RATE + seen[piece]), blocks)
    return dataclasses.replace(
        contours,
        first=np.searchsorted(block, np.arange(blocks + 1)),
        piece=piece,
        cumulative=np.concatenate([[0.0], np.cumsum(weight)]),
        samples=np.minimum(_RATE * worth, BLOCK * BLOCK),
    )
