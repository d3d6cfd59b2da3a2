"""A world and the cameras in it as somebody sees them from outside: points, frusta, small pictures.

For pages that show a result; nothing of it enters any number.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera, Intrinsics
from ..jacobian.method import Paths
from ..radiance.field import Field
from ..radiance.gaussians import Gaussians
from ..render.random import PILOT
from ..render.scene import SceneFile
from ..render.surface_points import surface_points
from .field_view import FieldView
from .measurable import Measurable
from .opening import as_world, open_measurable, wanted
from .options import MeasurementOptions

POINTS = 36_000
"""Of a world, at most."""
_LONGEST = 256
"""Pixels of a small picture's longer side, at most."""
_SPP = 16
_MOST_PICTURES = 48
_SOLID = 0.5
_DEGREE_0 = 0.28209479177387814
"""Of spherical harmonics, the constant one."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Sight:
    """One camera in the world."""

    name: str
    """As the result calls it."""
    pose: Floats
    """(4, 4) `world_from_camera`."""
    corners: Floats
    """(4, 3) directions of the image's corners at depth one in the camera's frame, around the image."""
    image: NDArray[np.float32] | None = None
    """(h, w, 3) a small render; None: there is none."""
    displayed: bool = False
    """Whether its values are those of a display, 1 is white; else radiance."""


@dataclass(frozen=True, eq=False)
class Outlook:
    """A world from outside."""

    points: Floats
    """(n, 3) [scene unit]."""
    colours: Floats
    """(n, 3) sRGB from 0 to 1."""
    normals: Floats
    """(n, 3) of surfaces; zero of what has none."""
    words: str
    """What the points are."""
    sights: tuple[Sight, ...]
    """The cameras."""


@dataclass(frozen=True, eq=False)
class Looking:
    """A world, and from where it is looked at."""

    world: Any
    """As for `pose_bound`."""
    options: Mapping[str, Any]
    """`MeasurementOptions`, of which those of the view count."""
    defines: Mapping[str, str] = field(default_factory=dict)
    """Of the world's file."""
    names: Sequence[str] = ("camera",)
    """Of its cameras."""
    poses: Sequence[Floats] | None = None
    """Of its cameras; None: of one, which the options say."""
    cameras: Sequence[Intrinsics] | None = None
    """Of each pose; None: as the options say."""
    images: bool = True
    """Whether to render small pictures."""


_OF_VIEW = ("sensor", "pose", "size", "camera", "integrator", "measure", "channels")


def outlook(places: Sequence[Looking]) -> Outlook:
    """The worlds that are looked at, those that are the same once, and all cameras.

    Raises:
        MitsubaCRBError: as `pose_bound`.
    """
    sights: list[Sight] = []
    worlds: dict[tuple[str, tuple[tuple[str, str], ...]], list[_Looked]] = {}
    for place in places:
        found = _looked(place)
        sights += found.sights
        worlds.setdefault((str(place.world), tuple(sorted(place.defines.items()))), []).append(found)
    parts = [_points(looked) for looked in worlds.values()]
    positions, colours, normals, words = zip(*parts, strict=True)
    return Outlook(
        np.concatenate(positions),
        np.concatenate(colours),
        np.concatenate(normals),
        "; ".join(dict.fromkeys(words)),
        tuple(sights),
    )


class _Looked(NamedTuple):
    """What became of looking at a world."""

    loaded: Any
    views: list[Measurable]
    sights: list[Sight]


def _looked(place: Looking) -> _Looked:
    options = {name: value for name, value in place.options.items() if name in _OF_VIEW}
    if place.poses is not None:
        options["pose"] = place.poses[0]
        if place.cameras is not None:
            options["camera"] = place.cameras[0]
    given = MeasurementOptions(**options)
    is_file = isinstance(place.world, str | Path)
    source = SceneFile(place.world, dict(place.defines)) if is_file else place.world
    loaded, _ = as_world(source, wanted(given))
    with open_measurable(loaded, given) as view:
        count = 1 if place.poses is None else len(place.poses)
        pictured = set(np.linspace(0, count - 1, min(count, _MOST_PICTURES)).round().astype(int).tolist())
        views: list[Measurable] = []
        for index in range(count):
            here: Measurable = view if place.poses is None else view.at(np.asarray(place.poses[index]))
            if place.cameras is not None and place.cameras[index] != place.cameras[0]:
                here = here.seen_through(place.cameras[index])
            views.append(here)
        sights = [
            Sight(
                name,
                here.pose,
                corners_of(here.camera),
                _small(here) if place.images and index in pictured else None,
                here.white is not None,
            )
            for index, (name, here) in enumerate(zip(place.names, views, strict=True))
        ]
        return _Looked(loaded, views, sights)


def corners_of(camera: Camera) -> Floats:
    """(4, 3) directions of the image's corners at depth one, around the image from the upper left."""
    width, height = camera.size
    corners = np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]])
    return np.asarray(camera.directions(corners))


def _small(view: Measurable) -> NDArray[np.float32]:
    """A render of every so many pixels; grey where nothing was measured."""
    width, height = view.size
    step = -(-max(width, height) // _LONGEST)
    x, y = np.meshgrid(np.arange(step // 2, width, step), np.arange(step // 2, height, step))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    values = view.start_image(pixels, Paths(_SPP, 0, 1), purpose=PILOT)()[0]
    return np.asarray(values.reshape(*x.shape, -1), dtype=np.float32)


def _points(looked: Sequence[_Looked]) -> tuple[Floats, Floats, Floats, str]:
    """Of one world, whose cameras these are."""
    loaded = looked[0].loaded
    if isinstance(loaded, Gaussians):
        return _of_splats(loaded)
    if isinstance(loaded, Field):
        return _of_field([view for each in looked for view in each.views])
    cameras = [(sight.pose, sight.corners) for each in looked for sight in each.sights]
    found = surface_points(loaded, cameras, POINTS)
    words = f"{len(found.positions)} random points of the scene's surfaces"
    return found.positions, to_srgb(found.colours), found.normals, words


def _of_splats(field: Gaussians) -> tuple[Floats, Floats, Floats, str]:
    """Centres, the more likely the more a splat covers."""
    splats = field.splats
    extents = np.sort(splats.scales, axis=1)
    weight = splats.opacities * np.minimum(
        extents[:, 1] * extents[:, 2], np.quantile(extents[:, 2], 0.9) ** 2
    )
    low, high = np.percentile(splats.means, (1.0, 99.0), axis=0)
    margin = 0.2 * (high - low)
    inside = ((splats.means >= low - margin) & (splats.means <= high + margin)).all(axis=1)
    weight = np.where(inside, weight, 0.0)
    count = min(POINTS, int(np.count_nonzero(weight)))
    if count == 0:
        return *np.zeros((3, 0, 3)), "no splats"
    index = np.random.default_rng(0).choice(len(weight), count, replace=False, p=weight / weight.sum())
    colours = np.clip(0.5 + _DEGREE_0 * splats.coefficients[index, 0].astype(np.float64), 0.0, 1.0)
    words = f"{count} of {len(splats)} splats, as points"
    return splats.means[index].astype(np.float64), colours, np.zeros((count, 3)), words


def _of_field(views: Sequence[Measurable]) -> tuple[Floats, Floats, Floats, str]:
    """What is half opaque along random rays of the cameras."""
    rng = np.random.default_rng(0)
    positions, colours = [], []
    for view in views:
        assert isinstance(view, FieldView)
        each = -(-POINTS // len(views))
        pixels = np.stack([rng.integers(0, n, each) for n in view.size], axis=1)
        shown = view.field.show(view.camera, view.pose, pixels)
        solid = np.isfinite(shown.depth) & (shown.depth > 0.0) & (shown.opacity >= _SOLID)
        local = shown.depth[solid, None] * view.camera.directions(pixels[solid] + 0.5)
        positions.append(local @ view.pose[:3, :3].T + view.pose[:3, 3])
        colours.append(np.clip(shown.values[solid], 0.0, 1.0))
    found = np.concatenate(positions)
    words = f"{len(found)} random points of what the cameras see"
    return found, np.concatenate(colours), np.zeros_like(found), words


def to_srgb(linear: NDArray[Any]) -> Floats:
    """Display values of linear ones, both from 0 to 1."""
    values = np.clip(np.asarray(linear, dtype=np.float64), 0.0, 1.0)
    return np.where(values <= 0.0031308, 12.92 * values, 1.055 * values ** (1 / 2.4) - 0.055)
