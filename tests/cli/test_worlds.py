"""The commands take worlds where they take scenes, and refuse what is none in one line with exit code 2."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from glb_files import SQUARE_UV, Glb

from mitsuba_crb.cli import app as cli

pytestmark = pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")

POSE = "0.1 0.05 2 0 1 0 0"
"""Before the square: turned by half about y, so that z points at it."""


@pytest.fixture
def room(tmp_path: Path) -> Path:
    """A square with a texture."""
    glb = Glb()
    texture = glb.texture(np.random.default_rng(0).integers(0, 256, (8, 8, 3), dtype=np.uint8))
    rough = {"baseColorTexture": {"index": texture}, "metallicFactor": 0.0}
    glb.mesh(uv=SQUARE_UV, material=glb.material(pbrMetallicRoughness=rough))
    return glb.write(tmp_path / "room.glb")


def test_a_bound_of_a_world_says_its_light(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["bound", str(room), "--pose", POSE, "--size", "16x12", "--spp", "16", "--sigma", "0.01"]
    assert cli.run([*command, "--light", "baked", "-D", "fov=40", "--json", str(tmp_path / "a.json")]) == 0
    out = capsys.readouterr().out
    assert "light" not in out
    assert "stands in" not in out
    document = json.loads((tmp_path / "a.json").read_text())
    assert document["defines"] == {"fov": "40", "light": "baked"}
    assert document["scene"] == str(room)
    assert cli.run(command) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "radiance 1 from everywhere (--light constant:1)" in out
    assert out.count("it has no camera: one with 60 degrees across stands in (--camera FILE") == 1


@pytest.mark.slow
def test_a_world_in_the_dark_is_said_to_be_dark(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "path.txt").write_text("0 0.1 0.05 2 0 1 0 0\n1 0.1 0.05 2 1 0 0 0\n")
    command = ["bound", str(room), "--poses", str(tmp_path / "path.txt"), "--size", "16x12", "--spp", "16"]
    assert cli.run([*command, "--light", "none"]) == 0
    out = capsys.readouterr().out
    assert "0 at 2" in out
    assert out.count("note: every image is black; of the first, the scene has no emitter; ") == 1
    assert "--light baked" in out


@pytest.mark.slow
def test_many_poses_say_their_worlds_light_once(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "path.txt").write_text("0 0.1 0.05 2 1 0 0 0\n1 0.2 0.05 2 1 0 0 0\n")
    command = ["bound", str(room), "--poses", str(tmp_path / "path.txt"), "--size", "16x12", "--spp", "16"]
    assert cli.run(command) == 0
    out, err = capsys.readouterr()
    assert out.count("radiance 1 from everywhere (--light constant:1), which leaves closed rooms dark") == 1
    assert err == ""


def test_many_poses_are_of_one_world(room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "path.txt").write_text("".join(f"{t} 0.{t} 0.05 2 0 1 0 0\n" for t in range(3)))
    command = [
        "bound",
        str(room),
        "--light",
        "baked",
        "--poses",
        str(tmp_path / "path.txt"),
        "--size",
        "16x12",
    ]
    assert cli.run([*command, "--spp", "16", "--sigma", "0.01", "--csv", str(tmp_path / "a.csv")]) == 0
    assert capsys.readouterr().out.count("it has no camera: ") == 1
    (tmp_path / "camera.toml").write_text("size = [16, 12]\nfocal = 20.0\n")
    lens = ["--camera", str(tmp_path / "camera.toml"), "--spp", "16", "--sigma", "0.01"]
    assert cli.run([*command, *lens]) == 0
    assert "it has no camera: " not in capsys.readouterr().out
    assert len((tmp_path / "a.csv").read_text().splitlines()) == 4


@pytest.mark.slow
def test_check_and_fuse_take_worlds(room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["check", str(room), "--pose", POSE, "--size", "16x12", "--light", "baked", "--spp", "64"]
    assert cli.run(command) in (0, 3)
    capsys.readouterr()
    (tmp_path / "team.toml").write_text(
        "[measure]\nsize = [16, 12]\nspp = 16\n"
        + "".join(
            f'[[agents]]\nname = "{name}"\nscene = "room.glb"\nnoise = 0.01\n'
            f'pose = [{POSE.replace(" ", ", ")}]\ndefines = {{ light = "baked" }}\n'
            for name in ("a", "b")
        )
    )
    assert cli.run(["fuse", str(tmp_path / "team.toml"), "--workers", "1"]) == 0
    assert "a" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("room.glb", "without a camera has; say its pose (--pose"),
        (f"room.glb --pose '{POSE}' --light bakd", "did you mean baked"),
        (f"room.glb --pose '{POSE}' --light hall.exr --up y", "no such file"),
        (f"room.glb --pose '{POSE}' --light sky --up up", "--up up is no axis"),
        (f"room.glb --pose '{POSE}' -D spp=4", "a world has up, light, fov"),
        ("scene.xml --light sky", "--light is of worlds (.glb"),
        ("points.ply --light baked", "no triangles"),
        ("empty.stl --light baked", "is empty"),
        ("cut.glb --light baked", "cut off"),
        ("room.fbx", "no world: those end in .glb"),
        ("missing.obj --light baked", "no file at missing.obj"),
    ],
)
def test_what_is_no_world_is_refused_in_a_line(
    arguments: str,
    words: str,
    room: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    import shlex

    monkeypatch.chdir(room.parent)
    data = room.read_bytes()
    Path("cut.glb").write_bytes(data[: len(data) // 2])
    Path("room.fbx").write_bytes(b"Kaydara FBX Binary  \x00\x1a\x00" + bytes(40))
    Path("empty.stl").touch()
    Path("scene.xml").write_text('<scene version="3.0.0"><sensor type="perspective"/></scene>')
    trimesh.PointCloud(np.eye(3)).export("points.ply")
    assert cli.run(["bound", *shlex.split(arguments), "--spp", "4", "--size", "8x8"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.strip().splitlines()[-1].count(words) == 1, err
    assert "Traceback" not in err
