"""What Mitsuba says of a bad input, in one line, with what to do about it."""

from __future__ import annotations

import difflib
import functools
import re
from pathlib import Path

_PLUGINS = {
    "ldrfilm": "hdrfilm",
    "mfilm": "hdrfilm",
    "sppm": "path",
    "bdpt": "path",
    "roughcoating": "principled",
    "phong": "roughplastic",
    "ward": "roughconductor",
    "difftrans": "principledthin",
    "scale": "bitmap",
    "cubetexture": "bitmap",
}
"""What comes in place of plugins that older versions of Mitsuba had."""

_PROPERTIES = {
    "gamma": "remove it; Mitsuba 3 measures linear radiance",
    "srgb": 'remove it, or write <boolean name="raw" value="true"/> for a texture of linear values',
    "strict_normals": "remove it; Mitsuba 3 has no strict normals (strictNormals)",
}

_CURES = (
    (r"<animation>|[Aa]nimated", "animated transforms are not supported: give it one <transform>"),
    (r"invalid lookat", "up is parallel to the view direction, or origin is target: choose another up"),
    (r"undefined parameter", "give it a value with -D name=value or add a <default>"),
    (r"trilinear", "use bilinear"),
    (
        r"[Tt]railing tokens after end of PLY|is this a triangle mesh|non-triangular|no triangle",
        "triangulate the mesh on export: Mitsuba reads triangles alone",
    ),
    (
        r"file not found|No such file|included file .* not found|File .* does not exist",
        "put the file there or correct its name (paths are relative to the scene's folder)",
    ),
    (r'[Pp]roperty "[^"]*" cannot be found', "add it, or correct its spelling"),
    (r"unresolved reference", "give the object that is meant this id, or remove the <ref>"),
    (r"duplicate ID", "give one of the two another id"),
    (r"XML parsing failed", "close what is open, or restore the file"),
)


def one_line(error: BaseException) -> str:
    """Mitsuba's message without its source lines, line breaks and memory addresses."""
    # Mitsuba quotes what it cannot read, which need not be text.
    message = error.object.decode(errors="replace") if isinstance(error, UnicodeDecodeError) else str(error)
    text = re.sub(r"\[\w+\.(cpp|h):\d+\]\s*", "", message)
    text = re.sub(r"\s*\n\s*-?\s*", " ", text)
    text = re.sub(r"(\w+)(_| at |@)0x[0-9a-fA-F]+", r"\1", text)
    return text.strip().rstrip("!.")


def innermost(error: BaseException) -> tuple[str, str]:
    """Where Mitsuba was, as it says it, and what stopped it there."""
    where, text = "", one_line(error)
    while found := re.search(
        r"(?:At|Error while loading) (.*? ?\(line \d+, col \d+\)|dictionary node \"[^\"]*\"): (.*)$", text
    ):
        where, text = found.groups()
    failed = r"^failed to instantiate (?:unknown |(\w+ ))?plugin of type (\"[^\"]*\"): "
    text = re.sub(failed, r"\1\2: ", text)
    return where, re.sub(r"^(\w+ )?\"[^\"]*\": \[PluginManager\] P", "p", text)


def cured(text: str) -> str:
    """What is wrong, with what to do about it."""
    found = re.search(r'[Pp]lugin "([^"]*)" not found', text)
    if found:
        return f"{text}; {plugin_cure(found.group(1))}"
    found = re.search(r"(?:unexpected |unsupported XML element: )<(\w+)>", text)
    tag = found.group(1) if found else ""
    if tag.lower() in TAGS and tag not in TAGS:
        return f"{text}; rename <{tag}> to <{tag.lower()}>"
    for pattern, cure in _CURES:
        if re.search(pattern, text):
            return f"{text}; {cure}"
    near = difflib.get_close_matches(tag, TAGS, 1) if tag else []
    return f"{text}; " + (f"did you mean <{near[0]}>?" if near else "correct the scene file")


def plugin_cure(name: str) -> str:
    """What to write in place of a plugin that Mitsuba 3 does not have."""
    if name in _PLUGINS:
        return f"Mitsuba 3 has no plugin of this name: use {_PLUGINS[name]} for {name}"
    near = difflib.get_close_matches(name, plugins(), 1)
    meant = f": did you mean {near[0]}?" if near else ": check its spelling or replace it"
    return f"Mitsuba 3 has no plugin of this name{meant}"


def property_cure(name: str) -> str:
    """What to do about a property that a plugin does not have."""
    snake = re.sub(r"([a-z])([A-Z])", r"\1_\2", name).lower()
    return _PROPERTIES.get(snake, "Mitsuba 3 does not know this property: remove or rename it")


@functools.cache
def plugins() -> tuple[str, ...]:
    """Names of the plugins that Mitsuba comes with."""
    import mitsuba as mi

    return tuple(sorted(file.stem for file in (Path(mi.__file__).parent / "plugins").iterdir()))


TAGS = (
    *("scene", "integrator", "sensor", "film", "rfilter", "sampler", "emitter", "shape", "bsdf", "texture"),
    *("volume", "medium", "phase", "spectrum", "rgb", "float", "integer", "boolean", "string", "vector"),
    *("point", "transform", "lookat", "translate", "scale", "rotate", "matrix", "ref", "default", "path"),
    *("include", "alias"),
)
"""Elements of a scene file."""
