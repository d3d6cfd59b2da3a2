"""Which files and objects are radiance fields, and what may be said of a file."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ..render.scene import SceneFile
from .field import Field

_LETTERS = 16

Loader = Callable[[Path, Mapping[str, str]], Field | None]
"""Makes a field of a file and what is said of it, by name; None if the file is none of its kind."""

_LOADERS: tuple[Loader, ...] = ()


def as_field(world: Any) -> Field | None:
    """The field that a path, a `SceneFile` or an object is; None if it is none.

    Raises:
        FieldError: the file is one, and cannot be read, or is told what it has no use for.
    """
    if isinstance(world, Field):
        return world
    source = SceneFile(world) if isinstance(world, str | os.PathLike) else world
    if not isinstance(source, SceneFile):
        return None
    for load in _LOADERS:
        field = load(Path(source.path), source.defines)
        if field is not None:
            return field
    return None


def field_fingerprint(field: Field, source: Any = None, defines: Mapping[str, str] | None = None) -> str:
    """Sixteen hexadecimal letters that say which field this is: by its file's bytes, and what it says itself.

    Args:
        field: as it was loaded.
        source: the path that it came from.
        defines: what was said of the file.
    """
    said = json.dumps([dict(field.provenance()), dict(defines or {})], sort_keys=True, default=str)
    digest = hashlib.sha256(said.encode())
    if isinstance(source, str | os.PathLike):
        digest.update(Path(source).read_bytes())
    return digest.hexdigest()[:_LETTERS]
