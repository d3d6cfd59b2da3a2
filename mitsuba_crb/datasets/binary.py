"""COLMAP's binary files: little-endian records one after another, behind their number."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

from ..files.reading import Fault


class Cursor:
    """A place in a file's bytes, which moves on with what is read."""

    def __init__(self, data: bytes, path: Path, fault: Fault) -> None:
        self.data, self.path, self.fault, self.at = data, path, fault, 0

    def take(self, layout: str) -> tuple[Any, ...]:
        """The values of one record, in the letters of `struct`.

        Raises:
            fault: the file ends before.
        """
        record = struct.Struct(f"<{layout}")
        start = self.skip(record.size)
        return record.unpack_from(self.data, start)

    def skip(self, size: int) -> int:
        """Passes over so many bytes; where they began.

        Raises:
            fault: the file ends before.
        """
        start = self.at
        if start + size > len(self.data):
            raise self.fault(f"{self.path} is cut off: it ends within a record, at byte {len(self.data)}")
        self.at = start + size
        return start

    def text(self) -> str:
        """Up to the next null character.

        Raises:
            fault: there is none, or the text is no UTF-8.
        """
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise self.fault(f"{self.path} is cut off: it ends within a name, at byte {len(self.data)}")
        start = self.skip(end + 1 - self.at)
        try:
            return self.data[start:end].decode()
        except UnicodeDecodeError:
            raise self.fault(f"{self.path}: the name at byte {start} is no UTF-8 text") from None

    def end(self) -> None:
        """The place is the file's end.

        Raises:
            fault: bytes follow.
        """
        if self.at != len(self.data):
            raise self.fault(
                f"{self.path} has {len(self.data) - self.at} bytes behind its last record; is it damaged?"
            )


def is_binary(data: bytes) -> bool:
    """Whether bytes are no text: COLMAP's begin with a number of eight bytes, most of them null."""
    return min(data[:64], default=32) < 9
