"""Where a camera can be: not inside a solid, and not before nothing.

A position is inside a solid if most of the rays from it, evenly over the sphere, first meet a face that is
turned to the inside of something. Which face that is:

- of a material that is black from behind (one-sided), its back: walls of a room show their fronts to who is
  in it, and objects theirs to who is not;
- of any other material either face may be right, and a sheet has no inside. But what is closed has: a line
  through it crosses it an even number of times. Its inside is solid, unless the world's own camera is there:
  then it is a room. Of a world without a camera, what reaches as far as the world is one;
- of what is closed, one-sided, and turned inside out, but seen from outside by that camera, its front.

So sheets whose backs are seen in free space are outvoted, and glass is a solid.

A view is blocked if what it sees is nearer than the near plane, or nearly touches the lens, or shows its
black back; and outside if it sees nothing at all. Of a radiance field there are no faces: both follow from
depth and opacity of a few pixels.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..measure.field_view import FieldView
from ..measure.opening import open_measurable
from ..measure.options import MeasurementKeywords, MeasurementOptions
from ..radiance.field import Field
from ..render.lending import in_turn
from ..render.rays import coarse_grid
from ..se3 import Array
from .layout import BLOCKED, INSIDE, OUTSIDE, TO_DO
from .surface_hits import Hits, crossings, even_directions, hits, number_of
from .surroundings import box_corners, shape_box, surroundings

if TYPE_CHECKING:
    import mitsuba as mi

    from ..measure.measurable import Measurable

Status = NDArray[np.int8]

_DIRECTIONS = 64
"""Of a position's rays."""
_SOLID = 0.5
"""Share of them that have to meet insides."""
_DOUBTFUL = 0.1
"""Share from which on it takes whole lines to say."""
_AT_ONCE = 1 << 14
"""Positions, or views."""
_LINES = 128
"""Through each shape."""
_EVEN = 0.9
"""Share of the lines through what is closed that cross it an even number of times: some run along an edge."""
_HOLDS = 0.9
"""Share of the directions in which a position inside of something meets it."""
_LOOKS = 1024
"""Directions from the world's own camera."""
_WHOLE = 0.95
"""Of the world's box: what reaches as far is the world's shell."""
_ACROSS = 8
"""Pixels across and down through which a view looks."""
_ACROSS_FINELY = 32
"""The same where nothing was met."""
_TOUCHING = 1e-3
"""Of the scene's size: what is nearer fills the view."""
_TOUCHING_OF_FIELD = 0.02
"""Of the extent of a field's cameras, whose surfaces are not sharp."""
_FEW = 0.05
"""Share of the rays that meet something, up to which what else they show is nothing."""
_FAINT = 1.0 / 255.0
"""Opacity below which nothing is seen."""


@in_turn
def view_status(loaded: Any, poses: Array, options: MeasurementKeywords) -> Status:
    """What can be said of views before they are measured.

    Args:
        loaded: a scene or a field, from `as_world`.
        poses: (n, 4, 4) world_from_camera.
        options: of the measurement; their sensor, camera and size say what a view sees.

    Returns:
        (n,) of `layout`: TO_DO where nothing is wrong, else INSIDE, BLOCKED or OUTSIDE.
    """
    asked: MeasurementKeywords = {**options, "pose": poses[0]}
    with open_measurable(loaded, MeasurementOptions(**asked)) as view:
        if isinstance(view, FieldView):
            return _field_status(view, poses)
        status = _seen_status(loaded, view, poses)
    places, place = np.unique(poses[:, :3, 3], axis=0, return_inverse=True)
    inside = inside_solid(loaded, places, surroundings(loaded, options).centre)
    status[inside[place.ravel()]] = INSIDE
    return status


def inside_solid(scene: mi.Scene, places: Array, own: Array | None) -> NDArray[np.bool_]:
    """Which positions are inside a solid.

    Args:
        scene: of surfaces.
        places: (n, 3) [scene unit].
        own: (3,) where the scene's own camera is, which is in free space; None: nowhere.
    """
    corners = box_corners(scene)
    if corners is None:
        return np.zeros(len(places), dtype=np.bool_)
    inner = _inner_faces(scene, corners, own)
    directions = even_directions(_DIRECTIONS)
    share = np.empty(len(places))
    for start in range(0, len(places), _AT_ONCE):
        here = places[start : start + _AT_ONCE]
        met = hits(scene, np.repeat(here, _DIRECTIONS, axis=0), np.tile(directions, (len(here), 1)))
        share[start : start + _AT_ONCE] = (_side(met, inner) > 0).reshape(-1, _DIRECTIONS).mean(axis=1)
    (doubtful,) = np.nonzero((share > _DOUBTFUL) & (share <= _SOLID))
    for start in range(0, len(doubtful), _AT_ONCE):
        which = doubtful[start : start + _AT_ONCE]
        share[which] = _share_of_lines(scene, places[which], directions, inner)
    return np.asarray(share > _SOLID)


def _share_of_lines(scene: mi.Scene, places: Array, directions: Array, inner: dict[int, bool]) -> Array:
    """(n,) the share of rays that meet the inside of something or, of the shape that they meet first, more
    insides than outsides: of a solid that is put together from several, some outsides are within others."""
    corners = box_corners(scene)
    size = 0.0 if corners is None else float(np.linalg.norm(np.ptp(corners, axis=0)))
    origins = np.repeat(places, len(directions), axis=0)
    first, balance = (np.zeros(len(origins), dtype=np.int64) for _ in range(2))
    solid = np.zeros(len(origins), dtype=np.bool_)
    for step, (rays, met) in enumerate(
        crossings(scene, origins, np.tile(directions, (len(places), 1)), size)
    ):
        side = _side(met, inner)
        if step == 0:
            first[rays] = met.shape
            solid[rays] = side > 0
        balance[rays] += np.where(met.shape == first[rays], side, 0)
    return np.asarray((solid | (balance > 0)).reshape(len(places), -1).mean(axis=1))


def _side(met: Hits, inner: dict[int, bool]) -> NDArray[np.int64]:
    """(n,) 1 where the face that is met is turned to the inside of a solid, −1 to its outside, 0 neither.

    Args:
        inner: of shapes by their number whether that is their back; others' is if they are one-sided.
    """
    found = np.where(met.one_sided, np.where(met.back, 1, -1), 0)
    for number, back in inner.items():
        found = np.where(met.shape == number, np.where(met.back == back, 1, -1), found)
    return found


def _inner_faces(scene: mi.Scene, corners: Array, own: Array | None) -> dict[int, bool]:
    """Of closed shapes whose inside is solid, whether their back is turned to it; see the module.

    Those are left out of which the material tells as much.
    """
    low, high = corners.min(axis=0), corners.max(axis=0)
    size = float(np.linalg.norm(high - low))
    holding: set[int] = set()
    seen: set[int] = set()
    if own is not None:
        looks = even_directions(_LOOKS)
        met = crossings(scene, np.broadcast_to(own, looks.shape), looks, size)
        if met:
            seen = set(met[0][1].shape.tolist())
            for number in seen:
                odd = np.zeros(_LOOKS, dtype=np.int64)
                for rays, each in met:
                    odd[rays] += each.shape == number
                if np.mean(odd % 2) > _HOLDS:
                    holding.add(number)
    asked: list[int] = []
    boxes: list[Array] = []
    for shape in scene.shapes():
        box = shape_box(shape)
        shell = own is None and bool((np.ptp(box, axis=0) >= _WHOLE * (high - low)).all())
        if np.isfinite(box).all() and not shell and number_of(shape) not in holding:
            asked.append(number_of(shape))
            boxes.append(box)
    found = {}
    for number, (flipped, one_sided) in _seen_from_outside(scene, asked, boxes, size).items():
        if not one_sided or (flipped and number in seen):
            found[number] = not flipped
    return found


def _seen_from_outside(
    scene: mi.Scene, numbers: list[int], boxes: list[Array], size: float
) -> dict[int, tuple[bool, bool]]:
    """Of those shapes that are closed, whether they show their backs to the outside, and are one-sided.

    Args:
        numbers: of the shapes.
        boxes: (2, 3) lowest and highest corner of each.
        size: of the scene.
    """
    if not numbers:
        return {}
    within = np.random.default_rng(0).uniform(size=(_LINES, 3))
    through = np.concatenate([box[0] + within * (box[1] - box[0]) for box in boxes])
    directions = np.tile(even_directions(_LINES), (len(boxes), 1))
    wanted = np.repeat(numbers, _LINES)
    count = np.zeros(len(wanted), dtype=np.int64)
    back, one_sided, see_through = (np.zeros(len(wanted), dtype=np.bool_) for _ in range(3))
    for rays, met in crossings(scene, through - 2.0 * size * directions, directions, size):
        of_it = met.shape == wanted[rays]
        new = of_it & (count[rays] == 0)
        back[rays[new]] = met.back[new]
        one_sided[rays] |= of_it & met.one_sided
        see_through[rays] |= of_it & met.see_through
        count[rays] += of_it
    found = {}
    for k, number in enumerate(numbers):
        lines = slice(k * _LINES, (k + 1) * _LINES)
        crossed = count[lines] > 0
        even = count[lines][crossed] % 2 == 0
        if crossed.any() and even.mean() >= _EVEN and not see_through[lines].any():
            found[number] = bool(back[lines][crossed].mean() > 0.5), bool(one_sided[lines].any())
    return found


def _seen_status(scene: mi.Scene, view: Measurable, poses: Array) -> Status:
    """Of views of a scene, by what a few rays through their film meet."""
    corners = box_corners(scene)
    size = 0.0 if corners is None else float(np.linalg.norm(np.ptp(corners, axis=0)))
    nearest = max(view.camera.near, _TOUCHING * size)
    sky = scene.environment() is not None
    status = np.full(len(poses), TO_DO, dtype=np.int8)
    met, shown = _counted(scene, view, poses, nearest, _ACROSS)
    (nothing,) = np.nonzero(met == 0)
    if not sky and len(nothing):  # what is small may stand between so few rays
        met[nothing], shown[nothing] = _counted(scene, view, poses[nothing], nearest, _ACROSS_FINELY)
    status[(met > 0) & (shown <= _FEW * met)] = BLOCKED
    if not sky:
        status[met == 0] = OUTSIDE
    return status


def _counted(
    scene: mi.Scene, view: Measurable, poses: Array, nearest: float, across: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Of every view's rays (n,), those that meet something, and those that meet what can be seen of it.

    Args:
        nearest: depth up to which nothing is seen [scene unit].
        across: rays across the film, and down.
    """
    rays = view.camera.directions(coarse_grid(view.size, across).reshape(-1, 2) + 0.5)
    lengths = np.linalg.norm(rays, axis=1)
    met, shown = (np.empty(len(poses), dtype=np.int64) for _ in range(2))
    for start in range(0, len(poses), _AT_ONCE):
        some = poses[start : start + _AT_ONCE]
        world = np.einsum("nij,mj->nmi", some[:, :3, :3], rays / lengths[:, None])
        found = hits(scene, np.repeat(some[:, :3, 3], len(rays), axis=0), world.reshape(-1, 3))
        far = found.distance.reshape(len(some), -1) / lengths > nearest
        black = (found.back & found.one_sided).reshape(far.shape)
        any_met = found.met.reshape(far.shape)
        met[start : start + _AT_ONCE] = any_met.sum(axis=1)
        shown[start : start + _AT_ONCE] = (any_met & far & ~black).sum(axis=1)
    return met, shown


def _field_status(view: FieldView, poses: Array) -> Status:
    """Of views of a field, by depth and opacity of a few pixels."""
    pixels = coarse_grid(view.size, _ACROSS).reshape(-1, 2)
    touching = _TOUCHING_OF_FIELD * _extent(view.field, poses)
    status = np.full(len(poses), TO_DO, dtype=np.int8)
    for k, pose in enumerate(poses):
        shown = view.field.show(view.camera, pose, pixels)
        seen = shown.opacity > _FAINT
        if not seen.any():
            status[k] = OUTSIDE
        elif np.mean(shown.depth[seen] > touching) <= _FEW:
            status[k] = BLOCKED
    return status


def _extent(field: Field, poses: Array) -> float:
    """Of a field's cameras, or of those that are asked for [unit of the field]."""
    own = [viewpoint.pose[:3, 3] for viewpoint in field.viewpoints]
    centres = np.array(own) if len(own) > 1 else poses[:, :3, 3]
    return float(np.linalg.norm(np.ptp(centres, axis=0)))
