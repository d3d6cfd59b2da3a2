"""Candidate poses: every form stands where it says and looks where it says; every mistake is one line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from small_scenes import T, camera, scene
from small_splats import write_splats

from mitsuba_crb import se3
from mitsuba_crb.datasets.poses import load_poses
from mitsuba_crb.errors import MitsubaCRBError, OptionError, PoseError
from mitsuba_crb.planning.candidates import candidates_of, parse_candidates, plan_axes


def furnished() -> dict[str, Any]:
    """A room of 4 x 3 x 6, y up, with a box in it; the camera stands at (0.5, 1.2, -2)."""
    return scene(
        sensor=camera(origin=(0.5, 1.2, -2), target=(0, 0.5, 3)),
        walls={
            "type": "cube",
            "to_world": T().translate([0, 1.5, 0]).scale([2, 1.5, 3]),
            "flip_normals": True,
        },
        chest={"type": "cube", "id": "chest", "to_world": T().translate([1, 0.25, 1]).scale(0.25)},
    )


@pytest.fixture(scope="module")
def room() -> Any:
    """The same, loaded."""
    return mi.load_dict(furnished())


def centres(found: Any) -> np.ndarray:
    return np.asarray(found.poses[:, :3, 3])


def looks(found: Any) -> np.ndarray:
    return np.asarray(found.poses[:, :3, 2])


def test_a_grid_stands_on_the_plan_at_the_cameras_height(room: Any) -> None:
    found = parse_candidates("grid:nx=3,nz=4,headings=2", room)
    assert len(found) == 3 * 4 * 2
    np.testing.assert_allclose(found.up, [0, 1, 0])
    # The world's box without a twentieth at each end.
    np.testing.assert_allclose(np.unique(centres(found)[:, 0].round(6)), [-1.8, 0, 1.8], atol=1e-6)
    np.testing.assert_allclose(np.unique(centres(found)[:, 2].round(6)), [-2.7, -0.9, 0.9, 2.7], atol=1e-6)
    np.testing.assert_allclose(centres(found)[:, 1], 1.2, atol=1e-6)
    for pose in found.poses:
        np.testing.assert_allclose(se3.as_pose(pose), pose, atol=1e-12)
        np.testing.assert_allclose(pose[:3, 1], [0, 1, 0], atol=1e-12)


def test_places_and_headings_are_numbered(room: Any) -> None:
    found = parse_candidates("grid:nx=3,nz=4,headings=5,pitch=-20:10", room)
    np.testing.assert_array_equal(found.place, np.repeat(np.arange(12), 10))
    np.testing.assert_array_equal(found.heading, np.tile(np.arange(10), 12))
    for number in range(12):
        assert np.ptp(centres(found)[found.place == number], axis=0).max() == 0.0
    again = parse_candidates("grid:nx=3,nz=4,headings=5,pitch=-20:10", room)
    np.testing.assert_array_equal(found.poses, again.poses)


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z", "0.1:0.2:-1"])
def test_directions_are_even_about_up_and_counter_clockwise(room: Any, up: str) -> None:
    found = parse_candidates(f"grid:x=0,y=0,z=0,headings=8,pitch=-30,up={up}", room)
    assert len(found) == 8
    np.testing.assert_allclose(looks(found) @ found.up, -0.5, atol=1e-12)  # sin 30°
    level = looks(found) + 0.5 * found.up
    level /= np.linalg.norm(level, axis=1, keepdims=True)
    turned = np.cross(level, np.roll(level, -1, axis=0)) @ found.up
    np.testing.assert_allclose(turned, np.sin(np.pi / 4), atol=1e-12)
    assert np.all(found.poses[:, :3, 1] @ found.up > 0.8)
    axes, which = plan_axes(found.up)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) > 0
    np.testing.assert_allclose(level[0], axes[0 if which else 1], atol=1e-12)


def test_spacing_stands_in_the_middle_of_a_range(room: Any) -> None:
    found = parse_candidates("grid:x=0:1,z=-1:1,spacing=0.4,headings=1", room)
    np.testing.assert_allclose(np.unique(centres(found)[:, 0].round(9)), [0.1, 0.5, 0.9])
    np.testing.assert_allclose(
        np.unique(centres(found)[:, 2].round(9)), [-1, -0.6, -0.2, 0.2, 0.6, 1], atol=1e-9
    )
    assert found.description["spacing"][0] == pytest.approx(0.4)
    assert found.description["shape"] == [3, 1, 6]


def test_a_grid_of_heights(room: Any) -> None:
    found = parse_candidates("grid:nx=2,nz=2,y=0.5:1.5,ny=3,headings=1", room)
    np.testing.assert_allclose(centres(found)[:, 1], np.repeat([0.5, 1.0, 1.5], 4), atol=1e-12)


def test_a_pitch_of_ninety_degrees_looks_straight_down(room: Any) -> None:
    found = parse_candidates("grid:x=0,z=0,headings=4,pitch=-90", room)
    np.testing.assert_allclose(looks(found), np.tile([0, -1, 0], (4, 1)), atol=1e-12)
    assert np.linalg.matrix_rank(found.poses[:, :3, 1]) == 2


@pytest.mark.parametrize(
    ("target", "middle"), [("1:0.25:1", (1, 0.25, 1)), ("chest", (1, 0.25, 1)), ("centre", (0, 1.5, 0))]
)
def test_around_looks_at_its_target(room: Any, target: str, middle: tuple[float, ...]) -> None:
    found = parse_candidates(f"around:target={target},radius=1.5,elevations=10:40,count=6", room)
    assert len(found) == 12
    np.testing.assert_array_equal(found.place, np.arange(12))
    np.testing.assert_array_equal(found.heading, 0)
    np.testing.assert_allclose(centres(found) + 1.5 * looks(found), np.tile(middle, (12, 1)), atol=1e-5)
    height = (centres(found) - middle) @ found.up / 1.5
    np.testing.assert_allclose(np.degrees(np.arcsin(height)), np.repeat([10, 40], 6), atol=1e-4)
    assert np.all(found.poses[:, :3, 1] @ found.up > 0.7)
    # The first stands on the plan's first axis.
    first = centres(found)[0] - middle
    np.testing.assert_allclose(first[[0, 2]], [1.5 * np.cos(np.radians(10)), 0], atol=1e-5)
    for pose in found.poses:
        np.testing.assert_allclose(se3.as_pose(pose), pose, atol=1e-12)


def test_a_file_of_poses_is_read_and_its_places_are_counted(tmp_path: Path, room: Any) -> None:
    poses = [se3.exp([x, 0, 0, 0, turn, 0]) for x, turn in ((0, 0), (1, 0.0), (0, 0.0), (2, 0), (1, 0.0))]
    for k, turn in enumerate((0.1, 0.2, 0.3, 0.4, 0.5)):
        poses[k] = poses[k] @ se3.exp([0, 0, 0, 0, turn, 0])
    np.save(tmp_path / "poses.npy", np.array(poses))
    found = parse_candidates(tmp_path / "poses.npy", room)
    np.testing.assert_allclose(found.poses, poses, atol=1e-12)
    assert found.place.tolist() == [0, 1, 0, 2, 1]
    assert found.heading.tolist() == [0, 0, 1, 0, 1]
    np.testing.assert_allclose(found.up, [0, 1, 0])
    assert found.description["kind"] == "file"
    opencv = parse_candidates(str(tmp_path / "poses.npy"), room, convention="opencv")
    np.testing.assert_allclose(opencv.up, [0, -1, 0])


def test_up_is_an_axis_only_if_the_cameras_nearly_say_so() -> None:
    tilted = se3.exp([0, 0, 0, np.radians(30), 0, 0])
    np.testing.assert_allclose(candidates_of([tilted]).up, tilted[:3, 1])
    nearly = se3.exp([0, 0, 0, np.radians(10), 0, 0])
    np.testing.assert_allclose(candidates_of([nearly]).up, [0, 1, 0])
    np.testing.assert_allclose(candidates_of([nearly], up=(0, 0, 2)).up, [0, 0, 1])


def test_a_fields_region_is_where_its_cameras_are(tmp_path: Path) -> None:
    (tmp_path / "beside").mkdir()
    (tmp_path / "alone").mkdir()
    splats = write_splats(tmp_path / "beside", cameras=2)
    poses = load_poses(tmp_path / "beside" / "cameras.json").poses
    found = parse_candidates("grid:headings=4,nx=2,ny=2,nz=2,x=0:1,y=0:1,z=0:1", splats)
    np.testing.assert_allclose(found.up, candidates_of(poses).up)
    with pytest.raises(OptionError, match="without shapes"):
        parse_candidates("around:target=chest,radius=1", splats)
    np.testing.assert_allclose(
        looks(parse_candidates("around:radius=1,count=1,elevations=0", splats))[0]
        + centres(parse_candidates("around:radius=1,count=1,elevations=0", splats))[0],
        0.5 * (poses[:, :3, 3].min(axis=0) + poses[:, :3, 3].max(axis=0)),
        atol=1e-9,
    )
    alone = write_splats(tmp_path / "alone", cameras=0)
    with pytest.raises(OptionError, match="up=z"):
        parse_candidates("grid:nx=3", alone)
    with pytest.raises(OptionError, match="how far"):
        parse_candidates("grid:nx=3,up=y,y=0", alone)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("grid:nx=3,heading=4", "did you mean headings"),
        ("grid:zzz=3", "it has x, y, z, nx"),
        ("grid:nx", "nx has no value"),
        ("grid:nx=", "nx has no value"),
        ("grid:nx=3,nx=4", "twice"),
        ("grid:nx=0", "whole number from 1"),
        ("grid:nx=2.5", "whole number from 1"),
        ("grid:headings=-3", "whole number from 1"),
        ("grid:x=1:0", "LO < HI"),
        ("grid:x=0:1:2", "LO:HI"),
        ("grid:x=zero:1", "number"),
        ("grid:x=nan:1", "number"),
        ("grid:spacing=0", "positive"),
        ("grid:spacing=-1", "positive"),
        ("grid:pitch=100", "-90 to 90"),
        ("grid:pitch=10:10", "different angles"),
        ("grid:up=w", "x, y, z"),
        ("grid:up=0:0:0", "x, y, z"),
        ("grid:ny=3", "y=LO:HI"),
        ("grid:nx=30000,nz=30000", "more than 10000000"),
        ("grid:spacing=1e-9", "more than 10000000"),
        ("around:target=centre", "radius=R"),
        ("around:radius=1,target=chst", "chest"),
        ("around:radius=1,target=1:2", "X:Y:Z"),
        ("around:radius=1:2", "one positive"),
        ("around:radius=1,elevation=3", "did you mean elevations"),
        ("gird:nx=3", "did you mean grid:"),
        ("grid", "did you mean grid:"),
        ("orbit:nx=3", "orbit:nx=3"),
        ("missing.txt", "missing.txt"),
    ],
)
def test_a_mistake_is_one_line_that_names_the_cure(room: Any, text: str, words: str) -> None:
    with pytest.raises((OptionError, PoseError)) as caught:
        parse_candidates(text, room)
    assert isinstance(caught.value, MitsubaCRBError)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_convention_is_of_a_file(room: Any) -> None:
    with pytest.raises(OptionError, match="leave it out"):
        parse_candidates("grid:nx=2", room, convention="opencv")


def test_a_world_whose_camera_stands_nowhere_has_to_be_told_what_is_up() -> None:
    room = furnished()
    lost = {**room, "camera": {**room["camera"], "to_world": T(np.full((4, 4), np.nan))}}
    with pytest.raises(OptionError, match="up=z"):
        parse_candidates("grid:nx=2", lost)
    with pytest.raises(OptionError, match="how high: y=H"):
        parse_candidates("grid:nx=2,up=y", lost)
    assert len(parse_candidates("grid:nx=2,nz=2,up=y,y=1", lost)) == 4 * 8
