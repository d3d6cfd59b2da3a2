"""Run the commands of the pages as they stand there, and put their outputs and pictures into the pages.

    python docs/tools/outputs.py                 # all pages
    python docs/tools/outputs.py howto/check.md  # one

The commands of a page run in one empty folder, with the repository's `scenes` and `docs` in it. What follows
a block of commands as `text` becomes its output; a picture that the page shows as `pictures/NAME.png` becomes
that of this name.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from pages import DOCS, blocks

WIDTH = "120"
LONGEST = 200  # a line of the output


def refresh(page: Path) -> None:
    """Rewrite one page's outputs and pictures.

    Raises:
        SystemExit: a command ended otherwise than the page says.
    """
    text = page.read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        for name in ("scenes", "docs", "benchmarks"):
            (work / name).symlink_to(DOCS.parent / name)
        changes = []
        for block in filter(lambda block: block.marked, blocks(text)):
            output = ""
            for command in block.commands:
                print(f"{page.name}: {command}", flush=True)
                output, code = run(command, work)
            if code != block.exit:
                raise SystemExit(f"{page}: exit code {code}, not {block.exit}\n{output}")
            if block.output is not None:
                changes.append((block.span, output))
        for (start, end), output in reversed(changes):
            text = text[:start] + output + text[end:]
        page.write_text(text, encoding="utf-8")
        (DOCS / "pictures").mkdir(exist_ok=True)
        for name in re.findall(r"\]\((?:\.\./)?pictures/([\w.-]+)\)", text):
            if (work / name).is_file():
                shutil.copy(work / name, DOCS / "pictures" / name)


def run(command: str, folder: Path) -> tuple[str, int]:
    """What a command prints, without blanks at the ends of lines, and its exit code."""
    environment = os.environ | {"COLUMNS": WIDTH, "PYTHONPATH": str(DOCS.parent)}
    done = subprocess.run(
        command,
        shell=True,
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=None,
        text=True,
        check=False,
    )
    lines = [line.rstrip()[:LONGEST] for line in done.stdout.splitlines()]
    return "\n".join(lines).strip("\n") + "\n", done.returncode


if __name__ == "__main__":
    named = [DOCS / name for name in sys.argv[1:]] or sorted(
        [DOCS / "tutorial.md", *(DOCS / "howto").glob("*.md")]
    )
    for one in named:
        refresh(one)
