"""Flow's parts against oracles of their own: the sensor model, the integrator, the BSDFs, the filters.

Whole Jacobians are compared in test_flow_table.py.
"""

from __future__ import annotations

import dataclasses
import functools
import gc
import warnings
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from matrices import misfit
from one_go import estimated, measured
from scipy.stats import norm
from small_scenes import T, camera, scene, texture, textured_wall, wall

from mitsuba_crb import pose_bound, pose_jacobian, se3
from mitsuba_crb.errors import FilmError, PrecisionWarning
from mitsuba_crb.jacobian import flow, pair_sums
from mitsuba_crb.jacobian.pairs import PairSample, filter_pairs
from mitsuba_crb.jacobian.view_term import ViewTerm, _turn_of_lobes
from mitsuba_crb.noise import Gaussian
from mitsuba_crb.render import paths
from mitsuba_crb.render.pixels import render_pixels
from mitsuba_crb.render.random import lane_sampler, seeding
from mitsuba_crb.render.rays import Lanes, camera_ray, move_ray, opaque_transform
from mitsuba_crb.render.view import View, open_view

THIN = {"type": "thinlens", "aperture_radius": 0.2, "focus_distance": 2.5}


def all_pixels(view: View) -> np.ndarray:
    return np.stack(np.meshgrid(*(np.arange(n) for n in view.size)), axis=-1).reshape(-1, 2)


def with_filter(name: str) -> dict[str, Any]:
    sensor = camera()
    sensor["film"]["rfilter"] = {"type": name}
    return sensor


def information(values: np.ndarray) -> np.ndarray:
    """Unbiased ΣJᵀJ of (batches, n, 3, 6)."""
    batches = values.reshape(len(values), -1, 6)
    total = batches.sum(axis=0)
    return (total.T @ total - sum(b.T @ b for b in batches)) / (len(values) * (len(values) - 1))


# Closed forms of the flow and its divergence


@pytest.mark.parametrize("sensor", [{}, THIN], ids=["perspective", "thinlens"])
def test_flow_and_divergence_are_those_of_the_sensor_model(sensor: dict[str, Any]) -> None:
    """f by forward mode through the sensor's rays onto a tilted plane, ∇·f by differences of that f."""
    normal = (np.array([0.3, -0.5, -1.0]) / np.linalg.norm([0.3, -0.5, -1.0])).tolist()
    film0 = np.array([[5.0, 20.0, 14.0], [4.0, 9.0, 21.0]])
    with open_view(scene(sensor=camera() | sensor)) as view:
        aperture = mi.Point2f(0.8, 0.3)

        def plane_point(x: mi.Float, y: mi.Float, twist: list[mi.Float]) -> tuple[Any, mi.Ray3f]:
            ray, _ = camera_ray(view, mi.Point2f(x, y), aperture)
            a, b, c, d, e, f = twist
            generator = mi.Matrix4f(1, -f, e, a, f, 1, -d, b, -e, d, 1, c, 0, 0, 0, 1)
            moved = move_ray(ray, mi.Transform4f(generator))
            n = mi.Vector3f(normal)
            t = (3.0 * normal[2] - dr.dot(n, mi.Vector3f(moved.o))) / dr.dot(n, moved.d)
            return moved.o + t * moved.d, ray

        def derivative(film: np.ndarray, which: int) -> np.ndarray:
            variables = [mi.Float(film[0].astype(np.float32)), mi.Float(film[1].astype(np.float32))]
            variables += [mi.Float(0.0) for _ in range(6)]
            dr.enable_grad(variables[which])
            point, _ = plane_point(variables[0], variables[1], variables[2:])
            dr.forward_from(variables[which])
            gradient = np.array(dr.grad(point), dtype=np.float64)
            return np.broadcast_to(gradient.reshape(3, -1), (3, film.shape[1]))

        def film_flow(film: np.ndarray) -> np.ndarray:
            """(n, 2, 6): the film velocity that keeps the plane's point: X_v f + X_ξ = 0."""
            along = np.stack([derivative(film, k) for k in range(8)], axis=-1).transpose(1, 0, 2)
            return np.stack([-np.linalg.lstsq(a[:, :2], a[:, 2:], rcond=None)[0] for a in along])

        expected = film_flow(film0)
        step = 0.5
        shifts = np.eye(2) * step
        divergence = sum(
            (film_flow(film0 + s[:, None]) - film_flow(film0 - s[:, None]))[:, k] / (2 * step)
            for k, s in enumerate(shifts)
        )

        focal = flow.prepare(view).focal
        point, ray = plane_point(
            mi.Float(film0[0].astype(np.float32)), mi.Float(film0[1].astype(np.float32)), [mi.Float(0.0)] * 6
        )
        to_lens = ray.o.z / ray.d.z
        lens = mi.Point3f(ray.o - to_lens * ray.d)
        distance = to_lens + dr.dot(point - ray.o, ray.d)

        def closed(gradient: tuple[float, float], value: float) -> np.ndarray:
            half = PairSample(mi.Point2f(0.0, 0.0), mi.Vector2f(*gradient), mi.Float(value))
            got = pair_sums.divergences(
                half,
                ray,
                lens,
                mi.Bool(True),
                mi.Bool(False),
                distance,
                mi.Vector3f(list(normal)),
                focal,
            )
            return np.stack([np.broadcast_to(np.array(x, dtype=np.float64), 3) for x in got], axis=-1)

        scale = np.abs(expected).max()
        assert closed((1.0, 0.0), 0.0) == pytest.approx(expected[:, 0], abs=1e-4 * scale)
        assert closed((0.0, 1.0), 0.0) == pytest.approx(expected[:, 1], abs=1e-4 * scale)
        assert closed((0.0, 0.0), 1.0) == pytest.approx(divergence, abs=2e-3 * np.abs(divergence).max())


@pytest.mark.parametrize("normal", [(1.0, 0.0, 0.0), (np.nan, 0.0, 0.0), (0.0, 0.0, 0.0)])
def test_a_plane_through_the_lens_point_gives_no_infinity(normal: tuple[float, float, float]) -> None:
    half = PairSample(mi.Point2f(0.0, 0.0), mi.Vector2f(1.0, 1.0), mi.Float(1.0))
    ray = mi.Ray3f(mi.Point3f(0.0, 0.0, 0.01), mi.Vector3f(0.0, 0.0, 1.0))
    got = pair_sums.divergences(
        half,
        ray,
        mi.Point3f(0.0),
        mi.Bool(True),
        mi.Bool(False),
        mi.Float(2.0),
        mi.Vector3f(list(normal)),
        mi.Vector2f(30.0, 30.0),
    )
    assert all(np.isfinite(np.array(value)).all() for value in got)


def test_a_rim_weighs_its_mean_where_rounding_decides_its_slant() -> None:
    """Film distance from a sphere's rim is the square of its slant; uniform distances, mean weight to 1 %."""
    n, width = 1 << 16, 100.0 * pair_sums.RIM
    slant = width * np.sqrt((np.arange(n) + 0.5) / n)
    half = PairSample(mi.Point2f(0.0, 0.0), mi.Vector2f(0.0, 0.0), mi.Float(1.0))
    ray = mi.Ray3f(mi.Point3f(0.0), mi.Vector3f(0.0, 0.0, 1.0))
    normal = mi.Vector3f(mi.Float(np.sqrt(1.0 - slant**2)), 0.0, mi.Float(slant))
    mean = 2.0 / width
    for curved, largest in ((True, 2.0 / pair_sums.RIM), (False, 1.0 / slant[0])):
        got = pair_sums.divergences(
            half,
            ray,
            mi.Point3f(0.0),
            mi.Bool(True),
            mi.Bool(curved),
            mi.Float(1.0),
            normal,
            mi.Vector2f(1.0, 1.0),
        )
        weights = -np.array(got[0], dtype=np.float64)
        assert weights.mean() == pytest.approx(mean, rel=0.01)
        assert weights.max() == pytest.approx(largest, rel=0.01)


# Pairs


@pytest.mark.parametrize("name", ["gaussian", "box", "tent", "mitchell", "catmullrom", "lanczos"])
def test_pairs_have_the_moments_of_the_filter_and_its_derivative(name: str) -> None:
    """∫h = 1, ∫∂h/∂x x = −1, ∫∂h/∂x x³ = −3 ∫h x²; 2²⁰ pairs, to 5 standard errors."""
    n = 1 << 20
    with open_view(scene(sensor=with_filter(name))) as view:
        pixel_filter = view.pixel_filter
        pairs = filter_pairs(pixel_filter)
        x = np.linspace(-pixel_filter.radius, pixel_filter.radius, 200001)
        h = np.array(pixel_filter.eval(mi.Float(x.astype(np.float32))), dtype=np.float64)
        second = float(np.sum(h * x * x) * (x[1] - x[0]))
        rng = mi.PCG32(n, 7, 3)
        value, slopes, cubes = np.zeros(n), np.zeros((2, n)), np.zeros((2, n))
        for kind in range(pairs.kinds):
            point = mi.Point2f(rng.next_float32(), rng.next_float32())
            kinds = dr.full(mi.UInt32, kind, n)
            first = pairs.draw(kinds, point, [mi.Float(1.0)] * pairs.kinds)
            for half in (first, first.mirrored(kinds)):
                offset = np.array(half.offset, dtype=np.float64)
                gradient = np.array(half.gradient, dtype=np.float64)
                value += np.array(half.value, dtype=np.float64)
                slopes += gradient * offset
                cubes += gradient * offset**3
    checks = [(value, 1.0), *((s, -1.0) for s in slopes), *((c, -3.0 * second) for c in cubes)]
    for samples, expected in checks:
        assert samples.mean() == pytest.approx(expected, abs=5 * samples.std() / np.sqrt(n) + 2e-4)


def test_pairs_are_drawn_where_the_gaussian_changes() -> None:
    """Quantiles of |x| against the closed form of ∫|h'| (1 + 6x/r) dx; none waits in the flat tail.

    h' = −x/σ² g(x) and ∫x²/σ² g dx = ∫g dx − x g(x), g the normal density.
    """
    n = 1 << 16
    with open_view(scene(sensor=with_filter("gaussian"))) as view:
        pairs = filter_pairs(view.pixel_filter)
        points = mi.Point2f((dr.arange(mi.Float, n) + 0.5) / n, 0.5)
        half = pairs.draw(dr.zeros(mi.UInt32, n), points, [mi.Float(1.0)] * 2)
        drawn = np.sort(np.abs(np.array(half.offset.x, dtype=np.float64)))
    sigma, radius = 0.5, 2.0
    x = np.linspace(0.0, radius, 4001)
    density = norm.pdf(x, scale=sigma)
    mass = density[0] - density + 6.0 / radius * (norm.cdf(x, scale=sigma) - 0.5 - x * density)
    expected = np.interp((np.arange(n) + 0.5) / n, mass / mass[-1], x)
    middle = slice(n // 100, -n // 100)
    assert drawn[middle] == pytest.approx(expected[middle], abs=5e-3)
    assert np.mean(drawn > 1.8) == pytest.approx(np.mean(expected > 1.8), rel=0.1)


def test_a_filter_that_jumps_at_its_border_is_refused_by_name() -> None:
    """Mitsuba has none but the box; half a tent stands for one."""
    with open_view(scene(sensor=with_filter("tent"))) as view:
        half = dataclasses.replace(view.pixel_filter, radius=0.5)
        with pytest.raises(FilmError, match=r"TentFilter jumps at its border.* knows box, tent"):
            filter_pairs(half)


@pytest.mark.parametrize("name", ["gaussian", "box"])
@pytest.mark.parametrize("per_batch", [1, 2, 3, 5])
def test_few_paths_per_batch_stay_unbiased(name: str, per_batch: int) -> None:
    """Every batch alone projects onto a reference with slope 1, to 4 standard errors over 64 batches."""
    batches = 64
    with open_view(textured_wall(sensor=with_filter(name))) as view:
        _prepared, pixels = flow.prepare(view), all_pixels(view)
        reference, _ = measured(flow.Flow, view, pixels, spp=1024, seed=9, batches=4)
        values, _ = measured(flow.Flow, view, pixels, spp=per_batch * batches, seed=1, batches=batches)
    mean = reference.mean(axis=0)
    slope = np.einsum("kncj,ncj->kj", values, mean) / np.einsum("ncj,ncj->j", mean, mean)
    error = slope.std(axis=0, ddof=1) / np.sqrt(batches)
    assert np.all(np.abs(slope.mean(axis=0) - 1.0) < 4 * error + 0.01)


# The image


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["gaussian", *(pytest.param(n, marks=pytest.mark.slow) for n in ("mitchell", "tent"))]
)
def test_the_image_is_as_clean_as_a_plain_render(name: str) -> None:
    """Beside a lamp too, where the coarse pilot is far off and the batches' own images have specks."""
    with open_view(lamp_before_a_wall(name)) as view:
        pixels = all_pixels(view)
        truth = render_pixels(view, pixels, spp=8192, seed=1)[0]
        plain = render_pixels(view, pixels, spp=64, seed=2)[0]
        found = estimated(flow.Flow, view, pixels, spp=64, seed=0, batches=4)
    images, image = found.images, found.image
    beside = truth.max(axis=1) < 1.5
    error, usual, control = (np.abs(a - truth)[beside] for a in (image, plain, images.mean(axis=0)))
    # Pairs are not spread as the filter is, but share out their numbers: about as many paths' worth.
    assert np.sqrt(np.mean(error**2)) < 1.5 * np.sqrt(np.mean(usual**2))
    assert error.max() < 1.5 * usual.max()
    assert control.max() > 3.0 * error.max()


@pytest.mark.slow
def test_no_pixel_of_a_plain_wall_stands_out() -> None:
    """A lamp behind the camera makes noise alone: 5 standard deviations are for 1 in 500 such images."""
    light = {"type": "area", "radiance": {"type": "rgb", "value": 3.0}}
    lamp = {"type": "rectangle", "to_world": T().translate([0, 0, -1]).scale(2.0), "emitter": light}
    which = scene(wall=wall(), lamp=lamp, sensor=camera(64, 48))
    with open_view(which) as view:
        pixels = all_pixels(view)
        truth = render_pixels(view, pixels, spp=1024, seed=1)[0, :, 0]
        found = estimated(flow.Flow, view, pixels, spp=64, seed=0, batches=4)
    images, image = found.images, found.image
    np.testing.assert_array_equal(pose_jacobian(which, spp=64).image.reshape(-1, 3), image)
    for shown, stands_out in ((image[:, 0], False), (images.mean(axis=0)[:, 0], True)):
        error = shown - truth
        assert (np.abs(error).max() > 5.0 * error.std()) == stands_out


@pytest.mark.parametrize("name", ["gaussian", "mitchell", "lanczos", "box"])
def test_the_image_of_few_paths_is_finite(name: str) -> None:
    with open_view(lamp_before_a_wall(name)) as view:
        found = estimated(flow.Flow, view, all_pixels(view), spp=4, seed=0, batches=4)
    assert np.isfinite(found.image).all()


def lamp_before_a_wall(filter_name: str) -> dict[str, Any]:
    light = {"type": "area", "radiance": {"type": "rgb", "value": 20.0}}
    lamp = {"type": "sphere", "center": [0.2, 0.1, 2.0], "radius": 0.4, "emitter": light}
    return scene(wall=wall(texture()), lamp=lamp, sensor=with_filter(filter_name))


# Paths


GLASS = {"type": "sphere", "center": [0.2, 0.1, 2.0], "radius": 0.4, "bsdf": {"type": "dielectric"}}


@pytest.mark.parametrize(
    "integrator", [{"type": "path", "max_depth": 6, "rr_depth": 2}, {"type": "path", "max_depth": 1}]
)
def test_the_path_tracer_is_mitsubas_path(
    integrator: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same radiance from the same random numbers, to rounding, and with its roulette."""
    monkeypatch.setattr(paths, "SPARING", 1.0)
    which = scene(wall=wall(texture()), ball=GLASS) | {"integrator": integrator}
    with open_view(which) as view:
        lanes = Lanes.of(view, all_pixels(view), 8)
        ray, _ = camera_ray(view, lanes.centre, mi.Point2f(0.5, 0.5))
        world = move_ray(ray, opaque_transform(view.pose))
        tracers = paths.tracer(view), paths.IntegratorTracer()
        ours, mitsubas = (
            np.array(
                t.trace(view, lane_sampler(lanes.pixel, lanes.batch, seeding(3)), world).light,
                dtype=np.float64,
            )
            for t in tracers
        )
    assert isinstance(tracers[0], paths.PathTracer)
    different = np.abs(ours - mitsubas) > 1e-4 * (1.0 + mitsubas)
    assert different.mean() < 1e-3  # rounding may flip a choice between reflection and refraction


def grey_room(depth: int = 24, rr_depth: int = 2) -> dict[str, Any]:
    """A closed room with textured walls, lit by a ball behind a pillar."""
    diffuse = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.6}}
    grey = {"type": "twosided", "bsdf": diffuse}
    inside = {"type": "cube", "to_world": T().translate([0, 0, 1]).scale(2.0), "bsdf": grey}
    radiance = {"type": "area", "radiance": {"type": "rgb", "value": 20.0}}
    lamp = {"type": "sphere", "center": [1.2, 1.4, 1.0], "radius": 0.2, "emitter": radiance}
    pillar = {"type": "cube", "to_world": T().translate([0.7, 0.4, 1.6]).scale([0.2, 0.8, 0.2]), "bsdf": grey}
    objects = {"inside": inside, "picture": wall(texture(), depth=2.9, half=1.5), "pillar": pillar}
    integrator = {"type": "path", "max_depth": depth, "rr_depth": rr_depth}
    dark = {"type": "point", "position": [0, 0, 0], "intensity": {"type": "rgb", "value": 0.0}}
    return scene(light=dark, lamp=lamp, sensor=camera(24, 18), **objects) | {"integrator": integrator}


@pytest.mark.slow
def test_roulette_changes_no_mean_and_saves_variance(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of `path`, image and Jacobian, to 4 combined errors; not those of paths cut short.

    At equal paths the Jacobian's noise is less by a third.
    """
    batches, found = 32, []
    for sparing, depth in ((1.0, 24), (1.0, 24), (paths.SPARING, 24), (paths.SPARING, 3)):
        monkeypatch.setattr(paths, "SPARING", sparing)
        with open_view(grey_room(depth)) as view:
            pixels, seed = all_pixels(view), len(found)
            found.append(measured(flow.Flow, view, pixels, spp=32 * batches, seed=seed, batches=batches))
    reference = found[0][0].mean(axis=0)
    means, noise = [], []
    for values, images in found[1:]:
        sums = np.column_stack([images.mean(axis=(1, 2)), np.einsum("kncj,ncj->kj", values, reference)])
        means.append((sums.mean(axis=0), sums.std(axis=0, ddof=1) / np.sqrt(batches)))
        noise.append(values.var(axis=0, ddof=1).sum(axis=(0, 1)))
    (mean, error), *others = means
    spared, shorter = (np.abs(m - mean) / np.hypot(e, error) for m, e in others)
    assert np.all(spared < 4.0)
    assert np.all(shorter > 4.0)
    assert np.all(noise[1] < 0.67 * noise[0])


@pytest.mark.parametrize(
    ("integrator", "expected"),
    [
        ({"type": "path"}, paths.PathTracer),
        ({"type": "prb"}, paths.PathTracer),
        ({"type": "direct"}, paths.PathTracer),
        ({"type": "direct", "emitter_samples": 4}, paths.IntegratorTracer),
        ({"type": "path", "hide_emitters": True}, paths.IntegratorTracer),
        ({"type": "volpath"}, paths.IntegratorTracer),
        ({"type": "prb_basic"}, paths.IntegratorTracer),
    ],
)
def test_other_estimators_are_called_as_they_are(integrator: dict[str, Any], expected: type) -> None:
    with open_view(textured_wall() | {"integrator": integrator}) as view:
        assert isinstance(paths.tracer(view), expected)


class Impostor(mi.SamplingIntegrator):
    """A Python integrator that calls itself `path` and returns a constant."""

    def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True) -> Any:
        del scene, sampler, medium, active
        return mi.Color3f(0.25) + 0.0 * ray.d.x, mi.Bool(True), []

    def to_string(self) -> str:
        return "PathIntegrator[\n  max_depth = 3,\n  rr_depth = 5\n]"

    __repr__ = __str__ = to_string


def test_a_python_integrator_is_called_whatever_it_calls_itself() -> None:
    with open_view(textured_wall(), integrator=Impostor(mi.Properties())) as view:
        assert isinstance(paths.tracer(view), paths.IntegratorTracer)
        values, image = measured(flow.Flow, view, all_pixels(view), spp=16, seed=0, batches=4)
    assert image.mean() == pytest.approx(0.25, abs=2e-3)  # the pilot weights' noise
    assert np.abs(values).max() < 1.0


def test_no_garbage_is_collected_while_paths_are_traced() -> None:
    """A scene that died between two calls of one kernel made Dr.Jit abort."""
    collecting: list[bool] = []

    class Witness(Impostor):
        def sample(self, *arguments: Any, **named: Any) -> Any:
            collecting.append(gc.isenabled())
            return super().sample(*arguments, **named)

    with open_view(textured_wall(), integrator=Witness(mi.Properties())) as view:
        measured(flow.Flow, view, all_pixels(view), spp=4, seed=0, batches=4)
    assert collecting
    assert not any(collecting)
    assert gc.isenabled()


@functools.cache
def wall_by(integrator: str) -> np.ndarray:
    limit = {} if integrator.startswith("direct") else {"max_depth": 2}
    with open_view(textured_wall(sensor=camera(16, 12)), integrator={"type": integrator} | limit) as view:
        seed = 1 if integrator == "path" else 2
        return measured(flow.Flow, view, all_pixels(view), spp=256, seed=seed, batches=16)[0]


USUAL = ["prb_basic", "volpath", "prb_projective"]
OTHERS = ["direct", "prb", "prbvolpath", "volpathmis", "direct_projective"]


@pytest.mark.slow
@pytest.mark.parametrize("name", [*USUAL, *(pytest.param(name, marks=pytest.mark.slow) for name in OTHERS)])
def test_every_integrator_that_returns_radiance_gives_the_jacobian_of_path(name: str) -> None:
    """Slope of the projection onto `path`'s columns, to 4 standard errors of 16 batches and 1 %."""
    values, path = wall_by(name), wall_by("path")
    slope = np.einsum("kncj,ncj->kj", values, path.mean(axis=0)) / np.diag(information(path))
    error = slope.std(axis=0, ddof=1) / 4.0
    assert np.all(error < 0.02)
    assert np.all(np.abs(slope.mean(axis=0) - 1.0) < 4 * error + 0.01)


# View term


@pytest.mark.parametrize(
    "bsdf",
    [
        {"type": "roughconductor", "alpha": 0.2},
        {"type": "roughplastic", "alpha": 0.2},
        {"type": "roughdielectric", "alpha": 0.3},
        {"type": "principled", "roughness": 0.4, "metallic": 0.5},
        {"type": "twosided", "bsdf": {"type": "roughconductor", "alpha": 0.3}},
    ],
    ids=lambda bsdf: bsdf["type"],
)
def test_lobes_turn_as_the_bsdf_does(bsdf: dict[str, Any]) -> None:
    """Forward mode against central differences of f; away from grazing, where those are inaccurate."""
    n, step = 500, 2e-3
    rng = np.random.default_rng(4)
    wi, wo, tangent = (v / np.linalg.norm(v, axis=0) for v in rng.normal(size=(3, 3, n)))
    wi[2], wo[2] = np.abs(wi[2]) + 0.4, np.abs(wo[2]) + 0.2
    wi, wo = wi / np.linalg.norm(wi, axis=0), wo / np.linalg.norm(wo, axis=0)
    tangent -= wi * np.sum(wi * tangent, axis=0)
    tangent /= np.linalg.norm(tangent, axis=0)

    def vector(value: np.ndarray) -> mi.Vector3f:
        return mi.Vector3f(*(mi.Float(row.astype(np.float32)) for row in value))

    with open_view(scene(wall=wall() | {"bsdf": bsdf})) as view:
        ray = mi.Ray3f(mi.Point3f(dr.zeros(mi.Float, n), 0.0, 1.0), mi.Vector3f(0.0, 0.0, 1.0))
        hit = view.scene.ray_intersect(ray)
        values = []
        for sign in (1.0, -1.0):
            hit.wi = dr.normalize(vector(wi + sign * step * tangent))
            values.append(np.array(hit.bsdf().eval(mi.BSDFContext(), hit, vector(wo)), dtype=np.float64))
        hit.wi = vector(wi)
        seen = paths.Seen(hit, mi.Color3f(0.0), [(vector(wo), mi.Color3f(1.0))])
        got = _turn_of_lobes(seen, hit.to_world(vector(tangent)), mi.Bool(True))
        turned = np.array(got, dtype=np.float64)
    expected = (values[0] - values[1]) / (2 * step)
    assert turned == pytest.approx(expected, abs=5e-3 * np.abs(expected).max())


def test_diffuse_flat_scenes_need_no_view_term() -> None:
    with open_view(textured_wall()) as view:
        assert ViewTerm.of(view, paths.tracer(view)) is None


# Tiles


@pytest.mark.slow
def test_tiles_change_nothing_and_calls_repeat_bit_for_bit_with_contours(scenes: Path) -> None:
    options: dict[str, Any] = {"spp": 16, "size": (48, 40)}
    boxes, sigma = scenes / "boxes" / "boxes.xml", Gaussian(0.01)
    with pytest.warns(PrecisionWarning):  # sixteen paths
        whole, again, tiled = (
            pose_bound(boxes, sigma, tile=t, **options).information for t in (128, 128, 16)
        )
    assert np.array_equal(whole.matrix, again.matrix)
    assert misfit(tiled.matrix, whole.matrix) < 1e-12


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")
def test_principal_point_and_crop_window_are_those_of_finite_differences() -> None:
    """Of a textured wall behind a box, within 4 standard errors; the plain film's information is another."""
    sensor = camera(48, 36) | {"principal_point_offset_x": 0.15, "principal_point_offset_y": -0.1}
    window = {"crop_width": 24, "crop_height": 15, "crop_offset_x": 17, "crop_offset_y": 4}
    cropped = sensor | {"film": sensor["film"] | window}
    which = {
        "wall": wall(texture()),
        "box": {"type": "cube", "to_world": T().translate([0, 0.4, 2]).scale(0.3)},
    }
    flowing, differences = (
        pose_bound(scene(sensor=cropped, **which), Gaussian(0.1), method=method, spp=spp).information
        for method, spp in (("flow", 256), ("finite_difference", 4096))
    )
    plain = pose_bound(scene(sensor=camera(24, 15), **which), Gaussian(0.1), spp=256).information
    error = np.hypot(*(np.diagonal(F.standard_error) for F in (flowing, differences)))
    expected = np.diagonal(differences.matrix)
    assert np.all(4.0 * error < 0.25 * expected)
    assert np.all(np.abs(np.diagonal(flowing.matrix) - expected) < 4.0 * error + 0.02 * expected)
    assert np.abs(np.diagonal(plain.matrix) / expected - 1.0).max() > 0.5


# Kernels


def test_a_new_pose_seed_subset_or_sample_count_compiles_nothing() -> None:
    gc.collect()  # BSDFs of earlier scenes are part of a kernel's virtual calls while they live
    which = mi.load_dict(scene(wall=wall() | {"bsdf": {"type": "roughplastic", "alpha": 0.2}}))
    turn = se3.exp(np.array([0.01, 0.02, -0.03, 0.01, 0.02, 0.03]))

    def compiled(count: int, spp: int, seed: int, move: np.ndarray) -> int:
        with open_view(which) as view:
            pose = view.pose @ move
        with open_view(which, pose=pose) as view:
            dr.kernel_history_clear()
            measured(flow.Flow, view, all_pixels(view)[:count], spp=spp, seed=seed, batches=4)
            return sum(not kernel.get("cache_hit", True) for kernel in dr.kernel_history())

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        compiled(100, 16, 0, np.eye(4))
        assert compiled(57, 32, 1 << 40, turn) == 0
        assert compiled(300, 24, 2, turn @ turn) == 0


KERNEL_SCENES = {
    "glossy": scene(
        wall=wall() | {"bsdf": {"type": "roughplastic", "alpha": 0.2}},
        ball={"type": "sphere", "center": [0.2, 0.1, 2.0], "radius": 0.3},
    ),
    "thin lens": scene(
        wall=wall(texture()),
        box={"type": "cube", "to_world": T().translate([-0.4, 0.2, 2.0]).scale(0.2)},
        sensor=camera() | THIN,
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", KERNEL_SCENES)
def test_twenty_views_run_the_kernels_of_the_first(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Poses (some that see nothing), sizes of tiles, subsets, seeds and sample counts, all at random.

    The first view shows a contour, and suspects that its flow does not close: what no earlier view has met is
    compiled when it is.
    """
    monkeypatch.setattr(flow, "suspects", lambda *_: np.ones(len(_[-1].number), dtype=bool))
    monkeypatch.setattr(flow, "breaches", lambda *_: np.zeros(len(_[-1].number), dtype=bool))
    gc.collect()  # BSDFs of earlier scenes are part of a kernel's virtual calls while they live
    which, rng = mi.load_dict(KERNEL_SCENES[name]), np.random.default_rng(3)
    used: list[set[str]] = []
    with open_view(which) as view:
        first = view.pose
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for i in range(20):
            twist = rng.normal(size=6) * [0.5, 0.5, 0.5, 0.6, 0.6, 0.6]
            if i % 7 == 6:
                twist = np.array([0.0, 0.0, 0.0, 0.0, np.pi, 0.0])
            few = str(rng.choice(["random:0.3", "random:0.005", "gradient:0.2"]))
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", PrecisionWarning)
                dr.kernel_history_clear()
                pose_bound(
                    which,
                    Gaussian(0.1),
                    pose=first if i == 0 else first @ se3.exp(twist),
                    spp=int(rng.choice([8, 16, 24])),
                    seed=int(rng.integers(1 << 40)),
                    tile=int(rng.choice([16, 32, 128])),
                    pixels=None if i % 4 == 0 else few,
                )
            used.append({kernel["hash"] for kernel in dr.kernel_history([dr.KernelType.JIT])})
    assert len(used[0]) > 5
    assert set().union(*used[1:]) <= used[0]
