"""Inside and free, blocked and outside, of solids and sheets whatever way they are turned."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from small_scenes import T, camera, scene
from small_splats import write_splats

from mitsuba_crb import se3
from mitsuba_crb.measure.opening import as_world
from mitsuba_crb.planning.candidates import parse_candidates
from mitsuba_crb.planning.free_space import inside_solid, view_status
from mitsuba_crb.planning.layout import BLOCKED, INSIDE, OUTSIDE, TO_DO

OWN = (0.0, 0.0, -2.0)


def paint(value: float) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": value}}


# Mitsuba makes one mesh of those of one material.
GREY, WALLS = paint(0.5), paint(0.6)
BOTH, BOTH_WALLS = ({"type": "twosided", "bsdf": bsdf} for bsdf in (GREY, WALLS))
GLASS = {"type": "dielectric"}
CHEST = (1.0, 0.0, 1.0)


def box(middle: Any, half: Any, bsdf: Any, *, flipped: bool = False) -> dict[str, Any]:
    """A cube, whose normals point outwards unless it is flipped."""
    return {
        "type": "cube",
        "to_world": T().translate(list(middle)).scale(half),
        "flip_normals": flipped,
        "bsdf": bsdf,
    }


def sheet(middle: Any, towards: Any, half: float, bsdf: Any) -> dict[str, Any]:
    """A square whose normal points to a point."""
    up = [1, 0, 0] if towards[1] != middle[1] else [0, 1, 0]
    return {
        "type": "rectangle",
        "to_world": T().look_at(list(middle), list(towards), up).scale(half),
        "bsdf": bsdf,
    }


def inside(places: Any, *, own: Any = OWN, **objects: Any) -> list[bool]:
    loaded = mi.load_dict(scene(sensor=camera(origin=OWN, target=(0, 0, 1)), **objects))
    return inside_solid(
        loaded, np.array(places, dtype=np.float64), None if own is None else np.array(own)
    ).tolist()


@pytest.mark.parametrize("walls", [WALLS, BOTH_WALLS], ids=["one-sided walls", "two-sided walls"])
@pytest.mark.parametrize("chest", [GREY, BOTH, GLASS], ids=["one-sided", "two-sided", "glass"])
def test_a_box_in_a_room_is_solid_and_the_room_is_not(walls: Any, chest: Any) -> None:
    room = {"room": box((0, 0, 0), (3, 2, 3), walls, flipped=True), "chest": box(CHEST, 0.4, chest)}
    places = [CHEST, (1.2, 0.3, 0.8), (0, 0, 0), (-2, 1, 2), (1, 0.6, 1), OWN]
    assert inside(places, **room) == [True, True, False, False, False, False]


def test_a_room_whose_walls_face_outwards_is_the_cameras_if_it_is_in_it() -> None:
    room = {"room": box((0, 0, 0), (3, 2, 3), BOTH_WALLS), "chest": box(CHEST, 0.4, BOTH)}
    places = [CHEST, (0, 0, 0), (-2, 1, 2)]
    assert inside(places, **room) == [True, False, False]
    # Negative control: of a camera outside of it, the same thing is a solid.
    assert inside(places, own=(0, 0, -9), **room)[1:] == [True, True]
    # Without any camera, what reaches as far as the world is a shell.
    assert inside(places, own=None, **room) == [True, False, False]


@pytest.mark.parametrize("material", [GREY, BOTH], ids=["one-sided", "two-sided"])
def test_a_box_that_is_turned_inside_out_is_solid(material: Any) -> None:
    room = {
        "room": box((0, 0, 0), (3, 2, 3), WALLS, flipped=True),
        "chest": box(CHEST, 0.4, material, flipped=True),
    }
    assert inside([CHEST, (0, 0, 0), (1, 0.7, 1)], **room) == [True, False, False]


def test_another_room_whose_walls_face_inwards_is_free() -> None:
    rooms = {
        "room": box((0, 0, 0), (3, 2, 3), WALLS, flipped=True),
        "other": box((8, 0, 0), (3, 2, 3), paint(0.7), flipped=True),
        "chest": box((9, 0, 0), 0.5, GREY),
    }
    assert inside([(0, 0, 0), (7, 0, 0), (9, 0, 0)], **rooms) == [False, False, True]


@pytest.mark.parametrize("turned", [-1.0, 1.0], ids=["backs inside", "fronts inside"])
@pytest.mark.parametrize("material", [GREY, BOTH], ids=["one-sided", "two-sided"])
def test_between_two_sheets_is_solid_only_where_their_black_backs_are(turned: float, material: Any) -> None:
    sheets = {
        f"sheet{side:+d}": sheet((0, side, 0), (0, side * (1 - 0.5 * turned), 0), 40.0, material)
        for side in (-1, 1)
    }
    places = [(0, 0.0, 0.5), (3, 0.5, 2), (0, 4, 0)]
    expected = [turned < 0 and material is GREY] * 2 + [False]
    assert inside(places, own=(0, 0, -1) if turned > 0 else (0, 5, 0), **sheets) == expected


def test_a_few_sheets_that_show_their_backs_are_outvoted() -> None:
    room = {"room": box((0, 0, 0), (3, 2, 3), WALLS, flipped=True)}
    sheets = {
        "screen": sheet((0.5, 0, 0), (2, 0, 0), 1.0, GREY),
        "picture": sheet((0, 0, 2.5), (0, 0, 9), 1.0, GREY),
    }
    place = [(0.2, 0, 0), (0, 0, 2), (-1, 0, 0)]
    assert inside(place, **room, **sheets) == [False, False, False]
    # Negative control: shut in by such sheets on all sides it is no free space.
    shut = {
        f"sheet{axis}{'-+'[side > 0]}": sheet(
            np.array((0, 0, 0)) + 0.5 * side * np.eye(3)[axis], 4.0 * side * np.eye(3)[axis], 0.5, GREY
        )
        for axis in range(3)
        for side in (-1, 1)
    }
    assert inside([(0, 0, 0)], **room, **shut) == [True]


def test_fog_is_no_solid() -> None:
    fog = box((0, 0, 0), (1, 1, 1), {"type": "null"})
    room = box((0, 0, 0), (3, 2, 3), WALLS, flipped=True)
    assert inside([(0, 0, 0)], room=room, fog=fog) == [False]
    # Negative control: the same box of glass.
    assert inside([(0, 0, 0)], room=room, fog=box((0, 0, 0), (1, 1, 1), GLASS)) == [True]


def pose(origin: Any, target: Any) -> np.ndarray:
    up = [0, 1, 0] if origin[0] != target[0] or origin[2] != target[2] else [0, 0, 1]
    return np.array(T().look_at(list(origin), list(target), up).matrix, dtype=np.float64)


def statuses(views: Any, **objects: Any) -> list[int]:
    loaded = mi.load_dict(scene(sensor=camera(origin=OWN, target=(0, 0, 1)), **objects))
    return view_status(loaded, np.array([pose(*view) for view in views]), {}).tolist()


def test_what_a_view_sees_decides_whether_it_is_blocked() -> None:
    room = {"room": box((0, 0, 0), (3, 2, 3), WALLS, flipped=True), "chest": box(CHEST, 0.4, GREY)}
    views = [
        ((0, 0, 0), (1, 0, 0)),
        ((0, 0, 2.999), (0, 0, 4)),  # a millimetre before a wall
        ((0, 0, 2.999), (0, 0, 0)),  # from there into the room
        (CHEST, (0, 0, 0)),
        ((0, 0, 5), (0, 0, 0)),  # the wall's black back, from outside
    ]
    assert statuses(views, **room) == [TO_DO, BLOCKED, TO_DO, INSIDE, BLOCKED]


def test_who_looks_away_from_everything_is_outside_unless_there_is_a_sky() -> None:
    away = [((0, 0, -9), (0, 0, -20)), ((0, 0, -9), (0, 0, 0))]
    chest = box((0, 0, 0), 0.5, BOTH)
    assert statuses(away, chest=chest) == [TO_DO, TO_DO]
    lamp = {"type": "point", "position": [0, 5, -5], "intensity": {"type": "rgb", "value": 10.0}}
    assert statuses(away, chest=chest, light=lamp) == [OUTSIDE, TO_DO]


def test_the_furnished_room(scenes: Path) -> None:
    loaded, _ = as_world(scenes / "textured_room" / "textured_room.xml")
    names = {
        "middle": (0.0, 0.5, 1.3),
        "sofa's seat": (-1.1, 3.3, 0.3),
        "sofa's back": (-0.55, 3.6, 0.45),
        "table's top": (-0.35, 1.75, 0.405),
        "vase": (-0.12, 1.72, 0.57),
        "above the rug": (-0.4, 1.2, 0.1),
        "book case's side": (2.11, 3.66, 1.0),
        "before the far wall": (1.0, 3.2, 1.5),
        "under the lamp": (0.7, 3.3, 0.5),
        "outside, left": (-4.0, 1.0, 1.0),
    }
    found = inside_solid(loaded, np.array(list(names.values())), np.array((0.85, -0.75, 1.5)))
    solid = {name for name, is_inside in zip(names, found, strict=True) if is_inside}
    assert {"sofa's seat", "sofa's back", "vase"} <= solid
    assert not {"middle", "above the rug", "before the far wall", "under the lamp"} & solid
    # From outside, facing the room: its walls' backs; facing away: nothing.
    views = np.array([pose_z((-4.0, 1.0, 1.0), (0, 1, 1)), pose_z((-4.0, 1.0, 1.0), (-9, 1, 1))])
    assert view_status(loaded, views, {}).tolist() == [BLOCKED, OUTSIDE]


def pose_z(origin: Any, target: Any) -> np.ndarray:
    return np.array(T().look_at(list(origin), list(target), [0, 0, 1]).matrix, dtype=np.float64)


def test_equal_positions_and_other_orders_have_equal_answers(scenes: Path) -> None:
    loaded, _ = as_world(scenes / "textured_room" / "textured_room.xml")
    found = parse_candidates("grid:z=0.3,nx=6,ny=5,headings=2", loaded)
    status = view_status(loaded, found.poses, {})
    assert {TO_DO, INSIDE} < set(status.tolist())
    order = np.random.default_rng(0).permutation(len(status))
    np.testing.assert_array_equal(view_status(loaded, found.poses[order], {}), status[order])
    for number in np.unique(found.place):
        here = status[found.place == number] == INSIDE
        assert here.all() or not here.any()


def test_a_field_is_judged_by_its_picture(tmp_path: Path) -> None:
    field, _ = as_world(write_splats(tmp_path))
    ahead, back = np.eye(4), se3.exp([0, 0, 0, 0, np.pi, 0])
    assert view_status(field, np.array([ahead, back]), {}).tolist() == [TO_DO, OUTSIDE]


def test_the_cameras_lens_decides_what_it_sees() -> None:
    """A narrow view between two posts sees nothing, a wide one does."""
    posts = {f"post{x:+d}": box((2.0 * x, 0, 4), 0.3, GREY) for x in (-1, 1)}
    lamp = {"type": "point", "position": [0, 5, 0], "intensity": {"type": "rgb", "value": 10.0}}
    found = []
    for fov in (10, 90):
        sensor = camera(origin=(0, 0, 0), target=(0, 0, 1), fov=fov)
        loaded = mi.load_dict(scene(sensor=sensor, **posts, light=lamp))
        found += view_status(loaded, np.array([pose((0, 0, 0), (0, 0, 1))]), {}).tolist()
    assert found == [OUTSIDE, TO_DO]
