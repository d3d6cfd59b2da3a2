"""How far finite differences step: where the film moves fastest, and where a cut runs over it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from small_scenes import T, scene

from mitsuba_crb import pose_bound
from mitsuba_crb.jacobian import finite_difference
from mitsuba_crb.jacobian.clip_planes import cut_speeds, cuts_by_far_plane, cuts_by_near_plane
from mitsuba_crb.jacobian.finite_difference import steps_of
from mitsuba_crb.noise import Gaussian
from mitsuba_crb.render.view import open_view

pytestmark = pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")

SIGMA = Gaussian(0.01)
METHODS = ("flow", "finite_difference")


def camera(fov: float, **more: Any) -> dict[str, Any]:
    film = {"type": "hdrfilm", "width": 24, "height": 18, "rfilter": {"type": "gaussian"}}
    towards = T().look_at([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0])
    return {"type": "perspective", "fov": fov, "film": film, "to_world": towards, **more}


def tilted(degrees: float, clip: str, x: float = 0.02) -> dict[str, Any]:
    """A shining wall through (x, 0, 3), turned about y; the near or the far plane cuts it upright there."""
    glow = {"type": "area", "radiance": {"type": "rgb", "value": 1.0}}
    place = T().translate([x, 0.0, 3.0]).rotate([0, 1, 0], 180 + degrees).scale([20.0, 20.0, 1.0])
    wall = {"type": "rectangle", "to_world": place, "emitter": glow}
    return {"type": "scene", "sensor": camera(30.0, **{clip: 3.0}), "wall": wall}


@pytest.mark.parametrize("clip", ["far_clip", "near_clip"])
@pytest.mark.parametrize("method", METHODS)
def test_a_cut_moves_as_steeply_as_its_wall_faces_the_camera(method: str, clip: str) -> None:
    """Closed form: an upright edge moves n_z/n_x times as far by z as by x, and n·q/n_x by a turn."""
    degrees = 8.0
    bound = pose_bound(tilted(degrees, clip), SIGMA, method=method, spp=256)
    F = bound.information.matrix
    steep = 1.0 / np.tan(np.radians(degrees))
    assert F[2, 2] / F[0, 0] == pytest.approx(steep**2, rel=0.05)
    # A yaw moves it by (−z, 0, x) at (x, ·, z) = (0.02, ·, 3).
    assert F[4, 4] / F[0, 0] == pytest.approx((3.0 - 0.02 * steep) ** 2, rel=0.05)


@pytest.mark.filterwarnings("ignore:nothing is visible")
@pytest.mark.parametrize("x", [-0.85, 0.85])
def test_a_cut_just_beyond_the_film_is_found_as_far_as_filters_reach(x: float) -> None:
    """0.7 pixels beyond it: no pixel's middle sees the cut, and all of the information is its own."""
    F = pose_bound(tilted(8.0, "far_clip", x), SIGMA, spp=2048).information.matrix
    assert F[2, 2] / F[0, 0] == pytest.approx(1.0 / np.tan(np.radians(8.0)) ** 2, rel=0.15)


def test_the_same_by_the_steps_of_what_is_seen_is_far_too_little(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(finite_difference, "cut_speeds", lambda view, film: np.empty((0, 6)))
    F = pose_bound(tilted(8.0, "far_clip"), SIGMA, method="finite_difference", spp=256).information.matrix
    assert F[2, 2] / F[0, 0] < 0.8 / np.tan(np.radians(8.0)) ** 2


def test_speeds_of_cuts_are_those_of_the_edge() -> None:
    with open_view(tilted(8.0, "far_clip")) as view:
        speeds = cut_speeds(view, cuts_by_far_plane(view))
        focal = view.camera.focal_length
    steep = 1.0 / np.tan(np.radians(8.0))
    assert len(speeds) > 10
    np.testing.assert_allclose(
        np.median(speeds[:, :3], axis=0), [focal / 3, 0.0, steep * focal / 3], atol=0.1
    )
    with open_view(scene()) as view:
        none = np.concatenate([cuts_by_near_plane(view), cuts_by_far_plane(view)])
        assert cut_speeds(view, none).shape == (0, 6)


@pytest.mark.parametrize("fov", [30.0, 110.0])
def test_no_turn_moves_any_point_of_the_film_farther_than_the_step(fov: float) -> None:
    offset = {"principal_point_offset_x": 0.2}
    with open_view({**scene(), "sensor": camera(fov, **offset)}) as view:
        steps = steps_of(view, 0.1)[3:5]
        corners = np.array([[0, 0], [0, 18], [24, 0], [24, 18], [12, 9]], dtype=np.float64)
        flow = view.camera.flow(view.camera.directions(corners))[:, :, 3:5]
    motion = np.linalg.norm(flow, axis=1) * steps
    assert motion.max() == pytest.approx(0.1, rel=1e-6)


@pytest.mark.slow
def test_turns_of_a_wide_field_agree_with_flow_where_all_is_in_a_corner() -> None:
    """A yaw moves it twice as fast as in the middle: by steps for the middle 20 % were lost."""
    glow = {"type": "area", "radiance": {"type": "rgb", "value": 1.0}}
    place = T().translate([1.9, 1.1, 2.0]).rotate([0, 1, 0], 180).scale(0.3)
    lamp = {"type": "rectangle", "to_world": place, "emitter": glow}
    world = {"type": "scene", "sensor": camera(100.0), "lamp": lamp}
    flow, other = (pose_bound(world, SIGMA, method=method, spp=1024, seed=3) for method in METHODS)
    ratio = np.diag(other.information.matrix) / np.diag(flow.information.matrix)
    np.testing.assert_allclose(ratio, 1.0, atol=0.05)
