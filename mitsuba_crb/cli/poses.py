"""`mitsuba-crb bound --poses`: the second half of the command where poses are many, a row for each."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..errors import OptionError
from .outcome import answered, measuring


def check_pose_options(poses: Path | None, single: dict[str, Any], many: dict[str, Any]) -> None:
    """Refuse options of a single pose beside --poses, and those of many without it.

    Args:
        poses: the file of --poses.
        single: values of options by their names, false where they are not given.
        many: likewise.

    Raises:
        OptionError: names one.
    """
    for option, value in (single if poses is not None else many).items():
        if value and poses is not None:
            raise OptionError(f"{option} is of a single pose, and --poses of many; leave out one of them")
        if value:
            raise OptionError(f"{option} is of many poses: give --poses FILE, or leave it out")


def bound_poses(
    scene: Path,
    poses: Path,
    convention: str | None,
    *,
    json_file: Path | None,
    csv_file: Path | None,
    parquet_file: Path | None,
    plot_file: Path | None,
    **options: Any,
) -> int:
    """A table of bounds; options as `pose_table` has them.

    Returns:
        The exit code: 0, or 130 if it was interrupted; what is done is printed and kept then.
    """
    from ..datasets.poses import load_poses
    from ..export.pose_files import PoseFiles, parquet_library, write_parquet
    from ..measure.poses import pose_table
    from ..show.poses_table import print_poses

    if parquet_file is not None:
        parquet_library()
    read = load_poses(poses, convention)
    record = PoseFiles(json_file, csv_file)
    with measuring() as (bar, notes):  # of the scene; every row has its own
        table = pose_table(scene, read.poses, names=read.names, record=record, on_pose=bar, **options)
    with answered(lambda to: print_poses(to, table, f"{poses}: {read}", notes)):
        if parquet_file is not None:
            write_parquet(parquet_file, table)
        if plot_file is not None:
            from ..show.poses_page import write_poses_plot

            write_poses_plot(plot_file, table)
    return 130 if table.interrupted else 0
