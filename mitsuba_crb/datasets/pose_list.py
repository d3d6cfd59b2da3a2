"""Poses read from a file, with what the file calls them and the convention that was read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from ..errors import PoseError
from ..files import Record
from ..se3 import Array, as_pose
from .conventions import Convention, settled

# Rounded to three decimals, a quaternion's length is off by at most this.
_UNIT_TOLERANCE = 1e-3
_WORTH_SAYING = 1e-6


@dataclass(frozen=True, eq=False)
class Poses(Record):
    """Poses of a file."""

    poses: Array
    """(n, 4, 4) world_from_camera [scene unit], the camera's axes being ours (`se3`)."""
    names: tuple[str, ...]
    """What the file calls each: the digits of its time stamp, the name of its image, or its number."""
    format: str
    """The format's name."""
    convention: str
    """What was read, in a sentence: which way the poses map, and the axes."""
    cameras: tuple[str, ...] = ()
    """What the file calls the camera of each; empty if it does not say."""
    notes: tuple[str, ...] = ()
    """What was mended, in words."""

    def __len__(self) -> int:
        return len(self.poses)

    def __str__(self) -> str:
        some = "1 pose" if len(self) == 1 else f"{len(self)} poses"
        head = f"{some} of {self.format}, {self.names[0]} to {self.names[-1]}"
        return "\n".join([head, self.convention, *self.notes])


def listed(
    file: Path,
    given: Convention,
    custom: Convention,
    *,
    form: str,
    poses: Array,
    names: Sequence[str],
    notes: tuple[str, ...] = (),
    cameras: Sequence[str] = (),
    more: str = "",
    body: bool = False,
    fixed: bool = False,
) -> Poses:
    """Poses in our convention, with a sentence on theirs and on whence it is known.

    Args:
        file: that they were read from.
        given: what the user says of their convention.
        custom: the format's.
        form: the format's name.
        poses: (n, 4, 4) in their own convention.
        names: see `Poses`, as `notes` and `cameras`.
        more: ends the sentence.
        body: the poses are those of a body that carries the camera.
        fixed: the format defines its convention.

    Raises:
        PoseError: the user contradicts the format.
    """
    convention = settled(given, custom, str(file), fixed=fixed)
    known = "" if fixed else ", as given" if given.axes else ", by custom, as the file does not say"
    if convention.body_from_camera is not None:
        known += "; of a body, and carried to its camera by body_from_camera"
    elif body:
        known += (
            "; of the body, not of a camera: give --body-from-camera (body_from_camera=) of its calibration"
        )
    words = f"{convention.words}{known}{more}"
    return Poses(convention.ours(poses), tuple(names), form, words, tuple(cameras), notes)


def from_matrices(matrices: ArrayLike, wheres: Sequence[str]) -> tuple[Array, tuple[str, ...]]:
    """Rigid motions (n, 4, 4), and notes on what was rounding.

    Args:
        matrices: (n, 4, 4) or (n, 3, 4).
        wheres: what messages call each.

    Raises:
        PoseError: one is no rigid motion.
    """
    given = np.asarray(matrices, dtype=np.float64)
    if given.shape[1:] == (3, 4):
        last = np.broadcast_to([[0.0, 0.0, 0.0, 1.0]], (len(given), 1, 4))
        given = np.concatenate([given, last], axis=1)
    rigid = np.array([as_pose(matrix, where) for matrix, where in zip(given, wheres, strict=True)])
    deviation = float(np.abs(rigid - given).max(initial=0.0))
    return rigid, _noted("the rotations' entries", deviation)


def from_quaternions(
    positions: ArrayLike, quaternions: ArrayLike, wheres: Sequence[str]
) -> tuple[Array, tuple[str, ...]]:
    """Rigid motions (n, 4, 4), and notes on what was rounding.

    Args:
        positions: (n, 3).
        quaternions: (n, 4), x, y, z, w.
        wheres: what messages call each.

    Raises:
        PoseError: a number is not finite, or a quaternion's length is not one.
    """
    t, q = np.asarray(positions, dtype=np.float64), np.asarray(quaternions, dtype=np.float64)
    finite = np.isfinite(t).all(axis=1) & np.isfinite(q).all(axis=1)
    if not finite.all():
        raise PoseError(f"{wheres[int(np.argmin(finite))]} has numbers that are NaN or infinite")
    with np.errstate(over="ignore"):
        length = np.linalg.norm(q, axis=1)
    off = np.abs(length - 1.0)
    if off.max(initial=0.0) > _UNIT_TOLERANCE:
        k = int(np.argmax(off > _UNIT_TOLERANCE))
        raise PoseError(
            f"{wheres[k]} has a quaternion of length {length[k]:.6g}, not 1; are the columns those of this "
            "format, and is it normalised?"
        )
    poses = np.tile(np.eye(4), (len(t), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(q).as_matrix()
    poses[:, :3, 3] = t
    return poses, _noted("the quaternions' lengths", float(off.max(initial=0.0)))


def _noted(what: str, deviation: float) -> tuple[str, ...]:
    if deviation <= _WORTH_SAYING:
        return ()
    return (f"{what} were off by up to {deviation:.1g}, as by rounding, and were made exact",)
