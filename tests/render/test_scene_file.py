"""All that is wrong with a scene file in one message; mutated files are measured, or refused in one line."""

from __future__ import annotations

import random
import re
import shutil
from pathlib import Path

import pytest

from mitsuba_crb import load_scene
from mitsuba_crb.cli import app as cli
from mitsuba_crb.errors import PoseError, SceneError
from mitsuba_crb.render.view import open_view

QUADS = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
0 0 2
0 1 2
1 1 2
1 0 2
4 0 1 2 3
"""
SENSOR = '<sensor type="perspective"><film type="hdrfilm"/></sensor>'


def refused(tmp_path: Path, *lines: str) -> str:
    file = tmp_path / "scene.xml"
    file.write_text("\n".join(['<scene version="3.0.0">', *lines, "</scene>"]))
    with pytest.raises(SceneError) as error:
        load_scene(file)
    message = str(error.value)
    assert "\n" not in message
    assert not re.search(r"\.cpp:|0x[0-9a-f]{6}", message)
    return message.removeprefix(f"{file}: ")


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (SENSOR.replace("<film", '<transform name="to_world"><lookAt/></transform><film'), ["<lookat>"]),
        (SENSOR.replace("hdrfilm", "ldrfilm"), ["ldrfilm", "use hdrfilm"]),
        ('<sensor type="perspective"><animation name="to_world"/></sensor>', ["animated", "one <transform>"]),
        ('<shape type="my-shape"/>', ["my-shape", "no plugin of this name"]),
        ('<bsdf type="difuse"/>', ["no plugin of this name", "did you mean diffuse"]),
        (
            '<shape type="ply"><string name="filename" value="no.ply"/></shape>',
            ["no.ply", "put the file there"],
        ),
        (
            '<shape type="ply"><string name="filename" value="quads.ply"/></shape>',
            ["quads.ply", "triangulate"],
        ),
        ('<shape type="sphere"><float name="radius" value="$r"/></shape>', ["$r", "-D name=value"]),
        (
            '<shape type="sphere"><boolean name="strictNormals" value="true"/></shape>',
            ["strict", "remove it"],
        ),
        (
            '<texture type="bitmap"><string name="filename" value="a.png"/></texture>',
            ["a.png", "put the file there"],
        ),
        ('<shape type="sphere"><ref id="nobody"/></shape>', ["nobody", "<ref>"]),
        ("<bdsf/>", ["<bdsf>", "did you mean <bsdf>"]),
        (
            '<sensor type="perspective"><transform name="to_world"><lookat origin="0,0,0" target="0,2,0" '
            'up="0,1,0"/></transform></sensor>',
            ["parallel to the view direction", "another up"],
        ),
    ],
)
def test_a_fault_is_named_with_its_line_and_a_cure(line: str, words: list[str], tmp_path: Path) -> None:
    (tmp_path / "quads.ply").write_text(QUADS)
    message = refused(tmp_path, "", line)
    assert message.startswith("line 3: " if "nobody" not in line else "line ")
    for word in words:
        assert word in message


def test_all_faults_are_named_at_once(tmp_path: Path) -> None:
    (tmp_path / "quads.ply").write_text(QUADS)
    message = refused(
        tmp_path,
        '<integrator type="path"><boolean name="strictNormals" value="true"/></integrator>',
        '<sensor type="perspective"><transform name="to_world">',
        '<lookAt origin="0,0,0" target="0,0,1" up="0,1,0"/></transform>',
        '<film type="ldrfilm"><float name="gamma" value="2.2"/></film></sensor>',
        '<shape type="ply"><string name="filename" value="quads.ply"/></shape>',
        '<shape type="sphere"><float name="rafius" value="2"/></shape>',
        '<bsdf type="my-material"/>',
    )
    for words in (
        "line 4:.*lookAt",
        "line 5:.*hdrfilm",
        "line 6:.*triangulate",
        "line 7:.*rafius",
        "line 8:.*my-",
    ):
        assert re.search(words, message)
    lines = [int(line) for line in re.findall(r"line (\d+):", message)]
    assert lines == sorted(lines)
    assert "strictNormals of integrator path" in message
    assert "gamma of film hdrfilm" in message


def test_windows_line_ends_in_a_mesh_are_no_fault(tmp_path: Path) -> None:
    text = QUADS.replace("face 1", "face 2").replace("4 0 1 2 3", "3 0 1 2\n3 0 2 3")
    (tmp_path / "crlf.ply").write_bytes(text.replace("\n", "\r\n").encode())
    file = tmp_path / "scene.xml"
    file.write_text(
        '<scene version="3.0.0"><shape type="ply"><string name="filename" value="crlf.ply"/></shape></scene>'
    )
    assert load_scene(file).shapes()[0].face_count() == 2


def test_an_up_along_the_view_is_named_in_a_dictionary_as_well() -> None:
    import mitsuba as mi

    looks = mi.ScalarTransform4f().look_at(origin=[0, 0, 0], target=[0, 1, 0], up=[0, 1, 0])
    with (
        pytest.raises(PoseError, match="up is parallel to the view direction"),
        open_view({"type": "scene", "camera": {"type": "perspective", "to_world": looks}}),
    ):
        pass


def mutated(text: str, rng: random.Random) -> str:
    """A file with one to three things wrong: an attribute dropped, a value not a number, a name misspelt, or
    its end cut off."""
    for _ in range(rng.randint(1, 3)):
        kind = rng.randrange(5)
        places = list(re.finditer(r'\s(\w+)="([^"]*)"', text))
        if kind == 4 or not places:
            text = text[: rng.randrange(len(text))]
            continue
        place = rng.choice(places)
        name, value = place.groups()
        new = {
            0: "",
            1: f' {name}="nan"',
            2: f' {name}="{value[::-1]}x"',
            3: f' {name[:-1]}="{value}"',
        }[kind]
        text = text[: place.start()] + new + text[place.end() :]
    return text


@pytest.mark.slow
@pytest.mark.parametrize("name", ["textured_wall", "boxes"])
@pytest.mark.filterwarnings("ignore")
def test_mutated_files_are_measured_or_refused_in_a_line(
    name: str, scenes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / name
    shutil.copytree(scenes / name, folder)
    file = folder / f"{name}.xml"
    good = file.read_text()
    rng = random.Random(1)
    codes = []
    for _ in range(150):
        file.write_text(mutated(good, rng))
        before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
        codes.append(cli.run(["bound", str(file), "--size", "8x6", "--spp", "4", "--sigma", "0.1"]))
        printed = capsys.readouterr()
        assert codes[-1] in (0, 2), (file.read_text(), printed.err)
        assert "Traceback" not in printed.err
        assert codes[-1] == 0 or printed.err.splitlines()[-1].startswith("mitsuba-crb: ")
        assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before
    assert {0, 2} == set(codes)
