"""What cannot be measured is refused by the command in one line; odd geometry that can be is finite."""

from __future__ import annotations

import gc
import warnings
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from small_scenes import T, camera, scene, texture, wall

from mitsuba_crb import cli, pose_bound, pose_jacobian
from mitsuba_crb.errors import BlindSpotWarning, PoseError, SceneError
from mitsuba_crb.noise import Gaussian
from mitsuba_crb.scene import open_view

# Few samples on small images: that standard errors exceed 10 % is expected.
pytestmark = pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")

FILM = '<film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film>'
CAMERA = f'<sensor type="perspective">{FILM}</sensor>'


def integrator(name: str, inside: str = "") -> str:
    return f'{CAMERA}<integrator type="{name}">{inside}</integrator>'


@pytest.mark.parametrize(
    ("inside", "words"),
    [
        (f'<sensor type="orthographic">{FILM}</sensor>', ["OrthographicCamera", "perspective, thinlens"]),
        (
            f'<shape type="sphere"><sensor type="irradiancemeter">{FILM}</sensor></shape>',
            ["IrradianceMeter", "perspective, thinlens"],
        ),
        (
            f'<sensor type="perspective"><string name="distortion" value="0.1, 0.2"/>{FILM}</sensor>',
            ["distortion", "remove"],
        ),
        (integrator("ptracer"), ["ptracer", "no radiance", "path"]),
        (integrator("moment", '<integrator type="path"/>'), ["moment", "no radiance", "path"]),
        (integrator("aov", '<string name="aovs" value="d:depth"/>'), ["aov", "no radiance", "path"]),
        (integrator("depth"), ["depth", "no radiance", "path"]),
        (integrator("stokes", '<integrator type="path"/>'), ["Stokes", "polarized"]),
        (
            CAMERA + '<shape type="ply"><string name="filename" value="far.ply"/></shape>',
            ["3 vertices", "vertex 7", "export"],
        ),
        (
            CAMERA + '<shape type="ply"><string name="filename" value="empty.ply"/></shape>',
            ['"ply"', "correct"],
        ),
        (CAMERA + '<shape type="ply"><string name="filename" value="nan.ply"/></shape>', ["nan.ply"]),
    ],
    ids=lambda value: "" if isinstance(value, str) else value[0],
)
def test_the_command_names_what_it_refuses_and_exits_with_2(
    inside: str, words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    header = (
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        "element face {}\nproperty list uchar int vertex_indices\nend_header\n0 0 2\n1 0 2\n0 {} 2\n"
    )
    (tmp_path / "far.ply").write_text(header.format(1, 1) + "3 0 1 7\n")
    (tmp_path / "nan.ply").write_text(header.format(1, "nan") + "3 0 1 2\n")
    (tmp_path / "empty.ply").write_text(header.format(0, 1))
    file = tmp_path / "scene.xml"
    file.write_text(f'<scene version="3.0.0">{inside}<emitter type="constant"/></scene>')
    assert cli.run(["bound", str(file), "--spp", "4"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert "Traceback" not in err
    for word in words:
        assert word in err


def test_a_pose_that_is_not_finite_and_a_mesh_without_faces_are_named() -> None:
    nowhere = camera() | {"to_world": T(np.full((4, 4), np.nan))}
    with pytest.raises(PoseError, match="to_world holds NaN"), open_view(scene(sensor=nowhere)):
        pass
    with (
        pytest.raises(SceneError, match="mesh hollow has no faces"),
        open_view(scene(hollow=mi.Mesh("hollow", 0, 0))),
    ):
        pass


BLACK = {"type": "point", "position": [0, 0, 0]}
ROOM = {"type": "diffuse", "reflectance": {"type": "checkerboard", "to_uv": T().scale(4)}}
ODD: dict[str, dict[str, Any]] = {
    "camera inside a box": scene(
        room={"type": "cube", "bsdf": {"type": "twosided", "bsdf": ROOM}},
        light={"type": "point", "position": [0.3, 0.2, 0.1]},
    ),
    "camera at a sphere's centre": scene(
        globe={"type": "sphere", "radius": 2.0, "flip_normals": True, "bsdf": ROOM},
        light={"type": "point", "position": [0.3, 0.2, 0.1]},
    ),
    "camera inside glass": scene(
        wall=wall(texture()), ball={"type": "sphere", "radius": 1.0, "bsdf": {"type": "dielectric"}}
    )
    | {"integrator": {"type": "path", "max_depth": 4}},
    "camera in the plane of a surface": scene(
        wall=wall(texture()), floor={"type": "rectangle", "to_world": T().rotate([1, 0, 0], 90).scale(3)}
    ),
    "camera on a sphere": scene(
        wall=wall(texture()), ball={"type": "sphere", "center": [0, 0.5, 0], "radius": 0.5}
    ),
    "a sphere without extent": scene(
        wall=wall(texture()),
        dot={"type": "sphere", "center": [0, 0, 2], "radius": 0.0},
    ),
    "a narrow view": scene(wall=wall(texture()), sensor=camera(fov=0.01)),
    "a wide view": scene(wall=wall(texture()), sensor=camera(fov=179.0)),
}


@pytest.mark.parametrize("name", ODD)
def test_odd_places_and_shapes_give_finite_information(name: str) -> None:
    bound = pose_bound(ODD[name], Gaussian(0.01), spp=16)
    assert np.all(np.isfinite(bound.information.matrix))
    assert np.all(np.isfinite(bound.information.standard_error))
    assert np.max(bound.information.matrix) > 0.0


@pytest.mark.parametrize("light", ["constant", "black"])
def test_a_camera_with_everything_behind_it_sees_no_direction(light: str) -> None:
    behind = scene(ball={"type": "sphere", "center": [0, 0, -5]})
    bound = pose_bound(behind if light == "constant" else behind | {"light": BLACK}, Gaussian(0.01), spp=16)
    assert np.all(np.isinf(bound.position_std))
    assert np.all(np.isinf(bound.rotation_std_deg))


def test_faces_without_area_or_not_finite_change_nothing() -> None:
    """A triangle before a wall, with and without a line, a point and a face of NaN."""
    vertices = [[0, 0, 2], [0.5, 0.1, 2], [0.2, 0.6, 2], [1, 0.2, 2], [np.nan, 0, 2]]
    values = []
    for faces in ([[0, 1, 2]], [[0, 1, 2], [0, 1, 3], [0, 0, 0], [0, 1, 4]]):
        made = mi.Mesh("mesh", len(vertices), len(faces))
        params = mi.traverse(made)
        params["vertex_positions"] = np.ravel(vertices).astype(np.float32)
        params["faces"] = np.ravel(faces).astype(np.uint32)
        params.update()
        values.append(pose_jacobian(scene(wall=wall(texture()), mesh=made), spp=16).values)
        del made, params
        gc.collect()
    assert np.all(np.isfinite(values[1]))
    assert values[1] == pytest.approx(values[0], abs=1e-5 * np.abs(values[0]).max())


@pytest.mark.parametrize(
    ("kind", "near", "cut"),
    [
        ("perspective", 0.2, False),
        ("perspective", 1.8, True),
        ("thinlens", 1.8, True),
        ("perspective", 2.6, False),
    ],
)
def test_surfaces_that_the_near_plane_cuts_are_named(kind: str, near: float, cut: bool) -> None:
    """A sphere beyond, across and wholly before the near plane; the last leaves no edge in the image."""
    lens = {"aperture_radius": 0.01, "focus_distance": 3.0} if kind == "thinlens" else {}
    sensor = camera() | lens | {"type": kind, "near_clip": near}
    ball = {"type": "sphere", "center": [0, 0, 2], "radius": 0.5}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        pose_jacobian(scene(wall=wall(texture()), ball=ball, sensor=sensor), spp=4)
    named = [str(w.message) for w in caught if issubclass(w.category, BlindSpotWarning)]
    assert len(named) == cut
    assert all("near plane" in text and "any direction" in text for text in named)
