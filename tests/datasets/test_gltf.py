"""GLB files: geometry as trimesh reads it, cameras and materials by hand; what is wrong with them."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from glb_files import SQUARE, SQUARE_FACES, SQUARE_UV, Glb

from mitsuba_crb.datasets.gltf import read_gltf
from mitsuba_crb.errors import SceneError

TURNED = [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]
"""A quarter turn about z."""


def test_the_scene_graph_is_flattened_as_trimesh_does(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    scene = trimesh.Scene()
    for number in range(3):
        pose = trimesh.transformations.random_rotation_matrix(rng.uniform(size=3))
        pose[:3, :3] *= rng.uniform(0.5, 2.0)
        pose[:3, 3] = rng.normal(size=3)
        box = trimesh.creation.box(rng.uniform(0.5, 1.0, 3))
        scene.add_geometry(box, node_name=f"box {number}", transform=pose)
    scene.export(tmp_path / "boxes.glb")
    meshes = read_gltf(tmp_path / "boxes.glb").meshes
    ours = np.concatenate([mesh.vertices[mesh.faces].mean(axis=1) for mesh in meshes])
    theirs = trimesh.load_scene(tmp_path / "boxes.glb").to_mesh().triangles_center
    assert ours.shape == theirs.shape == (36, 3)
    # trimesh writes float32.
    np.testing.assert_allclose(ours[np.lexsort(ours.T)], theirs[np.lexsort(theirs.T)], atol=1e-6)


def test_nodes_within_nodes_and_matrices_multiply_from_the_left(tmp_path: Path) -> None:
    glb = Glb()
    inner = glb.mesh(root=False, translation=[1, 0, 0])
    mirrored = glb.mesh(
        root=False, matrix=np.diag([-1.0, 1, 1, 1]).T.ravel().tolist(), normals=np.float32([[0, 0, 1]] * 4)
    )
    glb.document["scenes"][0]["nodes"] = []
    glb.node(children=[inner, mirrored], rotation=TURNED, scale=[2, 2, 2])
    one, two = read_gltf(glb.write(tmp_path / "a.glb")).meshes
    turn = np.array([[0, -2.0, 0], [2, 0, 0], [0, 0, 2]])
    np.testing.assert_allclose(one.vertices, (SQUARE + np.array([1, 0, 0])) @ turn.T, atol=1e-12)
    np.testing.assert_allclose(two.vertices, (SQUARE * [-1, 1, 1]) @ turn.T, atol=1e-12)
    # A reflection turns the winding, so that it still goes with the normals.
    a, b, c = np.moveaxis(two.vertices[two.faces], 1, 0)
    assert two.normals is not None
    assert np.all(np.einsum("ij,ij->i", np.cross(b - a, c - a), two.normals[two.faces[:, 0]]) > 0.0)


def test_a_camera_looks_along_minus_z_with_y_up(tmp_path: Path) -> None:
    glb = Glb()
    glb.mesh()
    glb.document["cameras"] = [
        {"type": "perspective", "perspective": {"yfov": 0.7, "aspectRatio": 1.5, "znear": 0.1}}
    ]
    glb.node(camera=0, name="left", translation=[1, 2, 3], rotation=TURNED, scale=[2, 2, 2])
    (camera,) = read_gltf(glb.write(tmp_path / "a.glb")).cameras
    assert (camera.name, camera.fov_y, camera.aspect) == ("left", 0.7, 1.5)
    # Columns: x left, y up, z forward.
    expected = np.array([[0, -1, 0, 1], [-1, 0, 0, 2], [0, 0, -1, 3], [0, 0, 0, 1]], dtype=float)
    np.testing.assert_allclose(camera.world_from_camera, expected, atol=1e-12)
    assert np.linalg.det(camera.world_from_camera[:3, :3]) == pytest.approx(1.0)


def test_materials_keep_their_numbers(tmp_path: Path) -> None:
    glb = Glb()
    pixels = np.random.default_rng(0).integers(0, 256, (4, 6, 3), dtype=np.uint8)
    moved = {"KHR_texture_transform": {"scale": [2, 3], "offset": [0.5, 0.25]}}
    wall = glb.material(
        name="wall",
        pbrMetallicRoughness={
            "baseColorFactor": [0.123456, 0.5, 1.0, 0.7],
            "baseColorTexture": {
                "index": glb.texture(pixels, wrapS=33071, magFilter=9728),
                "extensions": moved,
            },
            "metallicFactor": 0.25,
        },
        emissiveFactor=[0, 0.5, 0],
        extensions={"KHR_materials_emissive_strength": {"emissiveStrength": 4}},
    )
    picture = glb.material(extensions={"KHR_materials_unlit": {}})
    glb.mesh(uv=SQUARE_UV, material=wall)
    glb.mesh(material=picture)
    one, two = (mesh.material for mesh in read_gltf(glb.write(tmp_path / "a.glb")).meshes)
    assert one.colour == (0.123456, 0.5, 1.0)
    assert (one.metallic, one.roughness, one.opacity, one.unlit) == (0.25, 1.0, 0.7, False)
    assert one.emission == (0.0, 2.0, 0.0)
    assert one.texture is not None
    np.testing.assert_array_equal(one.texture.pixels, pixels)
    assert (one.texture.wrap, one.texture.nearest) == ("clamp", True)
    assert (one.texture.scale, one.texture.offset) == ((2.0, 3.0), (0.5, 0.25))
    assert two.unlit


def test_colours_are_linear_whatever_their_type(tmp_path: Path) -> None:
    glb = Glb()
    glb.mesh(colours=np.full((4, 4), 51, np.uint8))
    glb.mesh(colours=np.full((4, 3), 13107, np.uint16))
    glb.mesh(colours=np.full((4, 3), 0.2, np.float32))
    for mesh in read_gltf(glb.write(tmp_path / "a.glb")).meshes:
        np.testing.assert_allclose(mesh.colours, 0.2, rtol=1e-6)
        assert mesh.colours is not None
        assert mesh.colours.shape == (4, 3)


@pytest.mark.parametrize("stride", [12, 20])
def test_strides_sparse_arrays_and_files_beside_it_are_read(stride: int, tmp_path: Path) -> None:
    rows = np.zeros((4, stride // 4), np.float32)
    rows[:, :3] = SQUARE
    index = SQUARE_FACES.astype(np.uint16).ravel()
    moved = np.array([[5, 6, 7]], np.float32)
    data = rows.tobytes() + index.tobytes() + np.array([2, 0], np.uint16).tobytes() + moved.tobytes()
    starts = np.cumsum([0, rows.nbytes, index.nbytes, 4]).tolist()
    sizes = [rows.nbytes, index.nbytes, 4, 12]
    views = [{"buffer": 0, "byteOffset": a, "byteLength": n} for a, n in zip(starts, sizes, strict=True)]
    views[0]["byteStride"] = stride
    sparse = {
        "count": 1,
        "indices": {"bufferView": 2, "componentType": 5123},
        "values": {"bufferView": 3},
    }
    document = {
        "asset": {"version": "2.0"},
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3", "sparse": sparse},
            {"bufferView": 1, "componentType": 5123, "count": 6, "type": "SCALAR"},
        ],
        "bufferViews": views,
    }
    (tmp_path / "a data.bin").write_bytes(data)
    for uri in ("a%20data.bin", f"data:application/octet-stream;base64,{base64.b64encode(data).decode()}"):
        text = json.dumps(document | {"buffers": [{"byteLength": len(data), "uri": uri}]})
        (tmp_path / "a.gltf").write_text(text)
        (mesh,) = read_gltf(tmp_path / "a.gltf").meshes
        expected = SQUARE.copy()
        expected[2] = 5, 6, 7
        np.testing.assert_array_equal(mesh.vertices, expected)
        np.testing.assert_array_equal(mesh.faces, SQUARE_FACES)


def test_strips_and_fans_are_triangles(tmp_path: Path) -> None:
    glb = Glb()
    for mode, order in ((5, [0, 1, 3, 2]), (6, [0, 1, 2, 3])):
        glb.mesh(faces=np.array(order))
        glb.document["meshes"][-1]["primitives"][0]["mode"] = mode
    for mesh in read_gltf(glb.write(tmp_path / "a.glb")).meshes:
        a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
        np.testing.assert_allclose(np.cross(b - a, c - a), [[0, 0, 4], [0, 0, 4]])


def good() -> Glb:
    """A textured square."""
    glb = Glb()
    texture = glb.texture(np.full((2, 2, 3), 100, np.uint8))
    glb.mesh(
        uv=SQUARE_UV, material=glb.material(pbrMetallicRoughness={"baseColorTexture": {"index": texture}})
    )
    return glb


def _without_its_texture(glb: Glb) -> None:
    glb.document["images"][0] = {"uri": "wood.png"}


def _with_a_broken_texture(glb: Glb) -> None:
    view = glb.document["bufferViews"][glb.document["images"][0]["bufferView"]]
    start = view["byteOffset"]
    glb.binary = glb.binary[: start + 40] + bytes(len(glb.binary) - start - 40)


def _compressed(glb: Glb) -> None:
    glb.document["extensionsRequired"] = ["KHR_draco_mesh_compression"]


def _with_a_node_too_few(glb: Glb) -> None:
    glb.document["scenes"][0]["nodes"] = [7]


def _in_a_circle(glb: Glb) -> None:
    glb.document["nodes"][0]["children"] = [0]


def _longer_than_its_buffer(glb: Glb) -> None:
    glb.document["accessors"][0]["count"] = 400


def _turned(glb: Glb) -> None:
    reference = glb.document["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    reference["extensions"] = {"KHR_texture_transform": {"rotation": 1.0}}


def _of_old(glb: Glb) -> None:
    glb.document["asset"]["version"] = "1.0"


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (_without_its_texture, ["wood.png", "beside"]),
        (_with_a_broken_texture, ["image 0", "no image"]),
        (_compressed, ["KHR_draco_mesh_compression", "uncompressed"]),
        (_with_a_node_too_few, ["damaged", "export it again"]),
        (_in_a_circle, ["without end"]),
        (_longer_than_its_buffer, ["longer than its buffer"]),
        (_turned, ["KHR_texture_transform", "apply it"]),
        (_of_old, ["no glTF 2"]),
    ],
)
def test_what_is_wrong_with_a_file_is_said_in_a_line(spoil, words: list[str], tmp_path: Path) -> None:
    glb = good()
    assert len(read_gltf(glb.write(tmp_path / "a.glb")).meshes) == 1
    spoil(glb)
    with pytest.raises(SceneError) as raised:
        read_gltf(glb.write(tmp_path / "a.glb"))
    text = str(raised.value)
    assert "\n" not in text
    assert all(word in text for word in ["a.glb", *words]), text


def test_any_value_in_any_place_is_read_or_refused(tmp_path: Path) -> None:
    """Of a document's every entry."""

    def places(node: Any, above: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
        entries = (
            node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
        )
        for key, value in entries:
            yield (*above, key)
            yield from places(value, (*above, key))

    refused = []
    for place in list(places(good().document)):
        for value in (None, -1, 10**9, "x", [], {}):
            glb = good()
            node: Any = glb.document
            for key in place[:-1]:
                node = node[key]
            node[place[-1]] = value
            try:
                read_gltf(glb.write(tmp_path / "a.glb"))
            except SceneError as error:
                refused.append(str(error))
    assert len(refused) > 200
    assert not [text for text in refused if "\n" in text]


@pytest.mark.parametrize("share", [0.01, 0.3, 0.9])
def test_a_file_that_is_cut_off_is_named(share: float, tmp_path: Path) -> None:
    file = good().write(tmp_path / "a.glb")
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    with pytest.raises(SceneError, match=r"a\.glb is (cut off|no glTF)"):
        read_gltf(file)


def test_what_is_left_out_is_noted(tmp_path: Path) -> None:
    glb = good()
    glb.mesh()
    glb.document["meshes"][-1]["primitives"][0]["mode"] = 1
    assert read_gltf(glb.write(tmp_path / "a.glb")).notes == ["1 primitives of points or lines are left out"]
