"""OBJ (with its materials), PLY and STL files, read by trimesh.

trimesh says nothing of files that it misses, so what it asks for is watched. Colours stored as bytes are
sRGB, those of OBJ's materials linear. Texture coordinates have v up there, and down here.
"""

from __future__ import annotations

import contextlib
import io
import logging
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SceneError
from .pixels import pixels_of
from .textured_mesh import Floats, Material, Texture, TexturedMesh, World

_GREY = (0.5, 0.5, 0.5)
_PLAIN = (0.8, 0.8, 0.8)
"""Of OBJ's materials without a colour, and of what has no material."""


def read_scan(file: Path) -> World:
    """What an `.obj`, `.ply` or `.stl` file shows.

    Raises:
        SceneError: trimesh is missing or cannot read it, or materials or textures of it are missing.
    """
    try:
        import trimesh
    except ImportError as error:
        raise SceneError(
            f"{file} is read by trimesh, which is not installed: pip install 'mitsuba_crb[worlds]'"
        ) from error
    asked: Any = _Beside(file)
    with _silenced():
        try:
            scene = trimesh.load_scene(
                io.BytesIO(file.read_bytes()),
                file_type=file.suffix[1:].lower(),
                resolver=asked,
                process=False,
            )
        except Exception as error:  # what readers stumble over in damaged data has no common class
            reason = str(error).splitlines()[0][:80] if str(error) else "it ends too early"
            raise SceneError(f"{file} is damaged or cut off ({reason}); export it again") from error
        if asked.missing:
            raise SceneError(
                f"{file} refers to {', '.join(sorted(asked.missing))}, which cannot be read: put it beside "
                "the file, or remove the reference"
            )
        shown = [mesh for mesh in scene.geometry.values() if isinstance(mesh, trimesh.Trimesh)]
        if not shown and file.suffix.lower() == ".stl":  # whose damage passes for a text without triangles
            raise SceneError(f"{file} is damaged or cut off (no triangle is in it); export it again")
        return World(
            [_mesh(mesh, file, f"{file.stem} {i}" if i else file.stem) for i, mesh in enumerate(shown)]
        )


class _Beside:
    """Files beside a file, as trimesh asks for them, and those that it did not get."""

    def __init__(self, file: Path) -> None:
        self.missing: set[str] = set()
        self.file_name = file.name
        self.folder = file.parent

    def get(self, name: str) -> bytes:
        name = name.strip().replace("\\", "/")
        try:
            data = (self.folder / name).read_bytes()
        except OSError:
            self.missing.add(name)
            raise
        if not name.lower().endswith(".mtl"):
            self._try(name, data)
        return data

    __getitem__ = get

    def _try(self, name: str, data: bytes) -> None:
        from PIL import Image

        try:
            Image.open(io.BytesIO(data))
        except Exception:
            self.missing.add(name)
            raise


@contextlib.contextmanager
def _silenced() -> Iterator[None]:
    """What trimesh and NumPy remark of files that it then reads or refuses."""
    log = logging.getLogger("trimesh")
    level = log.level
    log.setLevel(logging.CRITICAL + 1)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.setLevel(level)


def _mesh(mesh: Any, file: Path, name: str) -> TexturedMesh:
    visual = mesh.visual
    colours, of, uv, material = None, "vertex", None, Material(file.stem, _PLAIN)
    if visual.kind in ("vertex", "face"):
        of = visual.kind
        colours = linear(np.asarray(getattr(visual, f"{of}_colors"))[:, :3])
        material = Material(file.stem, (1.0, 1.0, 1.0))
    elif visual.kind == "texture":
        material = _material(visual.material, file)
        if visual.uv is not None and len(visual.uv) == len(mesh.vertices):
            uv = np.column_stack([visual.uv[:, 0], 1.0 - visual.uv[:, 1]])
    # trimesh computes normals that the file does not have, and does not say so elsewhere.
    normals = np.asarray(mesh.vertex_normals, np.float64) if "vertex_normals" in mesh._cache else None
    return TexturedMesh(
        name,
        np.asarray(mesh.vertices, dtype=np.float64),
        np.asarray(mesh.faces).astype(np.uint32),
        material,
        normals,
        uv,
        colours,
        of,
    )


def _material(found: Any, file: Path) -> Material:
    """Of OBJ's materials the colour and its texture; their highlights have no physical meaning."""
    name = str(getattr(found, "name", None) or file.stem)
    image = getattr(found, "image", None)
    texture = None
    if image is not None:
        try:
            texture = Texture(pixels_of(image))
        except Exception as error:  # as when it is opened
            raise SceneError(f"{file}: the texture of {name} is damaged ({str(error)[:80]})") from error
    given = getattr(found, "kwargs", {}).get("kd")
    if given is None:
        return Material(name, _GREY if texture is None else (1.0, 1.0, 1.0), texture)
    red, green, blue = np.broadcast_to(np.asarray(given, dtype=np.float64), 3).tolist()
    # Exporters write the colour of a texture that has it already as black, too.
    black = texture is not None and not any((red, green, blue))
    return Material(name, (1.0, 1.0, 1.0) if black else (red, green, blue), texture)


def linear(encoded: NDArray[np.uint8]) -> Floats:
    """Linear values of sRGB bytes. Source: IEC 61966-2-1."""
    values = np.arange(256) / 255.0
    table = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    return np.asarray(table[encoded])
