"""The commands take radiance fields where they take scenes, and refuse in one line what they cannot."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from small_grid import write_grid
from small_splats import FOCAL, SIZE, write_splats

from mitsuba_crb import Intrinsics, check_jacobian, pose_bound, se3
from mitsuba_crb.camera import Camera
from mitsuba_crb.cli import app as cli
from mitsuba_crb.noise import Gaussian
from mitsuba_crb.radiance.beside import beside
from mitsuba_crb.radiance.exact import FIELD_METHODS, Exact
from mitsuba_crb.radiance.files import as_field

PIXELS = np.stack(np.meshgrid(*(np.arange(n) for n in SIZE)), axis=-1).reshape(-1, 2)


@pytest.fixture
def splats(tmp_path: Path) -> Path:
    return write_splats(tmp_path)


def _out(capsys: pytest.CaptureFixture[str]) -> str:
    return " ".join(capsys.readouterr().out.split())


def test_a_bound_of_splats_is_that_of_their_columns(
    splats: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The 1e-5 are what two orders of summation differ by."""
    assert cli.run(["bound", str(splats), "--sigma", "0.01", "--json", str(tmp_path / "a.json")]) == 0
    out = _out(capsys)
    assert "deterministic: there are no paths" in out
    assert "Monte Carlo" not in out
    assert "measures colour, display-referred" in out
    assert "σ = 0.01 display-referred (given)" in out
    document = json.loads((tmp_path / "a.json").read_text())
    assert (document["method"], document["spp"], document["deterministic"]) == ("exact", 0, True)
    assert document["field"]["splats"] == 30
    field, found = as_field(splats), beside(splats)
    assert field is not None
    assert found is not None
    view = found.viewpoints[0]
    _, columns = field.columns(Camera.of(view.intrinsics), view.pose, PIXELS)
    F = np.einsum("nci,ncj->ij", columns, columns) / 0.01**2
    C = np.linalg.inv(F)
    np.testing.assert_allclose(document["rotation_std_deg"], np.degrees(np.sqrt(np.diag(C)[3:])), rtol=1e-5)


def test_round_splats_on_the_axis_do_not_see_a_roll(tmp_path: Path) -> None:
    """Its column is what is left of terms that cancel, in float32; all else is seen."""
    bound = pose_bound(write_splats(tmp_path, on_axis=True), Gaussian(0.01))
    assert bound.rank == 5
    assert np.isinf(bound.rotation_std_deg[2])
    assert np.isfinite([*bound.position_std, *bound.rotation_std_deg[:2]]).all()


def test_precision_and_paths_are_accepted_and_mean_nothing(
    splats: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.run(["bound", str(splats)]) == 0
    first = capsys.readouterr().out.partition("time ")[0]
    for more in (["--spp", "8"], ["--precision", "0.01"], ["--max-spp", "64"]):
        assert cli.run(["bound", str(splats), *more]) == 0
        assert capsys.readouterr().out.partition("time ")[0] == first
    assert "0.01 of white 1 (display-referred)" in first


def test_what_is_said_of_a_file_counts(splats: Path, tmp_path: Path) -> None:
    """Another dilation and another background are other images."""
    found = []
    for more in ([], ["-D", "variant=mip"], ["-D", "background=1,0.5,0"]):
        assert cli.run(["bound", str(splats), "--sigma", "0.01", *more, "--json", str(tmp_path / "a")]) == 0
        found.append(json.loads((tmp_path / "a").read_text())["position_std"][0])
    assert len(set(found)) == 3


@pytest.mark.slow
@pytest.mark.parametrize("write", [write_splats, write_grid])
def test_check_agrees_and_finds_wrong_columns(
    write: Callable[[Path], Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The control: columns that are too large by a tenth."""
    file = write(tmp_path)
    assert cli.run(["check", str(file)]) == 0
    assert "exact and finite_difference agree" in _out(capsys)

    class Wrong(Exact):
        def _all(self, pixels: Any, batches: int) -> Any:
            found = super()._all(pixels, batches)
            return found._replace(columns=1.1 * found.columns)

    monkeypatch.setitem(FIELD_METHODS, "exact", Wrong)
    assert cli.run(["check", str(file)]) == 1
    assert "exact disagrees with finite_difference" in _out(capsys)
    assert all(check_jacobian(file).rows[0].disagrees)


def test_validate_finds_the_errors_that_the_bound_says(
    splats: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["validate", str(splats), "--trials", "8", "--workers", "1", "--perturb-trans", "0.005"]
    assert cli.run([*command, "--sigma", "0.01"]) == 0
    out = _out(capsys)
    assert "the errors are as the bound says" in out
    assert "deterministic renders" in out


@pytest.mark.slow
def test_validate_in_processes_is_the_same(splats: Path, tmp_path: Path) -> None:
    command = ["validate", str(splats), "--trials", "12", "--sigma", "0.01", "--perturb-trans", "0.005"]
    found = []
    for workers in ("1", "2"):
        file = tmp_path / f"{workers}.json"
        assert cli.run([*command, "--workers", workers, "--json", str(file)]) == 0
        found.append([trial["error"] for trial in json.loads(file.read_text())["results"]])
    assert found[0] == found[1]


TEAM = """
[[agents]]
name = "left"
scene = "splats.ply"
sensor = 0

[[agents]]
name = "right"
scene = "splats.ply"
sensor = "view1"
defines = { variant = "classic" }
"""


def test_agents_in_one_splat_are_fused_and_choose_tiles(
    splats: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "team.toml").write_text("[tiles]\nsize = 8\n" + TEAM)
    out = tmp_path / "out.json"
    assert cli.run(["fuse", str(tmp_path / "team.toml"), "--workers", "1", "--json", str(out)]) == 0
    alone = [pose_bound(splats, sensor=k).position_std for k in (0, 1)]
    joint = json.loads(out.read_text())["position_std"]
    assert np.all(np.array(joint) < np.minimum(*alone))
    capsys.readouterr()
    assert cli.run(["select", str(tmp_path / "team.toml"), "--workers", "1", "--budget", "4"]) == 0
    assert "left" in capsys.readouterr().out


def test_many_poses_are_a_table(splats: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    csv = tmp_path / "a.csv"
    assert cli.run(["bound", str(splats), "--poses", str(tmp_path / "cameras.json"), "--csv", str(csv)]) == 0
    out = _out(capsys)
    assert "0.01 of white 1, one exposure for all poses" in out
    assert "exact, deterministic" in out
    assert len(csv.read_text().splitlines()) == 3


def test_nuisances_cost(splats: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.json"
    names = ["--marginalize", "gain", "--marginalize", "fov"]
    assert cli.run(["bound", str(splats), *names, "--json", str(out)]) == 0
    document = json.loads(out.read_text())
    found, how = document["nuisances"]["if_known"], document["nuisances"]["how"]
    assert how["gain"] == "the image itself"
    assert how["fov"].startswith("finite differences")
    for name in how:
        assert document["position_std"][2] > found[name]["position_std"][2]


def test_cameras_are_given_or_lie_beside_or_are_asked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    splats = write_splats(tmp_path, cameras=0)
    (tmp_path / "camera.toml").write_text(f"size = {list(SIZE)}\nfocal = {list(FOCAL)}\n")
    camera = ["--camera", str(tmp_path / "camera.toml")]
    pose = ["--pose", "0 0 0 0 0 1 0"]
    assert cli.run(["bound", str(splats), *camera, *pose]) == 0
    capsys.readouterr()
    for some in ([], camera, pose):
        assert cli.run(["bound", str(splats), *some]) == 2
        err = capsys.readouterr().err
        assert err.count("\n") == 1
        assert "--camera FILE" in err
        assert "--pose" in err


def test_a_photograph_of_something_else_is_warned_of(
    splats: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    field, found = as_field(splats), beside(splats)
    assert field is not None
    assert found is not None
    (tmp_path / "images").mkdir()
    view = found.viewpoints[0]
    image = field.show(Camera.of(view.intrinsics), view.pose, PIXELS).values.reshape(24, 32, 3)
    true = (255.0 * np.clip(image, 0.0, 1.0)).round().astype(np.uint8)
    for picture, warned in ((true, False), (true[::-1, ::-1], True)):
        Image.fromarray(picture).save(tmp_path / "images" / "view0.png")
        assert cli.run(["bound", str(splats)]) == 0
        out = _out(capsys)
        assert ("probably of another frame" in out) is warned
        assert "photograph view0.png: PSNR of the render " in out
    # From elsewhere, or through another camera, there is nothing to compare.
    assert cli.run(["bound", str(splats), "--pose", "0 0 0 0 0 1 0"]) == 0
    assert "PSNR" not in _out(capsys)


def test_a_photograph_is_aligned(splats: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of noise 0.01, started 2 degrees and 0.07 away: within four standard deviations of the truth."""
    field, found = as_field(splats), beside(splats)
    assert field is not None
    assert found is not None
    view = found.viewpoints[0]
    image = field.show(Camera.of(view.intrinsics), view.pose, PIXELS).values.reshape(24, 32, 3)
    image = image + 0.01 * np.random.default_rng(0).standard_normal(image.shape)
    Image.fromarray((255.0 * np.clip(image, 0.0, 1.0)).round().astype(np.uint8)).save(tmp_path / "photo.png")
    np.savetxt(tmp_path / "start.txt", view.pose @ se3.exp([0.05, -0.03, 0.05, 0.01, 0.03, -0.01]))
    out = tmp_path / "out.json"
    command = ["align", str(splats), str(tmp_path / "photo.png"), "--pose", str(tmp_path / "start.txt")]
    assert cli.run([*command, "--json", str(out)]) == 0
    assert "deterministic renders" in _out(capsys)
    document = json.loads(out.read_text())
    off = np.array(document["pose"])[:3, 3] - view.pose[:3, 3]
    assert np.all(np.abs(off) < 4.0 * np.array(document["ideal"]["position_std"]))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("--measure depth", "whose depth is not measured"),
        ("--measure rgbd", "whose depth is not measured"),
        ("--method flow", "methods: exact, finite_difference"),
        ("--integrator path", "has no integrator"),
        ("--light sky", "no light"),
        ("-D colour=1", "variant, background"),
        ("-D variant=best", "classic"),
        ("-D background=red", "background"),
        ("--sensor 7", "comes with 2 cameras"),
        ("--sensor vew1", "view1"),
        ("--marginalize wall.bsdf.reflectance.value", "no nuisance of a radiance field"),
        ("--size 20x20", "another shape"),
        ("--camera lens.toml", "undistort"),
    ],
)
def test_what_splats_have_not_is_refused_in_a_line(
    arguments: str,
    words: str,
    splats: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(splats.parent)
    Path("lens.toml").write_text('size = [32, 24]\nfocal = 30\nmodel = "opencv"\nk1 = -0.1\n')
    assert cli.run(["bound", str(splats), *shlex.split(arguments)]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert len(err.strip().splitlines()) == 1
    assert words in err


def test_a_trained_field_is_taken_with_its_cameras(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    grid, out = write_grid(tmp_path), tmp_path / "a.json"
    assert cli.run(["bound", str(grid), "--sensor", "view1", "--sigma", "0.01", "--json", str(out)]) == 0
    document = json.loads(out.read_text())
    assert (document["sensor"], document["method"], document["size"]) == ("view1", "exact", [16, 12])
    assert document["field"]["kind"] == "hash grid"
    assert document["rank"] == 6
    capsys.readouterr()
    assert cli.run(["bound", str(grid), "-D", "variant=mip"]) == 2
    assert "trained fields have none" in capsys.readouterr().err
    assert cli.run(["bound", str(tmp_path / "missing.npz")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_mesh_in_ply_is_a_world_still(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trimesh = pytest.importorskip("trimesh")
    box = trimesh.creation.box()
    box.visual.vertex_colors = np.random.default_rng(0).integers(0, 255, (8, 4)).astype(np.uint8)
    box.export(tmp_path / "box.ply")
    command = [
        "bound",
        str(tmp_path / "box.ply"),
        "--pose",
        "0.1 0 3 0 1 0 0",
        "--size",
        "16x12",
        "--spp",
        "8",
    ]
    assert cli.run([*command, "--light", "baked", "--sigma", "0.01"]) == 0
    assert "flow, 8 paths per pixel" in _out(capsys)


def test_objects_are_measured_as_their_files_are(splats: Path) -> None:
    field, found = as_field(splats), beside(splats)
    assert found is not None
    by_file = pose_bound(splats, Gaussian(0.01))
    intrinsics: Intrinsics = found.viewpoints[0].intrinsics
    by_object = pose_bound(field, Gaussian(0.01), camera=intrinsics, pose=found.viewpoints[0].pose)
    assert np.array_equal(by_file.information.matrix, by_object.information.matrix)
