"""What cannot be read, written or measured is refused in one line; odd geometry that can be is finite."""

from __future__ import annotations

import dataclasses
import gc
import io
import json
import os
import warnings
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image
from scipy import sparse
from small_scenes import T, camera, scene, texture, wall

from mitsuba_crb import pose_bound, pose_jacobian
from mitsuba_crb.cli import app as cli
from mitsuba_crb.errors import BlindSpotWarning, PoseError, SceneError, SceneWarning
from mitsuba_crb.estimate import trials
from mitsuba_crb.estimate.trial import Trial
from mitsuba_crb.estimate.trial_record import SCHEMA
from mitsuba_crb.measure import measurement as measure
from mitsuba_crb.noise import Gaussian
from mitsuba_crb.render.view import open_view

# Few samples on small images: that standard errors exceed 10 % is expected.
pytestmark = pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")

FILM = '<film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film>'
CAMERA = f'<sensor type="perspective">{FILM}</sensor>'


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
        (
            CAMERA + '<shape type="ply"><string name="filename" value="far.ply"/></shape>',
            ["3 vertices", "vertex 7", "export"],
        ),
        (
            CAMERA + '<shape type="ply"><string name="filename" value="empty.ply"/></shape>',
            ['"ply"', "correct"],
        ),
        (CAMERA + '<shape type="ply"><string name="filename" value="nan.ply"/></shape>', ["nan.ply"]),
        (
            CAMERA + '<shape type="ply"><string name="filename" value="cut.ply"/></shape>',
            ["cut.ply", "token"],
        ),
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
    (tmp_path / "cut.ply").write_bytes(b"ply\n\xff\x80")
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
    with pytest.raises(PoseError, match="to_world has entries that"), open_view(scene(sensor=nowhere)):
        pass
    with (
        pytest.raises(SceneError, match="mesh hollow has no faces"),
        open_view(scene(hollow=mi.Mesh("hollow", 0, 0))),
    ):
        pass


def written(save: Callable[..., None], *values: Any, **options: Any) -> bytes:
    """What a function writes into a file."""
    file = io.BytesIO()
    save(file, *values, **options)
    return file.getvalue()


GOOD: dict[str, bytes] = {
    "scene.xml": f'<scene version="3.0.0">{CAMERA}<emitter type="constant"/></scene>'.encode(),
    "pose.txt": b"1 0 0 0  0 1 0 0  0 0 1 0  0 0 0 1",
    "pose.json": b"[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]",
    "pose.npy": written(np.save, np.eye(4)),
    "twists.txt": b"0.1 0 0 0 0 0",
    "noise.toml": b'[noise]\nmodel = "gaussian"\nsigma = 0.1\n',
    "map.npy": written(np.save, np.full((8, 8), 0.01)),
    "precision.npz": written(sparse.save_npz, 2.0 * sparse.eye_array(64).tocsc()),
    "prior.toml": b'position_std = 0.5\nframe = "camera"\n',
    "prior.json": b'{"frame": "camera", "position_std": 0.5}',
    "mask.png": written(Image.fromarray(np.indices((8, 8))[0].astype(np.uint8) * 36).save, format="png"),
    "photo.png": written(
        Image.fromarray(np.random.default_rng(0).integers(20, 200, (8, 8, 3), np.uint8)).save, format="png"
    ),
    "team.toml": b'[[agents]]\nname = "a"\nscene = "scene.xml"\nnoise = "noise.toml"\n[tiles]\nsize = 8\n',
    "trials.json": json.dumps(
        {
            "schema": SCHEMA,
            "settings": {},
            "results": [dataclasses.asdict(Trial(0, "converged", (0.0,) * 6, 1.0, 3, 0.0, (0.0,) * 21, 0))],
        }
    ).encode(),
    "map.toml": b'[noise]\nmodel = "per_pixel"\nvariance = "map.npy"\n',
    "precision.toml": b'[noise]\nmodel = "sparse_precision"\nprecision = "precision.npz"\nshape = [8, 8]\n',
    "map_team.toml": b'[[agents]]\nname = "a"\nscene = "scene.xml"\nnoise = "map.toml"\n',
}
"""Files by their names, all of them good."""

READERS = [
    ("scene.xml", "bound scene.xml"),
    ("scene.xml", "check scene.xml"),
    ("scene.xml", "validate scene.xml"),
    ("scene.xml", "fuse team.toml --workers 1"),
    ("pose.txt", "bound scene.xml --pose pose.txt"),
    ("pose.json", "check scene.xml --pose pose.json"),
    ("pose.npy", "validate scene.xml --pose pose.npy"),
    ("twists.txt", "bound scene.xml --hcr --displacements twists.txt"),
    ("noise.toml", "bound scene.xml --noise noise.toml"),
    ("noise.toml", "fuse team.toml --workers 1"),
    ("map.npy", "bound scene.xml --noise map.toml"),
    ("map.npy", "select --workers 1 --budget 1 map_team.toml"),
    ("precision.npz", "bound scene.xml --noise precision.toml"),
    ("prior.toml", "bound scene.xml --prior prior.toml"),
    ("prior.json", "bound scene.xml --prior prior.json"),
    ("mask.png", "bound scene.xml --pixels mask.png"),
    ("mask.png", "check scene.xml --pixels mask.png"),
    ("team.toml", "fuse team.toml --workers 1"),
    ("team.toml", "select team.toml --budget 1 --workers 1"),
    ("trials.json", "validate scene.xml --json trials.json"),
    ("scene.xml", "align scene.xml photo.png"),
    ("photo.png", "align scene.xml photo.png"),
    ("pose.npy", "align scene.xml photo.png --poses pose.npy"),
    ("mask.png", "align scene.xml photo.png --mask mask.png"),
]
"""A file, and a command that reads it."""

TEXTS = (".txt", ".json", ".toml")
DAMAGES = (
    "missing",
    "empty",
    "cut off",
    "another kind",
    "random bytes",
    "not UTF-8",
    "deeply nested",
    "a folder",
    "a link to itself",
    "unreadable",
    "forbidden",
)
ANOTHER = {
    "map.npy": "precision.npz",
    "precision.npz": "map.npy",
    "mask.png": "noise.toml",
    "photo.png": "noise.toml",
}


def damage(file: Path, how: str) -> None:
    """Put something in the place of a good file."""
    good = file.read_bytes()
    contents = {
        "empty": b"",
        "cut off": good[: len(good) * 2 // 3],
        "another kind": GOOD[ANOTHER.get(file.name, "mask.png")],
        "random bytes": np.random.default_rng(0).bytes(300),
        "not UTF-8": good[: len(good) // 2] + b"\xe9" + good[len(good) // 2 :],
        "deeply nested": b"a = " * (file.suffix == ".toml") + b"[" * 100_000,
    }
    file.unlink()
    if how in contents:
        file.write_bytes(contents[how])
    elif how == "a folder":
        file.mkdir()
    elif how == "a link to itself":
        file.symlink_to(file)
    elif how == "unreadable":
        file.symlink_to("/proc/self/mem")  # whose first byte nobody can read, not even root
    elif how == "forbidden":
        file.write_bytes(good)
        file.chmod(0)
        if os.access(file, os.R_OK):
            pytest.skip("root reads everything")


@pytest.fixture
def readable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of good files, in which the commands run until they would render."""

    def render(*_: Any, **__: Any) -> Any:
        raise AssertionError("this would be rendered")

    monkeypatch.setattr(measure.Measurement, "tiles", render)
    monkeypatch.setattr(trials, "truth_of", render)
    monkeypatch.chdir(tmp_path)
    for name, contents in GOOD.items():
        Path(name).write_bytes(contents)
    return tmp_path


def refusal(command: str, capsys: pytest.CaptureFixture[str]) -> str:
    """The one line with which a command ends before it renders, with exit code 2."""
    code = cli.run(command.split())
    out, err = capsys.readouterr()
    assert code == 2, err
    assert out == ""
    assert err.startswith("mitsuba-crb: ")
    assert err.count("\n") == 1
    assert len(err) < 500
    return err


@pytest.mark.parametrize("command", dict.fromkeys(command for _, command in READERS))
def test_commands_with_good_files_would_render(
    command: str, readable: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The negative control of what follows."""
    assert cli.run(command.split()) == cli.INTERNAL_ERROR
    assert "this would be rendered" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "command", "how"),
    [
        (name, command, how)
        for name, command in READERS
        for how in DAMAGES
        if (how not in ("not UTF-8", "deeply nested") or name.endswith(TEXTS))
        and (name, how) != ("trials.json", "missing")
    ],
)
def test_a_damaged_file_is_named_in_one_line_before_anything_is_rendered(
    name: str, command: str, how: str, readable: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damage(readable / name, how)
    assert name in refusal(command, capsys)
    assert all((readable / other).read_bytes() == GOOD[other] for other in GOOD if other != name)


PICTURES = "select team.toml --workers 1 --budget 1 --plot {}"  # into a folder
OUTPUTS = [
    "bound scene.xml --json {}",
    "bound scene.xml --exr {}",
    "bound scene.xml --plot {}",
    "align scene.xml photo.png --json {}",
    "align scene.xml photo.png --residual {}",
    "validate scene.xml --json {}",
    "validate scene.xml --plot {}",
    "fuse team.toml --workers 1 --json {}",
    "select team.toml --workers 1 --budget 1 --json {}",
    PICTURES,
]
PLACES = {
    "folder": "folder",
    "no/folder/out": "no/folder",
    "scene.xml": "scene.xml",
    "to_itself": "to_itself",
    "to_nowhere": "to_nowhere",
    "/dev/null": "/dev/null",
    "/proc/self/out": "/proc/self",
    "x" * 300: "x" * 300,
}
"""Where nothing can be written, and what the refusal must name."""


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="needs a folder in which nobody can write")
@pytest.mark.parametrize(
    ("command", "place"),
    [
        pytest.param(command, place, id=f"{command} {place[:20]}")
        for command in OUTPUTS
        for place in PLACES
        if (command, place) != (PICTURES, "folder")
    ],
)
def test_a_place_that_cannot_be_written_is_named_in_one_line_before_anything_is_rendered(
    command: str, place: str, readable: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (readable / "folder").mkdir()
    (readable / "to_itself").symlink_to(readable / "to_itself")
    (readable / "to_nowhere").symlink_to(readable / "no" / "where")
    before = sorted(readable.rglob("*"))
    assert PLACES[place] in refusal(command.format(place), capsys)
    assert sorted(readable.rglob("*")) == before
    assert (readable / "scene.xml").read_bytes() == GOOD["scene.xml"]


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
    told = pytest.warns(SceneWarning, match="none of 768 rays") if light == "black" else nullcontext()
    with told:
        bound = pose_bound(
            behind if light == "constant" else behind | {"light": BLACK}, Gaussian(0.01), spp=16
        )
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


@pytest.mark.slow
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
    """A sphere beyond, across and wholly before the near plane; the last leaves no edge in the image.

    Flow leaves them to finite differences; forward says what its numbers are worth.
    """
    lens = {"aperture_radius": 0.01, "focus_distance": 3.0} if kind == "thinlens" else {}
    sensor = camera() | lens | {"type": kind, "near_clip": near}
    ball = {"type": "sphere", "center": [0, 0, 2], "radius": 0.5}
    blocks, named = cut_by(scene(wall=wall(texture()), ball=ball, sensor=sensor))
    assert ("near plane" in blocks) == cut
    assert len([text for text in named if "near plane" in text and "any direction" in text]) == cut


@pytest.mark.slow
@pytest.mark.parametrize(("far", "cut"), [(10.0, True), (0.9, False), (1e4, False)])
def test_surfaces_that_the_far_plane_cuts_are_named(far: float, cut: bool) -> None:
    """A floor that runs beyond the far plane, is wholly beyond it, or ends so far out as the horizon."""
    level = T().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(1e5)
    sensor = camera(target=(0, 0, 1)) | {"far_clip": far}
    blocks, named = cut_by(scene(floor={"type": "rectangle", "to_world": level}, sensor=sensor))
    assert ("far plane" in blocks) == cut
    assert len([text for text in named if "far plane at 10" in text and "finite_difference" in text]) == cut


def cut_by(which: dict[str, Any]) -> tuple[dict[str, int], list[str]]:
    """Which blocks flow left to finite differences, and what forward warns of."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = pose_bound(which, Gaussian(0.1), spp=4)
        pose_jacobian(which, spp=4, method="forward")
    texts = [str(w.message) for w in caught if issubclass(w.category, BlindSpotWarning)]
    return found.provenance["finite_differences"]["blocks"], texts
