"""The gallery: no plugin is forgotten, each is answered or refused in one line, verdicts tell apart."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from mitsuba_crb import PoseBound, load_scene, pose_bound
from mitsuba_crb.errors import FilmError, MitsubaCRBError, NoiseError, SceneError, SensorError
from mitsuba_crb.render.backend import use_mitsuba

use_mitsuba()

import mitsuba as mi  # noqa: E402  the variant comes first

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import gallery  # noqa: E402
import gallery_scenes  # noqa: E402

PICTURES = {f"{one.kind} {one.name}": one for one in gallery_scenes.gallery()}
REFUSED: dict[str, tuple[type[MitsubaCRBError], str]] = {
    "emitter directionalarea": (NoiseError, "no light reaches"),
    "emitter timed_sunsky": (SceneError, "use sunsky"),
    "film hdrfilm, xyz": (FilmError, "pixel_format"),
    "film specfilm": (SceneError, "spectral"),
    "sensor orthographic": (SensorError, "supported: perspective"),
    "sensor radiancemeter": (SceneError, "1x1"),
    "sensor distant": (SceneError, "1x1"),
    "sensor batch": (SensorError, "name one of them"),
    "sensor irradiancemeter": (SensorError, "supported: perspective"),
}
REPLACED = ("integrator depth", "integrator ptracer", "integrator stokes")
QUICK = ("shape sphere", "emitter spot", "bsdf plastic", "texture volume", "film hdrfilm, luminance")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All scenes and their files."""
    path = tmp_path_factory.mktemp("gallery")
    gallery_scenes.write(path)
    return path


def test_no_plugin_is_forgotten() -> None:
    installed = {file.stem for file in (Path(mi.__file__).parent / "plugins").iterdir()}
    named = set().union(*(one.plugins for one in PICTURES.values()))
    assert len(installed) > 90
    assert gallery_scenes.missing(installed) == set()
    assert not named & set(gallery_scenes.NOT_COVERED)
    assert gallery_scenes.missing(["thinlens", "fisheye"]) == {"fisheye"}


def test_every_scene_has_a_file_of_its_own(folder: Path) -> None:
    assert len(list(folder.glob("*.xml"))) == len(PICTURES) >= 60


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=[] if n in {*QUICK, *REPLACED, *REFUSED} else pytest.mark.slow) for n in PICTURES],
)
def test_it_is_answered_or_refused_in_one_line(name: str, folder: Path) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        if name in REFUSED:
            kind, says = REFUSED[name]
            with pytest.raises(kind, match=says) as refused:
                answer(name, folder)
            assert "\n" not in str(refused.value)
            return
        bound = answer(name, folder)
    assert np.isfinite(bound.information.matrix).all()
    assert np.trace(bound.information.plain_matrix) > 0.0
    assert any("is used in its place" in str(w.message) for w in caught) == (name in REPLACED)


def answer(name: str, folder: Path) -> PoseBound:
    scene = load_scene(PICTURES[name].write(folder), width="8", height="6")
    return pose_bound(scene, spp=8)


@pytest.mark.slow
def test_a_scene_is_measured_by_both_methods_under_the_same_noise(folder: Path) -> None:
    path = PICTURES["emitter spot"].write(folder)
    found = gallery.measured(path, "gaussian", target=0.05, seconds=1.0)
    assert found["verdict"] == "agrees", found
    assert np.array(found["flow"]).shape == np.array(found["finite_difference"]).shape == (7,)


@pytest.mark.parametrize(
    ("factor", "error", "verdict"),
    [
        (1.0, 0.002, "agrees"),
        (1.015, 0.002, "agrees"),
        (1.05, 0.002, "differs"),
        (1.05, 0.02, "agrees"),
        (1.0, 0.1, "undecided"),
    ],
)
def test_a_verdict_weighs_the_difference_by_its_error(factor: float, error: float, verdict: str) -> None:
    diagonal = np.array([5.0, 4.0, 0.5, 6.0, 7.0, 1.0])
    value = np.concatenate([[diagonal.sum()], diagonal])
    judged = gallery.judged(factor * value, error * value, value, 0.0 * value)
    assert judged["verdict"] == verdict
    assert judged["trace"] == pytest.approx(factor - 1.0)


def test_one_wrong_direction_is_enough_unless_it_is_next_to_none() -> None:
    for weak, verdict in ((0.1, "differs"), (1e-6, "agrees")):
        diagonal = np.array([5.0, 4.0, weak, 6.0, 7.0, 1.0])
        other = np.concatenate([[diagonal.sum()], diagonal])
        value = other + 0.2 * weak * (np.arange(7) == 3)
        judged = gallery.judged(value, 1e-3 * other, other, 0.0 * other)
        assert judged["verdict"] == verdict
        assert judged["worst"] == "z"
