"""All edges of all meshes of a scene, and which of them a camera can see as contours.

An edge is a contour from the camera centre c if all faces around it lie on the same side of the plane through
c and the edge: it is open, or the surface folds there. Which side a face lies on follows from the side of its
own plane that c stands on, so neither winding nor closedness matters. Vertices are welded by position: split
vertices would otherwise make every seam an open edge. NumPy, float64. Source: design section 4.1.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_DEGENERATE = 1e-10
"""Height over length below which a face has no area: far below what float32 positions resolve."""


@dataclass(frozen=True)
class EdgeTable:
    """All edges of all meshes of a scene, whatever the camera."""

    ends: Floats
    """(E, 2, 3) end points, in the world [scene unit]."""
    first: Ints
    """(E + 1,) where each edge's half-edges start; an edge has one half-edge per face around it."""
    half_face: Ints
    """(H,) face of each half-edge."""
    half_sign: NDArray[np.int8]
    """(H,) +1 where the face lists the edge from `ends[:, 0]` to `ends[:, 1]`, −1 otherwise."""
    normals: Floats
    """(F, 3) face normals, of length twice the area [scene unit²]."""
    points: Floats
    """(F, 3) a vertex of each face [scene unit]."""
    corners: Ints
    """(faces given, 3) the welded vertices of each face."""
    face: Ints
    """(F,) each face, as numbered when given."""
    face_edges: Ints
    """(faces given, 3) the edges of each face, −1 of those left out."""
    dropped: int
    """Faces left out: without area, or not finite."""

    @staticmethod
    def of(vertices: NDArray[np.float32], faces: Ints) -> EdgeTable:
        """Weld vertices of equal position, drop faces without area, and gather the faces around each edge.

        Args:
            vertices: (V, 3) positions of all meshes in the world [scene unit].
            faces: (F, 3) their vertices.
        """
        weld, positions = _weld(vertices)
        corners = weld[faces]
        first, second, third = (positions[corners[:, k]] for k in range(3))
        with np.errstate(invalid="ignore", over="ignore"):
            along, across, beyond = second - first, third - first, third - second
            normals = _cross(along, across)
            longest = np.maximum(np.maximum(_squared(along), _squared(across)), _squared(beyond))
            # Of a face that is not finite one side is no number, and not more than anything.
            kept = np.sqrt(_squared(normals)) > _DEGENERATE * longest
        face = np.flatnonzero(kept)
        start = corners[face]
        end = start[:, [1, 2, 0]].ravel()
        start = start.ravel()
        low, high = np.minimum(start, end), np.maximum(start, end)
        order, begins = _grouped(low * len(positions) + high, len(positions) ** 2)
        count = np.diff(begins)
        edges = np.empty(len(order), dtype=np.int64)
        edges[order] = np.repeat(np.arange(len(count)), count)
        face_edges = np.full((len(faces), 3), -1)
        face_edges[face] = edges.reshape(-1, 3)
        named = order[begins[:-1]]
        return EdgeTable(
            ends=positions[np.stack([low[named], high[named]], axis=1)],
            first=begins,
            half_face=order // 3,
            half_sign=np.where(start < end, 1, -1).astype(np.int8)[order],
            normals=normals[face],
            points=first[face],
            corners=corners,
            face=face,
            face_edges=face_edges,
            dropped=len(faces) - len(face),
        )

    def sides(self, edges: Ints, centre: Floats) -> NDArray[np.int8]:
        """On which side of the plane through camera and edge the faces around it lie.

        The sign is that of det(e₀ − c, e₁ − c, o − c), o the face's third vertex, which is the side of the
        face's own plane that the camera c stands on: one sign per face, so the three edges of a face agree
        however nearly edge-on it is.

        Args:
            edges: (n,) indices.
            centre: (n, 3) a camera centre for each, in the world.

        Returns:
            (n,) +1 or −1 if all faces lie on that side; 0 if on both, so that the edge is no contour.
        """
        low = np.full(len(edges), 1, dtype=np.int8)
        high = np.full(len(edges), -1, dtype=np.int8)
        for has, half in self._around(edges):
            face, sign = self.half_face.take(half), self.half_sign.take(half)
            to_face = self.points.take(face, axis=0) - centre.take(has, axis=0)
            height = np.einsum("ij,ij->i", self.normals.take(face, axis=0), to_face)
            sign = np.where(height >= 0.0, sign, -sign)
            low[has], high[has] = np.minimum(low[has], sign), np.maximum(high[has], sign)
        return np.where(low == high, low, np.int8(0))

    def around(self, edges: Ints, hit: Ints) -> NDArray[np.bool_]:
        """Which edges (n,) belong to the face (n,), as numbered when given; −1 for none."""
        own = (self.face_edges[np.maximum(hit, 0)] == edges[:, None]).any(axis=1)
        return np.asarray(own & (hit >= 0))

    def next_to(self, edges: Ints, hit: Ints) -> NDArray[np.bool_]:
        """Which edges (n,) belong to a face that shares a vertex with another (n,), as numbered when given.

        Args:
            hit: −1 for none.
        """
        near, seen = np.zeros(len(edges), dtype=bool), self.corners[np.maximum(hit, 0)]
        for has, half in self._around(edges):
            own = self.corners[self.face[self.half_face[half]]]
            near[has] |= (own[:, :, None] == seen[has][:, None]).any(axis=(1, 2))
        return near & (hit >= 0)

    def nearest(self, edges: Ints, centre: Floats, direction: Floats) -> Floats:
        """Largest inverse depth (n,) at which rays meet the planes of the faces around edges.

        Args:
            edges: (n,) indices.
            centre: (n, 3) where the rays start, in the world.
            direction: (n, 3) of length one along the optical axis.
        """
        largest = np.full(len(edges), -np.inf)
        for has, half in self._around(edges):
            face = self.half_face[half]
            height = np.einsum("ij,ij->i", self.normals[face], self.points[face] - centre[has])
            along = np.einsum("ij,ij->i", self.normals[face], direction[has])
            with np.errstate(divide="ignore", invalid="ignore"):
                largest[has] = np.fmax(largest[has], along / height)
        return largest

    def _around(self, edges: Ints) -> Iterator[tuple[Ints, Ints]]:
        """Which edges have a first half-edge, a second, and so on, and which that is."""
        start = self.first[edges]
        count = self.first[edges + 1] - start
        for j in range(int(count.max(initial=0))):
            has = np.flatnonzero(count > j)
            yield has, start[has] + j

    def repeats(
        self, edges: Ints, hit: Ints, points: Floats, tolerance: Floats, centre: Floats
    ) -> NDArray[np.bool_]:
        """Which points of edges another contour stands for, that of the face that is seen there.

        Where two surfaces meet without sharing vertices (a box of six rectangles, a long edge along two short
        ones, bars that run into each other), both have the edge, and the contour would count twice.

        Args:
            edges: (n,) indices.
            hit: (n,) the face seen beside each point, as numbered when given, none of the edge's own; −1 for
                none.
            points: (n, 3) in the world.
            tolerance: (n,) distance within which edges coincide [scene unit].
            centre: (n, 3) a camera centre for each, in the world.
        """
        open_edge = self.first[edges + 1] - self.first[edges] == 1
        other = np.where((hit >= 0) & (open_edge | ~self.next_to(edges, hit)), hit, -1)
        repeated = np.zeros(len(edges), dtype=bool)
        for j in range(3):
            has = np.flatnonzero(other >= 0)
            edge = self.face_edges[other[has], j]
            contour = (edge >= 0) & (self.sides(edge, centre[has]) != 0)
            has, edge = has[contour], edge[contour]
            ends = self.ends[edge]
            along, to_point = ends[:, 1] - ends[:, 0], points[has] - ends[:, 0]
            s = np.einsum("ij,ij->i", to_point, along) / np.einsum("ij,ij->i", along, along)
            distance = np.linalg.norm(to_point - s[:, None] * along, axis=1)
            repeated[has] |= (s > 0.0) & (s < 1.0) & (distance < tolerance[has])
        return repeated

    def candidates(self, centre: Floats, axis: Floats, lens_radius: float) -> Ints:
        """Edges that are a contour from some point of a lens; of a pinhole's (radius 0): its contours.

        Args:
            centre: (3,) the lens' centre in the world.
            axis: (3,) the optical axis in the world.
        """
        height = np.einsum("ij,ij->i", self.normals, self.points - centre)
        sign = np.where(height >= 0.0, 1, -1).astype(np.int8)
        if lens_radius > 0.0:
            across = self.normals - np.outer(self.normals @ axis, axis)
            reach = lens_radius * np.linalg.norm(across, axis=1)
            sign[np.abs(height) < reach] = 0  # either side, depending on the lens point
        half = sign[self.half_face] * self.half_sign
        if not len(half):
            return np.empty(0, dtype=np.int64)
        both = half[self.first[:-1]] * half[self.first[1:] - 1] < 0
        many = np.flatnonzero(np.diff(self.first) > 2)
        low, high = half[self.first[many]], half[self.first[many]]
        for has, beside in self._around(many):
            low[has], high[has] = np.minimum(low[has], half[beside]), np.maximum(high[has], half[beside])
        both[many] = (low < 0) & (high > 0)
        return np.flatnonzero(~both)


def _weld(vertices: NDArray[np.float32]) -> tuple[Ints, Floats]:
    """One index per distinct position (exact), and the positions."""
    if not len(vertices):
        return np.empty(0, dtype=np.int64), np.empty((0, 3))
    bits = np.ascontiguousarray(vertices + np.float32(0.0)).view(np.uint32).astype(np.uint64)  # −0 is 0
    _, column = np.unique(bits[:, 0] << np.uint64(32) | bits[:, 1], return_inverse=True)
    _, index, weld = np.unique(
        column.astype(np.uint64) << np.uint64(32) | bits[:, 2], return_index=True, return_inverse=True
    )
    return weld.astype(np.int64), vertices[index].astype(np.float64)


def _grouped(key: Ints, most: int) -> tuple[Ints, Ints]:
    """The order that sorts keys below `most`, equal ones as they come, and where each key's begin (and end).

    Where both fit into 63 bits, key and place are sorted as one number, which takes a third of the time.
    """
    bits = len(key).bit_length()
    if most << bits < 1 << 63:
        packed = (key << bits) | np.arange(len(key))
        packed.sort()
        order, found = packed & ((1 << bits) - 1), packed >> bits
    else:
        order = np.argsort(key, kind="stable")
        found = key[order]
    return order, np.append(np.flatnonzero(np.diff(found, prepend=-1)), len(key))


def _cross(a: Floats, b: Floats) -> Floats:
    """a × b, row by row, in a third of NumPy's time."""
    product = np.empty_like(a)
    for i in range(3):
        np.subtract(a[:, i - 2] * b[:, i - 1], a[:, i - 1] * b[:, i - 2], out=product[:, i])
    return product


def _squared(vectors: Floats) -> Floats:
    return np.asarray(np.einsum("ij,ij->i", vectors, vectors))
