"""What stands in `grid:…` and `around:…`: keys, numbers, counts, angles; each mistake named in one line."""

from __future__ import annotations

import math
import re
from difflib import get_close_matches
from typing import NoReturn

import numpy as np
from numpy.typing import ArrayLike

from ..errors import OptionError
from ..se3 import Array

AXES = "xyz"
_GRID = ("x", "y", "z", "nx", "ny", "nz", "spacing", "headings", "pitch", "up")
_AROUND = ("target", "radius", "elevations", "count", "up")
FORMS = {"grid": _GRID, "around": _AROUND}
"""Their keys."""
_MOST = 10_000_000
"""Views that a form makes."""


def values_of(form: str, text: str) -> dict[str, str]:
    """Keys and values of a form.

    Raises:
        OptionError: a key that it has not, or twice, or without a value.
    """
    said: dict[str, str] = {}
    for part in filter(None, (part.strip() for part in text.split(","))):
        key, equals, value = (word.strip() for word in part.partition("="))
        if key not in FORMS[form]:
            near = get_close_matches(key, FORMS[form], 1, 0.5)
            hint = f"did you mean {near[0]}? " if near else ""
            raise OptionError(f"--poses {form}: has no {key!r}; {hint}it has {', '.join(FORMS[form])}")
        if not equals or not value:
            raise OptionError(f"--poses {form}: {key} has no value; write {key}=...")
        if key in said:
            raise OptionError(f"--poses {form}: says {key} twice; leave one out")
        said[key] = value
    return said


def numbers_of(form: str, key: str, text: str) -> list[float]:
    """Finite numbers between colons."""
    try:
        numbers = [float(word) for word in text.split(":")]
    except ValueError:
        numbers = [math.nan]
    if not all(math.isfinite(number) for number in numbers):
        _refuse(form, key, text, "a number, or several between colons")
    return numbers


def positive(form: str, key: str, text: str) -> float:
    """One positive number."""
    numbers = numbers_of(form, key, text)
    if len(numbers) != 1 or numbers[0] <= 0.0:
        _refuse(form, key, text, "one positive number [scene unit]")
    return numbers[0]


def count_of(form: str, key: str, said: dict[str, str]) -> int | None:
    """A whole number from 1; None if nothing is said."""
    if key not in said:
        return None
    if not re.fullmatch(r"\d{1,9}", said[key]) or int(said[key]) == 0:
        _refuse(form, key, said[key], "a whole number from 1")
    return int(said[key])


def angles_of(form: str, key: str, text: str) -> Array:
    """Different angles (k,) from −90 to 90 degrees."""
    numbers = numbers_of(form, key, text)
    if not all(-90.0 <= number <= 90.0 for number in numbers) or len(set(numbers)) < len(numbers):
        _refuse(form, key, text, "one or several different angles from -90 to 90 [deg], such as -20:0:20")
    return np.array(numbers)


def _refuse(form: str, key: str, text: str, wanted: str) -> NoReturn:
    raise OptionError(f"--poses {form}: {key}={text} is not {wanted}")


def check_few(count: int) -> None:
    """Refuse more views than anybody measures."""
    if count > _MOST:
        raise OptionError(f"--poses: {count} views are more than {_MOST}; choose fewer, or a larger spacing")


def up_of(form: str, text: str) -> Array:
    """A unit vector (3,): one of the world's axes, or three numbers."""
    axis = text.lstrip("+-")
    if axis in tuple(AXES):
        return np.asarray(np.eye(3)[AXES.index(axis)] * (-1.0 if text.startswith("-") else 1.0))
    numbers = numbers_of(form, "up", text) if ":" in text else []
    if len(numbers) != 3 or not any(numbers):
        _refuse(form, "up", text, "x, y, z, -x, -y, -z or three numbers between colons, such as 0:0.1:1")
    return direction_of(numbers)


def direction_of(vector: ArrayLike) -> Array:
    """A unit vector (3,)."""
    found = np.asarray(vector, dtype=np.float64)
    length = float(np.linalg.norm(found)) if found.shape == (3,) else math.nan
    if not 0.0 < length < math.inf:
        raise OptionError(f"up is a direction of three finite numbers, not {vector!r}")
    return np.asarray(found / length)
