"""The command's texts made into values: pose, size, defaults, noise; each mistake named in one line."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ..errors import OptionError, PoseError
from ..files import read_array, read_json, read_rows, read_text

if TYPE_CHECKING:
    from ..camera import Intrinsics
    from ..noise import NoiseModel


def parse_size(text: str | None) -> tuple[int, int] | None:
    """Width and height [pixel] from "WxH"."""
    if text is None:
        return None
    found = re.fullmatch(r"\s*(\d+)\s*[xX×]\s*(\d+)\s*", text)
    if not found:
        raise OptionError(f"--size {text!r} is not WxH, two whole numbers of pixels, such as 256x192")
    width, height = int(found.group(1)), int(found.group(2))
    if not width or not height:
        raise OptionError(f"--size {text}: width and height must be at least 1")
    return width, height


def parse_defines(texts: list[str] | None) -> dict[str, str]:
    """Names and values from "name=value" texts; the last of a name counts."""
    defines = {}
    for text in texts or ():
        name, equals, value = text.partition("=")
        if not equals or not name.strip():
            raise OptionError(f"-D {text!r} is not name=value, such as -D spp=64")
        defines[name.strip()] = value.strip()
    return defines


def scene_defines(scene: Path, texts: list[str] | None, light: str | None, up: str | None) -> dict[str, str]:
    """What is said of a scene: "name=value" texts, and of a world's file its light and the axis that is up.

    Raises:
        OptionError: one of the last two, and the file is none of a world.
    """
    from ..render.world import ENDINGS, is_world

    said = {name: value for name, value in (("light", light), ("up", up)) if value is not None}
    if said and not is_world(scene):
        raise OptionError(
            f"--{next(iter(said))} is of worlds ({', '.join(ENDINGS)}), and {scene} is a scene file with "
            "lights of its own; leave it out"
        )
    return parse_defines(texts) | said


def pose_file(text: str | None) -> Path | None:
    """The file that a `--pose` text names, or None if the text is the pose itself or is not given."""
    return None if text is None or _numbers(text) is not None else Path(text)


def parse_pose(text: str | None) -> npt.NDArray[np.float64] | None:
    """world_from_camera, 4x4, from "x y z qx qy qz qw" or from a file.

    A file holds a 4x4 matrix, or the seven numbers, as text separated by blanks or commas, as `.npy`, or as
    `.json`: nested lists, or an object with the key "pose", as `bound --json` writes.

    Raises:
        PoseError: the file is missing or unreadable, or is no rigid motion.
    """
    from .. import se3

    if text is None:
        return None
    file = pose_file(text)
    if file is None:
        return se3.pose_from_vector(text)
    values = _read(file)
    try:
        return se3.pose_from_numbers(values)
    except PoseError as error:
        raise PoseError(f"--pose {file}: {error}") from error


def parse_body_from_camera(text: str | None, pose: object) -> npt.NDArray[np.float64] | None:
    """(4, 4) from "x y z qx qy qz qw" or from a file, as `load_body_from_camera` reads it.

    Args:
        text: what was said.
        pose: of the body.

    Raises:
        OptionError: there is none.
        PoseError: the file is missing or unreadable, or is no rigid motion.
    """
    from .. import se3
    from ..datasets.body_from_camera import load_body_from_camera

    if text is None:
        return None
    if pose is None:
        raise OptionError("--body-from-camera is of poses of a body: give them by --poses or --pose")
    file = pose_file(text)
    try:
        return se3.pose_from_vector(text) if file is None else load_body_from_camera(file)
    except PoseError as error:
        raise PoseError(f"--body-from-camera {error}") from None


def camera_of_body(
    world_from_body: npt.NDArray[np.float64], body_from_camera: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """world_from_camera in our axes (4, 4), of a camera whose own are OpenCV's."""
    from ..datasets.conventions import Convention

    (pose,) = Convention("opencv", body_from_camera=body_from_camera).ours(world_from_body[None])
    return np.asarray(pose)


_SCENE_S = "scene"
"""What `--camera` says for the scene's own camera."""


def camera_file(text: str | None) -> Path | None:
    """The file that a `--camera` text names, None if it names none."""
    from ..datasets.intrinsics import file_and_name

    return None if text in (None, _SCENE_S) else file_and_name(text)[0]


def parse_camera(text: str | None) -> Intrinsics | None:
    """The calibration in a file, or in "FILE:NAME", of several cameras the one of this name.

    None if the text is not given, or says that it is the scene's own.

    Raises:
        CameraError: the file is missing, of no known format or damaged, or the name is missing or unknown.
    """
    from ..datasets.intrinsics import file_and_name, load_camera

    return None if text in (None, _SCENE_S) else load_camera(*file_and_name(text))


def parse_noise(sigma: float | None, file: Path | None) -> NoiseModel | None:
    """The noise that `--sigma` or `--noise` says, None if neither does.

    Raises:
        OptionError: both do.
        NoiseError: an impossible noise.
    """
    from .. import noise

    if sigma is not None and file is not None:
        raise OptionError("--sigma and --noise both say what the noise is; give one of them")
    if file is not None:
        return noise.load(file)
    return None if sigma is None else noise.Gaussian(sigma)


def parse_exposure(text: str | None) -> float | str | None:
    """White of the default noise [radiance], "auto" or None.

    Raises:
        OptionError: it is neither a number nor "auto".
    """
    if text is None or text == "auto":
        return text
    try:
        return float(text)
    except ValueError:
        raise OptionError(f"--exposure {text!r} is neither a radiance, such as 0.8, nor auto") from None


def parse_displacements(file: Path | None, *, hcr: bool) -> npt.NDArray[np.float64] | None:
    """Camera-frame twists (m, 6) from a text file with six numbers a row; `#` starts a comment.

    Args:
        file: the file.
        hcr: whether there is a bound for them.

    Raises:
        OptionError: there is none, or the file is missing, or has something else in it.
    """
    if file is None:
        return None
    if not hcr:
        raise OptionError("--displacements belongs to --hcr; give both")
    rows = read_rows(file, OptionError)
    if rows.shape[1] != 6 or len(rows) == 0:
        raise OptionError(f"--displacements {file}: expected rows of six numbers, got shape {rows.shape}")
    return rows


def view_options(
    *,
    sensor: str,
    pose: str | None,
    size: str | None,
    camera: str | None,
    pixels: str | None,
    drop_invalid: bool,
    integrator: str | None,
    spp: int | None,
    precision: float | None = None,
    max_spp: int | None = None,
    seed: int,
    batches: int,
) -> dict[str, Any]:
    """What every command that measures a view is told of it, as the library's keywords."""
    return {
        "sensor": sensor,
        "pose": parse_pose(pose),
        "size": parse_size(size),
        "camera": parse_camera(camera),
        "pixels": pixels,
        "drop_invalid": drop_invalid,
        "integrator": integrator,
        "spp": spp,
        "precision": precision,
        "max_spp": max_spp,
        "seed": seed,
        "batches": batches,
    }


def sensor_options(
    *,
    channels: str | None,
    measure: str,
    depth_sigma: str | None,
    depth_range: str | None,
    depth_edges: bool,
    exposure: str | None,
    no_clip: bool,
) -> dict[str, Any]:
    """What the camera measures and how it exposes, as the library's keywords."""
    from ..measure.sensing import parse_depth_sigma, parse_range

    return {
        "channels": channels,
        "measure": measure,
        "depth_edges": depth_edges,
        "depth_sigma": parse_depth_sigma(depth_sigma),
        "depth_range": parse_range(depth_range),
        "exposure": parse_exposure(exposure),
        "clip": not no_clip,
    }


def view_files(
    scene: Path, pose: str | None, camera: str | None, pixels: str | None, body: str | None = None
) -> list[Path]:
    """The files that the view is read from, which no output may overwrite."""
    from ..render.demos import scene_path

    named = (pose_file(pose), pose_file(body), camera_file(camera), Path(pixels) if pixels else None)
    return [scene_path(scene), *(file for file in named if file is not None)]


def _read(file: Path) -> Any:
    if not os.path.lexists(file):
        raise PoseError(f"--pose {file}: no such file, and not the seven numbers x y z qx qy qz qw")
    if file.suffix.lower() == ".npy":
        return read_array(file, PoseError)
    if file.suffix.lower() == ".json":
        document = read_json(file, PoseError)
        if isinstance(document, dict) and "pose" not in document:
            raise PoseError(f'--pose {file}: the JSON object has no key "pose"')
        return document["pose"] if isinstance(document, dict) else document
    numbers = _numbers(read_text(file, PoseError))
    if numbers is None:
        raise PoseError(f"--pose {file}: expected a 4x4 matrix of numbers separated by blanks")
    return numbers


def _numbers(text: str) -> list[float] | None:
    """The numbers of a text of nothing but numbers, else None."""
    try:
        return [float(word) for word in re.split(r"[\s,]+", text.strip())]
    except ValueError:
        return None
