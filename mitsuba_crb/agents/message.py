"""What an agent sends about a pose: an information matrix in some 200 bytes, never over-confident.

A message carries the information of one agent, or of one tile of its image, about one pose, as rounded by
`quantisation`: decoded ⪯ encoded. It also bounds the uncertainty of the estimate (`entry_noise`), so that a
receiver does not take noise in unseen directions for information. Receivers combine messages in an
`InformationFilter`. Layout: `message_layout`; conventions: `se3`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from numbers import Integral

import numpy as np

from ..errors import MessageError
from ..files import Record
from ..information.fisher import FisherInformation
from ..information.symmetric import congruence
from ..se3 import Array
from . import message_layout
from .entry_noise import noise_bound
from .message_layout import LARGEST_COORDINATE, NUMBER_BYTES, Fields, Tile
from .quantisation import FORMS, Form, Precision, QuantisedInformation, kept_fraction, quantise


@dataclass(frozen=True, eq=False)
class Message(Record):
    """A decoded message."""

    agent: str
    """Who sent it."""
    sequence: int
    """Its number; of messages about the same tile by the same agent, the highest is the newest."""
    tile: Tile | None
    """The part of the image that it is about; None for the whole."""
    information: FisherInformation
    """What is claimed, decoded. For a delta: what adds to its base, with the covariance of the whole."""
    base: tuple[int, int] | None
    """For a delta, sequence number and checksum of the message that it adds to."""
    quantised: QuantisedInformation
    """The numbers as sent, in the camera frame."""
    kept: float
    """Smallest fraction of the original's information kept in any direction sent, as the sender found it."""
    checksum: int
    """CRC-32 of the message."""
    size: int
    """Bytes."""

    def is_based_on(self, other: Message) -> bool:
        """Whether `other` is the complete message that this delta adds to."""
        return (
            other.base is None
            and (other.agent, other.tile) == (self.agent, self.tile)
            and (other.sequence, other.checksum) == self.base
        )

    def on(self, base: Message) -> FisherInformation:
        """The whole information that a delta and its base describe.

        Raises:
            MessageError: `base` is not the message that this one was made for.
            FrameError: the two are about different poses.
        """
        if not self.is_based_on(base):
            raise MessageError(
                f"message {self.sequence} of {self.agent!r} does not add to message {base.sequence} of "
                f"{base.agent!r}"
            )
        mine = self.information.to_frame("camera")
        whole = mine + base.information.to_frame("camera")
        return replace(mine, matrix=whole.matrix).to_frame(self.information.frame)


def message_size(
    *, agent: str, variable: str, form: Form = "factor", precision: Precision = "float32", rank: int = 6
) -> int:
    """Bytes of the message that `encode` would make; they do not depend on the information's values.

    Raises:
        MessageError: unknown form or precision, rank outside 1 to 6, or a name too long.
    """
    _check_form(form, precision, rank)
    return message_layout.size(agent, variable, form, precision, rank)


def encode(
    information: FisherInformation,
    *,
    agent: str,
    sequence: int,
    tile: Tile | None = None,
    form: Form = "factor",
    precision: Precision = "float32",
    rank: int = 6,
    base: Message | None = None,
) -> bytes:
    """A message whose decoded information is nowhere above `information`.

    Args:
        information: of a pose that sender and receivers know by the same name and linearisation; transport it
            first if they speak about a common body (`fusion`).
        agent: the sender's name, at most 255 bytes of UTF-8.
        sequence: counts up with every message of this agent.
        tile: x, y, width, height of the part of the image that it is about; None for the whole.
        form: `"factor"`; `"full"`, twice the numbers, for indefinite estimates and the smallest δ; `"sketch"`
            for few directions.
        precision: `"float16"` keeps at least 0.94 of F in every direction up to condition 1e4, `"float32"`
            0.99 up to 1e10; of a sketch, in the directions sent. Beyond, and for singular F, δ counts.
        rank: columns of a sketch.
        base: a complete message of the same agent and tile that receivers already have; only what has changed
            since is sent, and receivers without it cannot use the message.

    Raises:
        MessageError: something does not fit the layout, or the base belongs to another agent or tile.
        FrameError: the base is about another pose.
    """
    _check_form(form, precision, rank)
    _check_numbers(sequence, tile, information)
    camera = information.to_frame("camera")
    change = camera.matrix if base is None else _change(camera, base, agent, sequence, tile)
    quantised = quantise(change, form=form, precision=precision, rank=rank)
    decoded = quantised.matrix + (camera.matrix - change)
    T = congruence(np.diag(1.0 / quantised.row_scales))
    return message_layout.write(
        Fields(
            agent=agent,
            linearisation=information.linearisation,
            sequence=int(sequence),
            tile=tile,
            base=None if base is None else (base.sequence, base.checksum),
            quantised=quantised,
            noise=noise_bound(quantised.scaled_matrix, T @ camera.covariance_of_entries @ T.T),
            kept=kept_fraction(decoded, camera.matrix, quantised.rank if base is None else 6),
        )
    )


def decode(data: bytes) -> Message:
    """Read a message.

    Raises:
        MessageError: the bytes are no message: too short or long, another magic or version, a wrong checksum,
            or values that no encoder writes.
    """
    fields, checksum = message_layout.read(bytes(data))
    quantised = fields.quantised
    T = congruence(np.diag(quantised.row_scales))
    information = FisherInformation(
        matrix=quantised.matrix,
        covariance_of_entries=T @ fields.noise.covariance(quantised.scaled_matrix) @ T.T,
        linearisation=replace(fields.linearisation, frame="camera"),
    )
    return Message(
        agent=fields.agent,
        sequence=fields.sequence,
        tile=fields.tile,
        information=information.to_frame(fields.linearisation.frame),
        base=fields.base,
        quantised=quantised,
        kept=fields.kept,
        checksum=checksum,
        size=len(data),
    )


def _change(camera: FisherInformation, base: Message, agent: str, sequence: int, tile: Tile | None) -> Array:
    """(6, 6), the information beyond what a receiver of the base has decoded, in the camera frame."""
    if base.base is not None:
        raise MessageError("a delta needs a complete message as its base, not another delta")
    if (base.agent, base.tile) != (agent, tile):
        raise MessageError(
            f"the base is about tile {base.tile} of {base.agent!r}, the delta about tile {tile} of {agent!r}"
        )
    if base.sequence >= sequence:
        raise MessageError(f"a delta comes after its base: {sequence} is not above {base.sequence}")
    known = base.information.to_frame("camera")
    camera.linearisation.refuse_to_mix(known.linearisation, "send a change of information")
    return np.asarray(camera.matrix - known.matrix)


def _check_form(form: str, precision: str, rank: int) -> None:
    if form not in FORMS:
        raise MessageError(f"unknown form {form!r}; expected one of {', '.join(FORMS)}")
    if precision not in NUMBER_BYTES:
        raise MessageError(f"unknown precision {precision!r}; expected one of {', '.join(NUMBER_BYTES)}")
    if not 1 <= rank <= 6:
        raise MessageError(f"a sketch has 1 to 6 columns, not {rank}")


def _check_numbers(sequence: int, tile: Tile | None, information: FisherInformation) -> None:
    if not isinstance(sequence, Integral) or not 0 <= sequence < 2**64:
        raise MessageError(f"a sequence number is an integer from 0 to 2^64 - 1, not {sequence}")
    if tile is not None and not (
        len(tile) == 4 and all(isinstance(n, Integral) and 0 <= n < 2**16 for n in tile) and min(tile[2:]) > 0
    ):
        raise MessageError(f"a tile is x, y, width, height, integers up to 65535 and not empty, not {tile}")
    if information.selection.total >= 2**32:
        raise MessageError(f"a message counts up to 2^32 - 1 pixels, not {information.selection.total}")
    distance = max(float(np.abs(information.pose[:3, 3]).max()), information.length_scale)
    if distance > LARGEST_COORDINATE:
        raise MessageError(
            f"distances reach {distance:.3g} scene units, a message carries up to {LARGEST_COORDINATE:g}; "
            "move the world's origin or choose another unit"
        )
