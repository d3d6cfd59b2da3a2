"""A camera in a scene, checked, its rays in its own frame: what every method of the library is given.

The Jacobian needs six things of a scene: the scene, an integrator that returns radiance for rays, a sensor
whose rays can be had in its own frame, the film's filter and size, and the pose. `open_view` gathers them in
a `View` and undoes whatever it changed. While a view is open the sensor stands at the origin of its own
frame (`to_world` = identity): rays are made there in float32 and moved by a float64 pose, so that neither a
new pose nor a geo-referenced origin costs digits or a new kernel.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import os
import re
import traceback
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..camera import image_size
from ..errors import (
    FilmError,
    MitsubaCRBError,
    OptionError,
    PoseError,
    SceneWarning,
    SensorError,
    TracingError,
)
from ..noise.measured import CHANNELS, COLOUR
from .cures import one_line
from .fit import CROP_DROPPED, Wanted, find
from .integrators import find_integrator
from .lending import at_identity, turns
from .recorded import join, split
from .scene import SceneFile, as_scene, contents

if TYPE_CHECKING:
    import mitsuba as mi

    from ..camera import Camera, Intrinsics
    from ..noise import Measured
    from .film import PixelFilter
    from .film_map import Bend, Calibration, FilmMap
    from .recorded import Recorder


SENSORS = {"PerspectiveCamera": "perspective", "ThinLensCamera": "thinlens"}
"""Supported sensors: Mitsuba's class name, and the plugin's."""


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
    measured: Measured = COLOUR
    """What the camera measures: what its film does, if not told otherwise."""
    calibration: Calibration | None = None
    """Of the camera that the sensor stands in for; None: the sensor is the camera."""

    @functools.cached_property
    def camera(self) -> Camera:
        """The calibration's intrinsics, or the sensor's, read off its own rays."""
        from .rays import seen_camera

        return seen_camera(self) if self.calibration is None else self.calibration.camera

    @property
    def intrinsics(self) -> Intrinsics:
        """The calibration, or what it would be of the sensor."""
        from ..camera import Intrinsics

        if self.calibration is not None:
            return self.calibration.intrinsics
        (fx, fy), (cx, cy) = self.camera.focal, self.camera.centre
        return Intrinsics(self.size, (fx, fy), (cx, cy))

    @property
    def plain_fov_deg(self) -> float:
        """Horizontal field of view of the film without the lens' distortion; of a sensor, of all its film."""
        import mitsuba as mi

        if self.calibration is None:
            return float(np.asarray(mi.traverse(self.sensor)["x_fov"]).ravel()[0])
        return self.calibration.intrinsics.plain_fov_deg

    @property
    def film_map(self) -> FilmMap | None:
        """From the camera's film to the sensor's; None if they are the same."""
        return None if self.calibration is None else self.calibration.film_map

    @property
    def bend(self) -> Bend | None:
        """The lens' distortion."""
        return None if self.film_map is None else self.film_map.bend

    def seen_through(self, intrinsics: Intrinsics) -> Self:
        """The sensor as another camera, of the calibration's image.

        Raises:
            CameraError: as `Calibration.of`.
        """
        from .film_map import Calibration
        from .rays import seen_camera

        sensor = replace(self, size=intrinsics.size, calibration=None)
        # A little more, for pixels of a box filter are moved a little.
        margin = float(self.sensor.film().rfilter().radius()) + 0.01
        calibration = Calibration.of(intrinsics, seen_camera(sensor), margin, self.variable)
        return replace(self, size=intrinsics.size, calibration=calibration)

    @property
    def film_arrays(self) -> list[Any]:
        """What `camera_ray` reads of the view beside the sensor, as kernel input."""
        return split(self.film_map)[0]

    def with_film_arrays(self, arrays: list[Any]) -> Self:
        """The same view with those arrays as a kernel has them."""
        if self.calibration is None or self.film_map is None:
            return self
        other = copy.copy(self)  # what has been found out of the view is kept
        film_map = join(self.film_map, iter(arrays))
        vars(other)["calibration"] = replace(self.calibration, film_map=film_map)
        return other

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

    @property
    def far_clip(self) -> float:
        """Distance of the far plane [scene unit]."""
        return float(self.sensor.far_clip())


@contextlib.contextmanager
def tracing(integrator: mi.Integrator) -> Iterator[None]:
    """What Mitsuba, Dr.Jit or the integrator's own module raises meanwhile becomes one line."""
    try:
        yield
    except Exception as error:
        cause: BaseException = error
        while cause.__cause__ or cause.__context__:
            cause = cause.__cause__ or cause.__context__ or cause
        *_, (frame, _line) = traceback.walk_tb(cause.__traceback__)
        origin = str(frame.f_globals.get("__name__", ""))
        # What C++ raises is a RuntimeError, and its last frame that of the caller.
        compiled = type(cause) is RuntimeError and origin.startswith(f"{__package__.partition('.')[0]}.")
        python = origin.startswith(("mitsuba.", "drjit")) or origin == type(integrator).__module__
        if isinstance(error, MitsubaCRBError) or not (compiled or python):
            raise
        name = type(integrator).__name__
        text = one_line(cause) or type(cause).__name__
        raise TracingError(f"the scene cannot be traced with integrator {name}: {text}") from error


_kept: list[tuple[mi.Scene, Recorder]] = []
"""The last scene that was given as such."""


@contextlib.contextmanager
def open_view(
    scene: str | os.PathLike[str] | SceneFile | Mapping[str, Any] | mi.Scene,
    *,
    sensor: int | str = 0,
    pose: Any = None,
    integrator: Any = None,
    size: tuple[int, int] | None = None,
    camera: Intrinsics | None = None,
    measured: Measured | None = None,
    apart: bool = False,
) -> Iterator[View]:
    """Load what is not loaded, check it, and lend it as a `View`; restores the sensor afterwards.

    An `mi.Scene` is kept, with its kernels as long as its parameters stay, until another one is opened.
    Another thread's view waits until this one is closed.

    Args:
        scene: path of an XML file or a world's, a `SceneFile`, a dictionary, or an `mi.Scene`.
        sensor: index in the file's order, or id; also of a child of a batch sensor in a file or dictionary.
        pose: `world_from_camera` (4x4 or SciPy `RigidTransform`) in place of the file's `to_world`.
        integrator: an `mi.Integrator`, a plugin's name, or a dictionary, in place of the scene's.
        size: width and height in place of the film's [pixel]; removes a crop window. The field of view is
            what the file says, along the axis that it names; of an `mi.Scene` the shape has to stay.
        camera: in place of the sensor's focal length, principal point, film size and crop window; with a
            `size`, scaled to that.
        measured: in place of what the film measures; depth only through a pinhole.
        apart: every mesh and material of a file or dictionary is an object of its own.

    Raises:
        SceneError, SensorError, CameraError, FilmError, IntegratorError, PoseError, OptionError,
        VariantError, LLVMError.
    """
    with turns:
        if _kept and _kept[0][0] is not scene:
            _kept.clear()
        size = None if size is None else image_size(size)
        if camera is not None:
            # The map to the sensor's film holds whatever size that has.
            camera, size = camera if size is None else camera.scaled(size), None
        loaded, label = as_scene(
            scene, Wanted(sensor, size, integrator is not None, camera is not None, apart)
        )
        from .recorded import Recorder

        recorder = Recorder(loaded)
        if _kept and _kept[0][1].fits(recorder):
            recorder = _kept[0][1]
        _kept[:] = [(loaded, recorder)] if loaded is scene else []
        lent, variable = _find_sensor(loaded, sensor)
        film = _measured_by(lent.film())
        _check_shape(lent, variable, size)
        radiance = find_integrator(loaded, lent, integrator)
        with at_identity(lent, variable, size) as to_world:
            if pose is None and np.isnan(to_world).all():
                raise PoseError(
                    f"sensor {variable} stands nowhere: its to_world has entries that are NaN, as that of a "
                    "world without a camera has; say its pose (--pose, pose=)"
                )
            found = (to_world, "the sensor's to_world") if pose is None else (pose,)
            world_from_camera = se3.as_pose(*found)
            width, height = lent.film().crop_size()
            size = int(width), int(height)
            if measured is not None and measured.depth is not None and lent.needs_aperture_sample():
                raise SensorError(
                    f"sensor {variable} has a thin lens, and depth is measured through a pinhole: use "
                    "perspective in place of thinlens"
                )
            measured = measured or film
            view = View(loaded, lent, radiance, world_from_camera, size, variable, label, recorder, measured)
            if camera is not None:
                view = view.seen_through(camera)
            with tracing(radiance):
                yield view


def _find_sensor(scene: mi.Scene, which: int | str) -> tuple[mi.Sensor, str]:
    sensors = scene.sensors()
    if not sensors:
        raise SensorError("the scene has no sensor: add a <sensor type='perspective'>")
    # Mitsuba names what has no name by its address, if at all.
    named = [re.sub(r"^(object|_unnamed)_(0x)?[0-9a-f]{6,}$|^object_0x.*", "", s.id()) for s in sensors]
    index = find(named, which)
    if index is None:
        known = ", ".join(name for name in [*named, *_children(sensors)] if name) or "none"
        raise SensorError(
            f"the scene has no sensor with id {which!r}; ids: {known}; indices: 0 to {len(sensors) - 1}"
        )
    if not 0 <= index < len(sensors):
        raise SensorError(
            f"sensor index {index} is out of range: the scene has {len(sensors)}, 0 to {len(sensors) - 1}"
        )
    sensor = sensors[index]
    if sensor.class_name() == "BatchSensor":
        parts = _children([sensor], index)
        raise SensorError(
            f"sensor {named[index] or index} is a batch of {', '.join(parts)}: name one of them, such as "
            f"--sensor {parts[0]} (sensor={parts[0]!r}), and give the scene's file or dictionary"
        )
    if sensor.class_name() not in SENSORS:
        raise SensorError(
            f"sensor {named[index] or index} is a {sensor.class_name()}; "
            f"supported: {', '.join(SENSORS.values())}"
        )
    return sensor, named[index] or f"sensor {index}"


def _children(sensors: list[mi.Sensor], first: int = 0) -> list[str]:
    """Names of what batch sensors consist of: ids, or the batch's index and the place in it."""
    import mitsuba as mi

    names = []
    for index, sensor in enumerate(sensors, first):
        if sensor.class_name() == "BatchSensor":
            parts = [part for part in contents(sensor)[1:] if isinstance(part, mi.Sensor)]
            names += [part.id() or f"{index}:{number}" for number, part in enumerate(parts)]
    return names


def _measured_by(film: mi.Film) -> Measured:
    """What a film measures: luminance alone, or linear RGB."""
    if film.class_name() != "HDRFilm":
        raise FilmError(f"the film is a {film.class_name()}; use hdrfilm with pixel_format rgb")
    found = re.search(r"pixel_format = (\w+)", str(film))
    pixel_format = found.group(1) if found else "unknown"
    if pixel_format not in ("rgb", "rgba", "y", "ya"):
        raise FilmError(
            f"the film's pixel_format is {pixel_format}, which does not measure linear RGB; set it to rgb"
        )
    return CHANNELS["luminance" if pixel_format.startswith("y") else "rgb"]


def _check_shape(sensor: mi.Sensor, name: str, size: tuple[int, int] | None) -> None:
    """Refuse another shape of an image whose field of view is known along x alone, and say what is lost."""
    if size is None:
        return
    film = sensor.film()
    (across, down), (width, height) = film.size(), size
    # As close to the film's shape as whole pixels can be.
    if abs(width * down - height * across) >= max(across, down):
        raise OptionError(
            f"sensor {name} has {across}x{down} pixels, and {width}x{height} is another shape: its object "
            "does not say which field of view to keep; give the scene's file or dictionary in its place"
        )
    if list(film.crop_size()) != list(film.size()):
        warnings.warn(CROP_DROPPED, SceneWarning, stacklevel=4)
