"""A document compared with its schema, a `Table`, or refused in one line that says where it is not so."""

from __future__ import annotations

import reprlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from difflib import get_close_matches
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError, WrapValidator, model_validator
from pydantic_core import PydanticCustomError

from .reading import Fault

TableT = TypeVar("TableT", bound="Table")

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
