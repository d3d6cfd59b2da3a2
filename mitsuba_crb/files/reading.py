"""Files read whole, or refused in one line.

One function reads each kind of contents. All of them raise the class of error that they are given, with a
message that names the file.
"""

from __future__ import annotations

import io
import json
import re
import tomllib
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T")
Fault = type[Exception]


def read_text(path: Path, fault: Fault) -> str:
    """A text."""
    return _read(path, fault, "UTF-8 text", _text)


def read_bytes(path: Path, fault: Fault) -> bytes:
    """A file's bytes."""
    return _read(path, fault, "file", bytes)


def read_toml(path: Path, fault: Fault) -> dict[str, Any]:
    """A TOML document."""
    return _read(path, fault, "TOML", lambda data: tomllib.loads(_text(data)))


def read_json(path: Path, fault: Fault) -> Any:
    """A JSON document."""
    return _read(path, fault, "JSON", lambda data: json.loads(_text(data)))


def read_yaml(path: Path, fault: Fault) -> Any:
    """A YAML document: tables, lists and texts; numbers stay texts, of which YAML's own idea is odd (1e-5).

    Left out: tags, OpenCV's line %YAML:1.0, which is no YAML, and what follows the first document.
    """
    return _read(path, fault, "YAML", _yaml)


def read_rows(path: Path, fault: Fault) -> NDArray[np.float64]:
    """Rows (n, m) of numbers, separated by blanks; `#` starts a comment."""
    return _read(path, fault, "text of as many numbers in every row", _rows)


def read_array(path: Path, fault: Fault) -> NDArray[Any]:
    """A `.npy` file's array of real numbers."""
    return _read(path, fault, ".npy file of real numbers", _array)


def read_sparse(path: Path, fault: Fault) -> Any:
    """A sparse matrix that `scipy.sparse.save_npz` wrote."""
    return _read(path, fault, ".npz file of a sparse matrix", _sparse)


def read_grey(path: Path, fault: Fault, *, upright: bool = False) -> NDArray[np.uint8]:
    """An image's grey values (H, W); `upright` as of `read_colours`."""
    return _read(path, fault, "image", lambda data: _grey(data, upright))


def read_image_size(path: Path, fault: Fault) -> tuple[int, int]:
    """An image's width and height [pixel]; its pixels stay unread."""
    from PIL import Image

    try:
        with Image.open(path) as picture:
            return picture.size
    except Exception as error:  # see `_read`
        reason = error.strerror if isinstance(error, OSError) and error.strerror else "it is no image"
        raise fault(f"cannot read {path}: {reason}") from error


def read_colours(path: Path, fault: Fault, *, upright: bool = False) -> NDArray[np.float32]:
    """An image's values (H, W, 4), red, green, blue and opacity as stored, from 0 to 1.

    Args:
        path: of the file.
        fault: the class of error.
        upright: turned as its EXIF orientation says it is to be shown, not as its pixels are stored.
    """
    return _read(path, fault, "image", lambda data: _colours(data, upright))


def _read(path: Path, fault: Fault, kind: str, decode: Callable[[bytes], T]) -> T:
    try:
        data = path.read_bytes()
    except (OSError, ValueError) as error:  # ValueError: of a name with a null character
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise fault(f"cannot read {path}: {reason}") from error
    try:
        return decode(data)
    except Exception as error:  # what decoders stumble over in damaged data has no common class
        raise fault(f"{path} is no {kind}: {str(error)[:200] or 'it ends too early'}") from error


def _text(data: bytes) -> str:
    return data.decode("utf-8-sig")


def _yaml(data: bytes) -> Any:
    import yaml

    text = re.sub(r"\A%YAML.*", "", _text(data))
    try:
        return next(yaml.load_all(text, yaml.BaseLoader), None)
    except yaml.MarkedYAMLError as error:  # its own words span several lines
        place = f"line {error.problem_mark.line + 1}: " if error.problem_mark else ""
        raise ValueError(f"{place}{error.problem or error.context}") from None
    except yaml.YAMLError as error:
        raise ValueError(" ".join(str(error).split())) from None


def _rows(data: bytes) -> NDArray[np.float64]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # NumPy's own remark on an empty text
        return np.loadtxt(io.StringIO(_text(data)), ndmin=2)


def _array(data: bytes) -> NDArray[Any]:
    array = np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)
    if array.dtype.kind not in "biuf":
        raise TypeError(f"its numbers are {array.dtype}")
    return array


def _sparse(data: bytes) -> Any:
    from scipy import sparse

    matrix = sparse.load_npz(io.BytesIO(data))
    if hasattr(matrix, "check_format"):  # of compressed formats, whose indices nobody has looked at yet
        matrix.check_format()
    return matrix


def _grey(data: bytes, upright: bool) -> NDArray[np.uint8]:
    from PIL import Image

    with Image.open(io.BytesIO(data)) as picture:
        return np.asarray(_turned(picture, upright).convert("L"))


def _colours(data: bytes, upright: bool) -> NDArray[np.float32]:
    from PIL import Image

    with Image.open(io.BytesIO(data)) as picture:
        if picture.mode[0] in "IF":  # which PIL's conversion cuts off at 255
            raise ValueError(f"its values are of PIL's mode {picture.mode}; save it with 8 bits per channel")
        values = _turned(picture, upright).convert("RGBA")
        return np.asarray(values, dtype=np.float32) / np.float32(255.0)


def _turned(picture: Any, upright: bool) -> Any:
    from PIL import ImageOps

    return ImageOps.exif_transpose(picture) if upright else picture
