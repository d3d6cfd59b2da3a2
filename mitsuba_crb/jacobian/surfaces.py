"""What a scene's shapes contribute to contours: one edge table of all meshes, curves of smooth shapes.

Meshes are read through the shape interface, which `rectangle` and `cube` share. The edge table depends on the
geometry alone, so it is cached by its content: moving the camera, or changing and restoring vertices, never
meets a stale table. Spheres, cylinders and disks are given by their `to_world`; every other kind of shape
(instances, curves, signed distance fields, ellipsoids) has no contours here and is named, and so is a sphere
or cylinder that is scaled unevenly, which Mitsuba itself warns of.
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

from ..errors import SceneError
from .curves import CIRCLE, RIM, TANGENT, Curves
from .edges import EdgeTable

if TYPE_CHECKING:
    import mitsuba as mi

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


_SMOOTH = ("Sphere", "Cylinder", "Disk")


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
    """The edges of all meshes of a scene; made once per geometry, whatever the pose.

    Raises:
        SceneError: a mesh whose faces refer to vertices that it does not have.
    """
    vertices, faces, count = [np.empty((0, 3), np.float32)], [np.empty((0, 3), np.int64)], 0
    digest = hashlib.blake2b()
    for shape in scene.shapes():
        if shape.is_mesh():
            vertices.append(np.array(shape.vertex_positions_buffer(), dtype=np.float32).reshape(-1, 3))
            index = np.array(shape.faces_buffer(), dtype=np.uint32).reshape(-1, 3)
            if index.max(initial=0) >= len(vertices[-1]):
                raise SceneError(
                    f"mesh {shape.id()} has {len(vertices[-1])} vertices and a face with vertex "
                    f"{index.max()}, counted from 0; export it again"
                )
            digest.update(vertices[-1].tobytes() + b"|" + index.tobytes() + b"|")
            faces.append(index.astype(np.int64) + count)
            count += len(vertices[-1])
    return _edge_table(_Meshes(np.concatenate(vertices), np.concatenate(faces), digest.digest()))


@functools.lru_cache(maxsize=2)
def _edge_table(meshes: _Meshes) -> EdgeTable:
    table = EdgeTable.of(meshes.vertices, meshes.faces)
    for stored in vars(table).values():
        if isinstance(stored, np.ndarray):
            stored.flags.writeable = False
    return table


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
    found: dict[str, list[Floats]] = {name: [] for name in _SMOOTH}
    for shape in scene.shapes():
        if _is_smooth(shape):
            found[shape.class_name()].append(camera_from_world @ _to_world(shape))
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
    unknown = [s for s in scene.shapes() if not s.is_mesh() and not _is_smooth(s)]
    names = [s.class_name() + (" (scaled unevenly)" if s.class_name() in _SMOOTH else "") for s in unknown]
    return [f"{n} x {name}" for name, n in sorted(Counter(names).items())]


def _is_smooth(shape: mi.Shape) -> bool:
    """Whether a shape is a disk, or a sphere or cylinder that is round."""
    if shape.class_name() not in _SMOOTH:
        return False
    gram = _to_world(shape)[:3, :3].T @ _to_world(shape)[:3, :3]
    if shape.class_name() == "Cylinder":
        gram[2, 2] = gram[0, 0]
    even = np.abs(gram - gram[0, 0] * np.eye(3)).max() <= 1e-4 * gram[0, 0]
    return bool(even or shape.class_name() == "Disk")


def _to_world(shape: mi.Shape) -> Floats:
    import mitsuba as mi

    return np.array(mi.traverse(shape)["to_world"].matrix, dtype=np.float64).reshape(4, 4, -1)[..., 0]
