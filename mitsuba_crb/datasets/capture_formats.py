"""What the formats of captures say: images, cameras, poses, who is held out, points.

COLMAP, `transforms.json`, LLFF, Tanks and Temples' `.log`, and 7-Scenes' `frame-*.pose.txt`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import Intrinsics
from ..errors import CaptureError
from ..files import read_array, read_bytes, read_json
from ..se3 import Array
from .colmap import read_cameras
from .colmap_model import model_file, model_folder
from .colmap_points import read_points
from .images import image_folders, images_in, is_reduced, mask_of, so_many_images
from .intrinsics import load_camera
from .llff import is_llff, llff_intrinsics
from .pose_list import Poses
from .poses import load_poses
from .seven_scenes import frame_file, is_seven_scenes, seven_scenes_camera
from .transforms import frame_intrinsics, frames_of, image_path, is_transforms

_CALIBRATIONS = ("camera.toml", "camera.yaml", "camera.yml", "camera.json", "camera.xml", "cameras.txt")
"""Of a whole capture, beside its poses."""


@dataclass(frozen=True)
class Found:
    """What a capture's files say, before its images are looked at."""

    poses: Poses
    images: list[Path]
    """Their files, one for each pose."""
    cameras: list[Intrinsics]
    """Theirs."""
    scaled: bool = False
    """The cameras are of the original images, whatever the size of these."""
    masks: Sequence[Path | None] | None = None
    depths: list[Path] | None = None
    held_out: set[str] | None = None
    """Names that the capture holds out; None if it does not say."""
    said: str = ""
    """Where it says so."""
    points: tuple[Array, NDArray[np.uint8]] | None = None
    """Positions and colours."""
    notes: tuple[str, ...] = ()


def found_in(place: Path, images: str | None, camera: Intrinsics | None) -> Found | None:
    """What the capture in a folder, or of a file, says; None if there is none.

    Args:
        place: the folder or file.
        images: the images' folder, from that of the poses.
        camera: what the user says, in place of the capture's.
    """
    if place.is_file():
        return _in_file(place, images, camera)
    for name in ("transforms.json", "transforms_train.json"):
        if (place / name).is_file():
            return _transforms(place / name, images, camera)
    if model_folder(place) is not None:
        return _colmap(place, images, camera)
    logs = sorted(place.glob("*.log"))
    for file in ([place / "poses_bounds.npy"] if (place / "poses_bounds.npy").is_file() else []) + logs:
        return _in_file(file, images, camera)
    return _seven_scenes(place, camera) if is_seven_scenes(place) else None


def _in_file(file: Path, images: str | None, camera: Intrinsics | None) -> Found:
    start = read_bytes(file, CaptureError)[:64]
    if start.startswith(b"\x93NUMPY"):
        return _llff(file, images, camera)
    if start.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"{"):
        return _transforms(file, images, camera)
    return _log(file, images, camera)


def _transforms(file: Path, images: str | None, camera: Intrinsics | None) -> Found:
    document = read_json(file, CaptureError)
    if not is_transforms(document):
        raise CaptureError(f"{file} is no transforms.json: it has no frames")
    poses, frames = load_poses(file), frames_of(document, file, CaptureError)
    files = [image_path(frame, file) for frame in frames]
    if None in files:
        raise CaptureError(f"{file}: frame {files.index(None) + 1} has no file_path")
    photographs = [image for image in files if image is not None]
    if images is not None:
        photographs = [file.parent / images / image.name for image in photographs]
    masks = [file.parent / str(frame["mask_path"]) if frame.get("mask_path") else None for frame in frames]
    depths = [file.parent / str(frame["depth_file_path"]) for frame in frames if frame.get("depth_file_path")]
    cameras = [camera or frame_intrinsics(document, frame, file) for frame in frames]
    held_out, said = _held_out(document, file)
    reduced = images is not None and is_reduced(file.parent / images)
    found = Found(
        poses,
        photographs,
        cameras,
        reduced,
        masks,
        depths=depths if len(depths) == len(frames) else None,
        held_out=held_out,
        said=said,
    )
    test = file.with_name("transforms_test.json")
    if file.name != "transforms_train.json":
        return found
    if not test.is_file():
        return replace(found, held_out=set(), said="there is a transforms_train.json, and no other")
    return _joined(found, _transforms(test, images, camera))


def _held_out(document: Any, file: Path) -> tuple[set[str] | None, str]:
    names = document.get("test_filenames") or document.get("val_filenames")
    return (None, "") if names is None else (set(map(str, names)), f"{file.name} says so")


def _joined(train: Found, test: Found) -> Found:
    """One capture of two files, the second of which is held out."""
    poses = replace(
        train.poses,
        poses=np.concatenate([train.poses.poses, test.poses.poses]),
        names=train.poses.names + test.poses.names,
        notes=train.poses.notes + test.poses.notes,
    )
    return replace(
        train,
        poses=poses,
        images=train.images + test.images,
        cameras=train.cameras + test.cameras,
        masks=[*(train.masks or ()), *(test.masks or ())],
        depths=train.depths + test.depths if train.depths and test.depths else None,
        held_out=set(test.poses.names),
        said="transforms_test.json",
    )


def _colmap(place: Path, images: str | None, camera: Intrinsics | None) -> Found:
    model = model_file(place, "images", CaptureError).parent
    poses = load_poses(model)
    cameras = read_cameras(model_file(model, "cameras", CaptureError))
    unknown = [key for key in poses.cameras if key not in cameras]
    if unknown:
        raise CaptureError(f"{model}: an image has the camera {unknown[0]}, which its cameras lack")
    known = {key: camera or cameras[key].intrinsics() for key in set(poses.cameras)}
    folder = _images_of_model(place, model, images)
    order = sorted(range(len(poses)), key=lambda k: poses.names[k])
    names, keys = [poses.names[k] for k in order], [poses.cameras[k] for k in order]
    has_points = any((model / f"points3D.{ending}").is_file() for ending in ("bin", "txt"))
    return Found(
        replace(poses, poses=poses.poses[order], names=tuple(names), cameras=tuple(keys)),
        [folder / name for name in names],
        [known[key] for key in keys],
        scaled=is_reduced(folder),
        masks=[mask_of(folder, name) for name in names],
        points=read_points(model_file(model, "points3D", CaptureError)) if has_points else None,
        notes=() if has_points else (f"{model} has no points3D",),
    )


def _images_of_model(place: Path, model: Path, images: str | None) -> Path:
    """The folder that the images' names of a COLMAP model are in."""
    if images is not None:
        return place / images
    for root in (place, model, model.parent, model.parent.parent):
        folders = image_folders(root)
        if folders:
            return folders[0]
    raise CaptureError(f"{model} has no folder `images` beside it; name the one that its images are in")


def _llff(file: Path, images: str | None, camera: Intrinsics | None) -> Found:
    array = read_array(file, CaptureError)
    if not is_llff(array):
        raise CaptureError(f"{file} has the shape {array.shape}; LLFF's poses_bounds.npy has (n, 17)")
    poses = load_poses(file)
    folder, photographs = _sorted_images(file, images, len(poses))
    return Found(
        replace(poses, names=tuple(image.name for image in photographs)),
        photographs,
        [camera] * len(poses) if camera else llff_intrinsics(array, file),
        scaled=True,
        masks=[mask_of(folder, image.name) for image in photographs],
    )


def _log(file: Path, images: str | None, camera: Intrinsics | None) -> Found:
    poses = load_poses(file)
    if camera is None:
        beside = [file.with_name(name) for name in _CALIBRATIONS if file.with_name(name).is_file()]
        if not beside:
            raise CaptureError(f"{file} says nothing of the camera; give its calibration as `camera`")
        camera = load_camera(beside[0])
    folder, photographs = _sorted_images(file, images, len(poses))
    masks = [mask_of(folder, image.name) for image in photographs]
    return Found(poses, photographs, [camera] * len(poses), is_reduced(folder), masks)


def _sorted_images(file: Path, images: str | None, count: int) -> tuple[Path, list[Path]]:
    """The folder of the images that a file lists by their sorted order, and these."""
    folders = [file.parent / images] if images else [*image_folders(file.parent), file.parent]
    if not folders[0].is_dir():
        raise CaptureError(f"{folders[0]} is no folder; name the one that the images are in")
    found = so_many_images(folders, count)
    if found is None:
        counts = ", ".join(f"{len(images_in(folder))} in {folder.name}" for folder in folders)
        raise CaptureError(f"{file} has {count} poses, and there are not as many images: {counts}")
    return found


def _seven_scenes(place: Path, camera: Intrinsics | None) -> Found:
    poses = load_poses(place)
    images, depths = ([frame_file(place, name, kind) for name in poses.names] for kind in ("color", "depth"))
    missing = [name for name, image in zip(poses.names, images, strict=True) if image is None]
    if missing:
        raise CaptureError(f"{place}: {missing[0]} has no .color.png or .color.jpg")
    return Found(
        poses,
        [image for image in images if image is not None],
        [camera or seven_scenes_camera(place)] * len(poses),
        depths=None if None in depths else [depth for depth in depths if depth is not None],
    )
