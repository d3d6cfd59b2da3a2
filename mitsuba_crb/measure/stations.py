"""Where a camera stands, many times: poses by name, each with a camera of its own if cameras differ."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .. import se3
from ..errors import CaptureError, MitsubaCRBError, OptionError, PoseError
from ..se3 import Array
from .likeness import UNKNOWN, Likeness, compared
from .measurable import Measurable
from .opening import open_measurable
from .options import MeasurementKeywords, MeasurementOptions

if TYPE_CHECKING:
    from ..camera import Intrinsics


@dataclasses.dataclass(frozen=True, eq=False)
class Station:
    """One of many poses."""

    name: str
    """Its time stamp, its image, or its place in the list."""
    pose: Array
    """(4, 4), rigid."""
    camera: Intrinsics | None
    """Of its own; None: the one of all."""

    def options(self, shared: MeasurementKeywords) -> MeasurementKeywords:
        """What is measured with here, of what all poses share."""
        here: MeasurementKeywords = {**shared, "pose": self.pose}
        return here if self.camera is None else {**here, "camera": self.camera}


def stations_of(
    poses: Sequence[Any] | Array,
    names: Sequence[str] | None,
    cameras: Sequence[Intrinsics] | None,
    options: MeasurementKeywords,
) -> list[Station]:
    """Poses (n, 4, 4) with their names (None: their places, counted from 0) and cameras.

    Raises:
        PoseError: there are no poses, one is no rigid motion, or a name cannot be printed.
        OptionError: there are not as many cameras, or the options have a pose or a camera besides.
    """
    if options.get("pose") is not None:
        raise OptionError("poses say where the camera is; leave out pose")
    if isinstance(poses, str | Path):
        raise PoseError(f"poses are matrices, not the file {str(poses)!r}: read it first")
    count = len(poses)
    if not count:
        raise PoseError("there are no poses")
    named = [str(index) for index in range(count)] if names is None else [str(name) for name in names]
    if len(named) != count:
        raise PoseError(f"{count} poses have {len(named)} names")
    for name in named:
        if not name.isprintable():
            raise PoseError(f"the name {name!r} of a pose does not fit on a line")
    if cameras is not None and options.get("camera") is not None:
        raise OptionError("cameras say what each pose is seen with; leave out camera")
    if cameras is not None and len(cameras) != count:
        raise OptionError(f"{count} poses have {len(cameras)} cameras")
    own = [None] * count if cameras is None else cameras
    return [
        Station(name, se3.as_pose(pose, f"pose {name!r} ({index + 1} of {count})"), camera)
        for index, (name, pose, camera) in enumerate(zip(named, poses, own, strict=True))
    ]


@contextmanager
def open_stations(
    loaded: Any, stations: Sequence[Station], options: MeasurementKeywords
) -> Iterator[Iterator[Measurable]]:
    """The views of all stations, one after another, of a scene that is opened once."""
    with open_measurable(loaded, MeasurementOptions(**stations[0].options(options))) as view:
        yield (_seen_from(view, station, options) for station in stations)


def _seen_from(view: Measurable, station: Station, options: MeasurementKeywords) -> Measurable:
    if station.camera is None:
        return view.at(station.pose)
    size = options.get("size")
    with named(station):
        return view.seen_through(station.camera if size is None else station.camera.scaled(size)).at(
            station.pose
        )


def photograph_likenesses(
    loaded: Any,
    stations: Sequence[Station],
    photographs: Sequence[str | Path | None],
    options: MeasurementKeywords,
) -> list[Likeness]:
    """How like its photograph the render at each pose is.

    Args:
        loaded: the scene.
        stations: the poses.
        photographs: files of each pose's; None: it has none.
        options: of the measurement.

    Returns:
        One a pose; of NaN where there is no photograph, or one of another shape than the camera's image.

    Raises:
        CaptureError: there are not as many as poses, or one is no image.
    """
    if len(photographs) != len(stations):
        raise CaptureError(f"{len(stations)} poses have {len(photographs)} photographs")
    seed = MeasurementOptions(**options).seed
    # Colours, whatever is measured there.
    seen: MeasurementKeywords = {
        "sensor": options.get("sensor", MeasurementOptions.sensor),
        "integrator": options.get("integrator"),
        "size": options.get("size"),
        "camera": options.get("camera"),
    }
    with open_stations(loaded, stations, seen) as views:
        return [
            UNKNOWN if file is None else compared(view, Path(file), seed)
            for view, file in zip(views, photographs, strict=True)
        ]


@contextmanager
def named(station: Station) -> Iterator[None]:
    """Errors say at which pose."""
    try:
        yield
    except MitsubaCRBError as error:
        raise type(error)(f"pose {station.name!r}: {error}") from error
