"""`mitsuba-crb export`: a result's poses and covariances for the tools that use them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..export.names import Axes, FormatName
from .options import Debug
from .outcome import complain, foreseen


def export(
    result: Annotated[
        Path, typer.Argument(metavar="RESULT.json", help="What bound, fuse or align wrote with --json.")
    ],
    to: Annotated[
        FormatName,
        typer.Option(
            "--to",
            help="gtsam, g2o: a pose graph, for each its own, as they read one line differently; colmap: a "
            "folder with a model in text; ros: PoseWithCovarianceStamped in YAML; tum: a trajectory with 21 "
            "numbers of covariance a line; csv, npz: a table, arrays; rerun: a recording to look at.",
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE", help="Where; default: beside RESULT.json, unless it is there."),
    ] = None,
    axes: Annotated[
        Axes | None,
        typer.Option(
            help="The camera's: opencv (x right, y down, z forward: also ROS's optical frame), opengl or "
            "mitsuba; default: opencv, of csv and npz mitsuba.",
        ),
    ] = None,
    body_from_camera: Annotated[
        str | None,
        typer.Option(
            metavar='FILE|"x y z qx qy qz qw"',
            help="Write the poses of the body that carries the camera here; as bound --body-from-camera.",
        ),
    ] = None,
    misspecified: Annotated[
        bool,
        typer.Option(
            "--misspecified",
            help="In place of the ideal bound, the covariance that counts what the map does not explain; "
            "bound --photographs and align find it.",
        ),
    ] = False,
    images: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE|FOLDER",
            help="Of --to rerun: a picture of the pose, or a folder with some by names.",
        ),
    ] = None,
    debug: Debug = False,
) -> None:
    """How does this covariance get into GTSAM, COLMAP or ROS?

    Or into g2o, a trajectory, a table, arrays, Rerun. Order, side, frame and axes are turned to the tool's,
    and the file says which they are.
    """
    with foreseen(debug):
        from ..export.formats import export_result
        from .arguments import parse_body_from_camera

        body = parse_body_from_camera(body_from_camera, result)
        done = export_result(
            result, to, out, axes=axes, body_from_camera=body, misspecified=misspecified, images=images
        )
        for note in done.notes:
            complain(f"note: {note}")
        poses = "1 pose" if done.count == 1 else f"{done.count} poses"
        typer.echo(f"{done.path}: {poses} of {done.body}")
