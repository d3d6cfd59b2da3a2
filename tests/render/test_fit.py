"""What people's files say of film, sensor and integrator, against closed forms and against plainer files."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from small_scenes import camera, scene, textured_wall, wall

from mitsuba_crb import SceneFile, load_scene, pose_bound
from mitsuba_crb.errors import OptionError, SceneError, SceneWarning, SensorError
from mitsuba_crb.measure.pictures import Gathering
from mitsuba_crb.measure.tile_jacobian import TileJacobian
from mitsuba_crb.noise import Gaussian
from mitsuba_crb.render.view import View, open_view

# Few samples on small images.
pytestmark = pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")

SIGMA = Gaussian(0.01)
RAMP = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
property float r
property float g
property float b
element face 2
property list uchar int vertex_indices
end_header
-8 -8 2 -0.3 -0.3 -0.3
8 -8 2 1.3 1.3 1.3
8 8 2 1.3 1.3 1.3
-8 8 2 -0.3 -0.3 -0.3
3 0 2 1
3 0 3 2
"""
"""A wall two units away, whose radiance is 0.5 + 0.1 X."""

LOOK = '<transform name="to_world"><lookat origin="0,0,0" target="0,0,1" up="0,1,0"/></transform>'


def film(width: int, height: int, more: str = "") -> str:
    size = f'<integer name="width" value="{width}"/><integer name="height" value="{height}"/>'
    return f'<film type="hdrfilm">{size}{more}<rfilter type="box"/></film>'


def sensor(inside: str, name: str = "cam") -> str:
    return f'<sensor type="perspective" id="{name}">{LOOK}{inside}</sensor>'


def written(
    folder: Path, sensors: str, integrator: str = '<integrator type="path"/>', more: str = ""
) -> Path:
    (folder / "ramp.ply").write_text(RAMP)
    file = folder / "scene.xml"
    file.write_text(
        f"""<scene version="3.0.0">{integrator}{sensors}{more}
        <shape type="ply" id="wall"><string name="filename" value="ramp.ply"/>
          <bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf>
          <emitter type="area"><texture type="mesh_attribute" name="radiance">
            <string name="name" value="vertex_color"/></texture></emitter>
        </shape></scene>"""
    )
    return file


def opened(source: Any, **options: Any) -> View:
    with open_view(source, **options) as view:
        assert view.camera.focal.shape == (2,)
        return view


def information(source: Any, **options: Any) -> Any:
    return pose_bound(source, options.pop("noise", SIGMA), spp=64, **options).information.matrix


def ramp_information(width: int, height: int, focal: float) -> dict[tuple[int, int], float]:
    """Of pixels (x, y) [focal lengths] that see 0.5 + 0.1 X on a wall at Z = 2: a sum over pixel centres.

    Yaw turns a point by 2 (1 + x²), pitch by 2 x y, roll by 2 y along X; motion along z is -x of it.
    """
    x, y = np.meshgrid(
        (np.arange(width) + 0.5 - width / 2) / focal, (np.arange(height) + 0.5 - height / 2) / focal
    )
    slopes = {0: np.ones_like(x), 2: x, 3: 2 * x * y, 5: 2 * y}
    return {(k, k): 3 * np.sum((0.1 * slope) ** 2) / 1e-4 for k, slope in slopes.items()}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("says", "focal"),
    [
        (
            '<string name="fov_axis" value="y"/><float name="fov" value="40"/>',
            16 / math.tan(math.radians(20)),
        ),
        (
            '<string name="fov_axis" value="smaller"/><float name="fov" value="40"/>',
            16 / math.tan(math.radians(20)),
        ),
        (
            '<string name="fov_axis" value="larger"/><float name="fov" value="40"/>',
            24 / math.tan(math.radians(20)),
        ),
        (
            '<string name="fov_axis" value="diagonal"/><float name="fov" value="40"/>',
            math.hypot(24, 16) / math.tan(math.radians(20)),
        ),
        ('<string name="focal_length" value="50mm"/>', math.hypot(48, 32) * 50 / math.hypot(36, 24)),
        ('<float name="fov" value="40"/>', 24 / math.tan(math.radians(20))),
    ],
)
def test_another_shape_keeps_the_field_of_view_that_the_file_says(
    says: str, focal: float, tmp_path: Path
) -> None:
    file = written(tmp_path, sensor(says + film(64, 64)))
    with open_view(file, size=(48, 32)) as view:
        assert view.camera.focal == pytest.approx([focal] * 2, rel=1e-4)
        across = 2 * math.degrees(math.atan(24 / focal))
        assert view.camera.field_of_view_deg[0] == pytest.approx(across, rel=1e-4)
    found = information(file, size=(48, 32))
    for (i, j), value in ramp_information(48, 32, focal).items():
        assert found[i, j] == pytest.approx(value, rel=0.01)


def test_of_a_dictionary_too_and_an_object_of_another_shape_is_refused() -> None:
    upright = scene(sensor=camera(40, 30) | {"fov_axis": "y"}, wall=wall())
    kept = opened(upright).camera.focal[0] * 24 / 30
    assert opened(upright, size=(24, 24)).camera.focal[0] == pytest.approx(kept, rel=1e-5)
    loaded = mi.load_dict(upright)
    assert opened(loaded, size=(20, 15)).size == (20, 15)
    with pytest.raises(OptionError, match=r"40x30 pixels, and 24x24 is another shape.*file or dictionary"):
        opened(loaded, size=(24, 24))


def test_a_crop_window_that_a_size_drops_is_said(tmp_path: Path) -> None:
    crop = "".join(
        f'<integer name="crop_{name}" value="8"/>' for name in ("width", "height", "offset_x", "offset_y")
    )
    file = written(tmp_path, sensor(film(32, 32, crop)))
    assert opened(file).size == (8, 8)
    with pytest.warns(SceneWarning, match="crop window is left out"):
        assert opened(file, size=(32, 16)).size == (32, 16)


def test_any_id_names_a_sensor_and_a_size_is_that_of_one(tmp_path: Path) -> None:
    """The films are written alike, which makes them one object; "1" is an id before it is an index."""
    names = ("object_front", "_unnamed_1", "1")
    lenses = (30, 40, 50)
    sensors = "".join(
        sensor(f'<float name="fov" value="{fov}"/>' + film(32, 32), name)
        for name, fov in zip(names, lenses, strict=True)
    )
    file = written(tmp_path, sensors)
    for source in (file, load_scene(file)):
        for name, fov in zip(names, lenses, strict=True):
            small = opened(source, sensor=name, size=(16, 16))
            assert (small.variable, small.size) == (name, (16, 16))
            for other in names:
                assert opened(source, sensor=other).size == (32, 32)
            assert small.camera.field_of_view_deg[0] == pytest.approx(fov, rel=1e-4)
        with pytest.raises(SensorError, match="ids: object_front, _unnamed_1, 1;"):
            opened(source, sensor="nobody")


@pytest.mark.slow
def test_the_children_of_a_batch_are_sensors_of_their_own(tmp_path: Path) -> None:
    parts = [
        sensor('<float name="fov" value="60"/>' + film(64, 64), name)
        .replace('origin="0,', f'origin="{x},')
        .replace('target="0,', f'target="{x},')
        for name, x in (("left", 0.05), ("right", -0.05))
    ]
    batch = written(tmp_path, f'<sensor type="batch">{"".join(parts)}{film(64, 32)}</sensor>')
    with pytest.raises(SensorError, match=r"sensor 0 is a batch of left, right.*--sensor left"):
        opened(batch)
    together = {name: information(batch, sensor=name) for name in ("left", "right")}
    for name, part in zip(("left", "right"), parts, strict=True):
        alone = information(written(tmp_path, part.replace('value="64"', 'value="32"')), sensor=name)
        assert np.array_equal(alone, together[name])


def test_a_child_of_a_batch_sees_what_the_batch_shows_whatever_its_axis(tmp_path: Path) -> None:
    """Mitsuba sets the film of a batch's children and leaves the horizontal field of view that they had."""
    axis = '<string name="fov_axis" value="y"/>'
    lens = f'<sensor type="perspective">{axis}<float name="fov" value="{{}}"/></sensor>'
    children = lens.format(30) + lens.format(40)
    file = written(tmp_path, f'<sensor type="batch">{children}{film(64, 32)}</sensor>')
    with pytest.raises(SensorError, match="a batch of 0:0, 0:1"):
        opened(file)
    rig = mi.traverse(load_scene(file))
    expected = next(value for key, value in rig if key.endswith("sensor1.x_fov"))
    view = opened(file, sensor="0:1")
    assert view.size == (32, 32)
    assert view.camera.field_of_view_deg[0] == pytest.approx(float(expected[0]), rel=1e-4)


@pytest.mark.slow
def test_alpha_measures_nothing_and_luminance_a_third_of_a_grey_scene(tmp_path: Path) -> None:
    found = {}
    for name in ("rgb", "rgba", "luminance", "luminance_alpha"):
        pixel_format = f'<string name="pixel_format" value="{name}"/>'
        file = written(tmp_path, sensor(film(32, 32, pixel_format)))
        found[name] = pose_bound(file, SIGMA, spp=64)
        assert "one channel" in found[name].provenance["noise"]["description"] or name.startswith("rgb")
    matrices = {name: bound.information.matrix for name, bound in found.items()}
    assert np.array_equal(matrices["rgba"], matrices["rgb"])
    assert np.array_equal(matrices["luminance_alpha"], matrices["luminance"])
    assert matrices["luminance"] == pytest.approx(
        matrices["rgb"] / 3, rel=1e-5, abs=1e-6 * matrices["rgb"].max()
    )


@pytest.mark.slow
def test_luminance_of_a_coloured_scene_is_that_of_its_weighted_sum() -> None:
    """Red 0.2126, green 0.7152, blue 0.0722: a scene of one colour is a grey one times that weight."""
    luminance = camera(24, 18)
    luminance["film"] = luminance["film"] | {"pixel_format": "luminance"}
    values = np.repeat(np.random.default_rng(0).uniform(0.1, 0.9, (32, 32, 1)), 3, axis=2)
    paper = wall({"type": "bitmap", "bitmap": mi.Bitmap(values.astype(np.float32)), "raw": True})
    grey = information(scene(sensor=camera(24, 18), wall=paper)) / 3
    for channel, weight in enumerate((0.2126, 0.7152, 0.0722)):
        colour = np.eye(3)[channel].tolist()
        light = {"type": "constant", "radiance": {"type": "rgb", "value": colour}}
        found = information(scene(sensor=luminance, wall=paper) | {"light": light})
        assert found == pytest.approx(grey * weight**2, rel=1e-3, abs=1e-3 * weight**2 * grey.max())


@pytest.mark.slow
def test_pictures_of_a_luminance_film_are_of_its_one_channel(tmp_path: Path) -> None:
    """Their information adds up to the bound's, with the noise that was given and with the default."""
    luminance = '<string name="pixel_format" value="luminance"/>'
    file = written(tmp_path, sensor(film(16, 16, luminance)))
    for noise in (SIGMA, None):
        gathering = Gathering()

        def on_tile(tile: TileJacobian, *_: int, into: Gathering = gathering) -> None:
            into.add(tile.pixels, tile.mean, tile.batch_values, tile.weights)

        bound = pose_bound(file, noise, spp=64, on_tile=on_tile)
        pictures = gathering.pictures(bound.information, (16, 16))
        scaled = bound.information.matrix * bound.information.scale[:, None] * bound.information.scale
        assert pictures.information.sum() == pytest.approx(np.trace(scaled), rel=1e-6)


PATH = '<integrator type="path"><integer name="max_depth" value="2"/></integrator>'


@pytest.fixture(scope="module")
def by_path(tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    """The information that the path tracer finds."""
    file = written(tmp_path_factory.mktemp("path"), sensor(film(16, 16)), PATH)
    return np.asarray(information(file))


@pytest.mark.parametrize(
    ("integrator", "words"),
    [
        (f'<integrator type="moment">{PATH}</integrator>', None),
        (
            f'<integrator type="aov"><string name="aovs" value="d:depth"/>{PATH}</integrator>',
            None,
        ),
        (f'<integrator type="stokes">{PATH}</integrator>', "stokes.*path"),
        (PATH.replace('"path"', '"sppm"'), "sppm.*path"),
        (PATH.replace('"path"', '"path-guiding"'), "path-guiding.*path"),
        ('<integrator type="depth"/>', "depth.*path"),
        (PATH.replace('"path"', '"ptracer"'), "ptracer.*path"),
        (PATH.replace("</", '<boolean name="strictNormals" value="true"/></'), "strictNormals of integrator"),
    ],
)
def test_an_integrator_without_radiance_gives_way_to_a_path_tracer(
    integrator: str, words: str | None, by_path: np.ndarray, tmp_path: Path
) -> None:
    file = written(tmp_path, sensor(film(16, 16)), integrator)
    if words is None:
        found = information(file)
    else:
        with pytest.warns(SceneWarning, match=words) as told:
            found = information(file)
        assert len(told) == 1
    assert found == pytest.approx(by_path, rel=1e-3, abs=1e-3 * by_path.max())


def test_the_sensors_medium_is_not_passed_by_without_a_word(tmp_path: Path) -> None:
    fog = (
        '<medium type="homogeneous" id="fog"><rgb name="sigma_t" value="0.5"/><rgb name="albedo" value="0"/>'
        "</medium>"
    )
    inside = sensor('<ref name="medium" id="fog"/>' + film(8, 8))
    with pytest.warns(SceneWarning, match="prbvolpath ignores the sensor's medium: volpath is used"):
        view = opened(written(tmp_path, fog + inside, '<integrator type="prbvolpath"/>'))
    assert view.integrator.class_name() == "VolumetricPathIntegrator"
    with pytest.warns(SceneWarning, match="path ignores the medium"):
        opened(written(tmp_path, fog + inside))
    assert opened(written(tmp_path, fog + inside, "")).integrator.class_name() == "VolumetricPathIntegrator"


@pytest.mark.slow
def test_light_that_path_loses_on_masks_is_not_lost_without_a_word() -> None:
    """Half of what a half mask reflects: the half of the paths that pass it meet nothing."""
    sheet = wall() | {"bsdf": {"type": "mask", "opacity": 0.5, "bsdf": {"type": "diffuse"}}}
    lamp = {"type": "point", "position": [0.8, 1.2, -1.0], "intensity": {"type": "rgb", "value": 20.0}}
    masked = scene(wall=sheet, light=lamp)
    with pytest.warns(SceneWarning, match="path loses light on masked surfaces.*use volpath or prb"):
        lossy = opened(masked)
    whole = opened(masked | {"integrator": {"type": "volpath", "max_depth": 2}})
    lossy, whole = (
        np.array(mi.render(mi.load_dict(masked), integrator=view.integrator, spp=256)).mean()
        for view in (lossy, whole)
    )
    assert lossy == pytest.approx(0.5 * whole, rel=0.02)
    for harmless in (
        scene(wall=sheet),  # a constant light
        masked | {"integrator": {"type": "prb", "max_depth": 2}},
        scene(wall=wall() | {"bsdf": {"type": "thindielectric"}}, light=lamp),
        scene(wall=wall() | {"bsdf": {"type": "hair"}}, light=lamp),
    ):
        opened(harmless)  # warnings are errors


def test_what_is_not_needed_is_left_out_in_one_warning(tmp_path: Path) -> None:
    more = '<boolean name="high_quality_edges" value="true"/>'
    sampler = '<sampler type="independent"><integer name="dimension" value="2"/></sampler>'
    file = written(tmp_path, sensor(film(16, 16, more) + sampler), '<path value="../nowhere"/>' + PATH)
    with pytest.warns(
        SceneWarning, match=r"nowhere.*high_quality_edges of film.*dimension of sampler"
    ) as told:
        opened(file)
    assert len(told) == 1


@pytest.mark.slow
def test_a_parameter_of_one_of_two_equal_materials_is_its_alone() -> None:
    board = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.8}}}
    move = mi.ScalarTransform4f
    boards = {
        "left": board | {"to_world": move().translate([0.5, 0, 2]).rotate([0, 1, 0], 180).scale(0.4)},
        "right": board | {"to_world": move().translate([-0.5, 0, 2]).rotate([0, 1, 0], 180).scale(0.4)},
    }
    described = scene(sensor=camera(24, 18), **boards)
    one, other = (
        pose_bound(described, SIGMA, spp=64, nuisances=[f"{name}.bsdf.reflectance.value"])
        for name in ("left", "right")
    )
    # Of both boards together a common reflectance would show no difference between them.
    assert one.joint is not None
    assert other.joint is not None
    assert not np.allclose(one.information.matrix, other.information.matrix, rtol=1e-3)
    with pytest.raises(Exception, match="merged") as error:
        pose_bound(mi.load_dict(described), SIGMA, spp=64, nuisances=["right.bsdf.reflectance.value"])
    assert "object_" not in str(error.value)


@pytest.mark.slow
def test_a_scene_beyond_the_far_plane_is_said_to_be(tmp_path: Path) -> None:
    file = written(tmp_path, sensor('<float name="far_clip" value="1.5"/>' + film(16, 16)))
    with pytest.warns(SceneWarning, match=r"256 of 256 rays.*from 2, beyond far_clip 1\.5"):
        bound = pose_bound(file, SIGMA, spp=16)
    assert np.isinf([*bound.position_std, *bound.rotation_std_deg]).all()
    with pytest.raises(Exception, match=r"black \(nothing is visible.*far_clip"):
        pose_bound(file, spp=16)
    near = written(tmp_path, sensor('<float name="near_clip" value="5"/>' + film(16, 16)))
    with pytest.warns(SceneWarning, match="before near_clip 5"):
        pose_bound(near, SIGMA, spp=16)


def test_a_scene_file_with_its_defaults_is_a_scene(scenes: Path) -> None:
    room = SceneFile(scenes / "white_wall" / "white_wall.xml", {"width": "20", "height": "10"})
    assert opened(room).size == (20, 10)
    with pytest.raises(SceneError, match="no <default> named widht"):
        opened(SceneFile(room.path, {"widht": "20"}))


@pytest.mark.slow
def test_a_measurement_says_its_field_of_view() -> None:
    bound = pose_bound(textured_wall(sensor=camera(24, 18)), SIGMA, spp=16)
    across, down = bound.provenance["fov_deg"]
    assert math.tan(math.radians(down / 2)) == pytest.approx(
        math.tan(math.radians(across / 2)) * 18 / 24, rel=1e-4
    )
