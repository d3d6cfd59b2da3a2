"""What a scene's shapes contribute to contours: one edge table of all meshes, curves of smooth shapes.

Meshes are read through the shape interface, which `rectangle` and `cube` share. The edge table depends on the
geometry alone, so it is cached by its content: moving the camera, or changing and restoring vertices, never
meets a stale table. Spheres, cylinders and disks are given by their `to_world`; every other kind of shape
(instances, curves, signed distance fields, ellipsoids) has no contours here and is named.
"""

from __future__ import annotations

import functools
import hashlib
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from .curves import CIRCLE, RIM, TANGENT, Curves
from .edges import EdgeTable

if TYPE_CHECKING:
    import mitsuba as mi

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class _Meshes:
    """All meshes of a scene as one; equal where their bits are."""

    vertices: NDArray[np.float32]
    """(V, 3) world positions [scene unit]."""
    faces: Ints
    """(F, 3)"""
    digest: bytes

    def __hash__(self) -> int:
        return hash(self.digest)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Meshes) and self.digest == other.digest


def edge_table(scene: mi.Scene) -> EdgeTable:
    """The edges of all meshes of a scene; made once per geometry, whatever the pose."""
    vertices, faces, count = [np.empty((0, 3), np.float32)], [np.empty((0, 3), np.int64)], 0
    digest = hashlib.blake2b()
    for shape in scene.shapes():
        if shape.is_mesh():
            vertices.append(np.array(shape.vertex_positions_buffer(), dtype=np.float32).reshape(-1, 3))
            index = np.array(shape.faces_buffer(), dtype=np.uint32).reshape(-1, 3)
            digest.update(vertices[-1].tobytes() + b"|" + index.tobytes() + b"|")
            faces.append(index.astype(np.int64) + count)
            count += len(vertices[-1])
    return _edge_table(_Meshes(np.concatenate(vertices), np.concatenate(faces), digest.digest()))


@functools.lru_cache(maxsize=2)
def _edge_table(meshes: _Meshes) -> EdgeTable:
    return EdgeTable.of(meshes.vertices, meshes.faces)


def first_faces(scene: mi.Scene) -> Ints:
    """Each shape's first face in the edge table, by Dr.Jit's number of the shape; −1 if it is no mesh."""
    import mitsuba as mi

    number = [int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0]) for shape in scene.shapes()]
    first, count = np.full(max(number, default=0) + 1, -1), 0
    for i, shape in zip(number, scene.shapes(), strict=True):
        if shape.is_mesh():
            first[i] = count
            count += shape.face_count()
    return first


def smooth_curves(scene: mi.Scene, camera_from_world: Floats) -> list[Curves]:
    """Curves of spheres, cylinders and disks that may be contours, in the camera frame."""
    import mitsuba as mi

    found: dict[str, list[Floats]] = {"Sphere": [], "Cylinder": [], "Disk": []}
    for shape in scene.shapes():
        if shape.class_name() in found:
            to_world = np.array(mi.traverse(shape)["to_world"].matrix, dtype=np.float64).reshape(4, 4, -1)
            found[shape.class_name()].append(camera_from_world @ to_world[..., 0])
    sphere, cylinder, disk = (np.array(m).reshape(-1, 4, 4) for m in found.values())
    base, x, y, axis = (cylinder[:, :3, j] for j in (3, 0, 1, 2))
    return [
        Curves.of(CIRCLE, sphere[:, :3, 3], sphere[:, :3, 0]),
        *(Curves.of(TANGENT, base, axis, x, np.full(len(base), sign)) for sign in (1, -1)),
        Curves.of(RIM, base, x, y, inward=axis),
        Curves.of(RIM, base + axis, x, y, inward=-axis),
        Curves.of(RIM, disk[:, :3, 3], disk[:, :3, 0], disk[:, :3, 1]),
    ]


def without_contours(scene: mi.Scene) -> list[str]:
    """Names and numbers of the shapes whose contours are not known, as "2 x Instance"."""
    smooth = ("Sphere", "Cylinder", "Disk")
    names = [s.class_name() for s in scene.shapes() if not s.is_mesh() and s.class_name() not in smooth]
    return [f"{n} x {name}" for name, n in sorted(Counter(names).items())]
