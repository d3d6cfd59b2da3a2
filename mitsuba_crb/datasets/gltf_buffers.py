"""The bytes of a glTF file: its JSON, its buffers, and the arrays (accessors) that lie in them.

Source: Khronos, glTF 2.0 specification, 3.6 (binary data) and 4 (GLB).
"""

from __future__ import annotations

import base64
import json
import struct
import urllib.parse
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SceneError

_MAGIC, _JSON, _BINARY = b"glTF", 0x4E4F534A, 0x004E4942
_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


class Buffers:
    """A glTF file's JSON and what it refers to."""

    def __init__(self, file: Path) -> None:
        """Read a `.glb` or `.gltf` file; errors in one line."""
        self.file = file
        data = file.read_bytes()
        own: bytes | None = None
        if data.startswith(_MAGIC):
            data, own = self._chunks(data)
        try:
            self.json: dict[str, Any] = json.loads(data.decode("utf-8-sig"))
        except (ValueError, RecursionError) as error:
            raise SceneError(f"{file} is no glTF: its JSON cannot be read ({str(error)[:80]})") from error
        asset = self.json.get("asset") if isinstance(self.json, dict) else None
        if not isinstance(asset, dict) or not str(asset.get("version")).startswith("2"):
            raise SceneError(f"{file} is no glTF 2: export it again as glTF 2.0 (.glb)")
        self._own = own
        self._read: dict[int, bytes] = {}

    def bytes_of(self, view: int) -> bytes:
        """A buffer view."""
        entry = self.json["bufferViews"][view]
        buffer, start, length = entry["buffer"], entry.get("byteOffset", 0), entry["byteLength"]
        if buffer not in self._read:
            uri = self.json["buffers"][buffer].get("uri")
            self._read[buffer] = (self._own or b"") if uri is None else self.resource(uri)
        data = self._read[buffer][start : start + length]
        if len(data) < length:
            raise SceneError(
                f"{self.file} is cut off: buffer {buffer} ends {length - len(data)} bytes too early; "
                "copy it again"
            )
        return data

    def resource(self, uri: str) -> bytes:
        """What a URI names: data in the text, or a file beside this one."""
        if uri.startswith("data:"):
            return base64.b64decode(uri.partition(",")[2])
        name = urllib.parse.unquote(uri)
        try:
            return (self.file.parent / name).read_bytes()
        except OSError as error:
            raise SceneError(
                f"{self.file} refers to {name}, which cannot be read ({error.strerror}): put it beside the "
                "file, or export one .glb"
            ) from error

    def array(self, accessor: int) -> NDArray[Any]:
        """An accessor's numbers (n, components), integers that stand for fractions as such."""
        entry = self.json["accessors"][accessor]
        kind, width, count = (
            np.dtype(_TYPES[entry["componentType"]]),
            _COMPONENTS[entry["type"]],
            entry["count"],
        )
        if "bufferView" in entry:
            values = self._strided(entry["bufferView"], entry.get("byteOffset", 0), kind, width, count)
        else:
            values = np.zeros((count, width), kind)
        if sparse := entry.get("sparse"):
            values = values.copy()
            n, places, own = sparse["count"], sparse["indices"], sparse["values"]
            index = self._strided(
                places["bufferView"],
                places.get("byteOffset", 0),
                np.dtype(_TYPES[places["componentType"]]),
                1,
                n,
            )
            values[index[:, 0]] = self._strided(own["bufferView"], own.get("byteOffset", 0), kind, width, n)
        if entry.get("normalized"):
            return np.maximum(values / np.iinfo(kind).max, -1.0)
        return values

    def _strided(self, view: int, start: int, kind: np.dtype[Any], width: int, count: int) -> NDArray[Any]:
        data, row = self.bytes_of(view), kind.itemsize * width
        stride = self.json["bufferViews"][view].get("byteStride", row)
        if count and start + stride * (count - 1) + row > len(data):
            raise SceneError(f"{self.file} is damaged: an array is longer than its buffer; export it again")
        return np.ndarray((count, width), kind, data, start, (stride, kind.itemsize))

    def _chunks(self, data: bytes) -> tuple[bytes, bytes | None]:
        """The JSON and the binary chunk of a GLB."""
        length = struct.unpack_from("<I", data, 8)[0] if len(data) >= 20 else 20
        if len(data) < length:
            raise SceneError(f"{self.file} is cut off: {len(data)} of {length} bytes; copy it again")
        found: dict[int, bytes] = {}
        place = 12
        while place + 8 <= length:
            size, kind = struct.unpack_from("<II", data, place)
            found.setdefault(kind, data[place + 8 : place + 8 + size])
            place += 8 + size
        return found.get(_JSON, b""), found.get(_BINARY)
