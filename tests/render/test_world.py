"""Worlds look as they should: known albedos, colours, textures and cameras; and as the same scene in XML."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from glb_files import SQUARE, SQUARE_FACES, SQUARE_UV, Glb
from PIL import Image

from mitsuba_crb import SceneFile, load_scene, load_world, pose_bound
from mitsuba_crb.errors import OptionError, PoseError, SceneError, SceneWarning
from mitsuba_crb.noise import Gaussian
from mitsuba_crb.render.backend import use_mitsuba
from mitsuba_crb.render.fingerprint import fingerprint
from mitsuba_crb.render.pixels import render_pixels
from mitsuba_crb.render.scene import as_scene
from mitsuba_crb.render.view import open_view

use_mitsuba()

import mitsuba as mi  # noqa: E402  the variant comes first

FRONT = np.array([[-1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 2], [0, 0, 0, 1]])
"""Two units before the square, x to the right and y up in the image."""
BEHIND = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -2], [0, 0, 0, 1]])

WEIGHTS = 3e-3
"""How far the filter's weights leave the mean of a uniform picture from its radiance."""


def image(scene: Any, pose: np.ndarray | None = FRONT, *, spp: int = 16, size=(8, 8)) -> np.ndarray:
    """A picture (H, W, 3)."""
    with open_view(scene, pose=pose, size=size) as view:
        rows, columns = np.indices(view.size[::-1])
        pixels = np.stack([columns, rows], axis=-1).reshape(-1, 2)
        values = render_pixels(view, pixels, spp=spp, seed=0)
        return values[0].reshape(*rows.shape, 3)


def lit(file: Path, light: str = "baked", **options: Any) -> SceneFile:
    """A world's file with its light, and a camera that sees the square's middle half."""
    return SceneFile(file, {"light": light, "fov": "30", **options})


def textured(file: Path, pixels: np.ndarray, **material: Any) -> Path:
    """A GLB file of the square with an image on it."""
    glb = Glb()
    texture = glb.texture(pixels, magFilter=9728)
    rough = {"baseColorTexture": {"index": texture}, **material}
    glb.mesh(uv=SQUARE_UV, material=glb.material(pbrMetallicRoughness=rough))
    return glb.write(file)


def test_a_convex_body_under_a_constant_light_shows_its_albedo(tmp_path: Path) -> None:
    box = trimesh.creation.box((2, 2, 0.5))
    box.visual.vertex_colors = np.tile(np.uint8([188, 94, 255]), (8, 1))
    box.export(tmp_path / "box.ply")
    expected = [0.50289, 0.11193, 1.0]
    seen = image(lit(tmp_path / "box.ply", "constant:2"), spp=256)
    # Over 64 pixels of 2 %.
    np.testing.assert_allclose(seen.mean(axis=(0, 1)), 2.0 * np.array(expected), rtol=0.01)
    baked = image(lit(tmp_path / "box.ply"))
    np.testing.assert_allclose(baked.mean(axis=(0, 1)), expected, rtol=WEIGHTS)


@pytest.mark.slow
@pytest.mark.parametrize("light", ["baked", "constant:1"])
def test_an_image_lies_on_a_surface_as_it_is_and_on_both_of_its_sides(light: str, tmp_path: Path) -> None:
    pixels = np.uint8([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]])
    glb = textured(tmp_path / "a.glb", pixels, metallicFactor=0.0)
    (tmp_path / "a.obj").write_text(
        "mtllib a.mtl\nv -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nusemtl paint\n"
        "f 1/1 2/2 3/3 4/4\n"
    )
    (tmp_path / "a.mtl").write_text("newmtl paint\nmap_Kd a.png\n")
    # An OBJ's texture is interpolated: larger, so that its quarters are uniform away from their borders.
    Image.fromarray(pixels.repeat(64, axis=0).repeat(64, axis=1)).save(tmp_path / "a.png")
    for file in (glb, tmp_path / "a.obj"):
        front, behind = (image(lit(file, light), pose) for pose in (FRONT, BEHIND))
        corners = front[[0, 0, -1, -1], [0, -1, 0, -1]]
        assert (corners[:3].argmax(axis=1) == [0, 1, 2]).all()
        assert np.ptp(corners[3]) < 0.05
        mirrored = behind[[0, 0, -1, -1], [-1, 0, -1, 0]]
        assert (mirrored[:3].argmax(axis=1) == [0, 1, 2]).all()
        assert mirrored.max() > 0.5


def test_one_mesh_is_the_same_picture_in_all_formats(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(2)
    colours = np.random.default_rng(0).integers(0, 256, (len(ball.vertices), 3), dtype=np.uint8)
    ball.visual.vertex_colors = colours
    for ending in ("ply", "obj"):
        ball.export(tmp_path / f"a.{ending}")
    encoded = colours / 255.0
    decoded = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    glb = Glb()
    glb.mesh(ball.vertices, ball.faces, colours=decoded.astype(np.float32))
    glb.write(tmp_path / "a.glb")
    pose = FRONT.copy()
    pose[2, 3] = 6.0
    pictures = [image(lit(tmp_path / f"a.{ending}"), pose) for ending in ("ply", "obj", "glb")]
    assert pictures[0].std() > 0.01
    # OBJ is text of 8 digits.
    np.testing.assert_allclose(pictures[1], pictures[0], atol=1e-5)
    np.testing.assert_allclose(pictures[2], pictures[0], atol=1e-5)


def test_a_factor_of_a_texture_and_of_colours_multiplies_them(tmp_path: Path) -> None:
    grey = np.full((2, 2, 3), 188, np.uint8)
    file = textured(tmp_path / "a.glb", grey, baseColorFactor=[0.5, 1.0, 0.25, 1.0])
    np.testing.assert_allclose(
        image(lit(file)).mean(axis=(0, 1)), 0.50289 * np.array([0.5, 1.0, 0.25]), rtol=WEIGHTS
    )
    glb = Glb()
    half = glb.material(pbrMetallicRoughness={"baseColorFactor": [0.5, 0.5, 0.5, 1]})
    glb.mesh(colours=np.full((4, 3), 0.8, np.float32), material=half)
    np.testing.assert_allclose(image(lit(glb.write(tmp_path / "b.glb"))).mean(axis=(0, 1)), 0.4, rtol=WEIGHTS)


def test_unlit_files_are_baked_without_a_word_and_others_say_their_light(tmp_path: Path) -> None:
    glb = Glb()
    colour = {"baseColorFactor": [0.1, 0.2, 0.3, 1]}
    glb.mesh(material=glb.material(pbrMetallicRoughness=colour, extensions={"KHR_materials_unlit": {}}))
    file = glb.write(tmp_path / "a.glb")
    np.testing.assert_allclose(
        image(SceneFile(file, {"fov": "30"})).mean(axis=(0, 1)), [0.1, 0.2, 0.3], rtol=WEIGHTS
    )
    glb.mesh(translation=[0, 0, -1])
    with pytest.warns(SceneWarning, match="radiance 1 from everywhere"):
        world = load_world(glb.write(tmp_path / "b.glb"), fov=30)
    np.testing.assert_allclose(image(world).mean(axis=(0, 1)), [0.1, 0.2, 0.3], rtol=WEIGHTS)
    assert load_world(tmp_path / "b.glb", light="none").keys() == world.keys() - {"light"}


def test_a_normal_map_turns_surfaces_as_they_would_be_turned(tmp_path: Path) -> None:
    """Red is to the right of the image, green is up in it: against a square that is turned itself."""
    tilt = np.array([0.3, 0.2, np.sqrt(1.0 - 0.13)])
    pixel = np.round(255.0 * (0.5 + 0.5 * tilt)).astype(np.uint8)
    tilt = pixel / 255.0 * 2.0 - 1.0
    tilt /= np.linalg.norm(tilt)
    rough = {"baseColorFactor": [0.5, 0.5, 0.5, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0}
    glb = Glb()
    mapped = glb.material(
        pbrMetallicRoughness=rough, normalTexture={"index": glb.texture(np.tile(pixel, (2, 2, 1)))}
    )
    glb.mesh(uv=SQUARE_UV, material=mapped)
    # Vertex normals do the same, without a texture's space.
    plain = Glb()
    plain.mesh(normals=np.float32([tilt] * 4), material=plain.material(pbrMetallicRoughness=rough))
    pictures = []
    for name, made in (("map", glb), ("normals", plain)):
        world = load_world(made.write(tmp_path / f"{name}.glb"), light="none", fov=30)
        lamp = {"type": "directional", "direction": [-0.8, -0.3, -0.5], "irradiance": 1.0}
        pictures.append(image(world | {"lamp": lamp}).mean(axis=(0, 1)))
    # Mitsuba shadows bumps, by 1.4 % here; green that is down makes it 15 %, red to the left 56 %.
    np.testing.assert_allclose(pictures[0], pictures[1], rtol=0.03)


def test_masks_let_through_what_lies_behind(tmp_path: Path) -> None:
    pixels = np.zeros((2, 2, 4), np.uint8)
    pixels[..., 3] = [[255, 0], [0, 255]]
    glb = Glb()
    rough = {"baseColorTexture": {"index": glb.texture(pixels, magFilter=9728)}, "metallicFactor": 0.0}
    glb.mesh(uv=SQUARE_UV, material=glb.material(pbrMetallicRoughness=rough, alphaMode="MASK"))
    seen = image(lit(glb.write(tmp_path / "a.glb"), "constant:1"))
    corners = seen[[0, 0, -1, -1], [0, -1, 0, -1], 0]
    np.testing.assert_allclose(corners[[1, 2]], 1.0, rtol=0.05)
    assert corners[[0, 3]].max() < 0.2


def test_what_shines_in_a_file_lights_it(tmp_path: Path) -> None:
    glb = Glb()
    glb.mesh(
        material=glb.material(
            emissiveFactor=[0.5, 1, 0], pbrMetallicRoughness={"baseColorFactor": [0, 0, 0, 1]}
        )
    )
    seen = image(lit(glb.write(tmp_path / "a.glb"), "none"))
    np.testing.assert_allclose(seen.mean(axis=(0, 1)), [0.5, 1.0, 0.0], rtol=WEIGHTS)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["point", "spot", "directional"])
def test_lamps_of_a_file_light_it_as_they_should(kind: str, tmp_path: Path) -> None:
    """By E = I cos θ / r² of a point or within a spot, and E cos θ of a distant light."""
    glb = Glb()
    # Without a material it is diffuse.
    glb.mesh(colours=np.full((4, 3), 0.5, np.float32))
    lamp = {"type": kind, "intensity": 10.0, "color": [1.0, 0.5, 0.25]}
    if kind == "spot":
        lamp["spot"] = {"innerConeAngle": 0.5, "outerConeAngle": 0.6}
    glb.document["extensions"] = {"KHR_lights_punctual": {"lights": [lamp]}}
    # A lamp at (3, 0, 4) that shines along (-3, 0, -4)/5.
    turn = [0.0, float(np.sqrt(0.1)), 0.0, float(np.sqrt(0.9))]
    glb.node(
        translation=[3, 0, 4],
        rotation=turn,
        scale=[2, 2, 2],
        extensions={"KHR_lights_punctual": {"light": 0}},
    )
    seen = image(SceneFile(glb.write(tmp_path / "a.glb"), {"fov": "2"})).mean(axis=(0, 1))
    irradiance = 10.0 * 0.8 / (1.0 if kind == "directional" else 25.0)
    np.testing.assert_allclose(seen, 0.5 / np.pi * irradiance * np.array([1.0, 0.5, 0.25]), rtol=5e-3)
    assert image(lit(tmp_path / "a.glb")).mean() == pytest.approx(0.5, rel=WEIGHTS)


@pytest.mark.slow
@pytest.mark.parametrize(("up", "axis"), [("z", 2), ("y", 1), ("x", 0), ("-y", -1)])
def test_the_sky_is_where_up_says(up: str, axis: int, tmp_path: Path) -> None:
    file = textured(tmp_path / "a.glb", np.zeros((2, 2, 3), np.uint8))
    vertical = np.zeros(3)
    vertical[abs(axis)] = 1.0 if axis >= 0 else -1.0
    levels = []
    for towards in (vertical, -vertical):
        # Past the square, which is far away in either direction.
        pose = np.eye(4)
        side = np.eye(3)[(abs(axis) + 1) % 3]
        pose[:3, :3] = np.column_stack([side, np.cross(towards, side), towards])
        pose[:3, 3] = 50.0 * np.array([1.0, 2.0, 3.0])
        levels.append(image(lit(file, "sky", up=up), pose).mean())
    assert levels[0] > 0.01
    assert levels[1] == 0.0


def test_a_sky_asks_a_file_that_does_not_say_for_its_up(tmp_path: Path) -> None:
    trimesh.creation.box().export(tmp_path / "a.stl")
    with pytest.raises(OptionError, match="does not say which axis is up"):
        load_world(tmp_path / "a.stl", light="sky")
    file = textured(tmp_path / "a.glb", np.zeros((2, 2, 3), np.uint8))
    assert load_world(file, light="sky")["light"]["type"] == "sunsky"


def test_the_files_camera_is_the_scenes(tmp_path: Path) -> None:
    glb = Glb()
    glb.mesh(colours=np.float32([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]))
    glb.document["cameras"] = [{"type": "perspective", "perspective": {"yfov": 0.5, "aspectRatio": 2.0}}]
    glb.node(camera=0, name="left eye", translation=[0, 0, 2])
    file = glb.write(tmp_path / "a.glb")
    with open_view(SceneFile(file, {"light": "baked"})) as view:
        assert (view.variable, view.size) == ("left eye", (960, 480))
        np.testing.assert_allclose(view.pose, FRONT, atol=1e-6)
        # Half the height of the image is tan(yfov/2) focal lengths.
        assert 240.0 / view.camera.focal_length == pytest.approx(np.tan(0.25), rel=1e-5)
    seen = image(SceneFile(file, {"light": "baked"}), None, size=(16, 8))
    # Red grows to the right, green upwards, where the square shows.
    assert seen[4, 10, 0] > seen[4, 5, 0]
    assert seen[2, 8, 1] > seen[5, 8, 1]


def test_a_world_without_a_camera_asks_for_a_pose(tmp_path: Path) -> None:
    file = textured(tmp_path / "a.glb", np.zeros((2, 2, 3), np.uint8))
    with pytest.raises(PoseError, match="without a camera has; say its pose"), open_view(lit(file)):
        pass


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")
def test_information_is_that_of_the_same_scene_in_xml(tmp_path: Path) -> None:
    """A textured square before the sky: inside by its texture, at its border by the parallax term."""
    values = np.random.default_rng(1).integers(30, 220, (8, 8, 3), dtype=np.uint8)
    glb = Glb()
    smooth = {"baseColorTexture": {"index": glb.texture(values)}}
    glb.mesh(uv=SQUARE_UV, material=glb.material(pbrMetallicRoughness=smooth))
    file = glb.write(tmp_path / "a.glb")
    Image.fromarray(values).save(tmp_path / "a.png")
    # A rectangle's own texture coordinates have v up.
    (tmp_path / "a.xml").write_text(
        """<scene version="3.0.0"><integrator type="path"><integer name="max_depth" value="1"/></integrator>
        <sensor type="perspective"><float name="fov" value="60"/><film type="hdrfilm">
        <rfilter type="gaussian"/></film></sensor>
        <shape type="rectangle"><emitter type="area"><texture type="bitmap" name="radiance">
        <string name="filename" value="a.png"/><transform name="to_uv"><scale y="-1"/><translate y="1"/>
        </transform></texture></emitter></shape></scene>"""
    )
    pose = FRONT.copy()
    pose[:3, 3] = 0.3, -0.2, 3.0
    ours, theirs = (
        pose_bound(scene, Gaussian(0.01), pose=pose, size=(32, 24), spp=128, seed=seed).information
        for scene, seed in ((lit(file, fov="60"), 1), (tmp_path / "a.xml", 2))
    )
    scale = np.sqrt(np.outer(np.diag(theirs.matrix), np.diag(theirs.matrix)))
    error = np.hypot(ours.standard_error, theirs.standard_error)
    # Neither by chance nor because the errors are large.
    assert np.all(np.diag(error) < 0.05 * np.diag(scale))
    assert np.all(np.abs(ours.matrix - theirs.matrix) < 4.0 * error + 1e-4 * scale)


def test_a_worlds_fingerprint_is_of_its_contents(tmp_path: Path) -> None:
    one = textured(tmp_path / "a.glb", np.full((2, 2, 3), 10, np.uint8))
    two = textured(tmp_path / "b.glb", np.full((2, 2, 3), 11, np.uint8))
    letters = [fingerprint(as_scene(lit(file))[0], file) for file in (one, one, two)]
    assert letters[0] == letters[1] != letters[2]
    with pytest.raises(SceneError, match="has no <default> named spp; a world has up, light, fov"):
        load_scene(one, spp="4")


def test_a_colour_that_is_set_is_seen(tmp_path: Path) -> None:
    """Kernels that are recorded hold nothing of what a scene's parameters were."""
    pixels = np.full((4, 4, 3), 255, np.uint8)
    file = textured(tmp_path / "a.glb", pixels, baseColorFactor=[0.4, 0.4, 0.4, 1.0])
    scene = mi.load_dict(load_world(file, light="baked", fov=30))
    assert image(scene, size=(8, 6)).mean() == pytest.approx(0.4, rel=WEIGHTS)
    parameters = mi.traverse(scene)
    (name,) = (name for name, _ in parameters if name.endswith("radiance.data"))
    parameters[name] = 0.5 * parameters[name]
    parameters.update()
    assert image(scene, size=(8, 6)).mean() == pytest.approx(0.2, rel=WEIGHTS)


def test_meshes_of_one_material_are_one_and_have_a_name_of_its_own(tmp_path: Path) -> None:
    glb = Glb()
    paint, paper, wood = (
        glb.material(name=name, pbrMetallicRoughness={"baseColorFactor": [level, level, level, 1]})
        for name, level in (("a.paint", 0.2), ("a.paint", 0.4), ("camera", 0.6))
    )
    # Halves of the square, and what lies far behind it.
    glb.mesh(SQUARE * np.float32([0.5, 1, 1]), material=paint, name="left", translation=[-0.5, 0, 0])
    glb.mesh(material=paper, name="wall", translation=[0, 0, -1], scale=[9, 9, 1])
    glb.mesh(SQUARE * np.float32([0.5, 1, 1]), material=paint, name="right", translation=[0.5, 0, 0])
    glb.mesh(material=wood, name="camera", translation=[0, 0, -2])
    world = load_world(glb.write(tmp_path / "a.glb"), light="baked", fov=30)
    assert [name for name, part in world.items() if isinstance(part, mi.Mesh)] == [
        "a_paint",
        "wall",
        "camera 2",
    ]
    assert world["camera"]["type"] == "perspective"
    assert world["a_paint"].face_count() == 4
    np.testing.assert_allclose(image(world).mean(axis=(0, 1)), 0.2, rtol=WEIGHTS)


@pytest.mark.parametrize(
    ("light", "words"),
    [
        ("bakd", "did you mean baked"),
        ("constnat:1", "did you mean constant"),
        ("constant:-1", "radiance above 0"),
        ("constant:bright", "radiance above 0"),
        ("hall.exr", "no such file"),
        ("moon", "expected constant:L, sky, baked"),
    ],
)
def test_an_impossible_light_is_named_in_a_line(light: str, words: str, tmp_path: Path) -> None:
    file = textured(tmp_path / "a.glb", np.zeros((2, 2, 3), np.uint8))
    with pytest.raises(OptionError, match=f"--light {light}.*{words}") as raised:
        load_world(file, light=light, up="y")
    assert "\n" not in str(raised.value)


def test_a_light_file_that_is_damaged_is_named(tmp_path: Path) -> None:
    file = textured(tmp_path / "a.glb", np.zeros((2, 2, 3), np.uint8))
    (tmp_path / "hall.exr").write_bytes(b"no picture")
    with pytest.raises(SceneError, match=r"hall\.exr"), open_view(lit(file, str(tmp_path / "hall.exr"))):
        pass


@pytest.mark.parametrize(("option", "value"), [("up", "w"), ("fov", "190"), ("fov", "wide")])
def test_impossible_options_are_named(option: str, value: str, tmp_path: Path) -> None:
    file = textured(tmp_path / "a.glb", np.zeros((2, 2, 3), np.uint8))
    with pytest.raises(OptionError, match=option):
        load_world(file, light="sky", **{option: value})


def test_meshes_that_cannot_be_shown_are_refused_and_what_no_face_uses_is_not(tmp_path: Path) -> None:
    cases = {
        "no triangles": (SQUARE, SQUARE_FACES[:0]),
        "1 faces whose vertices are not numbers": (
            np.where(SQUARE[:, :1] + SQUARE[:, 1:2] > 1, np.nan, SQUARE),
            SQUARE_FACES[:1],
        ),
        "4 vertices and a face with vertex 9": (SQUARE, np.array([[0, 1, 9]])),
    }
    for words, (vertices, faces) in cases.items():
        glb = Glb()
        glb.mesh(vertices, faces)
        with pytest.raises(SceneError, match=words):
            load_world(glb.write(tmp_path / "a.glb"), light="baked")
    glb = Glb()
    glb.mesh(np.vstack([SQUARE, [[np.nan] * 3]]), SQUARE_FACES)
    seen = image(lit(glb.write(tmp_path / "a.glb")))
    np.testing.assert_allclose(seen.mean(axis=(0, 1)), 0.8, rtol=WEIGHTS)


@pytest.mark.parametrize("name", ["a.glb", "a.gltf", "a.obj", "a.ply", "a.stl"])
@pytest.mark.parametrize("contents", [None, b"", b"\xff\x00no such thing" * 30])
def test_files_without_a_world_are_refused_in_a_line(
    contents: bytes | None, name: str, tmp_path: Path
) -> None:
    if contents is not None:
        (tmp_path / name).write_bytes(contents)
    with pytest.raises(SceneError, match=name) as raised:
        load_world(tmp_path / name, light="baked")
    assert "\n" not in str(raised.value)


def test_a_cloud_of_points_is_said_to_be_one(tmp_path: Path) -> None:
    trimesh.PointCloud(np.random.default_rng(0).normal(size=(20, 3))).export(tmp_path / "a.ply")
    with pytest.raises(SceneError, match=r"a\.ply has no triangles, as a cloud of points"):
        load_world(tmp_path / "a.ply")


def test_others_files_are_read_as_mitsuba_reads_them(real_scenes: Path) -> None:
    for file in sorted((real_scenes / "cbox" / "meshes").glob("*.obj")):
        (mesh,) = (part for part in load_world(file, light="baked").values() if isinstance(part, mi.Mesh))
        theirs = mi.load_dict({"type": "obj", "filename": str(file)})
        corners = [
            np.array(shape.vertex_positions_buffer())
            .reshape(-1, 3)[np.array(shape.faces_buffer())]
            .reshape(-1, 9)
            for shape in (mesh, theirs)
        ]
        centres, expected = (c.reshape(-1, 3, 3).mean(axis=1) for c in corners)
        order, other = (np.lexsort(np.round(c, 3).T) for c in (centres, expected))
        np.testing.assert_allclose(centres[order], expected[other], rtol=1e-6, atol=1e-4)
