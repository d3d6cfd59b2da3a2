"""Curves that may be contours, and where a point of one lands on the film.

Edges of meshes and tangent lines of cylinders are straight; the circle in which a cone from the camera
touches a sphere, the ends of cylinders and the rims of disks are conics. Everything is exact (no polylines),
in float64 NumPy, in the camera frame, and a function of the lens point a that the surfaces are seen from, so
that a thin lens needs no second derivation. p' = p − a throughout. Source: design section 4.1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera

if TYPE_CHECKING:
    from collections.abc import Callable

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

_PIECE = 16.0
"""Longest piece that a line is cut into [pixel]."""
_BOW_PIECE = 8.0
"""Longest piece, about, that a conic is cut into [pixel]."""
_HALVINGS = 64
"""Of one that is longer, at most: beyond them float64 has no middle."""


EDGE, TANGENT, CIRCLE, RIM = range(4)
"""Kinds of curve: a mesh's edge, a cylinder's tangent line, a sphere's touching circle, a surface's end."""


@dataclass(frozen=True)
class Curves:
    """Curves that may be contours, in the camera frame; `span` selects a part of each.

    EDGE:    origin + t·u                                              t in [0, 1]
    TANGENT: origin + t·u + |v| n(a), n the tangent plane's normal      t in [0, 1]
    CIRCLE:  of the sphere about `origin` with radius |u|               t in [0, 2π]
    RIM:     origin + u cos t + v sin t                                 t in [0, 2π]
    """

    kind: NDArray[np.int8]
    """(n,)"""
    span: Floats
    """(n, 2) first and last parameter t."""
    origin: Floats
    """(n, 3)"""
    u: Floats
    """(n, 3)"""
    v: Floats
    """(n, 3)"""
    tag: Ints
    """(n,) EDGE: index in the edge table. TANGENT: +1 or −1, which of the two lines."""
    inward: Floats
    """(n, 3) RIM: direction in which the surface leaves the rim; zero where that is the centre (a disk)."""
    surface: Ints
    """(n,) key of the surface that it belongs to; −1 for edges, which may belong to several."""

    def __len__(self) -> int:
        return len(self.kind)

    def part(self, index: Ints, span: Floats | None = None) -> Curves:
        """Some of the curves, as often as listed, with new spans."""
        return Curves(
            self.kind.take(index),
            self.span.take(index, axis=0) if span is None else span,
            self.origin.take(index, axis=0),
            self.u.take(index, axis=0),
            self.v.take(index, axis=0),
            self.tag.take(index),
            self.inward.take(index, axis=0),
            self.surface.take(index),
        )

    @staticmethod
    def join(parts: list[Curves]) -> Curves:
        """One list of several."""
        names = ("kind", "span", "origin", "u", "v", "tag", "inward", "surface")
        return Curves(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    @staticmethod
    def of(
        kind: int,
        origin: Floats,
        u: Floats,
        v: Floats | None = None,
        tag: Ints | None = None,
        inward: Floats | None = None,
        surface: Ints | None = None,
    ) -> Curves:
        """Whole curves of one kind."""
        n = len(origin)
        last = 1.0 if kind in (EDGE, TANGENT) else 2.0 * np.pi
        return Curves(
            np.full(n, kind, dtype=np.int8),
            np.broadcast_to([0.0, last], (n, 2)),
            origin,
            u,
            np.zeros((n, 3)) if v is None else v,
            np.zeros(n, dtype=np.int64) if tag is None else tag,
            np.zeros((n, 3)) if inward is None else inward,
            np.full(n, -1) if surface is None else surface,
        )

    @property
    def straight(self) -> NDArray[np.bool_]:
        """(n,) which curves are lines."""
        return np.asarray((self.kind == EDGE) | (self.kind == TANGENT))

    def lines(self, point: Floats) -> tuple[Floats, Floats, Bools]:
        """End points (n, 2, 3) relative to lens points (n, 3), inward directions, and which exist (n,).

        Inward directions are left zero for edges, whose side the edge table knows.
        """
        origin = self.origin - point
        inward = np.zeros_like(origin)
        exists = np.ones(len(self), dtype=bool)
        i = np.flatnonzero(self.kind == TANGENT)
        if len(i):
            axis = self.u[i] / np.linalg.norm(self.u[i], axis=1, keepdims=True)
            away = -(origin[i] - axis * np.sum(axis * origin[i], axis=1, keepdims=True))
            distance = np.linalg.norm(away, axis=1, keepdims=True)
            radius = np.linalg.norm(self.v[i], axis=1, keepdims=True)
            exists[i] = (distance > radius)[:, 0]
            cosine = radius / np.maximum(distance, radius)
            toward = away / np.maximum(distance, np.finfo(float).tiny)
            across = np.cross(axis, toward) * self.tag[i, None]
            normal = cosine * toward + np.sqrt(1.0 - cosine**2) * across
            origin[i] += radius * normal
            inward[i] = -normal
        ends = origin[:, None] + self.span[..., None] * self.u[:, None]
        return ends, inward, exists

    def bows(self, t: Floats, point: Floats) -> tuple[Floats, Floats, Floats, NDArray[np.bool_]]:
        """Points p' (n, 3), dp'/dt, inward directions, and which exist, of the curves that are not lines."""
        centre = self.origin - point
        u, v = self.u.copy(), self.v.copy()
        exists = np.ones(len(self), dtype=bool)
        i = np.flatnonzero(self.kind == CIRCLE)
        if len(i):
            distance = np.linalg.norm(centre[i], axis=1, keepdims=True)
            radius = np.linalg.norm(u[i], axis=1, keepdims=True)
            exists[i] = (distance > radius)[:, 0]
            sine = radius / np.maximum(np.maximum(distance, radius), np.finfo(float).tiny)
            toward = centre[i] / np.maximum(distance, np.finfo(float).tiny)
            # The frame turns smoothly with the lens point, because the helper axis follows the sphere alone.
            helper = np.eye(3)[np.argmin(np.abs(self.origin[i]), axis=1)]
            first = np.cross(toward, helper)
            first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), np.finfo(float).tiny)
            reach = radius * np.sqrt(1.0 - sine**2)
            u[i], v[i] = reach * first, reach * np.cross(toward, first)
            centre[i] *= 1.0 - sine**2
        spoke = u * np.cos(t)[:, None] + v * np.sin(t)[:, None]
        turn = v * np.cos(t)[:, None] - u * np.sin(t)[:, None]
        inward = np.where(self.inward.any(axis=1, keepdims=True), self.inward, -spoke)
        inward[i] = self.origin[i] - point[i] - centre[i] - spoke[i]
        return centre + spoke, turn, inward, exists


@dataclass(frozen=True)
class Placed:
    """Points of curves on the film."""

    film: Floats
    """(n, 2) position [pixel]."""
    normal: Floats
    """(n, 2) unit normal, towards the foreground."""
    seen: Floats
    """(n, 3) p', the point relative to the lens point, in the camera frame [scene unit]."""
    length: Floats
    """(n,) film arc length that the point stands for [pixel]; 0 where its lens point sees no contour."""

    def part(self, index: Ints) -> Placed:
        """Some of the points."""
        arrays = (self.film, self.normal, self.seen, self.length)
        return Placed(*(array.take(index, axis=0) for array in arrays))


def place(
    curves: Curves,
    u: Floats,
    point: Floats,
    box: Floats,
    camera: Camera,
    edge_side: Callable[[Ints, Floats], Floats],
) -> Placed:
    """One point on each piece: uniform in the plain film's arc length on lines, in the parameter on conics.

    On the plain film lines are straight; a lens that distorts carries their points over from there.

    Args:
        curves: n pieces.
        u: (n,) in [0, 1).
        point: (n, 3) lens points.
        box: (n, 4) rectangle x0 y0 x1 y1 of the plain film that lines are clipped to [pixel].
        edge_side: of edges (k,) seen from lens points (k, 3): +1 or −1, the side of the plane through lens
            point and edge that all faces lie on, or 0 if they lie on both.
    """
    n = len(curves)
    film, direction, seen, inner = np.zeros((n, 2)), np.zeros((n, 2)), np.ones((n, 3)), np.zeros(n)
    length = np.zeros(n)
    i = np.flatnonzero(curves.straight)
    if len(i):
        part, a = curves.part(i), point[i]
        ends, inward, exists = part.lines(a)
        ends, on_film, exists = _in_front(ends, a, exists, camera)
        first, last = _clip(on_film, box[i])
        exists &= last > first
        s = first + u[i] * (last - first)
        along = on_film[:, 1] - on_film[:, 0]
        depth = 1.0 / ((1.0 - s) / ends[:, 0, 2] + s / ends[:, 1, 2])
        plain = on_film[:, 0] + s[:, None] * along
        seen[i, 2] = depth
        seen[i, :2] = (camera.scale * plain + camera.offset - a[:, :2] / camera.focus) * depth[:, None]
        film[i], along = camera.distorted(plain), camera.stretched(plain, along)
        extent = _length(along)
        direction[i] = along / np.maximum(extent, np.finfo(float).tiny)[:, None]
        length[i] = np.where(exists, extent * (last - first), 0.0)
        other = np.flatnonzero(part.kind != EDGE)
        across = np.cross(ends[other, 0], ends[other, 1])
        inner[i[other]] = np.einsum("ij,ij->i", across, inward[other])
        edge = np.flatnonzero((part.kind == EDGE) & exists)
        inner[i[edge]] = edge_side(part.tag[edge], a[edge])
        # Left of `direction` on the film is where det(e₀, e₁, ·) > 0, if the film's axes are not mirrored.
        inner[i] *= np.prod(camera.scale)
    i = np.flatnonzero(~curves.straight)
    if len(i):
        part, a = curves.part(i), point[i]
        width = part.span[:, 1] - part.span[:, 0]
        p, turn, inward, exists = part.bows(part.span[:, 0] + u[i] * width, a)
        exists &= p[:, 2] > camera.near
        p[~exists] = [0.0, 0.0, 1.0]
        velocity = camera.velocity(p, turn)
        speed = np.linalg.norm(velocity, axis=1)
        film[i], seen[i] = camera.project(p, a), p
        direction[i] = velocity / np.maximum(speed, np.finfo(float).tiny)[:, None]
        length[i] = np.where(exists, speed * width, 0.0)
        toward = camera.velocity(p, inward)
        inner[i] = direction[i, 0] * toward[:, 1] - direction[i, 1] * toward[:, 0]
    normal = np.stack([-direction[:, 1], direction[:, 0]], axis=1) * np.sign(inner)[:, None]
    return Placed(film, normal, seen, np.where(inner == 0.0, 0.0, length))


def cut(curves: Curves, camera: Camera, frame: Floats) -> Curves:
    """Pieces of curves, short on the film, that may land in a rectangle of it; what lies behind is left out.

    Args:
        frame: (4,) film rectangle x0 y0 x1 y1 [pixel].
    """
    line, bow = (curves.part(np.flatnonzero(which)) for which in (curves.straight, ~curves.straight))
    return Curves.join([_cut_lines(line, camera, frame), _cut_bows(bow, camera, frame)])


def bounds(curves: Curves, camera: Camera) -> tuple[Floats, Floats]:
    """Film rectangle (n, 4) that holds each piece from every lens point, and its length (n,) [pixel]."""
    low, high = np.full((len(curves), 2), np.inf), np.full((len(curves), 2), -np.inf)
    length = np.zeros(len(curves))
    line = curves.straight
    for rim in camera.rim():
        a = np.broadcast_to(rim, (len(curves), 3))
        points = np.empty((len(curves), 3, 2))
        part = curves.part(np.flatnonzero(line))
        ends, _, exists = part.lines(a[line])
        points[line, ::2] = _in_front(ends, a[line], exists, camera)[1]
        points[line, 1] = 0.5 * (points[line, 0] + points[line, 2])
        points[line] = camera.distorted(points[line])
        part = curves.part(np.flatnonzero(~line))
        for j, t in enumerate((part.span[:, 0], part.span.mean(axis=1), part.span[:, 1])):
            p = part.bows(t, a[~line])[0]
            p[:, 2] = np.maximum(p[:, 2], camera.near)
            points[~line, j] = camera.project(p, a[~line])
        # A conic leaves its chords by about the sagitta that its middle shows.
        first, middle, last = (points[:, j] for j in range(3))
        bend = 2.0 * np.abs(middle - 0.5 * (first + last)) + 0.01
        low = np.minimum(low, np.minimum(np.minimum(first, middle), last) - bend)
        high = np.maximum(high, np.maximum(np.maximum(first, middle), last) + bend)
        length = np.maximum(length, _length(middle - first) + _length(last - middle))
    return np.concatenate([low, high], axis=1), length


def _in_front(ends: Floats, point: Floats, exists: Bools, camera: Camera) -> tuple[Floats, Floats, Bools]:
    """Lines (n, 2, 3) clipped to the near plane, ends on the plain film (n, 2, 2), and which remain."""
    camera = camera.plain
    first, last = (ends[:, j, 2] >= camera.near for j in range(2))
    exists = exists & (np.maximum(ends[:, 0, 2], ends[:, 1, 2]) > camera.near)
    ends = ends.copy()
    i = np.flatnonzero(exists & (first != last))
    if len(i):
        start, along = ends[i, 0], ends[i, 1] - ends[i, 0]
        crossing = (camera.near - start[:, 2]) / along[:, 2]
        ends[i, first[i].astype(np.int64)] = start + crossing[:, None] * along
    ends[~exists] = [0.0, 0.0, 1.0]
    ends[..., 2] = np.maximum(ends[..., 2], camera.near)
    return ends, np.stack([camera.project(ends[:, j], point) for j in range(2)], axis=1), exists


def _clip(ends: Floats, box: Floats) -> tuple[Floats, Floats]:
    """First and last fraction of film lines (n, 2, 2) inside rectangles (n, 4) (Liang and Barsky 1984)."""
    along = ends[:, 1] - ends[:, 0]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        low = (box[:, :2] - ends[:, 0]) / along
        high = (box[:, 2:] - ends[:, 0]) / along
    inside = (ends[:, 0] >= box[:, :2]) & (ends[:, 0] <= box[:, 2:])
    parallel = along == 0.0
    enter = np.where(parallel, np.where(inside, 0.0, 1.0), np.minimum(low, high))
    leave = np.where(parallel, np.where(inside, 1.0, 0.0), np.maximum(low, high))
    enter, leave = np.maximum(enter[:, 0], enter[:, 1]), np.minimum(leave[:, 0], leave[:, 1])
    return np.maximum(enter, 0.0), np.minimum(leave, 1.0)


def _length(rows: Floats) -> Floats:
    """(n,) of (n, 2): NumPy's sums along so short an axis take ten times as long."""
    return np.asarray(np.sqrt(rows[:, 0] ** 2 + rows[:, 1] ** 2), dtype=np.float64)


def _cut_lines(lines: Curves, camera: Camera, frame: Floats) -> Curves:
    centre = np.zeros((len(lines), 3))
    whole, _, exists = lines.lines(centre)
    ends, film, exists = _in_front(whole, centre, exists, camera)
    defocus = np.abs(1.0 / camera.focus - 1.0 / ends[..., 2])
    blur = camera.radius * np.maximum(defocus[:, 0], defocus[:, 1])
    margin = blur[:, None] / np.abs(camera.scale)
    frame = camera.plain_boxes(frame[None])[0]
    first, last = _clip(film, np.concatenate([frame[:2] - margin, frame[2:] + margin], axis=1))
    kept = np.flatnonzero(exists & (last > first))
    first, last, film, ends, whole = (x[kept] for x in (first, last, film, ends, whole))
    count = np.ceil(_length(film[:, 1] - film[:, 0]) * (last - first) / _PIECE)
    index, j, count = _pieces(np.maximum(count, 1.0).astype(np.int64))
    s = first[index, None] + (last - first)[index, None] * np.stack([j, j + 1], axis=1) / count[:, None]
    # Film fraction to fraction of the line in front, then of the whole line.
    z = ends[index][..., 2]
    inside = s * z[:, :1] / ((1.0 - s) * z[:, 1:] + s * z[:, :1])
    along = (whole[:, 1] - whole[:, 0])[index]
    squared = np.sum(along**2, axis=1, keepdims=True)
    reach = np.einsum("nek,nk->ne", (ends - whole[:, :1])[index], along) / np.maximum(
        squared, np.finfo(float).tiny
    )
    fraction = reach[:, :1] + inside * (reach[:, 1:] - reach[:, :1])
    span = lines.span[kept][index]
    return lines.part(kept[index], span[:, :1] + fraction * (span[:, 1:] - span[:, :1]))


def _cut_bows(bows: Curves, camera: Camera, frame: Floats) -> Curves:
    """Depth along a conic is C + U cos t + V sin t, which says where it is in front."""
    n = len(bows)
    if not n:
        return bows
    centre = np.zeros((n, 3))
    right, up, left = (bows.bows(np.full(n, t), centre)[0][:, 2] for t in (0.0, np.pi / 2.0, np.pi))
    middle = 0.5 * (right + left)
    cosine, sine = right - middle, up - middle
    amplitude = np.maximum(np.hypot(cosine, sine), 1e-12 * np.abs(middle) + np.finfo(float).tiny)
    half = np.arccos(np.clip((camera.near - middle) / amplitude, -1.0, 1.0))
    nearest = np.arctan2(sine, cosine)
    exists = bows.bows(nearest, centre)[3] & (half > 0.0)
    bows = replace(bows, span=np.stack([nearest - half, nearest + half], axis=1)).part(np.flatnonzero(exists))
    trial = _divide(bows, np.full(len(bows), 64))
    box, length = bounds(trial, camera)
    longest = np.where(_overlap(box, frame), length, 0.0).reshape(-1, 64).max(axis=1, initial=0.0)
    pieces = _divide(bows, np.clip(np.ceil(64.0 * longest / _BOW_PIECE), 16.0, 4096.0).astype(np.int64))
    found: list[Curves] = []
    for _ in range(_HALVINGS):
        box, length = bounds(pieces, camera)
        held, long = _overlap(box, frame), length > 2.0 * _BOW_PIECE
        found.append(pieces.part(np.flatnonzero(held & ~long)))
        # Those that run to the near plane, whose rectangle is the whole film and far more.
        rest = np.flatnonzero(held & long)
        pieces = _divide(pieces.part(rest), np.full(len(rest), 2))
        if not len(rest):
            break
    return Curves.join([*found, pieces])


def _divide(curves: Curves, count: Ints) -> Curves:
    index, j, count = _pieces(count)
    low, high = curves.span[index].T
    return curves.part(
        index, low[:, None] + (high - low)[:, None] * np.stack([j, j + 1], axis=1) / count[:, None]
    )


def _pieces(count: Ints) -> tuple[Ints, Ints, Ints]:
    """Which curve each piece belongs to, its number there, and how many there are."""
    index = np.repeat(np.arange(len(count)), count)
    return index, np.arange(len(index)) - (np.cumsum(count) - count)[index], count[index]


def _overlap(box: Floats, frame: Floats) -> Bools:
    return np.asarray(((box[:, :2] <= frame[2:]) & (box[:, 2:] >= frame[:2])).all(axis=1))
