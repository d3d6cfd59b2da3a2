"""Kernels that are traced once and launched again for other tiles, seeds and poses of the same scene.

To trace a kernel costs as much as the paths of some thousand pixels. Dr.Jit's `freeze` records what a
function launches and, called again, launches that with the new arrays; it records anew where their types, the
pattern of their sizes or the objects of loaded scenes differ. All else that a function reads is baked in:
numbers of Python's, and what Mitsuba's objects hold besides arrays. So a recorder belongs to one scene with
parameters that nobody has set meanwhile, and everything else is part of a recording's key (`split`).
"""

from __future__ import annotations

import contextlib
import dataclasses
import gc
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from .scene import contents

if TYPE_CHECKING:
    import mitsuba as mi

    from .view import View

_KNOWN = ("mitsuba", f"{__package__}.baked")
"""Modules whose objects show all their parameters."""


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

    def __init__(self, scene: mi.Scene | None) -> None:
        """Of the scene as it is; None records nothing."""
        self._state = None if scene is None else _state(scene)
        self._functions: dict[Any, Any] = {}
        self._call = _Call()

    def fits(self, now: Recorder) -> bool:
        """Whether nobody has set a parameter of the scene since, by a new recorder of the same scene."""
        return self._state is not None and now._state is not None and self._state[1] == now._state[1]

    def ready(
        self, name: str, body: Callable[[Any], Any], view: View, arrays: Any, key: Any
    ) -> Callable[[], Any]:
        """What starts body(arrays) in the background and returns it.

        Args:
            name: of the function; what `body` does follows from it, from the view's scene and film, and from
                `key`.
            body: reads no Dr.Jit array that is neither of `arrays` nor the scene's.
            arrays: lists, tuples and dictionaries of Dr.Jit arrays.
            key: whatever else `body` depends on; None if that is not known, so that it is traced.
        """
        sensor, film = view.sensor.ptr, view.sensor.film()
        if key is None or self._state is None or self._functions.get((name, sensor), self) is None:
            with uncollected():
                traced = body(arrays)
            return lambda: _evaluated(traced)
        # As text: of equal objects in nested tuples Dr.Jit takes the second for a reference to the first.
        lens = split(view.film_map)[1]
        whole = repr((key, lens, view.size, film.size(), film.crop_size(), film.crop_offset()))
        return lambda: self._run((name, sensor), body, view, arrays, whole)

    def _run(self, name: Any, body: Callable[[Any], Any], view: View, arrays: Any, key: str) -> Any:
        if name not in self._functions:
            self._functions[name] = _frozen(self._call)
        function, call = self._functions[name], self._call
        with uncollected():
            if function is not None:
                call.body, call.failure = body, None
                try:
                    return function(view.scene, view.sensor, arrays, key)
                except RuntimeError:
                    # Something in the scene cannot be recorded; if it is the body that fails, it will again.
                    if not isinstance(call.failure, RuntimeError | None):
                        raise call.failure from None
                    self._functions[name] = None
                finally:
                    call.body = call.failure = None
            return _evaluated(body(arrays))


class _Call:
    """What a recorded function is to trace if it has to, and how that ended.

    Not the recorder itself: in a circle with its functions it would outlive its scene, whose materials are
    part of every kernel's calls as long as they live.
    """

    body: Callable[[Any], Any] | None = None
    failure: BaseException | None = None


def _frozen(call: _Call) -> Any:
    def recorded(_scene: Any, _sensor: Any, arrays: Any, _key: str) -> Any:
        assert call.body is not None
        try:
            return call.body(arrays)
        except BaseException as failure:
            call.failure = failure  # Dr.Jit makes a RuntimeError of it
            raise

    return dr.freeze(recorded, limit=8, warn_after=1 << 30)


def _evaluated(results: Any) -> Any:
    dr.eval(results)
    return results


def _state(scene: mi.Scene) -> tuple[list[Any], list[Any]] | None:
    """The scene's parameters, held so that no other array takes an index of theirs, and their identities.

    None if not all can be known: of objects that others write in Python, and of those with a parameter that
    has no value.
    """
    import mitsuba as mi

    objects = (node for node in contents(scene) if not isinstance(node, mi.Integrator))
    if any(type(node).__module__ not in _KNOWN for node in objects):
        return None
    try:  # Copies, because Mitsuba's own follow what is set.
        parameters = [(name, type(value)(value)) for name, value in mi.traverse(scene)]
    except TypeError:
        return None
    return parameters, [(name, _identity(value)) for name, value in parameters]


def _identity(value: Any) -> Any:
    """Equal for two values of a parameter only if none was set between them; numbers by what they are."""
    if dr.is_tensor_v(value):
        return value.shape, value.array.index
    value = getattr(value, "matrix", value) if "Transform" in type(value).__name__ else value
    if not dr.is_jit_v(value):
        return repr(value if isinstance(value, bool | int | float | str) else np.array(value).tolist())
    return tuple(map(_identity, value)) if dr.depth_v(value) > 1 else value.index


def split(value: Any) -> tuple[list[Any], Any]:
    """The Dr.Jit arrays in dataclasses, tuples and lists, and a key for all else, as `repr` shows it."""
    import mitsuba as mi

    if value is None or isinstance(value, bool | int | float | str):
        return [], value
    if isinstance(value, np.ndarray):
        return [], hash(value.tobytes())
    if isinstance(value, mi.Object):
        return [], str(value)
    parts = _parts(value)
    if parts is None:
        return [value], None
    found = [split(part) for part in parts]
    return [array for arrays, _ in found for array in arrays], (type(value), *(key for _, key in found))


def join(value: Any, arrays: Iterator[Any]) -> Any:
    """The same with other arrays, in the order of `split`."""
    parts = _parts(value)
    if parts is None:
        return next(arrays) if split(value)[0] else value
    joined = [join(part, arrays) for part in parts]
    kind: Any = type(value)
    return kind(*joined) if dataclasses.is_dataclass(value) else kind(joined)


def _parts(value: Any) -> list[Any] | None:
    if dataclasses.is_dataclass(value):
        return [getattr(value, field.name) for field in dataclasses.fields(value)]
    return list(value) if type(value) in (list, tuple) else None
