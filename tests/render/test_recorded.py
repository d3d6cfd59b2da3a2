"""Recorded kernels: bit for bit what tracing gives, whatever is changed in the scene between two calls."""

from __future__ import annotations

import gc
from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from small_scenes import T, camera, scene, texture, wall

from mitsuba_crb import pose_jacobian, se3
from mitsuba_crb.render import recorded
from mitsuba_crb.render import view as scene_module
from mitsuba_crb.render.arrays import upload
from mitsuba_crb.render.recorded import Recorder, join, split
from mitsuba_crb.render.view import open_view

OPTIONS: dict[str, Any] = {"spp": 16, "size": (24, 18)}
SCENE = scene(
    wall=wall(texture()),
    ball={"type": "sphere", "center": [0.3, 0.1, 2.0], "radius": 0.3, "bsdf": {"type": "roughplastic"}},
    box={"type": "cube", "to_world": T().translate([-0.4, 0.2, 2.0]).scale(0.2)},
    rod={
        "type": "cylinder",
        "p0": [0, -0.2, 2],
        "p1": [0.4, -0.2, 2],
        "radius": 0.1,
        "bsdf": {"type": "principled"},
    },
    lamp={"type": "point", "position": [1.0, 1.0, 0.0], "intensity": {"type": "rgb", "value": 3.0}},
)


@pytest.fixture
def traced(monkeypatch: pytest.MonkeyPatch) -> Callable[..., np.ndarray]:
    """The Jacobian with nothing recorded."""

    def jacobian(which: mi.Scene, **options: Any) -> np.ndarray:
        with monkeypatch.context() as patch:
            patch.setattr(recorded, "_state", lambda _scene: None)
            return pose_jacobian(which, **OPTIONS | options).batch_values

    return jacobian


def ours(which: mi.Scene, **options: Any) -> np.ndarray:
    return pose_jacobian(which, **OPTIONS | options).batch_values


def change(which: mi.Scene, name: str, value: Callable[[Any], Any]) -> None:
    """Set the only parameter whose name ends so."""
    params = mi.traverse(which)
    (key,) = (key for key in params.keys() if key.endswith(name))  # noqa: SIM118
    params[key] = value(params[key])
    params.update()


CHANGES: dict[str, tuple[str, Callable[[Any], Any]]] = {
    "texture": ("wall.bsdf.reflectance.data", lambda data: type(data)(0.5 * np.array(data))),
    "light": ("lamp.intensity.value", lambda value: 2.0 * value),
    "vertices": ("box.vertex_positions", lambda value: value + 0.02),
    "roughness": ("ball.bsdf.alpha", lambda _: mi.Float(0.4)),
    "refraction": ("ball.bsdf.eta", lambda _: mi.Float(1.8)),
    "field of view": ("camera.x_fov", lambda _: mi.Float(55.0)),
    "lamp's share": ("lamp.sampling_weight", lambda _: 7.0),
    "metal": ("rod.bsdf.metallic.value", lambda _: mi.Float(1.0)),
    "texture's scale": ("wall.bsdf.reflectance.to_uv", lambda value: type(value)().scale(1.7)),
    "texture's size": ("wall.bsdf.reflectance.data", lambda data: type(data)(np.array(data)[::2, ::2])),
    "near plane": ("camera.near_clip", lambda _: 2.5),  # the last: it hides all but the wall
}


@pytest.mark.slow
def test_what_changes_in_the_scene_is_seen(traced: Callable[..., np.ndarray]) -> None:
    """One after the other. A principled material has a metallic lobe only once its metal is set."""
    which = mi.load_dict(SCENE)
    before = ours(which)
    for name, what in CHANGES.items():
        change(which, *what)
        after = ours(which)
        assert not np.array_equal(after, before), name
        assert np.array_equal(after, traced(which)), name
        before = after


def bitmap(seed: int, *shape: int, low: float = 0.1, high: float = 0.9) -> dict[str, Any]:
    values = np.random.default_rng(seed).uniform(low, high, shape).astype(np.float32)
    return {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(values)}


def ball(x: float, y: float, bsdf: dict[str, Any]) -> dict[str, Any]:
    return {"type": "sphere", "center": [x, y, 2.2], "radius": 0.25, "bsdf": bsdf}


def rgb(value: float) -> dict[str, Any]:
    return {"type": "rgb", "value": value}


PRINCIPLED = {"type": "principled", "roughness": 0.3, "metallic": 0.4, "spec_tint": 0.2, "clearcoat": 0.3}
BLEND = {"type": "blendbsdf", "weight": 0.3, "x": {"type": "diffuse"}, "y": {"type": "roughconductor"}}
BUMPY = {"type": "bumpmap", "height": bitmap(1, 16, 16, 1, high=0.2), "bsdf": {"type": "diffuse"}}
NORMALS = {"type": "normalmap", "normalmap": bitmap(2, 16, 16, 3, low=0.4), "bsdf": {"type": "roughplastic"}}
SPOT = {"type": "spot", "to_world": T().look_at([0, 1, 0], [0, 0, 3], [0, 0, 1]), "intensity": rgb(4.0)}
PLUGINS = {
    "materials and lamps": scene(
        wall=wall(texture()),
        plastics=ball(-0.5, 0.3, {"type": "roughplastic"}),
        plastic=ball(0.0, 0.3, {"type": "plastic"}),
        gold=ball(0.5, 0.3, {"type": "roughconductor", "material": "Au", "distribution": "ggx"}),
        glass=ball(-0.5, -0.3, {"type": "roughdielectric"}),
        principled=ball(0.0, -0.3, PRINCIPLED),
        blend=ball(0.5, -0.3, BLEND),
        point={"type": "point", "position": [1, 1, 0], "intensity": rgb(3.0)},
        spot=SPOT,
        sun={"type": "directional", "direction": [0.3, -0.2, 1.0], "irradiance": rgb(1.0)},
    ),
    "shapes and textures": scene(
        wall=wall() | {"bsdf": NORMALS},
        lamp={
            "type": "rectangle",
            "to_world": T().translate([0, 1.5, 2]).rotate([1, 0, 0], 90).scale(0.3),
            "emitter": {"type": "area", "radiance": bitmap(3, 8, 8, 3, high=2.0)},
        },
        box={
            "type": "cube",
            "to_world": T().translate([-0.4, 0.2, 2]).scale(0.2),
            "bsdf": {"type": "twosided", "side": {"type": "diffuse"}},
        },
        post={"type": "cylinder", "p0": [0.2, -0.4, 2], "p1": [0.2, 0.2, 2.1], "radius": 0.15, "bsdf": BUMPY},
        disk={
            "type": "disk",
            "to_world": T().translate([0.6, 0.3, 2]).rotate([0, 1, 0], 170).scale(0.3),
            "bsdf": {"type": "mask", "opacity": 0.6, "inner": {"type": "diffuse"}},
        },
        glass=ball(-0.5, -0.3, {"type": "dielectric"}),
        mirror=ball(0.0, -0.6, {"type": "conductor", "material": "Ag"}),
    )
    | {"light": {"type": "envmap", "bitmap": bitmap(4, 8, 16, 3)["bitmap"]}},
}


def changed(name: str, value: Any) -> Any:
    """Another value of a parameter; None of those that cannot be changed by themselves."""
    if isinstance(value, bool) or any(part in name for part in ("film", "faces", "count", "shutter")):
        return None
    if dr.is_tensor_v(value):
        return type(value)(np.array(value)[::2])
    if "to_uv" in name:
        return type(value)().scale(1.7)
    if "ransform" in type(value).__name__:  # far for one of them, so that the scene's bounds change, too
        return value @ type(value)().translate([30.0, 2.0, 1.0] if "box" in name else [0.03, 0.02, 0.01])
    return 1.1 * value if isinstance(value, float) or dr.is_float_v(value) else None


@pytest.mark.slow
@pytest.mark.parametrize("name", PLUGINS)
def test_every_parameter_that_changes_is_seen(name: str, traced: Callable[..., np.ndarray]) -> None:
    which = mi.load_dict(PLUGINS[name])
    params = mi.traverse(which)
    seen = 0
    ours(which)
    for key in params.keys():  # noqa: SIM118  no dictionary
        value = params[key]
        other = changed(key, value)
        if other is None or key.startswith("camera.to_world"):
            continue
        params[key] = other
        params.update()
        assert np.array_equal(ours(which), traced(which)), key
        params[key] = value
        params.update()
        seen += 1
    assert seen > 35


@pytest.mark.parametrize("name", ["near plane", "metal"])
def test_a_change_that_nobody_noticed_would_not_be_seen(
    name: str, monkeypatch: pytest.MonkeyPatch, traced: Callable[..., np.ndarray]
) -> None:
    """Negative control: what Mitsuba's objects hold besides arrays is baked into recordings."""
    scene_module._kept.clear()
    gc.collect()  # when another scene's objects go, everything is recorded anew
    which = mi.load_dict(SCENE)
    with monkeypatch.context() as patch:
        patch.setattr(recorded, "_state", lambda _scene: ([], []))
        ours(which)
        change(which, *CHANGES[name])
        after = ours(which)
    expected = traced(which)
    assert np.abs(after - expected).mean() > 0.01 * np.abs(expected).mean()


VIEWS: list[dict[str, Any]] = [
    {},
    {"sensor": "lens"},
    {"seed": 1 << 40},  # at another pose
    {"pixels": "random:0.2"},
    {"size": (16, 12), "spp": 8, "batches": 8},
    {"nuisances": ["fov", "principal_point"]},
    {"integrator": {"type": "path", "max_depth": 3}},
]
OTHERS: list[dict[str, Any]] = [
    {},
    {"sensor": "boxed"},
    {"integrator": "prb"},
    {"integrator": {"type": "path", "max_depth": 3}},
    {"integrator": {"type": "path", "max_depth": 4}},
    {"integrator": {"type": "path", "hide_emitters": True}},
    {"integrator": "prb", "nuisances": ["rod.bsdf.metallic.value", "lamp.intensity.value"]},
]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("several", "tracings"),
    [(VIEWS, 8), (OTHERS, 13)],
    ids=["views", "others"],
)
def test_views_seeds_subsets_and_sizes_are_what_tracing_gives(
    several: list[dict[str, Any]],
    tracings: int,
    monkeypatch: pytest.MonkeyPatch,
    traced: Callable[..., np.ndarray],
) -> None:
    """And so are the nuisances of the film, other integrators, and other sensors of the scene."""
    scene_module._kept.clear()
    gc.collect()  # when another scene's objects go, everything is recorded anew
    lens = camera() | {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 2.0, "id": "lens"}
    box = {"type": "hdrfilm", "width": 32, "height": 24, "rfilter": {"type": "box"}}
    which = mi.load_dict(SCENE | {"second": lens, "third": camera() | {"id": "boxed", "film": box}})
    with open_view(which) as view:
        pose = view.pose @ se3.exp(np.array([0.05, -0.02, 0.1, 0.02, 0.1, -0.05]))
    several = [options | {"pose": pose} if "seed" in options else options for options in several]
    found = [ours(which, **options) for options in several]
    calls: list[str] = []
    monkeypatch.setattr(Recorder, "ready", _counting(Recorder.ready, calls))
    again = [ours(which, **options) for options in several]
    # The lens, hidden emitters and what nuisances move are traced.
    assert len(calls) <= tracings
    for options, first, second in zip(several, found, again, strict=True):
        expected = traced(which, **options)
        assert np.array_equal(first, expected), options
        assert np.array_equal(second, expected), options


@pytest.mark.slow
def test_other_scenes_come_and_go(traced: Callable[..., np.ndarray]) -> None:
    """Their materials are targets of every kernel's calls as long as they live."""
    first = mi.load_dict({name: part for name, part in SCENE.items() if name not in ("box", "rod")})
    with open_view(first) as view:  # keeps its recorder, whatever is opened meanwhile
        recorder = view.recorder
    expected = ours(first)
    for alpha in (0.1, 0.2):
        other = mi.load_dict(scene(wall=wall() | {"bsdf": {"type": "roughconductor", "alpha": alpha}}))
        assert np.isfinite(ours(other)).all()
        scene_module._kept[:] = [(first, recorder)]
        assert np.array_equal(ours(first), expected)
        del other
        gc.collect()
        assert np.array_equal(ours(first), expected)
    assert np.array_equal(traced(first), expected)


@pytest.mark.slow
def test_a_scene_is_traced_once_and_kept_until_another_is_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    scene_module._kept.clear()
    gc.collect()
    calls: list[str] = []
    monkeypatch.setattr(Recorder, "ready", _counting(Recorder.ready, calls))
    which = mi.load_dict(SCENE)

    def first(scene: mi.Scene) -> None:
        # The second has more blocks to look at again: Dr.Jit takes the sizes of the first for the ratio.
        for seed in (0, 1):
            ours(scene, seed=seed)

    first(which)
    traced_at_first = len(calls)
    for seed in (2, 3, 4):
        ours(which, seed=seed)
    assert traced_at_first > 3
    assert len(calls) == traced_at_first
    assert scene_module._kept[0][0] is which
    first(mi.load_dict(SCENE))
    assert scene_module._kept[0][0] is not which
    assert len(calls) == 2 * traced_at_first
    pose_jacobian(SCENE, **OPTIONS)
    assert not scene_module._kept


def _counting(ready: Callable[..., Any], calls: list[str]) -> Callable[..., Any]:
    """As `ready`, noting whenever a body is traced."""

    def counted(self: Recorder, name: str, body: Any, *rest: Any) -> Any:
        def noted(arrays: Any) -> Any:
            calls.append(name)
            return body(arrays)

        return ready(self, name, noted, *rest)

    return counted


class Grey(mi.BSDF):
    """A diffuse material that holds its albedo where Mitsuba cannot see it."""

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.albedo = 0.5
        self.m_flags = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide
        self.m_components = [self.m_flags]

    def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
        del ctx, sample1
        out = mi.BSDFSample3f()
        out.wo = mi.warp.square_to_cosine_hemisphere(sample2)
        out.pdf = mi.warp.square_to_cosine_hemisphere_pdf(out.wo)
        out.eta, out.sampled_type = 1.0, mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
        out.sampled_component = mi.UInt32(0)
        return out, mi.Color3f(self.albedo) & (active & (si.wi.z > 0.0))

    def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        del ctx
        value = self.albedo / np.pi * mi.warp.square_to_cosine_hemisphere_pdf(wo) * np.pi
        return mi.Color3f(value) & (active & (si.wi.z > 0.0) & (wo.z > 0.0))

    def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        del ctx
        return dr.select(active & (si.wi.z > 0.0), mi.warp.square_to_cosine_hemisphere_pdf(wo), 0.0)

    def to_string(self) -> str:
        return "Grey"

    def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)


@pytest.mark.slow
def test_what_python_objects_hold_is_never_baked_in() -> None:
    mi.register_bsdf("grey", Grey)
    material = Grey(mi.Properties("grey"))
    which = mi.load_dict(scene(wall=wall() | {"bsdf": material}, lamp=SCENE["lamp"]))
    before = ours(which)
    material.albedo = 0.25
    assert ours(which) == pytest.approx(0.5 * before, rel=1e-4, abs=1e-5)


@pytest.mark.slow
def test_a_parameter_without_a_value_is_no_obstacle() -> None:
    hair = {"type": "hair", "eumelanin": 0.2, "pheomelanin": 0.4}
    strand = {"type": "cylinder", "p0": [-0.5, 0, 2], "p1": [0.5, 0, 2], "radius": 0.2, "bsdf": hair}
    assert np.isfinite(ours(mi.load_dict(scene(wall=wall(texture()), strand=strand)))).all()


def test_what_cannot_be_recorded_is_traced() -> None:
    """Here because the function reads an array that nobody gave it."""
    hidden = upload(mi.Float, np.array([2.0, 3.0]))
    with open_view(mi.load_dict(SCENE)) as view:
        for x in (1.0, 5.0):
            arrays = [upload(mi.Float, np.array([x, 1.0]))]
            ready = view.recorder.ready("hidden", lambda given: given[0] * hidden, view, arrays, ())
            assert np.array_equal(np.array(ready()), [2.0 * x, 3.0])


@pytest.mark.parametrize("error", [ZeroDivisionError, KeyboardInterrupt])
def test_a_failure_while_recording_is_no_one_elses(error: type[BaseException]) -> None:
    failures = [error("once")]

    def body(given: list[Any]) -> Any:
        if failures:
            raise failures.pop()
        return 2.0 * given[0]

    with open_view(mi.load_dict(SCENE)) as view:
        arrays = [upload(mi.Float, np.array([1.0, 2.0]))]
        with pytest.raises(error, match="once"):
            view.recorder.ready("failing", body, view, arrays, ())()
        assert np.array_equal(np.array(view.recorder.ready("failing", body, view, arrays, ())()), [2.0, 4.0])


def test_no_other_array_takes_the_place_of_a_parameters() -> None:
    """Dr.Jit gives the indices of arrays that are gone to new ones."""
    which = mi.load_dict(SCENE)
    recorder = Recorder(which)
    assert recorder.fits(Recorder(which))
    for i in range(50):
        change(which, "lamp.intensity.value", lambda _, i=i: mi.Color3f(2.0 + i))
        assert not recorder.fits(Recorder(which))


def test_keys_of_equal_parts_are_told_apart() -> None:
    """Dr.Jit takes the second True of nested tuples for the first one."""
    with open_view(mi.load_dict(SCENE)) as view:
        arrays = [upload(mi.Float, np.array([1.0, 2.0]))]
        for key in ((True, (False, True)), (True, (False, False))):
            factor = 3.0 if key[1][1] else 5.0
            ready = view.recorder.ready("keyed", lambda given, f=factor: f * given[0], view, arrays, key)
            assert np.array_equal(np.array(ready()), [factor, 2.0 * factor])


def test_arrays_and_all_else_are_told_apart_and_put_together_again() -> None:
    with open_view(mi.load_dict(SCENE)) as view:
        value = (view.pixel_filter, None, [1, mi.Float(3.0), "text"], mi.Vector2f(1.0, 2.0))
        arrays, key = split(value)
        again = join(value, iter(arrays))
    assert len(arrays) == 3
    assert isinstance(repr(key), str)
    assert again[0].table.nodes is arrays[0]
    assert again[0].radius == value[0].radius
    assert again[1:3] == (None, value[2])
    assert split((1, value[1]))[1] != split((2, value[1]))[1]
