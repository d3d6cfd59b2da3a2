"""The file that trials are kept in as they end, so that a run that was interrupted can be resumed.

Trials are resumed only under the settings that they were run with: whatever a result depends on.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, get_args

from ..errors import TrialError
from ..files import atomic, changes, read_json
from .optimisers import Status
from .trial import Trial

SCHEMA = "mitsuba-crb/validate/2"


class EarlierRun(NamedTuple):
    """An earlier run."""

    file: Path
    """Where it is kept."""
    settings: dict[str, Any]
    """What its trials depend on."""
    trials: list[Trial]
    """As they ended."""


def recorded(file: Path | None) -> EarlierRun | None:
    """What an earlier run has left; None if there was none.

    Raises:
        TrialError: the file is there, and is no record of trials.
    """
    if file is None or not os.path.lexists(file):
        return None
    try:
        document = read_json(file, ValueError)
        schema, settings, results = (document[key] for key in ("schema", "settings", "results"))
        if schema == SCHEMA:
            return EarlierRun(file, dict(settings), [_read_trial(**result) for result in results])
    except (ArithmeticError, KeyError, TypeError, ValueError) as error:
        raise TrialError(f"{file} exists and is no record of trials ({error}); name another file") from error
    raise TrialError(f"{file} has the schema {schema!r}, not {SCHEMA!r}; name another file")


def _read_trial(
    index: Any,
    status: Any,
    error: Any,
    residual: Any,
    iterations: Any,
    excess: Any,
    added: Any,
    invalid: Any,
) -> Trial:
    if status not in get_args(Status) or len(error) != 6 or len(added) != 21:
        raise ValueError(f"trial {index} has the status {status!r}, the error {error} and {added} added")
    return Trial(
        index=int(index),
        status=status,
        error=tuple(float(value) for value in error),
        residual=float(residual),
        iterations=int(iterations),
        excess=float(excess),
        added=tuple(float(value) for value in added),
        invalid=int(invalid),
    )


def resumed(record: EarlierRun | None, settings: dict[str, Any]) -> dict[int, Trial]:
    """The trials of an earlier run with the same settings by their numbers, all of them.

    Raises:
        TrialError: its settings were others; names them.
    """
    if record is None:
        return {}
    file, before, found = record
    changed = changes(before, json.loads(json.dumps(settings)))
    if changed:
        raise TrialError(
            f"{file} holds trials with {', '.join(changed)}; name another file, or use the same settings to "
            "resume"
        )
    return {trial.index: trial for trial in found}


def write_record(file: Path, settings: Mapping[str, Any], trials: Mapping[int, Trial]) -> None:
    """Write trials by their numbers, in place of what the file held."""
    results = [dataclasses.asdict(trials[index]) for index in sorted(trials)]
    document = {"schema": SCHEMA, "settings": settings, "results": results}
    with atomic(file) as temporary:
        temporary.write_text(json.dumps(document), encoding="utf-8")
