"""Loading, choosing and posing: what is wrong with an input is said in one line."""

from __future__ import annotations

import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from small_scenes import T, camera, scene, textured_wall, wall

from mitsuba_crb import pose_bound, se3
from mitsuba_crb.errors import (
    FilmError,
    IntegratorError,
    MitsubaCRBError,
    OptionError,
    PoseError,
    SceneError,
    SceneWarning,
    SensorError,
    TracingError,
)
from mitsuba_crb.noise import Gaussian
from mitsuba_crb.render.scene import SceneFile, load_scene
from mitsuba_crb.render.view import View, open_view

SENSOR = '<sensor type="perspective"><film type="hdrfilm"/></sensor>'


def _message(error: pytest.ExceptionInfo[MitsubaCRBError]) -> str:
    text = str(error.value)
    assert "\n" not in text
    return text


def _open(of: Any, **options: Any) -> View:
    with open_view(of, **options) as view:
        return view


def _file(tmp_path: Path, inside: str) -> Path:
    path = tmp_path / "scene.xml"
    path.write_text(f'<scene version="3.0.0">{inside}</scene>')
    return path


@pytest.mark.parametrize(
    ("inside", "expected"),
    [
        (SENSOR + "\n<shape", ["line 2"]),
        (SENSOR + '\n\n<shape type="sfere"/>', ["line 3", "sfere", "no plugin"]),
        (
            SENSOR + '\n<shape type="sphere"><float name="rafius" value="3"/></shape>',
            ["line 2", "rafius", "remove"],
        ),
        (
            SENSOR + '<shape type="obj"><string name="filename" value="no.obj"/></shape>',
            ["no.obj", "put the file"],
        ),
        (
            SENSOR + '<texture type="bitmap"><string name="filename" value="no.png"/></texture>',
            ["no.png", "put the file"],
        ),
        (
            '<sensor type="perspective"><animation name="to_world"/></sensor>',
            ["animated transforms", "one <transform>"],
        ),
        (SENSOR + '<shape type="sphere"><float name="radius" value="$r"/></shape>', ["$r", "-D name=value"]),
    ],
)
def test_a_malformed_file_is_named_with_its_line_and_a_cure(
    tmp_path: Path, inside: str, expected: list[str]
) -> None:
    path = _file(tmp_path, inside)
    with pytest.raises(SceneError) as error:
        load_scene(path)
    message = _message(error)
    for part in [str(path), *expected]:
        assert part in message


@pytest.mark.slow
@pytest.mark.parametrize(
    "load", ["load_scene", "lambda file: as_scene({'type': 'scene', 'wall': wall(file)})"]
)
def test_a_scene_with_an_openexr_texture_loads_on_one_core(load: str, scenes: Path) -> None:
    """Mitsuba alone never comes back: in a process of its own."""
    code = (
        "import drjit as dr\n"
        "from mitsuba_crb.render.scene import as_scene, load_scene, use_mitsuba\n"
        "def wall(file):\n"
        "    image = {'type': 'bitmap', 'filename': file.replace('warehouse.xml', 'cartons.exr')}\n"
        "    return {'type': 'rectangle', 'bsdf': {'type': 'diffuse', 'reflectance': image}}\n"
        "use_mitsuba()\n"
        "dr.set_thread_count(1)\n"
        f"({load})({str(scenes / 'warehouse' / 'warehouse.xml')!r})\n"
        "print(dr.thread_count())\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=30, check=True
    )
    assert done.stdout == "1\n"


def test_a_missing_file_a_folder_and_a_scene_without_scene_are_told_apart(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="no scene file"):
        load_scene(tmp_path / "absent.xml")
    with pytest.raises(SceneError, match="folder"):
        load_scene(tmp_path)


def test_an_unknown_default_lists_the_known_ones(tmp_path: Path) -> None:
    path = _file(tmp_path, '<default name="radius" value="1"/>' + SENSOR)
    with pytest.raises(SceneError) as error:
        load_scene(path, radios="3")
    assert "radios" in _message(error)
    assert "it has radius" in _message(error)


def test_a_default_changes_the_scene(tmp_path: Path) -> None:
    path = _file(
        tmp_path,
        '<default name="fov" value="20"/>'
        + SENSOR.replace("><film", '><float name="fov" value="$fov"/><film'),
    )
    with (
        open_view(load_scene(path), size=(8, 6)) as narrow,
        open_view(load_scene(path, fov="90"), size=(8, 6)) as wide,
        open_view(SceneFile(path, {"fov": "90"}), size=(8, 8)) as square,
    ):
        assert wide.camera.focal_length == pytest.approx(4.0, rel=1e-5)
        assert square.camera.focal_length == pytest.approx(4.0, rel=1e-5)
        assert narrow.camera.focal_length == pytest.approx(4.0 / np.tan(np.radians(10.0)), rel=1e-5)


def test_a_sensor_is_found_by_index_or_id_and_missing_ones_are_named() -> None:
    two = scene(other=camera(16, 8) | {"id": "other"})
    with open_view(two, sensor="other") as view:
        assert (view.variable, view.size) == ("other", (16, 8))
    with open_view(two, sensor=0) as by_index, open_view(two, sensor="1") as by_text:
        assert {by_index.variable, by_text.variable} == {"camera", "other"}
    with pytest.raises(SensorError, match="out of range: the scene has 2"):
        _open(two, sensor=2)
    with pytest.raises(SensorError, match=r"ids: .*camera"):
        _open(two, sensor="third")
    nameless = mi.load_dict(scene())
    nameless.sensors()[0].set_id("object_0x55")
    with open_view(nameless) as view:
        assert view.variable == "sensor 0"


def test_unsupported_sensors_films_and_integrators_are_refused_by_name() -> None:
    bare = {key: value for key, value in scene().items() if key != "camera"}
    with pytest.raises(SensorError, match="no sensor"):
        _open(bare)
    with pytest.raises(SensorError, match=r"Orthographic.*supported: perspective, thinlens"):
        _open(scene(sensor={"type": "orthographic"}))
    film = {"type": "hdrfilm", "pixel_format": "xyz"}
    with pytest.raises(FilmError, match=r"xyz.*set it to rgb"):
        _open(scene(sensor=camera() | {"film": film}))
    for integrator in ({"type": "aov", "aovs": "d:depth"}, "ptracer", "moment"):
        with pytest.raises(IntegratorError, match="no radiance"):
            _open(scene(), integrator=integrator)
    with pytest.raises(IntegratorError, match="no plugin of this name"):
        _open(scene(), integrator="pathh")


def test_a_scene_that_names_no_integrator_gets_path() -> None:
    bare = {key: value for key, value in scene().items() if key != "integrator"}
    with open_view(bare) as view:
        assert view.integrator.class_name() == "PathIntegrator"


def test_reflections_and_scales_are_no_poses() -> None:
    mirrored = camera() | {"to_world": T().scale([-1, 1, 1])}
    with pytest.raises(PoseError, match="the sensor's to_world contains a reflection"):
        _open(scene(sensor=mirrored))
    with pytest.raises(PoseError):
        _open(scene(), pose=np.diag([2.0, 2.0, 2.0, 1.0]))


def test_sizes_must_be_positive_whole_numbers() -> None:
    for size in ((0, 4), (4, -1), ("a", 4)):
        with pytest.raises(OptionError, match="size"):
            _open(scene(), size=size)  # type: ignore[arg-type]


def test_the_scene_is_as_before_afterwards_even_after_an_error() -> None:
    cropped = camera(64, 48)
    cropped["film"] |= {"crop_width": 20, "crop_height": 10, "crop_offset_x": 3, "crop_offset_y": 5}
    loaded = mi.load_dict(scene(wall=wall(), sensor=cropped))
    before = str(loaded.sensors()[0])
    with pytest.warns(SceneWarning, match="crop window"), open_view(loaded, size=(8, 6)) as view:
        assert view.size == (8, 6)
    assert str(loaded.sensors()[0]) == before

    def fail() -> None:
        with open_view(loaded) as view:
            assert view.size == (20, 10)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert str(loaded.sensors()[0]) == before


@pytest.mark.filterwarnings("ignore:the film's crop window")
@pytest.mark.parametrize("failing", range(3))
def test_the_scene_is_as_before_after_a_failure_while_it_is_set_or_restored(
    failing: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    cropped = camera(64, 48)
    cropped["film"] |= {"crop_width": 20, "crop_height": 10, "crop_offset_x": 3, "crop_offset_y": 5}
    loaded = mi.load_dict(scene(wall=wall(), sensor=cropped))
    before = str(loaded.sensors()[0])
    update, calls = mi.SceneParameters.update, iter(range(100))

    def fail_once(parameters: Any, *arguments: Any) -> Any:
        if next(calls) == failing:
            raise KeyboardInterrupt
        return update(parameters, *arguments)

    monkeypatch.setattr(mi.SceneParameters, "update", fail_once)
    with pytest.raises(KeyboardInterrupt):
        _open(loaded, size=(32, 24))
    assert str(loaded.sensors()[0]) == before
    assert _open(loaded).size == (20, 10)


def test_a_sensor_that_is_in_use_is_refused_not_read_at_the_identity() -> None:
    loaded = mi.load_dict(textured_wall())
    shared = mi.load_dict(scene(sensor=loaded.sensors()[0], wall=wall()))
    with open_view(loaded) as view:
        for other in (loaded, shared, loaded):
            with pytest.raises(SensorError, match=r"sensor camera .*in use.*load the scene again"):
                _open(other)
    assert _open(shared).pose == pytest.approx(view.pose)
    assert not np.allclose(view.pose, np.eye(4))


def test_two_sensors_of_one_scene_are_open_together_unless_a_film_they_share_is_resized() -> None:
    first, second = camera(target=(0.1, 0.2, 3)), camera(target=(-0.3, 0.1, 3)) | {"id": "other"}
    expected = [pytest.approx(np.array(kind["to_world"].matrix), abs=1e-6) for kind in (first, second)]
    loaded = mi.load_dict(scene(sensor=first, other=second))
    # Mitsuba makes equal films one.
    assert len({sensor.film().ptr for sensor in loaded.sensors()}) == 1
    with open_view(loaded, sensor="camera") as a, open_view(loaded, sensor="other") as b:
        assert [a.pose, b.pose] == expected
        with pytest.raises(SensorError, match="sensor other is in use: "):
            _open(loaded, sensor="other")
    for sizes in ((None, (8, 6)), ((8, 6), None), ((8, 6), (8, 6))):
        with (
            open_view(loaded, sensor="camera", size=sizes[0]),
            pytest.raises(SensorError, match=r"sensor other .*shares its film"),
        ):
            _open(loaded, sensor="other", size=sizes[1])
    second["film"] = second["film"] | {"width": 30}
    apart = mi.load_dict(scene(sensor=first, other=second))
    with open_view(apart, sensor="camera", size=(8, 6)) as a, open_view(apart, sensor="other") as b:
        assert [a.pose, b.pose] == expected
        assert (a.size, b.size) == ((8, 6), (30, 24))


def test_threads_take_turns_with_a_sensor() -> None:
    loaded = mi.load_dict(textured_wall())
    expected = _open(loaded).pose

    def pose(_: int) -> Any:
        with open_view(loaded) as view:
            time.sleep(0.01)
            return view.pose

    with ThreadPoolExecutor(4) as pool:
        assert all(np.array_equal(found, expected) for found in pool.map(pose, range(8)))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")
def test_threads_that_measure_one_scene_get_the_bits_of_one_thread() -> None:
    """Also while one of them sets the scene's parameters for its finite differences."""
    first, second = camera(16, 12), camera(16, 12, target=(0.5, 0.1, 3)) | {"id": "other"}
    loaded = mi.load_dict(textured_wall(sensor=first, other=second))

    def information(sensor: str) -> Any:
        unknown = ["fov"] if sensor == "other" else []
        bound = pose_bound(loaded, Gaussian(0.01), sensor=sensor, spp=16, nuisances=unknown)
        return bound.information.matrix

    jobs = ["camera", "other"] * 3
    expected = [information(sensor) for sensor in jobs]
    with ThreadPoolExecutor(2) as pool:
        found = list(pool.map(information, jobs))
    assert all(np.array_equal(a, b) for a, b in zip(found, expected, strict=True))


def test_a_pose_replaces_to_world_without_touching_the_scene() -> None:
    pose = se3.exp([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    with open_view(textured_wall(), pose=pose) as view:
        assert view.pose == pytest.approx(pose)


def test_nobody_can_change_the_depths_that_a_view_keeps() -> None:
    with open_view(textured_wall()) as view, pytest.raises(ValueError, match="read-only"):
        view.visible_depth[:] = 1.0


def test_dictionaries_and_objects_that_are_no_scenes_are_refused() -> None:
    with pytest.raises(SceneError, match="'type': 'scene'"):
        _open({"type": "sphere"})
    with pytest.raises(SceneError, match="plugin"):
        _open({"type": "scene", "a": {"type": "sfere"}})
    with pytest.raises(SceneError, match="not int"):
        _open(3)  # type: ignore[arg-type]


class _Failing(mi.SamplingIntegrator):
    """Raises when it is traced."""

    def sample(self, *_: Any, **__: Any) -> Any:
        raise AttributeError("no such\nattribute at 0x7f8dc2bd7b80")

    def to_string(self) -> str:
        return "failing"


def test_what_an_integrator_raises_while_it_is_traced_is_one_line() -> None:
    with pytest.raises(
        TracingError, match="cannot be traced with integrator _Failing: no such attribute"
    ) as error:
        pose_bound(textured_wall(), Gaussian(0.01), integrator=_Failing(mi.Properties()), spp=16)
    assert "0x" not in _message(error)


def test_what_a_caller_raises_while_a_view_is_open_stays_what_it_is() -> None:
    for kind in (RuntimeError, ZeroDivisionError):
        with pytest.raises(kind, match="own"), open_view(textured_wall()):
            raise kind("own")
