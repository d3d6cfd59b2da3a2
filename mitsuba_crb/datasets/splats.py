"""Files of 3D Gaussian splats, told apart by what is in them.

Read are PLY as in `splat_ply`, SOG as in `splat_sog`, and antimatter15's `.splat`: 32 bytes each, position
and scales as floats, colour, opacity and quaternion (w x y z, (b − 128) / 128) as bytes. Of others the error
says how to make PLY.
"""

from __future__ import annotations

import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import FieldError
from ..files.reading import read_bytes
from .ply import HEADER, is_ply, read_header
from .splat_ply import is_splat_header, read_ply
from .splat_set import Splats, checked, colours_of
from .splat_sog import is_sog, read_sog

__all__ = ["Splats", "checked", "is_splats", "load_splats"]

_RECORD = np.dtype(
    [("means", "<f4", 3), ("scales", "<f4", 3), ("colour", "u1", 3), ("opacity", "u1"), ("rotation", "u1", 4)]
)
_LOOKED_AT = 64
"""Records of `.splat` by which it is known; it has no header."""
_CURE = "convert it to PLY: npx @playcanvas/splat-transform {path} {stem}.ply"


def is_splats(path: str | Path) -> bool:
    """Whether a file seems to hold splats, of a kind that is read or not; a mesh's PLY does not.

    Only its beginning is looked at.
    """
    path = Path(path)
    try:
        with path.open("rb") as opened:
            data = opened.read(HEADER)
            size = path.stat().st_size
    except OSError:
        return False
    if is_ply(data):
        header = read_header(data)
        return header is not None and is_splat_header(header)
    return is_sog(path, data) or _is_spz(data) or _are_records(data, size)


def load_splats(path: str | Path) -> Splats:
    """Read a file of splats.

    Warns:
        FieldWarning: some cannot be drawn and are left out.

    Raises:
        FieldError: it is no file of splats, is damaged, or of a kind that is not read.
    """
    path = Path(path)
    if path.is_dir():
        raise FieldError(f"{path} is a folder; name the file of splats in it")
    data = read_bytes(path, FieldError)
    with np.errstate(all="ignore"):  # what is no number is counted
        return _read(path, data)


def _read(path: Path, data: bytes) -> Splats:
    if is_ply(data):
        header = read_header(data[:HEADER])
        if header is None:
            raise FieldError(f"{path} has a PLY header that makes no sense; export it again")
        if not is_splat_header(header):
            raise FieldError(
                f"{path} is a PLY file of something else than splats, which have the columns f_dc_0, "
                "opacity, scale_0, rot_0 and so on; a mesh is loaded as a scene"
            )
        return read_ply(data, header, path)
    if is_sog(path, data):
        return read_sog(path)
    if _is_spz(data):
        raise FieldError(f"{path} is SPZ, which is not read; {_CURE.format(path=path, stem=path.stem)}")
    if not _are_records(data, len(data)):
        cut = (
            f"; it is cut off, if it is .splat: {len(data)} bytes are no multiple of 32"
            if len(data) % 32
            else ""
        )
        raise FieldError(f"{path} is no file of splats (PLY, SOG or .splat){cut}")
    records = np.frombuffer(data, _RECORD)
    return checked(
        str(path),
        records["means"],
        records["rotation"].astype(np.float64) - 128.0,
        records["scales"],
        records["opacity"] / 255.0,
        colours_of(records["colour"] / 255.0),
    )


def _is_spz(data: bytes) -> bool:
    """Niantic's, by its first bytes, packed by gzip or not."""
    if data[:2] != b"\x1f\x8b":
        return data[:4] == b"NGSP"
    try:
        return zlib.decompressobj(31).decompress(data[:4096], 4) == b"NGSP"
    except zlib.error:
        return False


def _are_records(data: bytes, size: int) -> bool:
    """Whether bytes are those of `.splat`: most of the first have rotations of length one, and sizes."""
    if size == 0 or size % _RECORD.itemsize:
        return False
    records: NDArray[np.void] = np.frombuffer(data, _RECORD, min(len(data) // _RECORD.itemsize, _LOOKED_AT))
    with np.errstate(invalid="ignore", over="ignore"):
        length = np.linalg.norm((records["rotation"].astype(np.float64) - 128.0) / 128.0, axis=1)
        sized = ((records["scales"] >= 0.0) & (records["scales"] < 1e6)).all(axis=1)
        placed = (np.abs(records["means"]) < 1e9).all(axis=1)
    return bool(np.mean((np.abs(length - 1.0) < 0.1) & sized & placed) > 0.8)
