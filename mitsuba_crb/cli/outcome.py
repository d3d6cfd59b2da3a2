"""How every command ends: mistakes in one line, warnings as notes, an answer whatever becomes of files."""

from __future__ import annotations

import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import typer

from ..errors import MitsubaCRBError

if TYPE_CHECKING:
    from rich.console import Console

    from ..show.terminal import Bar


def complain(message: str) -> None:
    """Say one line on standard error, whatever a file has put into the message."""
    line = "".join(c if c.isprintable() else "\ufffd" for c in " ".join(message.split()))
    typer.echo(f"mitsuba-crb: {line}", err=True)


@contextmanager
def foreseen(debug: bool, variant: str | None = None) -> Iterator[None]:
    """Turn what can go wrong into one line and an exit code; Mitsuba runs in a variant if one is given."""
    try:
        if variant is not None:
            from ..render.backend import use_mitsuba

            use_mitsuba(variant)
        yield
    except (MitsubaCRBError, MemoryError) as error:
        if debug:
            traceback.print_exc()
        complain(str(error) or "out of memory: choose a smaller --size or fewer --spp")
        raise typer.Exit(2) from error
    except KeyboardInterrupt as error:
        complain("interrupted; no half-written file is left")
        raise typer.Exit(130) from error


@contextmanager
def measuring() -> Iterator[tuple[Bar, list[str]]]:
    """Measure under a bar of progress; yields what moves it, and what will hold the warnings, each once.

    Nothing is printed Python's way; what fails has its warnings said.
    """
    from ..show.terminal import progress

    texts: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            with progress() as advance:
                yield advance, texts
        except BaseException:
            for text in dict.fromkeys(str(warning.message) for warning in caught):
                complain(f"note: {text}")
            raise
        texts += dict.fromkeys(str(warning.message) for warning in caught)


@contextmanager
def answered(answer: Callable[[Console], None]) -> Iterator[None]:
    """Print an answer whatever becomes of the files written here: a disk that fills up must not cost it."""
    try:
        yield
    finally:
        answer(console())


def console() -> Console:
    """Where answers are printed."""
    from rich.console import Console

    return Console(markup=False, emoji=False)  # what is printed has names of users in it
