"""The three methods against closed forms and against each other."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from matrices import misfit
from one_go import measured
from small_scenes import T, camera, scene, texture, textured_wall, wall

from mitsuba_crb import fisher_information, pose_jacobian, se3
from mitsuba_crb.errors import BlindSpotWarning, IntegratorError
from mitsuba_crb.jacobian import finite_difference
from mitsuba_crb.noise import Gaussian
from mitsuba_crb.render.pixels import render_pixels
from mitsuba_crb.render.view import open_view

SIGMA = Gaussian(0.01)


def _ramp_wall() -> dict[str, Any]:
    """Radiance 0.5 + 0.1 X on the plane z = 3, seen straight: every derivative has a closed form."""
    ramp = np.linspace(0.0, 1.0, 2, dtype=np.float32)[None, :, None].repeat(2, axis=0)
    # The bitmap's linear part spans its inner half, uv 0.25 to 0.75, which is 6 units of the wall here.
    bitmap = {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.repeat(ramp, 3, axis=2)),
        "raw": True,
        "wrap_mode": "clamp",
    }
    shape = wall(bitmap) | {"to_world": T().translate([0, 0, 3]).scale(6).rotate([0, 1, 0], 180)}
    return scene(wall=shape, sensor=camera(17, 17, target=(0, 0, 1)))


@pytest.mark.slow
@pytest.mark.parametrize("method", ["finite_difference", "forward"])
def test_a_ramp_on_a_plane_has_the_closed_form_jacobian(method: str) -> None:
    """L = a + b X, X the wall point of a film point: to 1 % along the expected pattern, 3 % rms per pixel."""
    jacobian = pose_jacobian(_ramp_wall(), method=method, spp=256, seed=1)
    x, y = jacobian.pixels.T
    focal = 17 / 2 / np.tan(np.radians(22.5))
    # Mitsuba's camera has x to the left: the ray of a column right of the centre has negative x.
    u, v = -(x + 0.5 - 8.5) / focal, -(y + 0.5 - 8.5) / focal
    # Camera and world axes agree for this camera; the wall's texture runs along ±X with slope b.
    measured = jacobian.values[:, 0]
    slope = measured[:, 0].mean()
    assert abs(slope) == pytest.approx(1.0 / 6.0, rel=0.02)
    z = 3.0
    # A ray of direction (u, v, 1) from the centre moved by ρ and turned by φ meets Z = 3 at X + δX.
    expected = slope * np.stack([np.ones_like(u), 0 * u, -u, -z * u * v, z * (1 + u**2), -z * v], axis=1)
    # The path integrator's own noise is multiplicative, 1.6 % per pixel here.
    deviation = np.sqrt(np.mean((measured - expected) ** 2, axis=0))
    assert np.all(deviation < 0.03 * np.sqrt(np.mean(expected**2, axis=0)) + 1e-5)
    along = (
        np.sum(measured * expected, axis=0)[[0, 2, 3, 4, 5]] / np.sum(expected**2, axis=0)[[0, 2, 3, 4, 5]]
    )
    assert along == pytest.approx(1.0, abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("shipped", [False, True])
def test_forward_agrees_with_finite_differences_where_radiance_is_smooth(shipped: bool, scenes: Path) -> None:
    """ΔJ's unbiased information is within 4 standard errors of 0.02² of J's (float32 and step bias)."""
    which: Any = scenes / "textured_wall" / "textured_wall.xml" if shipped else textured_wall()
    fd = pose_jacobian(which, method="finite_difference", spp=64, seed=1, size=(32, 24))
    forward = pose_jacobian(which, method="forward", spp=64, seed=2, size=(32, 24))
    f, f_fd = fisher_information(forward, SIGMA), fisher_information(fd, SIGMA)
    for own, reference, own_se, reference_se in zip(
        np.diag(f.matrix),
        np.diag(f_fd.matrix),
        np.diag(f.standard_error),
        np.diag(f_fd.standard_error),
        strict=True,
    ):
        assert abs(own - reference) < 4 * np.hypot(own_se, reference_se) + 0.02 * reference
    left_over = fisher_information(forward - fd, SIGMA)
    bound = (0.02) ** 2 * np.diag(f_fd.matrix) + 4 * np.diag(left_over.standard_error)
    assert np.all(np.diag(left_over.matrix) < bound)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("reflectance", "named"),
    [
        ({"type": "checkerboard", "to_uv": T().scale(8)}, "checkerboard"),
        (texture(filter_type="nearest"), "nearest"),
    ],
)
def test_forward_is_blind_to_jumps_and_says_so(reflectance: Any, named: str) -> None:
    jumpy = scene(wall=wall(reflectance))
    with pytest.warns(BlindSpotWarning, match=named):
        forward = pose_jacobian(jumpy, method="forward", spp=16)
    fd = pose_jacobian(jumpy, method="finite_difference", spp=16)
    missed = np.diag(fisher_information(forward, SIGMA).matrix) / np.diag(
        fisher_information(fd, SIGMA).matrix
    )
    assert np.all(missed < 0.01)


def test_forward_refuses_integrators_that_detach_the_camera() -> None:
    with pytest.raises(IntegratorError, match=r"PRBIntegrator.*detaches"):
        pose_jacobian(textured_wall(), method="forward", integrator="prb", spp=4)
    values = pose_jacobian(textured_wall(), method="finite_difference", integrator="prb", spp=4).values
    assert np.abs(values).max() > 0


def test_finite_differences_halve_their_bias_fourfold() -> None:
    """Without noise (common random numbers, equal seeds) J(h) − J(h/2) is a quarter of J(2h) − J(h)."""
    with open_view(textured_wall()) as view:
        pixels = np.stack(np.meshgrid(np.arange(8, 24), np.arange(6, 18)), axis=-1).reshape(-1, 2)
        steps = [
            measured(
                finite_difference.FiniteDifference, view, pixels, spp=256, seed=0, batches=4, step_pixels=step
            )[0].mean(axis=0)
            for step in (0.1, 0.2, 0.4)
        ]
    fine, coarse = steps[0] - steps[1], steps[1] - steps[2]
    ratio = np.sum(fine * coarse, axis=(0, 1)) / np.sum(coarse * coarse, axis=(0, 1))
    # A bilinear texture has kinks, so the order is a little below two.
    assert np.all((ratio > 0.1) & (ratio < 0.45))


def test_a_step_through_a_surface_is_named() -> None:
    """A chip before a few pixels, nearer than the step; the wall behind it sets the step."""
    chip = {
        "type": "rectangle",
        "to_world": T().translate([0.001, 0.0, 0.004]).scale(0.0003).rotate([0, 1, 0], 180),
    }
    sensor = camera(target=(0, 0, 3)) | {"near_clip": 0.001}
    options: dict[str, Any] = {"method": "finite_difference", "spp": 4, "size": (16, 12)}
    with pytest.warns(BlindSpotWarning, match=r"moves the camera by .*through what is seen at depth 0.004"):
        pose_jacobian(scene(wall=wall(), chip=chip, sensor=sensor), **options)
    pose_jacobian(scene(wall=wall(), sensor=sensor), **options)  # warnings are errors


def test_camera_frame_information_moves_to_the_world_like_left_perturbations() -> None:
    """F from renders at exp(ξ)·x equals the transported F; equal random numbers: 1 % of √(F_ii F_jj)."""
    sensor = camera(origin=(0.5, -0.3, 0.4), target=(0.2, 0.1, 3))
    right = pose_jacobian(textured_wall(sensor=sensor), method="finite_difference", spp=64, seed=5)
    transported = fisher_information(right, SIGMA).to_frame("world").matrix
    with open_view(textured_wall(sensor=sensor)) as view:
        steps = finite_difference.steps_of(view)
        columns = []
        for axis, step in enumerate(steps):
            twist = np.zeros(6)
            twist[axis] = step
            plus, minus = (
                render_pixels(
                    view, right.pixels, spp=16, seed=5, batches=4, pose=se3.exp(xi) @ view.pose, even=True
                )
                for xi in (twist, -twist)
            )
            columns.append((plus - minus) / (2 * step))
    left = dataclasses.replace(right, batch_values=np.stack(columns, axis=-1)).about(frame="world")
    direct = fisher_information(left, SIGMA).matrix
    assert misfit(transported, direct) < 0.01
    # Negative control: the camera-frame matrix is another one.
    untransported = fisher_information(right, SIGMA).matrix
    assert misfit(untransported, direct) > 0.1
