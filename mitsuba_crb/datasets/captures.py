"""Folders of posed photographs: COLMAP, `transforms.json`, LLFF, Tanks and Temples' `.log`, 7-Scenes.

What is to be held out is what the capture says, else every eighth photograph, as is the custom since LLFF.
"""

from __future__ import annotations

import os
from pathlib import Path

from ..camera import Intrinsics
from ..errors import CameraError, CaptureError
from ..files import read_image_size
from .capture_formats import Found, found_in
from .intrinsics import load_camera
from .photographs import Capture, Photograph

EVERY = 8
"""One photograph of so many is held out where the capture does not say which."""


def load_capture(
    path: str | os.PathLike[str],
    *,
    images: str | None = None,
    camera: Intrinsics | str | os.PathLike[str] | None = None,
    rescale: bool = False,
) -> Capture:
    """Posed photographs in a folder, their poses in our axes and their intrinsics for the images' size.

    Args:
        path: the folder, or the file in it that has the poses.
        images: the folder of the images within it; default: as the capture says, or `images`, `images_2` ...
        camera: the calibration, or its file, of captures that have none.
        rescale: images of another size than their intrinsics are the same in other pixels; so are, without
            it, those in a folder called `images_4`, and LLFF's.

    Raises:
        CaptureError: there is no capture, a file of it is missing, or an image is of another size.
        CameraError: intrinsics cannot be used.
        PoseError: a pose cannot be used.
    """
    place = Path(path)
    if not place.exists():
        raise CaptureError(f"cannot read {place}: No such file or directory")
    intrinsics = camera if isinstance(camera, Intrinsics) or camera is None else load_camera(camera)
    found = found_in(place, images, intrinsics)
    if found is None:
        raise CaptureError(
            f"{place} has no posed photographs that are known here: no transforms.json, COLMAP model, "
            "poses_bounds.npy, .log of Tanks and Temples, or frame-*.pose.txt"
        )
    _check_files(place, found)
    cameras, notes = _fitted(found, rescale=rescale)
    names = found.poses.names
    train, test, split = _split(found)
    nothing: list[Path | None] = [None] * len(names)
    masks, depths = found.masks or nothing, found.depths or nothing
    points, colours = found.points or (None, None)
    return Capture(
        tuple(
            Photograph(
                name=name,
                image=str(found.images[k]),
                intrinsics=cameras[k],
                pose=found.poses.poses[k],
                mask=None if masks[k] is None else str(masks[k]),
                depth=None if depths[k] is None else str(depths[k]),
            )
            for k, name in enumerate(names)
        ),
        train,
        test,
        split,
        found.poses.format,
        found.poses.convention,
        points,
        colours,
        (*found.poses.notes, *found.notes, *notes),
    )


def _check_files(place: Path, found: Found) -> None:
    """Refuses a capture whose files are not all there."""
    for kind, files in (
        ("images", found.images),
        ("masks", found.masks or ()),
        ("depth maps", found.depths or ()),
    ):
        missing = [file for file in files if file is not None and not file.is_file()]
        if missing:
            raise CaptureError(
                f"{place}: {len(missing)} of {len(files)} {kind} are missing, the first is {missing[0]}; "
                "restore them, or remove their entries"
            )


def _fitted(found: Found, *, rescale: bool) -> tuple[list[Intrinsics], tuple[str, ...]]:
    """Intrinsics for the sizes that the images have, and notes on what was scaled."""
    fitted, notes = [], {}
    for image, camera in zip(found.images, found.cameras, strict=True):
        size = read_image_size(image, CaptureError)
        if size != camera.size:
            sizes = f"{camera.size[0]}x{camera.size[1]}", f"{size[0]}x{size[1]}"
            if not (rescale or found.scaled):
                raise CaptureError(
                    f"{image} has {sizes[1]} pixels, its camera {sizes[0]}; give intrinsics of this size, or "
                    "rescale=True if the image is the same in other pixels"
                )
            try:
                camera = camera.scaled(size)
            except CameraError as error:
                raise CaptureError(f"{image}: {error}") from None
            notes[sizes] = f"intrinsics of {sizes[0]} pixels were scaled to the images' {sizes[1]}"
        fitted.append(camera)
    return fitted, tuple(notes.values())


def _split(found: Found) -> tuple[tuple[int, ...], tuple[int, ...], str]:
    """Which photographs to train on, which are held out, and who says so."""
    names = found.poses.names
    if found.held_out is None:
        held = {name for k, name in enumerate(names) if k % EVERY == 0}
        said = f"every {EVERY}th, as the capture does not say"
    else:
        held, said = found.held_out, found.said
    test = tuple(k for k, name in enumerate(names) if name in held)
    train = tuple(k for k, name in enumerate(names) if name not in held)
    return train, test, said
