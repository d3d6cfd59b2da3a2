"""Photographs of a scene are aligned to within what is said of them, by file and by the command."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy import stats

from mitsuba_crb import pose_jacobian, se3
from mitsuba_crb.cli import app as cli
from mitsuba_crb.datasets.photographs import Capture, Photograph
from mitsuba_crb.errors import CaptureError
from mitsuba_crb.estimate.align import Alignment, align
from mitsuba_crb.estimate.misfit import Anchor
from mitsuba_crb.estimate.photograph import align_photograph
from mitsuba_crb.information.subset import selected
from mitsuba_crb.measure.held_out import held_out_residuals
from mitsuba_crb.measure.measurement import measurement
from mitsuba_crb.noise import SRGB, Gaussian
from mitsuba_crb.render.pixels import render_pixels
from mitsuba_crb.render.scene import SceneFile, as_scene

SIZE = (48, 36)
GAIN, BLACK, SIGMA = 1.3, 0.04, 0.01
OPTIONS: dict[str, Any] = {"size": SIZE, "spp": 16}


@pytest.fixture(scope="module")
def wall() -> Any:
    """The shipped wall, half as bright as the photograph's white."""
    scenes = Path(__file__).parents[2] / "scenes"
    file = scenes / "textured_wall" / "textured_wall.xml"
    return as_scene(SceneFile(file, {"width": str(SIZE[0]), "height": str(SIZE[1])}))[0]


def rendered(scene: Any, pose: Any = None, size: tuple[int, int] = SIZE) -> tuple[Any, Any]:
    """The expected image of a scene, and its pose."""
    with measurement(scene, size=size, pose=pose) as run:
        image = render_pixels(run.view, selected(run.mask), spp=1024, seed=77, even=True)
        return image.reshape(*size[::-1], 3), run.view.pose


def exposed(image: Any, seed: int, gain: Any = GAIN, sigma: float = SIGMA) -> Any:
    """Linear values of a photograph of it."""
    noise = np.random.default_rng(seed).standard_normal(image.shape)
    return gain * image + BLACK + sigma * noise


def written(file: Path, linear: Any) -> Path:
    Image.fromarray(np.rint(255.0 * SRGB(np.clip(linear, 0.0, 1.0))).astype(np.uint8)).save(file)
    return file


@pytest.fixture(scope="module")
def truth(wall: Any) -> tuple[Any, Any]:
    return rendered(wall)


def start(pose: Any, position: float, degrees: float, seed: int = 0) -> Any:
    direction = np.random.default_rng(seed).standard_normal((2, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return pose @ se3.exp(np.concatenate([position * direction[0], np.radians(degrees) * direction[1]]))


def nees(found: Alignment, pose: Any) -> float:
    error = se3.log(se3.inverse(pose) @ found.pose)
    return float(error @ np.linalg.inv(found.bound.covariance + found.added) @ error)


@pytest.mark.slow
def test_gain_black_and_pose_are_found_together(wall: Any, truth: Any) -> None:
    image, pose = truth
    gains = np.array([1.3, 0.7, 1.0])
    measured = exposed(image, 1, gains)
    options: dict[str, Any] = OPTIONS | {"pose": start(pose, 0.02, 0.5), "tone": "channels"}
    found = align(wall, measured, None, **options)
    assert found.status == "converged"
    assert nees(found, pose) < 28.0  # the 99.99 % quantile of χ² with 6 degrees of freedom
    np.testing.assert_allclose(found.tone.gain, gains, rtol=0.05)
    np.testing.assert_allclose(found.tone.black, BLACK, atol=0.02)
    assert found.noise["sigma"] == pytest.approx(SIGMA, rel=0.05)
    assert found.noise["origin"] == "residuals"
    cost = found.bound.position_std / found.bound.if_known["all of them"].position_std
    assert np.all(cost > 1.0)
    assert np.sqrt(np.mean((found.image - gains * image - BLACK) ** 2)) < 0.01
    given = align(wall, measured, Gaussian(SIGMA), **options)
    np.testing.assert_allclose(given.pose, found.pose, atol=1e-4)
    # The negative control: to take the values for radiance.
    wrong = align(wall, measured, Gaussian(SIGMA), **options | {"tone": "known"})
    assert wrong.residual > 3.0


@pytest.mark.slow
def test_a_file_is_aligned_by_the_command(
    scenes: Path, truth: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    image, pose = truth
    file = written(tmp_path / "photo.png", exposed(image, 2))
    begin = tmp_path / "start.txt"
    np.savetxt(begin, start(pose, 0.1, 4.0))
    scene = scenes / "textured_wall" / "textured_wall.xml"
    outputs = ["--json", str(tmp_path / "out.json"), "--residual", str(tmp_path / "out.png")]
    code = cli.run(["align", str(scene), str(file), "--pose", str(begin), "--spp", "16", *outputs])
    out, err = capsys.readouterr()
    assert code == 0, err
    assert "aligned after" in out
    assert "misspecified: not known" in out
    document = json.loads((tmp_path / "out.json").read_text())
    assert document["schema"] == "mitsuba-crb/align/1"
    assert (document["verdict"], document["status"], document["size"]) == ("aligned", "converged", [48, 36])
    error = se3.log(se3.inverse(pose) @ np.array(document["pose"]))
    covariance = np.array(document["ideal"]["covariance"]) + np.array(document["covariance_of_renderer"])
    assert error @ np.linalg.inv(covariance) @ error < 28.0
    np.testing.assert_allclose(se3.pose_from_vector(document["position_and_quaternion"]), document["pose"])
    np.testing.assert_allclose(document["tone"]["gain"], GAIN, rtol=0.05)
    # 8 bits of sRGB add to the noise, by the slope of the curve.
    assert document["noise"]["sigma"] == pytest.approx(SIGMA, rel=0.1)
    assert document["psnr_db"] > document["even_psnr_db"] + 3.0
    assert document["misspecified"] is None
    with Image.open(tmp_path / "out.png") as picture:
        assert min(picture.size) > 300


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_starts_further_away_come_back(wall: Any, truth: Any, tmp_path: Path, seed: int) -> None:
    """5 degrees and a tenth of the depth away, by way of reduced images of its own choice."""
    image, pose = truth
    file = written(tmp_path / "photo.png", exposed(image, seed))
    found = align_photograph(wall, file, levels=None, **OPTIONS | {"pose": start(pose, 0.2, 5.0, seed)})
    assert found.verdict == "aligned"
    assert nees(found.alignment, pose) < 28.0


@pytest.mark.slow
def test_the_right_one_of_many_starts_is_kept(
    scenes: Path, wall: Any, truth: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    image, pose = truth
    file = written(tmp_path / "photo.png", exposed(image, 3))
    far = [start(pose, 0.9, 25.0, seed) for seed in range(4)]
    behind = pose @ se3.exp([0, 0, 0, 0, np.pi, 0])
    np.save(tmp_path / "starts.npy", np.array([*far[:2], behind, start(pose, 0.05, 2.0), *far[2:]]))
    scene = scenes / "textured_wall" / "textured_wall.xml"
    options = ["--poses", str(tmp_path / "starts.npy"), "--json", str(tmp_path / "out.json"), "--spp", "16"]
    assert cli.run(["align", str(scene), str(file), *options]) == 0, capsys.readouterr().err
    document = json.loads((tmp_path / "out.json").read_text())
    residuals = {candidate["name"]: float(candidate["rms"]) for candidate in document["candidates"]}
    assert sorted(residuals) == list("012345")
    assert list(residuals.values()) == sorted(residuals.values())
    # One of those far away may come back, too; the one that looks away has seen nothing.
    assert residuals["3"] < 1.2 * min(residuals.values()) < 0.2 * residuals["0"]
    assert np.isinf(residuals["2"])
    error = se3.log(se3.inverse(pose) @ np.array(document["pose"]))
    assert np.linalg.norm(error[:3]) < 0.02
    assert np.degrees(np.linalg.norm(error[3:])) < 0.5
    assert "of 6" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize(
    ("photograph", "asked", "used"),
    [((96, 72), None, SIZE), ((96, 72), (96, 72), (96, 72)), ((32, 24), None, (32, 24))],
)
def test_photographs_of_another_size_are_averaged_or_the_cameras_image_is(
    wall: Any, tmp_path: Path, photograph: Any, asked: Any, used: Any
) -> None:
    image, pose = rendered(wall, size=photograph)
    file = written(tmp_path / "photo.png", exposed(image, 4))
    found = align_photograph(wall, file, spp=16, pose=start(pose, 0.05, 1.0), size=asked)
    assert tuple(found.settings["size"]) == used
    assert found.measured.values.shape[:2] == used[::-1]
    assert found.verdict == "aligned"
    # Averages of areas are not what larger pixels measure, whose filter is wider.
    assert nees(found.alignment, pose) < (28.0 if used == photograph else 200.0)


@pytest.mark.slow
def test_what_is_masked_does_not_matter(wall: Any, truth: Any, tmp_path: Path) -> None:
    image, pose = truth
    mask = np.ones(image.shape[:2], dtype=np.uint8) * 255
    mask[:20, :20] = 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    poses = []
    for value in (0.0, 0.9):
        linear = np.where(mask[..., None] > 0, exposed(image, 5), value)
        file = written(tmp_path / f"{value}.png", linear)
        options = OPTIONS | {"pose": start(pose, 0.05, 1.0)}
        found = align_photograph(wall, file, mask=tmp_path / "mask.png", **options)
        assert found.measured.masked == 400
        selected = found.alignment.bound.information.selection.selected
        assert selected == 48 * 36 - 400 - found.measured.saturated
        poses.append(found.alignment.pose)
    np.testing.assert_array_equal(*poses)


def capture_of(wall: Any, pose: Any, folder: Path, count: int, error: Any = 0.0) -> Capture:
    """Photographs at poses nearby, of a scene that looks otherwise by some error (H, W, 3)."""
    photographs = []
    with measurement(wall, size=SIZE) as run:
        intrinsics = run.view.intrinsics
    for seed in range(count):
        here = start(pose, 0.3, 5.0, 100 + seed)
        linear = exposed(rendered(wall, here)[0], 100 + seed) + error * _blotches(seed)
        file = written(folder / f"{seed}.png", linear)
        photographs.append(Photograph(str(seed), str(file), intrinsics, here))
    return Capture(tuple(photographs), (), tuple(range(count)), "all", "made", "ours")


def _blotches(seed: int, width: float = 3.0) -> Any:
    """Grey errors that are alike over some pixels, of standard deviation 1."""
    from scipy import ndimage

    noise = np.random.default_rng(900 + seed).standard_normal((SIZE[1] + 40, SIZE[0] + 40))
    smooth = ndimage.gaussian_filter(noise, width)[20:-20, 20:-20, None]
    return smooth * 2.0 * np.sqrt(np.pi) * width * np.ones(3)


@pytest.mark.slow
def test_residuals_held_out_tell_noise_and_the_maps_error(wall: Any, truth: Any, tmp_path: Path) -> None:
    image, pose = truth
    clean = held_out_residuals(wall, capture_of(wall, pose, tmp_path, 4), **OPTIONS | {"spp": 128})
    # Eight bits, and the noise of what was photographed, add some per cent.
    np.testing.assert_allclose(clean.noise.estimate**0.5, 1.07 * SIGMA, rtol=0.07)
    inner = clean.in_radiance().noise.estimate ** 0.5
    np.testing.assert_allclose(inner, clean.noise.estimate**0.5 / GAIN, rtol=0.02)
    assert clean.covariance().pixels_alike == pytest.approx(1.0, abs=0.5)
    (tmp_path / "map").mkdir()
    wrong = capture_of(wall, pose, tmp_path / "map", 4, error=0.02)
    file = written(tmp_path / "photo.png", exposed(image, 7) + 0.02 * _blotches(7))
    options = OPTIONS | {"pose": start(pose, 0.05, 1.0)}
    found = align_photograph(wall, file, capture=wrong, **options)
    beside = found.alignment.misspecified
    assert beside is not None
    assert found.settings["noise"] == "held out"
    np.testing.assert_allclose(found.alignment.noise["sigmas"], np.hypot(SIGMA, 0.02), rtol=0.15)
    assert np.all(beside.ratios > 2.0)
    assert "map's error" in beside.gap
    error = se3.log(se3.inverse(pose) @ found.alignment.pose)
    assert error @ np.linalg.inv(beside.covariance) @ error < 28.0
    nothing = Capture(wrong.photographs, (0, 1, 2, 3), (), "all", "made", "ours")
    with pytest.raises(CaptureError, match="holds no photographs out"):
        held_out_residuals(wall, nothing, **OPTIONS)


@pytest.mark.slow
def test_errors_of_many_photographs_have_the_stated_covariance(wall: Any, truth: Any) -> None:
    """100 of them, gain and black unknown: mean NEES in its 99.9 % band, that of half the noise outside."""
    image, pose = truth
    # The expected image is defined as this render, as in `validate`.
    anchor = Anchor(pose, image[None], pose_jacobian(wall, size=SIZE, spp=256))
    squares, halves = [], []
    for seed in range(100):
        measured = exposed(image, 1000 + seed)
        options = OPTIONS | {"pose": start(pose, 0.01, 0.2, seed), "seed": seed, "anchor": anchor, "spp": 64}
        found = align(wall, measured, None, tone="channels", **options)
        assert found.status == "converged"
        error = se3.log(se3.inverse(pose) @ found.pose)
        covariance = found.bound.covariance
        squares.append(error @ np.linalg.inv(covariance + found.added) @ error)
        halves.append(error @ np.linalg.inv(covariance / 4.0 + found.added) @ error)
    low, high = stats.chi2.ppf([0.0005, 0.9995], 600) / 100
    assert low < np.mean(squares) < high
    assert np.mean(halves) > high


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["photo.png", "--pose", "nowhere.txt"], "nowhere.txt"),
        (["nothing.png"], "cannot read nothing.png"),
        (["scene.txt"], "scene.txt is no image"),
        (["black.png"], "black.png is of one colour"),
        (["wide.png"], "another shape"),
        (["photo.png", "--mask", "wide.png"], "the mask wide.png has 48x12 pixels"),
        (["photo.png", "--photo-encoding", "rec709"], "srgb"),
        (["photo.png", "--poses", "scene.txt"], "scene.txt"),
        (["photo.png", "--poses", "a.npy", "--pose", "0 0 0 0 0 0 1"], "leave out one of them"),
        (["photo.png", "--convention", "opencv"], "give --poses"),
        (["photo.png", "--photographs", "folder"], "no posed photographs"),
        (["photo.png", "--sigma", "-1"], "positive"),
        (["photo.png", "--levels", "-1"], "levels must not be negative"),
        (["photo.png", "--json", "photo.png"], "overwrite an input"),
        (["photo.png", "--json", "out", "--residual", "out"], "both name out"),
        (["photo.png", "--residual", "trials.json"], "holds trials"),
    ],
)
def test_what_cannot_be_aligned_is_one_line(
    scenes: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    noise = np.random.default_rng(0).uniform(0.1, 0.8, (*SIZE[::-1], 3))
    written(Path("photo.png"), noise)
    written(Path("black.png"), 0.0 * noise)
    written(Path("wide.png"), noise[:12])
    Path("scene.txt").write_text("no picture, no pose")
    Path("trials.json").write_text('{"schema": "mitsuba-crb/validate/2", "results": []}')
    Path("folder").mkdir()
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir() if file.is_file()}
    scene = str(scenes / "textured_wall" / "textured_wall.xml")
    code = cli.run(["align", scene, *arguments, "-D", "width=48", "-D", "height=36", "--spp", "4"])
    out, err = capsys.readouterr()
    assert code == 2, err
    assert out == ""
    assert err.count("\n") == 1
    assert words in err
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir() if file.is_file()} == before


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--photographs", "nowhere"], "cannot read nowhere"),
        (["--photographs", "."], "no posed photographs"),
        (["--photographs", ".", "--poses", "starts.npy"], "--photographs is of a single pose"),
        (["--photographs", "capture", "--prior", "prior.toml"], "leave out --prior"),
        (["--photographs", "capture", "--measure", "depth"], "leave out --prior and --measure"),
    ],
)
def test_photographs_that_cannot_stand_beside_a_bound_are_one_line(
    scenes: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = Path("capture")
    folder.mkdir()
    written(folder / "a.png", np.random.default_rng(0).uniform(0.1, 0.8, (36, 48, 3)))
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
    document = {"w": 48, "h": 36, "fl_x": 50.0, "fl_y": 50.0, "frames": [frame]}
    (folder / "transforms.json").write_text(json.dumps(document))
    Path("prior.toml").write_text('position_std = 0.5\nframe = "camera"\n')
    scene = str(scenes / "textured_wall" / "textured_wall.xml")
    assert cli.run(["bound", scene, *arguments, "--spp", "4", "--size", "48x36"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert words in err


@pytest.mark.slow
def test_a_photograph_of_something_else_is_not_aligned(
    scenes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    blotches = 0.4 + 0.1 * _blotches(1, 2.0)
    file = written(tmp_path / "photo.png", blotches)
    scene = str(scenes / "textured_wall" / "textured_wall.xml")
    code = cli.run(["align", scene, str(file), "--spp", "4", "--levels", "0", "--iterations", "4"])
    assert code in (1, 3)
    out = capsys.readouterr().out
    assert "start nearer (--pose)" in out
