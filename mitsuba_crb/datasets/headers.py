"""What the header of a table of poses says of its columns."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import NamedTuple

_UNIT = re.compile(r"[\[(][^\])\s]*[\])]")
_COMPONENT = r"(?:[_. ]\w+)*?[_. ]?"
"""What may stand between a quantity and its axis: q_RS_w, pose.orientation.x."""
_QUATERNION = re.compile(rf"(?:^|[./ ])(?:q|quat\w*|orientation|ori|rot\w*){_COMPONENT}([wxyz])$")
_POSITION = re.compile(rf"(?:(?:^|[./ ])(?:t|p|pos|position|trans\w*){_COMPONENT}|^)([xyz])$")
_TIME = re.compile(r"time|stamp|^t$|^ts$|\bsec")


class Columns(NamedTuple):
    """Of a table: where what is in it."""

    number: int
    """How many there are."""
    time: int | None
    """The time stamp's."""
    position: tuple[int, ...]
    """Those of x, y, z."""
    quaternion: tuple[int, ...]
    """Those of x, y, z, w."""
    euroc: bool
    """The names are EuRoC's, whose quaternions have w first."""

    @property
    def order(self) -> str:
        """Of the quaternion's numbers, from left to right."""
        left_to_right = sorted(range(4), key=lambda k: self.quaternion[k])
        return "".join("xyzw"[k] for k in left_to_right)


def columns_of(lines: Iterable[str]) -> Columns | None:
    """Of the last line that names the columns of a position and a quaternion; None if no line does."""
    found = None
    for line in lines:
        found = _columns(line) or found
    return found


def quaternion_order(lines: Iterable[str]) -> str | None:
    """Of a quaternion's numbers, from left to right; None if no line says it."""
    columns = columns_of(lines)
    return None if columns is None else columns.order


def _columns(line: str) -> Columns | None:
    text = _UNIT.sub("", line.lower().rpartition(":")[2]).strip("#% \t()[]")
    names = re.split(r"[,;\t]", text) if re.search(r"[,;\t]", text) else text.split()
    names = [name.strip().strip("'\"") for name in names]
    while names and not names[-1]:
        names.pop()
    quaternion = {found.group(1): k for k, name in enumerate(names) if (found := _QUATERNION.search(name))}
    position = {
        found.group(1): k
        for k, name in enumerate(names)
        if k not in quaternion.values() and (found := _POSITION.search(name))
    }
    if len(quaternion) != 4 or len(position) != 3:
        return None
    time = next((k for k, name in enumerate(names) if _TIME.search(name)), None)
    return Columns(
        len(names),
        time,
        tuple(position[axis] for axis in "xyz"),
        tuple(quaternion[axis] for axis in "xyzw"),
        any(re.match(r"q_\w+_[wxyz]$", name) for name in names),
    )
