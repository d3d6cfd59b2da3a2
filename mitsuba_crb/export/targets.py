"""Where a run's files will go, asked before anything is rendered."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from ..errors import OutputError
from ..files import temporary_path


def check_targets(
    targets: Mapping[str, Path | None], inputs: Sequence[Path] = (), *, resumed: Collection[str] = ()
) -> None:
    """Raise `OutputError` unless every file can be written and no two are one.

    Args:
        targets: the files by the names of their options; None is not asked for.
        inputs: as for `check_target`.
        resumed: the options whose files may hold what an earlier run has left, which is kept.
    """
    taken: dict[str, str] = {}
    for option, path in targets.items():
        if path is None:
            continue
        check_target(path, option, inputs, resumes=option in resumed)
        other = taken.setdefault(os.path.realpath(path), option)
        if other != option:
            raise OutputError(f"{option} and {other} both name {path}; give each a file of its own")


def check_target(path: Path, option: str, inputs: Sequence[Path] = (), *, resumes: bool = False) -> None:
    """Raise `OutputError` unless `path` can be written, without touching what is there.

    Args:
        path: the file to be written.
        option: the option's name, for the message.
        inputs: files that this run reads, and that must not be overwritten.
        resumes: whether this run keeps what the file holds of an earlier one.
    """
    target = Path(os.path.realpath(path)) if os.path.islink(path) else path
    folder = target.parent
    if not os.path.isdir(folder):
        raise OutputError(f"{option} {path}: the folder {folder} does not exist; create it first")
    if os.path.isdir(target):
        raise OutputError(f"{option} {path}: this is a folder; name a file in it")
    if os.path.lexists(target) and not os.path.isfile(target):
        raise OutputError(f"{option} {path}: this is not a regular file; name another")
    if any((parent / "zarr.json").is_file() for parent in (folder.resolve(), *folder.resolve().parents)):
        raise OutputError(f"{option} {path}: this is in a store of views; name a file elsewhere")
    for source in inputs:
        if os.path.exists(target) and os.path.exists(source) and os.path.samefile(target, source):
            raise OutputError(
                f"{option} {path}: this would overwrite an input of this run; name another file"
            )
    held = "" if resumes or not os.path.isfile(path) else _held(path)
    if held:
        raise OutputError(f"{option} {path}: this holds {held} that would be lost; name another file")
    # asking by writing: permission bits say nothing about root, read-only mounts and quotas
    probe = temporary_path(target)
    try:
        probe.touch(exist_ok=False)
        probe.unlink()
    except OSError as error:
        raise OutputError(
            f"{option} {path}: cannot write in the folder {folder} ({error.strerror})"
        ) from error


def _held(path: Path) -> str:
    """What a run can be resumed from, in words; empty if it is something else."""
    from ..estimate.trial_record import SCHEMA as TRIALS  # late: it imports what measures
    from ..radiance.field_file import is_field
    from .pose_files import BEGINNINGS

    if is_field(path):
        return "a trained field"
    with path.open("rb") as file:
        start = file.read(100)
    if TRIALS.rpartition("/")[0].encode() in start:
        return "trials"
    return "bounds of many poses" if start.startswith(BEGINNINGS) else ""


def check_folder(path: Path, option: str) -> None:
    """Make the folder `path` if it is missing; raise `OutputError` unless files can be written in it."""
    if os.path.lexists(path) and not os.path.isdir(path):
        raise OutputError(f"{option} {path}: this is a file; name a folder")
    if not os.path.lexists(path):
        try:
            path.mkdir()
        except OSError as error:
            raise OutputError(f"{option} {path}: cannot make this folder ({error.strerror})") from error
    check_target(path / "probe", option)
