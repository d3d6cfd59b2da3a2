"""The bounds of one camera at many poses: the scene is loaded once, its kernels are traced once.

Each bound is that of `pose_bound` at its pose, with the same random numbers, bit for bit: it depends neither
on the other poses nor on their order. The one thing that they share is the default camera's exposure, from
their pooled pixels (design section 11). So a run can stop after any pose and go on later.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, Unpack

from ..bound.cramer_rao import PoseBound
from ..bound.prior import load_prior
from ..noise import NoiseModel
from ..render.lending import in_turn
from ..render.scene import SceneFile
from ..se3 import Array, Frame
from .likeness import UNKNOWN, Likeness
from .many import Shared, common_white, load_shared, said, shared_settings, with_white
from .options import MeasurementKeywords
from .pose_table import PoseRow, PoseTable
from .stations import Station, photograph_likenesses, stations_of

if TYPE_CHECKING:
    from ..camera import Intrinsics

Progress = Callable[[int, int], None]
"""Called after each pose with the poses done and all of them."""


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
    loaded, _ = load_shared(scene, nuisances, stations, options)
    white = common_white(loaded, stations, noise, options)
    shared = Shared(loaded, noise, prior, nuisances, with_white(options, white))
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
    loaded, label = load_shared(source, nuisances, stations, options)
    likeness = [UNKNOWN] * len(stations)
    if photographs is not None:
        likeness = photograph_likenesses(loaded, stations, photographs, options)
        if on_likeness is not None:
            on_likeness(likeness)
    settings = {
        **shared_settings(loaded, label, scene, defines, options, noise, prior, nuisances),
        "poses": {"count": len(stations), "contents": _poses_fingerprint(stations)},
        "cameras": None if cameras is None else said([camera.to_dict() for camera in cameras]),
        "photographs": None if photographs is None else said(likeness),
        "frame": frame,
    }
    before = record.earlier() if record is not None else None
    if before is not None and before.get("white") is not None:
        settings["white"] = before["white"]  # of the same poses, if all else is the same
    else:
        settings["white"] = common_white(loaded, stations, noise, options)
    rows = record.resume(settings, [station.pose for station in stations]) if record is not None else {}
    facts = {"scene": label, "defines": settings["defines"]}
    if isinstance(prior, Path):
        facts["prior"] = str(prior)
    shared = Shared(loaded, noise, known, nuisances, with_white(options, settings["white"]))
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


def _poses_fingerprint(stations: Sequence[Station]) -> str:
    digest = hashlib.sha256()
    for station in stations:
        digest.update(station.name.encode() + b"\0" + station.pose.tobytes())
    return digest.hexdigest()[:16]
