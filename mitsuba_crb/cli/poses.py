"""`mitsuba-crb bound --poses`: the second half of the command where poses are many, a row for each."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import OptionError
from .outcome import answered, complain, measuring

if TYPE_CHECKING:
    import typer

    from ..camera import Intrinsics
    from ..measure.likeness import Likeness
    from ..se3 import Array


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
    body_from_camera: Array | None,
    images: Path | None,
    *,
    own_cameras: bool,
    json_file: Path | None,
    csv_file: Path | None,
    parquet_file: Path | None,
    plot_file: Path | None,
    report_file: Path | None,
    context: typer.Context,
    **options: Any,
) -> int:
    """A table of bounds; options as `pose_table` has them.

    Args:
        convention, body_from_camera: as `load_poses` has them.
        images: a folder of photographs; None: those that are at hand.
        own_cameras: each pose has the camera that the file says, if it has any.

    Returns:
        The exit code: 0, or 130 if it was interrupted; what is done is printed and kept then.
    """
    from ..datasets.intrinsics import cameras_of_poses
    from ..datasets.pose_photographs import photographs_at_hand, photographs_in
    from ..datasets.poses import load_poses
    from ..export.pose_files import PoseFiles, parquet_library, write_parquet
    from ..measure.poses import pose_table
    from ..show.poses_table import print_poses

    if parquet_file is not None:
        parquet_library()
    read = load_poses(poses, convention, body_from_camera=body_from_camera)
    cameras = cameras_of_poses(poses, read) or None if own_cameras else None
    photographs = photographs_at_hand(poses, read) if images is None else photographs_in(images, read)
    record = PoseFiles(json_file, csv_file)
    with measuring() as (bar, notes):  # of the scene; every row has its own
        table = pose_table(
            scene,
            read.poses,
            names=read.names,
            cameras=cameras,
            photographs=photographs or None,
            record=record,
            on_pose=bar,
            on_likeness=_warn,
            **options,
        )
    with answered(lambda to: print_poses(to, table, f"{poses}: {read}{_said(cameras)}", notes)):
        if parquet_file is not None:
            write_parquet(parquet_file, table)
        if plot_file is not None:
            from ..show.poses_page import write_poses_plot

            write_poses_plot(plot_file, table)
        if report_file is not None:
            from .reports import report_poses

            report_poses(report_file, context, table, scene, cameras, options["defines"], options)
    return 130 if table.interrupted else 0


def _said(cameras: list[Intrinsics] | None) -> str:
    """That the cameras are the file's, on a line of its own."""
    if cameras is None:
        return ""
    different = set(cameras)
    alike = f"{cameras[0]}" if len(different) == 1 else f"{len(different)} different ones, each pose its own"
    return f"\ncameras of the same file: {alike}; --camera would say otherwise"


def _warn(likeness: list[Likeness]) -> None:
    """Before the bounds, which take long."""
    from ..show.poses_table import likeness_fault

    fault = likeness_fault(likeness)
    if fault:
        complain(f"note: {fault}")
