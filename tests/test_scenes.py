"""The shipped scenes load and render, their files are what the script makes, and the table lists them all."""

import importlib
import re
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from mitsuba_crb.render.scene import load_scene

SCENES = Path(__file__).parents[1] / "scenes"
SKY = "sky/sky.exr"
NAMES = sorted(path.stem for path in SCENES.glob("*/*.xml") if path.stem == path.parent.name)


def decoded(path):
    if path.suffix == ".png":
        return np.asarray(Image.open(path))
    if path.suffix == ".exr":
        with OpenEXR.File(str(path)) as file:
            return file.channels()["RGB"].pixels.copy()
    return np.frombuffer(path.read_bytes(), np.uint8)


@pytest.mark.parametrize("name", NAMES)
def test_scene_renders_finite_pixels(name):
    scene = load_scene(SCENES / name / f"{name}.xml", width=48, height=36, spp=4)
    assert scene.sensors()[0].id() == "camera"
    image = np.array(scene.integrator().render(scene, seed=1))
    assert image.shape == (36, 48, 3)
    assert np.isfinite(image).all()
    assert image.mean() > 0.05


@pytest.mark.slow
def test_the_script_reproduces_the_committed_files(tmp_path, monkeypatch):
    """All but the sky, which takes as long as all others."""
    monkeypatch.syspath_prepend(SCENES)
    sky = decoded(SCENES / SKY)
    monkeypatch.setattr(importlib.import_module("patterns"), "sky", lambda: sky)
    written = importlib.import_module("make_textures").write(tmp_path)
    committed = {p for p in SCENES.rglob("*") if p.suffix in {".png", ".exr", ".ply", ".obj"}}
    assert {p.relative_to(tmp_path) for p in written} == {p.relative_to(SCENES) for p in committed}
    for path in written:
        np.testing.assert_array_equal(decoded(path), decoded(SCENES / path.relative_to(tmp_path)), str(path))


@pytest.mark.slow
def test_the_script_reproduces_the_committed_sky(monkeypatch):
    monkeypatch.syspath_prepend(SCENES)
    np.testing.assert_array_equal(importlib.import_module("patterns").sky(), decoded(SCENES / SKY))


def test_the_readme_table_lists_each_scene_once():
    listed = re.findall(r"^\| `(\w+)` \|", (SCENES / "README.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(listed) == NAMES
    assert len(NAMES) >= 10


def test_files_stay_small():
    sizes = {p: p.stat().st_size for p in SCENES.rglob("*") if p.is_file() and "__pycache__" not in p.parts}
    assert max(sizes.values()) < 300_000
    assert sum(sizes.values()) < 4_000_000
