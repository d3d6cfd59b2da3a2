"""A recording for Rerun's viewer: frusta of the cameras, ellipsoids of their positions' errors, and pictures.

An ellipsoid is that of the position's covariance, δ = R ρ along the world's axes, at one standard deviation
and at 95 % of a Gaussian, √χ²₃(0.95) = 2.80 of them, in true size. A direction that is not seen is an open
line as long as the visible depth, and no ball; what is finite across it stays an ellipse.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .. import se3
from ..errors import OutputError
from ..files import atomic
from ..se3 import Array
from .estimates import Estimate
from .headings import Heading, blind

LEVELS = {"1_sigma": 1.0, "95_percent": 2.7954834829151074}
"""Semi-axes in standard deviations, by the name of the level."""
_OPEN = 1e-6
_FRUSTUM = 0.15
"""Of a camera's picture: its distance from the camera over the visible depth."""


def write_rerun(
    path: Path, estimates: Sequence[Estimate], heading: Heading, pictures: Path | None = None
) -> list[str]:
    """Write the recording; returns what there is to say of it.

    Args:
        path: the file.
        estimates: of cameras in OpenCV's axes, or of bodies.
        heading: of the file.
        pictures: a PNG or JPEG of the only pose, or a folder with pictures by the poses' names.

    Raises:
        OutputError: rerun-sdk is not installed, or there are no such pictures.
    """
    rr = _library()
    found = _pictures(pictures, estimates)
    stream = rr.RecordingStream("mitsuba-crb", recording_id=heading.source.name)
    lines = heading.lines(estimates, "ellipsoids: of the position, true size, " + " and ".join(LEVELS))
    with atomic(path) as temporary:
        stream.save(temporary)
        stream.log("about", rr.TextDocument("\n".join(lines)), static=True)
        for place, (estimate, picture) in enumerate(zip(estimates, found, strict=True)):
            stream.set_time("pose", sequence=place)
            _log_camera(rr, stream, f"world/{place}", estimate, picture)
            _log_errors(rr, stream, f"world/{place}", estimate)
        stream.flush()
        stream.disconnect()
    return [
        f"{estimate.name}'s position is an open line along {'; '.join(estimate.words)}"
        for estimate in blind(estimates)
        if np.isinf(position_errors(estimate)[0]).any()
    ]


def position_errors(estimate: Estimate) -> tuple[Array, Array]:
    """Standard deviations (3,) of the position along axes (3, 3) in columns, the world's; infinite first."""
    rotation = estimate.pose[:3, :3]
    left, singular, _ = np.linalg.svd(rotation @ estimate.unseen[:3], full_matrices=True)
    free = int(np.count_nonzero(singular > _OPEN))
    zero = np.zeros((3, 3))
    covariance, _ = estimate.in_coordinates(np.block([[left.T @ rotation, zero], [zero, np.eye(3)]]))
    variances, axes = np.linalg.eigh(covariance[free:3, free:3])
    deviations = np.concatenate([np.full(free, np.inf), np.sqrt(np.maximum(variances[::-1], 0.0))])
    return deviations, np.hstack([left[:, :free], left[:, free:] @ axes[:, ::-1]])


def _log_camera(rr: Any, stream: Any, name: str, estimate: Estimate, picture: Path | None) -> None:
    pose = estimate.pose
    stream.log(name, rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
    stream.log(f"{name}/name", rr.Points3D([[0.0, 0.0, 0.0]], labels=[estimate.name], radii=[0.0]))
    if estimate.camera is not None:
        pinhole = rr.Pinhole(
            resolution=estimate.camera.size,
            focal_length=estimate.camera.focal,
            principal_point=estimate.camera.centre,
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=_FRUSTUM * estimate.length_scale,
        )
        stream.log(f"{name}/camera", pinhole)
    if picture is not None:
        stream.log(f"{name}/camera/picture", rr.EncodedImage(path=picture))


def _log_errors(rr: Any, stream: Any, name: str, estimate: Estimate) -> None:
    deviations, axes = position_errors(estimate)
    axes = axes * np.linalg.det(axes)  # a rotation
    finite = np.where(np.isfinite(deviations), deviations, 0.0)
    centre, turn = estimate.pose[:3, 3], np.eye(4)
    turn[:3, :3] = axes
    quaternion = se3.vector_from_pose(turn)[3:]
    for level, sigmas in LEVELS.items():
        ellipsoid = rr.Ellipsoids3D(centers=[centre], half_sizes=[sigmas * finite], quaternions=[quaternion])
        stream.log(f"errors/{level}/{name}", ellipsoid)
    open_axes = axes[:, ~np.isfinite(deviations)].T * estimate.length_scale
    if len(open_axes):
        strips = [[centre - axis, centre + axis] for axis in open_axes]
        stream.log(f"errors/unseen/{name}", rr.LineStrips3D(strips))


def _pictures(given: Path | None, estimates: Sequence[Estimate]) -> list[Path | None]:
    if given is None:
        return [None] * len(estimates)
    if os.path.isfile(given) and len(estimates) == 1:
        return [given]
    files = [given / estimate.name for estimate in estimates]
    found = [file if os.path.isfile(file) else None for file in files]
    if not any(found):
        raise OutputError(
            f"--images {given}: neither the only pose's picture nor a folder with any called as the poses, "
            f"such as {estimates[0].name!r}"
        )
    return found


def _library() -> Any:
    try:
        return importlib.import_module("rerun")
    except ImportError:
        raise OutputError("--to rerun needs rerun-sdk: pip install 'mitsuba_crb[rerun]'") from None
