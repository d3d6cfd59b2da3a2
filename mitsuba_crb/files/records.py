"""Results as documents that strict JSON can hold, and back again, bit for bit.

An object becomes a table of its fields, with the name of its class as "type" and the layout's number as
"schema"; so do the objects in its fields. An array keeps its type and shape, and lists its numbers row by
row. Of numbers that JSON does not know, infinities are "inf" and "-inf", and not-a-number is "nan".

Writing looks at the values, reading at the fields' annotations. Where an annotation does not say what to
expect, as in a provenance, lists, tables, arrays, texts and numbers come back, and tuples as lists.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import reprlib
import sys
from collections.abc import Iterable, Mapping
from contextlib import suppress
from types import NoneType, UnionType
from typing import Any, Literal, Self, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import DocumentError

SCHEMA = 1
"""Number of this layout."""

_NOT_FINITE = {"inf": math.inf, "-inf": -math.inf, "nan": math.nan}
_ENTRIES: dict[str, set[type]] = {"b": {bool}, "i": {int}, "u": {int}, "f": {float, int, str}}
"""What the numbers of an array may be, by the kind of its type."""

_NAMES: dict[type, str] = {
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "a text",
    list: "a list",
    dict: "a table",
}


class Record:
    """A dataclass that can be written as a document, and read back."""

    def to_dict(self) -> dict[str, Any]:
        """This object as a document that strict JSON can hold.

        Raises:
            DocumentError: a field holds something else than numbers, texts, arrays and tables of them.
        """
        return _written_record(self)

    @classmethod
    def from_dict(cls, document: Any) -> Self:
        """The object that `to_dict` wrote, bit for bit.

        Args:
            document: what `to_dict` returned, or `json.loads` of what was made of it.

        Raises:
            DocumentError: of another class or layout, a key that is missing or unknown, or a value of the
                wrong kind.
            MitsubaCRBError: values that the class itself refuses.
        """
        record: Self = _read_record(cls, document, cls.__name__)
        return record


def _written(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return _written_record(value)
    if isinstance(value, np.ndarray):
        return _written_array(value)
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, Mapping):
        pairs = [(_written(key), _written(item)) for key, item in value.items()]
        if all(isinstance(key, str) and key != "type" for key, _ in pairs):
            return dict(pairs)
        return {"type": "mapping", "items": [list(pair) for pair in pairs]}
    if isinstance(value, frozenset):
        return sorted(value)
    if isinstance(value, list | tuple):
        return [_written(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    if isinstance(value, str) and value in _NOT_FINITE:
        return {"type": "text", "value": value}
    if value is None or isinstance(value, bool | int | str):
        return value
    raise DocumentError(f"cannot write {reprlib.repr(value)}, of the type {type(value).__name__}")


def _written_record(value: Any) -> dict[str, Any]:
    values = {field.name: _written(getattr(value, field.name)) for field in dataclasses.fields(value)}
    return {"type": type(value).__name__, "schema": SCHEMA, **values}


def _written_array(array: NDArray[Any]) -> dict[str, Any]:
    if array.dtype.kind not in _ENTRIES:
        raise DocumentError(f"cannot write an array of {array.dtype}")
    values = array.ravel().tolist()
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        values = [_written(value) for value in values]
    return {"type": "array", "dtype": array.dtype.name, "shape": list(array.shape), "values": values}


def _read(hint: Any, document: Any, where: str) -> Any:
    """What was written of a value that is annotated so; `where` it stands begins an error's message."""
    origin, inner = get_origin(hint), get_args(hint)
    if hint is Any or hint == ArrayLike:
        return _read_anything(document, where)
    if origin in (Union, UnionType):
        return _read_one_of(inner, document, where)
    if dataclasses.is_dataclass(hint):
        return _read_record(hint, document, where)
    if origin is np.ndarray:
        return _read_array(document, where)
    if origin is tuple:
        return _read_tuple(inner, document, where)
    if hasattr(hint, "_fields"):  # a named tuple
        return hint(*_read_tuple(tuple(_hints(hint).values()), document, where))
    if origin is frozenset:
        return frozenset(_read(inner[0], item, where) for item in _of_kind(list, document, where))
    if origin in (dict, Mapping):
        key_hint, item_hint = inner
        pairs = [(_read(key_hint, key, where), item) for key, item in _pairs(document, where)]
        return {key: _read(item_hint, item, f"{where}[{key!r}]") for key, item in pairs}
    if origin is Literal and document not in inner:
        expected = ", ".join(map(repr, inner))
        raise DocumentError(f"{where} must be one of {expected}, not {reprlib.repr(document)}")
    if origin is Literal:
        return document
    if hint in (float, str):
        document = _read_anything(document, where)
    return _of_kind(hint, document, where)


def _read_record(cls: Any, document: Any, where: str) -> Any:
    table = _of_kind(dict, document, where)
    if table.get("type") != cls.__name__:
        raise DocumentError(f"{where} has the type {reprlib.repr(table.get('type'))}, not {cls.__name__!r}")
    if table.get("schema") != SCHEMA:
        raise DocumentError(f"{where} has the schema {reprlib.repr(table.get('schema'))}, not {SCHEMA}")
    hints = _hints(cls)
    fields = dataclasses.fields(cls)
    known = ["type", "schema", *(field.name for field in fields)]
    _check_keys(table, known, where)
    values = {name: _read(hints[name], table[name], f"{where}.{name}") for name in known[2:]}
    record = cls(**{field.name: values[field.name] for field in fields if field.init})
    for field in fields:
        if not field.init:
            object.__setattr__(record, field.name, values[field.name])
    return record


@functools.cache
def _hints(cls: type) -> dict[str, Any]:
    return get_type_hints(cls)


def _read_tuple(hints: tuple[Any, ...], document: Any, where: str) -> tuple[Any, ...]:
    items = _of_kind(list, document, where)
    if hints[-1] is ...:
        hints = hints[:1] * len(items)
    if len(items) != len(hints):
        raise DocumentError(f"{where} has {len(items)} entries, not {len(hints)}")
    return tuple(_read(hint, items[k], f"{where}[{k}]") for k, hint in enumerate(hints))


def _read_array(document: Any, where: str) -> NDArray[Any]:
    table = _of_kind(dict, document, where)
    _check_keys(table, ("type", "dtype", "shape", "values"), where)
    sides, values = (_of_kind(list, table[name], f"{where}.{name}") for name in ("shape", "values"))
    shape = tuple(_of_kind(int, side, f"{where}.shape") for side in sides)
    if min(shape, default=0) < 0 or math.prod(shape) != len(values):
        raise DocumentError(f"{where} has {len(values)} values, which do not fill the shape {shape}")
    try:
        dtype = np.dtype(_of_kind(str, table["dtype"], f"{where}.dtype"))
        words = {value for value in values if isinstance(value, str)} - _NOT_FINITE.keys()
        if words or not set(map(type, values)) <= _ENTRIES.get(dtype.kind, set()):
            raise TypeError(f"some of its values are no {dtype} numbers")
        return np.array(values, dtype=dtype).reshape(shape)
    except (OverflowError, TypeError, ValueError) as error:
        raise DocumentError(f"{where} is no array of numbers: {error}") from None


def _read_one_of(hints: tuple[Any, ...], document: Any, where: str) -> Any:
    if document is None and NoneType in hints:
        return None
    possible = [hint for hint in hints if hint is not NoneType]
    named = document.get("type") if isinstance(document, dict) else None
    likely = [hint for hint in possible if getattr(hint, "__name__", None) == named] or possible
    for hint in likely[:-1]:
        with suppress(DocumentError):
            return _read(hint, document, where)
    return _read(likely[-1], document, where)


def _read_anything(document: Any, where: str) -> Any:
    if isinstance(document, list):
        return [_read_anything(item, f"{where}[{k}]") for k, item in enumerate(document)]
    if not isinstance(document, dict):
        return _NOT_FINITE.get(document, document) if isinstance(document, str) else document
    match document.get("type"):
        case "array":
            return _read_array(document, where)
        case "text":
            return _of_kind(str, document.get("value"), where)
    pairs = [(_read_anything(key, where), item) for key, item in _pairs(document, where)]
    if any(isinstance(key, list | dict) for key, _ in pairs):
        raise DocumentError(f"{where} has a list or a table for a key")
    return {key: _read_anything(item, f"{where}[{key!r}]") for key, item in pairs}


def _pairs(document: Any, where: str) -> list[tuple[Any, Any]]:
    """Keys and items of a table, which lists them if a key is no text, or is "type"."""
    table = _of_kind(dict, document, where)
    if "type" not in table:
        return list(table.items())
    if table["type"] != "mapping":
        raise DocumentError(f"{where} has the type {reprlib.repr(table['type'])}, which is unknown here")
    pairs = [_of_kind(list, pair, where) for pair in _of_kind(list, table.get("items"), where)]
    if any(len(pair) != 2 for pair in pairs):
        raise DocumentError(f"{where} has an item that is no pair of a key and a value")
    return [(key, item) for key, item in pairs]


def _check_keys(table: dict[str, Any], known: Iterable[str], where: str) -> None:
    missing = [name for name in known if name not in table]
    if missing:
        raise DocumentError(f"{where} has no {missing[0]}")
    unknown = [name for name in table if name not in known]
    if unknown:
        raise DocumentError(f"{where} has an unknown key {unknown[0]!r}")


def _of_kind(kind: type, value: Any, where: str) -> Any:
    """The value, if it is of this kind; a bool is no number here, but a whole number is a number."""
    whole = kind is float and type(value) is int and abs(value) <= sys.float_info.max
    if type(value) is not kind and not whole:
        raise DocumentError(f"{where} must be {_NAMES[kind]}, not {reprlib.repr(value)}")
    return value
