"""Lens models against pycolmap's, against differences of themselves, and what calibrations are refused."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pycolmap
import pytest

from mitsuba_crb.camera import LENS_MODELS, Camera, Distortion, Intrinsics, lens
from mitsuba_crb.errors import CameraError

SIZE, FOCAL, CENTRE = (640, 480), (420.0, 410.0), (310.0, 250.0)
BARREL = (-0.3, 0.08, 1e-3, -7e-4, 0.0, 0.0, 0.0, 0.0)
PINCUSHION = (0.3, -0.02, -2e-3, 1e-3, 0.0, 0.0, 0.0, 0.0)
RATIONAL = (0.4, 0.1, 1e-3, 5e-4, 0.01, 0.7, 0.2, 0.03)
SKEW = (-0.25, 0.08, 0.03, -0.02, 0.01, 0.1, 0.0, 0.0)
"""Tangential coefficients of lenses are below 0.01."""
FISHEYE = (-0.02, 0.01, -0.004, 0.0005)
LENSES = {
    "barrel": ("opencv", BARREL, 330.0),
    "pincushion": ("opencv", PINCUSHION, 420.0),
    "rational": ("opencv", RATIONAL, 330.0),
    "skew": ("opencv", SKEW, 450.0),
    "fisheye": ("fisheye", FISHEYE, 330.0),
    "equidistant": ("fisheye", (0.0,) * 4, 310.0),
}
ORACLES = {"opencv": "FULL_OPENCV", "fisheye": "OPENCV_FISHEYE"}
every_lens = pytest.mark.parametrize("name", LENSES)


def calibration(name: str) -> Intrinsics:
    model, k, focal = LENSES[name]
    return Intrinsics(SIZE, (focal, 0.98 * focal), CENTRE, model, k)


def film_points() -> np.ndarray:
    """All over the image, its corners and its axis among them."""
    x, y = np.meshgrid(np.linspace(0.0, SIZE[0], 17), np.linspace(0.0, SIZE[1], 13))
    return np.concatenate([np.stack([x.ravel(), y.ravel()], axis=1), [CENTRE]])


def distortion_of(name: str) -> Distortion:
    found = Distortion.of(calibration(name), 2.0)
    assert found is not None
    return found


def undistorted_points(name: str) -> np.ndarray:
    camera = calibration(name)
    return distortion_of(name).undistorted((film_points() - camera.centre) / camera.focal)


@every_lens
def test_points_land_where_pycolmap_has_them(name: str) -> None:
    """To 1e-9 pixel; pycolmap's own inverse is iterative, so ours goes through its forward map."""
    camera = calibration(name)
    k = camera.distortion
    theirs = pycolmap.Camera(
        model=ORACLES[camera.model], width=SIZE[0], height=SIZE[1], params=[*camera.focal, *CENTRE, *k]
    )
    film = film_points()
    seen = Camera.of(camera).directions(film)
    # Their axes are x right, y down.
    np.testing.assert_allclose(theirs.img_from_cam(seen * [-1.0, -1.0, 1.0]), film, atol=1e-9)
    np.testing.assert_allclose(Camera.of(camera).project(7.0 * seen), film, atol=1e-9)


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "RADIAL", "OPENCV"])
def test_the_smaller_models_of_colmap_are_instances(model: str) -> None:
    radial = {"SIMPLE_RADIAL": (-0.12,), "RADIAL": (-0.2, 0.03), "OPENCV": (-0.2, 0.03, 1e-3, 2e-3)}[model]
    focal = (400.0, 390.0) if model == "OPENCV" else (400.0,)
    theirs = pycolmap.Camera(model=model, width=SIZE[0], height=SIZE[1], params=[*focal, *CENTRE, *radial])
    ours = Intrinsics(SIZE, (focal[0], focal[-1]), CENTRE, "opencv", (*radial, *(0.0,) * (8 - len(radial))))
    seen = Camera.of(ours).directions(film_points()) * [-1.0, -1.0, 1.0]
    np.testing.assert_allclose(theirs.img_from_cam(seen), film_points(), atol=1e-9)


def _slope(of: Any, u: np.ndarray, step: float = 1e-5) -> np.ndarray:
    """∂/∂u of a function of (n, 2), its last axis along u."""
    moved = [np.asarray(of(u + s)) - np.asarray(of(u - s)) for s in step * np.eye(2)]
    return np.stack(moved, axis=-1) / (2.0 * step)


@every_lens
def test_stretch_and_swelling_are_derivatives(name: str) -> None:
    """Of D and of ln det D', by central differences."""
    model, k, _ = LENSES[name]
    u = undistorted_points(name)[:-1]  # its middle, where the differences step over r = 0, apart

    def log_area(w: np.ndarray) -> np.ndarray:
        a, b, c = lens.stretch(np, model, k, *w.T)
        return np.asarray(np.log(a * c - b * b))

    a, b, c = lens.stretch(np, model, k, *u.T)
    by_differences = _slope(lambda w: np.stack(lens.distorted(np, model, k, *w.T), axis=1), u)
    np.testing.assert_allclose(np.array([[a, b], [b, c]]).transpose(2, 0, 1), by_differences, atol=1e-7)
    found = np.stack(lens.swelling(np, model, k, *u.T), axis=1)
    np.testing.assert_allclose(found, _slope(log_area, u), rtol=1e-5, atol=1e-5)
    least = np.linalg.eigvalsh(by_differences)[:, 0]
    np.testing.assert_allclose(lens.least_stretch(np, model, k, *u.T), least, atol=1e-6)


@every_lens
def test_nothing_is_divided_by_zero_on_the_axis(name: str) -> None:
    model, k, _ = LENSES[name]
    for u in (np.zeros(1), np.full(1, 1e-9)):
        values = [*lens.stretch(np, model, k, u, u), *lens.swelling(np, model, k, u, u)]
        tangential = np.zeros(2) if model == "fisheye" else 8.0 * np.array(k[3:1:-1])
        np.testing.assert_allclose(np.ravel(values), [1.0, 0.0, 1.0, *tangential], atol=1e-3)


@every_lens
def test_coefficients_move_the_film_as_differences_say(name: str) -> None:
    """w at fixed u; its divergence on the film is that of ln det D' in the coefficient (Liouville)."""
    model, k, _ = LENSES[name]
    u, step = undistorted_points(name), 1e-6

    def at(by: float, index: int) -> np.ndarray:
        other = [value + by * (j == index) for j, value in enumerate(k)]
        a, b, c = lens.stretch(np, model, other, *u.T)
        return np.array([*lens.distorted(np, model, other, *u.T), np.log(a * c - b * b)])

    for index in range(len(LENS_MODELS[model])):
        expected = (at(step, index) - at(-step, index)) / (2.0 * step)
        np.testing.assert_allclose(lens.motion(np, model, k, index, *u.T), expected, rtol=1e-6, atol=1e-6)


@every_lens
def test_a_lens_goes_on_beyond_the_image_and_nothing_lands_there_twice(name: str) -> None:
    """Along every ray from the axis the film point moves outwards, up to points beside the camera."""
    found, camera = distortion_of(name), calibration(name)
    corners = np.array([[x, y] for x in (-2.0, SIZE[0] + 2.0) for y in (-2.0, SIZE[1] + 2.0)])
    farthest = np.linalg.norm((corners - CENTRE) / camera.focal, axis=1).max()
    r = np.concatenate([np.linspace(0.0, found.limit, 200), found.limit * np.geomspace(1.01, 1e4, 200)])
    for angle in np.linspace(0.0, 6.0, 7):
        u = r[:, None] * [np.cos(angle), np.sin(angle)]
        landed = found.distorted(u)
        assert (np.diff(np.linalg.norm(landed, axis=1)) > 0.0).all()
        assert np.linalg.norm(landed[r > found.limit], axis=1).min() > farthest


@every_lens
def test_velocities_and_flow_are_derivatives_of_the_projection(name: str) -> None:
    camera = Camera.of(calibration(name))
    p = 3.0 * camera.directions(film_points()[::5])
    step = 1e-6
    along = np.random.default_rng(0).normal(size=p.shape)
    expected = (camera.project(p + step * along) - camera.project(p - step * along)) / (2.0 * step)
    np.testing.assert_allclose(camera.velocity(p, along), expected, rtol=1e-5, atol=1e-4)
    pulled = camera.pulled(p, np.ones((len(p), 2)))
    np.testing.assert_allclose(
        np.sum(pulled * camera.plain.velocity(p, along), axis=1), expected.sum(axis=1), rtol=1e-5, atol=1e-4
    )


@every_lens
def test_rectangles_of_the_plain_film_hold_those_of_the_film(name: str) -> None:
    camera = Camera.of(calibration(name), 2.0)
    rng = np.random.default_rng(1)
    low = rng.uniform([-2.0, -2.0], [600.0, 440.0], (50, 2))
    box = np.concatenate([low, low + rng.uniform(4.0, 40.0, (50, 1))], axis=1)
    plain = camera.plain_boxes(box)
    inside = low[:, None] + rng.random((50, 400, 2)) * (box[:, None, 2:] - low[:, None])
    there = camera.undistorted(inside)
    assert (there >= plain[:, None, :2]).all()
    assert (there <= plain[:, None, 2:]).all()
    # And are not much larger than they have to be.
    extent = there.max(axis=1) - there.min(axis=1)
    assert (plain[:, 2:] - plain[:, :2] < 1.5 * extent + 1.0).all()


class TestRefusals:
    def test_a_model_that_folds_the_image_over(self) -> None:
        """k1 = −0.4 turns back at r = 0.91, D = 0.61: 182 pixels; the corner is 402 pixels away."""
        folding = Intrinsics(SIZE, (300.0, 300.0), CENTRE, "opencv", (-0.4, *(0.0,) * 7))
        with pytest.raises(CameraError, match=r"k1 = -0.4 folds the image over at 182.* reaches 4\d\d.*crop"):
            Camera.of(folding)
        cropped = dataclasses.replace(folding, size=(200, 200), centre=(100.0, 100.0))
        assert Camera.of(cropped).distortion is not None

    def test_a_model_that_newton_s_method_does_not_invert(self) -> None:
        k = (-0.41, 0.29, 0.06, 0.058, 0.02, 0.44, 0.08, -0.2)
        skewed = Intrinsics(SIZE, (286.0, 286.0), CENTRE, "opencv", k)
        with pytest.raises(CameraError, match=r"cannot be inverted near film point \(.*crop the image"):
            Camera.of(skewed)

    def test_a_fisheye_that_looks_aside(self) -> None:
        wide = Intrinsics((400, 400), (150.0, 150.0), (200.0, 200.0), "fisheye", (0.0,) * 4)
        with pytest.raises(
            CameraError, match=r"no coefficients comes to 88° off the axis at 230.4 pixels.*crop"
        ):
            Camera.of(wide)
        across = Camera.of(Intrinsics((290, 290), (150.0, 150.0), (145.0, 145.0), "fisheye", (0.0,) * 4))
        assert across.field_of_view_deg == pytest.approx([np.degrees(290 / 150.0)] * 2)

    def test_a_size_of_another_shape(self) -> None:
        camera = calibration("barrel")
        half = camera.scaled((320, 240))
        assert (half.size, half.focal, half.centre) == (
            (320, 240),
            (165.0, 0.5 * 0.98 * 330.0),
            (155.0, 125.0),
        )
        with pytest.raises(CameraError, match="640x480 pixels, and 320x200 is another shape"):
            camera.scaled((320, 200))


def test_a_camera_prints_in_a_line_what_is_not_zero() -> None:
    lens = Intrinsics((640, 480), (460.25, 461.0), (322.9, 237.3), "opencv", (-0.28, 0.07, *(0.0,) * 6))
    line = "640×480 pixels, fx = 460.25, fy = 461, cx = 322.9, cy = 237.3; opencv lens, k1 = -0.28, k2 = 0.07"
    assert str(lens) == line
    assert str(Intrinsics((64, 48), (50.0, 50.0), (32.0, 24.0))).endswith("cy = 24; pinhole")
