"""`mitsuba-crb align`: the pose that a photograph was taken from."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from ..measure.options import MeasurementOptions
from .options import (
    Batches,
    Camera,
    Convention,
    Debug,
    Define,
    DropInvalid,
    Integrator,
    JsonFile,
    Light,
    Method,
    PhotoEncoding,
    Photographs,
    Scene,
    Seed,
    Sensor,
    Size,
    Spp,
    Up,
    Variant,
)
from .outcome import answered, foreseen, measuring

if TYPE_CHECKING:
    from ..measure.stations import Station


def align(
    scene: Scene,
    photo: Annotated[Path, typer.Argument(metavar="PHOTO", help="The photograph: PNG, JPEG and others.")],
    sensor: Sensor = "0",
    pose: Annotated[
        str | None,
        typer.Option(
            metavar='FILE|"x y z qx qy qz qw"',
            help="Where the search starts, in place of the scene's camera: see bound.",
        ),
    ] = None,
    poses: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Where searches start: each is tried coarse to fine, and the best goes on; formats as of "
            "bound.",
        ),
    ] = None,
    convention: Convention = None,
    camera: Camera = None,
    photo_encoding: PhotoEncoding = "srgb",
    mask: Annotated[
        Path | None,
        typer.Option(
            metavar="MASK.png", help="Of the photograph's size; black pixels show nothing of the scene."
        ),
    ] = None,
    tone: Annotated[
        Literal["channels", "common", "known"] | None,
        typer.Option(
            help="What is fitted: gain and black level of each channel (the default for scenes), common to "
            "all, or neither (the default for radiance fields)."
        ),
    ] = None,
    sigma: Annotated[
        float | None,
        typer.Option(
            metavar="X",
            help="Standard deviation of the photograph's values, decoded for scenes, of which white is 1; "
            "default: that of the residuals.",
        ),
    ] = None,
    photographs: Photographs = None,
    estimator: Annotated[
        Literal["levenberg_marquardt", "gauss_newton"], typer.Option(help="How to search.")
    ] = "levenberg_marquardt",
    levels: Annotated[
        int | None,
        typer.Option(
            metavar="L", help="Halvings of the image that the search begins with; default: to 16 pixels."
        ),
    ] = None,
    iterations: Annotated[int, typer.Option(metavar="N", help="At most, of each search.")] = 30,
    method: Method = MeasurementOptions.method,
    spp: Spp = None,
    seed: Seed = MeasurementOptions.seed,
    batches: Batches = MeasurementOptions.batches,
    size: Size = None,
    define: Define = None,
    light: Light = None,
    up: Up = None,
    drop_invalid: DropInvalid = False,
    integrator: Integrator = None,
    json_file: JsonFile = None,
    residual_file: Annotated[
        Path | None,
        typer.Option(
            "--residual", metavar="FILE", help="Write photograph, render and their difference as PNG."
        ),
    ] = None,
    variant: Variant = None,
    debug: Debug = False,
) -> int:
    """Where was this photograph taken from, and how sure is that?

    Exit code 0 if it is aligned, 1 if the search ended where the scene is unlike the photograph, 3 if it did
    not end.
    """
    with foreseen(debug, variant):
        from ..export.targets import check_targets
        from .arguments import parse_noise, scene_defines, view_files, view_options

        options = view_options(
            sensor=sensor,
            pose=pose,
            size=size,
            camera=camera,
            pixels=None,
            drop_invalid=drop_invalid,
            integrator=integrator,
            spp=spp,
            seed=seed,
            batches=batches,
        )
        defines = scene_defines(scene, define, light, up)
        given = [photo, *(file for file in (poses, mask, photographs) if file is not None)]
        inputs = [*view_files(scene, pose, camera, None), *given]
        check_targets({"--json": json_file, "--residual": residual_file}, inputs)
        starts = _starts(poses, convention, pose, own_cameras=camera is None)
        noise = parse_noise(sigma, None)

        from ..datasets.captures import load_capture
        from ..estimate.photograph import align_photograph
        from ..export.documents import alignment_document, write_json
        from ..show.align_table import print_alignment

        capture = None if photographs is None else load_capture(photographs)
        if starts:
            del options["pose"]
        with measuring() as (bar, warned):
            result = align_photograph(
                scene,
                photo,
                noise,
                mask=mask,
                encoding=photo_encoding,
                tone=tone,
                starts=starts,
                capture=capture,
                estimator=estimator,
                iterations=iterations,
                levels=levels,
                defines=defines,
                on_start=bar,
                method=method,
                **options,
            )
        with answered(lambda to: print_alignment(to, result, warned)):
            if json_file is not None:
                write_json(json_file, alignment_document(result))
            if residual_file is not None:
                from ..show.align_page import write_residual_picture

                write_residual_picture(residual_file, result)
        return result.exit_code


def _starts(
    poses: Path | None, convention: str | None, pose: str | None, *, own_cameras: bool
) -> list[Station]:
    """Where searches start; none: where the camera is."""
    from ..errors import OptionError

    if poses is None:
        if convention is not None:
            raise OptionError("--convention is of many poses: give --poses FILE, or leave it out")
        return []
    if pose is not None:
        raise OptionError("--pose is one start, and --poses are many; leave out one of them")
    from ..datasets.intrinsics import cameras_of_poses
    from ..datasets.poses import load_poses
    from ..measure.stations import stations_of

    read = load_poses(poses, convention)
    cameras = cameras_of_poses(poses, read) or None if own_cameras else None
    return stations_of(read.poses, read.names, cameras, {})
