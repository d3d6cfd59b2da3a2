"""The store of a field of views as it is written: one chunk of views after another, `done` last.

The parent process alone writes. A chunk is all views of a task, and each array's part of it is a file that is
there whole or not at all. So whatever ends a run, a view is done or it is not, and the same command goes on.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import OutputError, StoreError
from ..files import changes, jsonable, temporary_path
from .layout import CANDIDATES, DONE, INSIDE, MEASUREMENTS, SCHEMA, VARIABLES, Variable
from .view_field import ViewField, field_library, open_field

TITLE = "Cramér–Rao bounds of a camera's pose at many views"
CONVENTIONS = (
    "poses are world_from_camera, camera axes x left, y up, z forward; a twist is (ρ, φ), translation first; "
    "frame world: exp(ξ) @ world_from_camera, frame camera: world_from_camera @ exp(ξ)"
)
_ADVICE = "name another store, or use the same scene, poses and settings to go on with it"


class FieldStore:
    """An open store."""

    def __init__(self, path: Path) -> None:
        """Of a store that is there."""
        self.path = path
        group = field_library("zarr").open_group(path, mode="r+", use_consolidated=False)
        self._arrays = {name: group[name] for name in (*MEASUREMENTS, DONE)}
        self.batch = int(self._arrays[DONE].chunks[0])
        self.done: NDArray[np.bool_] = np.asarray(self._arrays[DONE][:]) == 1
        self.to_measure: NDArray[np.bool_] = np.asarray(self._arrays["status"][:]) < INSIDE

    @staticmethod
    def create(
        path: Path,
        known: dict[str, NDArray[Any]],
        settings: dict[str, Any],
        attributes: dict[str, Any],
        batch: int,
    ) -> None:
        """Make a store with nothing done, whole or not at all.

        Args:
            path: where nothing is.
            known: the variables of `CANDIDATES`, and `status`, of the views to be measured `TO_DO`.
            settings: what the numbers depend on, JSON-able.
            attributes: what else it says of itself, JSON-able.
            batch: views of a chunk.

        Raises:
            OutputError: it cannot be written.
        """
        zarr = field_library("zarr")
        temporary = temporary_path(path)
        try:
            with writing(path):
                group = zarr.create_group(
                    temporary,
                    zarr_format=3,
                    attributes={
                        "title": TITLE,
                        "schema": SCHEMA,
                        "frame": "world",
                        "conventions": CONVENTIONS,
                        "unit": "scene unit",
                        "settings": json.dumps(settings, ensure_ascii=False),
                        **attributes,
                    },
                )
                count = len(known["status"])
                for name, variable in VARIABLES.items():
                    array = group.create_array(
                        name,
                        shape=(count, *variable.shape),
                        chunks=(count if name in CANDIDATES else batch, *variable.shape),
                        dtype=variable.dtype,
                        fill_value=variable.fill,
                        dimension_names=("view", *variable.dims),
                        attributes=variable.attributes,
                    )
                    if name in known:
                        array[:] = known[name]
                os.rename(temporary, path)
        finally:
            with suppress(OSError):
                shutil.rmtree(temporary, ignore_errors=True)

    def chunks(self) -> Iterator[NDArray[np.int64]]:
        """The views of each chunk that are not done yet."""
        for start in range(0, len(self.done), self.batch):
            views = np.arange(start, min(start + self.batch, len(self.done)))
            if not self.done[views].all():
                yield views

    def write(self, views: NDArray[np.int64], measured: dict[str, NDArray[Any]] | None) -> None:
        """A chunk's values: of those of its views that were to be measured, and of all others.

        Raises:
            OutputError: they cannot be written; then none of them is done.
        """
        seen = self.to_measure[views]
        part = slice(int(views[0]), int(views[-1]) + 1)
        with writing(self.path):
            for name, variable in MEASUREMENTS.items():
                values = self._arrays[name][part] if name == "status" else _unseen(variable, len(views))
                if measured is not None:
                    values[seen] = measured[name]
                self._arrays[name][part] = values
            self._arrays[DONE][part] = np.ones(len(views), dtype=np.int8)
        self.done[views] = True


def _unseen(variable: Variable, count: int) -> NDArray[Any]:
    return np.full((count, *variable.shape), variable.unseen, dtype=variable.dtype)


def earlier(path: Path) -> ViewField | None:
    """What is there of an earlier run.

    Raises:
        StoreError: something else is.
    """
    if not os.path.lexists(path):
        return None
    try:
        return open_field(path)
    except StoreError as error:
        raise StoreError(f"{error}; it exists and is left alone: {_ADVICE}") from None


def refuse_others(path: Path, before: dict[str, Any], now: dict[str, Any]) -> None:
    """Refuse to go on with a store of another scene, other poses or settings.

    Raises:
        StoreError: says what differs.
    """
    found = changes(before, json.loads(json.dumps(jsonable(now))))
    if found:
        raise StoreError(f"{path} holds views with {', '.join(found)}; {_ADVICE}")


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """A full disk, or one that may not be written to, is one line."""
    try:
        yield
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror or error}") from error
