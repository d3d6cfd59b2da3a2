"""A result in another tool's format: which there are, and the way from the result's file to theirs."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import get_args

from numpy.typing import ArrayLike

from .. import __version__
from ..errors import OptionError, OutputError
from .colmap import write_colmap
from .estimates import Estimate, turned
from .headings import Heading
from .names import Axes, FormatName
from .pose_graph import write_g2o, write_gtsam
from .results import load_estimates
from .ros import write_ros
from .rrd import write_rerun
from .tables import write_csv, write_npz
from .targets import check_target
from .tum import write_tum


@dataclass(frozen=True)
class Format:
    """How one is written."""

    write: Callable[[Path, Sequence[Estimate], Heading], list[str]]
    """Writes the file, and returns what there is to say of it."""
    ending: str
    """Of the file's name if it is not said."""
    axes: Axes
    """Of the camera by custom."""
    fixed: bool = False
    """The camera's axes are part of the format, and its poses are the camera's."""


FORMATS: dict[str, Format] = {
    "gtsam": Format(write_gtsam, ".gtsam.g2o", "opencv"),
    "colmap": Format(write_colmap, "_colmap", "opencv", fixed=True),
    "ros": Format(write_ros, ".ros.yaml", "opencv"),
    "g2o": Format(write_g2o, ".g2o", "opencv"),
    "tum": Format(write_tum, ".tum", "opencv"),
    "csv": Format(write_csv, ".csv", "mitsuba"),
    "npz": Format(write_npz, ".npz", "mitsuba"),
    "rerun": Format(write_rerun, ".rrd", "opencv", fixed=True),
}
assert tuple(FORMATS) == get_args(FormatName)


@dataclass(frozen=True)
class Exported:
    """What was written."""

    path: Path
    """The file, or COLMAP's folder."""
    count: int
    """Of poses."""
    body: str
    """Whose, with its axes."""
    notes: list[str]
    """What there is to say of it."""


def export_result(
    result: Path,
    to: FormatName,
    out: Path | None = None,
    *,
    axes: Axes | None = None,
    body_from_camera: ArrayLike | None = None,
    misspecified: bool = False,
    images: Path | None = None,
) -> Exported:
    """Write a result's poses, covariances and informations for another tool.

    Args:
        result: JSON of `bound`, `fuse` or `align`.
        to: a name in `FORMATS`.
        out: the file, replaced if it is there, or for COLMAP a folder; None: beside the result, where nothing
            may be.
        axes: of the camera; None: those of the format. With a body: those of body_from_camera.
        body_from_camera: (4, 4), to write the poses of the body that carries the camera.
        misspecified: the covariance that counts what the map does not explain, in place of the ideal bound's.
        images: for `rerun`, a picture of the only pose, or a folder with some by the poses' names.

    Raises:
        DocumentError: as `load_estimates`.
        OptionError: axes or a body for a format, or a result, that has its own.
        OutputError: the format cannot hold the result, or it cannot be written.
    """
    form = FORMATS[to]
    if form.fixed and (axes is not None or body_from_camera is not None):
        which = "--axes" if axes is not None else "--body-from-camera"
        raise OptionError(f"--to {to} has the camera's poses in its own axes; leave out {which}")
    if images is not None and to != "rerun":
        raise OptionError(f"--images is of --to rerun; {to} has no pictures: leave it out")
    estimates = load_estimates(result, misspecified=misspecified)
    if axes is not None and not estimates[0].of_camera:
        raise OptionError(f"{result} has the pose of {estimates[0].body}; leave out --axes")
    target = result.with_name(result.stem + form.ending) if out is None else out
    if out is None and os.path.lexists(target):
        raise OutputError(f"{target} is there already; name it, or another, by --out to write there")
    if to != "colmap":
        check_target(target, "--out", [result])
    # Calibrations write body_from_camera for OpenCV's axes.
    custom = form.axes if body_from_camera is None else "opencv"
    estimates = [turned(each, axes or custom, body_from_camera) for each in estimates]
    kind = "misspecified covariance" if misspecified else "Cramér–Rao bound"
    write = form.write if images is None else partial(write_rerun, pictures=images)
    notes = write(target, estimates, Heading(result, kind, __version__))
    return Exported(target, len(estimates), estimates[0].body, notes)
