"""Rays of calibrated cameras: where they go, when they are the sensor's own, and what is refused."""

from __future__ import annotations

import gc
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from small_scenes import camera, scene, texture, textured_wall, wall

from mitsuba_crb import pose_bound
from mitsuba_crb.camera import Intrinsics
from mitsuba_crb.errors import CameraError, OptionError
from mitsuba_crb.noise import Gaussian
from mitsuba_crb.render.arrays import upload
from mitsuba_crb.render.rays import camera_ray
from mitsuba_crb.render.view import View, open_view

ZEROS = (0.0,) * 8
BARREL = (-0.3, 0.08, 1e-3, -7e-4, 0.0, 0.0, 0.0, 0.0)
PINCUSHION = (0.3, -0.02, -2e-3, 1e-3, 0.0, 0.0, 0.0, 0.0)
THIN = {"type": "thinlens", "aperture_radius": 0.2, "focus_distance": 2.5}

pytestmark = pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")


def directions(view: View, film: np.ndarray) -> np.ndarray:
    """(n, 3) of rays through film points, at depth one."""
    points = mi.Point2f(*(upload(mi.Float, x) for x in film.T))
    d = np.array(camera_ray(view, points, mi.Point2f(0.5, 0.5))[0].d, dtype=np.float64).T
    return d / d[:, 2:]


def own_intrinsics(width: int = 32, height: int = 24, fov: float = 45.0) -> Intrinsics:
    """Those of the small scenes' camera."""
    f = 0.5 * width / np.tan(np.radians(0.5 * fov))
    return Intrinsics((width, height), (f, f), (0.5 * width, 0.5 * height))


@pytest.mark.parametrize(
    ("model", "k", "focal"),
    [
        ("pinhole", (), (500.0, 480.0)),
        ("opencv", BARREL, (500.0, 480.0)),
        ("opencv", PINCUSHION, (500.0, 480.0)),
        ("opencv", (-0.25, 0.08, 0.03, -0.02, 0.01, 0.1, 0.0, 0.0), (450.0, 440.0)),
        ("fisheye", (-0.02, 0.01, -0.004, 5e-4), (320.0, 310.0)),
    ],
    ids=["pinhole", "barrel", "pincushion", "skew", "fisheye"],
)
@pytest.mark.parametrize("fov", [5.0, 90.0])
def test_rays_land_where_they_come_from(
    model: str, k: tuple[float, ...], focal: tuple[float, float], fov: float
) -> None:
    """Within 3e-4 pixel, twice the sensor's own rounding, whatever the sensor's own field of view."""
    calibration = Intrinsics((640, 480), focal, (310.0, 250.0), model, k)
    film = np.random.default_rng(0).uniform([-2.0, -2.0], [642.0, 482.0], (4096, 2)).astype(np.float32)
    with open_view(textured_wall(sensor=camera(fov=fov)), camera=calibration) as view:
        assert view.size == (640, 480)
        np.testing.assert_allclose(view.camera.project(directions(view, film)), film, atol=3e-4)
        # x is left and y up in the camera, right and down in the image.
        left, right = directions(view, np.array([[0.0, 240.0], [640.0, 240.0]]))
        assert left[0] > 0.0 > right[0]


def test_a_thin_lens_may_have_another_focal_length_but_no_distortion() -> None:
    which = textured_wall(sensor=camera() | THIN)
    calibration = Intrinsics((32, 24), (30.0, 28.0), (15.0, 13.0))
    with open_view(which, camera=calibration) as view:
        film = np.array([[3.0, 4.0], [30.0, 20.0]])
        np.testing.assert_allclose(view.camera.project(directions(view, film)), film, atol=1e-4)
        assert (view.camera.radius, view.camera.focus) == pytest.approx((0.2, 2.5))
    bent = Intrinsics((32, 24), (30.0, 28.0), (15.0, 13.0), "opencv", (-0.1, *ZEROS[1:]))
    with pytest.raises(CameraError, match="opencv distorts, and sensor camera is a thinlens"):
        pose_bound(which, Gaussian(0.01), camera=bent, spp=16)


def information(camera_: Intrinsics | None, method: str = "flow", **options: Any) -> np.ndarray:
    ball = {"type": "sphere", "radius": 0.4, "center": [0.2, 0.1, 2.0]}
    which = scene(wall=wall(texture(cells=16)), ball=ball)
    return pose_bound(
        which, Gaussian(0.01), camera=camera_, spp=16, method=method, **options
    ).information.matrix


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.BlindSpotWarning")
@pytest.mark.parametrize(
    "method", ["flow", "finite_difference", pytest.param("forward", marks=pytest.mark.slow)]
)
def test_a_lens_without_coefficients_is_a_pinhole_to_the_bit(method: str) -> None:
    own = own_intrinsics()
    zero = Intrinsics(own.size, own.focal, own.centre, "opencv", ZEROS)
    expected = information(None, method)
    np.testing.assert_array_equal(information(own, method), expected)
    np.testing.assert_array_equal(information(zero, method), expected)
    other = Intrinsics(own.size, (30.0, 31.0), (15.0, 13.0))
    expected = information(other, method)
    zero = Intrinsics(other.size, other.focal, other.centre, "opencv", ZEROS)
    np.testing.assert_array_equal(information(zero, method), expected)
    # A fisheye without coefficients is equidistant.
    fisheye = Intrinsics(other.size, other.focal, other.centre, "fisheye", (0.0,) * 4)
    assert not np.allclose(information(fisheye, method), expected, rtol=1e-2)


@pytest.mark.slow
def test_a_size_scales_the_calibration() -> None:
    large = own_intrinsics(64, 48)
    np.testing.assert_array_equal(information(large, size=(32, 24)), information(None))
    bound = pose_bound(textured_wall(), Gaussian(0.01), camera=large, size=(32, 24), spp=16)
    assert bound.provenance["size"] == [32, 24]
    assert bound.provenance["camera"]["focal"] == pytest.approx([0.5 * large.focal[0]] * 2)
    assert bound.provenance["camera_scaled_from"] == [64, 48]
    with pytest.raises(CameraError, match="of 64x48 pixels, and 32x32 is another shape"):
        information(large, size=(32, 32))


def test_the_calibration_s_size_wins_over_the_film_s() -> None:
    bound = pose_bound(textured_wall(), Gaussian(0.01), camera=own_intrinsics(16, 16), spp=16)
    assert bound.provenance["size"] == [16, 16]
    assert bound.provenance["fov_deg"] == pytest.approx([45.0, 45.0])


def test_what_is_no_calibration_is_refused() -> None:
    with pytest.raises(OptionError, match="camera must be Intrinsics"):
        pose_bound(textured_wall(), camera="camera.yaml")  # type: ignore[arg-type]


@pytest.mark.slow
def test_another_calibration_needs_no_other_kernel() -> None:
    """Its numbers are kernel input."""
    gc.collect()  # BSDFs of earlier scenes are part of a kernel's virtual calls while they live
    which, own = mi.load_dict(textured_wall()), own_intrinsics()
    used: list[set[str]] = []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for k1 in (-0.1, -0.2, 0.15):
            calibration = Intrinsics(own.size, own.focal, own.centre, "opencv", (k1, *ZEROS[1:]))
            dr.kernel_history_clear()
            pose_bound(which, Gaussian(0.01), camera=calibration, spp=16)
            used.append({kernel["hash"] for kernel in dr.kernel_history([dr.KernelType.JIT])})
    assert len(used[0]) > 5
    assert set().union(*used[1:]) <= used[0]
