"""No weight, density or root of the kernels is infinite or NaN where what goes in is finite."""

from __future__ import annotations

import itertools
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from matrices import misfit
from one_go import measured
from small_scenes import T, camera

from mitsuba_crb import pose_bound
from mitsuba_crb.jacobian import pair_sums
from mitsuba_crb.jacobian.flow import Flow
from mitsuba_crb.jacobian.pairs import PairSample
from mitsuba_crb.jacobian.view_term import _turn_of_lobes
from mitsuba_crb.noise import Gaussian
from mitsuba_crb.render import paths
from mitsuba_crb.render.random import lane_sampler, seeding
from mitsuba_crb.render.view import open_view

EXTREMES = [0.0, 1e-37, 1e-30, 1e-20, 1e-6, 1.0, 3.0, 1e6, 1e19, 1e30, 3e38, np.inf]


def floats(values: Any) -> mi.Float:
    return mi.Float(np.asarray(values, dtype=np.float32))


def test_power_heuristic_is_finite_and_right_for_all_densities() -> None:
    density, other = np.array(list(itertools.product(EXTREMES, repeat=2))).T
    weight = np.array(paths._power_heuristic(floats(density), floats(other)), dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        expected = 1.0 / (1.0 + (other / density) ** 2)
    expected = np.where((density > 0.0) & np.isfinite(expected), expected, 0.0)
    assert np.isfinite(weight).all()
    assert weight == pytest.approx(expected, rel=1e-5, abs=1e-30)
    finite = np.isfinite(density) & np.isfinite(other) & ((density > 1e-30) | (other > 1e-30))
    both = weight + np.array(paths._power_heuristic(floats(other), floats(density)))
    assert both[finite] == pytest.approx(1.0, rel=1e-5)


@pytest.mark.parametrize("throughput", [0.0, 1e-38, 1e-30, 1e-7, 0.5, 1.0, 1e30])
def test_russian_roulette_leaves_throughput_finite_and_its_mean(throughput: float) -> None:
    n = 1 << 23
    sampler = lane_sampler(mi.UInt32(np.arange(n)), mi.UInt32(0), seeding(3))
    after = mi.Color3f(floats(np.full(n, throughput)))
    survive = paths._survives(sampler, after, mi.Color3f(1.0), mi.Float(1.0), mi.UInt32(9), 5, mi.Bool(True))
    kept = np.where(np.array(survive), np.array(after[0], dtype=np.float64), 0.0)
    assert np.isfinite(np.array(after)).all()
    if throughput > 1e-4:
        assert kept.mean() == pytest.approx(throughput, rel=0.01)


def test_lobes_turn_by_something_finite_however_grazing() -> None:
    n = 256
    rng = np.random.default_rng(0)
    wi = np.array([[0.0], [1.0], [1e-30]]) * np.ones(n)
    wo, tangent = rng.normal(size=(2, 3, n)).astype(np.float32)
    wo /= np.linalg.norm(wo, axis=0)
    material = {"type": "roughconductor", "distribution": "ggx"}
    ray = mi.Ray3f(mi.Point3f(floats(np.full(n, 0.1)), 0.2, 3.0), mi.Vector3f(0.0, 0.0, -1.0))
    scene = mi.load_dict({"type": "scene", "wall": {"type": "rectangle", "bsdf": material}})
    si = scene.ray_intersect(ray)
    si.wi = mi.Vector3f(*wi.astype(np.float32))
    seen = paths.Seen(si, mi.Color3f(0.0), [(mi.Vector3f(*np.abs(wo)), mi.Color3f(1.0))])
    across = dr.normalize(dr.cross(si.wi, mi.Vector3f(*tangent)))
    turned = _turn_of_lobes(seen, si.to_world(across), mi.Bool(True))
    assert np.isfinite(np.array(turned)).all()


def test_weights_of_grazing_and_touching_planes_are_finite() -> None:
    normals = [[0.0, 1.0, s] for s in (0.0, 1e-38, 1e-30, 1e-12, 1e-7, 0.5)] + [[0.0, 0.0, 0.0]]
    cases = list(itertools.product(normals, [0.0, 1e-30, 1e-6, 1.0, 1e6], [0.0, 1e-6, 1.0], [False, True]))
    normal = mi.Vector3f(*(floats([c[0][k] for c in cases]) for k in range(3)))
    distance, value = (floats([c[k] for c in cases]) for k in (1, 2))
    got = pair_sums.divergences(
        PairSample(mi.Point2f(0.1), mi.Vector2f(2.0, 0.0), value),
        mi.Ray3f(mi.Point3f(0.0), mi.Vector3f(0.0, 0.0, 1.0)),
        mi.Point3f(0.0),
        mi.Bool(True),
        mi.Bool([c[3] for c in cases]),
        distance,
        normal,
        mi.Vector2f(500.0, 500.0),
    )
    for weight in got:
        assert np.isfinite(np.array(weight)).all()


def flush(below: float) -> dict[str, Any]:
    """A room with its lamp in the plane of the ceiling, to what is left of cos 90°, or below it."""
    cosine = np.cos(0.5 * np.pi)
    down = np.array([[1, 0, 0, 0], [0, cosine, -1, 0], [0, 1, cosine, 0], [0, 0, 0, 1]])
    place = np.array([[1, 0, 0, 0.1], [0, 1, 0, 2.0 - below], [0, 0, 1, -0.5], [0, 0, 0, 1]])
    grey = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.7}}}
    tiles = {"type": "diffuse", "reflectance": {"type": "checkerboard", "to_uv": T().scale(6)}}
    lift = np.array(T().translate([0, 2, 0]).matrix)
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 3},
        "camera": camera(24, 16, target=(0, 0.3, 3), fov=90),
        "ceiling": {"type": "rectangle", "to_world": T(lift @ down).scale(6), "bsdf": grey},
        "floor": {
            "type": "rectangle",
            "to_world": T().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(6),
            "bsdf": tiles,
        },
        "lamp": {
            "type": "rectangle",
            "to_world": T(place @ down).scale(0.015),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 20000.0}},
        },
    }


@pytest.mark.slow
def test_a_lamp_flush_with_a_wall_gives_no_nan_and_what_one_just_below_gives() -> None:
    """Directions from the wall to a lamp in its plane have densities whose squares are beyond float32."""
    found = []
    for below in (0.0, 1e-3):
        with open_view(flush(below)) as view:
            pixels = np.stack(np.meshgrid(np.arange(24), np.arange(16)), axis=-1).reshape(-1, 2)
            columns, images = measured(Flow, view, pixels, spp=256, seed=1, batches=4)
        assert np.isfinite(columns).all()
        assert np.isfinite(images).all()
        total = columns.sum(axis=0).reshape(-1, 6)
        found.append(total.T @ total - sum(b.T @ b for b in columns.reshape(4, -1, 6)))
    assert misfit(*found) < 0.05


@pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")
def test_a_blend_of_one_sided_materials_seen_from_behind_gives_no_nan() -> None:
    """Mitsuba samples its conductor there with weight and density NaN, and goes on nowhere."""
    conductor = {"type": "roughconductor", "alpha": 0.3}
    blend = {"type": "blendbsdf", "weight": 0.5, "a": {"type": "diffuse"}, "b": conductor}
    pipe = T().translate([0.1, -0.3, 2.0]).rotate([1, 1, 0], 35).scale([0.4, 0.4, 0.6])
    world = {
        "type": "scene",
        "sensor": camera(16, 12),
        "pipe": {"type": "cylinder", "to_world": pipe, "bsdf": blend},
        "lamp": {"type": "point", "position": [0.5, 1.0, 0.0], "intensity": {"type": "rgb", "value": 5.0}},
    }
    bound = pose_bound(world, Gaussian(0.01), spp=64)
    assert np.isfinite(bound.information.matrix).all()
