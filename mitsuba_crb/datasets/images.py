"""Photographs in a folder, in the sorted order of their names."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".exr")


def images_in(folder: Path) -> list[Path]:
    """The folder's images, sorted."""
    return sorted(file for file in folder.iterdir() if file.suffix.lower() in ENDINGS)


def image_folders(folder: Path) -> list[Path]:
    """`images`, then `images_2`, `images_4` and so on, of those that are in the folder."""
    found = [part for part in folder.iterdir() if part.is_dir() and re.fullmatch(r"images(_\d+)?", part.name)]
    return sorted(found, key=lambda part: int(part.name[7:] or 1))


def is_reduced(folder: Path) -> bool:
    """Whether the folder's name, such as `images_4`, says that its images are smaller ones."""
    return re.fullmatch(r"images_\d+", folder.name) is not None


def so_many_images(folders: Iterable[Path], count: int) -> tuple[Path, list[Path]] | None:
    """The first folder with so many images, and these, sorted; None if there is none."""
    for folder in folders:
        images = images_in(folder)
        if len(images) == count:
            return folder, images
    return None


def images_beside(file: Path, count: int) -> list[str] | None:
    """Names of the images beside a file that lists them by their sorted order; None if none are so many."""
    found = so_many_images(image_folders(file.parent), count)
    return None if found is None else [image.name for image in found[1]]


def mask_of(folder: Path, name: str) -> Path | None:
    """An image's mask in `masks` beside the images' folder (`masks_8` beside `images_8`), if it is there."""
    masks = folder.with_name(folder.name.replace("images", "masks"))
    below = Path(name)
    if masks == folder or below.is_absolute():
        return None
    names = (below.with_suffix(".png"), below.with_name(f"{below.name}.png"), below)
    return next((masks / name for name in names if (masks / name).is_file()), None)
