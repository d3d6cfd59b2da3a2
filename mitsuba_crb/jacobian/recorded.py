"""Kernels that are traced once and launched again for other tiles, seeds and poses of the same scene.

To trace a kernel costs as much as the paths of some thousand pixels. Dr.Jit's `freeze` records what a
function launches and, called again, launches that with the new arrays; it records anew where their types, the
pattern of their sizes or the objects of loaded scenes differ. All else that a function reads is baked in:
numbers of Python's, and Mitsuba's own scalars. So these are the recording's key (`View.settings`, `split`),
and a recorder belongs to one scene and keeps it (`scene.open_view`): what is no setting cannot change in it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import gc
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

if TYPE_CHECKING:
    from ..scene import View


@contextlib.contextmanager
def uncollected() -> Iterator[None]:
    """No garbage collection while a kernel is traced.

    If another scene dies meanwhile, the kernel's first calls still count its objects as targets and the later
    ones do not: Dr.Jit 1.5 then writes one function twice, and the process aborts.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


class Recorder:
    """The recordings of one scene's kernels."""

    def __init__(self) -> None:
        self._functions: dict[str, Any] = {}
        self._body: Callable[[Any], Any] | None = None

    def ready(
        self, name: str, body: Callable[[Any], Any], view: View, arrays: Any, key: Any
    ) -> Callable[[], Any]:
        """What starts body(arrays) in the background and returns it.

        Args:
            name: of the function; what `body` does follows from it, from the view's scene, and from `key`.
            body: reads no Dr.Jit array that is neither of `arrays` nor the scene's.
            arrays: lists, tuples and dictionaries of Dr.Jit arrays.
            key: whatever else `body` depends on, hashable; None if that is not known, so that it is traced.
        """
        if key is None or view.settings is None or self._functions.get(name, self) is None:
            with uncollected():
                traced = body(arrays)
            return lambda: _evaluated(traced)
        return lambda: self._run(name, body, view, arrays, (key, view.settings))

    def _run(self, name: str, body: Callable[[Any], Any], view: View, arrays: Any, key: Any) -> Any:
        if name not in self._functions:
            self._functions[name] = self._frozen()
        function = self._functions[name]
        with uncollected():
            if function is not None:
                self._body = body
                try:
                    return function(view.scene, view.sensor, arrays, key)
                except RuntimeError:  # something in the scene cannot be recorded
                    self._functions[name] = None
                finally:
                    self._body = None
            return _evaluated(body(arrays))

    def _frozen(self) -> Any:
        recorder = self

        def recorded(_scene: Any, _sensor: Any, arrays: Any, _key: Any) -> Any:
            assert recorder._body is not None
            return recorder._body(arrays)

        return dr.freeze(recorded, limit=8, warn_after=1 << 30)


def _evaluated(results: Any) -> Any:
    dr.eval(results)
    return results


def split(value: Any) -> tuple[list[Any], Any]:
    """The Dr.Jit arrays in dataclasses, tuples and lists, and a key for all else."""
    import mitsuba as mi

    if value is None or isinstance(value, bool | int | float | str):
        return [], value
    if isinstance(value, np.ndarray):
        return [], value.tobytes()
    if isinstance(value, mi.Object):
        return [], str(value)
    parts = _parts(value)
    if parts is None:
        return [value], None
    found = [split(part) for part in parts]
    return [array for arrays, _ in found for array in arrays], (type(value), *(key for _, key in found))


def join(value: Any, arrays: Iterator[Any]) -> Any:
    """The same with other arrays, in the order of `split`."""
    import mitsuba as mi

    if value is None or isinstance(value, bool | int | float | str | np.ndarray | mi.Object):
        return value
    parts = _parts(value)
    if parts is None:
        return next(arrays)
    joined = [join(part, arrays) for part in parts]
    kind: Any = type(value)
    return kind(*joined) if dataclasses.is_dataclass(value) else kind(joined)


def _parts(value: Any) -> list[Any] | None:
    if dataclasses.is_dataclass(value):
        return [getattr(value, field.name) for field in dataclasses.fields(value)]
    return list(value) if type(value) in (list, tuple) else None
