"""Media and radiance fields: rotation by the filter term, translation by finite differences, by block."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from one_go import estimated, measured
from small_scenes import T, camera, scene, texture

from mitsuba_crb.jacobian import finite_difference, flow
from mitsuba_crb.jacobian.closure import FilmBlocks
from mitsuba_crb.jacobian.method import Paths
from mitsuba_crb.jacobian.unfollowed import Unfollowed
from mitsuba_crb.render.paths import tracer
from mitsuba_crb.render.rays import coarse_grid
from mitsuba_crb.render.view import open_view

FOG = {"type": "homogeneous", "id": "fog", "albedo": 0.0, "sigma_t": 0.3}
LAMP = {
    "type": "rectangle",
    "to_world": T().translate([0, 0, 3]).scale(6).rotate([0, 1, 0], 180),
    "emitter": {"type": "area", "radiance": texture()},
}
CLOUD = {"type": "cube", "to_world": T().translate([0, 0, 1.5]).scale(0.4), "bsdf": {"type": "null"}}
BLOBS = {
    "type": "ellipsoids",
    "centers": mi.TensorXf(np.array([[0.0, 0.1, 2.0], [0.5, 0.3, 3.0], [-0.4, 0.0, 2.5]])),
    "scales": mi.TensorXf(np.array([[0.2, 0.1, 0.1], [0.1, 0.3, 0.1], [0.1, 0.1, 0.2]])),
    "quaternions": mi.TensorXf(np.array([[0.0, 0.0, 0.0, 1.0]] * 3)),
    "opacities": mi.TensorXf(np.full((3, 1), 0.8)),
    "sh_coeffs": mi.TensorXf(np.array([[1.5, 0.2, 0.4], [0.1, 1.2, 0.3], [0.5, 0.2, 1.0]])),
}
SCENES: dict[str, dict[str, Any]] = {
    "cloud": scene(lamp=LAMP, cloud=CLOUD | {"interior": FOG}, sensor=camera(16, 12))
    | {"integrator": {"type": "volpath", "max_depth": 2}},
    "camera in fog": scene(
        lamp=LAMP,
        box={"type": "cube", "to_world": T().scale(7), "bsdf": {"type": "null"}, "interior": FOG},
        sensor=camera(16, 12) | {"medium": {"type": "ref", "id": "fog"}},
    )
    | {"integrator": {"type": "volpath", "max_depth": 2}},
    "radiance field": {
        "type": "scene",
        "integrator": {"type": "volprim_rf_basic"},
        "camera": camera(16, 12),
        "blobs": BLOBS,
    },
    "radiance field of meshes": {
        "type": "scene",
        "integrator": {"type": "volprim_rf_basic"},
        "camera": camera(16, 12),
        "blobs": BLOBS | {"type": "ellipsoidsmesh"},
    },
}


SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("cloud", "camera in fog")]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["radiance field", "radiance field of meshes", *SLOW])
def test_rotation_is_the_filter_term_and_translation_a_difference(name: str) -> None:
    """Finite differences project onto flow's columns with slope 1, to 4 errors and 1 % of bias."""
    options: dict[str, Any] = {"spp": 256, "batches": 16}
    with open_view(SCENES[name]) as view:
        pixels = coarse_grid(view.size, 16).reshape(-1, 2)
        found = estimated(flow.Flow, view, pixels, seed=1, **options)
        other, _ = measured(finite_difference.FiniteDifference, view, pixels, seed=2, **options)
    assert found.causes is not None
    assert set(found.causes) <= {"", "media", "radiance fields"}
    assert (found.causes != "").any()
    total = found.columns.sum(axis=0)
    norm = (np.sum(total**2, axis=(0, 1)) - np.sum(found.columns**2, axis=(0, 1, 2))) / (16 * 15)
    slope = np.einsum("kncj,ncj->kj", other, total / 16.0) / norm
    error = slope.std(axis=0, ddof=1) / 4.0
    assert np.all(error < 0.1)
    assert np.all(np.abs(slope.mean(axis=0) - 1.0) < 4 * error + 0.01)


def test_a_medium_that_the_integrator_passes_by_changes_nothing() -> None:
    for integrator, seen in (({"type": "path", "max_depth": 2}, False), (None, True)):
        with open_view(SCENES["cloud"], integrator=integrator) as view:
            pixels = coarse_grid(view.size, 16).reshape(-1, 2)
            causes = Unfollowed.of(view, tracer(view)).causes(pixels, FilmBlocks.of(pixels))
        assert ("media" in causes) == seen


@pytest.mark.slow
def test_a_thin_lens_among_volumes_leaves_rotation_to_finite_differences_too() -> None:
    """Its rotation has parallax, which needs points."""
    lens = camera(16, 12) | {"type": "thinlens", "aperture_radius": 0.2, "focus_distance": 2.5}
    options: dict[str, Any] = {"spp": 16, "batches": 4, "seed": 0}
    with open_view(SCENES["cloud"] | {"camera": lens}) as view:
        pixels = coarse_grid(view.size, 16).reshape(-1, 2)
        found = estimated(flow.Flow, view, pixels, **options)
        paths = Paths(**options)
        method = flow.Flow(view, np.ones((12, 16), dtype=bool), paths.seed)
        rows = np.flatnonzero(found.causes != "")
        assert len(rows)
        np.testing.assert_array_equal(found.columns[:, rows], method.differences(pixels[rows], 6, paths))
