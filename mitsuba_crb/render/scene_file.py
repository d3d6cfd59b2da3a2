"""A scene's file as Mitsuba's parser reads it, and all that keeps the parser from reading it.

The parser stops at the first fault. So what it names is taken out of a copy of the text, at the same length,
and the copy read again, until it has named everything; line numbers stay those of the file.
"""

from __future__ import annotations

import os
import re
import xml.parsers.expat
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import SceneError
from .cures import TAGS, cured, innermost, one_line
from .world import ENDINGS

if TYPE_CHECKING:
    import mitsuba as mi

_NAMED = r"(?:unexpected |unsupported XML element: )<(\w+)>"
"""An element that has no place there, in Mitsuba's words."""

_MOST = 30
"""Faults that are looked for in one file."""


@dataclass(frozen=True)
class Parsed:
    """What the parser makes of a file."""

    state: mi.parser.ParserState | None
    """Its nodes; None if there is no making sense of it."""
    faults: list[str] = field(default_factory=list)
    """What is wrong with it, each with its line and a cure."""
    left_out: list[str] = field(default_factory=list)
    """What it names that is not needed and not there."""
    files: tuple[Path, ...] = ()
    """Itself and what it includes."""
    text: str = ""
    """What was parsed, if not the file; Mitsuba tells lines by it as long as it lives."""


def parse(config: mi.parser.ParserConfig, file: Path, defines: Mapping[str, str]) -> Parsed:
    """Read a file; `defines` set its `<default>`s.

    Raises:
        SceneError: there is no such file, or a `<default>` of none of these names.
    """
    import mitsuba as mi

    if os.path.isdir(file):
        raise SceneError(f"{file} is a folder; name the scene's .xml file")
    if not os.path.isfile(file):
        raise SceneError(f"no scene file at {file}")
    if file.suffix.lower() != ".xml" and not _begins_as_xml(file):
        raise SceneError(
            f"{file} is no XML, and no world: those end in {', '.join(ENDINGS)}; export it as .glb"
        )
    try:
        state = mi.parser.parse_file(config, str(file), **defines)
        return Parsed(state, files=tuple(Path(str(name)) for name in state.files))
    except Exception as error:  # Mitsuba raises RuntimeError and others for a bad scene file
        _check_defines(error, file)
        return _search(config, file, dict(defines))


def _begins_as_xml(file: Path) -> bool:
    try:
        with file.open("rb") as opened:
            return opened.read(64).removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"<")
    except OSError as error:
        raise SceneError(f"{file} cannot be read: {error.strerror}") from error


def _check_defines(error: Exception, file: Path) -> None:
    unused = re.search(r"unused parameters?: ?(.*)", one_line(error))
    if unused:
        names = re.findall(r"\$([^\s=]+)=", unused.group(1))
        known = re.findall(r'<default\s+name="([^"]+)"', file.read_text(errors="replace"))
        raise SceneError(
            f"{file} has no <default> named {', '.join(names)}; "
            f"it has {', '.join(known) if known else 'none at all'}"
        ) from error


def _search(config: mi.parser.ParserConfig, file: Path, defines: dict[str, str]) -> Parsed:
    """Read what can be read of a file with faults."""
    import mitsuba as mi

    try:
        text = file.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise SceneError(f"{file} cannot be read: {error.strerror}") from error
    found: dict[str, None] = {}
    left_out: list[str] = []
    for _ in range(_MOST):
        try:
            state = mi.parser.parse_string(config, text, **defines)
        except Exception as error:
            where, cause = innermost(error)
            message = f"{at(_line_of(text, where, cause), file)}{cured(cause)}"
            missing = re.search(r'<path>: folder "(.*)" not found', cause)
            if missing:
                left_out.append(f'<path value="{missing.group(1)}"/>, a folder that does not exist')
            elif message in found:
                return Parsed(None, list(found), left_out)
            else:
                found[message] = None
            mended = _without(text, where, cause, defines)
            if mended is None:
                return Parsed(None, list(found), left_out)
            text = mended
        else:
            files = tuple(Path(str(name)) for name in state.files if os.path.isfile(str(name)))
            return Parsed(state, list(found), left_out, (file, *files), text)
    return Parsed(None, list(found), left_out)


def at(where: str, file: Path | None) -> str:
    """A place, as Mitsuba tells it, in fewer words: of the scene's own file, its line alone."""
    found = re.match(r"(.*?) ?\((line \d+), col \d+\)$", where)
    if not found:
        return f"{where}: " if where else ""
    name, line = found.groups()
    return f"{line}: " if name in ("", "string", str(file)) else f"{name} {line}: "


def _line_of(text: str, where: str, cause: str) -> str:
    """Where an element is that the parser names in the place of what it is part of."""
    named, place = re.search(_NAMED, cause), re.match(r"string \(line (\d+), col", where)
    if named and place:
        lines = text.split("\n")
        for row in range(int(place.group(1)), len(lines) + 1):
            if re.search(rf"<{named.group(1)}\b", lines[row - 1]):
                return f"string (line {row}, col 1)"
    return where


def _without(text: str, where: str, cause: str, defines: dict[str, str]) -> str | None:
    """The text without what is at fault there, every line where it was; None if that cannot be taken out."""
    undefined = re.search(r"undefined parameter: \$(\w+)", cause)
    if undefined:
        defines[undefined.group(1)] = "1"
        return text
    named = re.search(_NAMED, cause)
    if named:
        tag = named.group(1)
        if tag.lower() in TAGS:
            return re.sub(rf"(</?){tag}\b", lambda m: m.group(1) + tag.lower(), text)
    place = re.match(r"string \(line (\d+), col (\d+)\)$", where)
    if not place:
        return None
    # Mitsuba counts columns from the element's name.
    row, column = int(place.group(1)), int(place.group(2)) - 2
    return _blanked(text, row, column, named and named.group(1))


def _blanked(text: str, row: int, column: int, tag: str | None) -> str | None:
    """The text with one element turned into blanks: that at a place, or the first of a name from there on."""
    data = text.encode()
    spans: list[list[Any]] = []
    open_spans: list[list[Any]] = []
    reader = xml.parsers.expat.ParserCreate()

    def start(name: str, _attributes: Any) -> None:
        place = (reader.CurrentLineNumber, reader.CurrentColumnNumber)
        open_spans.append([place, name, reader.CurrentByteIndex, None])
        spans.append(open_spans[-1])

    def end(_name: str) -> None:
        place, own = reader.CurrentByteIndex, open_spans.pop()
        # Of <a/> the place is that after it, or its own.
        closing = data.startswith(b"</", place) or place == own[2]
        own[3] = data.index(b">", place) + 1 if closing else place

    reader.StartElementHandler, reader.EndElementHandler = start, end
    try:
        reader.Parse(data, True)
    except (xml.parsers.expat.ExpatError, ValueError):
        return None
    for place, name, first, last in spans[1:]:
        if place >= (row, column) and tag in (None, name):
            blank = re.sub(rb"[^\n]", b" ", data[first:last])
            return (data[:first] + blank + data[last:]).decode()
    return None
