"""One page that needs nothing else: styles, scripts, plotly, pictures and numbers in one file of HTML."""

from __future__ import annotations

import importlib
import importlib.resources
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ...errors import OutputError
from ...files import atomic
from .markup import Markup, joined, tag

_FOLDER = "mitsuba_crb.show.report"
_FEW = 2
"""Notes that stand there open."""


@dataclass(frozen=True)
class Origin:
    """Where a page comes from."""

    command: str
    """As it was typed."""
    versions: Mapping[str, str]
    """Of what the numbers depend on."""


@dataclass(frozen=True)
class Page:
    """What a page shows."""

    title: str
    summary: Sequence[str]
    """Facts of the line below the title."""
    sections: Sequence[Markup]
    """In order, see `section`."""
    notes: Sequence[tuple[str, str]] = ()
    """What the reader must know first: a kind (`bad` or `note`), and a sentence."""
    data: Mapping[str, Any] = field(default_factory=dict)
    """For the script: `images`, `space` and `charts`, see `page.js`."""


def plotly_library() -> Any:
    """Plotly's graph objects.

    Raises:
        OutputError: it is not installed.
    """
    try:
        return importlib.import_module("plotly.graph_objects")
    except ImportError:
        raise OutputError("--report needs plotly: pip install 'mitsuba_crb[report]'") from None


def section(title: str, *content: object, kind: str = "") -> Markup:
    """A part of a page under a heading.

    Args:
        title: its heading.
        content: as of `tag`.
        kind: `wide` has the page's whole width.
    """
    name = title.lower().replace(" ", "-")
    return tag(
        "section", tag("h2", title, id=name), *content, class_=f"card {kind}".strip(), aria_labelledby=name
    )


def side_by_side(*columns: Sequence[Markup]) -> Markup:
    """Columns of sections, which stand below each other in a narrow window."""
    return joined(*(tag("div", *column, class_="stack") for column in columns))


def write_page(path: Path, page: Page, origin: Origin) -> None:
    """Write a page.

    Raises:
        OutputError: plotly is not installed.
    """
    text = _html(page, origin)
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _html(page: Page, origin: Origin) -> str:
    notes = [tag("p", text, class_=f"notice {kind}") for kind, text in page.notes if kind != "note"]
    rest = [text for kind, text in page.notes if kind == "note"]
    if len(rest) > _FEW:
        words = tag("summary", f"{len(rest)} notes")
        notes.append(tag("details", words, *(tag("p", text) for text in rest), class_="notice note"))
    else:
        notes += [tag("p", text, class_="notice note") for text in rest]
    parts = {
        "title": joined(page.title),
        "summary": joined(*(tag("span", fact) for fact in page.summary)),
        "notes": joined(*notes),
        "sections": joined(*page.sections, _provenance(origin)),
        "style": Markup(_own("page.css")),
        "data": Markup(_in_script(page.data)),
        "plotly": Markup(_plotly_script()),
        "script": Markup(_own("page.js")),
    }
    text = _own("page.html")
    before, *pieces = text.split("{{")
    written = [before]
    for piece in pieces:  # in one go, for what is put in may have braces of its own
        name, _, after = piece.partition("}}")
        written += [parts[name], after]
    return "".join(written)


def _plotly_script() -> str:
    plotly_library()
    script: str = importlib.import_module("plotly.offline").get_plotlyjs()
    return script.replace("</script", "<\\/script")


def _own(name: str) -> str:
    return importlib.resources.files(_FOLDER).joinpath(name).read_text(encoding="utf-8")


def _in_script(data: Mapping[str, Any]) -> str:
    """JSON that ends no element that it stands in."""
    text = json.dumps(data, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def _provenance(origin: Origin) -> Markup:
    versions = ", ".join(f"{name} {version}" for name, version in origin.versions.items())
    return section(
        "How to get this again",
        tag(
            "div",
            tag("pre", tag("code", origin.command), tabindex=0, aria_label="Command"),
            tag("button", "Copy", type="button", data_copy=True),
            class_="command",
        ),
        tag("p", versions, class_="muted"),
        kind="wide",
    )
