"""`mitsuba-crb bound`: the Cramér–Rao bound on the camera's pose."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from ..measure.options import MeasurementOptions
from .options import (
    Batches,
    BodyFromCamera,
    Camera,
    Channels,
    Convention,
    CsvFile,
    Debug,
    Define,
    DepthEdges,
    DepthRange,
    DepthSigma,
    DropInvalid,
    Exposure,
    Images,
    Integrator,
    Light,
    Marginalize,
    MaxSpp,
    Measure,
    Method,
    NoClip,
    NoiseFile,
    ParquetFile,
    PhotoEncoding,
    Photographs,
    Pixels,
    Pose,
    Poses,
    Precision,
    Prior,
    Report,
    Scene,
    Seed,
    Sensor,
    Sigma,
    Size,
    Spp,
    Up,
    Variant,
)
from .outcome import answered, foreseen, measuring
from .poses import bound_poses, check_pose_options
from .reports import check_report, report_bound


def bound(
    context: typer.Context,
    scene: Scene,
    sensor: Sensor = "0",
    pose: Pose = None,
    poses: Poses = None,
    convention: Convention = None,
    body_from_camera: BodyFromCamera = None,
    images: Images = None,
    photographs: Photographs = None,
    photo_encoding: PhotoEncoding = "srgb",
    method: Method = MeasurementOptions.method,
    spp: Spp = None,
    precision: Precision = None,
    max_spp: MaxSpp = None,
    seed: Seed = MeasurementOptions.seed,
    batches: Batches = MeasurementOptions.batches,
    size: Size = None,
    camera: Camera = None,
    define: Define = None,
    light: Light = None,
    up: Up = None,
    sigma: Sigma = None,
    exposure: Exposure = None,
    no_clip: NoClip = False,
    channels: Channels = None,
    measure: Measure = MeasurementOptions.measure,
    depth_sigma: DepthSigma = None,
    depth_range: DepthRange = None,
    depth_edges: DepthEdges = False,
    noise_file: NoiseFile = None,
    marginalize: Marginalize = None,
    prior: Prior = None,
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
    json_file: Annotated[
        Path | None,
        typer.Option(
            "--json",
            metavar="FILE",
            help="Write everything as JSON; with --poses a line as each is done, and resumes what is there.",
        ),
    ] = None,
    csv_file: CsvFile = None,
    parquet_file: ParquetFile = None,
    exr_file: Annotated[
        Path | None,
        typer.Option("--exr", metavar="FILE", help="Write the image and six Jacobian columns as OpenEXR."),
    ] = None,
    plot_file: Annotated[
        Path | None,
        typer.Option(
            "--plot", metavar="FILE", help="Write a page of pictures as PNG; with --poses, of the path."
        ),
    ] = None,
    report_file: Report = None,
    variant: Variant = None,
    debug: Debug = False,
) -> int:
    """How precisely can this camera's pose be known?

    Its Cramér–Rao bound: no unbiased estimator has smaller standard deviations. With --poses: of many.

    Exit code 130 if it was interrupted; the answer is then that of the rounds or the poses before.
    """
    with foreseen(debug, variant):
        from ..export.targets import check_targets
        from .arguments import (
            camera_of_body,
            parse_body_from_camera,
            parse_displacements,
            parse_noise,
            scene_defines,
            sensor_options,
            view_files,
            view_options,
        )

        check_pose_options(
            poses,
            single={"--pose": pose, "--hcr": hcr, "--exr": exr_file, "--photographs": photographs},
            many={
                "--convention": convention,
                "--images": images,
                "--csv": csv_file,
                "--parquet": parquet_file,
            },
        )
        body = parse_body_from_camera(body_from_camera, pose or poses)
        options = view_options(
            sensor=sensor,
            pose=pose,
            size=size,
            camera=camera,
            pixels=pixels,
            drop_invalid=drop_invalid,
            integrator=integrator,
            spp=spp,
            precision=precision,
            max_spp=max_spp,
            seed=seed,
            batches=batches,
        )
        if body is not None and pose is not None:
            options["pose"] = camera_of_body(options["pose"], body)
        options |= sensor_options(
            channels=channels,
            measure=measure,
            depth_sigma=depth_sigma,
            depth_range=depth_range,
            depth_edges=depth_edges,
            exposure=exposure,
            no_clip=no_clip,
        )
        defines = scene_defines(scene, define, light, up)
        noise = parse_noise(sigma, noise_file)
        twists = parse_displacements(displacements, hcr=hcr)
        given = [poses, prior, noise_file, displacements, photographs]
        inputs = view_files(scene, pose, camera, pixels, body_from_camera)
        inputs += [file for file in given if file is not None]
        targets = {"--json": json_file, "--csv": csv_file, "--parquet": parquet_file}
        targets |= {"--exr": exr_file, "--plot": plot_file, "--report": report_file}
        check_targets(targets, inputs, resumed=() if poses is None else ("--json", "--csv"))
        check_report(report_file)
        options |= {"prior": prior, "nuisances": marginalize or (), "frame": frame, "method": method}
        if poses is not None:
            options |= {"json_file": json_file, "csv_file": csv_file}
            options |= {"parquet_file": parquet_file, "plot_file": plot_file}
            options |= {"report_file": report_file, "context": context}
            options |= {"noise": noise, "defines": defines, "own_cameras": camera is None}
            return bound_poses(scene, poses, convention, body, images, **options)

        from ..datasets.captures import load_capture
        from ..export.documents import bound_document, write_json
        from ..export.exr import write_exr
        from ..measure.report import bound_report
        from ..noise import CoupledNoise
        from ..show.bound_table import print_report

        coupled = isinstance(noise, CoupledNoise)  # has no information of single pixels to show
        capture = None if photographs is None else load_capture(photographs)
        with measuring() as (bar, _):  # the bound's provenance repeats the warnings
            report = bound_report(
                scene,
                noise,
                defines=defines,
                hcr=hcr,
                displacements=twists,
                pictures=bool(exr_file or plot_file or (report_file and not coupled)),
                capture=capture,
                encoding=photo_encoding,
                on_progress=bar,
                on_round=bar.after,
                **options,
            )
        with answered(lambda to: print_report(to, report)):
            document = bound_document(report.bound, report.hcr, report.misspecified, report.held_out)
            if json_file is not None:
                write_json(json_file, document)
            if exr_file is not None and report.pictures is not None:
                write_exr(exr_file, report.pictures, report.attributes)
            if plot_file is not None and report.pictures is not None:
                from ..show.bound_page import write_plot

                write_plot(plot_file, report.bound, report.pictures)
            if report_file is not None:
                report_bound(report_file, context, report, document, scene, defines, options)
        return 130 if report.bound.provenance.get("sampling", {}).get("interrupted") else 0
