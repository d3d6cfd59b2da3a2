"""The command `mitsuba-crb`: each command is a file that parses, calls one library function, and prints.

Nothing heavy is imported before it is needed, so that `--help` answers at once and `doctor` works
where Mitsuba does not load. Exit codes: 0; 2 for every mistake that has a message; 130 for Ctrl-C; 70 for
an error that nobody foresaw; `check` has its own (0 agree, 1 disagree, 3 inconclusive), and so have
`path`, `validate` and `align`.
"""

from __future__ import annotations

import shlex
import sys
import traceback
from collections.abc import Callable
from typing import Annotated

import typer

from .. import __version__
from .align import align
from .bound import bound
from .check import check
from .doctor import doctor
from .export import export
from .field import field
from .fuse import fuse
from .next_view import next_view
from .outcome import complain
from .path import path
from .select import select
from .train import train
from .validate import validate

INTERNAL_ERROR = 70

app = typer.Typer(
    rich_markup_mode=None,  # in every other mode [noise] is markup and vanishes
    pretty_exceptions_enable=False,
    help="How precisely could any algorithm estimate this camera's pose from this image of this scene?",
)
_EXAMPLES: dict[Callable[..., int | None], str] = {
    bound: "bound demo:textured_room --json room.json --plot room.png",
    field: "field demo:textured_room --poses grid:headings=8 --size 64x48 --out room.zarr",
    next_view: "next-view room.zarr --budget 3 --have 3,17",
    path: "path room.zarr --from 0 --to 40 --limit 0.01",
    align: "align room.glb photo.jpg --camera calibration.yaml --light baked",
    check: "check demo:boxes --size 64x48",
    fuse: "fuse demo:warehouse",
    select: "select demo:warehouse --budget 24",
    validate: "validate demo:textured_room --size 32x24 --trials 100",
    train: "train photographs --out garden.npz --minutes 15",
    export: "export room.json --to gtsam",
    doctor: "doctor",
}
"""Of every command, which the help of each ends with."""
for _command, _example in _EXAMPLES.items():
    app.command(epilog=f"Example: mitsuba-crb {_example}")(_command)


def main() -> None:
    """Entry point of `mitsuba-crb`."""
    raise SystemExit(run())


def run(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        code = app(
            arguments or ["--help"],
            prog_name="mitsuba-crb",
            standalone_mode=False,
            obj=shlex.join(["mitsuba-crb", *arguments]),  # for pages that say how to get them again
        )
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
