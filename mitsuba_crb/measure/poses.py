"""The bounds of one camera at many poses: the scene is loaded once, its kernels are traced once.

Each bound is that of `pose_bound` at its pose, with the same random numbers, bit for bit: it depends neither
on the other poses nor on their order. The one thing that they share is the default camera's exposure, from
their pooled pixels (design section 11). So a run can stop after any pose and go on later.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, Unpack

import numpy as np

from ..bound.cramer_rao import PoseBound
from ..bound.prior import load_prior
from ..errors import NoiseError, SceneWarning
from ..files import jsonable
from ..noise import NoiseModel
from ..render.fingerprint import mask_fingerprint
from ..render.lending import in_turn
from ..render.scene import SceneFile
from ..se3 import Array, Frame
from .exposure import exposed, start_metering
from .likeness import UNKNOWN, Likeness
from .measurable import method_of
from .nuisances import name_parameters
from .opening import as_world, fingerprint, kind_of, wanted
from .options import MeasurementKeywords, MeasurementOptions
from .pose import pose_bound
from .pose_table import PoseRow, PoseTable
from .sensing import DEPTH
from .stations import Station, named, open_stations, photograph_likenesses, stations_of
from .versions import versions

if TYPE_CHECKING:
    from ..camera import Intrinsics

Progress = Callable[[int, int], None]
"""Called after each pose with the poses done and all of them."""

_POOLED = 1 << 14
"""Pixels that the exposure is taken from, at least."""
_COARSEST = 16
_BLACK = 1.0
"""White of a camera that sees nothing anywhere: its information is zero whatever that is."""
_LONGEST = 200
"""Letters of a setting that is told as it is; of a longer one its fingerprint."""
_INDIFFERENT = ("pose", "tile", "on_tile", "on_progress", "on_round")
"""Options that no row depends on."""


class PoseRecord(Protocol):
    """Where rows are kept as they are done, so that an interrupted run goes on."""

    def earlier(self) -> dict[str, Any] | None:
        """The settings of an earlier run; None if there was none."""

    def resume(self, settings: dict[str, Any], poses: Sequence[Array]) -> dict[int, PoseRow]:
        """The rows of an earlier run by their place; it must have had the same settings."""

    def add(self, index: int, row: PoseRow, bound: PoseBound) -> None:
        """Keep one more row for good."""


@in_turn
def pose_bounds(
    scene: Any,
    poses: Sequence[Any] | Array,
    noise: NoiseModel | None = None,
    *,
    prior: Any = None,
    nuisances: Sequence[str] = (),
    cameras: Sequence[Intrinsics] | None = None,
    on_pose: Progress | None = None,
    **options: Unpack[MeasurementKeywords],
) -> list[PoseBound]:
    """The Cramér–Rao bounds at many poses; `PoseTable.of` makes a table of them.

    Args:
        scene: as for `pose_bound`.
        poses: `world_from_camera` of each, (n, 4, 4) or a sequence of what `se3.as_pose` takes.
        noise: as for `pose_bound`; None is that of one camera for all poses, exposed for their pooled pixels,
            or with `exposure="auto"` for each. Where all is black, white is 1: nothing is seen there.
        prior, nuisances: as for `pose_bound`, the same at every pose.
        cameras: of each pose, in place of one `camera` for all.
        on_pose: called after each pose.
        options: see `MeasurementOptions`.

    Returns:
        `PoseBound`s in the order of the poses. What was warned of stands in their provenance.

    Raises:
        PoseError: there are no poses, or one is no rigid motion; says which.
        OptionError: there are not as many cameras as poses, or a `camera` besides.
        MitsubaCRBError: as `pose_bound`, the pose named.

    Warns:
        SceneWarning: all images are black, and why.
    """
    stations = stations_of(poses, None, cameras, options)
    loaded, _ = _loaded(scene, nuisances, stations, options)
    white = _white(loaded, stations, noise, options)
    shared = _Shared(loaded, noise, prior, nuisances, _exposed(options, white))
    found = []
    for index, station in enumerate(stations):
        found.append(shared.bound(station))
        if on_pose is not None:
            on_pose(index + 1, len(stations))
    return found


@in_turn
def pose_table(
    scene: Any,
    poses: Sequence[Any] | Array,
    noise: NoiseModel | None = None,
    *,
    names: Sequence[str] | None = None,
    defines: Mapping[str, str] | None = None,
    prior: Any = None,
    nuisances: Sequence[str] = (),
    cameras: Sequence[Intrinsics] | None = None,
    photographs: Sequence[str | Path | None] | None = None,
    frame: Frame = "camera",
    record: PoseRecord | None = None,
    on_pose: Progress | None = None,
    on_likeness: Callable[[list[Likeness]], None] | None = None,
    **options: Unpack[MeasurementKeywords],
) -> PoseTable:
    """The bounds at many poses as a table, kept row by row, so that an interrupted run can go on.

    Args:
        scene, poses, noise, nuisances, cameras, options: as for `pose_bounds`.
        names: of the poses; None: their places, counted from 0.
        defines: the scene file's `<default>`s.
        prior: as for `pose_bound`, or its file.
        photographs: files of each pose's, which the render there is compared with, see `likeness`.
        frame: of the matrices that the record is given.
        record: what is asked for rows that are done, and given every new one.
        on_pose: called before the first pose, with what is done, and after each.
        on_likeness: called before that, if there are photographs, with what came of them.

    Returns:
        `PoseTable`, without the rows that are missing if it was interrupted (Ctrl-C).

    Raises:
        PriorError: an impossible prior.
        CaptureError: there are not as many photographs as poses, or one is no image.
        MitsubaCRBError: as `pose_bounds`; the record's own if an earlier run had other settings.
        KeyboardInterrupt: before the first row was done.
    """
    stations = stations_of(poses, names, cameras, options)
    source = SceneFile(scene, dict(defines or {})) if isinstance(scene, str | Path) else scene
    known = load_prior(prior) if isinstance(prior, Path) else prior
    loaded, label = _loaded(source, nuisances, stations, options)
    kind = kind_of(loaded)
    likeness = [UNKNOWN] * len(stations)
    if photographs is not None:
        likeness = photograph_likenesses(loaded, stations, photographs, options)
        if on_likeness is not None:
            on_likeness(likeness)
    settings = {
        "scene": label,
        "scene_contents": fingerprint(loaded, scene, defines),
        "defines": dict(defines or {}),
        "poses": {"count": len(stations), "contents": _poses_fingerprint(stations)},
        **_options_said(options),
        "method": method_of(kind.methods, options.get("method")).name,
        **({"deterministic": True} if kind.deterministic else {}),
        "cameras": None if cameras is None else _said([camera.to_dict() for camera in cameras]),
        "photographs": None if photographs is None else _said(likeness),
        "noise": _said(noise),
        "prior": _said(prior),
        "nuisances": list(nuisances),
        "frame": frame,
        "versions": versions(),
    }
    before = record.earlier() if record is not None else None
    if before is not None and before.get("white") is not None:
        settings["white"] = before["white"]  # of the same poses, if all else is the same
    else:
        settings["white"] = _white(loaded, stations, noise, options)
    rows = record.resume(settings, [station.pose for station in stations]) if record is not None else {}
    facts = {"scene": label, "defines": settings["defines"]}
    if isinstance(prior, Path):
        facts["prior"] = str(prior)
    shared = _Shared(loaded, noise, known, nuisances, _exposed(options, settings["white"]))
    if on_pose is not None:
        on_pose(len(rows), len(stations))
    try:
        for index, station in enumerate(stations):
            if index in rows:
                continue
            bound = shared.bound(station).to_frame(frame)
            bound = dataclasses.replace(bound, provenance={**bound.provenance, **facts})
            row = PoseRow.of(station.name, bound, likeness[index])
            if record is not None:
                record.add(index, row, bound)
            rows[index] = row
            if on_pose is not None:
                on_pose(len(rows), len(stations))
    except KeyboardInterrupt:
        if not rows:
            raise
    places = tuple(sorted(rows))
    return PoseTable(tuple(rows[place] for place in places), places, len(stations), settings)


@dataclasses.dataclass(frozen=True, eq=False)
class _Shared:
    """What the bounds of all poses are measured with."""

    scene: Any
    noise: NoiseModel | None
    prior: Any
    nuisances: Sequence[str]
    options: MeasurementKeywords

    def bound(self, station: Station) -> PoseBound:
        """At one pose.

        Raises:
            KeyboardInterrupt: also where `pose_bound` would have answered with what it had.
        """
        options: MeasurementKeywords = station.options(self.options)
        with warnings.catch_warnings():  # they stand in the provenance
            warnings.simplefilter("ignore")
            with named(station):
                try:
                    found = self._measured(options)
                except NoiseError:
                    if self.noise is not None or options.get("exposure") != "auto":
                        raise
                    found = self._measured({**options, "exposure": _BLACK})  # black, and set by itself
        if found.provenance.get("sampling", {}).get("interrupted"):
            raise KeyboardInterrupt
        return found

    def _measured(self, options: MeasurementKeywords) -> PoseBound:
        return pose_bound(self.scene, self.noise, prior=self.prior, nuisances=self.nuisances, **options)


def _loaded(
    scene: Any, nuisances: Sequence[str], stations: Sequence[Station], options: MeasurementKeywords
) -> tuple[Any, str]:
    first = MeasurementOptions(**stations[0].options(options))
    asked = dataclasses.replace(wanted(first), apart=name_parameters(nuisances))
    return as_world(scene, asked)


def _exposed(options: MeasurementKeywords, white: float | None) -> MeasurementKeywords:
    return options if white is None else {**options, "exposure": white}


def _white(
    loaded: Any, stations: Sequence[Station], noise: NoiseModel | None, options: MeasurementKeywords
) -> float | None:
    """That of the default camera, from all poses' pixels if they do not say; None if it is not asked for.

    The more poses, the fewer pixels of each.
    """
    if noise is not None or options.get("exposure") is not None or options.get("measure") == DEPTH:
        return None
    white = kind_of(loaded).white
    if white is not None:
        return white
    side = max(_COARSEST, math.ceil(math.sqrt(_POOLED / len(stations))))
    seed = MeasurementOptions(**options).seed
    with open_stations(loaded, stations, options) as opened:
        views = list(opened)
        parts = [start_metering(view, seed, side)().reshape(2, -1) for view in views]
        # In an order that is not that of the poses, for sums of floats depend on it.
        found = exposed(*np.concatenate(sorted(parts, key=lambda part: part.tobytes()), axis=1))
        if found is None:
            why = views[0].nothing_visible(black=True)
            warnings.warn(f"every image is black; of the first, {why}", SceneWarning, stacklevel=3)
    return _BLACK if found is None else found.white


def _options_said(options: MeasurementKeywords) -> dict[str, Any]:
    """The options that rows depend on, with their defaults, JSON-able."""
    given = MeasurementOptions(**options)
    names = [field.name for field in dataclasses.fields(given) if field.name not in _INDIFFERENT]
    return {name: _said(getattr(given, name)) for name in names}


def _said(value: Any) -> Any:
    """A setting as JSON can hold it; of what is long, and of files, a fingerprint."""
    if isinstance(value, np.ndarray):
        return mask_fingerprint(value)
    if isinstance(value, str | Path) and os.path.isfile(value):
        return {"file": str(value), "contents": hashlib.sha256(Path(value).read_bytes()).hexdigest()[:16]}
    try:
        plain = jsonable(value.to_dict() if hasattr(value, "to_dict") else value)
        text = json.dumps(plain)
    except (TypeError, ValueError):
        plain = text = str(value)
    if len(text) <= _LONGEST:
        return plain
    kind = {"model": plain["model"]} if isinstance(plain, dict) and "model" in plain else {}
    return {**kind, "contents": hashlib.sha256(text.encode()).hexdigest()[:16]}


def _poses_fingerprint(stations: Sequence[Station]) -> str:
    digest = hashlib.sha256()
    for station in stations:
        digest.update(station.name.encode() + b"\0" + station.pose.tobytes())
    return digest.hexdigest()[:16]
