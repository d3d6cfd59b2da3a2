"""HTML put together from parts: what is not markup already is escaped, so that no name can be any."""

from __future__ import annotations

import html


class Markup(str):
    """Text that is HTML."""

    __slots__ = ()


def tag(name: str, *content: object, **attributes: object) -> Markup:
    """An element with its content and attributes.

    Args:
        name: of the element.
        content: texts, which are escaped, and `Markup`, which is not; None is left out.
        attributes: `class_` is class, `aria_label` is aria-label; True is one without a value, None and False
            are left out.
    """
    written = "".join(
        f" {key.rstrip('_').replace('_', '-')}" + ("" if value is True else f'="{html.escape(str(value))}"')
        for key, value in attributes.items()
        if value is not None and value is not False
    )
    return Markup(f"<{name}{written}>{joined(*content)}</{name}>")


def joined(*content: object) -> Markup:
    """Parts one after the other, escaped as by `tag`."""
    return Markup("".join(_escaped(part) for part in content if part is not None))


def _escaped(part: object) -> str:
    return part if isinstance(part, Markup) else html.escape(str(part))
