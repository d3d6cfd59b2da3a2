"""`mitsuba-crb validate`: an estimator's errors beside the bound."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from ..measure.options import MeasurementOptions
from .options import (
    Batches,
    Camera,
    Debug,
    Define,
    DropInvalid,
    Exposure,
    Integrator,
    Light,
    Method,
    Pixels,
    Pose,
    Report,
    Scene,
    Seed,
    Sensor,
    Sigma,
    Size,
    Spp,
    Up,
    Variant,
    Workers,
)
from .outcome import answered, foreseen, measuring
from .reports import check_report, report_validation


def validate(
    context: typer.Context,
    scene: Scene,
    sensor: Sensor = "0",
    pose: Pose = None,
    trials: Annotated[int, typer.Option(metavar="N", help="How many.")] = 100,
    perturb_deg: Annotated[
        float, typer.Option(metavar="D", help="Starts are turned by up to this angle (degrees).")
    ] = 0.5,
    perturb_trans: Annotated[
        float, typer.Option(metavar="T", help="Starts are moved by up to this distance (scene units).")
    ] = 0.01,
    sigma: Sigma = None,
    exposure: Exposure = None,
    estimator: Annotated[
        Literal["gauss_newton", "levenberg_marquardt", "adam"], typer.Option(help="What is put to the test.")
    ] = "gauss_newton",
    levels: Annotated[
        int, typer.Option(metavar="L", help="Halvings of the image that a search begins with.")
    ] = 0,
    method: Method = MeasurementOptions.method,
    spp: Spp = None,
    precision: Annotated[
        float | None,
        typer.Option(
            metavar="P",
            help="Largest part of the errors' variance that may be the renderer's. Default: 0.05.",
        ),
    ] = None,
    max_spp: Annotated[
        int | None,
        typer.Option(
            "--max-spp", metavar="N", help="Most paths per pixel; default: 256, or more of a small image."
        ),
    ] = None,
    seed: Seed = MeasurementOptions.seed,
    batches: Batches = MeasurementOptions.batches,
    size: Size = None,
    camera: Camera = None,
    define: Define = None,
    light: Light = None,
    up: Up = None,
    pixels: Pixels = None,
    drop_invalid: DropInvalid = False,
    integrator: Integrator = None,
    workers: Workers = None,
    json_file: Annotated[
        Path | None,
        typer.Option(
            "--json", metavar="FILE", help="Write all trials as JSON, as they end; resumes what is there."
        ),
    ] = None,
    plot_file: Annotated[
        Path | None,
        typer.Option("--plot", metavar="FILE", help="Write coverage, NEES and eigenvalues as PNG."),
    ] = None,
    report_file: Report = None,
    variant: Variant = None,
    debug: Debug = False,
) -> int:
    """Do estimates really scatter as the bound says?

    Simulated trials tell: noisy images are drawn, poses perturbed and aligned.

    Exit code 0 if the errors are as the bound says, 1 if they are not, 3 if the renderer's noise hides it.
    """
    with foreseen(debug, variant):
        from ..export.targets import check_targets
        from .arguments import parse_exposure, scene_defines, view_files, view_options

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
        options |= {"exposure": parse_exposure(exposure)}
        defines = scene_defines(scene, define, light, up)
        inputs = view_files(scene, pose, camera, pixels)
        targets = {"--json": json_file, "--plot": plot_file, "--report": report_file}
        check_targets(targets, inputs, resumed=("--json",))
        check_report(report_file)

        from ..estimate.trials import validate as run_trials
        from ..export.documents import validation_document, write_json
        from ..show.trials_table import print_validation

        with measuring() as (advance, warned):
            result = run_trials(
                scene,
                trials=trials,
                perturb_deg=perturb_deg,
                perturb_trans=perturb_trans,
                sigma=sigma,
                estimator=estimator,
                levels=levels,
                workers=workers,
                resume=json_file,
                on_trial=advance,
                defines=defines,
                method=method,
                **options,
            )
        with answered(lambda to: print_validation(to, result, warned)):
            if json_file is not None:
                write_json(json_file, validation_document(result))
            if plot_file is not None:
                from ..show.trials_page import write_validation_plot

                write_validation_plot(plot_file, result)
            if report_file is not None:
                report_validation(report_file, context, validation_document(result), scene, defines, options)
        return result.exit_code
