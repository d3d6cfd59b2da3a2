"""Triangle meshes of the scenes [m, z up], and their binary PLY files."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from patterns import Array

Range = tuple[float, float]


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh.

    Attributes:
        vertices: (n, 3).
        faces: (m, 3), outward.
        uv: (n, 2), or None.
    """

    vertices: Array
    faces: Array
    uv: Array | None = None

    def ply(self) -> bytes:
        """The mesh as a binary little-endian PLY file, float32."""
        columns = "xyz" if self.uv is None else "xyzuv"
        values = self.vertices if self.uv is None else np.hstack([self.vertices, self.uv])
        head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(values)}"]
        head += [f"property float {column}" for column in columns]
        head += [f"element face {len(self.faces)}", "property list uchar int vertex_indices", "end_header"]
        rows = np.zeros(len(self.faces), [("n", "u1"), ("v", "<i4", 3)])
        rows["n"], rows["v"] = 3, self.faces
        values = np.round(values, 6)  # a micrometre: the last bit of a sine must not change the file
        return ("\n".join(head) + "\n").encode() + values.astype("<f4").tobytes() + rows.tobytes()


def merge(parts: Sequence[Mesh]) -> Mesh:
    """One mesh of several."""
    start = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    return Mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + first for part, first in zip(parts, start, strict=True)]),
        None if parts[0].uv is None else np.concatenate([part.uv for part in parts if part.uv is not None]),
    )


def cube(*, shared: bool) -> Mesh:
    """Cube with corners at ±1: 8 vertices, or 24 that split at the edges."""
    corner = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    quad = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    if not shared:
        corner, quad = corner[quad.ravel()], np.arange(24).reshape(6, 4)
    return Mesh(corner, np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]))


def block(x: Range, y: Range, z: Range, *, radius: float = 0.0, steps: int = 3) -> Mesh:
    """Cuboid with rounded edges; texture coordinates in metres, the first along each face's longer side."""
    low, high = np.array([x, y, z], float).T
    arc = radius * np.tan(np.linspace(np.pi / 4, 0, steps + 1)[:-1]) if radius else np.zeros(0)
    faces, vertices, uvs = [], [], []
    for axis in range(3):
        across = sorted({0, 1, 2} - {axis}, key=lambda other: low[other] - high[other])
        nodes = [
            np.concatenate(
                [low[a] + radius - arc, [low[a] + radius, high[a] - radius], high[a] - radius + arc[::-1]]
            )
            for a in across
        ]
        for side in (low, high):
            point = np.empty((len(nodes[0]), len(nodes[1]), 3))
            point[..., across[0]], point[..., across[1]] = np.meshgrid(*nodes, indexing="ij")
            point[..., axis] = side[axis]
            core = np.clip(point, low + radius, high - radius)
            offset = point - core
            uvs.append(point[..., across].reshape(-1, 2))
            if radius:
                point = core + radius * offset / np.linalg.norm(offset, axis=-1, keepdims=True)
            index = np.arange(len(nodes[0]) * len(nodes[1])).reshape(len(nodes[0]), -1) + sum(
                map(len, vertices)
            )
            a, b, c, d = (q.ravel() for q in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
            triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
            even = (across[1] - across[0]) % 3 == 1
            outward = even == (side is high)
            faces.append(triangles if outward else triangles[:, ::-1])
            vertices.append(point.reshape(-1, 3))
    return Mesh(np.concatenate(vertices), np.concatenate(faces), np.concatenate(uvs))


def moved(mesh: Mesh, to: tuple[float, float, float], *, turn: float = 0.0, tilt: float = 0.0) -> Mesh:
    """The mesh tilted about the x axis, then turned about the z axis [degrees], then translated [m]."""
    a, t = math.radians(turn), math.radians(tilt)
    yaw = np.array([[math.cos(a), -math.sin(a), 0], [math.sin(a), math.cos(a), 0], [0, 0, 1]])
    pitch = np.array([[1, 0, 0], [0, math.cos(t), -math.sin(t)], [0, math.sin(t), math.cos(t)]])
    return Mesh(mesh.vertices @ (yaw @ pitch).T + np.array(to), mesh.faces, mesh.uv)


def lathe(profile: Sequence[tuple[float, float]], *, segments: int = 40) -> Mesh:
    """Surface of revolution about z of a profile (radius, height), outward if the profile runs upwards."""
    radius, height = np.array(profile).T
    angle = 2 * np.pi * np.arange(segments) / segments
    vertices = np.stack(
        [radius[:, None] * np.cos(angle), radius[:, None] * np.sin(angle), height[:, None] + 0 * angle],
        axis=-1,
    )
    index = np.arange(vertices.size // 3).reshape(len(profile), segments)
    right = np.roll(index, -1, axis=1)
    a, b, c, d = index[:-1].ravel(), right[:-1].ravel(), right[1:].ravel(), index[1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    corner = vertices.reshape(-1, 3)[faces]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    return Mesh(vertices.reshape(-1, 3), faces[area > 1e-12])


def frond() -> Mesh:
    """A flat palm frond in the plane z = 0, about 2 long, from the origin along y: midrib and leaflets."""
    vertices: list[Array] = []
    faces: list[list[int]] = []

    def polygon(*points: Array) -> None:
        faces.extend(
            [len(vertices), len(vertices) + i, len(vertices) + i + 1] for i in range(1, len(points) - 1)
        )
        vertices.extend(points)

    def midrib(t: float) -> Array:
        return np.array([0.35 * t**2, 2 * t - 0.25 * t**3, 0.0])

    def along(t: float) -> Array:
        direction = np.array([0.7 * t, 2 - 0.75 * t**2, 0.0])
        return direction / np.linalg.norm(direction)

    def right_of(direction: Array) -> Array:
        return np.array([direction[1], -direction[0], 0.0])

    for t0, t1 in pairwise(np.linspace(0, 1, 13)):
        side0, side1 = (right_of(along(t)) * 0.02 * (1 - 0.8 * t) for t in (t0, t1))
        polygon(midrib(t0) - side0, midrib(t0) + side0, midrib(t1) + side1, midrib(t1) - side1)
    for i, t in enumerate(np.linspace(0.18, 0.98, 15)):
        for side in (-1, 1):
            length = 0.75 * math.sin(math.pi * (0.2 + 0.72 * t)) * (1 + 0.12 * math.sin(2.3 * i + side))
            turn = side * math.radians(62 - 30 * t + 5 * math.sin(1.7 * i))
            axis = math.cos(turn) * along(t) + math.sin(turn) * right_of(along(t))
            middle, across = midrib(t) + 0.35 * length * axis, 0.045 * right_of(axis)
            polygon(midrib(t), middle + across, midrib(t) + length * axis, middle - across)
    return Mesh(np.array(vertices), np.array(faces))


def palm() -> Mesh:
    """Fronds that grow out of the origin, arch outwards and droop; z up."""
    single = frond()
    parts = []
    for i in range(12):
        size = 0.60 - 0.02 * (i % 4)
        azimuth, rise, bend = 2.4 * i, math.radians(86 - 3.2 * i), math.radians(70 + 4 * i)
        along = single.vertices[:, 1] / 1.75
        out = (math.sin(rise) - np.sin(rise - bend * along)) / bend * 1.75 * size
        up = (np.cos(rise - bend * along) - math.cos(rise)) / bend * 1.75 * size
        aside = size * (single.vertices[:, 0] - 0.35 * along**2)
        vertices = np.stack(
            [
                out * math.cos(azimuth) - aside * math.sin(azimuth),
                out * math.sin(azimuth) + aside * math.cos(azimuth),
                up,
            ],
            axis=1,
        )
        parts.append(Mesh(vertices, single.faces, np.stack([along, aside], axis=1)))
    return merge(parts)


def sofa() -> Mesh:
    """Base, back, arms, two seats and two back cushions; the front at y = 0, facing -y."""
    rest = block((-0.46, 0.46), (-0.09, 0.09), (0.0, 0.42), radius=0.06)
    return merge(
        [
            block((-1.0, 1.0), (0.06, 0.90), (0.08, 0.30), radius=0.03),
            block((-1.0, 1.0), (0.70, 0.92), (0.10, 0.78), radius=0.06),
            block((-1.16, -0.94), (0.0, 0.92), (0.08, 0.58), radius=0.06),
            block((0.94, 1.16), (0.0, 0.92), (0.08, 0.58), radius=0.06),
            block((-0.935, -0.005), (0.02, 0.72), (0.29, 0.45), radius=0.04),
            block((0.005, 0.935), (0.02, 0.72), (0.29, 0.45), radius=0.04),
            moved(rest, (-0.47, 0.58, 0.44), tilt=-12),
            moved(rest, (0.47, 0.58, 0.44), tilt=-12),
        ]
    )


def cushions() -> Mesh:
    """Two loose cushions for the sofa."""
    loose = block((-0.21, 0.21), (-0.06, 0.06), (0.0, 0.40), radius=0.055)
    return merge(
        [
            moved(loose, (-0.66, 0.36, 0.45), turn=16, tilt=-20),
            moved(loose, (0.64, 0.36, 0.45), turn=-22, tilt=-22),
        ]
    )


def table() -> Mesh:
    """Coffee table, 1.1 m x 0.6 m, 0.42 m high, with a shelf."""
    legs = [
        block((x - 0.025, x + 0.025), (y - 0.025, y + 0.025), (0.0, 0.385))
        for x in (-0.5, 0.5)
        for y in (-0.25, 0.25)
    ]
    top = block((-0.55, 0.55), (-0.30, 0.30), (0.385, 0.42), radius=0.008)
    return merge([top, block((-0.474, 0.474), (-0.24, 0.24), (0.12, 0.14)), *legs])


SHELVES = (0.06, 0.44, 0.80, 1.14, 1.46)
"""Heights of the book case's boards [m]."""


def book_case() -> Mesh:
    """1 m wide, 0.28 m deep, 1.8 m high; its front at y = 0, facing -y."""
    sides = [block((x, x + 0.03), (0.0, 0.28), (0.0, 1.80)) for x in (-0.50, 0.47)]
    boards = [block((-0.47, 0.47), (0.005, 0.27), (z - 0.025, z)) for z in (*SHELVES, 1.80)]
    return merge([*sides, *boards, block((-0.47, 0.47), (0.27, 0.28), (0.035, 1.80))])


def books(*, spines: int = 32) -> Mesh:
    """Rows of books on the shelves; the texture holds the given number of spines side by side."""
    random = np.random.Generator(np.random.PCG64(201))
    parts = []
    for shelf in SHELVES:
        x, end = -0.455, 0.30 + 0.15 * random.random()
        while x < end:
            thick, tall, deep = 0.022 + 0.026 * random.random(), 0.19 + 0.07 * random.random(), 0.15
            gap = 0.07 if random.random() < 0.05 else 0.002
            front = 0.035 + 0.02 * random.random()
            book = block((x, x + thick), (front, front + deep), (shelf, shelf + tall))
            place = (book.vertices - [x, front, shelf]) / [thick, deep, tall]
            spine = len(parts) * 7 % spines
            uv = np.stack([(spine + 0.05 + 0.9 * place[:, 0]) / spines, 0.99 - 0.98 * place[:, 2]], axis=1)
            parts.append(Mesh(book.vertices, book.faces, uv))
            x += thick + gap
    return merge(parts)


def picture_frame() -> Mesh:
    """Frame around a picture of 1.2 m x 0.9 m in the plane y = 0, 3 cm deep towards -y."""
    w, h, t, y = 0.6, 0.45, 0.05, (-0.03, 0.0)
    upright = [block((x, x + t), y, (-h - t, h + t)) for x in (-w - t, w)]
    return merge([*upright, *(block((-w, w), y, (z, z + t)) for z in (-h - t, h))])


def skirting() -> Mesh:
    """Boards along the foot of the room's left, far and right walls."""
    return merge(
        [
            block((-2.4, -2.382), (-1.2, 3.8), (0.0, 0.10)),
            block((2.382, 2.4), (-1.2, 3.8), (0.0, 0.10)),
            block((-2.382, 2.382), (3.782, 3.8), (0.0, 0.10)),
        ]
    )


def pot() -> Mesh:
    """Plant pot, 0.36 m wide, 0.34 m high, with earth."""
    return lathe(
        [
            (0.0, 0.0),
            (0.12, 0.0),
            (0.17, 0.30),
            (0.18, 0.30),
            (0.18, 0.34),
            (0.155, 0.34),
            (0.15, 0.30),
            (0.0, 0.30),
        ]
    )
