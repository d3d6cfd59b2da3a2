"""A camera in a scene, checked, its rays in its own frame: what every method of the library is given.

The Jacobian needs six things of a scene: the scene, an integrator that returns radiance for rays, a sensor
whose rays can be had in its own frame, the film's filter and size, and the pose. `open_view` gathers them in
a `View` and undoes whatever it changed. While a view is open the sensor stands at the origin of its own
frame (`to_world` = identity): rays are made there in float32 and moved by a float64 pose, so that neither a
new pose nor a geo-referenced origin costs digits or a new kernel.
"""

from __future__ import annotations

import contextlib
import functools
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..errors import FilmError, IntegratorError, SensorError
from .lending import at_identity, turns
from .scene import as_scene, parser_message

if TYPE_CHECKING:
    import mitsuba as mi

    from ..camera import Camera
    from .film import PixelFilter
    from .recorded import Recorder


SENSORS = {"PerspectiveCamera": "perspective", "ThinLensCamera": "thinlens"}
"""Supported sensors: Mitsuba's class name, and the plugin's."""


_NO_RADIANCE = {
    "AOVIntegrator": "aov",
    "MomentIntegrator": "moment",
    "DepthIntegrator": "depth",
    "StokesIntegrator": "stokes",
    "ParticleTracerIntegrator": "ptracer",
}


@dataclass(frozen=True)
class View:
    """One camera in one scene, checked, with its rays in the camera's own frame while the view is open."""

    scene: mi.Scene
    """The Mitsuba scene."""
    sensor: mi.Sensor
    """The sensor, standing at the identity."""
    integrator: mi.SamplingIntegrator
    """What gives radiance for rays."""
    pose: NDArray[np.float64]
    """`world_from_camera`, 4x4, rigid."""
    size: tuple[int, int]
    """Width and height of the image [pixel]; with a crop window, of that window."""
    variable: str
    """The camera's name: the sensor's id, or its index."""
    label: str
    """The scene's file, or what kind of object it came from."""
    recorder: Recorder
    """Of the scene's kernels."""

    @functools.cached_property
    def camera(self) -> Camera:
        """The sensor's intrinsics, read off its own rays."""
        from .rays import seen_camera

        return seen_camera(self)

    @functools.cached_property
    def pixel_filter(self) -> PixelFilter:
        """The film's reconstruction filter, tabulated once, for it waits for what runs in the background."""
        from .film import PixelFilter

        return PixelFilter.of(self.sensor.film().rfilter())

    @functools.cached_property
    def visible_depth(self) -> NDArray[np.float64]:
        """Finite depths along the optical axis through a coarse grid of pixels [scene unit]."""
        from .rays import coarse_grid, first_hits

        _, depth = first_hits(self, coarse_grid(self.size, 96).reshape(-1, 2))
        visible = depth[np.isfinite(depth) & (depth > 0)]
        visible.flags.writeable = False
        return visible

    @property
    def near_clip(self) -> float:
        """Distance of the near plane [scene unit]."""
        return float(self.sensor.near_clip())


_kept: list[tuple[mi.Scene, Recorder]] = []
"""The last scene that was given as such."""


@contextlib.contextmanager
def open_view(
    scene: str | os.PathLike[str] | Mapping[str, Any] | mi.Scene,
    *,
    sensor: int | str = 0,
    pose: Any = None,
    integrator: Any = None,
    size: tuple[int, int] | None = None,
) -> Iterator[View]:
    """Load what is not loaded, check it, and lend it as a `View`; restores the sensor afterwards.

    An `mi.Scene` is kept, with its kernels as long as its parameters stay, until another one is opened.
    Another thread's view waits until this one is closed.

    Args:
        scene: path of an XML file, a dictionary for `mi.load_dict`, or an `mi.Scene`.
        sensor: index in the file's order, or id.
        pose: `world_from_camera` (4x4 or SciPy `RigidTransform`) in place of the file's `to_world`.
        integrator: an `mi.Integrator`, a plugin's name, or a dictionary, in place of the scene's.
        size: width and height in place of the film's [pixel]; removes a crop window.

    Raises:
        SceneError, SensorError, FilmError, IntegratorError, PoseError, OptionError, VariantError, LLVMError.
    """
    with turns:
        if _kept and _kept[0][0] is not scene:
            _kept.clear()
        loaded, label = as_scene(scene)
        from .recorded import Recorder

        recorder = Recorder(loaded)
        if _kept and _kept[0][1].fits(recorder):
            recorder = _kept[0][1]
        _kept[:] = [(loaded, recorder)] if loaded is scene else []
        camera, variable = _find_sensor(loaded, sensor)
        _check_film(camera.film())
        radiance = _find_integrator(loaded, integrator)
        with at_identity(camera, variable, size) as to_world:
            found = (to_world, "the sensor's to_world") if pose is None else (pose,)
            world_from_camera = se3.as_pose(*found)
            width, height = camera.film().crop_size()
            size = int(width), int(height)
            yield View(loaded, camera, radiance, world_from_camera, size, variable, label, recorder)


def _find_sensor(scene: mi.Scene, which: int | str) -> tuple[mi.Sensor, str]:
    sensors = scene.sensors()
    if not sensors:
        raise SensorError("the scene has no sensor: add a <sensor type='perspective'>")
    named = [re.sub(r"^(object_|_unnamed_).*", "", s.id()) for s in sensors]
    if isinstance(which, str) and which in named:
        index = named.index(which)
    elif isinstance(which, str) and not re.fullmatch(r"-?\d+", which):
        known = ", ".join(name for name in named if name) or "none"
        raise SensorError(
            f"the scene has no sensor with id {which!r}; ids: {known}; indices: 0 to {len(sensors) - 1}"
        )
    else:
        index = int(which)
        if not 0 <= index < len(sensors):
            raise SensorError(
                f"sensor index {index} is out of range: the scene has {len(sensors)}, 0 to {len(sensors) - 1}"
            )
    sensor = sensors[index]
    if sensor.class_name() not in SENSORS:
        raise SensorError(
            f"sensor {named[index] or index} is a {sensor.class_name()}; "
            f"supported: {', '.join(SENSORS.values())}"
        )
    return sensor, named[index] or f"sensor {index}"


def _check_film(film: mi.Film) -> None:
    if film.class_name() != "HDRFilm":
        raise FilmError(f"the film is a {film.class_name()}; use hdrfilm with pixel_format rgb")
    found = re.search(r"pixel_format = (\w+)", str(film))
    pixel_format = found.group(1) if found else "unknown"
    if pixel_format != "rgb":
        name = {"y": "luminance", "ya": "luminance_alpha"}.get(pixel_format, pixel_format)
        raise FilmError(
            f"the film's pixel_format is {name}, which does not measure linear RGB alone; set it to rgb"
        )


def _find_integrator(scene: mi.Scene, integrator: Any) -> mi.SamplingIntegrator:
    import mitsuba as mi

    if integrator is None:
        found = scene.integrator() or mi.load_dict({"type": "path"})
    elif isinstance(integrator, str | Mapping):
        config = {"type": integrator} if isinstance(integrator, str) else dict(integrator)
        try:
            found = mi.load_dict(config)
        except Exception as error:
            raise IntegratorError(parser_message(error, Path("integrator"))) from error
    else:
        found = integrator
    if found.class_name() in _NO_RADIANCE or not isinstance(found, mi.SamplingIntegrator):
        name = _NO_RADIANCE.get(found.class_name(), found.class_name())
        raise IntegratorError(
            f"integrator {name} returns no radiance for a ray; use path, direct, volpath or another "
            "that does (integrator='path')"
        )
    return found
