"""What a file of triangles says of a world: meshes where they stand, their materials, cameras, lamps.

Coordinates and units are the file's own. Texture coordinates are an image's: (0, 0) is the corner of its
first pixel, v points down, as in glTF and in Mitsuba. Colours are linear, images encoded as they were stored.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Texture:
    """An image on a surface."""

    pixels: NDArray[np.uint8]
    """(H, W, 3 or 4), the first row is the upper one."""
    wrap: str = "repeat"
    """What lies beyond its border: repeat, mirror or clamp."""
    nearest: bool = False
    """Whether its pixels are squares of one colour; else it is interpolated."""
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)
    """The texture's coordinates are offset + scale times the mesh's."""


@dataclass(frozen=True, eq=False)
class Material:
    """glTF's metallic-roughness model, or a diffuse surface."""

    name: str = ""
    colour: tuple[float, float, float] = (0.5, 0.5, 0.5)
    """Factor of the texture and of the mesh's colours; linear."""
    texture: Texture | None = None
    """Of the colour, sRGB."""
    opacity: float = 1.0
    """Factor of the texture's fourth channel."""
    transparency: str = "OPAQUE"
    """Or BLEND; or MASK, which has all or nothing."""
    cutoff: float = 0.5
    """Opacity from which on a MASK has all."""
    diffuse: bool = True
    """Whether the two numbers and the two textures below mean nothing."""
    metallic: float = 0.0
    roughness: float = 1.0
    metallic_roughness: Texture | None = None
    """Its green channel is a factor of the roughness, its blue one of how metallic it is; linear."""
    normal: Texture | None = None
    """Normals in tangent space; linear."""
    normal_scale: float = 1.0
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)
    emission_texture: Texture | None = None
    """Factors of its own radiance; linear, sRGB."""
    unlit: bool = False
    """Its colour is the radiance that leaves it."""


@dataclass(frozen=True, eq=False)
class TexturedMesh:
    """Triangles of one material in the world."""

    name: str
    vertices: Floats
    """(V, 3) [unit of the file]."""
    faces: NDArray[np.uint32]
    """(F, 3)"""
    material: Material
    normals: Floats | None = None
    """(V, 3) for shading; None: the faces' own."""
    uv: Floats | None = None
    """(V, 2) texture coordinates."""
    colours: Floats | None = None
    """(V, 3) or (F, 3) linear; factors of the material's colour."""
    colours_of: str = "vertex"
    """Or face."""


@dataclass(frozen=True, eq=False)
class PlacedCamera:
    """A pinhole in the world."""

    name: str
    world_from_camera: Floats
    """4x4, in the axes of `se3`."""
    fov_y: float
    """Vertical field of view [rad]."""
    aspect: float | None
    """Width over height, if the file says it."""


@dataclass(frozen=True, eq=False)
class Lamp:
    """A light without a surface."""

    kind: str
    """point, spot or directional."""
    world_from_lamp: Floats
    """4x4; it shines along its z."""
    power: tuple[float, float, float]
    """Intensity, of a directional one irradiance."""
    outer: float = float(np.pi / 4)
    inner: float = 0.0
    """Half angles of a spot's cone: where it ends, and where it begins to fade [rad]."""


@dataclass(frozen=True, eq=False)
class World:
    """A file's contents."""

    meshes: list[TexturedMesh]
    cameras: list[PlacedCamera] = field(default_factory=list)
    lamps: list[Lamp] = field(default_factory=list)
    up: str | None = None
    """The axis that is up, if the format says it."""
    notes: list[str] = field(default_factory=list)
    """What of the file is left out."""


def merged(meshes: Sequence[TexturedMesh]) -> list[TexturedMesh]:
    """Meshes of one material and the same arrays as one, called by it: fewer are faster to trace."""
    alike: dict[Any, list[TexturedMesh]] = {}
    for mesh in meshes:
        arrays = (mesh.normals is None, mesh.uv is None, mesh.colours is None, mesh.colours_of)
        alike.setdefault((mesh.material, arrays), []).append(mesh)
    return [group[0] if len(group) == 1 else _joined(group) for group in alike.values()]


def _joined(meshes: list[TexturedMesh]) -> TexturedMesh:
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])

    def together(name: str) -> Any:
        parts = [getattr(mesh, name) for mesh in meshes]
        return None if parts[0] is None else np.concatenate(parts)

    return TexturedMesh(
        meshes[0].material.name,
        together("vertices"),
        np.concatenate([mesh.faces + np.uint32(start) for mesh, start in zip(meshes, starts, strict=False)]),
        meshes[0].material,
        together("normals"),
        together("uv"),
        together("colours"),
        meshes[0].colours_of,
    )
