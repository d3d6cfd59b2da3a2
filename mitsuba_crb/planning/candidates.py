"""Candidate poses: read from a file, on a grid over the floor plan, or around what is looked at.

    FILE                             any file of poses that `load_poses` reads
    grid:nx=10,ny=8,headings=8       places on a grid, and at each as many directions, evenly about up
    around:target=0:1.7:0.6,radius=2 places on rings round a point or a shape, all looking at it

After the colon stand `key=value`s between commas; several numbers of one value stand between colons. Of a
`grid:`

| key | value | default |
|---|---|---|
| `x`, `y`, `z` | LO:HI, or one number | 0.9 of the world; of the axis that is up the camera's own place |
| `nx`, `ny`, `nz` | places along it, its ends included | what `spacing` makes; of the axis that is up 1 |
| `spacing` | between places [scene unit], in the middle of the range | a tenth of the longer side |
| `headings` | directions at a place | 8 |
| `pitch` | upwards [deg], one number or several: -20:0:20 | 0 |
| `up` | x, y, z, -x, -y, -z, or three numbers | the scene camera's |

and of `around:`

| key | value | default |
|---|---|---|
| `target` | X:Y:Z, a shape's id, or `centre` of the world | centre |
| `radius` | distance from it [scene unit] | has to be said |
| `elevations` | of the rings above it [deg], one number or several: 10:40 | 20 |
| `count` | places on each ring | 24 |
| `up` | as above | as above |

Of the axes of the world, the one next to up is taken to be up itself, and the two others to be level: with an
up that is none of them, `x`, `y`, `z` and the plan are tilted with it. The first direction looks along the
first level axis; the others follow counter-clockwise, seen from above. Of a radiance field the world is where
its cameras stand.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..datasets.poses import load_poses
from ..errors import OptionError
from ..files import Record
from ..measure.options import MeasurementKeywords
from ..se3 import Array, as_pose
from .forms import (
    AXES,
    FORMS,
    angles_of,
    check_few,
    count_of,
    direction_of,
    numbers_of,
    positive,
    up_of,
    values_of,
)
from .plan_view import plan_axes
from .surroundings import Surroundings, mean_up, shape_centre, surroundings

Ints = NDArray[np.int32]

HELP = (
    "A file of poses (TUM, KITTI, COLMAP, transforms.json, ...); or grid:nx=10,ny=8,headings=8 over the "
    "floor plan, with [x=LO:HI][,y=...][,z=...][,nz=N][,spacing=S][,pitch=A:B:...][,up=z]; or "
    "around:target=X:Y:Z|SHAPE|centre,radius=R with [,elevations=A:B:...][,count=N][,up=z]."
)
"""What `--poses` says of itself."""

_HEADINGS, _COUNT, _ELEVATION = 8, 24, 20.0
_SIDE = 10
"""Spacings in the longer side of a grid of which nothing is said."""
_MARGIN = 0.05
"""Of the world's box, left out at each end."""
_SAME_PLACE = 1e-9
"""Of the positions' extent: places that differ by less are one."""


@dataclass(frozen=True, eq=False)
class Candidates(Record):
    """Poses that a plan may choose from."""

    poses: Array
    """(n, 4, 4) world_from_camera [scene unit]."""
    place: Ints
    """(n,) number of the position."""
    heading: Ints
    """(n,) number of the direction there."""
    up: Array
    """(3,) unit vector, in the world."""
    description: dict[str, Any] = field(default_factory=dict)
    """The form and its parameters, JSON-able: `kind` is grid, around, file or poses."""

    def __len__(self) -> int:
        return len(self.poses)

    def __str__(self) -> str:
        return f"{len(self)} views, {len(np.unique(self.place))} places ({self.description['kind']})"


def candidates_of(
    poses: Sequence[Any] | Array, *, up: ArrayLike | None = None, description: Mapping[str, Any] | None = None
) -> Candidates:
    """Poses as candidates; those of one position have one place.

    Args:
        poses: (n, 4, 4) world_from_camera, or a sequence of what `as_pose` takes.
        up: (3,); default: the cameras' own on average, or the world's axis within 15 degrees of that.
        description: see `Candidates`.

    Raises:
        PoseError: one is no rigid motion.
        OptionError: there are none, or up is no direction.
    """
    rigid = [as_pose(pose, f"pose {k} of {len(poses)}") for k, pose in enumerate(poses)]
    if not rigid:
        raise OptionError("there are no candidate poses")
    found = np.array(rigid)
    centres = found[:, :3, 3]
    grain = _SAME_PLACE * max(float(np.ptp(centres, axis=0).max()), 1e-300)
    keys = np.round((centres - centres.min(axis=0)) / grain).astype(np.int64)
    _, first, group = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    place = np.argsort(np.argsort(first))[group.ravel()]  # in the order of the poses
    heading = np.zeros(len(found), dtype=np.int32)
    for number in range(len(first)):
        (here,) = np.nonzero(place == number)
        heading[here] = np.arange(len(here))
    said = dict(description or {"kind": "poses"})
    direction = mean_up(found) if up is None else direction_of(up)
    return Candidates(found, place.astype(np.int32), heading, direction, said)


def parse_candidates(
    text: str | os.PathLike[str],
    world: Any,
    *,
    convention: str | None = None,
    body_from_camera: ArrayLike | None = None,
    **options: Unpack[MeasurementKeywords],
) -> Candidates:
    """The candidates that a text means: `grid:…`, `around:…` or a file, see the module.

    Args:
        text: one of the forms.
        world: whatever can be measured.
        convention, body_from_camera: of a file, as `load_poses` has them.
        options: of the measurement; its sensor and camera say where the scene's own camera is.

    Raises:
        OptionError: the form, a key or a value means nothing, in a line that names the cure.
        PoseError: as `load_poses`.
        MitsubaCRBError: the world cannot be opened.
    """
    form, colon, rest = os.fspath(text).partition(":")
    if not colon or form not in FORMS or os.path.exists(text):
        return _of_file(Path(text), convention, body_from_camera)
    if convention is not None or body_from_camera is not None:
        raise OptionError(
            f"--poses {form}: makes poses in our axes, and a convention is of a file: leave it out"
        )
    said = values_of(form, rest)
    around = surroundings(world, options)
    up = around.up if "up" not in said else up_of(form, said["up"])
    if up is None:
        raise OptionError(f"--poses {form}: the world's own camera stands nowhere; say what is up: up=z")
    if form == "grid":
        return _grid(said, around, up)
    return _around(said, around, up, world)


def looking(forward: Array, upwards: Array) -> Array:
    """Rotations (..., 3, 3) of cameras that look along `forward` and whose own up is `upwards`."""
    return np.stack([np.cross(upwards, forward), upwards, forward], axis=-1)


def _of_file(file: Path, convention: str | None, body_from_camera: ArrayLike | None) -> Candidates:
    name = str(file)
    form = re.match(r"([A-Za-z_]+)(:|$)", name)
    if form and not os.path.lexists(file):
        near = get_close_matches(form[1].lower(), FORMS, 1, 0.6)
        if near:
            raise OptionError(f"--poses {name}: no such file; did you mean {near[0]}:key=value,...?")
    read = load_poses(file, convention, body_from_camera=body_from_camera)
    said = {"kind": "file", "file": name, "format": read.format, "convention": read.convention}
    return candidates_of(read.poses, description=said)


def _grid(said: dict[str, str], around: Surroundings, up: Array) -> Candidates:
    axes, which = plan_axes(up)
    level = [axis for axis in range(3) if axis != which]
    ranges = _ranges(said, around, axes, which)
    sides = np.ptp(ranges, axis=1)
    spacing = max(sides[level]) / _SIDE
    if "spacing" in said:
        spacing = positive("grid", "spacing", said["spacing"])
    places, steps = [], np.zeros(3)
    for axis, (low, high) in enumerate(ranges):
        count = count_of("grid", f"n{AXES[axis]}", said)
        if count is None and (axis != which or "spacing" in said) and high > low and spacing > 0:
            whole = math.floor((high - low) / spacing + 1e-9)
            low, high = np.array([low, high]).mean() + 0.5 * spacing * whole * np.array([-1.0, 1.0])
            count = whole + 1
        count = count or 1
        check_few(count)
        places.append(np.linspace(low, high, count) if count > 1 else np.array([0.5 * (low + high)]))
        steps[axis] = (high - low) / (count - 1) if count > 1 else 0.0
    headings = count_of("grid", "headings", said) or _HEADINGS
    pitches = angles_of("grid", "pitch", said.get("pitch", "0"))
    shape = [len(part) for part in places]
    check_few(math.prod(shape) * headings * len(pitches))
    # The axis that is up varies slowest, then the second of the plan.
    order = [which, level[1], level[0]]
    lattice = np.meshgrid(*(places[axis] for axis in order), indexing="ij")
    coordinates = np.zeros((lattice[0].size, 3))
    coordinates[:, order] = np.stack([part.ravel() for part in lattice], axis=1)
    forward, upwards = _directions(axes[level[0]], up, 2 * np.pi * np.arange(headings) / headings, pitches)
    turns = looking(forward, upwards)
    poses = np.tile(np.eye(4), (len(coordinates), len(turns), 1, 1))
    poses[..., :3, :3] = turns
    poses[..., :3, 3] = (coordinates @ axes)[:, None]
    description = {
        "kind": "grid",
        "axes": axes.tolist(),
        "up_axis": which,
        "origin": [float(part[0]) for part in places],
        "spacing": steps.tolist(),
        "shape": shape,
        "headings": headings,
        "pitch_deg": pitches.tolist(),
    }
    return _numbered(poses, up, description)


def _around(said: dict[str, str], around: Surroundings, up: Array, world: Any) -> Candidates:
    if "radius" not in said:
        raise OptionError("--poses around: lacks the distance from the target; add radius=R [scene unit]")
    radius = positive("around", "radius", said["radius"])
    target = _target(said.get("target", "centre"), around, world)
    elevations = angles_of("around", "elevations", said.get("elevations", str(_ELEVATION)))
    count = count_of("around", "count", said) or _COUNT
    check_few(count * len(elevations))
    axes, which = plan_axes(up)
    first = axes[min(axis for axis in range(3) if axis != which)]
    forward, upwards = _directions(first, up, 2 * np.pi * np.arange(count) / count, -elevations)
    # The place at azimuth 0 stands on the first level axis and looks back along it.
    half_turn = np.eye(3) - 2.0 * (np.eye(3) - np.outer(up, up))
    forward, upwards = forward @ half_turn.T, upwards @ half_turn.T
    poses = np.tile(np.eye(4), (len(forward), 1, 1, 1))
    poses[:, 0, :3, :3] = looking(forward, upwards)
    poses[:, 0, :3, 3] = target - radius * forward
    description = {
        "kind": "around",
        "target": target.tolist(),
        "radius": radius,
        "elevations_deg": elevations.tolist(),
        "count": count,
    }
    return _numbered(poses, up, description)


def _numbered(poses: Array, up: Array, description: dict[str, Any]) -> Candidates:
    """Of poses (places, directions, 4, 4)."""
    places, directions = poses.shape[:2]
    place = np.repeat(np.arange(places, dtype=np.int32), directions)
    heading = np.tile(np.arange(directions, dtype=np.int32), places)
    return Candidates(poses.reshape(-1, 4, 4), place, heading, up, description)


def _directions(first: Array, up: Array, azimuths: Array, pitches: Array) -> tuple[Array, Array]:
    """Forward and the camera's own up (pitches * azimuths, 3): of every pitch [deg] all azimuths [rad]."""
    pitch = np.repeat(np.radians(pitches), len(azimuths))[:, None]
    turn = np.tile(azimuths, len(pitches))[:, None]
    level = np.cos(turn) * first + np.sin(turn) * np.cross(up, first)
    return np.cos(pitch) * level + np.sin(pitch) * up, np.cos(pitch) * up - np.sin(pitch) * level


def _ranges(said: dict[str, str], around: Surroundings, axes: Array, which: int) -> Array:
    """(3, 2) lowest and highest place along each axis."""
    found = np.empty((3, 2))
    for axis, name in enumerate(AXES):
        if name in said:
            numbers = numbers_of("grid", name, said[name])
            if len(numbers) > 2 or (len(numbers) == 2 and numbers[0] >= numbers[1]):
                raise OptionError(
                    f"--poses grid: {name}={said[name]} is neither LO:HI with LO < HI nor a number"
                )
            found[axis] = numbers[0], numbers[-1]
        elif axis == which:
            if around.centre is None:
                raise OptionError(
                    f"--poses grid: the world's own camera stands nowhere; say how high: {name}=H"
                )
            found[axis] = around.centre @ axes[axis]
        else:
            if around.corners is None:
                raise OptionError(
                    f"--poses grid: nothing says how far this world reaches; say {name}=LO:HI [scene unit]"
                )
            along = around.corners @ axes[axis]
            margin = _MARGIN * np.ptp(along)
            found[axis] = along.min() + margin, along.max() - margin
        several = count_of("grid", f"n{name}", said)
        if several is not None and several > 1 and found[axis, 0] == found[axis, 1]:
            raise OptionError(f"--poses grid: n{name}={several} places need a range; say {name}=LO:HI")
    return found


def _target(text: str, around: Surroundings, world: Any) -> Array:
    if text in ("centre", "center"):
        if around.corners is None:
            raise OptionError("--poses around: this world has no centre; say target=X:Y:Z")
        return np.asarray(0.5 * (around.corners.min(axis=0) + around.corners.max(axis=0)))
    if re.fullmatch(r"[-+.\deE:\s]+", text):
        numbers = numbers_of("around", "target", text)
        if len(numbers) != 3:
            raise OptionError(f"--poses around: target={text} is not X:Y:Z, a shape's id or centre")
        return np.array(numbers)
    return shape_centre(world, text)
