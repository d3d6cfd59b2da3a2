"""Scenes: loaded from files, dictionaries and objects; what is wrong with one, in a line; what is in it."""

from __future__ import annotations

import contextlib
import os
import re
import sys
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import SceneError, SceneWarning
from .backend import use_mitsuba
from .cures import cured, innermost, property_cure
from .demos import scene_path
from .fit import Wanted, fit
from .instantiate import instantiate
from .lending import turns
from .scene_file import Parsed, at, parse
from .world import FOV, OPTIONS, is_world, load_world, stands_in

if TYPE_CHECKING:
    import mitsuba as mi

_MOST_NAMED = 12
"""Faults that one message names."""


@dataclass(frozen=True)
class SceneFile:
    """A scene's file with its `<default>`s, to be loaded as it is measured: its image of another shape, its
    meshes apart if their parameters are asked for."""

    path: str | os.PathLike[str]
    """Of the XML file, or of a world's (see `world`); or "demo:NAME", one that comes along (see `demos`)."""
    defines: Mapping[str, str] = field(default_factory=dict)
    """Values of its `<default>`s; of a world: up, light and fov; of splats: variant and background."""

    @property
    def file(self) -> Path:
        """Where it is.

        Raises:
            SceneError: there is no such demo.
        """
        return scene_path(self.path)


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


@contextlib.contextmanager
def _names_relative_to(folder: Path) -> Iterator[None]:
    """Mitsuba finds files in this folder first."""
    import mitsuba as mi

    before = mi.file_resolver()
    own = mi.FileResolver(before)
    own.prepend(str(folder))
    mi.set_file_resolver(own)
    try:
        yield
    finally:
        mi.set_file_resolver(before)


_STANDS_IN = f"it has no camera: one with {FOV:g} degrees across stands in (--camera FILE, or -D fov={FOV:g})"
_UNTRACEABLE = "emitter timed_sunsky is loaded by Mitsuba, but cannot be traced; use sunsky"
"""Mitsuba 3.9 evaluates what is symbolic there, and no kernel of any scene is traced while one lives."""


def load_scene(path: str | os.PathLike[str], /, **defines: str) -> mi.Scene:
    """Load a Mitsuba XML file; `defines` set its `<default>` values.

    Raises:
        SceneError: in one line, all that is wrong with the file, with lines and cures.

    Warns:
        SceneWarning: something in it that is not needed was left out or replaced.
    """
    use_mitsuba()
    return _from_file(SceneFile(path, defines), Wanted())


def read_file(source: SceneFile) -> Parsed:
    """What Mitsuba's parser makes of a file; errors as `parse`."""
    import mitsuba as mi

    file = source.file
    defines = {key: str(value) for key, value in source.defines.items()}
    with _loading(), _names_relative_to(file.parent):
        return parse(mi.parser.ParserConfig(mi.variant()), file, defines)


def as_scene(scene: Any, wanted: Wanted | None = None) -> tuple[mi.Scene, str]:
    """The scene of a path, a `SceneFile`, a dictionary or a scene, and what to call it.

    Args:
        scene: any of these; an `mi.Scene` is taken as it is.
        wanted: what is going to be measured of it.

    Raises:
        SceneError: it is none of these, was loaded under another variant, cannot be loaded, or has a mesh
            without faces or another thing that Mitsuba loads and cannot trace.
    """
    use_mitsuba()
    with _loading():
        loaded, label = _loaded(scene, wanted or Wanted())
    for shape in loaded.shapes():
        if shape.is_mesh() and not shape.face_count():
            raise SceneError(f"mesh {shape.id()} has no faces, which Mitsuba cannot trace; remove it")
    for emitter in loaded.emitters():
        if emitter.class_name() == "TimedSunskyEmitter":
            raise SceneError(_UNTRACEABLE)
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


def _loaded(scene: Any, wanted: Wanted) -> tuple[mi.Scene, str]:
    import mitsuba as mi

    if isinstance(scene, mi.Scene):
        return scene, "mi.Scene"
    if isinstance(scene, Mapping):
        loaded = _from_dictionary(scene, wanted)
        if not isinstance(loaded, mi.Scene):
            raise SceneError("the dictionary is no scene: it needs 'type': 'scene' at its top")
        return loaded, "dict"
    if isinstance(scene, str | os.PathLike):
        scene = SceneFile(scene)
    if isinstance(scene, SceneFile):
        return _from_file(scene, wanted), os.fspath(scene.path)
    variant = getattr(scene, "variant_name", str)()
    if variant not in ("", mi.variant()):
        raise SceneError(
            f"this scene was loaded under variant {variant}, and {mi.variant()} is set now: load it again"
        )
    raise SceneError(f"a scene is a path, a dictionary or an mi.Scene, not {type(scene).__name__}")


def _from_file(source: SceneFile, wanted: Wanted) -> mi.Scene:
    import mitsuba as mi

    file = source.file
    if is_world(file):
        world = _world(file, source.defines)
        if stands_in(world) and not wanted.calibrated and "fov" not in source.defines:
            warnings.warn(f"{file}: {_STANDS_IN}", SceneWarning, stacklevel=4)
        return _from_dictionary(world, wanted, file)
    parsed = read_file(source)
    with _loading(), _names_relative_to(file.parent):
        loaded = _made(parsed, wanted, file)
    if not isinstance(loaded, mi.Scene):
        raise SceneError(f"{file} holds no <scene> at its top")
    return loaded


def _world(file: Path, defines: Mapping[str, str]) -> dict[str, Any]:
    unknown = sorted(set(defines) - set(OPTIONS))
    if unknown:
        raise SceneError(
            f"{file} has no <default> named {', '.join(unknown)}; a world has {', '.join(OPTIONS)}"
        )
    options: dict[str, Any] = dict(defines)
    return load_world(file, **options)


def _from_dictionary(scene: Mapping[str, Any], wanted: Wanted, file: Path | None = None) -> Any:
    import mitsuba as mi

    try:
        state = mi.parser.parse_dict(mi.parser.ParserConfig(mi.variant()), dict(scene))
    except Exception as error:  # Mitsuba raises RuntimeError and others for a bad dictionary
        where, cause = innermost(error)
        raise SceneError(f"dict: {at(where, None)}{cured(cause)}") from error
    return _made(Parsed(state), wanted, file)


def _made(parsed: Parsed, wanted: Wanted, file: Path | None) -> Any:
    """The object of a parsed scene; all that is wrong with it in one message, all it goes without in one."""
    import mitsuba as mi

    state, config = parsed.state, mi.parser.ParserConfig(mi.variant())
    if state is None:
        raise SceneError(_named(file or "dict", parsed.faults))
    # Not by the loaded scene: an error would keep it alive.
    if any(node.props.plugin_name() == "timed_sunsky" for node in state.nodes):
        raise SceneError(f"{file or 'dict'}: {_UNTRACEABLE}")
    faults: list[str] = list(parsed.faults)
    notes: list[str] = []
    made: Any = None
    unread: list[str] = []
    try:
        if state.versions:
            mi.parser.transform_upgrade(config, state)
        mi.parser.transform_resolve(config, state)
        if str(state.nodes[0].type).endswith("Scene"):
            notes = fit(state, wanted)
        if not wanted.apart:
            mi.parser.transform_merge_equivalent(config, state)
            mi.parser.transform_merge_meshes(config, state)
    except Exception as error:  # as when it is parsed
        where, cause = innermost(error)
        faults.append(f"{at(where, file)}{cured(cause)}")
    else:
        made, more, unread = instantiate(config, state, file)
        faults += more
    if faults:
        faults += [f"{name}: {property_cure(name.split()[0])}" for name in unread]
        raise SceneError(_named(file or "dict", faults))
    left_out = [*parsed.left_out, *unread]
    if left_out:
        notes.append(f"left out, for Mitsuba 3 has no such thing: {', '.join(left_out)}")
    if notes:
        warnings.warn("; ".join(notes), SceneWarning, stacklevel=5)
    return made


def _named(file: Path | str, faults: list[str]) -> str:
    """All faults in one message, in the order of their lines; what has none comes last."""
    lines = {fault: re.match(r"line (\d+):", fault) for fault in faults}
    faults = sorted(lines, key=lambda fault: int(found[1]) if (found := lines[fault]) else sys.maxsize)
    more = [f"and {len(faults) - _MOST_NAMED} more"] if len(faults) > _MOST_NAMED else []
    return f"{file}: " + "; ".join([*faults[:_MOST_NAMED], *more])
