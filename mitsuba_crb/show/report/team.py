"""The reports of `mitsuba-crb fuse` and `select`: what cameras know together, and what they send."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .bound import verdict_words
from .charts import budgets
from .ellipsoids import Ellipsoid
from .layers import render_layer, sight_layers
from .markup import Markup, tag
from .page import Origin, Page, section, write_page
from .space import space
from .tables import cells, deviations, facts, number, significant, table
from .viewers import chart_place, picture_viewer, space_viewer

if TYPE_CHECKING:
    import numpy.typing as npt

    from ...measure.outlook import Outlook


def write_fusion_report(path: Path, document: Mapping[str, Any], outlook: Outlook, origin: Origin) -> None:
    """Write the page of a team's joint bound.

    Args:
        path: the file.
        document: from `fusion_document`.
        outlook: the world and the agents' cameras.
        origin: the command.

    Raises:
        OutputError: plotly is not installed.
    """
    write_page(path, fusion_page(document, outlook), origin)


def fusion_page(document: Mapping[str, Any], outlook: Outlook) -> Page:
    """The page of a team's joint bound; arguments as of `write_fusion_report`."""
    agents = document["agents"]
    ellipsoids = [Ellipsoid.of(document["body"], document["pose"], document["ellipsoids"]["position"])]
    ellipsoids += [
        Ellipsoid.of(agent["name"], agent["pose"], agent["ellipsoids"]["position"]) for agent in agents
    ]
    view = space(outlook, ellipsoids)
    layers = sight_layers(outlook.sights)
    sections = [
        section(f"Bound of {document['body']}", deviations(document, "body"), verdict_words(document)),
        section("Pictures", picture_viewer("agents", layers, label="What an agent sees")),
        section("Agents", _shares(agents), kind="wide"),
        section("In the world", space_viewer(view), kind="wide"),
    ]
    summary = [f"{len(agents)} agents", f"rank {document['rank']} of 6 together"]
    notes = [("note", text) for text in document["warnings"]]
    data = {"space": view, "images": {"agents": layers}}
    return Page(Path(str(document["config"])).name, summary, sections, notes, data)


def _shares(agents: Sequence[Mapping[str, Any]]) -> Markup:
    rows = []
    for agent in agents:
        unseen = "; ".join(
            f"{direction['description']} ({direction['verdict']})" for direction in agent["unobserved"]
        )
        width, height = agent["size"]
        rows.append(
            [
                *cells(
                    [agent["name"], f"{agent['rank']} of 6", f"{agent['share']:.1%}", f"{width}×{height}"]
                ),
                tag("td", unseen or "nothing", class_="words"),
            ]
        )
    heads = ("agent", "rank alone", "share", "pixels", "does not see alone")
    return table(heads, rows, caption="What each agent brings")


def write_selection_report(
    path: Path,
    document: Mapping[str, Any],
    tiles: Sequence[npt.NDArray[np.int64]],
    images: Sequence[npt.NDArray[np.float32]],
    outlook: Outlook,
    origin: Origin,
) -> None:
    """Write the page of a team's chosen tiles.

    Args:
        path: the file.
        document: from `selection_document`.
        tiles: of each agent (T, 4): x, y, width, height [pixel].
        images: of each agent (H, W, 3) [radiance].
        outlook: the world and the agents' cameras.
        origin: the command.

    Raises:
        OutputError: plotly is not installed.
    """
    write_page(path, selection_page(document, tiles, images, outlook), origin)


def selection_page(
    document: Mapping[str, Any],
    tiles: Sequence[npt.NDArray[np.int64]],
    images: Sequence[npt.NDArray[np.float32]],
    outlook: Outlook,
) -> Page:
    """The page of a team's chosen tiles; arguments as of `write_selection_report`."""
    counts = "bytes" if document["curve"] and "bytes" in document["curve"][0] else "tiles"
    charts = {"budget": budgets(dict(document), counts)}
    view = space(outlook, [])
    pictures = [
        _tiles(agent, own, image, document["chosen"])
        for agent, own, image in zip(document["agents"], tiles, images, strict=True)
    ]
    total = sum(len(own) for own in tiles)
    guarantee = document["guarantee"]
    certain = "nothing" if guarantee is None else f"{guarantee:.1%}"
    rows = [
        ("chosen", f"{len(document['chosen'])} of {total} tiles, {document['total_bytes']} bytes"),
        ("objective", document["objective"]),
        ("certificate", f"{document['certificate']:.1%} of the best gain; beforehand certain: {certain}"),
        ("length scale", f"{document['length_scale']:.4g} scene units"),
    ]
    sections = [
        section("What it is worth", _worth(document), facts(rows)),
        section("Worth against budget", chart_place("budget", charts["budget"]["alt"])),
        section("Tiles that are sent", tag("div", *pictures, class_="tiles"), kind="wide"),
        section("In the world", space_viewer(view), kind="wide"),
    ]
    summary = [f"{len(document['agents'])} agents", f"{len(document['chosen'])} of {total} tiles"]
    notes = [("note", text) for text in document["warnings"]]
    data = {"space": view, "charts": charts, "images": {}}
    return Page(Path(str(document["config"])).name, summary, sections, notes, data)


def _worth(document: Mapping[str, Any]) -> Markup:
    rows = [("nothing sent", document["value_empty"], document["value_empty"])]
    rows += [
        (name.replace("_", " "), base["value"], base["value_heldout"])
        for name, base in document["baselines"].items()
    ]
    rows.append(("chosen", document["value"], document["value_heldout"]))
    written = [cells([name, *(significant(number(value), 5) for value in values)]) for name, *values in rows]
    written.append(cells(["no choice exceeds", significant(number(document["upper_bound"]), 5), ""]))
    heads = (document["objective"], "on the half chosen by", "held out")
    return table(heads, written, caption="What the tiles are worth beside simpler rules")


def _tiles(
    agent: Mapping[str, Any],
    tiles: npt.NDArray[np.int64],
    image: npt.NDArray[np.float32],
    chosen: Sequence[Mapping[str, Any]],
) -> Markup:
    """An agent's image, what is not sent dimmed, and on each tile that is sent its place in the order."""
    order = {each["tile"]: place for place, each in enumerate(chosen, 1) if each["agent"] == agent["name"]}
    height, width = image.shape[:2]
    layer = render_layer(image, name=agent["name"], unit="radiance", displayed=False)
    parts: list[Markup] = [tag("image", href=layer["png"], width=width, height=height)]
    for index, (x, y, w, h) in enumerate(tiles.tolist()):
        box = {"x": x, "y": y, "width": w, "height": h}
        parts.append(tag("rect", class_="sent" if index in order else "kept", **box))
    for index, place in order.items():
        x, y, w, h = tiles[index].tolist()
        style = {"x": x + w / 2, "y": y + h / 2, "font_size": 0.5 * h}
        parts.append(tag("text", place, **style))
    words = f"{len(order)} of {len(tiles)} tiles sent"
    return tag(
        "figure",
        tag(
            "svg",
            *parts,
            viewBox=f"0 0 {width} {height}",
            role="img",
            aria_label=f"{agent['name']}: {words}, numbered in the order of choice",
        ),
        tag("figcaption", tag("b", agent["name"]), f" {words}"),
    )
