"""The commands in the pages, and what is said of them: what both the tests and `outputs.py` read.

    <!-- run: small="--size 32x24 --spp 64" shows="rank +6 of 6" -->
    ```sh
    mitsuba-crb bound scenes/textured_room/textured_room.xml
    ```

A comment stands before every block of commands. `small` is appended to the block's last command where it is
tested, so that the page shows the command that people want. `exit` is its exit code (0), `shows` a regular
expression that its output matches, shrunk or not. A block of `text` that follows is its output.
"""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

DOCS = Path(__file__).parents[1]
_BLOCK = re.compile(
    r"(?:<!-- run:(?P<said>[^\n]*)-->\n)?```sh\n(?P<code>.*?)```\n(?:\n```text\n(?P<output>.*?)```\n)?",
    re.DOTALL,
)
_SAID = {"small", "exit", "shows"}


@dataclass(frozen=True)
class Block:
    """A block of commands in a page."""

    commands: tuple[str, ...]
    "One a line, continued lines joined, comments left out."
    marked: bool
    "Whether a comment says how it is run."
    small: str
    "Options that make the last command quick."
    exit: int
    "The last command's exit code."
    shows: str
    "What its output matches."
    output: str | None
    "What the page shows of its output."
    span: tuple[int, int]
    "Where that stands in the page's text."

    def shrunk(self) -> tuple[str, ...]:
        """The commands as they are tested."""
        return (*self.commands[:-1], f"{self.commands[-1]} {self.small}".strip())


def blocks(page: str) -> list[Block]:
    """All blocks of commands in a page's text, in order.

    Raises:
        ValueError: a comment says what is not known.
    """
    return [_block(found) for found in _BLOCK.finditer(page)]


def _block(found: re.Match[str]) -> Block:
    said = {}
    for word in shlex.split(found["said"] or ""):
        key, _, value = word.partition("=")
        said[key] = value
    if said.keys() - _SAID:
        raise ValueError(
            f"a comment says {', '.join(sorted(said.keys() - _SAID))}; known: {', '.join(sorted(_SAID))}"
        )
    lines = found["code"].replace("\\\n", " ").splitlines()
    commands = [re.sub(r"\s+#\s.*", "", line) for line in lines if line.strip() and not line.startswith("#")]
    return Block(
        commands=tuple(" ".join(command.split()) for command in commands),
        marked=found["said"] is not None,
        small=said.get("small", ""),
        exit=int(said.get("exit", 0)),
        shows=said.get("shows", ""),
        output=found["output"],
        span=found.span("output"),
    )
