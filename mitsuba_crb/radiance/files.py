"""Which files and objects are radiance fields, and what may be said of a file."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..datasets.splats import is_splats
from ..errors import FieldError
from ..render.scene import SceneFile
from .field import Field

_LETTERS = 16

TRAINED = ".npz"
"""The ending of a trained field's file."""
SPLAT_OPTIONS = ("variant", "background")
"""What may be said of a file of splats: classic, antialiased or mip; a grey, or red, green and blue."""


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
    file = source.file
    if is_splats(file):
        return _splats(file, source.defines)
    return _trained(file, source.defines) if file.suffix.lower() == TRAINED else None


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


def _splats(file: Path, said: Mapping[str, str]) -> Field:
    from .gaussians import load_gaussians

    _check(file, "splats", said, SPLAT_OPTIONS)
    options: dict[str, Any] = dict(said)
    if "background" in said:
        options["background"] = _colour(said["background"])
    return load_gaussians(file, **options)


def _trained(file: Path, said: Mapping[str, str]) -> Field:
    from .field_file import load_field

    _check(file, "trained fields", said, ())
    return load_field(file)


def _check(file: Path, kind: str, said: Mapping[str, str], known: Sequence[str]) -> None:
    unknown = sorted(set(said) - set(known))
    if unknown:
        raise FieldError(f"{file} has no {', '.join(unknown)}; {kind} have {', '.join(known) or 'none'}")


def _colour(text: str) -> float | list[float]:
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (1, 3):
        raise FieldError(f"-D background={text} is neither a grey, such as 1, nor three numbers: 1,0.5,0")
    return numbers if len(numbers) == 3 else numbers[0]
