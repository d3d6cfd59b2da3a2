"""The pages' commands run, shrunk, and say what the pages say, and what a page shows of an output is like it.

A page's commands run in order in one empty folder, as a reader would run them.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from typer.main import get_group

from mitsuba_crb import se3
from mitsuba_crb.cli import app as cli

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
sys.path.insert(0, str(DOCS / "tools"))

from pages import Block, blocks  # noqa: E402

PAGES = sorted(DOCS.rglob("*.md"))
RUN = [DOCS / "tutorial.md", *sorted((DOCS / "howto").glob("*.md"))]
TEXT = {page: page.read_text(encoding="utf-8") for page in PAGES}
BLOCKS = {page: blocks(TEXT[page]) for page in RUN}
COMMANDS = [page for page in RUN if any(block.marked for block in BLOCKS[page])]
QUICK = ("localise", "own-camera")
SNIPPETS = [
    (page.stem, code) for page in PAGES for code in re.findall(r"```python\n(.*?)```", TEXT[page], re.DOTALL)
]


def _name(page: Path) -> str:
    return page.stem


def test_there_are_how_tos_of_twelve_questions() -> None:
    """And each is in the list of them, under its title."""
    how_tos = [page for page in RUN if page.parent.name == "howto" and page.stem != "index"]
    assert len(how_tos) >= 12
    index = TEXT[DOCS / "howto" / "index.md"]
    for page in how_tos:
        title = TEXT[page].partition("\n")[0].removeprefix("# ")
        assert f"[{title}]({page.name})" in index
        assert any(block.marked for block in BLOCKS[page])


@pytest.mark.parametrize("page", COMMANDS, ids=_name)
def test_what_a_page_shows_of_an_output_is_what_it_says(page: Path) -> None:
    for block in BLOCKS[page]:
        assert block.marked or block.commands[0].startswith("pip install")
        assert block.output != ""
        if block.output and block.shows:
            assert re.search(block.shows, block.output), block.commands[-1]


@pytest.mark.parametrize(
    "page",
    [pytest.param(page, marks=() if page.stem in QUICK else pytest.mark.slow) for page in COMMANDS],
    ids=_name,
)
def test_commands_do_what_the_page_says(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("mitsuba")
    for name in ("scenes", "docs"):
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.chdir(tmp_path)
    # `python` is this one, also where its environment is not activated.
    monkeypatch.setenv("PATH", os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]))
    for block in BLOCKS[page]:
        if block.marked:
            _run(block, capfd)


def _run(block: Block, capfd: pytest.CaptureFixture[str]) -> None:
    """The last command's exit code and output are what the page says."""
    code = 0
    for command in block.shrunk():
        assert code == 0, capfd.readouterr().err
        capfd.readouterr()
        program, *arguments = shlex.split(command)
        if program == "mitsuba-crb":
            code = cli.run(arguments)
        else:
            code = subprocess.run(command, shell=True, check=False).returncode
    out, err = capfd.readouterr()
    assert code == block.exit, out + err
    assert re.search(block.shows, out), out


@pytest.mark.slow
def test_the_site_is_built_without_a_broken_link_and_asks_no_network(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs", reason="needs the extra docs")
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    done = subprocess.run(build, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    pages = sorted(tmp_path.rglob("*.html"))
    assert len(pages) > 30
    fetched = r"<(?:script|img|iframe)[^>]* src=\"?(?:https?:)?//|<link[^>]* href=\"?(?:https?:)?//"
    for page in pages:
        text = page.read_text(encoding="utf-8")
        assert not re.search(fetched, text), page.name
        assert "arithmatex" not in text, page.name  # a formula that is not MathML
    assert "<math" in (tmp_path / "explanation" / "flow.html").read_text(encoding="utf-8")
    assert "--marginalize" in (tmp_path / "reference" / "commands.html").read_text(encoding="utf-8")
    for sheet in tmp_path.rglob("*.css"):
        assert not re.search(r"@import|url\([\"']?(?:https?:)?//", sheet.read_text(encoding="utf-8")), (
            sheet.name
        )


@pytest.mark.slow
@pytest.mark.parametrize("snippet", [code for _, code in SNIPPETS], ids=[name for name, _ in SNIPPETS])
def test_snippets_of_python_run(snippet: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", snippet], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_the_conventions_are_those_of_the_code() -> None:
    page = TEXT[DOCS / "reference" / "conventions.md"]
    assert (
        page.partition("<!-- conventions -->\n")[2].partition("<!-- /conventions -->")[0] == se3.CONVENTIONS
    )


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_what_a_page_names_exists(page: Path) -> None:
    """Scripts, and options of the commands."""
    for path in re.findall(r"`(?:python )?((?:tests|benchmarks|docs|mitsuba_crb)/[\w./]+)", TEXT[page]):
        assert (ROOT / path).exists(), path
    of_scripts = {"--all", "--compare", "--only", "--quick", "--strict"}
    named = set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", _without_scripts(TEXT[page]))) - of_scripts
    commands = {parameter for command in get_group(cli.app).commands.values() for parameter in command.params}
    known = {option for parameter in commands for option in (*parameter.opts, *parameter.secondary_opts)}
    assert named <= known | {"--help"}, named - known


def _without_scripts(text: str) -> str:
    """Without comments, outputs, and what the repository's own scripts take."""
    return re.sub(r"<!--.*?-->|```text\n.*?```|python [^`\n]*", "", text, flags=re.DOTALL)


def test_a_comment_that_says_what_is_not_known_is_refused() -> None:
    with pytest.raises(ValueError, match="known: exit, shows, small"):
        blocks('<!-- run: shrink="--size 8x8" -->\n```sh\nmitsuba-crb doctor\n```\n')
