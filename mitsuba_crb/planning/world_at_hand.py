"""The world that a field of views was measured in, if its file is still there and as it was."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

from ..errors import MitsubaCRBError, SceneError, SceneWarning
from ..measure.nuisances import name_parameters
from ..measure.opening import as_world, fingerprint, wanted
from ..measure.options import MeasurementOptions
from ..render.demos import scene_path
from ..render.fit import Wanted
from ..render.lending import in_turn
from ..render.scene import SceneFile
from .view_field import ViewField


@in_turn
def world_at_hand(field: ViewField) -> Any:
    """A scene or a field, loaded; None if its file is missing, cannot be loaded, or is another one now."""
    settings = field.settings
    scene = str(settings.get("scene", ""))
    try:
        file = scene_path(scene)
    except SceneError:  # a demo that no longer comes along
        return None
    if not file.is_file():
        return None
    defines, size, camera = (settings.get(name) for name in ("defines", "size", "camera"))
    asked = Wanted(
        settings.get("sensor", 0),
        None if size is None or camera is not None else (int(size[0]), int(size[1])),
        settings.get("integrator") is not None,
        camera is not None,
        name_parameters(settings.get("nuisances", ())),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SceneWarning)  # said when it was measured
        try:
            loaded, _ = as_world(SceneFile(file, defines or {}), asked)
            same = fingerprint(loaded, str(file), defines or {}) == settings.get("scene_contents")
        except MitsubaCRBError:
            return None
    return loaded if same else None


@in_turn
def world_again(world: Any, options: Mapping[str, Any]) -> Any:
    """A world that has just been measured, loaded once for all that is to be drawn of it.

    Args:
        world: any.
        options: of the measurement.

    Raises:
        MitsubaCRBError: it cannot be loaded any more.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SceneWarning)  # said when it was measured
        return as_world(world, wanted(MeasurementOptions(**options)))[0]
