"""Fingerprints of scenes: the same for the same scene, and another one after any edit that can be seen."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from small_scenes import mi, texture, textured_wall, wall

from mitsuba_crb.measure.pose import pose_jacobian
from mitsuba_crb.render.fingerprint import fingerprint, mask_fingerprint
from mitsuba_crb.render.scene import load_scene


def _of(file: Path, **defines: str) -> str:
    return fingerprint(load_scene(file, **defines), file, defines)


def test_a_file_has_one_whatever_is_merged_when_and_wherever_it_lies(scenes: Path, tmp_path: Path) -> None:
    """Mitsuba merges the plain room's meshes in another order each time."""
    shutil.copytree(scenes / "plain_room", tmp_path / "plain_room")
    shutil.copytree(scenes / "textured_room", tmp_path / "textured_room")
    files = (scenes / "plain_room" / "plain_room.xml", tmp_path / "plain_room" / "plain_room.xml")
    assert len({_of(file) for file in files for _ in range(3)}) == 1


@pytest.mark.parametrize("name", ["textured_room.xml", "room.xml", "rug.png", "palm.ply"])
def test_an_edit_of_the_file_or_of_one_that_it_names_is_another_scene(
    name: str, scenes: Path, tmp_path: Path
) -> None:
    """Its own text, an included file's, a texture, a mesh."""
    folder = tmp_path / "textured_room"
    shutil.copytree(scenes / "textured_room", folder)
    before = _of(folder / "textured_room.xml")
    other = {"rug.png": "picture.png", "palm.ply": "sofa.ply"}.get(name)
    if other:
        shutil.copy(folder / other, folder / name)
    else:
        text = (folder / name).read_text()
        (folder / name).write_text(text.replace("</scene>", "<!-- edited --></scene>"))
    assert _of(folder / "textured_room.xml") != before


def test_a_default_that_is_set_to_another_value_is_another_scene(tmp_path: Path) -> None:
    file = tmp_path / "lamp.xml"
    file.write_text(
        '<scene version="3.0.0"><default name="power" value="1.0"/><emitter type="constant">'
        '<rgb name="radiance" value="$power"/></emitter></scene>'
    )
    assert _of(file) == _of(file, power="1.0") != _of(file, power="1.1")


@pytest.mark.slow
def test_dictionaries_and_loaded_scenes_have_them_too() -> None:
    def of(scene: dict[str, object]) -> str:
        return fingerprint(mi.load_dict(scene), scene)

    assert of(textured_wall()) == of(textured_wall())
    others = [{"wall": wall(texture(seed=1))}, {"wall": wall(texture(filter_type="nearest"))}]
    assert len({of(textured_wall() | other) for other in ({}, *others)}) == 3
    loaded = mi.load_dict(textured_wall())
    before = fingerprint(loaded)
    pose_jacobian(loaded, size=(16, 12), spp=4)
    assert fingerprint(loaded) == before
    params = mi.traverse(loaded)
    params["wall.to_world"] = params["wall.to_world"] @ mi.Transform4f().translate([0, 0, 1e-3])
    params.update()
    assert fingerprint(loaded) != before


def test_masks_differ_by_any_pixel_and_by_shape() -> None:
    mask = np.zeros((3, 4), dtype=bool)
    other = mask.copy()
    other[1, 2] = True
    assert len({mask_fingerprint(each) for each in (mask, mask.copy(), other, mask.T)}) == 3
