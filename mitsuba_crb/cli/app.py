"""The command `mitsuba-crb`: parse, call one library function, print.

Nothing heavy is imported before it is needed, so that `--help` answers at once and `doctor` works
where Mitsuba does not load. Exit codes: 0; 2 for every mistake that has a message; 130 for Ctrl-C; 70 for
an error that nobody foresaw; `check` has its own (0 agree, 1 disagree, 3 inconclusive).
"""

from __future__ import annotations

import dataclasses
import os
import sys
import time
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from .. import __version__
from ..errors import MitsubaCRBError, OptionError, OutputError
from ..measure.options import CHECKING, VALIDATING, MeasurementOptions

if TYPE_CHECKING:
    from rich.console import Console

    from ..measure.tile_jacobian import TileJacobian

INTERNAL_ERROR = 70

app = typer.Typer(
    add_completion=False,
    rich_markup_mode=None,  # in every other mode [noise] is markup and vanishes
    pretty_exceptions_enable=False,
    help="How precisely could any algorithm estimate this camera's pose from this image of this scene?",
)

Scene = Annotated[Path, typer.Argument(metavar="SCENE", help="A Mitsuba 3 scene file (.xml).")]
Sensor = Annotated[str, typer.Option(metavar="S", help="The camera: index or id.")]
Pose = Annotated[
    str | None,
    typer.Option(
        metavar='FILE|"x y z qx qy qz qw"',
        help="world_from_camera in place of the scene's: a file with a 4x4 matrix (text, .npy or .json), "
        "or position and quaternion.",
    ),
]
Method = Annotated[str, typer.Option(metavar="M", help="How the Jacobian is measured.")]
Spp = Annotated[int, typer.Option(metavar="N", help="Paths per pixel over all batches.")]
Seed = Annotated[int, typer.Option(metavar="N", help="Of all random numbers; same seed, same bits.")]
Batches = Annotated[int, typer.Option(metavar="N", help="Independent estimates, at least 4.")]
Sigma = Annotated[
    float | None,
    typer.Option(
        metavar="X",
        help="Standard deviation of the pixel noise (radiance); default: 0.01 of the image's white.",
    ),
]
Size = Annotated[str | None, typer.Option(metavar="WxH", help="Image size in place of the film's (pixels).")]
Define = Annotated[
    list[str] | None,
    typer.Option("-D", metavar="name=value", help="Set one of the scene's <default>s; repeatable."),
]
Config = Annotated[
    Path, typer.Argument(metavar="CONFIG.toml", help="Who looks where: see scenes/warehouse/warehouse.toml.")
]
Workers = Annotated[
    int | None, typer.Option(metavar="N", help="Processes that render; default: one per agent and core.")
]
JsonFile = Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write everything as JSON.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]


def main() -> None:
    """Entry point of `mitsuba-crb`."""
    raise SystemExit(run())


def run(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        code = app(arguments or ["--help"], prog_name="mitsuba-crb", standalone_mode=False)
    except typer.TyperException as error:  # a usage error: unknown option, missing argument, not a number
        complain(error.format_message())
        return error.exit_code
    except KeyboardInterrupt:
        complain("interrupted")
        return 130
    except Exception:
        traceback.print_exc()
        complain("this error was not foreseen, please report it with the lines above")
        return INTERNAL_ERROR
    return int(code or 0)


def complain(message: str) -> None:
    """Say one line on standard error, whatever a file has put into the message."""
    line = "".join(c if c.isprintable() else "\ufffd" for c in " ".join(message.split()))
    typer.echo(f"mitsuba-crb: {line}", err=True)


@contextmanager
def foreseen(debug: bool) -> Iterator[None]:
    """Turn what can go wrong into one line and an exit code."""
    try:
        yield
    except (MitsubaCRBError, MemoryError) as error:
        if debug:
            traceback.print_exc()
        complain(str(error) or "out of memory: choose a smaller --size or fewer --spp")
        raise typer.Exit(2) from error
    except KeyboardInterrupt as error:
        complain("interrupted; no half-written file is left")
        raise typer.Exit(130) from error


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"mitsuba-crb {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    pass


def _view_options(
    sensor: str, pose: str | None, size: str | None, spp: int, seed: int, batches: int
) -> dict[str, Any]:
    """What `bound` and `check` share, as the library's keyword arguments."""
    from .arguments import parse_pose, parse_size

    return {
        "sensor": sensor,
        "pose": parse_pose(pose),
        "size": parse_size(size),
        "spp": spp,
        "seed": seed,
        "batches": batches,
    }


def _check_targets(targets: dict[str, Path | None], inputs: list[Path], resumed: str = "") -> None:
    """Every output can be written, no two are one file, none is an input or, but for one, holds trials."""
    from ..export.targets import check_target

    taken: dict[str, str] = {}
    for option, path in targets.items():
        if path is None:
            continue
        check_target(path, option, inputs, resumes=option == resumed)
        other = taken.setdefault(os.path.realpath(path), option)
        if other != option:
            raise OutputError(f"{option} and {other} both name {path}; give each a file of its own")


@contextmanager
def _collected() -> Iterator[list[str]]:
    """Collect warnings, each once, instead of having them printed Python's way; say them of what fails."""
    texts: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            yield texts
        except BaseException:
            for text in dict.fromkeys(str(warning.message) for warning in caught):
                complain(f"note: {text}")
            raise
        texts += dict.fromkeys(str(warning.message) for warning in caught)


def _console() -> Console:
    from rich.console import Console

    return Console(markup=False, emoji=False)  # what is printed has names of users in it


@app.command()
def bound(
    scene: Scene,
    sensor: Sensor = "0",
    pose: Pose = None,
    method: Method = MeasurementOptions.method,
    spp: Spp = MeasurementOptions.spp,
    seed: Seed = MeasurementOptions.seed,
    batches: Batches = MeasurementOptions.batches,
    size: Size = None,
    define: Define = None,
    sigma: Sigma = None,
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
    pixels: Annotated[
        str | None,
        typer.Option(metavar="random:F|gradient:F|MASK.png", help="Which pixels to measure; default: all."),
    ] = None,
    drop_invalid: Annotated[
        bool, typer.Option("--drop-invalid", help="Leave out pixels with NaN or infinite radiance.")
    ] = False,
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
    debug: Debug = False,
) -> None:
    """The Cramér–Rao bound on the camera's pose."""
    start = time.perf_counter()
    with foreseen(debug):
        from ..noise import CoupledNoise, Gaussian, NoiseModel
        from ..noise import load as load_noise
        from .arguments import parse_defines, parse_displacements, pose_file

        if sigma is not None and noise_file is not None:
            raise OptionError("--sigma and --noise both say what the noise is; give one of them")
        options = _view_options(sensor, pose, size, spp, seed, batches)
        defines = parse_defines(define)
        noise: NoiseModel | None = None if sigma is None else Gaussian(sigma)
        if noise_file is not None:
            noise = load_noise(noise_file)
        if isinstance(noise, CoupledNoise) and (exr_file or plot_file):
            raise OptionError(
                "--exr and --plot show what each pixel tells, but this noise couples pixels; leave them out"
            )
        inputs = [
            scene,
            *([Path(pixels)] if pixels else []),
            *filter(None, [pose_file(pose), prior, noise_file]),
        ]
        inputs += [displacements] if displacements else []
        _check_targets({"--json": json_file, "--exr": exr_file, "--plot": plot_file}, inputs)
        if displacements and not hcr:
            raise OptionError("--displacements belongs to --hcr; give both")
        if hcr and (prior or marginalize):
            raise OptionError("--hcr knows neither priors nor nuisances; leave out --prior and --marginalize")
        twists = parse_displacements(displacements)

        from ..bound.prior import load_prior

        known = load_prior(prior) if prior else None

        from ..export.documents import bound_document, write_json
        from ..export.exr import write_exr
        from ..measure.displaced import hcr_bound
        from ..measure.pictures import Gathering
        from ..measure.pose import pose_bound
        from ..render.scene import load_scene
        from ..show.bound_table import print_bound, print_hcr
        from ..show.terminal import progress

        weighted = None if isinstance(noise, CoupledNoise) else noise
        gathering = Gathering(weighted) if exr_file or plot_file else None
        with _collected(), progress() as advance:  # the bound's provenance repeats them

            def on_tile(tile: TileJacobian, done: int, total: int) -> None:
                if gathering is not None:
                    gathering.add(tile.pixels, tile.mean, tile.batch_values, tile.expected)
                advance(done, total)

            loaded = load_scene(scene, **defines)
            load = time.perf_counter() - start
            result = pose_bound(
                loaded,
                noise,
                prior=known,
                nuisances=marginalize or (),
                method=method,
                pixels=pixels,
                drop_invalid=drop_invalid,
                on_tile=on_tile,
                **options,
            )
            result = result.to_frame(frame)
            beyond = None
            if hcr:
                beyond = hcr_bound(
                    loaded,
                    noise,
                    displacements=twists,
                    method=method,
                    pixels=pixels,
                    drop_invalid=drop_invalid,
                    on_tile=lambda _, done, total: advance(done, total),
                    **options,
                )
        seconds = {"load": load, **result.provenance["seconds"], "total": time.perf_counter() - start}
        provenance = {**result.provenance, "scene": str(scene), "defines": defines, "seconds": seconds}
        if prior:
            provenance["prior"] = str(prior)
        result = dataclasses.replace(result, provenance=provenance)
        try:
            if json_file is not None:
                more = {} if beyond is None else {"hcr": beyond.to_dict()}
                write_json(json_file, {**bound_document(result), **more})
            if gathering is not None:
                width, height = provenance["size"]
                variance = provenance["noise"]["sigma"] ** 2 if noise is None else 1.0
                pictures = gathering.pictures(
                    result.information, (width, height), frame=frame, variance=variance
                )
                if exr_file is not None:
                    write_exr(
                        exr_file,
                        pictures,
                        {"scene": str(scene), "method": method, "spp": spp, "seed": seed},
                    )
                if plot_file is not None:
                    from ..show.bound_page import write_plot

                    write_plot(plot_file, result, pictures)
        finally:  # a disk that fills up must not cost the answer
            print_bound(_console(), result)
            if beyond is not None:
                print_hcr(_console(), beyond)


@app.command()
def check(
    scene: Scene,
    sensor: Sensor = "0",
    pose: Pose = None,
    method: Annotated[
        list[str] | None,
        typer.Option(metavar="M", help="Method to check, repeatable; default: flow and forward."),
    ] = None,
    spp: Spp = CHECKING["spp"],
    seed: Seed = MeasurementOptions.seed,
    batches: Batches = CHECKING["batches"],
    size: Size = None,
    define: Define = None,
    debug: Debug = False,
) -> int:
    """Compare the methods with finite differences on this scene.

    Exit code 0 if they agree, 1 if they disagree, 3 if this many paths cannot tell.
    """
    with foreseen(debug):
        from .arguments import parse_defines

        options = _view_options(sensor, pose, size, spp, seed, batches)
        defines = parse_defines(define)

        from ..measure.check import CHECKED, check_jacobian
        from ..render.scene import load_scene
        from ..show.check_table import print_check
        from ..show.terminal import progress

        with _collected() as texts, progress():
            methods = tuple(method or CHECKED)
            result = check_jacobian(load_scene(scene, **defines), methods=methods, **options)
        print_check(_console(), result, texts)
        return int(result.exit_code)


@app.command()
def fuse(
    config: Config,
    workers: Workers = None,
    json_file: JsonFile = None,
    debug: Debug = False,
) -> None:
    """What several agents know together of their common body's pose."""
    with foreseen(debug):
        from ..agents.team import load_team

        team = load_team(config)
        _check_targets({"--json": json_file}, [config, *(member.scene for member in team.members)])

        from ..export.documents import fusion_document, write_json
        from ..measure.teams import fuse_team
        from ..show.team_table import print_fusion
        from ..show.terminal import progress

        with _collected(), progress() as advance:  # the result repeats them
            result = fuse_team(team, workers=workers, on_agent=advance)
        try:
            if json_file is not None:
                write_json(json_file, fusion_document(team, result))
        finally:
            print_fusion(_console(), team, result)


@app.command()
def select(
    config: Config,
    budget: Annotated[int | None, typer.Option(metavar="B", help="Tiles in total.")] = None,
    per_agent: Annotated[
        int | None,
        typer.Option("--per-agent", metavar="b", help="Tiles of each agent, in place of the file's budgets."),
    ] = None,
    size: Annotated[int | None, typer.Option("--bytes", metavar="N", help="Bytes in total.")] = None,
    objective: Annotated[
        Literal["logdet", "trace", "lambda_min"], typer.Option(help="What the tiles maximise.")
    ] = "logdet",
    workers: Workers = None,
    json_file: JsonFile = None,
    plot_folder: Annotated[
        Path | None,
        typer.Option(
            "--plot", metavar="FOLDER", help="Write a picture per agent, and the curve over budgets, as PNG."
        ),
    ] = None,
    debug: Debug = False,
) -> None:
    """Which image tiles several agents should send under a budget."""
    with foreseen(debug):
        from ..agents.team import load_team
        from ..agents.tiles import Budget

        team = load_team(config)
        limits = Budget(tiles=budget, tiles_per_agent=per_agent, bytes=size)
        _check_targets({"--json": json_file}, [config, *(member.scene for member in team.members)])

        from ..export.documents import selection_document, write_json
        from ..export.targets import check_folder
        from ..measure.teams import select_team
        from ..show.team_table import print_selection
        from ..show.terminal import progress

        if plot_folder is not None:
            check_folder(plot_folder, "--plot")
        with _collected(), progress() as advance:  # the result repeats them
            result = select_team(team, limits, objective=objective, workers=workers, on_agent=advance)
        try:
            if json_file is not None:
                write_json(json_file, selection_document(team, result))
            if plot_folder is not None:
                from ..show.team_page import write_selection_plots

                write_selection_plots(plot_folder, result)
        finally:
            print_selection(_console(), team, result)


@app.command()
def validate(
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
    estimator: Annotated[
        Literal["gauss_newton", "levenberg_marquardt", "adam"], typer.Option(help="What is put to the test.")
    ] = "gauss_newton",
    levels: Annotated[
        int, typer.Option(metavar="L", help="Halvings of the image that a search begins with.")
    ] = 0,
    spp: Spp = VALIDATING["spp"],
    seed: Seed = MeasurementOptions.seed,
    batches: Batches = MeasurementOptions.batches,
    size: Size = None,
    define: Define = None,
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
    debug: Debug = False,
) -> int:
    """Put the bound to the test: perturb poses, align noisy images.

    Exit code 0 if the errors are as the bound says, 1 if they are not.
    """
    with foreseen(debug):
        from .arguments import parse_defines, pose_file

        options = _view_options(sensor, pose, size, spp, seed, batches)
        defines = parse_defines(define)
        inputs = [scene, *filter(None, [pose_file(pose)])]
        _check_targets({"--json": json_file, "--plot": plot_file}, inputs, resumed="--json")

        from ..estimate.trials import validate as run_trials
        from ..export.documents import write_json
        from ..show.terminal import progress
        from ..show.trials_table import print_validation

        with _collected() as texts, progress() as advance:
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
                **options,
            )
        try:
            if json_file is not None:
                write_json(json_file, result.to_dict())
            if plot_file is not None:
                from ..show.trials_page import write_validation_plot

                write_validation_plot(plot_file, result)
        finally:
            print_validation(_console(), result, texts)
        return 0 if result.consistency.consistent else 1


@app.command()
def doctor(debug: Debug = False) -> int:
    """Versions, LLVM, cores, and whether a 16x16 bound runs."""
    with foreseen(debug):
        from ..measure.diagnosis import diagnose
        from ..show.diagnosis_table import print_diagnosis

        diagnosis = diagnose()
        print_diagnosis(_console(), diagnosis)
        return 0 if diagnosis.ok else 1
