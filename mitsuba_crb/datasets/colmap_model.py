"""The folder of a COLMAP model: which of its files are read."""

from __future__ import annotations

from pathlib import Path

from ..files.reading import Fault

_PLACES = (".", "sparse/0", "sparse", "colmap/sparse/0", "0")
"""Where a model lies within a folder."""

_PARTS = ("cameras", "images")


def model_folder(folder: Path) -> Path | None:
    """Where in this folder the COLMAP model is: at a usual place, or in the only folder that has one."""
    usual = [folder / place for place in _PLACES if _has_model(folder / place)]
    if usual or not folder.is_dir():
        return usual[0] if usual else None
    others = [part for part in folder.iterdir() if _has_model(part)]
    return others[0] if len(others) == 1 else None


def _has_model(folder: Path) -> bool:
    return any((folder / f"{part}.{ending}").is_file() for part in _PARTS for ending in ("bin", "txt"))


def model_file(folder: Path, name: str, fault: Fault) -> Path:
    """`cameras`, `images` or `points3D` of the model: of both kinds, the binary one, if it is whole.

    Raises:
        fault: the folder has no model, or the model has no such file.
    """
    model = model_folder(folder)
    if model is None:
        raise fault(f"{folder} has no COLMAP model in it: no cameras.txt or cameras.bin, here or in sparse/0")
    endings = [ending for ending in ("bin", "txt") if (model / f"{name}.{ending}").is_file()]
    if not endings:
        raise fault(f"the COLMAP model {model} has no {name}.txt or {name}.bin; export all of its files")
    whole = [ending for ending in endings if all((model / f"{part}.{ending}").is_file() for part in _PARTS)]
    return model / f"{name}.{(whole or endings)[0]}"
