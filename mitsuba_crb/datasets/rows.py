"""Rows of words in text files by others, with their line numbers; comments and blank lines are none."""

from __future__ import annotations

import re
from typing import NamedTuple

Row = tuple[int, list[str]]
"""Line number, counted from one, and words."""


class Rows(NamedTuple):
    """A text's rows, and its comments, which say what its columns are."""

    rows: list[Row]
    comments: list[str]


def rows_of(text: str, *, comment: str = "#") -> Rows:
    """Words separated by blanks, tabs, commas or semicolons; lines that begin with `#` are comments."""
    rows: list[Row] = []
    comments: list[str] = []
    for line_number, line in enumerate(text.splitlines(), 1):
        stripped = line.strip()
        if stripped.startswith(comment):
            comments.append(stripped.lstrip(comment).strip())
        elif stripped:
            rows.append((line_number, words(stripped)))
    return Rows(rows, comments)


def words(line: str) -> list[str]:
    """The words of a line; an empty one between two commas is a word, one after the last comma is none."""
    return re.split(r"\s*[,;]\s*|\s+", line.strip().rstrip(",;").rstrip())


def are_numbers(entries: list[str]) -> bool:
    """Whether each word is a number, NaN and infinities too."""
    try:
        return bool([float(entry) for entry in entries])
    except ValueError:
        return False


def first_row(text: str) -> str | None:
    """The first line that is neither blank nor a comment."""
    lines = (line.strip() for line in text.splitlines())
    return next((line for line in lines if line and not line.startswith("#")), None)
