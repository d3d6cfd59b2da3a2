"""A sensor, lent to one view: at the identity, its film of another size if that was asked for.

Meanwhile its `to_world` is not its pose, and its film's size not the scene's: whoever read them would compute
a plausible number that is wrong. So a sensor in use is refused to another view, whatever scene it is part of.
Threads take turns instead: one cannot know what the other is about to set.
"""

from __future__ import annotations

import contextlib
import functools
import threading
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..camera import image_size
from ..errors import SensorError

if TYPE_CHECKING:
    import mitsuba as mi

P = ParamSpec("P")
T = TypeVar("T")

turns = threading.RLock()
"""Held by the thread that loads a scene or has a view of one. Neither what Dr.Jit and Python's warnings
record nor what views and finite differences set for a while (poses, film sizes, parameters) is its own."""


def in_turn(measure: Callable[P, T]) -> Callable[P, T]:
    """The function, in one thread at a time.

    Its turn ends when nothing of it is left: Dr.Jit 1.5 ends the process if a scene dies while another thread
    traces.
    """

    @functools.wraps(measure)
    def waiting(*args: P.args, **kwargs: P.kwargs) -> T:
        with turns:
            return measure(*args, **kwargs)

    return waiting


class _Use(NamedTuple):
    """What an open view has, and what it does to it."""

    sensor: int
    """Pointer of the sensor, which stands at the identity."""
    film: int
    """Pointer of its film; sensors may have one film in common, and Mitsuba makes equal films one."""
    resized: bool
    """Whether the film has another size meanwhile."""

    def excludes(self, other: _Use) -> bool:
        """Whether one view would see what the other has set."""
        resized = self.resized or other.resized
        return self.sensor == other.sensor or (self.film == other.film and resized)


_in_use: list[_Use] = []


@contextlib.contextmanager
def at_identity(sensor: mi.Sensor, name: str, size: tuple[int, int] | None) -> Iterator[NDArray[np.float64]]:
    """The sensor's `to_world` (4, 4), which is the identity meanwhile; everything as before afterwards.

    Args:
        sensor: whose film is to have another size, unless that is None.
        name: of the sensor, for messages.
        size: width and height [pixel].

    Raises:
        SensorError: the sensor or its film is in use.
        OptionError: the size is none.
    """
    import mitsuba as mi

    use = _Use(sensor.ptr, sensor.film().ptr, size is not None)
    for other in filter(use.excludes, _in_use):
        shared = "" if use.sensor == other.sensor else ", for it shares its film with another sensor"
        raise SensorError(
            f"sensor {name} is in use{shared}: end the measurement that has it before another begins, or "
            "load the scene again"
        )
    resized = {} if size is None else {"film.size": mi.ScalarVector2u(*image_size(size))}
    params = mi.traverse(sensor)

    def put(values: dict[str, Any]) -> None:
        for key, value in values.items():
            params[key] = value
        params.update()

    def now(*keys: str) -> dict[str, Any]:
        return {key: type(params[key])(params[key]) for key in keys}

    to_world = np.array(params["to_world"].matrix, dtype=np.float64).reshape(4, 4, -1)[:, :, 0]
    with contextlib.ExitStack() as undo:
        _in_use.append(use)
        undo.callback(_in_use.remove, use)
        # What comes last is undone first: a new film size resets the crop window.
        undo.callback(put, now("film.crop_size", "film.crop_offset"))
        undo.callback(put, now("film.size", "to_world"))
        if resized:
            put(resized)
        put({"to_world": mi.Transform4f()})
        yield to_world
