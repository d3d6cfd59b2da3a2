"""Poses in rows of numbers: TUM, KITTI, EuRoC, Tanks and Temples' `.log`, and plain matrices.

    TUM     tx ty tz qx qy qz qw, mostly behind a time stamp
    EuRoC   time, px, py, pz, qw, qx, qy, qz, and more
    KITTI   r11 r12 r13 tx r21 ... tz, in KITTI-360 behind a number
    .log    three numbers, then a 4x4 matrix in four lines
    matrices of 16 numbers in a line, or of four lines

The first four are by custom world_from_camera in axes x right, y down, z forward (EuRoC: world_from_body);
plain matrices are ours.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..errors import PoseError
from ..files import read_text
from .conventions import ORDERS, Convention
from .entries import number
from .headers import Columns, columns_of
from .pose_list import Poses, from_matrices, from_quaternions, listed
from .rows import Row, are_numbers, rows_of

KNOWN = (
    "TUM, KITTI, EuRoC's csv, COLMAP's images.txt and images.bin, transforms.json, LLFF's poses_bounds.npy, "
    "INRIA's cameras.json, Tanks and Temples' .log, and 4x4 matrices as text, .npy or JSON"
)
"""All formats of poses, in words."""

_CAMERA = Convention("opencv", "world_from_camera")
_OURS = Convention("mitsuba", "world_from_camera")
_MATRICES = {
    12: "KITTI",
    13: "KITTI-360",
    16: "matrices of 16 numbers",
    17: "numbered matrices of 16 numbers",
}
"""Formats by the number of columns: of a matrix by rows, with or without a number before it."""


def trajectory(path: Path, given: Convention) -> Poses:
    """The poses in a text of rows of numbers.

    Raises:
        PoseError: the rows are of none of the formats, or of several, or are no poses.
    """
    text = read_text(path, PoseError)
    rows, comments = rows_of(text)
    if rows and not _is_row(rows[0][1]):  # a header
        comments.append(text.splitlines()[rows[0][0] - 1])
        rows = rows[1:]
    if not rows or not _is_row(rows[0][1]):
        raise PoseError(f"{path} has no rows of numbers; known are files of poses of {KNOWN}")
    for line, words in rows:
        for word in words:
            number(word, f"{path}, line {line}: an entry", PoseError)
    counts = [len(words) for _, words in rows]
    if counts[:5] == [3, 4, 4, 4, 4]:
        return _log(path, rows, given)
    _check_mixed(path, rows, counts)
    if counts[0] == 4:
        return _blocks(path, rows, given)
    columns = columns_of(comments)
    if columns is None and counts[0] in _MATRICES and not (counts[0] == 17 and _is_euroc(rows[0][1])):
        return _matrices(path, rows, given)
    commas = any("," in line for line in text.splitlines() if not line.lstrip().startswith("#"))
    return _quaternions(path, rows, columns, given, commas=commas)


def _is_row(words: Sequence[str]) -> bool:
    """Whether most words are numbers: a damaged row is none the less a row, no header."""
    return 2 * sum(are_numbers([word]) for word in words) > len(words)


def _check_mixed(path: Path, rows: list[Row], counts: list[int]) -> None:
    """Refuses rows of several formats."""
    for (line, _), count in zip(rows, counts, strict=True):
        if count != counts[0]:
            raise PoseError(
                f"{path}, line {line} has {count} numbers, and line {rows[0][0]} has {counts[0]}; a file has "
                "poses of one format"
            )


def _is_euroc(words: Sequence[str]) -> bool:
    """Whether 17 numbers are no numbered matrix, whose last row is 0 0 0 1."""
    return [float(word) for word in words[-4:]] != [0.0, 0.0, 0.0, 1.0]


def _quaternions(
    path: Path, rows: list[Row], columns: Columns | None, given: Convention, *, commas: bool
) -> Poses:
    count = len(rows[0][1])
    if columns is not None and columns.number != count:
        raise PoseError(
            f"{path}: its header names {columns.number} columns, and line {rows[0][0]} has {count} numbers"
        )
    if columns is None and count not in (7, 8, 17):
        raise PoseError(
            f"{path}, line {rows[0][0]} has {count} numbers; a pose has 7 (x y z and a quaternion), 8 (TUM: "
            "behind a time stamp), 12 (KITTI) or 16 (a 4x4 matrix)"
        )
    if columns is None:
        columns = _without_header(path, rows[0][1], given, commas=commas)
    else:
        _check_order(path, columns, given, commas=commas)
    numbers = np.array([words for _, words in rows], dtype=np.float64)
    wheres = [f"{path}, line {line}" for line, _ in rows]
    poses, notes = from_quaternions(
        numbers[:, list(columns.position)], numbers[:, list(columns.quaternion)], wheres
    )
    return listed(
        path,
        given,
        Convention(_CAMERA.axes, _CAMERA.maps, columns.order),
        form="EuRoC" if columns.euroc else "TUM",
        poses=poses,
        names=[str(k) if columns.time is None else words[columns.time] for k, (_, words) in enumerate(rows)],
        notes=notes,
        body=columns.euroc,
    )


def _check_order(path: Path, columns: Columns, given: Convention, *, commas: bool) -> None:
    """Refuses a header that contradicts its format; the convention may confirm it."""
    custom = "wxyz" if columns.euroc else columns.order if commas else "xyzw"
    expected = given.order or custom
    if columns.order != expected:
        whose = "the convention" if given.order else "EuRoC's format" if columns.euroc else "TUM's format"
        raise PoseError(
            f"{path}: its header has quaternions in the order {' '.join(columns.order)}, and {whose} in "
            f"{' '.join(expected)}; mend the header, or confirm it by the convention {columns.order}"
        )


def _without_header(path: Path, words: Sequence[str], given: Convention, *, commas: bool) -> Columns:
    """The columns of rows like this one, by custom."""
    count = len(words)
    euroc = count == 17 or (commas and count == 8 and bool(re.fullmatch(r"\d{15,}", words[0])))
    if euroc and given.order is None:
        raise PoseError(
            f"{path} is like EuRoC's files, but has no header that says where the quaternion's w is; "
            f"give the convention {' or '.join(ORDERS)}"
        )
    first = 0 if count == 7 else 1
    turns = [first + 3 + (given.order or "xyzw").index(axis) for axis in "xyzw"]
    return Columns(count, 0 if first else None, (first, first + 1, first + 2), tuple(turns), euroc)


def _matrices(path: Path, rows: list[Row], given: Convention) -> Poses:
    count = len(rows[0][1])
    numbered = count in (13, 17)
    values = np.array([words[numbered:] for _, words in rows], dtype=np.float64)
    wheres = [f"{path}, line {line}: the pose" for line, _ in rows]
    poses, notes = from_matrices(values.reshape(len(rows), -1, 4), wheres)
    return listed(
        path,
        given,
        _CAMERA if count in (12, 13) else _OURS,
        form=_MATRICES[count],
        poses=poses,
        names=[words[0] if numbered else str(k) for k, (_, words) in enumerate(rows)],
        notes=notes,
    )


def _blocks(path: Path, rows: list[Row], given: Convention) -> Poses:
    if len(rows) % 4:
        raise PoseError(f"{path} has {len(rows)} lines of four numbers, which make no whole 4x4 matrices")
    values = np.array([words for _, words in rows], dtype=np.float64).reshape(-1, 4, 4)
    wheres = [f"{path}, line {rows[4 * k][0]}: the pose" for k in range(len(values))]
    poses, notes = from_matrices(values, wheres)
    names = [str(k) for k in range(len(values))]
    return listed(path, given, _OURS, form="4x4 matrices", poses=poses, names=names, notes=notes)


def _log(path: Path, rows: list[Row], given: Convention) -> Poses:
    blocks = [rows[k : k + 5] for k in range(0, len(rows), 5)]
    for block in blocks:
        if [len(words) for _, words in block] != [3, 4, 4, 4, 4]:
            raise PoseError(
                f"{path}, line {block[0][0]}: expected three numbers and four lines of four, as in a .log of "
                "Tanks and Temples"
            )
    values = np.array([[words for _, words in block[1:]] for block in blocks], dtype=np.float64)
    poses, notes = from_matrices(values, [f"{path}, line {block[1][0]}: the pose" for block in blocks])
    names = [block[0][1][0] for block in blocks]
    return listed(path, given, _CAMERA, form="Tanks and Temples", poses=poses, names=names, notes=notes)
