"""The scenes that come along, by name from any folder: `demo:textured_room`.

They lie in `scenes/` beside the package in a checkout, and within it where a wheel was installed.
"""

from __future__ import annotations

import os
from difflib import get_close_matches
from pathlib import Path

from ..errors import SceneError

PREFIX = "demo:"
"""What their names begin with."""

_PACKAGE = Path(__file__).parents[1]
_FOLDERS = (_PACKAGE / "scenes", _PACKAGE.parent / "scenes")


def scene_path(path: str | os.PathLike[str], ending: str = ".xml") -> Path:
    """The file of a demo, or any other path as it is.

    Args:
        path: a path, or "demo:NAME".
        ending: of the demo's file: .xml, or .toml of a team in it.

    Raises:
        SceneError: there is no such demo; names the near one.
    """
    text = os.fspath(path)
    if not text.startswith(PREFIX):
        return Path(path)
    name, found = text.removeprefix(PREFIX), _found(ending)
    if name in found:
        return found[name]
    near = get_close_matches(name, found, 1)
    hint = f"did you mean {PREFIX}{near[0]}?" if near else f"there are {', '.join(PREFIX + n for n in found)}"
    kind = "" if ending == ".xml" else " with a team"
    raise SceneError(f"there is no {text}{kind}; {hint}")


def demo_names(ending: str = ".xml") -> tuple[str, ...]:
    """Of all that have a file of this ending."""
    return tuple(_found(ending))


def _found(ending: str) -> dict[str, Path]:
    folder = next((folder for folder in _FOLDERS if folder.is_dir()), None)
    if folder is None:
        return {}
    files = (each / f"{each.name}{ending}" for each in sorted(folder.iterdir()))
    return {file.stem: file for file in files if file.is_file()}
