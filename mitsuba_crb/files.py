"""Files: read whole or refused in one line; written whole or not there.

One function reads each kind of contents, and `checked` compares tables with their schema, a `Table`. All of
them raise the class of error that they are given, with a message that names the file. `jsonable` says how
numbers that JSON does not know are written.
"""

from __future__ import annotations

import io
import json
import math
import os
import reprlib
import secrets
import tomllib
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, ValidationError, WrapValidator, model_validator
from pydantic_core import PydanticCustomError

from .errors import OutputError

T = TypeVar("T")
TableT = TypeVar("TableT", bound="Table")
Fault = type[Exception]

_EXPECTED = {
    "int_type": "a whole number",
    "float_type": "a number",
    "string_type": "a text",
    "bool_type": "true or false",
    "list_type": "a list",
    "dict_type": "a table",
    "model_type": "a table",
    "model_attributes_type": "a table",
    "literal_error": "{expected}",
    "greater_than_equal": "at least {ge}",
    "expected": "{words}",
}
"""What a value must be, by pydantic's name of the fault."""


def read_text(path: Path, fault: Fault) -> str:
    """A text."""
    return _read(path, fault, "UTF-8 text", _text)


def read_toml(path: Path, fault: Fault) -> dict[str, Any]:
    """A TOML document."""
    return _read(path, fault, "TOML", lambda data: tomllib.loads(_text(data)))


def read_json(path: Path, fault: Fault) -> Any:
    """A JSON document."""
    return _read(path, fault, "JSON", lambda data: json.loads(_text(data)))


def read_rows(path: Path, fault: Fault) -> NDArray[np.float64]:
    """Rows (n, m) of numbers, separated by blanks; `#` starts a comment."""
    return _read(path, fault, "text of as many numbers in every row", _rows)


def read_array(path: Path, fault: Fault) -> NDArray[Any]:
    """A `.npy` file's array of real numbers."""
    return _read(path, fault, ".npy file of real numbers", _array)


def read_sparse(path: Path, fault: Fault) -> Any:
    """A sparse matrix that `scipy.sparse.save_npz` wrote."""
    return _read(path, fault, ".npz file of a sparse matrix", _sparse)


def read_grey(path: Path, fault: Fault) -> NDArray[np.uint8]:
    """An image's grey values (H, W)."""
    return _read(path, fault, "image", _grey)


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


def _grey(data: bytes) -> NDArray[np.uint8]:
    from PIL import Image

    with Image.open(io.BytesIO(data)) as picture:
        return np.asarray(picture.convert("L"))


class Table(BaseModel):
    """The schema of a table: a key and the type of its value are a field each; no value is converted."""

    model_config = ConfigDict(strict=True, extra="forbid")

    @model_validator(mode="before")
    @classmethod
    def _known_keys(cls, table: Any) -> Any:
        """Pydantic's own refusal would not name the known keys."""
        if not isinstance(table, Mapping):
            return table
        for key in table:
            if key not in cls.model_fields:
                raise refused(f" has an unknown key {key!r}; {_near(str(key), cls.model_fields)}")
        return dict(table)


def expected(words: str) -> WrapValidator:
    """Says in these words what a value must be, in place of a reason for each of several types."""

    def check(value: Any, inner: Callable[[Any], Any]) -> Any:
        try:
            return inner(value)
        except ValidationError:
            raise PydanticCustomError("expected", "{words}", {"words": words}) from None

    return WrapValidator(check)


def refused(reason: str) -> PydanticCustomError:
    """What a validator raises to end the sentence that begins with a place in a file."""
    return PydanticCustomError("refused", "{reason}", {"reason": reason})


def checked(schema: type[TableT], document: Any, fault: Fault, where: str, *, context: Any = None) -> TableT:
    """A document, if it is as its schema wants it; else `fault`, in one line that says where it is not.

    Args:
        schema: of the whole document.
        document: what `read_toml` or `read_json` returned.
        fault: the class of error to raise.
        where: what the message begins with: the file's name.
        context: for the schema's validators.
    """
    try:
        return schema.model_validate(document, context=context)
    except ValidationError as error:
        raise fault(_line(error, document, where)) from None


def _line(error: ValidationError, document: Any, where: str) -> str:
    """The first fault: its place, what was expected there, and what was got."""
    faults = error.errors(include_url=False)
    kind, steps, value = faults[0]["type"], faults[0]["loc"], faults[0]["input"]
    context = faults[0].get("ctx", {})
    parts = _place(document, steps)
    place = ": ".join([where, *parts] if where else parts)
    if kind == "refused":
        return f"{place}{context['reason']}"
    if kind == "missing":
        return f"{place} has no {steps[-1]}"
    if kind == "union_tag_invalid":
        key, names = (
            context["discriminator"].strip("'"),
            context["expected_tags"].replace("'", "").split(", "),
        )
        if value[key] is not None:
            return f"{place} has an unknown {key} {reprlib.repr(value[key])}; {_near(context['tag'], names)}"
        others = get_close_matches(key, [str(other) for other in value if other != key], 1)
        return f"{place} needs {key}{', not '.join(['', *others])} = one of {', '.join(names)}"
    here = [fault for fault in faults if _place(document, fault["loc"]) == parts]
    if any(fault["type"] not in _EXPECTED for fault in here):
        return f"{place}: {here[0]['msg']}"
    words = [_EXPECTED[fault["type"]].format(**fault.get("ctx", {})) for fault in here]
    return f"{place} must be {' or '.join(dict.fromkeys(words))}, not {reprlib.repr(value)}"


def _place(document: Any, steps: Sequence[str | int]) -> list[str]:
    """Steps into a document in words: `[noise.curve]`, or `agent 'front'` for a table among `agents`."""
    parts: list[str] = []
    for step in steps:
        try:
            document = document[step]
        except (IndexError, KeyError, TypeError):
            continue  # the name of one of several types
        name = step if str(step).isidentifier() else repr(step)
        if isinstance(step, int) and isinstance(document, Mapping):
            parts[-1] = f"{parts[-1].removesuffix('s')} {reprlib.repr(document.get('name', step + 1))}"
        elif isinstance(step, int):
            parts[-1] = f"entry {step + 1} of {parts[-1]}"
        elif not isinstance(document, Mapping):
            parts.append(str(name))
        elif parts and parts[-1].startswith("["):
            parts[-1] = f"{parts[-1][:-1]}.{name}]"
        else:
            parts.append(f"[{name}]")
    return parts


def _near(name: str, known: Iterable[str]) -> str:
    near = get_close_matches(name, known, 1)
    return f"did you mean {near[0]!r}?" if near else f"known are {', '.join(known)}"


def jsonable(value: Any) -> Any:
    """What strict JSON can hold: arrays as lists, infinities as "inf" or "-inf", not-a-number as None."""
    if isinstance(value, Mapping):
        return {str(key): jsonable(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return jsonable(value.tolist())
    if isinstance(value, list | tuple):
        return [jsonable(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else ("inf" if value > 0.0 else "-inf")
    return str(value) if isinstance(value, Path) else value


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """A temporary path beside `path` that replaces it when the block ends, and vanishes if it fails."""
    target = Path(os.path.realpath(path))  # a link keeps pointing where it did
    temporary = temporary_path(target)
    try:
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror or error}") from error
    finally:
        with suppress(OSError):
            temporary.unlink()


def temporary_path(path: Path) -> Path:
    """A new name in the same folder."""
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
