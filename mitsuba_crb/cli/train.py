"""`mitsuba-crb train`: a radiance field from posed photographs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .options import Camera, Debug, Variant
from .outcome import console, foreseen, measuring


def train(
    capture: Annotated[
        Path,
        typer.Argument(
            metavar="CAPTURE",
            help="A folder of posed photographs: transforms.json, a COLMAP model, LLFF, Tanks and Temples, "
            "7-Scenes; or the file in it that has the poses.",
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            metavar="FILE.npz",
            help="The field, kept as training goes on. What is there of an earlier run with the same capture "
            "and settings is gone on with.",
        ),
    ],
    size: Annotated[
        str | None,
        typer.Option(
            metavar="WxH",
            help="Size of the photographs (pixels); default: halved until no side is longer than 480.",
        ),
    ] = None,
    minutes: Annotated[
        float, typer.Option(metavar="M", help="How long to train, all runs on this file together.")
    ] = 15.0,
    steps: Annotated[
        int | None, typer.Option(metavar="N", help="How many steps to train, in place of minutes.")
    ] = None,
    seed: Annotated[int, typer.Option(metavar="N", help="Of all random numbers.")] = 0,
    images: Annotated[
        str | None, typer.Option(metavar="NAME", help="The folder of the images within the capture's.")
    ] = None,
    camera: Camera = None,
    variant: Variant = None,
    debug: Debug = False,
) -> int:
    """How do posed photographs become a scene?

    Trains a radiance field, a hash grid, whose file is a scene for `bound` and the others. The photographs
    that are held out are compared with it at the end. Ctrl-C keeps what was written last, at most half a
    minute earlier; the same command goes on from there.
    """
    with foreseen(debug, variant):
        from ..datasets.captures import load_capture
        from ..export.targets import check_target
        from ..radiance.training import Progress, train_field
        from ..show.training_table import print_training
        from .arguments import parse_camera, parse_size

        wanted = parse_size(size)
        check_target(out, "--out", [capture], resumes=True)
        photographs = load_capture(capture, images=images, camera=parse_camera(camera))
        with measuring() as (advance, warned):

            def report(at: Progress) -> None:
                advance.say(f"{at.words}, step {at.step}")
                advance(round(1000 * at.fraction), 1000)

            trained = train_field(
                photographs,
                out,
                size=wanted,
                minutes=minutes,
                steps=steps,
                seed=seed,
                on_progress=report,
            )
        print_training(console(), trained, warned)
        return 0
