"""Whatever can be measured, opened: the one place that tells scenes from radiance fields.

A world is what a measurement is given: the path of a scene's file, a world's or a field's, a `SceneFile`, a
dictionary, an `mi.Scene`, or a `Field`. Loaded it is one of the last two.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from typing import Any

from ..radiance.field import Field
from ..radiance.files import as_field, field_fingerprint
from ..render import fingerprint as of_scenes
from ..render.fit import Wanted
from ..render.scene import as_scene
from .field_view import FieldView, open_field_view
from .measurable import Measurable
from .mitsuba_view import MitsubaView, open_mitsuba_view
from .options import MeasurementOptions


def wanted(options: MeasurementOptions) -> Wanted:
    """What the options ask of a world before it is loaded."""
    size = options.size if options.camera is None else None
    return Wanted(options.sensor, size, options.integrator is not None, options.camera is not None)


def as_world(world: Any, asked: Wanted | None = None) -> tuple[Any, str]:
    """A world, loaded, and what to call it.

    Args:
        world: any.
        asked: what is going to be measured of it.

    Raises:
        FieldError: the file of a field cannot be read.
        SceneError: as `as_scene`.
    """
    field = as_field(world)
    return as_scene(world, asked) if field is None else (field, field.label)


def kind_of(loaded: Any) -> type[FieldView] | type[MitsubaView]:
    """What a view of a loaded world will be."""
    return FieldView if isinstance(loaded, Field) else MitsubaView


def fingerprint(loaded: Any, source: Any = None, defines: Mapping[str, str] | None = None) -> str:
    """Sixteen hexadecimal letters that say which world this is.

    Args:
        loaded: from `as_world`.
        source: what it was loaded from.
        defines: what was said of its file.
    """
    if isinstance(loaded, Field):
        return field_fingerprint(loaded, source, defines)
    return of_scenes.fingerprint(loaded, source, defines)


@contextlib.contextmanager
def open_measurable(world: Any, options: MeasurementOptions, *, apart: bool = False) -> Iterator[Measurable]:
    """The view of a world that the options ask for.

    Args:
        world: any.
        options: those of a measurement.
        apart: meshes and materials of a scene are objects of their own, for their parameters have names.

    Raises:
        MitsubaCRBError: as `open_view` and `open_field_view`.
    """
    field = as_field(world)
    if field is not None:
        with open_field_view(field, options) as seen:
            yield seen
        return
    with open_mitsuba_view(world, options, apart=apart) as view:
        yield view
