"""What a receiver knows about one pose: the sum of the newest messages about it, whatever way they came.

The state is the set of messages received, and the information a function of that set alone. Hence messages
may come late, twice or in any order: the result is the same, to the last bit. A lost one costs information
and nothing else. Of the messages by one agent about one tile the newest counts, since each tells all that the
agent knows of that tile; a delta counts if its base is there. No pixel counts twice: a message about an
agent's whole image stands in place of those about its tiles, and of tiles that overlap only one counts.

A moving body is predicted, in information form and so with singular F, as

    F⁺ = (1 + F Q)⁻¹ F,    F = Aᵀ F_now A,    A = Ad(now_from_next),

Q the covariance of the motion's error. That is no linear map: it would turn unresolved noise into something
that looks resolved, so that what F does not see for certain (`significance`) is given up first. The
linearisation pose moves along, and with it the pose that messages must be about.

Reference: Thrun, Burgard and Fox, "Probabilistic Robotics", 2005, section 3.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .. import se3
from ..errors import FrameError, FusionError
from ..files import Record
from ..information.fisher import FisherInformation
from ..information.significance import seen_root
from ..information.symmetric import congruence, symmetrised
from ..noise.covariance import positive_matrix
from ..se3 import Array
from .message import Message, decode


@dataclass(frozen=True, eq=False)
class Contribution(Record):
    """What one message, or a delta and its base, adds."""

    message: Message
    """The newest usable one about its tile."""
    information: FisherInformation
    """In the camera frame."""


class InformationFilter:
    """Receives messages about one pose and adds up what they tell.

    All messages are kept, because a delta may still come for any of them: memory grows with the number of
    different messages, a few kilobytes each.
    """

    def __init__(self, prior: FisherInformation) -> None:
        """Start from what is known beforehand, which says what the messages must be about.

        Args:
            prior: of the pose; its variable and linearisation pose are those of all messages.
                `no_information` where nothing is known.
        """
        self._prior = prior.to_frame("camera")
        self._messages: dict[bytes, Message] = {}

    def receive(self, data: bytes) -> Message:
        """Take a message into account; where it is refused, the filter stays as it was.

        Returns:
            The message as decoded. It need not change anything: it may be an old one, or wait for its base.

        Raises:
            MessageError: the bytes are corrupt.
            FrameError: the message is about another variable or linearisation pose.
        """
        data = bytes(data)
        if data not in self._messages:
            self._messages[data] = self._accepted(decode(data))
        return self._messages[data]

    @property
    def information(self) -> FisherInformation:
        """What is known now, in the camera frame."""
        total = self._prior
        for contribution in self.contributions:
            total = total + contribution.information
        return total

    @property
    def contributions(self) -> tuple[Contribution, ...]:
        """The messages that count, by agent and tile."""
        newest: dict[tuple[str, tuple[int, ...]], Contribution] = {}
        bases = self._bases()
        # By content where agent, tile and number agree, which they should not: still no order of arrival.
        for _, message in sorted(self._messages.items(), key=lambda item: (item[1].sequence, item[0])):
            base = None if message.base is None else bases.get(_needs(message))
            if message.base is None:
                newest[message.agent, message.tile or ()] = Contribution(message, message.information)
            elif base is not None:
                newest[message.agent, message.tile or ()] = Contribution(message, message.on(base))
        agents: dict[str, list[Contribution]] = {}
        for (agent, _), contribution in newest.items():
            agents.setdefault(agent, []).append(contribution)
        return tuple(chain.from_iterable(_without_overlap(agents[name]) for name in sorted(agents)))

    @property
    def waiting(self) -> tuple[Message, ...]:
        """Deltas that do not count because their base has not come."""
        bases = self._bases()
        deltas = (message for message in self._messages.values() if message.base is not None)
        return tuple(message for message in deltas if _needs(message) not in bases)

    def predicted(self, now_from_next: ArrayLike, motion_covariance: ArrayLike) -> InformationFilter:
        """The filter after the body has moved; it expects messages linearised at the new pose.

        Args:
            now_from_next: the motion, the body's next pose seen from the present one, 4 x 4.
            motion_covariance: (6, 6), Q of the motion's error, a right twist at the next pose.

        Raises:
            PoseError: the motion is not rigid.
            FusionError: Q is not symmetric positive semi-definite.
        """
        motion = se3.as_pose(now_from_next)
        Q = positive_matrix(motion_covariance, "a motion's covariance", FusionError, size=6)
        now = self.information
        moved = now.transform(
            se3.adjoint(motion), variable=now.variable, frame="camera", pose=now.pose @ motion
        )
        return InformationFilter(_diffused(moved, Q) if Q.any() else moved)

    def _bases(self) -> dict[tuple[Any, ...], Message]:
        complete = (message for message in self._messages.values() if message.base is None)
        return {(m.agent, m.tile, m.sequence, m.checksum): m for m in complete}

    def _accepted(self, message: Message) -> Message:
        """The message in the camera frame and at exactly the filter's pose."""
        information = message.information.to_frame("camera")
        try:
            self._prior.linearisation.refuse_to_mix(information.linearisation, "add information")
        except FrameError as error:
            raise FrameError(f"message {message.sequence} of {message.agent!r}: {error}") from None
        return replace(message, information=information.about(pose=self._prior.pose))


def _needs(delta: Message) -> tuple[Any, ...]:
    return (delta.agent, delta.tile, *(delta.base or ()))


def _without_overlap(contributions: Sequence[Contribution]) -> list[Contribution]:
    """The whole image alone if it is there, otherwise tiles that share no pixel, large ones first."""
    kept: list[Contribution] = []
    for contribution in sorted(contributions, key=_largest_first):
        if not any(_overlap(contribution.message, other.message) for other in kept):
            kept.append(contribution)
    return kept


def _largest_first(contribution: Contribution) -> tuple[float, tuple[int, ...]]:
    tile = contribution.message.tile
    return (-np.inf, ()) if tile is None else (-tile[2] * tile[3], tile)


def _overlap(a: Message, b: Message) -> bool:
    if a.tile is None or b.tile is None:
        return True
    (ax, ay, aw, ah), (bx, by, bw, bh) = a.tile, b.tile
    return ax < bx + bw and bx < ax + aw and ay < by + bh and by < ay + ah


def _diffused(information: FisherInformation, Q: Array) -> FisherInformation:
    """(1 + F Q)⁻¹ F of the part of F that is seen; to first order δF⁺ = Gᵀ δF G, G = (1 + Q F)⁻¹."""
    root = seen_root(information)
    # With F = R Rᵀ, (1 + F Q)⁻¹ F = R (1 + Rᵀ Q R)⁻¹ Rᵀ, whose middle is symmetric positive definite.
    middle = np.linalg.inv(np.eye(root.shape[1]) + root.T @ Q @ root)
    matrix = symmetrised(root @ middle @ root.T)
    T = congruence(np.eye(6) - Q @ matrix)
    covariance = T @ information.covariance_of_entries @ T.T
    return replace(information, matrix=matrix, covariance_of_entries=covariance, plain_matrix=None)
