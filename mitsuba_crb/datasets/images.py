"""Photographs in a folder, in the sorted order of their names."""

from __future__ import annotations

import re
from pathlib import Path

ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".exr")


def images_in(folder: Path) -> list[Path]:
    """The folder's images, sorted."""
    return sorted(file for file in folder.iterdir() if file.suffix.lower() in ENDINGS)


def image_folders(folder: Path) -> list[Path]:
    """`images`, then `images_2`, `images_4` and so on, of those that are in the folder."""
    found = [part for part in folder.iterdir() if part.is_dir() and re.fullmatch(r"images(_\d+)?", part.name)]
    return sorted(found, key=lambda part: int(part.name[7:] or 1))


def images_beside(file: Path, count: int) -> list[str] | None:
    """Names of the images beside a file that lists them by their sorted order; None if none are so many."""
    for folder in image_folders(file.parent):
        images = images_in(folder)
        if len(images) == count:
            return [image.name for image in images]
    return None
