"""A field of views without rendering: cameras in a room of points, whose information is a closed form.

A floor plan of places in the plane of x and z, headings about the axis y, which is up; a view at heading 0
looks along +z, at heading 1 further towards +x. Each sees those of the points that are in its square film, by
a noise of one pixel (`point_information`). The entries' covariance is a Wishart distribution's, as that of as
many paths as the relative error takes.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from mitsuba_crb import se3
from mitsuba_crb.agents.bundle import FEWEST_POINTS, PointView, point_information
from mitsuba_crb.bound.cramer_rao import PoseBound, cramer_rao_bound
from mitsuba_crb.camera import Camera
from mitsuba_crb.errors import PrecisionWarning
from mitsuba_crb.information.fisher import FisherInformation
from mitsuba_crb.information.significance import no_information
from mitsuba_crb.planning.layout import (
    BLOCKED,
    INSIDE,
    MEASURED,
    MEASUREMENTS,
    OUTSIDE,
    SCHEMA,
    TO_DO,
    VARIABLES,
    VERDICTS,
)
from mitsuba_crb.planning.view_field import ViewField

SIZE = 64
CAMERA = Camera.pinhole(SIZE / 2, SIZE / 2, (SIZE, SIZE))
"""A quarter of a turn wide and high."""

Matrix = NDArray[np.float64]


def room_points(rng: np.random.Generator, *, half: float = 6.0, count: int = 600) -> Matrix:
    """Points (n, 3) on the four walls of a square room, 3 high: the farther towards +x, the denser."""
    along, height = rng.uniform(-half, half, count), rng.uniform(0.0, 3.0, count)
    wall = rng.integers(4, size=count)
    x = np.choose(wall, [along, along, np.full(count, -half), np.full(count, half)])
    z = np.choose(wall, [np.full(count, -half), np.full(count, half), along, along])
    kept = rng.uniform(size=count) < 0.1 + 0.9 * (x + half) / (2.0 * half)
    return np.stack([x, height, z], axis=1)[kept]


def heading_pose(position: Any, angle: float) -> Matrix:
    """world_from_camera at a position, turned by an angle [rad] from +z towards +x, upright."""
    pose = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, angle, 0.0]))
    pose[:3, 3] = position
    return pose


def view_information(points: Matrix, pose: Matrix, *, relative_error: float) -> FisherInformation:
    """What a view at a pose knows of it, of the variable "body", in the camera frame."""
    p = (points - pose[:3, 3]) @ pose[:3, :3]
    depth = np.where(p[:, 2] > 0.1, p[:, 2], np.inf)
    seen = np.flatnonzero((np.abs(p[:, :2]) < depth[:, None]).all(axis=1) & np.isfinite(depth))
    if len(seen) < FEWEST_POINTS:
        return no_information(variable="body", pose=pose)
    exact = point_information(points, PointView("body", pose, CAMERA, 1.0, seen))
    i, j = np.triu_indices(6)
    F = exact.matrix
    covariance = F[np.ix_(i, i)] * F[np.ix_(j, j)] + F[np.ix_(i, j)] * F[np.ix_(j, i)]
    covariance *= 0.5 * relative_error**2
    return FisherInformation(F, covariance, linearisation=exact.linearisation)


def dataset_of(
    informations: list[FisherInformation],
    place: Any,
    heading: Any,
    status: Any,
    *,
    candidates: dict[str, Any] | None = None,
) -> xr.Dataset:
    """The dataset of some views as the store has it: NaN of what is to do, nothing where nothing is seen."""
    status = np.asarray(status, dtype=np.int8)
    rows = []
    for information, state in zip(informations, status, strict=True):
        if state != MEASURED:
            information = no_information(variable="body", pose=information.pose)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PrecisionWarning)
            rows.append(_row(information, cramer_rao_bound(information)))
    columns = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
    columns |= {"place": np.asarray(place), "heading": np.asarray(heading), "status": status}
    columns |= {"done": status != TO_DO, "seconds": np.full(len(rows), 0.1)}
    columns |= {"paths": np.zeros(len(rows)), "no_bound": np.zeros(len(rows))}
    for name, variable in MEASUREMENTS.items():
        columns[name] = np.array(columns[name], dtype=variable.dtype)
        columns[name][status == TO_DO] = variable.fill
    return xr.Dataset(
        {
            name: (("view", *variable.dims), columns[name].astype(variable.dtype), variable.attributes)
            for name, variable in VARIABLES.items()
        },
        attrs={
            "title": "a synthetic field of views",
            "schema": SCHEMA,
            "frame": "world_from_camera",
            "conventions": "x left, y up, z forward; twist (rho, phi)",
            "unit": "scene unit",
            "settings": json.dumps({"scene": "synthetic", "deterministic": True}),
            "candidates": json.dumps(candidates or {"kind": "file"}),
            "up": [0.0, 1.0, 0.0],
        },
    )


def small_dataset(
    *,
    shape: tuple[int, int] = (4, 3),
    headings: int = 4,
    spacing: float = 2.0,
    height: float = 1.5,
    points: Matrix | None = None,
    relative_error: float = 0.01,
    inside: Collection[int] = (),
    blocked: Collection[int] = (),
    to_do: Collection[int] = (),
    seed: int = 0,
) -> xr.Dataset:
    """Places on a grid centred on the y axis, each with some headings, as the store's dataset.

    Args:
        shape: places along x and along z; the last runs fastest.
        headings: of each place, equally spaced.
        spacing: between places [scene unit].
        height: of all cameras [scene unit].
        points: (n, 3); default: `room_points`.
        relative_error: of the information's entries, about.
        inside: numbers of places that are in a solid.
        blocked: indices of views that are blocked.
        to_do: indices of views that are not measured yet.
        seed: of the points.
    """
    if points is None:
        points = room_points(np.random.default_rng(seed))
    origin = [-0.5 * spacing * (shape[0] - 1), height, -0.5 * spacing * (shape[1] - 1)]
    informations, place, heading, status = [], [], [], []
    for view in range(shape[0] * shape[1] * headings):
        number, turn = divmod(view, headings)
        i, k = divmod(number, shape[1])
        position = [origin[0] + spacing * i, height, origin[2] + spacing * k]
        pose = heading_pose(position, 2.0 * np.pi * turn / headings)
        informations.append(view_information(points, pose, relative_error=relative_error))
        place.append(number)
        heading.append(turn)
        state = MEASURED if informations[-1].matrix.any() else OUTSIDE
        state = INSIDE if number in inside else BLOCKED if view in blocked else state
        status.append(TO_DO if view in to_do else state)
    candidates = {
        "kind": "grid",
        "axes": np.eye(3).tolist(),
        "up_axis": 1,
        "origin": origin,
        "spacing": [spacing, 0.0, spacing],
        "shape": [shape[0], 1, shape[1]],
        "headings": headings,
        "pitch_deg": [0.0],
    }
    return dataset_of(informations, place, heading, status, candidates=candidates)


def small_field(**options: Any) -> ViewField:
    """The same as it is read, without a file; see `small_dataset`."""
    return ViewField(small_dataset(**options))


def small_store(path: Path, **options: Any) -> Path:
    """The same in a store at a path, chunked by eight views."""
    small_dataset(**options).chunk(view=8).to_zarr(path, zarr_format=3, consolidated=False)
    return path


def _row(information: FisherInformation, bound: PoseBound) -> dict[str, Any]:
    """What the store has of one measured view."""
    return {
        "world_from_camera": information.pose,
        "information": information.to_frame("world").matrix,
        "information_camera": information.matrix,
        "covariance_of_entries": information.covariance_of_entries,
        "length_scale": bound.length_scale,
        "position_std": bound.position_std,
        "rotation_std_deg": bound.rotation_std_deg,
        "position_std_standard_error": bound.position_std_standard_error,
        "rotation_std_deg_standard_error": bound.rotation_std_deg_standard_error,
        "position_std_lower_limit": bound.position_std_lower_limit,
        "rotation_std_deg_lower_limit": bound.rotation_std_deg_lower_limit,
        "position_verdict": [VERDICTS.index(v) for v in bound.position_verdict],
        "rotation_verdict": [VERDICTS.index(v) for v in bound.rotation_verdict],
        "position_bound": np.linalg.norm(bound.position_std),
        "rotation_bound_deg": np.linalg.norm(bound.rotation_std_deg),
        "rank": bound.rank,
        "pixels": information.selection.selected,
        "weakest": np.full(6, np.nan) if bound.weakest is None else bound.weakest.direction,
        "eigenvalues": bound.eigenvalues,
    }
