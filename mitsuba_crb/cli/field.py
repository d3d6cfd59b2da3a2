"""`mitsuba-crb field`: the bounds at thousands of views, into a store that can be gone on with."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..measure.options import MeasurementOptions
from .options import (
    Batches,
    BodyFromCamera,
    Channels,
    Convention,
    Debug,
    Define,
    DepthEdges,
    DepthRange,
    DepthSigma,
    DropInvalid,
    Exposure,
    Integrator,
    Light,
    Marginalize,
    MaxSpp,
    Measure,
    Method,
    NoClip,
    NoiseFile,
    Pixels,
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
from .outcome import answered, complain, foreseen, measuring
from .reports import check_report, report_field

if TYPE_CHECKING:
    from ..camera import Intrinsics
    from ..se3 import Array
    from ..show.terminal import Bar


def field(
    context: typer.Context,
    scene: Scene,
    poses: Annotated[
        str,
        typer.Option(
            metavar="FILE|grid:…|around:…",
            help="The views: a file of poses, as of `bound`; grid:nx=10,ny=8,headings=8 over the floor plan; "
            "or around:target=X:Y:Z,radius=R. All keys: see `mitsuba_crb.planning.candidates`.",
        ),
    ],
    store: Annotated[
        Path,
        typer.Option(
            "--out",
            metavar="STORE.zarr",
            help="Where the bounds go, as they are measured: a folder that xarray opens; an earlier run's "
            "is gone on with.",
        ),
    ],
    workers: Annotated[
        int | None,
        typer.Option(metavar="N", help="Processes of this machine that measure; default: this one."),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="tcp://HOST:PORT",
            help="A Dask scheduler, whose workers measure: dask scheduler, and on each machine dask worker "
            "tcp://HOST:PORT --nthreads 1 --nworkers N. They find the scene under the same path.",
        ),
    ] = None,
    batch: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Views of a task, which are kept together; default: 32 of many. More are less work for who "
            "gives them to hundreds of workers.",
        ),
    ] = None,
    limit: Annotated[
        float | None,
        typer.Option(
            metavar="X",
            help="Position bound of interest (scene unit): what is certainly on one side of it is measured "
            "to 4 times the precision only.",
        ),
    ] = None,
    sensor: Sensor = "0",
    convention: Convention = None,
    body_from_camera: BodyFromCamera = None,
    method: Method = MeasurementOptions.method,
    spp: Spp = None,
    precision: Precision = None,
    max_spp: MaxSpp = None,
    seed: Seed = MeasurementOptions.seed,
    batches: Batches = MeasurementOptions.batches,
    size: Size = None,
    camera: Annotated[
        str | None,
        typer.Option(
            metavar="FILE[:NAME]|scene",
            help="A calibration in place of the scene's camera, as of `bound`; default: what the file of "
            "poses says, if it does; scene: the scene's nevertheless.",
        ),
    ] = None,
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
    plot_file: Annotated[
        Path | None,
        typer.Option("--plot", metavar="FILE", help="Write maps of the bounds over the floor plan as PNG."),
    ] = None,
    report_file: Report = None,
    variant: Variant = None,
    debug: Debug = False,
) -> int:
    """Where is a camera located well, and where is it lost?

    The Cramér–Rao bounds at thousands of views, as a field to plan with: `next-view` and `path` read it.

    Exit code 130 if it was interrupted; the same command goes on.
    """
    with foreseen(debug, variant):
        from ..export.targets import check_targets
        from ..render.scene import SceneFile
        from .arguments import (
            parse_body_from_camera,
            parse_noise,
            scene_defines,
            sensor_options,
            view_files,
            view_options,
        )

        body = parse_body_from_camera(body_from_camera, poses)
        options = view_options(
            sensor=sensor,
            pose=None,
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
        options |= sensor_options(
            channels=channels,
            measure=measure,
            depth_sigma=depth_sigma,
            depth_range=depth_range,
            depth_edges=depth_edges,
            exposure=exposure,
            no_clip=no_clip,
        )
        options["method"] = method
        defines = scene_defines(scene, define, light, up)
        noise = parse_noise(sigma, noise_file)
        inputs = view_files(scene, None, camera, pixels, body_from_camera)
        inputs += [file for file in (prior, noise_file) if file is not None]
        inputs += [Path(poses)] if os.path.isfile(poses) else []
        new = {} if os.path.lexists(store) else {"--out": store}
        check_targets({"--plot": plot_file, "--report": report_file, **new}, inputs)
        check_report(report_file)

        from ..planning.candidates import parse_candidates
        from ..planning.field_run import measure_field
        from ..show.field_table import print_field

        with measuring() as (bar, notes):
            world = SceneFile(scene, defines)
            candidates = parse_candidates(
                poses, world, convention=convention, body_from_camera=body, **options
            )
            if camera is None and candidates.description["kind"] == "file":
                options["camera"] = _camera_of(Path(poses), convention, body)
            found = measure_field(
                scene,
                candidates,
                store,
                workers=workers,
                scheduler=scheduler,
                noise=noise,
                prior=prior,
                nuisances=marginalize or (),
                defines=defines,
                limit=limit,
                batch=batch,
                on_view=_rate(bar),
                **options,
            )
        if found.interrupted:
            complain(
                f"interrupted; {int(found.done.sum())} of {len(found)} views are done, and the same command "
                "goes on from there"
            )
        with answered(lambda to: print_field(to, found, f"{poses}: {candidates}", notes)):
            if plot_file is not None or report_file is not None:
                from ..planning.world_at_hand import world_again

                shown = world_again(world, options)
            if plot_file is not None:
                from ..show.field_page import write_field_page

                write_field_page(plot_file, found, shown)
            if report_file is not None:
                report_field(report_file, context, found, shown, options)
        return 130 if found.interrupted else 0


def _rate(bar: Bar) -> Callable[[int, int], None]:
    """What moves a bar that says views done, and views per second since the first that was not done yet."""
    began: list[tuple[float, int]] = []

    def moved(done: int, total: int) -> None:
        now = time.perf_counter()
        began.append((now, done))
        start, before = began[0]
        rate = f", {(done - before) / (now - start):.3g} per second" if done > before else ""
        bar.say(f"{done} of {total} views{rate}")
        bar(done, total)

    return moved


def _camera_of(poses: Path, convention: str | None, body: Array | None) -> Intrinsics | None:
    """The camera that a file of poses says, of all alike; None if it says none.

    Raises:
        OptionError: it says several.
    """
    from ..datasets.intrinsics import cameras_of_poses
    from ..datasets.poses import load_poses
    from ..errors import OptionError

    cameras = cameras_of_poses(poses, load_poses(poses, convention, body_from_camera=body))
    if len(set(cameras)) > 1:
        raise OptionError(
            f"{poses} has {len(set(cameras))} different cameras, and a field one: say which by --camera"
        )
    return cameras[0] if cameras else None
