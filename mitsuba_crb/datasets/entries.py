"""Numbers taken out of documents by others, where a number may be written as a text, or be none."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Mapping, Sequence
from typing import Any

from ..files.reading import Fault


def number(value: Any, where: str, fault: Fault) -> float:
    """A finite number, or a text of one.

    Raises:
        fault: it is none.
    """
    try:
        if isinstance(value, bool) or not isinstance(value, int | float | str):
            raise TypeError
        result = float(value)
    except (TypeError, ValueError, OverflowError):
        raise fault(f"{where} must be a number, not {reprlib.repr(value)}") from None
    if not math.isfinite(result):
        raise fault(f"{where} is {result}; it must be a finite number")
    return result


def whole(value: Any, where: str, fault: Fault) -> int:
    """A whole number; 640.0 is one.

    Raises:
        fault: it is none.
    """
    result = number(value, where, fault)
    if result != round(result):
        raise fault(f"{where} must be a whole number, not {reprlib.repr(value)}")
    return round(result)


def numbers(value: Any, where: str, fault: Fault, count: int | None = None) -> list[float]:
    """A list of `count` finite numbers, or of any count.

    Raises:
        fault: it is none.
    """
    if not isinstance(value, Sequence) or isinstance(value, str | bytes):
        raise fault(f"{where} must be a list of numbers, not {reprlib.repr(value)}")
    if count is not None and len(value) != count:
        raise fault(f"{where} must have {count} numbers, not {len(value)}")
    return [number(entry, where, fault) for entry in value]


def table(value: Any, where: str, fault: Fault) -> Mapping[str, Any]:
    """A table.

    Raises:
        fault: it is none.
    """
    if not isinstance(value, Mapping):
        raise fault(f"{where} must be a table, not {reprlib.repr(value)}")
    return value


def required(document: Mapping[str, Any], key: str, where: str, fault: Fault) -> Any:
    """What the table has under the key.

    Raises:
        fault: it has nothing.
    """
    if key not in document:
        raise fault(f"{where} has no {key}")
    return document[key]
