"""The bytes of a message: a header of fixed layout, two names, rounded numbers, a checksum.

Little endian, no padding:

    offset  type    what
    0       4s      magic b"MCRB"
    4       u8      version, 1
    5       u8      form: 0 full, 1 factor, 2 sketch
    6       u8      bytes per number: 2 float16, 4 float32
    7       u8      frame in which the sender speaks: 0 camera, 1 world; the numbers are in the camera frame
    8       u8      k, the directions sent: the columns of a sketch, 6 in the other forms
    9       u8      bit i set: column i of the sketch is subtracted
    10      u8      bytes of the agent's name
    11      u8      bytes of the variable's name
    12      u8      pixels: 0 all, 1 random, 2 only
    13      u8      1 for a delta, whose numbers add to those of its base
    14      u16     smallest fraction kept of the k directions, times 65535, rounded down
    16      6 x i8  exponents of the row scaling
    22      u64     sequence number
    30      u64     a delta's base: its sequence number, or 0
    38      u32     a delta's base: its checksum, or 0
    42      4 x u16 tile: x, y, width, height [pixel]; zeros for the whole image
    50      u32     pixels of the image
    54      u32     pixels selected
    58      7 x f64 linearisation pose world_from_camera: x y z [scene unit], qx qy qz qw
    114     f64     length scale [scene unit]
    122     f32     α
    126     f32     δ
    130     f32     c
    134     f32     η
    138     6 x i8  exponents of n, in halves
    144     utf-8   agent's name, variable's name
    ...     f16/f32 the numbers: 42 of the full form, 21 of the factor, 6 k of a sketch
    ...     u32     CRC-32 of everything before

α, δ and the numbers are explained in `quantisation`, c, η and n in `entry_noise`, conventions in `se3`. A
good checksum proves nothing about the sender: every field is checked, so that no message makes a number
overflow.
"""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from .. import se3
from ..errors import MessageError
from ..information.linearisation import Linearisation, PixelSelection
from ..se3 import Array, Frame
from .entry_noise import LARGEST_INFLATION, NoiseBound
from .quantisation import (
    FORMS,
    LARGEST_NUMBER,
    LARGEST_SCALE,
    LARGEST_SHIFT,
    Form,
    Precision,
    QuantisedInformation,
    number_count,
)

MAGIC = b"MCRB"
VERSION = 1

LARGEST_COORDINATE = 1e12
"""Largest distance from the origin: beyond any geo-reference, and small enough that no product overflows."""

NUMBER_BYTES: dict[Precision, int] = {"float16": 2, "float32": 4}

Tile = tuple[int, int, int, int]
"""Left column x, top row y, width and height [pixel]."""

_HEADER = struct.Struct("<4s10BH6bQQI4HII7dd4f6b")
_CHECKSUM = struct.Struct("<I")
_FRAMES: tuple[Frame, ...] = ("camera", "world")
_KINDS: tuple[Literal["all", "random", "only"], ...] = ("all", "random", "only")
_PRECISIONS = {size: precision for precision, size in NUMBER_BYTES.items()}
_QUATERNION_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class Fields:
    """What a message says."""

    agent: str
    linearisation: Linearisation
    sequence: int
    tile: Tile | None
    base: tuple[int, int] | None
    """A delta's base: sequence number and checksum."""
    quantised: QuantisedInformation
    noise: NoiseBound
    kept: float
    """Within [0, 1]."""


def size(agent: str, variable: str, form: Form, precision: Precision, rank: int) -> int:
    """Bytes of a message."""
    names = len(_encoded(agent, "agent")) + len(_encoded(variable, "variable"))
    return _HEADER.size + names + number_count(form, rank) * NUMBER_BYTES[precision] + _CHECKSUM.size


def write(fields: Fields) -> bytes:
    """The message as bytes.

    Raises:
        MessageError: a name is empty or longer than 255 bytes.
    """
    about, quantised = fields.linearisation, fields.quantised
    agent, variable = _encoded(fields.agent, "agent"), _encoded(about.variable, "variable")
    header = _HEADER.pack(
        MAGIC,
        VERSION,
        FORMS.index(quantised.form),
        NUMBER_BYTES[quantised.precision],
        _FRAMES.index(about.frame),
        quantised.rank,
        sum(1 << i for i, sign in enumerate(quantised.signs) if sign < 0),
        len(agent),
        len(variable),
        _KINDS.index(about.selection.kind),
        0 if fields.base is None else 1,
        math.floor(fields.kept * 65535),
        *quantised.exponents.tolist(),
        fields.sequence,
        *(fields.base or (0, 0)),
        *(fields.tile or (0, 0, 0, 0)),
        about.selection.total,
        about.selection.selected,
        *about.pose[:3, 3],
        *Rotation.from_matrix(about.pose[:3, :3]).as_quat(),
        about.length_scale,
        quantised.scale,
        quantised.shift,
        fields.noise.inflation,
        fields.noise.like_signal,
        *fields.noise.row_exponents.tolist(),
    )
    numbers = quantised.numbers.astype(np.dtype(quantised.precision).newbyteorder("<")).tobytes()
    body = header + agent + variable + numbers
    return body + _CHECKSUM.pack(zlib.crc32(body))


def read(data: bytes) -> tuple[Fields, int]:
    """What a message says, and its checksum.

    Raises:
        MessageError: too short or long, another magic or version, a wrong checksum, or an impossible value.
    """
    if len(data) < _HEADER.size + _CHECKSUM.size:
        raise MessageError(f"a message has at least {_HEADER.size + _CHECKSUM.size} bytes, not {len(data)}")
    if data[:4] != MAGIC:
        raise MessageError(f"no message: it starts with {data[:4]!r}, not {MAGIC!r}")
    if data[4] != VERSION:
        raise MessageError(f"message version {data[4]}; this library reads version {VERSION}")
    body, (checksum,) = data[: -_CHECKSUM.size], _CHECKSUM.unpack(data[-_CHECKSUM.size :])
    if zlib.crc32(body) != checksum:
        raise MessageError("the message is corrupt: its checksum does not match")
    return _parse(_HEADER.unpack_from(body), body[_HEADER.size :]), checksum


def _parse(header: tuple[Any, ...], tail: bytes) -> Fields:
    form_code, number_bytes, frame, rank, subtracted, agent_bytes, variable_bytes, kind, delta, kept = header[
        2:12
    ]
    sequence, base_sequence, base_checksum = header[18:21]
    tile, (total, selected) = header[21:25], header[25:27]
    length_scale, scale, shift, inflation, like_signal = header[34:39]

    _require(form_code < len(FORMS), "form", form_code)
    form = FORMS[form_code]
    columns = rank if form == "sketch" else 0
    _require(number_bytes in _PRECISIONS, "number of bytes per number", number_bytes)
    _require(frame < len(_FRAMES), "frame", frame)
    _require(1 <= rank <= 6 if form == "sketch" else rank == 6, "rank", rank)
    _require(subtracted < 1 << columns, "sign of a column", subtracted)
    _require(kind < len(_KINDS), "kind of pixels", kind)
    _require(delta < 2, "delta flag", delta)
    _require(bool(delta) or (base_sequence, base_checksum) == (0, 0), "base", base_sequence)
    _require(not any(tile) or min(tile[2:]) > 0, "tile", tile)
    _require(0.0 < length_scale <= LARGEST_COORDINATE, "length scale", length_scale)

    names = agent_bytes + variable_bytes
    expected = names + number_count(form, rank) * number_bytes
    if len(tail) != expected:
        raise MessageError(f"{len(tail)} bytes follow the message's header, which announces {expected}")
    agent = _decoded(tail[:agent_bytes], "agent")
    precision = _PRECISIONS[number_bytes]
    return Fields(
        agent=agent,
        linearisation=Linearisation(
            variable=_decoded(tail[agent_bytes:names], "variable"),
            frame=_FRAMES[frame],
            pose=_pose(header[27:34]),
            length_scale=length_scale,
            selection=PixelSelection(_KINDS[kind], total, selected, f"message {sequence} of {agent}"),
        ),
        sequence=sequence,
        tile=tile if any(tile) else None,
        base=(base_sequence, base_checksum) if delta else None,
        quantised=QuantisedInformation(
            form,
            precision,
            _numbers(tail[names:], precision),
            np.array([-1 if subtracted >> i & 1 else 1 for i in range(columns)], dtype=np.int8),
            np.array(header[12:18], dtype=np.int8),
            _within(scale, LARGEST_SCALE, "α"),
            _within(shift, LARGEST_SHIFT, "δ"),
        ),
        noise=NoiseBound(
            _within(inflation, LARGEST_INFLATION, "c"),
            _within(like_signal, 1.0, "η"),
            np.array(header[39:45], dtype=np.int8),
        ),
        kept=kept / 65535,
    )


def _numbers(data: bytes, precision: Precision) -> Array:
    # A signalling NaN warns when it is converted.
    with np.errstate(invalid="ignore"):
        numbers = np.frombuffer(data, dtype=np.dtype(precision).newbyteorder("<")).astype(np.float64)
    # Written so that NaN fails, too.
    _require(bool((np.abs(numbers) <= LARGEST_NUMBER).all()), "number", numbers)
    return numbers


def _pose(values: tuple[float, ...]) -> Array:
    _require(all(abs(x) <= LARGEST_COORDINATE for x in values[:3]), "position", values[:3])
    # By components first: the square of a huge one would overflow.
    unit = all(abs(q) <= 2.0 for q in values[3:])
    unit = unit and abs(math.hypot(*values[3:]) - 1.0) <= _QUATERNION_TOLERANCE
    _require(unit, "quaternion", values[3:])
    return se3.pose_from_vector(values)


def _within(value: float, largest: float, what: str) -> float:
    _require(0.0 <= value <= largest, what, value)
    return value


def _require(condition: bool, what: str, value: object) -> None:
    if not condition:
        raise MessageError(f"the message has a good checksum, but an impossible {what}: {value}")


def _encoded(name: str, what: str) -> bytes:
    encoded = name.encode()
    if not 1 <= len(encoded) <= 255:
        raise MessageError(f"the name of the {what} must have 1 to 255 bytes of UTF-8, not {len(encoded)}")
    return encoded


def _decoded(data: bytes, what: str) -> str:
    try:
        name = data.decode()
    except UnicodeDecodeError:
        raise MessageError(f"the name of the {what} in the message is no UTF-8") from None
    if not name:
        raise MessageError(f"the message names no {what}")
    return name
