"""COLMAP's images, from its text and its binary files: the pose and the camera of each.

Poses are cam_from_world, with the quaternion's w first, in axes x right, y down, z forward.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import NamedTuple

from ..errors import PoseError
from ..files import read_bytes, read_text
from .binary import Cursor, is_binary
from .conventions import Convention
from .entries import number, whole
from .headers import quaternion_order
from .pose_list import Poses, from_quaternions, listed
from .rows import are_numbers

CONVENTION = Convention("opencv", "camera_from_world", "wxyz")


class ColmapImage(NamedTuple):
    """A record of an image."""

    where: str
    """What messages call it."""
    quaternion: tuple[float, ...]
    """w, x, y, z."""
    translation: tuple[float, ...]
    """Of cam_from_world [scene unit]."""
    camera: str
    """The number of its camera."""
    name: str
    """Of its file, below the folder of images."""


def is_images_text(line: str) -> bool:
    """Whether a text whose first row this is lists COLMAP's images, and not KITTI's whole numbers."""
    words = line.split()
    if len(words) < 10 or (len(words) > 10 and are_numbers(words)):
        return False
    return are_numbers(words[:9]) and words[0].isdigit() and words[8].isdigit()


def is_images_binary(data: bytes) -> bool:
    """Whether bytes list COLMAP's images, the last of which may be cut off."""
    if len(data) < 44:
        return len(data) >= 8
    count, _, *quaternion = struct.unpack_from("<QI4d", data)
    return count < 1 << 32 and all(abs(value) < 2.0 for value in quaternion)


def colmap_poses(path: Path, given: Convention) -> Poses:
    """The poses of an `images.txt` or an `images.bin`, in its order.

    Raises:
        PoseError: the file is neither, or is damaged.
    """
    images = read_images(path)
    w_first = [image.quaternion for image in images]
    poses, notes = from_quaternions(
        [image.translation for image in images],
        [(x, y, z, w) for w, x, y, z in w_first],
        [image.where for image in images],
    )
    return listed(
        path,
        given,
        CONVENTION,
        form="COLMAP",
        poses=poses,
        names=[image.name for image in images],
        cameras=[image.camera for image in images],
        notes=notes,
        fixed=True,
    )


def read_images(path: Path) -> list[ColmapImage]:
    """The images of an `images.txt` or an `images.bin`.

    Raises:
        PoseError: the file is neither, is damaged, or is empty.
    """
    data = read_bytes(path, PoseError)
    images = _binary(Cursor(data, path, PoseError)) if is_binary(data) else _text(path)
    if not images:
        raise PoseError(f"{path} has no image in it")
    names = [image.name for image in images]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise PoseError(f"{path} has two images {twice!r}")
    return images


def _text(path: Path) -> list[ColmapImage]:
    lines = read_text(path, PoseError).splitlines()
    order = quaternion_order([line for line in lines if line.startswith("#")])
    if order == "xyzw":
        raise PoseError(f"{path}: its header has qw last, and COLMAP's format first; mend the header")
    images: list[ColmapImage] = []
    points_follow = False
    for line_number, line in enumerate(lines, 1):
        words = line.split(maxsplit=9)
        if line.lstrip().startswith("#"):
            continue
        if points_follow and (not words or _are_points(line)):
            points_follow = False
        elif words:
            images.append(_image(words, f"{path}, line {line_number}"))
            points_follow = True
    return images


def _image(words: list[str], where: str) -> ColmapImage:
    if len(words) != 10:
        raise PoseError(
            f"{where}: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, got {len(words)} words"
        )
    whole(words[0], f"{where}: the image's number", PoseError)
    values = tuple(number(word, f"{where}: the pose", PoseError) for word in words[1:8])
    camera = str(whole(words[8], f"{where}: the camera's number", PoseError))
    return ColmapImage(where, values[:4], values[4:], camera, words[9].strip())


def _are_points(line: str) -> bool:
    """Whether a line lists x, y and the number of a point, one after another; images end in a name."""
    words = line.split()
    return len(words) % 3 == 0 and are_numbers(words[:3]) and are_numbers(words[-3:])


def _binary(cursor: Cursor) -> list[ColmapImage]:
    (count,) = cursor.take("Q")
    images = []
    for _ in range(count):
        key, *values, camera = cursor.take("I7dI")
        name = cursor.text()
        (points,) = cursor.take("Q")
        cursor.skip(24 * points)
        where = f"{cursor.path}: image {key} ({name})"
        images.append(ColmapImage(where, tuple(values[:4]), tuple(values[4:]), str(camera), name))
    cursor.end()
    return images
