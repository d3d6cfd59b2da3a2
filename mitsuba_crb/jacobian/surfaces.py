"""What a scene's shapes contribute to contours: one edge table of all meshes, curves of smooth shapes.

Meshes are read through the shape interface, which `rectangle` and `cube` share. The edge table depends on the
geometry alone, so it is cached by its content: moving the camera, or changing and restoring vertices, never
meets a stale table. Spheres, cylinders and disks are given by their `to_world`; every other kind of shape
(curves, signed distance fields, ellipsoids) has no contours here, and neither has a sphere or cylinder that
is scaled unevenly, which Mitsuba itself warns of (`unfollowed`). Instances are their group's shapes, moved;
Mitsuba lists the groups that stand in the scene itself, and an instance tells the name of its own.
"""

from __future__ import annotations

import functools
import hashlib
import re
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..errors import SceneError
from ..render.scene import contents
from .curves import CIRCLE, RIM, TANGENT, Curves
from .edges import EdgeTable

if TYPE_CHECKING:
    import mitsuba as mi

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


_SMOOTH = ("Sphere", "Cylinder", "Disk")
_MOST = 1 << 22
"""Faces of instances, of which each takes as much memory as a mesh's; further ones have no contours."""


@dataclass(frozen=True, eq=False)
class _Meshes:
    """All meshes of a scene; equal where their bits are."""

    vertices: list[NDArray[np.float32]]
    """(V, 3) of each, world positions [scene unit]."""
    faces: list[NDArray[np.uint32]]
    """(F, 3) of each, by its own vertices."""
    digest: bytes

    def __hash__(self) -> int:
        return hash(self.digest)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Meshes) and self.digest == other.digest


@dataclass(frozen=True)
class Surface:
    """A shape where it stands."""

    shape: mi.Shape
    key: int
    """By which a hit tells it: `surface_key` of the instance, 0 for none, and the shape."""
    to_world: Floats | None
    """4x4, of its instance; None of a shape that is none's."""


def surfaces(scene: mi.Scene) -> list[Surface]:
    """All shapes of a scene, those of groups once per instance; instances of groups that are not known."""
    groups = _groups(scene) if has_instances(scene) else {}
    found, budget = [], _MOST
    for shape in scene.shapes():
        children = groups.get(_group_name(shape), []) if shape.class_name() == "Instance" else []
        budget -= sum(child.face_count() for child in children if child.is_mesh())
        if not children or budget < 0:
            found.append(Surface(shape, surface_key(0, _number(shape)), None))
            continue
        world = _to_world(shape)
        found += [Surface(child, surface_key(_number(shape), _number(child)), world) for child in children]
    return found


def has_instances(scene: mi.Scene) -> bool:
    """Whether a scene shows shapes that its list of shapes does not hold."""
    return any(shape.class_name() == "Instance" for shape in scene.shapes())


def surface_key(instance: Any, shape: Any) -> Any:
    """One number of Dr.Jit's two."""
    return (instance << 32) | shape


def edge_table(scene: mi.Scene) -> EdgeTable:
    """The edges of all meshes of a scene; made once per geometry, whatever the pose.

    Raises:
        SceneError: a mesh whose faces refer to vertices that it does not have.
    """
    vertices, faces = [], []
    digest = hashlib.blake2b()
    for surface in surfaces(scene):
        shape = surface.shape
        if shape.is_mesh():
            own = np.array(shape.vertex_positions_buffer(), dtype=np.float32).reshape(-1, 3)
            index = np.array(shape.faces_buffer(), dtype=np.uint32).reshape(-1, 3)
            if index.max(initial=0) >= len(own):
                raise SceneError(
                    f"mesh {shape.id()} has {len(own)} vertices and a face with vertex "
                    f"{index.max()}, counted from 0; export it again"
                )
            if surface.to_world is not None:
                own = (own @ surface.to_world[:3, :3].T + surface.to_world[:3, 3]).astype(np.float32)
            vertices.append(own)
            faces.append(index)
            for part in (own.data, b"|", index.data, b"|"):
                digest.update(part)
    return _edge_table(_Meshes(vertices, faces, digest.digest()))


@functools.lru_cache(maxsize=2)
def _edge_table(meshes: _Meshes) -> EdgeTable:
    starts = np.cumsum([0, *(len(own) for own in meshes.vertices)])
    faces = [index.astype(np.int64) + start for index, start in zip(meshes.faces, starts, strict=False)]
    table = EdgeTable.of(
        np.concatenate([np.empty((0, 3), np.float32), *meshes.vertices]),
        np.concatenate([np.empty((0, 3), np.int64), *faces]),
    )
    for stored in vars(table).values():
        if isinstance(stored, np.ndarray):
            stored.flags.writeable = False
    return table


def first_faces(scene: mi.Scene) -> tuple[Ints, Ints]:
    """Keys of all meshes, ascending, and the first face of each in the edge table."""
    meshes = [surface for surface in surfaces(scene) if surface.shape.is_mesh()]
    key = np.array([mesh.key for mesh in meshes], dtype=np.int64)
    count = np.array([mesh.shape.face_count() for mesh in meshes], dtype=np.int64)
    order = np.argsort(key, kind="stable")
    return key[order], (np.cumsum(count) - count)[order]


def smooth_curves(scene: mi.Scene, camera_from_world: Floats) -> list[Curves]:
    """Curves of spheres, cylinders and disks that may be contours, in the camera frame."""
    found: dict[str, list[Floats]] = {name: [] for name in _SMOOTH}
    keys: dict[str, list[int]] = {name: [] for name in _SMOOTH}
    for surface in surfaces(scene):
        if _is_smooth(surface):
            found[surface.shape.class_name()].append(camera_from_world @ _place(surface))
            keys[surface.shape.class_name()].append(surface.key)
    sphere, cylinder, disk = (np.array(m).reshape(-1, 4, 4) for m in found.values())
    spheres, cylinders, disks = (np.array(n, dtype=np.int64) for n in keys.values())
    base, x, y, axis = (cylinder[:, :3, j] for j in (3, 0, 1, 2))
    return [
        Curves.of(CIRCLE, sphere[:, :3, 3], sphere[:, :3, 0], surface=spheres),
        *(Curves.of(TANGENT, base, axis, x, np.full(len(base), sign), surface=cylinders) for sign in (1, -1)),
        Curves.of(RIM, base, x, y, inward=axis, surface=cylinders),
        Curves.of(RIM, base + axis, x, y, inward=-axis, surface=cylinders),
        Curves.of(RIM, disk[:, :3, 3], disk[:, :3, 0], disk[:, :3, 1], surface=disks),
    ]


def has_contours(surface: Surface) -> bool:
    """Whether a shape's contours are known here."""
    return bool(surface.shape.is_mesh() or _is_smooth(surface))


def _number(shape: mi.Shape) -> int:
    """Dr.Jit's, by which a hit tells its shape."""
    import mitsuba as mi

    return int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0])


def _groups(scene: mi.Scene) -> dict[str, list[mi.Shape]]:
    """The shapes of each group that the scene lists, by the group's name; of no name that two have."""
    import mitsuba as mi

    nodes = [node for node in contents(scene) if node.class_name() == "ShapeGroupPlugin"]
    names = Counter(node.id() for node in nodes)
    shapes = {
        node.id(): [part for part in contents(node) if isinstance(part, mi.Shape) and part is not node]
        for node in nodes
    }
    return {name: parts for name, parts in shapes.items() if names[name] == 1}


def _group_name(instance: mi.Shape) -> str:
    """What an instance says of its group; nothing else that Python reaches does."""
    found = re.search(r'shapegroup = ShapeGroup\[\s*name = "([^"]*)"', str(instance))
    return found.group(1) if found else ""


def _is_smooth(surface: Surface) -> bool:
    """Whether a shape is a disk, or a sphere or cylinder that is round."""
    name = surface.shape.class_name()
    if name not in _SMOOTH:
        return False
    linear = _place(surface)[:3, :3]
    gram = linear.T @ linear
    if name == "Cylinder":
        gram[2, 2] = gram[0, 0]
    even = np.abs(gram - gram[0, 0] * np.eye(3)).max() <= 1e-4 * gram[0, 0]
    return bool(even or name == "Disk")


def _place(surface: Surface) -> Floats:
    own = _to_world(surface.shape)
    return own if surface.to_world is None else surface.to_world @ own


def _to_world(shape: mi.Shape) -> Floats:
    import mitsuba as mi

    return np.array(mi.traverse(shape)["to_world"].matrix, dtype=np.float64).reshape(4, 4, -1)[..., 0]
