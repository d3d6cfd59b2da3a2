"""GLB files written byte by byte, so that a test says what is in them."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

_KINDS = {"float32": 5126, "uint32": 5125, "uint16": 5123, "uint8": 5121}
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}

SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=np.float32)
"""A square in the plane z = 0, as an image lies on it: its corners from the lower left one on."""
SQUARE_UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], dtype=np.float32)
SQUARE_FACES = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.uint32)


class Glb:
    """A glTF document and its binary chunk, filled piece by piece."""

    def __init__(self) -> None:
        self.document: dict[str, Any] = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": []}]}
        self.binary = b""

    def view(self, data: bytes) -> int:
        views = self.document.setdefault("bufferViews", [])
        views.append({"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data)})
        self.binary += data + bytes(-len(data) % 4)
        return len(views) - 1

    def array(self, values: np.ndarray, *, normalized: bool = False) -> int:
        accessors = self.document.setdefault("accessors", [])
        width = values.shape[1] if values.ndim == 2 else 1
        accessors.append(
            {
                "bufferView": self.view(np.ascontiguousarray(values).tobytes()),
                "componentType": _KINDS[str(values.dtype)],
                "count": len(values),
                "type": _TYPES[width],
                "normalized": normalized,
            }
        )
        return len(accessors) - 1

    def texture(self, pixels: np.ndarray, **sampler: int) -> int:
        file = io.BytesIO()
        Image.fromarray(pixels).save(file, format="png")
        images = self.document.setdefault("images", [])
        images.append({"bufferView": self.view(file.getvalue()), "mimeType": "image/png"})
        self.document.setdefault("samplers", []).append(sampler)
        textures = self.document.setdefault("textures", [])
        textures.append({"source": len(images) - 1, "sampler": len(self.document["samplers"]) - 1})
        return len(textures) - 1

    def material(self, **entry: Any) -> int:
        materials = self.document.setdefault("materials", [])
        materials.append(entry)
        return len(materials) - 1

    def mesh(
        self,
        vertices: np.ndarray = SQUARE,
        faces: np.ndarray = SQUARE_FACES,
        *,
        uv: np.ndarray | None = None,
        colours: np.ndarray | None = None,
        normals: np.ndarray | None = None,
        material: int | None = None,
        **node: Any,
    ) -> int:
        """A mesh and its node, which is returned."""
        attributes = {"POSITION": self.array(vertices.astype(np.float32))}
        for name, values in (("TEXCOORD_0", uv), ("COLOR_0", colours), ("NORMAL", normals)):
            if values is not None:
                attributes[name] = self.array(values, normalized=values.dtype.kind == "u")
        primitive: dict[str, Any] = {
            "attributes": attributes,
            "indices": self.array(faces.astype(np.uint32).ravel()),
        }
        if material is not None:
            primitive["material"] = material
        meshes = self.document.setdefault("meshes", [])
        meshes.append({"primitives": [primitive]})
        return self.node(mesh=len(meshes) - 1, **node)

    def node(self, *, root: bool = True, children: Sequence[int] = (), **node: Any) -> int:
        nodes = self.document.setdefault("nodes", [])
        nodes.append(node | ({"children": list(children)} if children else {}))
        if root:
            self.document["scenes"][0]["nodes"].append(len(nodes) - 1)
        return len(nodes) - 1

    def write(self, file: Path) -> Path:
        document = self.document | {"buffers": [{"byteLength": len(self.binary)}]}
        text = json.dumps(document).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
        chunks += struct.pack("<II", len(self.binary), 0x004E4942) + self.binary
        file.write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks)
        return file
