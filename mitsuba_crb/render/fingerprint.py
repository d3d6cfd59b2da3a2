"""What a scene is, in a few letters: equal for equal scenes, another one after an edit.

The bytes of its files count, and of the scene that was loaded every parameter's value and every object's
description, so that textures and meshes count by their contents. Of a scene that came as an object there is
no text: what Mitsuba neither prints nor exposes, such as a texture's interpolation, goes unnoticed there.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .scene import SceneFile, contents, read_file
from .world import is_world

if TYPE_CHECKING:
    import mitsuba as mi

_LETTERS = 16


def fingerprint(scene: mi.Scene, source: Any = None, defines: Mapping[str, str] | None = None) -> str:
    """Sixteen hexadecimal letters that say which scene this is.

    Args:
        scene: as it was loaded.
        source: the path or the dictionary that it came from.
        defines: the file's `<default>`s.
    """
    # Sorted, because Mitsuba merges meshes in any order.
    parts = sorted(hashlib.sha256(part).digest() for part in (*_loaded(scene), *_written(source, defines)))
    return hashlib.sha256(b"".join(parts)).hexdigest()[:_LETTERS]


def mask_fingerprint(mask: NDArray[np.bool_]) -> str:
    """The same of a choice of pixels (H, W)."""
    return hashlib.sha256(repr(mask.shape).encode() + mask.tobytes()).hexdigest()[:_LETTERS]


def _loaded(scene: mi.Scene) -> Iterator[bytes]:
    import mitsuba as mi

    for name, value in mi.traverse(scene):
        # Objects without a name are called by their address.
        known = re.sub(r"(object|_unnamed|_arg)_\w+", "", name)
        array = np.array(getattr(value, "matrix", value))
        values = repr(value).encode() if array.dtype.hasobject else array.tobytes()
        yield f"{known} {array.dtype} {array.shape} ".encode() + values
    for node in contents(scene):
        if node is not scene:  # which lists them all, in any order
            yield re.sub("0x[0-9a-f]+", "", str(node)).encode()


def _written(source: Any, defines: Mapping[str, str] | None) -> Iterator[bytes]:
    if isinstance(source, Mapping):
        yield json.dumps(source, sort_keys=True, default=lambda value: type(value).__name__).encode()
    elif isinstance(source, str | os.PathLike):
        if is_world(Path(source)):
            yield Path(source).read_bytes()
        else:
            yield from (file.read_bytes() for file in read_file(SceneFile(source, defines or {})).files)
