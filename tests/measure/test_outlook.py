"""A world from outside: points where its surfaces are, cameras where they stand."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mitsuba_crb.measure.outlook import POINTS, Looking, outlook

SCENES = Path(__file__).parents[2] / "scenes"


def test_points_lie_on_the_surface_and_corners_on_what_is_seen():
    found = outlook([Looking(SCENES / "textured_wall" / "textured_wall.xml", {"size": (32, 24)})])
    (sight,) = found.sights
    assert 0 < len(found.points) <= POINTS
    assert str(len(found.points)) in found.words
    assert np.ptp(found.points[:, 1]) < 1e-5  # the wall is across y
    assert sight.image is not None
    assert sight.image.shape == (24, 32, 3)
    wall = found.points[0, 1]
    directions = sight.corners @ sight.pose[:3, :3].T
    seen = sight.pose[:3, 3] + directions * ((wall - sight.pose[1, 3]) / directions[:, 1:2])
    inside = ((found.points > seen.min(axis=0) - 1e-3) & (found.points < seen.max(axis=0) + 1e-3)).all(axis=1)
    assert inside.sum() > len(found.points) / 4  # a third are what the camera sees
    again = outlook([Looking(SCENES / "textured_wall" / "textured_wall.xml", {"size": (32, 24)})])
    np.testing.assert_array_equal(found.points, again.points)


def test_nothing_at_a_finite_distance_has_no_points():
    found = outlook([Looking(SCENES / "sky" / "sky.xml", {"size": (16, 12)}, images=False)])
    assert len(found.points) == 0
    assert found.sights[0].image is None


def test_one_world_of_several_cameras_is_there_once():
    scene = SCENES / "warehouse" / "warehouse.xml"
    both = [Looking(scene, {"sensor": name, "size": (16, 12)}, names=(name,)) for name in ("racks", "duct")]
    found = outlook(both)
    assert [sight.name for sight in found.sights] == ["racks", "duct"]
    assert len(found.points) <= POINTS
    for sight in found.sights:  # what each looks at is there
        along = (found.points - sight.pose[:3, 3]) @ sight.pose[:3, :3]
        assert ((along[:, 2] > 0) & (np.abs(along[:, :2]) < along[:, 2:] * 0.3).all(axis=1)).sum() > 100
