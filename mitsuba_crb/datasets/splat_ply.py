"""Splats in PLY: INRIA's layout, which gsplat, nerfstudio and SuperSplat write, and the compressed one.

INRIA's: logarithms of scales, logits of opacities, quaternions w x y z, spherical harmonics channel by
channel: `f_rest` holds all of red's coefficients beyond the constant, then green's, then blue's. Columns come
in any order; those that are not needed, such as normals, are left. Mip-Splatting's `filter_3D` blurs a splat
in space by so much and keeps what it adds up to.

SuperSplat's compressed layout: chunks of 256 splats with the bounds of what is in them, splats as four 32-bit
numbers (11-10-11 bits for positions and scales, the three smaller of a quaternion's numbers in 10 bits each,
8 bits for colours and opacity), an element `sh` of bytes.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FieldError
from .ply import Header, read_elements
from .splat_set import DEGREES, Floats, Splats, checked, colours_of, quaternions_of

_NEEDED = (
    *("x", "y", "z"),
    *(f"f_dc_{k}" for k in range(3)),
    "opacity",
    *(f"scale_{k}" for k in range(3)),
    *(f"rot_{k}" for k in range(4)),
)
_PACKED = tuple(f"packed_{name}" for name in ("position", "rotation", "scale", "color"))
_CHUNK = 256


def is_splat_header(header: Header) -> bool:
    """Whether a PLY file's header announces splats, whole or not."""
    vertex = header.element("vertex")
    if vertex is None:
        return False
    names = set(vertex.properties)
    return bool({"packed_position", "f_dc_0"} & names) or {"opacity", "scale_0", "rot_0"} <= names


def read_ply(data: bytes, header: Header, path: Path) -> Splats:
    """The splats of a PLY file.

    Raises:
        FieldError: it is cut off, lacks columns, or has a wrong number of spherical harmonics.
    """
    vertex = header.element("vertex")
    packed = vertex is not None and "packed_position" in vertex.properties
    if vertex is not None and not packed:
        _check(vertex.properties, path)
    elements = read_elements(data, header, path, FieldError)
    if "vertex" not in elements:
        raise FieldError(f"{path} has its splats behind lists; export it again")
    return _compressed(elements, path) if packed else _plain(elements["vertex"], path)


def _check(properties: Mapping[str, str], path: Path) -> None:
    missing = [name for name in _NEEDED if properties.get(name, "") == ""]
    if missing == ["scale_2"]:
        raise FieldError(f"{path} holds 2D Gaussians (discs with two scales), which are drawn otherwise")
    if missing:
        raise FieldError(
            f"{path} lacks {', '.join(missing)} of a splat's columns; export it again as INRIA's"
        )


def _rest_count(names: tuple[str, ...], path: Path) -> int:
    """How many coefficients beyond the constant each colour has."""
    numbers = sorted(int(found.group(1)) for name in names if (found := re.match(r"f_rest_(\d+)$", name)))
    allowed = [3 * ((degree + 1) ** 2 - 1) for degree in DEGREES]
    if numbers != list(range(len(numbers))) or len(numbers) not in allowed:
        raise FieldError(
            f"{path} has {len(numbers)} columns f_rest, and spherical harmonics of degree 0 to {DEGREES[-1]} "
            f"have {', '.join(map(str, allowed[:-1]))} or {allowed[-1]}, from f_rest_0 on; export it again"
        )
    return len(numbers) // 3


def _plain(vertex: NDArray[Any], path: Path) -> Splats:
    def table(*names: str) -> Floats:
        return np.stack([vertex[name].astype(np.float64) for name in names], axis=1)

    rest = _rest_count(vertex.dtype.names or (), path)
    coefficients = np.empty((len(vertex), rest + 1, 3), dtype=np.float32)
    for channel in range(3):
        coefficients[:, 0, channel] = vertex[f"f_dc_{channel}"]
        for k in range(rest):
            coefficients[:, k + 1, channel] = vertex[f"f_rest_{channel * rest + k}"]
    scales = np.exp(table(*(f"scale_{k}" for k in range(3))))
    opacities = 1.0 / (1.0 + np.exp(-vertex["opacity"].astype(np.float64)))
    if "filter_3D" in (vertex.dtype.names or ()):
        blurred = np.hypot(scales, vertex["filter_3D"].astype(np.float64)[:, None])
        opacities = opacities * np.prod(scales / blurred, axis=1)
        scales = blurred
    return checked(
        str(path),
        table("x", "y", "z"),
        table(*(f"rot_{k}" for k in range(4))),
        scales,
        opacities,
        coefficients,
    )


def _compressed(elements: Mapping[str, NDArray[Any]], path: Path) -> Splats:
    vertex, chunk = elements["vertex"], elements.get("chunk")
    missing = [name for name in _PACKED if name not in (vertex.dtype.names or ())]
    bounds = [f"{end}_{name}" for end in ("min", "max") for name in ("x", "y", "z")]
    bounds += [f"{end}_scale_{name}" for end in ("min", "max") for name in ("x", "y", "z")]
    missing += [name for name in bounds if chunk is None or name not in (chunk.dtype.names or ())]
    if missing or chunk is None or len(chunk) * _CHUNK < len(vertex):
        raise FieldError(
            f"{path} is no whole compressed PLY ({', '.join(missing) or 'too few chunks'}); export it again"
        )
    of_chunk = np.arange(len(vertex)) // _CHUNK

    def within(unit: Floats, *names: str) -> Floats:
        low, high = (np.stack([chunk[f"{end}_{n}"] for n in names], axis=1) for end in ("min", "max"))
        low, high = (ends.astype(np.float64)[of_chunk] for ends in (low, high))
        return np.asarray(low + unit * (high - low))

    colour = _bits(vertex["packed_color"], (24, 8), (16, 8), (8, 8), (0, 8))
    plain = colour[:, :3]
    if "min_r" in (chunk.dtype.names or ()):
        plain = within(plain, "r", "g", "b")
    coefficients = colours_of(plain)
    if "sh" in elements:
        coefficients = np.concatenate(
            [coefficients, _byte_harmonics(elements["sh"], len(vertex), path)], axis=1
        )
    return checked(
        str(path),
        within(_bits(vertex["packed_position"], (21, 11), (11, 10), (0, 11)), "x", "y", "z"),
        quaternions_of(
            (_bits(vertex["packed_rotation"], (20, 10), (10, 10), (0, 10)) - 0.5) * np.sqrt(2.0),
            vertex["packed_rotation"].astype(np.int64) >> 30 & 3,
        ),
        np.exp(
            within(
                _bits(vertex["packed_scale"], (21, 11), (11, 10), (0, 11)), "scale_x", "scale_y", "scale_z"
            )
        ),
        colour[:, 3],
        coefficients,
    )


def _bits(numbers: NDArray[Any], *fields: tuple[int, int]) -> Floats:
    """(n, fields) of numbers (n,), each from 0 to 1: where a field begins, and of how many bits it is."""
    values = [
        (numbers.astype(np.uint32) >> place & (1 << bits) - 1) / ((1 << bits) - 1) for place, bits in fields
    ]
    return np.stack(values, axis=1)


def _byte_harmonics(sh: NDArray[Any], count: int, path: Path) -> NDArray[np.float32]:
    """(n, k − 1, 3) of the element's bytes."""
    names = sh.dtype.names or ()
    rest = _rest_count(names, path)
    if len(sh) != count:
        raise FieldError(f"{path} has spherical harmonics of {len(sh)} splats for {count}; export it again")
    found = np.empty((count, rest, 3), dtype=np.float32)
    for channel in range(3):
        for k in range(rest):
            byte = sh[f"f_rest_{channel * rest + k}"].astype(np.float64)
            unit = np.where(byte == 0.0, 0.0, np.where(byte == 255.0, 1.0, (byte + 0.5) / 256.0))
            found[:, k, channel] = (unit - 0.5) * 8.0
    return found
