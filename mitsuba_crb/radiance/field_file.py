"""Fields in files: everything that an image of one depends on, its cameras, and how training stood.

One `.npz`: a header in JSON that names the format's version, and arrays.
"""

from __future__ import annotations

import io
import json
import os
import zipfile
import zlib
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from ..errors import CameraError, DocumentError, FieldError
from ..files import atomic, read_bytes
from ..render.backend import use_mitsuba
from .field import Viewpoint
from .hashgrid import HashGrid
from .network import Design
from .scene_space import SceneSpace

SCHEMA = "mitsuba-crb/field/1"
_KIND = SCHEMA.rpartition("/")[0]
_HEADER = "header"

Arrays = dict[str, NDArray[Any]]

_DAMAGE = (
    DocumentError,
    CameraError,
    ArithmeticError,
    AttributeError,
    EOFError,
    LookupError,
    NotImplementedError,
    OSError,
    TypeError,
    ValueError,
    zipfile.BadZipFile,
    zlib.error,
)
"""What readers stumble over."""


@dataclass(frozen=True, eq=False)
class Standing:
    """How training stood when a field was written."""

    settings: dict[str, Any]
    """What the field depends on; JSON-able."""
    progress: dict[str, Any]
    """Numbers; JSON-able."""
    arrays: Arrays
    """Moments of the parameters, density seen so far."""


def is_field(path: str | os.PathLike[str]) -> bool:
    """Whether a file is one that `save_field` wrote, of whatever version."""
    try:
        with zipfile.ZipFile(path) as file:
            return f"{_HEADER}.npy" in file.namelist()
    except (OSError, zipfile.BadZipFile, ValueError):
        return False


def save_field(path: Path, field: HashGrid, standing: Standing) -> None:
    """Write a field, in place of what the file held.

    Raises:
        OutputError: the file cannot be written.
    """
    header = {
        "schema": SCHEMA,
        "design": asdict(field.design),
        "space": asdict(field.space),
        "background": list(field.background),
        "facts": dict(field.facts),
        "viewpoints": [{"name": v.name, "intrinsics": v.intrinsics.to_dict()} for v in field.viewpoints],
        "settings": standing.settings,
        "progress": standing.progress,
    }
    arrays: dict[str, Any] = {
        _HEADER: np.array(json.dumps(header)),
        "poses": np.array([v.pose for v in field.viewpoints], dtype=np.float64).reshape(-1, 4, 4),
        "entries": field.entries,
        "vertices": np.packbits(field.vertices),
        **field.weights,
        **{f"standing_{name}": values for name, values in standing.arrays.items()},
    }
    with atomic(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)


def load_field(path: str | os.PathLike[str]) -> HashGrid:
    """A field that was trained here.

    Raises:
        FieldError: the file is none, is of another version, or is damaged.
    """
    return load_standing(Path(path))[0]


def load_standing(path: Path) -> tuple[HashGrid, Standing]:
    """A field, and how its training stood.

    Raises:
        FieldError: the file is none, is of another version, or is damaged.
    """
    data = read_bytes(path, FieldError)
    if not is_field(path):
        raise FieldError(f"{path} is no field that mitsuba-crb train wrote, or is damaged; train it anew")
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            header = json.loads(str(file[_HEADER]))
            schema = str(header["schema"])
            if schema == SCHEMA:
                return _read(str(path), header, {name: file[name] for name in file.files if name != _HEADER})
    except _DAMAGE as error:
        raise FieldError(f"{path} is damaged ({str(error)[:200]}); train it anew") from error
    if schema.rpartition("/")[0] != _KIND:
        raise FieldError(f"{path} has the format {schema[:80]!r}, which is no field's")
    raise FieldError(
        f"{path} has the format {schema[:80]!r}, and this version of mitsuba-crb reads {SCHEMA!r}; train it "
        "anew"
    )


def _read(label: str, header: dict[str, Any], arrays: Arrays) -> tuple[HashGrid, Standing]:
    from ..camera import Intrinsics

    design = TypeAdapter(Design).validate_python(header["design"])
    side = design.cells + 1
    use_mitsuba()
    count = design.encoding(0).n_params
    shapes = design.shapes() | {"entries": (count,), "vertices": (-(-(side**3) // 8),)}
    for name, shape in shapes.items():
        values = arrays[name]
        if values.shape != shape or not np.isfinite(values).all():
            raise ValueError(f"{name} is {values.shape}, not {shape}, or has numbers that are not finite")
    names = header["viewpoints"]
    poses = arrays["poses"].astype(np.float64)
    if poses.shape != (len(names), 4, 4) or not np.isfinite(poses).all():
        raise ValueError("its cameras' poses are not as many as its cameras")
    r, g, b = (float(value) for value in header["background"])
    field = HashGrid(
        label,
        design,
        TypeAdapter(SceneSpace).validate_python(header["space"]),
        arrays["entries"].astype(np.float32),
        {name: arrays[name].astype(np.float32) for name in design.shapes()},
        np.unpackbits(arrays["vertices"], count=side**3).astype(np.bool_).reshape((side,) * 3),
        (r, g, b),
        tuple(
            Viewpoint(str(item["name"]), Intrinsics.from_dict(item["intrinsics"]), pose)
            for item, pose in zip(names, poses, strict=True)
        ),
        dict(header["facts"]),
    )
    prefix = "standing_"
    kept = {name.removeprefix(prefix): values for name, values in arrays.items() if name.startswith(prefix)}
    return field, Standing(dict(header["settings"]), dict(header["progress"]), kept)
