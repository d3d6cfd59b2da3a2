"""glTF and GLB files: the scene graph flattened, materials, textures, cameras and lamps.

Read here and not by trimesh, which rounds colours to bytes, keeps one camera and no lamps, drops
`KHR_materials_unlit`, texture transforms and samplers, and says nothing of textures that are missing. World:
metres, right-handed, y up. Cameras look along −z with y up; `se3`'s have x left, y up, z forward. Lamps'
candela and lux are taken as they stand, of red, green and blue. Source: Khronos, glTF 2.0 specification, 3.5
(nodes), 3.7 (meshes), 3.9 (materials), 3.10 (cameras); `KHR_lights_punctual`.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SceneError
from .gltf_buffers import Buffers
from .pixels import decoded
from .textured_mesh import Floats, Lamp, Material, PlacedCamera, Texture, TexturedMesh, World

_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_WRAP = {33071: "clamp", 33648: "mirror"}
_NEAREST = 9728
_FLIP = np.diag([-1.0, 1.0, -1.0, 1.0])
"""The axes of `se3`'s cameras, and of lamps here, in those of glTF."""
_READ = (
    "KHR_lights_punctual",
    "KHR_materials_emissive_strength",
    "KHR_materials_unlit",
    "KHR_mesh_quantization",
    "KHR_texture_transform",
    "EXT_texture_webp",
)
_PLAIN, _WHITE = Material("plain", (0.8, 0.8, 0.8)), Material("plain", (1.0, 1.0, 1.0))
"""Of primitives without a material, and of those with colours: diffuse, not glTF's rough metal."""
_DEEPEST = 200
"""Nodes within nodes."""


def read_gltf(file: Path) -> World:
    """What a `.glb` or `.gltf` file shows.

    Raises:
        SceneError: it is damaged or cut off, refers to what is not there, or needs an extension that is not
            read.
    """
    buffers = Buffers(file)
    try:
        return _read(buffers)
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise SceneError(
            f"{file} is damaged: it refers to what it does not have ({type(error).__name__}: {error}); "
            "export it again"
        ) from error


def _read(buffers: Buffers) -> World:
    document = buffers.json
    unread = sorted(set(document.get("extensionsRequired", [])) - set(_READ))
    if unread:
        raise SceneError(
            f"{buffers.file} needs {', '.join(unread)}, which is not read here; export it uncompressed "
            "(gltf-transform copy)"
        )
    materials = _Materials(buffers)
    meshes: list[TexturedMesh] = []
    cameras: list[PlacedCamera] = []
    lamps: list[Lamp] = []
    skipped = 0
    for node, matrix in _nodes(document):
        if "camera" in node:
            cameras += _camera(document, node, matrix)
        lamp = node.get("extensions", {}).get("KHR_lights_punctual")
        if lamp is not None:
            lamps.append(_lamp(document, lamp["light"], matrix))
        if "mesh" not in node:
            continue
        mesh = document["meshes"][node["mesh"]]
        for primitive in mesh["primitives"]:
            if primitive.get("mode", _TRIANGLES) in (_TRIANGLES, _STRIP, _FAN):
                name = node.get("name") or mesh.get("name") or "mesh"
                meshes.append(_mesh(buffers, materials, primitive, matrix, name))
            else:
                skipped += 1
    notes = [f"{skipped} primitives of points or lines are left out"] if skipped else []
    return World(meshes, cameras, lamps, "y", notes + materials.notes)


def _nodes(document: dict[str, Any]) -> Iterator[tuple[dict[str, Any], Floats]]:
    """The nodes of the file's scene and their world matrices."""
    nodes = document.get("nodes", [])
    scenes = document.get("scenes")
    if scenes:
        roots = scenes[document.get("scene", 0)].get("nodes", [])
    else:
        roots = sorted(
            set(range(len(nodes))) - {child for node in nodes for child in node.get("children", [])}
        )
    waiting = [(root, np.eye(4), 0) for root in reversed(roots)]
    while waiting:
        index, parent, depth = waiting.pop()
        if depth > _DEEPEST:
            raise ValueError("nodes within nodes without end")
        node = nodes[index]
        matrix = parent @ _local(node)
        yield node, matrix
        waiting += [(child, matrix, depth + 1) for child in reversed(node.get("children", []))]


def _local(node: dict[str, Any]) -> Floats:
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    x, y, z, w = node.get("rotation", (0.0, 0.0, 0.0, 1.0))
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    matrix = np.eye(4)
    matrix[:3, :3] = turn * np.array(node.get("scale", (1.0, 1.0, 1.0)))
    matrix[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return matrix


def _camera(document: dict[str, Any], node: dict[str, Any], matrix: Floats) -> list[PlacedCamera]:
    camera = document["cameras"][node["camera"]]
    if camera.get("type") != "perspective":
        return []
    name = node.get("name") or camera.get("name") or "camera"
    lens = camera["perspective"]
    return [PlacedCamera(name, _placed(matrix), float(lens["yfov"]), lens.get("aspectRatio"))]


def _lamp(document: dict[str, Any], index: int, matrix: Floats) -> Lamp:
    light = document["extensions"]["KHR_lights_punctual"]["lights"][index]
    red, green, blue = (
        float(light.get("intensity", 1.0)) * float(value) for value in light.get("color", (1.0, 1.0, 1.0))
    )
    cone = light.get("spot", {})
    return Lamp(
        light["type"],
        _placed(matrix),
        (red, green, blue),
        float(cone.get("outerConeAngle", np.pi / 4)),
        float(cone.get("innerConeAngle", 0.0)),
    )


def _placed(matrix: Floats) -> Floats:
    """The pose of what looks along −z of a node, whatever the node's scale."""
    pose = matrix @ _FLIP
    pose[:3, :3] /= np.linalg.norm(pose[:3, :3], axis=0)
    return pose


def _mesh(
    buffers: Buffers, materials: _Materials, primitive: dict[str, Any], matrix: Floats, name: str
) -> TexturedMesh:
    attributes = primitive["attributes"]
    linear = matrix[:3, :3]
    vertices = buffers.array(attributes["POSITION"]).astype(np.float64) @ linear.T + matrix[:3, 3]
    index = (
        buffers.array(primitive["indices"])[:, 0]
        if "indices" in primitive
        else np.arange(len(vertices), dtype=np.uint32)
    )
    faces = _triangles(index.astype(np.uint32), primitive.get("mode", _TRIANGLES))
    mirrored = np.linalg.det(linear) < 0.0
    normals = None
    if "NORMAL" in attributes:
        # By the cofactor matrix, which a scale of zero along an axis leaves finite.
        cofactor = np.stack([np.cross(linear[i - 2], linear[i - 1]) for i in range(3)])
        normals = buffers.array(attributes["NORMAL"]).astype(np.float64) @ cofactor.T
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        normals = -normals if mirrored else normals
    material, texcoord = materials.of(primitive.get("material"))
    channel = f"TEXCOORD_{texcoord}"
    uv = buffers.array(attributes[channel]).astype(np.float64) if channel in attributes else None
    colours = buffers.array(attributes["COLOR_0"])[:, :3] if "COLOR_0" in attributes else None
    if colours is not None and "material" not in primitive:
        material = _WHITE
    elif colours is not None and material.texture is not None and uv is not None:
        # Mitsuba has no product of textures, and exporters write white beside them.
        if np.ptp(colours, axis=0).max(initial=0.0) > 0.0:
            materials.notes.append(f"the vertex colours of {name} beside its texture are left out")
        colours = None
    return TexturedMesh(
        name,
        vertices,
        faces[:, ::-1] if mirrored else faces,
        material,
        normals,
        uv,
        None if colours is None else colours.astype(np.float64),
    )


def _triangles(index: NDArray[np.uint32], mode: int) -> NDArray[np.uint32]:
    if mode == _TRIANGLES:
        return index[: len(index) // 3 * 3].reshape(-1, 3)
    if mode == _FAN:
        return np.stack([np.full(len(index) - 2, index[0]), index[1:-1], index[2:]], axis=1)
    faces = np.stack([index[:-2], index[1:-1], index[2:]], axis=1)
    faces[1::2] = faces[1::2, ::-1]
    return faces


class _Materials:
    """The file's materials, each read once, and their textures."""

    def __init__(self, buffers: Buffers) -> None:
        self.notes: list[str] = []
        self._buffers = buffers
        self._read: dict[int | None, tuple[Material, int]] = {None: (_PLAIN, 0)}
        self._images: dict[int, NDArray[np.uint8]] = {}

    def of(self, index: Any) -> tuple[Material, int]:
        """A material, and the number of its texture coordinates; of none a light grey one that is diffuse."""
        if index not in self._read:
            self._read[index] = self._material(self._buffers.json["materials"][index], f"material {index}")
        return self._read[index]

    def _material(self, entry: dict[str, Any], name: str) -> tuple[Material, int]:
        name = entry.get("name") or name
        rough = entry.get("pbrMetallicRoughness", {})
        colour = rough.get("baseColorFactor", (1.0, 1.0, 1.0, 1.0))
        used = {
            "texture": rough.get("baseColorTexture"),
            "metallic_roughness": rough.get("metallicRoughnessTexture"),
            "normal": entry.get("normalTexture"),
            "emission_texture": entry.get("emissiveTexture"),
        }
        sets = {key: _set(reference) for key, reference in used.items() if reference is not None}
        texcoord = next(iter(sets.values()), 0)
        for key, other in sets.items():
            if other != texcoord:
                self.notes.append(f"{key} of {name} is left out, for it has texture coordinates of its own")
                used[key] = None
        strength = entry.get("extensions", {}).get("KHR_materials_emissive_strength", {})
        power = float(strength.get("emissiveStrength", 1.0))
        red, green, blue = (power * float(value) for value in entry.get("emissiveFactor", (0.0, 0.0, 0.0)))
        return (
            Material(
                name,
                colour=(float(colour[0]), float(colour[1]), float(colour[2])),
                opacity=float(colour[3]),
                transparency=entry.get("alphaMode", "OPAQUE"),
                cutoff=float(entry.get("alphaCutoff", 0.5)),
                diffuse=False,
                metallic=float(rough.get("metallicFactor", 1.0)),
                roughness=float(rough.get("roughnessFactor", 1.0)),
                normal_scale=float((used["normal"] or {}).get("scale", 1.0)),
                emission=(red, green, blue),
                unlit="KHR_materials_unlit" in entry.get("extensions", {}),
                **{key: self._texture(name, reference) for key, reference in used.items()},
            ),
            texcoord,
        )

    def _texture(self, material: str, reference: dict[str, Any] | None) -> Texture | None:
        if reference is None:
            return None
        document = self._buffers.json
        entry = document["textures"][reference["index"]]
        sampler = document["samplers"][entry["sampler"]] if "sampler" in entry else {}
        moved = reference.get("extensions", {}).get("KHR_texture_transform", {})
        if moved.get("rotation", 0.0):
            raise SceneError(
                f"{self._buffers.file}: a texture of {material} is turned by KHR_texture_transform, which "
                "is not read here; apply it to the texture coordinates"
            )
        webp = entry.get("extensions", {}).get("EXT_texture_webp", {})
        source = webp.get("source", entry.get("source"))
        if source is None:
            raise SceneError(
                f"{self._buffers.file}: a texture of {material} has no PNG, JPEG or WebP image; "
                "export it again"
            )
        scale, offset = moved.get("scale", (1.0, 1.0)), moved.get("offset", (0.0, 0.0))
        return Texture(
            self._image(source),
            wrap=_WRAP.get(sampler.get("wrapS", 0), "repeat"),
            nearest=sampler.get("magFilter") == _NEAREST,
            scale=(float(scale[0]), float(scale[1])),
            offset=(float(offset[0]), float(offset[1])),
        )

    def _image(self, index: int) -> NDArray[np.uint8]:
        if index not in self._images:
            buffers, image = self._buffers, self._buffers.json["images"][index]
            if "bufferView" in image:
                data, name = buffers.bytes_of(image["bufferView"]), image.get("name") or f"image {index}"
            else:
                data, name = buffers.resource(image["uri"]), image["uri"][:60]
            self._images[index] = decoded(data, f"{buffers.file}: {name}")
        return self._images[index]


def _set(reference: dict[str, Any]) -> int:
    """Which texture coordinates a texture has."""
    moved = reference.get("extensions", {}).get("KHR_texture_transform", {})
    return int(moved.get("texCoord", reference.get("texCoord", 0)))
