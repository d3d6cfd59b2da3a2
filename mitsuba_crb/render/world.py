"""Worlds that no renderer wrote: GLB and glTF, OBJ, PLY and STL files as Mitsuba scenes.

Positions stay in the file's own coordinates and units (glTF: metres), so that poses mean what they say there.
`up` tells where the sky is and moves nothing. A file's cameras are the scene's sensors; without any there is
one that stands nowhere, until a pose is given. Light, besides the file's lamps and what shines in it:
`constant:L` from everywhere, `sky` (clear, the sun 45 degrees high in the direction of the axis after up), an
environment's `.exr` or `.hdr` file, or `none`. Or `baked`: no light at all, colours are radiance, as in
scans, whose photographs hold the light. Default: `baked` of files all of whose materials are unlit
(`KHR_materials_unlit`), `none` of those with lamps, `constant:1` of others.
"""

from __future__ import annotations

import dataclasses
import difflib
import os
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..datasets.gltf import read_gltf
from ..datasets.scans import read_scan
from ..datasets.textured_mesh import Lamp, PlacedCamera, TexturedMesh, World, merged
from ..errors import OptionError, SceneError, SceneWarning
from .backend import use_mitsuba
from .materials import ATTRIBUTE, Materials

if TYPE_CHECKING:
    import mitsuba as mi

_READERS = {".glb": read_gltf, ".gltf": read_gltf, ".obj": read_scan, ".ply": read_scan, ".stl": read_scan}
ENDINGS = tuple(_READERS)
"""Of the files that are worlds."""
OPTIONS = ("up", "light", "fov")
"""What may be said of a world, as of a scene file's `<default>`s."""
_AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1), "-x": (-1, 0, 0), "-y": (0, -1, 0), "-z": (0, 0, -1)}
_LIGHTS = ("constant", "sky", "baked", "none")
_IMAGES = (".exr", ".hdr")
FOV, _SIZE = 60.0, (640, 480)
"""Of a camera of which nothing is said: horizontal field of view [deg], pixels."""
_NEAR, _FAR = 1e-4, 1e2
"""Clip planes over the world's diagonal."""


def is_world(file: Path) -> bool:
    """Whether a file's ending is one of `ENDINGS`."""
    return file.suffix.lower() in _READERS


def load_world(
    path: str | os.PathLike[str],
    /,
    *,
    up: str | None = None,
    light: str | None = None,
    fov: float | None = None,
) -> dict[str, Any]:
    """A file of triangles as a Mitsuba dictionary, which everything here takes as a scene.

    More may be put into it, such as lamps or another sensor; `mi.load_dict` makes an `mi.Scene` of it. Meshes
    of one material are one, called by the material.

    Args:
        path: a .glb, .gltf, .obj, .ply or .stl file; the last three need trimesh (`mitsuba_crb[worlds]`).
        up: axis that is up: x, y, z, -x, -y or -z. Only a sky and an environment ask for it; glTF's is y.
        light: constant:L [radiance], sky, baked, none, or an environment's .exr or .hdr file.
        fov: horizontal field of view of the camera that stands in for one [deg]; default: 60.

    Raises:
        SceneError: the file cannot be read, is damaged, has no triangles, or lacks its textures.
        OptionError: an impossible axis, light or field of view.

    Warns:
        SceneWarning: what of the file is left out, and its light, if that is not said.
    """
    use_mitsuba()
    file = Path(path)
    world = _checked(file, _read(file))
    lit = any(not mesh.material.unlit for mesh in world.meshes)
    notes = list(world.notes)
    if light is None:
        light = "baked" if not lit else "none" if world.lamps else "constant:1"
        if light == "constant:1":
            notes.append(
                "its light is not said: radiance 1 from everywhere (--light constant:1), which leaves closed "
                "rooms dark; scans want baked"
            )
    if notes:
        warnings.warn(f"{file}: {'; '.join(dict.fromkeys(notes))}", SceneWarning, stacklevel=2)
    emitter = _emitter(light, file, up if up is not None else world.up)
    materials = Materials(unlit=light == "baked")
    # Paths from what shines itself end there.
    shines = all(materials.shines(mesh) for mesh in world.meshes)
    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path"} | ({"max_depth": 1} if shines else {}),
    }
    low, high = (
        np.array([bound(mesh.vertices, axis=0) for mesh in world.meshes]) for bound in (np.min, np.max)
    )
    diagonal = float(np.linalg.norm(high.max(axis=0) - low.min(axis=0)))
    for sensor in _sensors(world.cameras, fov, diagonal):
        name = _new(sensor["id"], scene)
        scene[name] = sensor | {"id": name}
    if emitter is not None:
        scene["light"] = emitter
    if light != "baked":
        scene |= {f"lamp {number}": _lamp(lamp) for number, lamp in enumerate(world.lamps)}
    for mesh in world.meshes:
        name = _new(mesh.name, scene)
        scene[name] = _shape(mesh, name, materials)
    return scene


def _read(file: Path) -> World:
    if file.is_dir():
        raise SceneError(f"{file} is a folder; name the file in it")
    if not file.exists():
        raise SceneError(f"no file at {file}")
    if not is_world(file):
        raise SceneError(f"{file} is no world: its name ends in none of {', '.join(ENDINGS)}")
    try:
        with file.open("rb") as opened:
            if not opened.read(1):
                raise SceneError(f"{file} is empty")
        return _READERS[file.suffix.lower()](file)
    except OSError as error:
        raise SceneError(f"{file} cannot be read: {error.strerror}") from error


def _checked(file: Path, world: World) -> World:
    """The world, its meshes with faces and numbers in all their vertices, those of one material as one."""
    meshes = [mesh for mesh in world.meshes if len(mesh.faces)]
    if not meshes:
        raise SceneError(
            f"{file} has no triangles, as a cloud of points or splats has none: make a mesh of it "
            "(Poisson reconstruction) first"
        )
    for mesh in meshes:
        if mesh.faces.max() >= len(mesh.vertices):
            raise SceneError(
                f"{file}: mesh {mesh.name} has {len(mesh.vertices)} vertices and a face with vertex "
                f"{mesh.faces.max()}, counted from 0; export it again"
            )
        bad = np.logical_not(np.isfinite(mesh.vertices).all(axis=1))
        if not bad.any():
            continue
        used = bad[mesh.faces].any(axis=1)
        if used.any():
            raise SceneError(
                f"{file}: mesh {mesh.name} has {np.count_nonzero(used)} faces whose vertices are "
                "not numbers; remove them"
            )
        mesh.vertices[bad] = mesh.vertices[mesh.faces[0, 0]]  # of no face, and still in the bounding box
    return dataclasses.replace(world, meshes=merged(meshes))


def _emitter(light: str, file: Path, up: str | None) -> dict[str, Any] | None:
    """Mitsuba's description of a light."""
    kind, _, value = light.partition(":")
    if light in ("baked", "none"):
        return None
    if kind == "constant":
        try:
            radiance = float(value or 1.0)
        except ValueError:
            radiance = -1.0
        if not 0.0 < radiance < np.inf:
            raise OptionError(
                f"--light {light}: expected constant:L with a radiance above 0, such as constant:1"
            )
        return {"type": "constant", "radiance": {"type": "rgb", "value": radiance}}
    if light == "sky":
        to_world = _from_z(_axis(up, file))
        sun = np.array(to_world.matrix)[:3, :3] @ [0.0, 1.0, 1.0]  # which Mitsuba takes in the world
        return {"type": "sunsky", "sun_direction": sun.tolist(), "to_world": to_world}
    if light.lower().endswith(_IMAGES):
        if not Path(light).is_file():
            raise OptionError(f"--light {light}: no such file")
        import mitsuba as mi

        # The map's own up is y.
        turned = mi.ScalarTransform4f().rotate([1, 0, 0], 90.0)
        return {"type": "envmap", "filename": light, "to_world": _from_z(_axis(up, file)) @ turned}
    near = difflib.get_close_matches(kind, _LIGHTS, n=1)
    meant = (
        f"did you mean {near[0]}?" if near else "expected constant:L, sky, baked, none or a file (.exr, .hdr)"
    )
    raise OptionError(f"--light {light} is not known: {meant}")


def _axis(up: str | None, file: Path) -> str:
    if up is None:
        raise OptionError(
            f"{file} does not say which axis is up, and this light asks: --up z (up='z') or another"
        )
    if up not in _AXES:
        raise OptionError(f"--up {up} is no axis; expected one of {', '.join(_AXES)}")
    return up


def _from_z(up: str) -> mi.ScalarTransform4f:
    """A rotation that takes z to an axis and y to the next one."""
    import mitsuba as mi

    z = np.array(_AXES[up], dtype=np.float64)
    y = np.roll(np.abs(z), 1)
    matrix = np.eye(4)
    matrix[:3, :3] = np.column_stack([np.cross(y, z), y, z])
    return mi.ScalarTransform4f(matrix)


def stands_in(scene: Mapping[str, Any]) -> bool:
    """Whether a world's first camera is one that stands nowhere, as its file has none."""
    cameras = [part for part in scene.values() if isinstance(part, dict) and part["type"] == "perspective"]
    return bool(np.isnan(np.array(cameras[0]["to_world"].matrix)).any())


def _sensors(cameras: list[PlacedCamera], fov: float | None, diagonal: float) -> Iterator[dict[str, Any]]:
    """The file's cameras, or one that stands nowhere."""
    import mitsuba as mi

    if fov is not None:
        try:
            fov = float(fov)
        except ValueError:
            fov = np.nan
        if not 0.0 < fov < 180.0:
            raise OptionError("fov is the horizontal field of view in degrees, between 0 and 180")
        if cameras:
            raise OptionError(
                "fov is of the camera that stands in for one, and this file has one; leave it out"
            )
    planes = {"near_clip": _NEAR * diagonal, "far_clip": _FAR * diagonal}
    for camera in cameras:
        width, height = _SIZE
        if camera.aspect is not None:
            width = max(1, round(height * camera.aspect))
        yield {
            "type": "perspective",
            "id": camera.name,
            "fov": float(np.degrees(camera.fov_y)),
            "fov_axis": "y",
            "to_world": mi.ScalarTransform4f(camera.world_from_camera),
            "film": _film(width, height),
            **planes,
        }
    if not cameras:
        yield {
            "type": "perspective",
            "id": "camera",
            "fov": fov or FOV,
            "to_world": mi.ScalarTransform4f(np.full((4, 4), np.nan)),
            "film": _film(*_SIZE),
            **planes,
        }


def _lamp(lamp: Lamp) -> dict[str, Any]:
    """Mitsuba's description of a lamp."""
    import mitsuba as mi

    power = {"type": "rgb", "value": list(lamp.power)}
    if lamp.kind == "point":
        return {"type": "point", "position": lamp.world_from_lamp[:3, 3].tolist(), "intensity": power}
    to_world = mi.ScalarTransform4f(lamp.world_from_lamp)
    if lamp.kind == "directional":
        return {"type": "directional", "to_world": to_world, "irradiance": power}
    angles = {
        "cutoff_angle": float(np.degrees(lamp.outer)),
        "beam_width": float(np.degrees(min(lamp.inner, 0.999 * lamp.outer))),
    }
    return {"type": "spot", "to_world": to_world, "intensity": power, **angles}


def _film(width: int, height: int) -> dict[str, Any]:
    return {
        "type": "hdrfilm",
        "width": width,
        "height": height,
        "pixel_format": "rgb",
        "rfilter": {"type": "gaussian"},
    }


def _shape(mesh: TexturedMesh, name: str, materials: Materials) -> mi.Mesh:
    """Mitsuba's mesh, filled from arrays."""
    import mitsuba as mi

    normals = None if materials.shines(mesh) else mesh.normals
    shape = mi.Mesh(
        name,
        len(mesh.vertices),
        len(mesh.faces),
        materials.properties(mesh),
        has_vertex_normals=normals is not None,
        has_vertex_texcoords=mesh.uv is not None,
    )
    if mesh.colours is not None:
        values = (mesh.colours * mesh.material.colour).astype(np.float32)
        shape.add_attribute(ATTRIBUTE.format(mesh.colours_of), 3, values.ravel())
    parameters = mi.traverse(shape)
    parameters["faces"] = mi.UInt32(np.ascontiguousarray(mesh.faces).ravel())
    parameters["vertex_positions"] = mi.Float(mesh.vertices.astype(np.float32).ravel())
    if normals is not None:
        parameters["vertex_normals"] = mi.Float(normals.astype(np.float32).ravel())
    if mesh.uv is not None:
        parameters["vertex_texcoords"] = mi.Float(mesh.uv.astype(np.float32).ravel())
    parameters.update()
    return shape


def _new(name: str, taken: dict[str, Any]) -> str:
    """A name of its own, without what separates names in `mi.traverse`."""
    plain = name.replace(".", "_") or "mesh"
    free, number = plain, 1
    while free in taken:
        number += 1
        free = f"{plain} {number}"
    return free
