"""OBJ, PLY and STL files: colours, textures and faces as they mean them; what they miss is said."""

from __future__ import annotations

import contextlib
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from mitsuba_crb.datasets.scans import linear, read_scan
from mitsuba_crb.errors import SceneError

OBJ = """mtllib square.mtl
v -1 -1 0
v 1 -1 0
v 1 1 0
v -1 1 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl paint
f 1/1 2/2 3/3 4/4
"""
MTL = "newmtl paint\nKd 0.2 0.4 0.6\n"
PLY = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
element face {}
property list uchar int vertex_indices
end_header
-1 -1 0 188 0 255
1 -1 0 188 0 255
1 1 0 188 0 255
-1 1 0 188 0 255
{}
"""


def test_a_quad_of_an_obj_is_two_triangles_with_v_down_and_a_linear_colour(tmp_path: Path) -> None:
    (tmp_path / "square.obj").write_text(OBJ)
    (tmp_path / "square.mtl").write_text(MTL + "map_Kd wood.png\n")
    pixels = np.random.default_rng(0).integers(0, 256, (3, 5, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "wood.png")
    (mesh,) = read_scan(tmp_path / "square.obj").meshes
    assert len(mesh.faces) == 2
    assert mesh.material.diffuse
    assert mesh.material.colour == (0.2, 0.4, 0.6)
    assert mesh.material.texture is not None
    np.testing.assert_array_equal(mesh.material.texture.pixels, pixels)
    # The upper left corner of the square is that of the image.
    assert mesh.uv is not None
    upper_left = np.flatnonzero((mesh.vertices[:, :2] == [-1, 1]).all(axis=1))
    np.testing.assert_array_equal(mesh.uv[upper_left], np.zeros((len(upper_left), 2)))


def test_bytes_of_colour_are_srgb(tmp_path: Path) -> None:
    assert linear(np.uint8([0, 188, 255])) == pytest.approx([0.0, 0.5029, 1.0], abs=5e-5)
    (tmp_path / "a.ply").write_text(PLY.format(1, "4 0 1 2 3"))
    (mesh,) = read_scan(tmp_path / "a.ply").meshes
    assert len(mesh.faces) == 2
    assert mesh.colours is not None
    np.testing.assert_allclose(mesh.colours, [[0.50289, 0.0, 1.0]] * 4, atol=5e-6)
    assert (mesh.material.colour, mesh.uv, mesh.normals) == ((1.0, 1.0, 1.0), None, None)


def test_colours_of_faces_stay_with_them(tmp_path: Path) -> None:
    box = trimesh.creation.box()
    box.visual.face_colors = np.arange(36, dtype=np.uint8).reshape(12, 3)
    box.export(tmp_path / "a.ply")
    (mesh,) = read_scan(tmp_path / "a.ply").meshes
    assert mesh.colours_of == "face"
    np.testing.assert_allclose(mesh.colours, linear(np.arange(36).reshape(12, 3)))


def test_a_ply_names_its_texture(tmp_path: Path) -> None:
    text = PLY.replace("format ascii 1.0", "format ascii 1.0\ncomment TextureFile wood.png").replace(
        "property uchar red\nproperty uchar green\nproperty uchar blue\n",
        "property float s\nproperty float t\n",
    )
    for corner, uv in (("-1 -1 0", "0 0"), ("1 -1 0", "1 0"), ("1 1 0", "1 1"), ("-1 1 0", "0 1")):
        text = text.replace(f"\n{corner} 188 0 255", f"\n{corner} {uv}")
    (tmp_path / "a.ply").write_text(text.format(2, "3 0 1 2\n3 0 2 3"))
    with pytest.raises(SceneError, match=r"a\.ply refers to wood\.png, which cannot be read"):
        read_scan(tmp_path / "a.ply")
    Image.fromarray(np.zeros((2, 2, 3), np.uint8)).save(tmp_path / "wood.png")
    (mesh,) = read_scan(tmp_path / "a.ply").meshes
    assert mesh.material.texture is not None
    assert mesh.uv is not None
    corner = (mesh.vertices[:, :2] == [-1, 1]).all(axis=1)
    np.testing.assert_array_equal(mesh.uv[corner], np.zeros((corner.sum(), 2)))


def test_an_stl_is_grey(tmp_path: Path) -> None:
    trimesh.creation.icosphere(2).export(tmp_path / "a.stl")
    (mesh,) = read_scan(tmp_path / "a.stl").meshes
    assert (len(mesh.faces), mesh.colours, mesh.uv, mesh.normals) == (320, None, None, None)
    assert mesh.material.colour == (0.8, 0.8, 0.8)


@pytest.mark.parametrize(
    ("mtl", "image", "missing"),
    [
        (None, None, "square.mtl"),
        (MTL + "map_Kd wood.png\n", None, "wood.png"),
        (MTL + "map_Kd wood.png\n", b"no picture", "wood.png"),
    ],
)
def test_materials_and_textures_that_are_missing_are_named(
    mtl: str | None, image: bytes | None, missing: str, tmp_path: Path
) -> None:
    (tmp_path / "square.obj").write_text(OBJ)
    if mtl is not None:
        (tmp_path / "square.mtl").write_text(mtl)
    if image is not None:
        (tmp_path / "wood.png").write_bytes(image)
    with pytest.raises(
        SceneError, match=f"square.obj refers to {missing}, which cannot be read: put it beside"
    ):
        read_scan(tmp_path / "square.obj")


@pytest.mark.parametrize("ending", ["ply", "stl"])
def test_a_file_that_is_cut_off_is_named(ending: str, tmp_path: Path) -> None:
    file = tmp_path / f"a.{ending}"
    trimesh.creation.icosphere(2).export(file)
    data = file.read_bytes()
    for share in (0.02, 0.5, 0.95):
        file.write_bytes(data[: int(share * len(data))])
        with pytest.raises(SceneError, match=rf"a\.{ending} is damaged or cut off") as raised:
            read_scan(file)
        assert "\n" not in str(raised.value)


def test_what_trimesh_remarks_is_not_printed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    text = trimesh.exchange.stl.export_stl_ascii(trimesh.creation.box())
    (tmp_path / "a.stl").write_text(text.replace("normal 0", "normal zero", 1))
    with contextlib.suppress(SceneError):
        read_scan(tmp_path / "a.stl")
    assert not caplog.records
    assert capsys.readouterr() == ("", "")


def test_without_trimesh_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(SceneError, match=r"pip install 'mitsuba_crb\[worlds\]'"):
        read_scan(tmp_path / "a.ply")
