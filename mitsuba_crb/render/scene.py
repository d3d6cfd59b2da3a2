"""Scenes: loaded from files, dictionaries and objects; what is wrong with one, in a line; what is in it."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import SceneError
from .backend import use_mitsuba
from .lending import turns

if TYPE_CHECKING:
    import mitsuba as mi


@contextlib.contextmanager
def _loading() -> Iterator[None]:
    """A turn with two threads at least: with one, Mitsuba 3.9 waits for ever for what reads OpenEXR files."""
    import drjit as dr

    with turns:
        threads = dr.thread_count()
        dr.set_thread_count(max(2, threads))
        try:
            yield
        finally:
            dr.set_thread_count(threads)


def load_scene(path: str | os.PathLike[str], /, **defines: str) -> mi.Scene:
    """Load a Mitsuba XML file; `defines` set its `<default>` values.

    Raises:
        SceneError: in one line, what is wrong with which line of the file.
    """
    use_mitsuba()
    import mitsuba as mi

    file = Path(path)
    if os.path.isdir(file):
        raise SceneError(f"{file} is a folder; name the scene's .xml file")
    if not os.path.isfile(file):
        raise SceneError(f"no scene file at {file}")
    try:
        with _loading():
            scene = mi.load_file(str(file), **{key: str(value) for key, value in defines.items()})
    except Exception as error:  # Mitsuba raises RuntimeError and others for a bad scene file
        raise SceneError(parser_message(error, file)) from error
    if not isinstance(scene, mi.Scene):
        raise SceneError(f"{file} holds no <scene> at its top")
    return scene


def parser_message(error: Exception, file: Path) -> str:
    """Mitsuba's parser message in one line, with what to do about it."""
    # Mitsuba quotes what it cannot read, which need not be text.
    message = error.object.decode(errors="replace") if isinstance(error, UnicodeDecodeError) else str(error)
    text = re.sub(r"\[\w+\.cpp:\d+\]\s*", "", message)
    text = re.sub(r"\s*\n\s*-?\s*", " ", text).strip()
    unused = re.search(r"unused parameters?: ?(.*)", text)
    if unused:
        names = re.findall(r"\$(\w+)=", unused.group(1))
        known = re.findall(r'<default\s+name="([^"]+)"', file.read_text(errors="replace"))
        return (
            f"{file} has no <default> named {', '.join(names)}; "
            f"it has {', '.join(known) if known else 'none at all'}"
        )
    if "<animation>" in text:
        cure = "animated transforms are not supported: give the sensor one <transform>"
    elif "unreferenced propert" in text:
        cure = "Mitsuba 3 does not know this property: remove or rename it"
    elif re.search(r'[Pp]lugin "?\w+"? not found', text):
        cure = "Mitsuba 3 has no plugin of this name: check its spelling or replace it"
    elif "undefined parameter" in text:
        cure = "give it a value with -D name=value or add a <default>"
    elif "file not found" in text or "No such file" in text:
        cure = "put the file there or correct its name (paths are relative to the scene's folder)"
    else:
        cure = "correct the scene file"
    if str(file) not in text:
        text = f"{file}: {text}"
    return f"{text.rstrip('!.')}; {cure}"


def as_scene(scene: Any) -> tuple[mi.Scene, str]:
    """The scene of a path, a dictionary or a scene, and what to call it.

    Raises:
        SceneError: it is none of these, was loaded under another variant, cannot be loaded, or has a mesh
            without faces.
    """
    use_mitsuba()
    with _loading():
        loaded, label = _loaded(scene)
    for shape in loaded.shapes():
        if shape.is_mesh() and not shape.face_count():
            raise SceneError(f"mesh {shape.id()} has no faces, which Mitsuba cannot trace; remove it")
    return loaded, label


def contents(root: mi.Object) -> list[mi.Object]:
    """A Mitsuba object and all it contains."""
    import mitsuba as mi

    found: dict[int, mi.Object] = {}

    class Collector(mi.TraversalCallback):  # type: ignore[misc]  # Mitsuba is untyped here
        def put(self, _name: str, value: Any, *_flags: Any) -> None:
            if isinstance(value, mi.Object):
                visit(value)

    def visit(node: mi.Object) -> None:
        if node.ptr not in found:
            found[node.ptr] = node
            node.traverse(Collector())

    visit(root)
    return list(found.values())


def _loaded(scene: Any) -> tuple[mi.Scene, str]:
    import mitsuba as mi

    if isinstance(scene, mi.Scene):
        return scene, "mi.Scene"
    if isinstance(scene, Mapping):
        try:
            loaded = mi.load_dict(dict(scene))
        except Exception as error:  # Mitsuba raises RuntimeError and others for a bad dictionary
            raise SceneError(parser_message(error, Path("dict"))) from error
        if not isinstance(loaded, mi.Scene):
            raise SceneError("the dictionary is no scene: it needs 'type': 'scene' at its top")
        return loaded, "dict"
    if isinstance(scene, str | os.PathLike):
        return load_scene(scene), os.fspath(scene)
    variant = getattr(scene, "variant_name", str)()
    if variant not in ("", mi.variant()):
        raise SceneError(
            f"this scene was loaded under variant {variant}, and {mi.variant()} is set now: load it again"
        )
    raise SceneError(f"a scene is a path, a dictionary or an mi.Scene, not {type(scene).__name__}")
