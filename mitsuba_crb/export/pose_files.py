"""The bounds of many poses in files: JSON lines and CSV, row by row as they are done, and Parquet.

A line is appended when its pose is done, and says what it depends on. So the file of a run that was
interrupted is its record: the same command goes on from it, and another one is refused. A last line that was
cut short is the only thing that is ever taken away.
"""

from __future__ import annotations

import csv
import importlib
import io
import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import OutputError
from ..files import atomic, changes, jsonable
from ..measure.pose_table import PoseRow, PoseTable
from ..se3 import Array
from .documents import bound_document

if TYPE_CHECKING:
    from ..bound.cramer_rao import PoseBound

JSON_START = '{"index": '
CSV_START = "index,name,"
BEGINNINGS = (JSON_START.encode(), CSV_START.encode())
"""How a file of either kind begins."""
_ADVICE = "name another file, or use the same settings and poses to resume"


@dataclass
class _Lines:
    """A file that grows line by line."""

    path: Path
    values: dict[int, dict[str, Any]] = field(default_factory=dict)
    """By their place, what has been read."""
    settings: dict[str, Any] | None = None
    """Of the rows that it has."""
    whole: int = 0
    """Bytes up to the end of the last whole line."""
    size: int = 0
    """Bytes of the file, as this run knows it."""

    def text(self) -> str:
        """Its whole lines."""
        if not os.path.lexists(self.path):
            return ""
        try:
            data = self.path.read_bytes()
        except OSError as error:
            raise OutputError(f"cannot read {self.path}: {error.strerror or error}") from error
        self.whole, self.size = data.rfind(b"\n") + 1, len(data)
        return data[: self.whole].decode()

    def keep(self, index: Any, values: dict[str, Any], settings: dict[str, Any]) -> None:
        """A row that has been read."""
        if self.settings is not None and settings != self.settings:
            raise ValueError("its rows have different settings")
        self.settings = settings
        self.values[int(index)] = values

    def append(self, text: str) -> None:
        """Write what comes after the last whole line.

        Raises:
            OutputError: it cannot be written, or somebody else has written meanwhile.
        """
        data = text.encode()
        try:
            with self.path.open("r+b" if os.path.lexists(self.path) else "xb") as file:
                if os.fstat(file.fileno()).st_size != self.size:
                    raise OutputError(f"{self.path} was changed meanwhile; does another run write to it?")
                file.seek(self.whole)
                file.truncate()
                file.write(data)
        except OSError as error:
            raise OutputError(f"cannot write {self.path}: {error.strerror or error}") from error
        self.whole += len(data)
        self.size = self.whole


class PoseFiles:
    """The record of a run in JSON lines, in CSV, or in both."""

    def __init__(self, json_file: Path | None = None, csv_file: Path | None = None) -> None:
        """Of files that are there or are not.

        Raises:
            OutputError: one is there, and is something else.
        """
        self._json = None if json_file is None else _read(json_file, _read_json)
        self._csv = None if csv_file is None else _read(csv_file, _read_csv)

    @property
    def _files(self) -> list[_Lines]:
        """That which is resumed first: of two the JSON lines, whose documents no row can replace."""
        return [lines for lines in (self._json, self._csv) if lines is not None]

    def earlier(self) -> dict[str, Any] | None:
        """See `PoseRecord`."""
        return next((lines.settings for lines in self._files if lines.settings is not None), None)

    def resume(self, settings: dict[str, Any], poses: Sequence[Array]) -> dict[int, PoseRow]:
        """See `PoseRecord`.

        Raises:
            OutputError: the settings were others; names them.
        """
        self._settings = json.loads(json.dumps(jsonable(settings)))
        for lines in self._files:
            found = changes(lines.settings, self._settings) if lines.settings is not None else []
            if found:
                raise OutputError(f"{lines.path} holds bounds with {', '.join(found)}; {_ADVICE}")
        rows: dict[int, PoseRow] = {}
        for lines in self._files[:1]:
            for index, values in lines.values.items():
                try:
                    rows[index] = PoseRow.of_columns(values, poses[index])
                except (IndexError, KeyError, TypeError, ValueError) as error:
                    raise OutputError(
                        f"{lines.path}: row {index} is damaged ({error!r}); {_ADVICE}"
                    ) from error
        if self._csv is not None:
            for index in sorted(rows):
                self._add_csv(index, rows[index])
        return rows

    def add(self, index: int, row: PoseRow, bound: PoseBound) -> None:
        """See `PoseRecord`.

        Raises:
            OutputError: it cannot be written.
        """
        if self._json is not None:
            document = {
                "index": index,
                "name": row.name,
                **bound_document(bound),
                "row": jsonable(row.columns()),
                "settings": self._settings,
            }
            self._json.append(json.dumps(document, ensure_ascii=False, allow_nan=False) + "\n")
        if self._csv is not None:
            self._add_csv(index, row)

    def _add_csv(self, index: int, row: PoseRow) -> None:
        assert self._csv is not None
        if index in self._csv.values:
            return
        columns = _columns(index, row, self._settings)
        text = io.StringIO()
        writer = csv.DictWriter(text, list(columns), lineterminator="\n")
        if not self._csv.whole:
            writer.writeheader()
        writer.writerow(columns)
        self._csv.append(text.getvalue())


def write_parquet(path: Path, table: PoseTable) -> None:
    """Write a table with the columns of the CSV, each of one type.

    Raises:
        OutputError: it cannot be written.
    """
    core, files = parquet_library()
    kinds = {str: core.DataType.utf8(), int: core.DataType.int64(), float: core.DataType.float64()}
    rows = [_columns(index, row, table.settings) for index, row in zip(table.places, table.rows, strict=True)]
    columns = {
        name: core.Array([row[name] for row in rows], kinds[type(value)]) for name, value in rows[0].items()
    }
    with atomic(path) as temporary:
        files.write_parquet(core.Table.from_pydict(columns), temporary)


def parquet_library() -> tuple[Any, Any]:
    """What writes Parquet.

    Raises:
        OutputError: it is not installed.
    """
    try:
        return importlib.import_module("arro3.core"), importlib.import_module("arro3.io")
    except ImportError:
        raise OutputError("--parquet needs arro3: pip install 'mitsuba_crb[parquet]'") from None


def _columns(index: int, row: PoseRow, settings: dict[str, Any]) -> dict[str, str | int | float]:
    return {"index": index, **row.columns(), "settings": json.dumps(jsonable(settings), ensure_ascii=False)}


def _read(path: Path, read: Callable[[_Lines, str], None]) -> _Lines:
    lines = _Lines(path)
    try:
        text = lines.text()
        if text or not _begins(path):
            read(lines, text)
    except (ArithmeticError, KeyError, TypeError, ValueError) as error:
        raise OutputError(
            f"{path} exists and is no record of bounds at poses ({error}); name another file"
        ) from error
    return lines


def _begins(path: Path) -> bool:
    """Whether a file without a whole line is missing, empty, or the beginning of one of ours."""
    if not os.path.lexists(path):
        return True
    start = path.read_bytes()
    return any(ours.startswith(start[: len(ours)]) for ours in BEGINNINGS)


def _read_json(lines: _Lines, text: str) -> None:
    if not text.startswith(JSON_START):
        raise ValueError("its first line is another")
    for line in text.split("\n")[:-1]:
        document = json.loads(line)
        lines.keep(document["index"], document["row"], document["settings"])


def _read_csv(lines: _Lines, text: str) -> None:
    if not text.startswith(CSV_START):
        raise ValueError("its first line is another")
    for values in csv.DictReader(io.StringIO(text, newline="")):
        lines.keep(values["index"], values, json.loads(values["settings"]))
