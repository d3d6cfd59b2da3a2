"""SOG, PlayCanvas' container of splats: a `meta.json` and images, beside it or in one ZIP with it; version 2.

Splat i is pixel i of every image, row by row. Positions are 16 bits in two images, of sign(x) ln(1 + |x|)
between the bounds in `meta.json`; logarithms of scales and coefficients of spherical harmonics are numbers of
a codebook; rotations are the three smaller numbers of a quaternion and, in the fourth channel, 252 and which
is largest; `shN_labels` says which entry of a palette holds the coefficients beyond the constant.
"""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FieldError
from ..files.reading import read_bytes, read_json
from .splat_set import DEGREES, Splats, checked, quaternions_of

_PARTS = (b'"means"', b'"scales"', b'"quats"', b'"sh0"')
_PALETTE = 64
"""Entries of the palette in a row of its image."""

Bytes = NDArray[np.uint8]


def is_sog(path: Path, data: bytes) -> bool:
    """Whether a file is one of these, by its first bytes."""
    if data[:4] == b"PK\x03\x04":
        try:
            with zipfile.ZipFile(path) as archive:
                return "meta.json" in archive.namelist()
        except (OSError, zipfile.BadZipFile):
            return False
    return data[:1] == b"{" and all(part in data for part in _PARTS)


def read_sog(path: Path) -> Splats:
    """The splats of a `meta.json`, or of a `.sog` file.

    Raises:
        FieldError: it is damaged, of another version, or an image is missing.
    """
    if path.suffix == ".json" or not zipfile.is_zipfile(path):
        meta = read_json(path, FieldError)
        return _decoded(meta, lambda name: read_bytes(path.parent / name, FieldError), path)
    with zipfile.ZipFile(path) as archive:

        def member(name: str) -> bytes:
            try:
                return archive.read(name)
            except (KeyError, zipfile.BadZipFile, OSError, zlib.error, NotImplementedError) as error:
                raise FieldError(f"{path} holds no readable {name}; fetch or export it again") from error

        try:
            meta = json.loads(member("meta.json"))
        except ValueError as error:
            raise FieldError(f"{path} holds a meta.json that is no JSON; export it again") from error
        return _decoded(meta, member, path)


def _decoded(meta: Any, read: Callable[[str], bytes], path: Path) -> Splats:
    version = meta.get("version") if isinstance(meta, Mapping) else None
    if version != 2:
        raise FieldError(
            f"{path} is SOG of version {version}, and 2 is read; convert it to PLY: npx "
            f"@playcanvas/splat-transform {path} {path.stem}.ply"
        )
    try:
        return _splats(meta, read, path)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        raise FieldError(
            f"{path} is damaged SOG ({type(error).__name__}: {error}); export it again"
        ) from error


def _splats(meta: Mapping[str, Any], read: Callable[[str], bytes], path: Path) -> Splats:
    count = int(meta["count"])

    def image(part: str, k: int = 0) -> Bytes:
        """(count, 4), or of a palette (rows, columns, 4)."""
        from PIL import Image

        name = meta[part]["files"][k]
        data = read(name)
        try:
            with Image.open(io.BytesIO(data)) as picture:
                pixels = np.asarray(picture.convert("RGBA"))
        except Exception as error:  # what decoders stumble over has no common class
            raise FieldError(f"{path}: {name} is no image; export it again") from error
        return pixels if (part, k) == ("shN", 0) else pixels.reshape(-1, 4)[:count]

    def book(part: str) -> NDArray[np.float64]:
        return np.asarray(meta[part]["codebook"], dtype=np.float64)

    low, high = image("means", 0)[:, :3].astype(np.float64), image("means", 1)[:, :3].astype(np.float64)
    ends = [np.asarray(meta["means"][end], dtype=np.float64) for end in ("mins", "maxs")]
    logarithm = ends[0] + (ends[1] - ends[0]) * (low + 256.0 * high) / 65535.0
    quats, sh0 = image("quats"), image("sh0")
    coefficients = book("sh0")[sh0[:, None, :3]]
    bands = int(meta["shN"]["bands"]) if meta.get("shN") else 0
    if bands:
        if bands not in DEGREES:
            raise ValueError(f"{bands} bands")
        palette, labels = image("shN", 0), image("shN", 1)
        entry = labels[:, 0] + 256 * labels[:, 1].astype(np.int64)
        column = (entry % _PALETTE * ((bands + 1) ** 2 - 1))[:, None] + np.arange((bands + 1) ** 2 - 1)
        rest = book("shN")[palette[(entry // _PALETTE)[:, None], column, :3]]
        coefficients = np.concatenate([coefficients, rest], axis=1)
    return checked(
        str(path),
        np.sign(logarithm) * np.expm1(np.abs(logarithm)),
        quaternions_of((quats[:, :3] / 255.0 - 0.5) * np.sqrt(2.0), quats[:, 3].astype(np.int64) - 252 & 3),
        np.exp(book("scales")[image("scales")[:, :3]]),
        sh0[:, 3] / 255.0,
        coefficients,
    )
