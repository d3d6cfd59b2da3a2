"""Teams of agents: their file, their processes, the two commands, and the warehouse that needs all four."""

from __future__ import annotations

import dataclasses
import json
import re
import warnings
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from matrices import misfit
from small_scenes import camera, texture, wall
from small_scenes import scene as scene_of

from mitsuba_crb import fisher_information, pose_bound, se3
from mitsuba_crb.agents.fusion import Agent, fuse
from mitsuba_crb.agents.selection import select_tiles
from mitsuba_crb.agents.tiles import Budget
from mitsuba_crb.cli import app as cli
from mitsuba_crb.datasets.intrinsics import load_camera
from mitsuba_crb.errors import (
    BlindSpotWarning,
    CameraError,
    ConfigError,
    FrameError,
    MitsubaCRBError,
    NoiseError,
    OptionError,
    PoseError,
    SelectionError,
    SensorError,
    WorkerError,
)
from mitsuba_crb.information.image_jacobian import ImageJacobian
from mitsuba_crb.information.linearisation import Linearisation, PixelSelection
from mitsuba_crb.measure import teams as team_measure
from mitsuba_crb.measure.options import MeasurementOptions
from mitsuba_crb.measure.team_file import MeasureTable, load_team
from mitsuba_crb.measure.teams import fuse_team, select_team
from mitsuba_crb.noise import Gaussian, Laplace, SigmaTable, Stereo
from mitsuba_crb.render.pixels import render_pixels
from mitsuba_crb.render.view import open_view

# Few samples on small images: that standard errors exceed 10 % is expected.
pytestmark = pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")

WAREHOUSE = Path(__file__).parents[2] / "scenes" / "warehouse"
AGENTS = ("racks", "shutter", "floor", "duct")


def written(folder: Path, text: str = "", *, agents: Any = ("racks", "floor"), each: str = "") -> Path:
    """A team of some of the warehouse's robots, small and fast."""
    measure = "" if "[measure]" in text else "[measure]\nsize = [32, 24]\nspp = 8\n"
    each = each if "noise" in each else f"{each}\nnoise = 0.01"
    tables = [
        f'[[agents]]\nname = "{name}"\nscene = "{WAREHOUSE}/warehouse.xml"\nsensor = "{name}"\n'
        for name in agents
    ]
    path = folder / "team.toml"
    path.write_text(f"{text}\n{measure}" + "".join(f"{table}{each}\n" for table in tables), encoding="utf-8")
    return path


def refused(capsys: Any, *arguments: str) -> str:
    """The one line on standard error of a command that must exit with code 2 and print nothing else."""
    assert cli.run(list(arguments)) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("mitsuba-crb: ")
    assert err.count("\n") == 1
    return str(err)


@pytest.fixture(scope="module")
def result() -> Any:
    """The warehouse's four robots, fused."""
    return fuse_team(load_team(WAREHOUSE / "warehouse.toml"), workers=1)


class TestWarehouse:
    def test_every_single_view_hides_one_direction_and_all_together_none(self, result: Any) -> None:
        assert [share.name for share in result.fusion.agents] == list(AGENTS)
        assert [share.rank for share in result.fusion.agents] == [5] * 4
        words = ("axis z", "axis x", "axis y", "roll")
        for bound, word in zip(result.bounds, words, strict=True):
            assert len(bound.unobserved) == 1
            assert word in bound.unobserved[0].description
        assert result.fusion.bound.rank == 6
        assert np.isfinite(result.fusion.bound.position_std).all()
        assert np.isfinite(result.fusion.bound.rotation_std_deg).all()
        assert sum(share.share for share in result.fusion.agents) == pytest.approx(1.0)

    @pytest.mark.slow
    def test_the_hidden_directions_are_the_derived_ones(self) -> None:
        """In the world: translations along z, x and y, and the roll about x through the duct's centre.

        To 0.8 degrees, for which the duct's 64 paths are too few: 512 leave a tenth of it.
        """
        axis = np.array([1.0, 0.0, 0.0])
        derived = [
            np.eye(6)[2],
            np.eye(6)[0],
            np.eye(6)[1],
            np.concatenate([-np.cross(axis, [0, 0.5, 2.2]), axis]),
        ]
        bounds = [
            pose_bound(WAREHOUSE / "warehouse.xml", Gaussian(0.01), sensor=name, size=(128, 96), spp=512)
            for name in AGENTS
        ]
        for bound, twist in zip(bounds, derived, strict=True):
            own = se3.adjoint(se3.inverse(bound.information.pose)) @ twist
            scaled = own / bound.information.scale
            found = bound.unobserved[0].direction
            cosine = abs(found @ scaled) / np.linalg.norm(found) / np.linalg.norm(scaled)
            assert cosine > 1.0 - 1e-4

    def test_the_body_s_information_is_the_sum_about_its_own_pose(self, result: Any) -> None:
        body = np.eye(4)
        body[2, 3] = 2.0
        np.testing.assert_allclose(result.fusion.information.pose, body, atol=1e-12)
        expected = 0.0
        for bound in result.bounds:
            A = se3.adjoint(se3.inverse(bound.information.pose) @ body)
            expected = expected + A.T @ bound.information.matrix @ A
        error = np.abs(result.fusion.information.matrix - expected).max()
        assert error < 1e-6 * np.abs(expected).max()  # poses from a float32 scene

    @pytest.mark.slow
    @pytest.mark.parametrize("name", ["camera", *AGENTS])
    def test_flow_and_finite_differences_agree_for_every_sensor(self, name: str) -> None:
        options: Any = {"sensor": name, "size": (64, 48), "spp": 64, "seed": 4}
        scene = str(WAREHOUSE / "warehouse.xml")
        flow, reference = (
            pose_bound(scene, Gaussian(0.01), method=method, **options).information
            for method in ("flow", "finite_difference")
        )
        error = np.hypot(flow.standard_error, reference.standard_error)
        scale = np.sqrt(np.abs(np.diagonal(reference.matrix)))
        # 2 % of the diagonal is the bias of finite steps across a silhouette.
        slack = 5.0 * error + 0.02 * np.outer(scale, scale)
        assert np.all(np.abs(flow.matrix - reference.matrix) < slack)


@pytest.mark.slow
def test_a_rendered_rig_s_joint_information_is_that_of_its_images_stacked_and_moved_as_one_body() -> None:
    """The oracle moves the body, renders all four cameras anew, and treats their images as one."""
    world_from_body = se3.exp([0.2, -0.1, 0.0, 0.1, 0.2, -0.1])
    places = {
        "a": se3.exp([0.5, 0.0, 0.0, 0.0, 0.2, 0.0]),
        "b": se3.exp([-0.5, 0.1, 0.0, 0.1, -0.2, 0.0]),
        "c": se3.exp([0.0, 0.4, 0.2, -0.2, 0.0, 0.5]),
        "d": se3.exp([0.1, -0.3, -0.4, 0.1, 0.1, 3.0]),
    }
    loaded = mi.load_dict(scene_of(wall=wall(texture(cells=8)), sensor=camera(16, 12)))
    batches, spp, sigma = 4, 64, Gaussian(0.01)
    steps = np.array([4e-3] * 3 + [1e-3] * 3)
    stacked, agents = [], []
    for name, body_from_camera in places.items():
        pose = world_from_body @ body_from_camera
        bound = pose_bound(loaded, sigma, pose=pose, spp=batches * spp, seed=7)
        agents.append(Agent(name, bound.information, body_from_camera))
        with open_view(loaded, pose=pose) as view:
            x, y = np.meshgrid(np.arange(16), np.arange(12))
            pixels = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.int64)

            def moved(
                twist: Any, view: Any = view, pixels: Any = pixels, place: Any = body_from_camera
            ) -> Any:
                there = world_from_body @ se3.exp(twist) @ place
                return render_pixels(view, pixels, spp=spp, seed=8, batches=batches, pose=there)

            columns = [
                (moved(h * e) - moved(-h * e)) / (2.0 * h) for h, e in zip(steps, np.eye(6), strict=True)
            ]
        stacked.append(np.stack(columns, axis=-1))
    values = np.concatenate(stacked, axis=1)
    count = values.shape[1]
    oracle = fisher_information(
        ImageJacobian(
            batch_values=values,
            pixels=np.stack([np.arange(count), np.zeros(count, int)], axis=1),
            image=np.zeros((1, count, 3)),
            linearisation=Linearisation(
                variable="rig",
                frame="camera",
                pose=world_from_body,
                length_scale=3.0,
                selection=PixelSelection("all", count, count, "all"),
            ),
        ),
        sigma,
    )
    joint = fuse(agents, variable="rig").information
    error = np.hypot(joint.standard_error, oracle.standard_error)
    scale = np.sqrt(np.diagonal(oracle.matrix))
    # 36 entries at 4 standard errors, and 1 % of the diagonal for the finite step.
    assert np.all(np.abs(joint.matrix - oracle.matrix) < 4.0 * error + 0.01 * np.outer(scale, scale))
    # Negative control: the identity in place of the adjoint, or the inverted transform, is far away.
    for wrong in (np.eye(4), None):
        total = 0.0
        for agent in agents:
            A = se3.adjoint(agent.common_from_agent) if wrong is None else se3.adjoint(wrong)
            total = total + A.T @ agent.information.matrix @ A
        assert misfit(total, oracle.matrix) > 0.1


class TestProcesses:
    @pytest.mark.slow
    def test_results_do_not_depend_on_the_number_of_processes_or_the_order(self, tmp_path: Path) -> None:
        alone = fuse_team(load_team(written(tmp_path)), workers=1)
        spawned = fuse_team(load_team(written(tmp_path)), workers=2)
        turned = fuse_team(load_team(written(tmp_path, agents=("floor", "racks"))), workers=1)
        for bound, other in zip(alone.bounds, spawned.bounds, strict=True):
            np.testing.assert_array_equal(bound.information.matrix, other.information.matrix)
        for bound, other in zip(alone.bounds, turned.bounds[::-1], strict=True):
            np.testing.assert_array_equal(bound.information.matrix, other.information.matrix)

    def test_agents_have_random_numbers_of_their_own(self, tmp_path: Path) -> None:
        team = load_team(written(tmp_path, agents=("racks", "floor", "duct")))
        seeds = [team.options(member)["seed"] for member in team.members]
        assert len(set(seeds)) == 3
        other = load_team(written(tmp_path, "[measure]\nsize = [32, 24]\nseed = 1\n"))
        assert team.options(team.members[0])["seed"] != other.options(other.members[0])["seed"]

    @pytest.mark.slow
    def test_an_error_names_its_agent(self, tmp_path: Path) -> None:
        path = written(tmp_path, agents=("racks", "dukt"))
        with pytest.raises(SensorError, match=r"agent 'dukt': .*no sensor"):
            fuse_team(load_team(path), workers=1)
        with pytest.raises(OptionError, match="worker"):
            fuse_team(load_team(path), workers=0)

    @pytest.mark.slow
    def test_a_process_that_dies_is_reported(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(team_measure, "_bound", _dies)
        with pytest.raises(WorkerError, match="--workers"):
            fuse_team(load_team(written(tmp_path)), workers=2)

    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("name", "measured", "workers"),
        [
            ("_bound", fuse_team, 1),
            ("_bound", fuse_team, 2),
            ("_tiles", lambda *a, **k: select_team(*a, Budget(), **k), 1),
        ],
        ids=["fuse", "fuse in processes", "select"],
    )
    def test_an_agent_that_fails_has_warned_before(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, measured: Any, workers: int
    ) -> None:
        monkeypatch.setattr(team_measure, name, _warns_and_fails)
        with (
            pytest.warns(BlindSpotWarning, match="racks: it sees little"),
            pytest.raises(SensorError, match="agent 'racks': it is broken"),
        ):
            measured(load_team(written(tmp_path)), workers=workers)

    def test_a_command_of_a_team_that_fails_says_what_it_warned_of(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
    ) -> None:
        monkeypatch.setattr(team_measure, "_bound", _warns_and_fails)
        assert cli.run(["fuse", str(written(tmp_path)), "--workers", "1"]) == 2
        note, error = capsys.readouterr().err.splitlines()
        assert note == "mitsuba-crb: note: racks: it sees little"
        assert error == "mitsuba-crb: agent 'racks': it is broken"

    @pytest.mark.slow
    def test_what_the_joint_bound_warns_of_is_said_with_what_its_agents_have(
        self, tmp_path: Path, capsys: Any
    ) -> None:
        team = written(tmp_path, "[measure]\nsize = [12, 8]\nspp = 4\n")
        found = fuse_team(load_team(team), workers=1)
        named = {text.partition(":")[0] for text in found.warnings}
        assert named == {"racks", "floor", "body"}
        file = tmp_path / "fused.json"
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # none is left to Python
            assert cli.run(["fuse", str(team), "--workers", "1", "--json", str(file)]) == 0
        out, err = capsys.readouterr()
        assert err == ""
        assert all(out.count(f"note: {text}\n") == 1 for text in found.warnings)
        assert json.loads(file.read_text(encoding="utf-8"))["warnings"] == list(found.warnings)


def _warns_and_fails(job: Any) -> None:
    if job.member.name == "racks":
        warnings.warn("it sees little", BlindSpotWarning, stacklevel=2)
        raise SensorError("it is broken")


def _dies(job: Any) -> None:
    import os

    os._exit(1)


class TestSelect:
    @pytest.mark.slow
    def test_the_commands_write_what_the_library_finds(self, tmp_path: Path, capsys: Any) -> None:
        path = written(tmp_path, "[tiles]\nsize = [8, 12]\n", each="budget = 4\n")
        files = {name: tmp_path / f"{name}.json" for name in ("fuse", "select")}
        plots = tmp_path / "plots"
        progress: list[tuple[int, int]] = []
        team = load_team(path)
        expected = select_team(team, Budget(tiles=5), workers=1, on_agent=lambda *done: progress.append(done))
        assert progress == [(1, 2), (2, 2)]
        arguments = ["--budget", "5", "--workers", "1", "--json", str(files["select"]), "--plot", str(plots)]
        assert cli.run(["select", str(path), *arguments]) == 0
        out = capsys.readouterr().out
        for word in (
            "on the half chosen by",
            "held out",
            "upper bound",
            "certificate",
            "random",
            "equal split",
        ):
            assert word in out
        found = json.loads(files["select"].read_text(encoding="utf-8"))
        assert found["schema"] == "mitsuba-crb/select/1"
        assert found["objective"] == "logdet"
        assert len(found["chosen"]) == 5
        assert found["chosen"] == [vars(chosen) for chosen in expected.selection.chosen]
        assert found["value"] <= found["upper_bound"]
        assert found["value_heldout"] == pytest.approx(expected.selection.value_heldout)
        assert set(found["baselines"]) == {"random", "equal_split", "top_trace"}
        assert 0.0 < found["certificate"] <= 1.0
        assert [len(agent["tiles"]) for agent in found["agents"]] == [8, 8]
        budgets = [point["tiles"] for point in found["curve"]]
        assert budgets == sorted(set(budgets))
        assert budgets[-1] == 10
        bounds = [point["upper_bound"] for point in found["curve"]]
        assert bounds == sorted(bounds)
        assert all(point["value"] <= point["upper_bound"] for point in found["curve"])
        assert sorted(p.name for p in plots.iterdir()) == ["01_racks.png", "02_floor.png", "budget.png"]
        assert cli.run(["fuse", str(path), "--workers", "1", "--json", str(files["fuse"])]) == 0
        assert "share" in capsys.readouterr().out
        found = json.loads(files["fuse"].read_text(encoding="utf-8"))
        assert found["schema"] == "mitsuba-crb/fuse/1"
        assert found["rank"] == 6
        assert np.shape(found["information"]) == np.shape(found["covariance"]) == (6, 6)
        assert [agent["name"] for agent in found["agents"]] == ["racks", "floor"]
        assert all({"name", "rank", "share"} <= set(agent) for agent in found["agents"])

    @pytest.mark.slow
    def test_budgets_of_the_file_hold_unless_one_is_asked_for(self, tmp_path: Path) -> None:
        team = load_team(written(tmp_path, "[tiles]\nsize = [16, 12]\n", each="budget = 2\nbytes = 100000\n"))
        own = select_team(team, Budget(), workers=1)
        assert len(own.selection.chosen) == 4
        again = select_tiles(own.agents, Budget(tiles_per_agent={"racks": 2, "floor": 2}))
        assert own.selection.chosen == again.chosen
        asked = select_team(team, Budget(tiles_per_agent=3), workers=1)
        assert len(asked.selection.chosen) == 6

    @pytest.mark.slow
    def test_byte_budgets_have_a_curve_over_bytes_and_too_large_ones_are_fine(self, tmp_path: Path) -> None:
        team = load_team(written(tmp_path, '[tiles]\nsize = 16\nprecision = "float16"\n'))
        result = select_team(team, Budget(bytes=700), workers=1)
        assert result.counts == "bytes"
        assert result.selection.total_bytes <= 700
        everything = select_team(team, Budget(tiles=10**9), workers=1, objective="lambda_min")
        assert len(everything.selection.chosen) == 8
        assert everything.curve[-1][0] == 8


def _exposures(folder: Path, text: str = "", *, noise: str = "") -> list[float | None]:
    """The white of each of two robots; a noise of its own is that of the second."""
    file = written(folder, each="noise = 0.01")
    first, second = file.read_text(encoding="utf-8").split("noise = 0.01\n[[agents]]")
    whole = f"{first}[[agents]]{second}".replace("noise = 0.01", noise)
    file.write_text(whole.replace("[measure]\n", f"[measure]\n{text}"), encoding="utf-8")
    found = fuse_team(load_team(file), workers=1)
    return [bound.provenance["noise"].get("white") for bound in found.bounds]


@pytest.mark.slow
def test_all_views_of_a_team_have_one_exposure_unless_it_says_otherwise(tmp_path: Path) -> None:
    one, other = _exposures(tmp_path, 'exposure = "auto"\n')
    assert one is not None
    assert other is not None
    assert abs(np.log(one / other)) > 0.01
    pooled = _exposures(tmp_path)
    assert pooled[0] == pooled[1]
    assert min(one, other) < pooled[0] < max(one, other)  # type: ignore[operator]
    assert _exposures(tmp_path, "exposure = 0.5\n") == [0.5, 0.5]
    assert _exposures(tmp_path, 'exposure = "auto"\n', noise="noise = 0.02") == [one, None]


def test_every_key_of_the_measurement_is_an_option_s_with_its_type(tmp_path: Path) -> None:
    given = {"size": (32, 24), "spp": 16, "seed": 2, "batches": 8, "method": "flow", "drop_invalid": True}
    given |= {"exposure": 0.5, "clip": False}
    adaptive = {"precision": 0.02, "max_spp": 512}  # in place of spp
    assert {*given, *adaptive, "integrator"} == set(MeasureTable.model_fields)
    team = load_team(written(tmp_path, "[measure]\nprecision = 0.02\nmax_spp = 512\n"))
    options = MeasurementOptions(**team.options(team.members[0]))
    assert (options.spp, options.precision, options.max_spp) == (None, 0.02, 512)
    text = f"[measure]\n{''.join(f'{k} = {json.dumps(v)}{chr(10)}' for k, v in given.items())}"
    team = load_team(written(tmp_path, f'{text}integrator = "path"\n'))
    exposing = dataclasses.replace(team.members[0], noise=None)
    options = MeasurementOptions(**team.options(exposing))
    assert not {"exposure", "clip"} & set(team.options(team.members[0]))  # its noise is another's
    assert {**given, "integrator": "path", "seed": options.seed} == {
        key: getattr(options, key) for key in MeasureTable.model_fields if key not in adaptive
    }


def test_noise_is_a_number_a_table_or_a_file(tmp_path: Path) -> None:
    (tmp_path / "sensor.toml").write_text("[noise]\nmodel = 'laplace'\nscale = 0.02\n", encoding="utf-8")
    for text, expected in (
        ("0.01", Gaussian(0.01)),
        ("{ model = 'gaussian', sigma = 0.01 }", Gaussian(0.01)),
        ("'sensor.toml'", Laplace(0.02)),
    ):
        team = load_team(written(tmp_path, each=f"noise = {text}\n"))
        assert [member.noise for member in team.members] == [expected] * 2


def test_an_agent_has_a_camera_and_measures_as_its_table_says(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text(
        "[left]\nsize = [64, 48]\nfocal = 60.0\nmodel = 'opencv'\nk1 = -0.1\n"
        "[right]\nsize = [64, 48]\nfocal = 50.0\n",
        encoding="utf-8",
    )
    (tmp_path / "sigma.txt").write_text("1 0.01\n3 0.05\n", encoding="utf-8")
    for text, expected in (
        ("camera = 'rig.toml:left'", {"camera": load_camera(tmp_path / "rig.toml", "left")}),
        ("channels = 'luminance'", {"channels": "luminance"}),
        ("measure = 'rgbd'\nrange = [0.4, inf]", {"measure": "rgbd", "depth_range": (0.4, np.inf)}),
        (
            "measure = 'rgbd'\ndepth_sigma = 'sigma.txt'\ndepth_edges = true",
            {"measure": "rgbd", "depth_sigma": SigmaTable([1, 3], [0.01, 0.05]), "depth_edges": True},
        ),
        (
            "measure = 'rgbd'\ndepth_sigma = 'stereo:0.05,0.1'",
            {"measure": "rgbd", "depth_sigma": Stereo(0.05, 0.1)},
        ),
        ("measure = 'rgbd'\ndepth_sigma = 0.02", {"measure": "rgbd", "depth_sigma": 0.02}),
    ):
        member = load_team(written(tmp_path, each=f"{text}\n")).members[0]
        assert member.sensing == expected
    assert tmp_path / "rig.toml" in load_team(written(tmp_path, each="camera = 'rig.toml:left'")).files
    assert (
        tmp_path / "sigma.txt"
        in load_team(written(tmp_path, each="measure = 'rgbd'\ndepth_sigma = 'sigma.txt'")).files
    )


@pytest.mark.slow
def test_depth_cameras_fuse_and_send_tiles_beside_cameras_of_colour(tmp_path: Path) -> None:
    """The default cameras among them have one exposure, which depth has none of."""
    (tmp_path / "rig.toml").write_text("size = [64, 48]\nfocal = 50.0\nmodel = 'opencv'\nk1 = -0.1\n")
    table = "[[agents]]\nname = '{}'\nscene = '{}/warehouse.xml'\nsensor = '{}'\n{}\n"
    own = {
        "racks": "camera = 'rig.toml'",
        "shutter": "measure = 'depth'\nrange = [0.1, 50]\ndepth_sigma = 0.02",
        "floor": "measure = 'rgbd'\nchannels = 'luminance'",
    }
    path = tmp_path / "team.toml"
    path.write_text(
        "[measure]\nsize = [32, 24]\nspp = 8\n"
        + "".join(table.format(name, WAREHOUSE, name, text) for name, text in own.items())
    )
    team = load_team(path)
    fused = fuse_team(team, workers=1)
    facts = [bound.provenance for bound in fused.bounds]
    assert [fact["noise"]["unit"] for fact in facts] == ["radiance", "scene unit", "radiance"]
    assert facts[0]["noise"]["white"] == facts[2]["noise"]["noise"]["white"]
    assert facts[1]["noise"]["sigma"] == 0.02
    of_plane = fused.bounds[1]
    assert of_plane.rank == 3  # a shutter is a plane: what moves within it is not seen
    chosen = select_team(dataclasses.replace(team, members=team.members[:2]), Budget(tiles=2), workers=1)
    assert [tile.agent for tile in chosen.selection.chosen] == ["racks", "shutter"]


@pytest.mark.slow
def test_an_agent_whose_noise_couples_pixels_fuses_but_sends_no_tiles(tmp_path: Path) -> None:
    table = "{ model = 'low_rank_plus_diagonal', variance = 'v.npy', modes = 'm.npy' }"
    np.save(tmp_path / "v.npy", np.full((24, 32, 3), 1e-4))
    np.save(tmp_path / "m.npy", np.full((1, 24, 32, 3), 1e-3))
    team = load_team(written(tmp_path, each=f"noise = {table}\n"))
    assert fuse_team(team, workers=1).fusion.bound.rank == 6
    with pytest.raises(SelectionError, match="'racks' is correlated between pixels"):
        select_team(team, Budget(tiles=3), workers=1)


POSE = "[0, 0, 2, 0, 0, 0, 1]"
SCALED = "[[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]"
SHEARED = "[[1, 0.4, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
BAD = [
    ("[mesure]\nspp = 8\n", "", ConfigError, "unknown key 'mesure'; did you mean 'measure'"),
    ("[measure]\nsppp = 8\n", "", ConfigError, r"\[measure\] has an unknown key 'sppp'; did you mean 'spp'"),
    ("", "buget = 3", ConfigError, "agent 'racks' has an unknown key 'buget'; did you mean 'budget'"),
    ("", "xyz = 3", ConfigError, "unknown key 'xyz'; known are name, scene"),
    ("[measure]\nspp = 1.5\n", "", ConfigError, "spp must be a whole number, not 1.5"),
    ("[measure]\nspp = true\n", "", ConfigError, "spp must be a whole number, not True"),
    ("[body]\nname = 3\n", "", ConfigError, r"\[body\]: name must be a text, not 3"),
    ("[measure]\nsize = [8]\n", "", ConfigError, r"size must be width and height in whole pixels, not \[8\]"),
    ("[measure]\nsize = [8, true]\n", "", ConfigError, r"size must be width and .*, not \[8, True\]"),
    ("[measure]\ndrop_invalid = 1\n", "", ConfigError, "drop_invalid must be true or false, not 1"),
    ("[measure]\nmethod = {}\n", "", ConfigError, r"method\]? must be a text, not {}"),
    ("[tiles]\nsize = 8.0\n", "", ConfigError, r"\[tiles\]: size must be a whole number of pixels, or two"),
    ("[tiles]\nrank = true\n", "", ConfigError, r"\[tiles\]: rank must be a whole number, not True"),
    ("[tiles]\nprecision = 16\n", "", ConfigError, "precision must be 'float16' or 'float32', not 16"),
    ("[agents]\n", None, ConfigError, r"\[agents\] must be a list, not {}"),
    ("", "budget = false", ConfigError, "agent 'racks': budget must be a whole number, not False"),
    ("", "noise = true", ConfigError, "noise must be a number or a text or a table, not True"),
    ("", "noise = { model = 'laplace', scale = true }", NoiseError, "scale must be a number, not True"),
    ("", "defines = { width = [1] }", ConfigError, r"agent 'racks': \[defines\]: width must be a text or"),
    ("", "defines = 1", ConfigError, "agent 'racks': defines must be a table, not 1"),
    ("agents = [1]\n", None, ConfigError, "entry 1 of agents must be a table, not 1"),
    ("body = 1\n", "", ConfigError, "body must be a table, not 1"),
    ("", "budget = -1", ConfigError, "agent 'racks': budget must be at least 0, not -1"),
    ("[measure]\nseed = -1\n", "", ConfigError, r"\[measure\]: seed must be at least 0, not -1"),
    ("", "noise = -0.1", NoiseError, "agent 'racks'.*positive"),
    ("", "noise = [1]", ConfigError, r"noise must be a number or a text or a table, not \[1\]"),
    ("", "noise = 'none.toml'", NoiseError, "agent 'racks': cannot read .*none.toml"),
    ("", "noise = { model = 'gausian', sigma = 1 }", NoiseError, "agent 'racks': .*gaussian"),
    ("", "camera = 'none.yaml'", CameraError, "agent 'racks': camera: .*none.yaml"),
    ("", "camera = 3", ConfigError, "agent 'racks': camera must be a text, not 3"),
    ("", "measure = 'dept'", OptionError, "agent 'racks': .*measure.*'dept'; did you mean 'depth'"),
    ("", "channels = 'grey'", OptionError, "agent 'racks': .*channels.*'grey'; .*luminance"),
    ("", "depth_sigma = 0.1", OptionError, "agent 'racks': .*depth_sigma.* is of a depth camera"),
    ("", "measure = 'rgbd'\ndepth_sigma = -0.1", NoiseError, "agent 'racks': .*sigma of depth .*positive"),
    ("", "measure = 'rgbd'\ndepth_sigma = 'x'", OptionError, "agent 'racks': depth_sigma 'x' is neither"),
    ("", "measure = 'rgbd'\nrange = [5, 1]", OptionError, "agent 'racks': .*range.* 5:1 is empty"),
    ("", "measure = 'rgbd'\nrange = 5", ConfigError, "agent 'racks': range must be the lowest and the"),
    ("", "measure = 'depth'\nnoise = 0.1", OptionError, "agent 'racks': noise is of colour"),
    ("", "depth_edges = 1", ConfigError, "agent 'racks': depth_edges must be true or false, not 1"),
    ("", "pose = [1, 2, 3]", PoseError, "agent 'racks': pose: .*seven numbers"),
    ("", 'pose = ["a"]', PoseError, "agent 'racks': pose: "),
    (
        "",
        "body_from_agent = [[2,0,0,0],[0,2,0,0],[0,0,2,0],[0,0,0,1]]",
        PoseError,
        "body_from_agent: .*scale",
    ),
    (
        "",
        "body_from_agent = [[1,0.4,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]",
        PoseError,
        "body_from_agent: .*shear",
    ),
    ("[body]\npose = [0, 0, 0, 0, 0, 0, 0]\n", "", PoseError, r"\[body\]: pose: "),
    ("", None, ConfigError, "lists no agents"),
    ("agents = []\n", None, ConfigError, "lists no agents"),
    ("[[agents]]\nname = 'x'\n", None, ConfigError, "agent 'x' has no scene"),
    (
        "[[agents]]\nname = 'x'\nscene = 'x.xml'\n",
        None,
        ConfigError,
        "agent 'x': no scene file at .*x.xml",
    ),
    ("[[agents]]\nscene = 'x.xml'\n", None, ConfigError, "agent 1 has no name"),
    ("not toml", "", ConfigError, "is no TOML"),
]


class TestBadInput:
    @pytest.mark.parametrize(("text", "each", "error", "match"), BAD)
    def test_it_is_named_by_the_library_and_the_command(
        self, text: str, each: str | None, error: Any, match: str, tmp_path: Path, capsys: Any
    ) -> None:
        path = written(tmp_path, text, agents=() if each is None else ("racks", "floor"), each=each or "")
        with pytest.raises(error, match=match):
            load_team(path)
        for command in ("fuse", "select"):
            assert re.search(match, refused(capsys, command, str(path)))

    def test_duplicate_names_missing_files_and_folders(self, tmp_path: Path, capsys: Any) -> None:
        path = written(tmp_path, agents=("racks", "racks"))
        assert "'racks' occurs twice" in refused(capsys, "fuse", str(path))
        assert "No such file" in refused(capsys, "fuse", str(tmp_path / "none.toml"))
        assert "cannot read" in refused(capsys, "select", str(tmp_path))
        path.write_bytes(b"\xff\xfe\x00")
        assert "utf-8" in refused(capsys, "fuse", str(path))

    def test_budgets_and_outputs_are_checked_before_rendering(
        self, tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        path = str(written(tmp_path))
        monkeypatch.setattr(team_measure, "_each", None)
        assert "budget tiles is negative: -1" in refused(capsys, "select", path, "--budget", "-1")
        assert "tiles_per_agent is negative" in refused(capsys, "select", path, "--per-agent", "-2")
        assert "bytes is negative" in refused(capsys, "select", path, "--bytes", "-3")
        assert "objective" in refused(capsys, "select", path, "--objective", "det")
        assert "name a folder" in refused(capsys, "select", path, "--plot", path)
        nowhere = str(tmp_path / "no" / "where")
        assert "cannot make this folder" in refused(capsys, "select", path, "--plot", nowhere)
        assert "overwrite an input" in refused(capsys, "fuse", path, "--json", path)

    @pytest.mark.slow
    def test_transforms_that_put_the_body_in_two_places(self, tmp_path: Path, capsys: Any) -> None:
        path = written(tmp_path, each=f"body_from_agent = {POSE}\n")
        match = r"agent 'racks' put the body .* scene units .* from where those of 'floor'"
        with pytest.raises(FrameError, match=match):
            fuse_team(load_team(path), workers=1)
        with pytest.raises(FrameError, match=match):
            select_team(load_team(path), Budget(tiles=2), workers=1)
        assert re.search(match, refused(capsys, "fuse", str(path), "--workers", "1"))

    def test_a_budget_for_nobody_and_a_tile_of_no_size(self, tmp_path: Path, capsys: Any) -> None:
        team = load_team(written(tmp_path, agents=("racks",)))
        with pytest.raises(SelectionError, match="'raks', which is no agent; did you mean 'racks'"):
            select_team(team, Budget(tiles_per_agent={"raks": 2}), workers=1)
        path = written(tmp_path, "[tiles]\nsize = 0\n", agents=("racks",))
        assert "tile's size" in refused(capsys, "select", str(path), "--budget", "3")
        path = written(tmp_path, "[tiles]\nform = 'fulll'\n", agents=("racks",))
        message = refused(capsys, "select", str(path), "--budget", "3")
        assert "[tiles]: form must be 'full', 'factor' or 'sketch', not 'fulll'" in message

    def test_every_error_is_the_library_s(self) -> None:
        assert issubclass(ConfigError, MitsubaCRBError)
        assert issubclass(WorkerError, MitsubaCRBError)
