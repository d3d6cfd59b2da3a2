"""The places of a page that its script fills: pictures with values, the view of the world, charts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from .markup import Markup, joined, tag


def picture_viewer(key: str, layers: Sequence[Mapping[str, Any]], *, label: str) -> Markup:
    """Pictures of which one is shown at a time, and what is under the pointer.

    Args:
        key: of the layers in the page's data `images`.
        layers: as of `layers`.
        label: what the pictures are.
    """
    many = len(layers) > 1
    options = [tag("option", layer["name"], value=index) for index, layer in enumerate(layers)]
    chooser = tag("label", "Picture ", tag("select", *options, class_="layer")) if many else None
    buttons = (
        joined(
            tag("button", "◀", type="button", class_="step", data_step=-1, aria_label="Previous picture"),
            tag("button", "▶", type="button", class_="step", data_step=1, aria_label="Next picture"),
        )
        if many
        else None
    )
    first = layers[0]
    return tag(
        "div",
        tag("div", chooser, buttons, tag("span", class_="about muted"), class_="controls"),
        tag(
            "div",
            tag(
                "img", src=first["png"], alt=f"{label}: {first['name']}, {first['about']}", draggable="false"
            ),
            tag("div", class_="cross", hidden=True, aria_hidden="true"),
            class_="picture",
            tabindex=0,
            role="group",
            aria_label=f"{label}; arrow keys move over the values, page up and down change the picture",
        ),
        tag("div", class_="bar", hidden=True),
        tag(
            "output",
            "Point at the picture, or use the arrow keys on it.",
            class_="readout",
            aria_live="polite",
        ),
        class_="viewer",
        data_key=key,
        data_label=label,
    )


def space_viewer(view: Mapping[str, Any]) -> Markup:
    """The view of the world, its buttons, and the factor of the ellipsoids."""
    views = (
        ("first", "Overview"),
        ("camera", "From the camera"),
        ("top", "From above"),
        ("close", "Close up"),
    )
    buttons = [tag("button", words, type="button", data_view=name) for name, words in views]
    scale = (
        tag(
            "label",
            "Ellipsoids drawn ",
            tag("input", type="range", min=0, max=len(view["factors"]) - 1, step=1, id="factor"),
            tag("output", id="factor-said"),
        )
        if view["scaled"]
        else None
    )
    return joined(
        tag("div", *buttons, scale, class_="controls"),
        tag(
            "div",
            id="space",
            class_="space",
            tabindex=0,
            role="application",
            aria_label=f"{view['alt']}. Arrow keys turn the view, plus and minus move it nearer or farther.",
        ),
        tag("p", view["words"], class_="muted"),
    )


def chart_place(key: str, alt: str) -> Markup:
    """Where a chart of the page's data goes."""
    return tag("div", class_="chart", data_chart=key, role="img", aria_label=alt)
