"""What mkdocs needs beside Markdown: pages of the notebooks, the commands' help, formulas as MathML.

All is made from what is there anyway (notebooks, the command line's own parser, tables beside the code), so
that it cannot go out of date, and nothing is left for a browser to fetch or to run.
"""

from __future__ import annotations

import base64
import html
import re
from pathlib import Path

import nbformat
import typer.main
from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from mitsuba_crb.cli.app import app
from mitsuba_crb.noise.schema import MODELS

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)
FIGURES = [
    ROOT / "benchmarks" / name
    for name in (
        "figures/basin.png",
        "figures/bound.png",
        "figures/columns.png",
        "figures/forward_violated.png",
        "paper/calibration.png",
        "paper/captures.png",
        "paper/cooperative_gain.png",
        "paper/table1.png",
    )
]
HELP_WIDTH = 110


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """All notebooks into the navigation."""
    config.nav.append({"Notebooks": [f"notebooks/{path.stem}.md" for path in NOTEBOOKS]})
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add a page for each notebook with the pictures in it, and the benchmarks' figures."""
    for path in NOTEBOOKS:
        text, pictures = notebook_page(path)
        for name, content in {f"{path.stem}.md": text, **pictures}.items():
            files.append(File.generated(config, f"notebooks/{name}", content=content))
    for path in FIGURES:
        files.append(File.generated(config, f"pictures/{path.name}", abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, **_: object) -> str:
    """Replace the comments that ask for something: commands, noise models, a file."""
    markdown = markdown.replace("<!-- commands -->", commands()).replace(
        "<!-- noise models -->", noise_models()
    )
    return re.sub(r"<!-- file (\S+) -->", lambda found: body(ROOT / found[1]), markdown)


def on_page_content(content: str, **_: object) -> str:
    """Formulas as MathML, which browsers draw themselves."""
    return FORMULA.sub(_mathml, content)


def notebook_page(path: Path) -> tuple[str, dict[str, bytes]]:
    """A notebook as Markdown, and its pictures by their names."""
    parts, pictures, heading = [], {}, path.stem
    for cell in nbformat.read(path, as_version=4).cells:
        if cell.cell_type == "markdown":
            parts.append(re.sub(r"\]\((\w+)\.ipynb\)", r"](\1.md)", cell.source))  # to other notebooks
            heading = (re.findall(r"^#+ (.*)", cell.source, re.MULTILINE) or [heading])[-1]
            continue
        parts.append(_fenced(cell.source, "python"))
        for output in cell.outputs:
            data = output.get("data", {})
            if "image/png" in data:
                name = f"{path.stem}_{len(pictures)}.png"
                pictures[name] = base64.b64decode(data["image/png"])
                parts.append(f"![{heading}: figure {len(pictures)} of this page]({name})")
            elif text := output.get("text") or data.get("text/plain"):
                parts.append(_fenced(text, "text"))
    note = (
        f"*This page is the notebook `notebooks/{path.name}`, with the outputs that it was committed with.*"
    )
    title, *rest = parts
    first, _, below = title.partition("\n")
    return "\n\n".join([first, note, below, *rest]), pictures


def commands() -> str:
    """Every command's `--help`, as the command line prints it."""
    group = typer.main.get_group(app)
    root = group.make_context("mitsuba-crb", ["doctor"], resilient_parsing=True)
    parts = []
    for name, command in group.commands.items():
        context = type(root)(command, info_name=name, parent=root)
        context.max_content_width = context.terminal_width = HELP_WIDTH
        parts += [f"## {name}", _fenced(command.get_help(context), "text")]
    return "\n\n".join(parts)


def noise_models() -> str:
    """A table of the names that a noise file knows, and of their parameters."""
    rows = ["| model | parameters | class |", "|---|---|---|"]
    for name, (maker, parameters) in MODELS.items():
        listed = ", ".join(f"`{parameter}`" for parameter in parameters)
        made = maker.__name__ if isinstance(maker, type) else name.title()
        rows.append(f"| `{name}` | {listed} | [`{made}`][mitsuba_crb.noise.{made}] |")
    return "\n".join(rows)


def body(path: Path) -> str:
    """A file's Markdown without its title and without links, for what they lead to is not on the site."""
    text = re.sub(r"\A# .*\n", "", path.read_text(encoding="utf-8"))
    return re.sub(r"(?<!!)\[([^\]]+)\]\((?!#|https?:)[^)]+\)", r"\1", text)


def _fenced(text: str, language: str) -> str:
    return f"```{language}\n{text.rstrip()}\n```"


def _mathml(found: re.Match[str]) -> str:
    display = "block" if found[2] == "[" else "inline"
    return convert(html.unescape(found[3]), display=display)
