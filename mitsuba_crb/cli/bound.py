"""`mitsuba-crb bound`: the Cramér–Rao bound on the camera's pose."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from ..measure.options import MeasurementOptions
from .options import (
    Batches,
    Debug,
    Define,
    DropInvalid,
    Exposure,
    Integrator,
    JsonFile,
    MaxSpp,
    Method,
    NoClip,
    Pixels,
    Pose,
    Precision,
    Scene,
    Seed,
    Sensor,
    Sigma,
    Size,
    Spp,
    Variant,
)
from .outcome import answered, foreseen, measuring


def bound(
    scene: Scene,
    sensor: Sensor = "0",
    pose: Pose = None,
    method: Method = MeasurementOptions.method,
    spp: Spp = None,
    precision: Precision = None,
    max_spp: MaxSpp = None,
    seed: Seed = MeasurementOptions.seed,
    batches: Batches = MeasurementOptions.batches,
    size: Size = None,
    define: Define = None,
    sigma: Sigma = None,
    exposure: Exposure = None,
    no_clip: NoClip = False,
    noise_file: Annotated[
        Path | None,
        typer.Option(
            "--noise",
            metavar="FILE.toml",
            help="Noise model and sensor response: a table [noise], see `mitsuba_crb.noise.schema`.",
        ),
    ] = None,
    marginalize: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="A parameter that is not known either: gain, black, fov, principal_point, gain:32 (one in "
            "every 32x32 tile), or a scene parameter's name in mi.traverse; repeatable.",
        ),
    ] = None,
    prior: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="What is known of the pose beforehand (.toml, .json): a frame, and information, covariance, "
            "or position_std and rotation_std_deg.",
        ),
    ] = None,
    pixels: Pixels = None,
    drop_invalid: DropInvalid = False,
    integrator: Integrator = None,
    frame: Annotated[
        Literal["camera", "world"],
        typer.Option(help="Of the matrices and Jacobian columns; the standard deviations do not change."),
    ] = "camera",
    hcr: Annotated[
        bool,
        typer.Option(
            "--hcr",
            help="Also bound errors over finite displacements (Hammersley, Chapman, Robbins): repetition.",
        ),
    ] = False,
    displacements: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Of --hcr: six numbers a row, camera-frame twists; default: along its axes."
        ),
    ] = None,
    json_file: JsonFile = None,
    exr_file: Annotated[
        Path | None,
        typer.Option("--exr", metavar="FILE", help="Write the image and six Jacobian columns as OpenEXR."),
    ] = None,
    plot_file: Annotated[
        Path | None, typer.Option("--plot", metavar="FILE", help="Write a page of pictures as PNG.")
    ] = None,
    variant: Variant = None,
    debug: Debug = False,
) -> int:
    """The Cramér–Rao bound on the camera's pose.

    Exit code 130 if it was interrupted; the answer is then that of the rounds before.
    """
    with foreseen(debug, variant):
        from ..export.targets import check_targets
        from .arguments import (
            parse_defines,
            parse_displacements,
            parse_exposure,
            parse_noise,
            view_files,
            view_options,
        )

        options = view_options(
            sensor=sensor,
            pose=pose,
            size=size,
            pixels=pixels,
            drop_invalid=drop_invalid,
            integrator=integrator,
            spp=spp,
            precision=precision,
            max_spp=max_spp,
            seed=seed,
            batches=batches,
        )
        options |= {"exposure": parse_exposure(exposure), "clip": not no_clip}
        defines = parse_defines(define)
        noise = parse_noise(sigma, noise_file)
        inputs = [*view_files(scene, pose, pixels), *filter(None, [prior, noise_file, displacements])]
        check_targets({"--json": json_file, "--exr": exr_file, "--plot": plot_file}, inputs)
        twists = parse_displacements(displacements, hcr=hcr)

        from ..export.documents import bound_document, write_json
        from ..export.exr import write_exr
        from ..measure.report import bound_report
        from ..show.bound_table import print_report

        with measuring() as (bar, _):  # the bound's provenance repeats the warnings
            report = bound_report(
                scene,
                noise,
                defines=defines,
                prior=prior,
                nuisances=marginalize or (),
                frame=frame,
                hcr=hcr,
                displacements=twists,
                pictures=bool(exr_file or plot_file),
                method=method,
                on_progress=bar,
                on_round=bar.after,
                **options,
            )
        with answered(lambda to: print_report(to, report)):
            if json_file is not None:
                write_json(json_file, bound_document(report.bound, report.hcr))
            if exr_file is not None and report.pictures is not None:
                write_exr(exr_file, report.pictures, report.attributes)
            if plot_file is not None and report.pictures is not None:
                from ..show.bound_page import write_plot

                write_plot(plot_file, report.bound, report.pictures)
        return 130 if report.bound.provenance.get("sampling", {}).get("interrupted") else 0
