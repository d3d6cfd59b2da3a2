"""PLY: a header that names elements and their properties, then their values, as text or in bytes.

Only elements of one number per property are read, all of a file's or its first ones; lists, which are what
meshes have faces in, end what can be read.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..files.reading import Fault

_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}
_ENDS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
HEADER = 1 << 16
"""A header is no longer [byte]."""


@dataclass(frozen=True)
class Element:
    """What the header says of an element."""

    name: str
    count: int
    properties: Mapping[str, str]
    """NumPy's code of each property's type; empty of a list."""


@dataclass(frozen=True)
class Header:
    """A file's."""

    form: str
    """One of PLY's three: binary_little_endian, binary_big_endian, ascii."""
    elements: tuple[Element, ...]
    size: int
    """Where the values begin [byte]."""

    def element(self, name: str) -> Element | None:
        """Of a name; None if there is none."""
        return next((element for element in self.elements if element.name == name), None)


def is_ply(data: bytes) -> bool:
    """Whether a file's first bytes are PLY's."""
    return data[:4] in (b"ply\n", b"ply\r")


def read_header(data: bytes) -> Header | None:
    """Of a file's first bytes; None if it makes no sense."""
    start = data.find(b"end_header")
    size = data.find(b"\n", start) + 1
    if not is_ply(data) or start < 0 or size == 0:
        return None
    form, elements = "", list[Element]()
    for line in data[:start].decode("latin-1").splitlines():
        match line.split():
            case ["format", name, _] if name in _ENDS:
                form = name
            case ["element", name, count] if count.isascii() and count.isdigit() and len(count) < 16:
                elements.append(Element(name, int(count), {}))
            case ["property", "list", _, _, name] if elements:
                elements[-1] = _with(elements[-1], name, "")
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1] = _with(elements[-1], name, _TYPES[kind])
            case ["ply" | "comment" | "obj_info", *_] | []:
                pass
            case _:
                return None
    return Header(form, tuple(elements), size) if form else None


def _with(element: Element, name: str, kind: str) -> Element:
    return Element(element.name, element.count, {**element.properties, name: kind})


def read_elements(data: bytes, header: Header, path: Path, fault: Fault) -> dict[str, NDArray[Any]]:
    """The elements before the first list, each an array (count,) with a field per property.

    Raises:
        fault: the file is cut off, or its text holds something else than numbers.
    """
    read = _from_text if header.form == "ascii" else _from_bytes
    return read(data, header, path, fault)


def _from_bytes(data: bytes, header: Header, path: Path, fault: Fault) -> dict[str, NDArray[Any]]:
    end, place, found = _ENDS[header.form], header.size, dict[str, NDArray[Any]]()
    for element in header.elements:
        if "" in element.properties.values():
            break
        layout = np.dtype([(name, end + kind) for name, kind in element.properties.items()])
        size = layout.itemsize * element.count
        if place + size > len(data):
            whole = (len(data) - place) // max(layout.itemsize, 1)
            raise fault(
                f"{path} is cut off: its header promises {element.count} of element {element.name}, and it "
                f"holds {whole}; fetch or export it again"
            )
        found[element.name] = np.frombuffer(data, layout, element.count, place)
        place += size
    return found


def _from_text(data: bytes, header: Header, path: Path, fault: Fault) -> dict[str, NDArray[Any]]:
    lines, place = data[header.size :].splitlines(), 0
    found = dict[str, NDArray[Any]]()
    for element in header.elements:
        if "" in element.properties.values():
            break
        rows = [line.split() for line in lines[place : place + element.count]]
        place += element.count
        if len(rows) < element.count or any(len(row) != len(element.properties) for row in rows):
            raise fault(
                f"{path} is cut off or damaged: its header promises {element.count} lines of "
                f"{len(element.properties)} numbers of element {element.name}"
            )
        try:
            values = np.array(rows, dtype=np.float64).reshape(element.count, len(element.properties))
        except ValueError:
            raise fault(f"{path} has something else than numbers in element {element.name}") from None
        layout = np.dtype([(name, "f8") for name in element.properties])
        found[element.name] = values.view(layout)[:, 0] if values.size else np.empty(element.count, layout)
    return found
