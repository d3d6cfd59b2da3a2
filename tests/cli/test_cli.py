from __future__ import annotations

import inspect
import json
import os
import subprocess
import sys
import warnings
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import OpenEXR
import pytest
import synthetic_view
from typer.main import get_command

from mitsuba_crb import pose_bound, se3
from mitsuba_crb.cli import app as cli
from mitsuba_crb.cli.arguments import parse_defines, parse_pose, parse_size
from mitsuba_crb.cli.outcome import complain
from mitsuba_crb.errors import OptionError, PoseError, PrecisionWarning, SceneError
from mitsuba_crb.estimate import trials
from mitsuba_crb.export.documents import bound_document
from mitsuba_crb.measure import check as validation
from mitsuba_crb.measure import options as measuring
from mitsuba_crb.measure import report
from mitsuba_crb.measure.tile_jacobian import TileJacobian
from mitsuba_crb.render.backend import use_mitsuba

WALL = str(Path(__file__).parents[2] / "scenes" / "textured_wall" / "textured_wall.xml")


@pytest.fixture
def rendered(monkeypatch):
    """`pose_bound` replaced by a synthetic view; records what it was given."""
    calls = SimpleNamespace(view=synthetic_view.jacobian(), options=None, defines=None, rendered=False)

    def pose_bound(source, noise, *, on_progress, on_round, on_tile=None, **options):
        calls.defines = source.defines
        calls.rendered, calls.options, calls.noise = True, options, noise
        warnings.warn("one thing to know", PrecisionWarning, stacklevel=2)
        view = calls.view
        for count, half in enumerate(np.array_split(np.arange(len(view.pixels)), 2), 1):
            tile = TileJacobian(view.batch_values[:, half], view.pixels[half], view.mean[half])
            if on_tile is not None:
                on_tile(tile, count * len(half), len(view.pixels))
            on_progress(count * len(half), len(view.pixels))
        return synthetic_view.bound(view)

    monkeypatch.setattr(report, "pose_bound", pose_bound)
    return calls


def refused(capsys, *arguments: str) -> str:
    """The one line on standard error of a command that must exit with code 2 and print nothing else."""
    assert cli.run(list(arguments)) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("mitsuba-crb: ")
    assert err.count("\n") == 1
    assert len(err) > len("mitsuba-crb: \n")
    return err


def test_table_says_what_a_person_asks(rendered, capsys):
    assert cli.run(["bound", "room.xml"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    for word in (
        "room.xml",
        "position x",
        "position y",
        "position z",
        "pitch",
        "yaw",
        "roll",
        "scene unit",
        "deg",
        "±",
        "rank",
        "6 of 6",
        "length scale",
        "2.5 scene units",
        "σ = 0.01",
        "0.01 of white 1 (99th percentile)",
        "plain JᵀWJ would have claimed",
        "finite_difference, 64 paths per pixel in 4 batches, seed 0",
        "note: one thing to know",
    ):
        assert word in out
    assert "PrecisionWarning" not in out
    assert "∞" not in out


def test_the_camera_is_exposed_as_asked(rendered, capsys):
    for arguments, asked in (
        (("--exposure", "0.5"), (0.5, True)),
        (("--exposure", "auto", "--no-clip"), ("auto", False)),
    ):
        assert cli.run(["bound", "room.xml", *arguments]) == 0
        assert (rendered.options["exposure"], rendered.options["clip"]) == asked
    capsys.readouterr()
    err = refused(capsys, "bound", "room.xml", "--exposure", "bright")
    assert "neither a radiance, such as 0.8, nor auto" in err


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("bound", "--exposure -1"),
        ("bound", "--exposure 1 --sigma 1"),
        ("bound", "--no-clip --sigma 1"),
        ("validate", "--exposure 1 --sigma 1"),
    ],
)
def test_an_exposure_that_cannot_be_is_refused(capsys, command, words):
    assert "exposure" in refused(capsys, command, WALL, "--size", "16x12", "--spp", "4", *words.split())


def test_table_and_json_say_what_is_saturated(capsys, tmp_path):
    file = tmp_path / "bound.json"
    arguments = ["--size", "16x12", "--spp", "16", "--json", str(file)]
    assert cli.run(["bound", WALL, *arguments]) == 0
    noise = json.loads(file.read_text())["noise"]
    share = f"{100 * noise['saturated']:.2g} % of the values are saturated, which tells nothing"
    words = f"σ = {noise['sigma']:.4g}: 0.01 of white {noise['white']:.3g} (99th percentile); {share}"
    assert words in " ".join(capsys.readouterr().out.split())


def test_a_command_that_fails_says_what_it_warned_of(rendered, capsys, monkeypatch):
    def fail(*_, **__):
        for _ in range(2):
            warnings.warn("one thing to know", PrecisionWarning, stacklevel=2)
        raise SceneError("the scene is at fault")

    monkeypatch.setattr(report, "pose_bound", fail)
    assert cli.run(["bound", "room.xml"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines() == ["mitsuba-crb: note: one thing to know", "mitsuba-crb: the scene is at fault"]


def test_table_says_what_is_unseen(rendered, capsys):
    rendered.view = synthetic_view.jacobian(unseen=(1, 5), noise=0.05)
    assert cli.run(["bound", "room.xml"]) == 0
    out = capsys.readouterr().out
    assert "4 of 6" in out
    assert "∞ (unseen)" in out
    for direction in synthetic_view.bound(rendered.view).unobserved:
        assert direction.description in out


@pytest.mark.filterwarnings("ignore:not resolved:mitsuba_crb.errors.PrecisionWarning")
@pytest.mark.filterwarnings("ignore:the bound on:mitsuba_crb.errors.PrecisionWarning")
def test_table_says_what_is_not_resolved_above_the_numbers(rendered, capsys):
    rendered.view = synthetic_view.jacobian(unseen=(1, 5), noise=3.0)
    bound = synthetic_view.bound(rendered.view)
    verdicts = [*bound.position_verdict, *bound.rotation_verdict]
    limits = [*bound.position_std_lower_limit, *bound.rotation_std_deg_lower_limit]
    assert cli.run(["bound", "room.xml"]) == 0
    out = capsys.readouterr().out
    assert f"not resolved: {bound.not_resolved}" in out
    assert out.index("not resolved: ") < out.index("1σ bound")
    assert f"> {limits[verdicts.index('not resolved')]:.3g} " in out
    assert f"note: not resolved: {bound.not_resolved}" not in out


@pytest.mark.slow
@pytest.mark.parametrize("frame", ["camera", "world"])
def test_all_outputs_are_written_and_agree(rendered, capsys, tmp_path, frame):
    files = {name: tmp_path / f"out.{name}" for name in ("json", "exr", "plot")}
    options = [text for name, path in files.items() for text in (f"--{name}", str(path))]
    assert cli.run(["bound", "room.xml", "--frame", frame, *options]) == 0
    document = json.loads(files["json"].read_text(encoding="utf-8"))
    assert document["frame"] == frame
    assert document["scene"] == "room.xml"
    assert document["warnings"] == ["one thing to know"]
    assert {"prepare", "total"} <= set(document["seconds"])
    expected = synthetic_view.bound(rendered.view)
    np.testing.assert_allclose(document["position_std"], expected.position_std, rtol=1e-9)
    np.testing.assert_allclose(document["rotation_std_deg"], expected.rotation_std_deg, rtol=1e-9)
    with OpenEXR.File(str(files["exr"])) as file:
        assert file.header()["frame"] == frame
    assert files["plot"].read_bytes().startswith(b"\x89PNG")
    assert sorted(os.listdir(tmp_path)) == ["out.exr", "out.json", "out.plot"]


def test_options_reach_the_library(rendered, capsys, tmp_path):
    matrix = tmp_path / "pose.txt"
    np.savetxt(matrix, synthetic_view.POSE)
    prior = tmp_path / "imu.toml"
    prior.write_text('frame = "world"\nrotation_std_deg = [1.0, inf, 2.0]\n')
    arguments = (
        "--sensor left --method forward --spp 8 --seed 5 --batches 8 --size 20x10 -D a=1 -D b=x=y --sigma 0.1"
    )
    code = cli.run(
        [
            "bound",
            "room.xml",
            *arguments.split(),
            "--pose",
            str(matrix),
            "--pixels",
            "random:0.5",
            "--drop-invalid",
            "--marginalize",
            "gain",
            "--marginalize",
            "fov",
            "--prior",
            str(prior),
        ]
    )
    assert code == 0
    options = rendered.options
    np.testing.assert_allclose(options.pop("pose"), synthetic_view.POSE, atol=1e-12)
    known = np.diagonal(options.pop("prior").matrix)
    np.testing.assert_allclose(known, np.radians([1, 1, 1, 1, 1, 2]) ** -2.0 * [0, 0, 0, 1, 0, 1])
    assert options == {
        "sensor": "left",
        "method": "forward",
        "spp": 8,
        "precision": None,
        "max_spp": None,
        "seed": 5,
        "batches": 8,
        "size": (20, 10),
        "pixels": "random:0.5",
        "drop_invalid": True,
        "integrator": None,
        "exposure": None,
        "camera": None,
        "clip": True,
        "channels": None,
        "measure": "colour",
        "depth_sigma": None,
        "depth_range": None,
        "depth_edges": False,
        "nuisances": ["gain", "fov"],
    }
    assert rendered.defines == {"a": "1", "b": "x=y"}
    assert rendered.noise.sigma == 0.1


VIEW = {
    "sensor": "left",
    "spp": 8,
    "seed": 5,
    "batches": 8,
    "size": (20, 10),
    "pixels": "random:0.5",
    "drop_invalid": True,
    "integrator": "volpath",
}
"""What every command that measures a view can be told of it."""


@pytest.mark.parametrize(
    ("command", "module", "function", "more"),
    [
        ("check", validation, "check_jacobian", {"methods": ("flow",)}),
        ("validate", trials, "validate", {"method": "flow", "defines": {}}),
    ],
)
def test_what_is_said_of_the_view_reaches_the_library(monkeypatch, capsys, command, module, function, more):
    given = {}

    def refuse(_, **options):
        given.update(options)
        raise OptionError("as far as this goes")

    monkeypatch.setattr(module, function, refuse)
    said = "--sensor left --method flow --spp 8 --seed 5 --batches 8 --size 20x10 --pixels random:0.5"
    said += " --integrator volpath"
    refused(capsys, command, "room.xml", *said.split(), "--drop-invalid", "--pose", "1 2 3 0 0 0 1")
    np.testing.assert_array_equal(given["pose"][:3, 3], [1, 2, 3])
    assert given.items() >= (VIEW | more).items()


@pytest.mark.parametrize("command", ["bound", "check", "validate", "fuse", "select"])
def test_another_variant_than_the_one_that_runs_is_refused(capsys, command):
    use_mitsuba()
    assert "runs in variant llvm_ad_rgb, and cuda_ad_rgb is needed" in refused(
        capsys, command, "room.xml", "--variant", "cuda_ad_rgb"
    )


def test_what_is_no_bound_is_said_above_the_table(capsys, tmp_path):
    scene = str(Path(WALL).parents[1] / "checkerboard_wall" / "checkerboard_wall.xml")
    file = tmp_path / "bound.json"
    options = ("--size", "16x12", "--spp", "8", "--sigma", "0.1", "--json", str(file))
    assert cli.run(["bound", scene, *options, "--method", "forward"]) == 0
    out = capsys.readouterr().out
    assert (
        0 < out.index("no bound: method 'forward' cannot see a checkerboard texture") < out.index("1σ bound")
    )
    assert out.count("cannot see a checkerboard texture") == 1
    assert "checkerboard" in json.loads(file.read_text())["no_bound"][0]
    assert cli.run(["bound", scene, *options, "--method", "flow"]) == 0
    assert "no bound" not in capsys.readouterr().out


def test_what_cannot_be_a_prior_is_refused(capsys, tmp_path):
    assert "cannot read" in refused(capsys, "bound", "room.xml", "--prior", str(tmp_path / "none.toml"))
    (tmp_path / "imu.toml").write_text('frame = "body"\nposition_std = 1\n')
    message = refused(capsys, "bound", "room.xml", "--prior", str(tmp_path / "imu.toml"))
    assert "'camera' or 'world', not 'body'" in message


def test_a_nuisance_that_does_not_exist_is_refused_with_near_ones(capsys):
    message = refused(capsys, "bound", WALL, "--size", "16x12", "--marginalize", "principal_pint")
    assert "near ones: principal_point" in message


def test_a_nuisance_per_tile_is_refused_with_random_pixels(capsys):
    message = refused(
        capsys, "bound", WALL, "--size", "16x12", "--marginalize", "black:8", "--pixels", "random:0.1"
    )
    assert "black:8 with random:f pixels" in message


def test_what_a_camera_measures_reaches_the_check(monkeypatch, capsys):
    given = {}

    def refuse(_, **options):
        given.update(options)
        raise OptionError("as far as this goes")

    monkeypatch.setattr(validation, "check_jacobian", refuse)
    refused(capsys, "check", "room.xml", "--measure", "depth", "--range", "0.4:5", "--depth-edges")
    assert given.items() >= {"measure": "depth", "depth_range": (0.4, 5.0), "depth_edges": True}.items()
    refused(capsys, "check", "room.xml", "--channels", "red")
    assert given["channels"] == "red"


def test_the_keywords_are_the_options():
    keywords = measuring.MeasurementKeywords.__annotations__
    written = {name: kind.__forward_arg__ for name, kind in keywords.items()}
    assert written == measuring.MeasurementOptions.__annotations__


@pytest.mark.parametrize(
    ("command", "other"),
    [(cli.bound, {}), (cli.check, measuring.CHECKING), (cli.validate, {})],
)
def test_defaults_are_the_librarys(command, other):
    ours = {name: option.default for name, option in inspect.signature(command).parameters.items()}
    defaults = vars(measuring.MeasurementOptions()) | other
    shared = (ours.keys() & defaults.keys()) - {"scene", "sensor", "method"}
    assert {"spp", "seed", "batches", "size", "pose"} <= shared
    for name in shared:
        assert ours[name] == defaults[name]
    assert int(ours["sensor"]) == defaults["sensor"]


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["--size", "256"], "256x192"),
        (["--size", "0x10"], "at least 1"),
        (["--size", "-3x10"], "WxH"),
        (["-D", "spp"], "name=value"),
        (["-D", "=3"], "name=value"),
        (["--pose", "nowhere.txt"], "nowhere.txt"),
        (["--pose", "1 2 3"], "seven numbers"),
        (["--pose", "0 0 0 0 0 0 2"], "length"),
        (["--pose", "0 0 nan 0 0 0 1"], "NaN"),
        (["--sigma", "0"], "positive"),
        (["--sigma", "1", "--noise", "camera.toml"], "give one of them"),
        (["--noise", "nowhere.toml"], "cannot read nowhere.toml"),
        (["--sigma", "-1"], "positive"),
        (["--sigma", "nan"], "positive"),
        (["--sigma", "inf"], "positive"),
        (["--sigma", "much"], "--sigma"),
        (["--spp", "many"], "--spp"),
        (["--frame", "film"], "--frame"),
        (["--json", "/nowhere/a.json"], "does not exist"),
        (["--exr", "/nowhere/a.exr"], "does not exist"),
        (["--plot", "/nowhere/a.png"], "does not exist"),
        (["--json", "."], "folder"),
        (["--json", "/dev/null"], "regular file"),
        (["--json", "same", "--exr", "same"], "both name same"),
        (["--nonsense"], "--nonsense"),
        (["another.xml"], "another.xml"),
    ],
)
def test_bad_option_is_one_line_before_anything_is_rendered(
    rendered, capsys, monkeypatch, tmp_path, arguments, word
):
    monkeypatch.chdir(tmp_path)
    assert word in refused(capsys, "bound", "room.xml", *arguments)
    assert not rendered.rendered
    assert rendered.defines is None
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("arguments", [["bound"], ["check"], ["bundle", "room.xml"], ["--nonsense"]])
def test_bad_command_is_one_line(capsys, arguments):
    refused(capsys, *arguments)


def test_outputs_never_overwrite_inputs(rendered, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    names = ("room.xml", "pose.txt", "mask.png")
    for name in names:
        Path(name).write_text(" ".join(map(str, np.eye(4).ravel())))
    for name in names:
        line = refused(
            capsys, "bound", "room.xml", "--pose", "pose.txt", "--pixels", "mask.png", "--json", name
        )
        assert "overwrite" in line
        line = refused(
            capsys, "validate", "room.xml", "--pose", "pose.txt", "--pixels", "mask.png", "--plot", name
        )
        assert "overwrite" in line
        assert Path(name).read_text().startswith("1.0 0.0")


def test_library_error_is_one_line_and_a_traceback_only_with_debug(capsys, monkeypatch):
    def pose_bound(*_, **options):
        raise SceneError("line 3 of room.xml\nis wrong")

    monkeypatch.setattr(report, "pose_bound", pose_bound)
    assert refused(capsys, "bound", "room.xml") == "mitsuba-crb: line 3 of room.xml is wrong\n"
    assert cli.run(["bound", "room.xml", "--debug"]) == 2
    assert "Traceback" in capsys.readouterr().err


def test_unforeseen_error_shows_its_traceback_and_is_no_verdict(capsys, monkeypatch):
    monkeypatch.setattr(report, "pose_bound", lambda *_, **options: 1 / 0)
    assert cli.run(["bound", "room.xml"]) == cli.INTERNAL_ERROR
    assert "ZeroDivisionError" in capsys.readouterr().err


@pytest.mark.parametrize("moment", ["rendering", "writing"])
def test_interrupt_is_one_line_and_leaves_files_alone(rendered, capsys, monkeypatch, tmp_path, moment):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    if moment == "rendering":
        monkeypatch.setattr(report, "pose_bound", interrupt)
    else:
        monkeypatch.setattr(os, "replace", interrupt)
    path = tmp_path / "out.json"
    path.write_text("old")
    assert cli.run(["bound", "room.xml", "--json", str(path)]) == 130
    err = capsys.readouterr().err
    assert err.startswith("mitsuba-crb: interrupted")
    assert err.count("\n") == 1
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["out.json"]


def test_answer_is_printed_even_if_a_file_cannot_be_written(rendered, capsys, monkeypatch, tmp_path):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    assert cli.run(["bound", "room.xml", "--json", str(tmp_path / "out.json")]) == 2
    out, err = capsys.readouterr()
    assert "position x" in out
    assert "No space left" in err
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    ("ratio", "spread", "code", "words"),
    [
        (1.0, 0.01, 0, ("forward and finite_difference agree", "equal")),
        (0.2, 0.01, 1, ("forward disagrees with finite_difference", "differs")),
        (1.0, 0.2, 3, ("inconclusive: about 40000 paths", "undecided")),
    ],
)
def test_check_prints_columns_and_returns_the_verdict(monkeypatch, capsys, ratio, spread, code, words):
    one = np.ones(6)
    row = validation.MethodCheck(
        "forward",
        ratio * one,
        spread * one,
        abs(1 - ratio) * one,
        spread * one,
        3 * spread * one,
        np.full(6, ratio != 1),
        156.25,
    )
    result = validation.JacobianCheck((row,), 3 * spread, 0 * one, 0.15, 40000, 256)

    def check_jacobian(loaded, **options):
        for _ in range(2):
            warnings.warn("one thing to know", PrecisionWarning, stacklevel=2)
        return result

    monkeypatch.setattr(validation, "check_jacobian", check_jacobian)
    assert cli.run(["check", "room.xml"]) == code
    out = capsys.readouterr().out
    assert all(word in out for word in words)
    assert f"{3 * spread:.1%}" in out
    assert "note: one thing to know" in out
    assert out.count("one thing to know") == 1
    for name in ("forward", *se3.TWIST_ORDER):
        assert name in out


def test_check_with_nothing_to_compare_says_so(monkeypatch, capsys):
    unknown = np.full(6, np.nan)
    row = validation.MethodCheck("forward", *[unknown] * 5, np.zeros(6, bool), 1.0)
    result = validation.JacobianCheck((row,), np.inf, np.zeros(6), 0.15, None, 64)
    monkeypatch.setattr(validation, "check_jacobian", lambda loaded, **options: result)
    assert cli.run(["check", "room.xml"]) == 3
    out = capsys.readouterr().out
    assert "no column to compare" in out
    assert "nan" not in out
    assert "inf" not in out


def test_real_scene_from_file_to_files(capsys, tmp_path):
    """Without any replacement: the same numbers as the library's, and pictures of the whole image."""
    files = {name: tmp_path / f"out.{name}" for name in ("json", "exr", "plot")}
    options = [text for name, path in files.items() for text in (f"--{name}", str(path))]
    assert cli.run(["bound", WALL, "--size", "20x16", "--spp", "16", "--seed", "3", *options]) == 0
    out, err = capsys.readouterr()
    document = json.loads(files["json"].read_text(encoding="utf-8"))
    with pytest.warns(PrecisionWarning) as caught:  # 16 paths are few
        expected = pose_bound(WALL, size=(20, 16), spp=16, seed=3)
    assert document["warnings"] == [str(warning.message) for warning in caught]
    assert all(f"note: {text}" in out for text in document["warnings"])
    assert err == ""
    assert document["position_std"] == bound_document(expected)["position_std"]
    np.testing.assert_array_equal(document["information"], expected.information.matrix)
    assert document["size"] == [20, 16]
    with OpenEXR.File(str(files["exr"]), separate_channels=True) as file:
        planes = [channel.pixels for channel in file.channels().values()]
    assert all(plane.shape == (16, 20) and np.isfinite(plane).all() for plane in planes)
    assert min(plane.std() for plane in planes) > 0


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["-D", "nonsense=1"], "nonsense"),
        (["--sensor", "7"], "sensor"),
        (["--sensor", "left"], "sensor"),
        (["--method", "guess"], "guess"),
        (["--spp", "10"], "nearest is"),
        (["--batches", "2"], "at least 4"),
        (["--seed", "-1"], "seed"),
        (["--pixels", "random:0"], "(0, 1]"),
        (["--pixels", "gradient:1.5"], "(0, 1]"),
        (["--pixels", "nowhere.png"], "nowhere.png"),
    ],
)
def test_bad_value_that_the_library_finds_is_one_line_too(capsys, arguments, word):
    assert word in refused(capsys, "bound", WALL, "--size", "8x8", *arguments)


def test_missing_scene_is_one_line(capsys):
    assert "nowhere.xml" in refused(capsys, "bound", "nowhere.xml")
    assert "nowhere.xml" in refused(capsys, "check", "nowhere.xml")


def test_version_and_help_need_nothing_heavy():
    code = """import sys
from mitsuba_crb.cli import app as cli
assert cli.run(["--version"]) == 0 and cli.run(["--help"]) == 0 and cli.run(["bound", "--help"]) == 0
heavy = {"mitsuba", "drjit", "numpy", "scipy", "matplotlib", "OpenEXR"} & set(sys.modules)
sys.exit(", ".join(heavy) or 0)"""
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("mitsuba-crb 0.")


COMMANDS = list(get_command(cli.app).commands)


@pytest.mark.parametrize("name", [None, *COMMANDS])
def test_help_says_every_word_brackets_included(name, capsys):
    """Compared without blanks, since lines are broken wherever they are full."""
    assert cli.run([name, "--help"] if name else ["--help"]) == 0
    said = "".join(capsys.readouterr().out.split())
    group = get_command(cli.app)
    command = group.commands[name] if name else group
    texts = [command.help, *(parameter.help for parameter in command.params)]
    texts += [other.help.partition("\n")[0] for other in group.commands.values()] if name is None else []
    for text in texts:
        assert "".join(text.split()) in said
    assert name != "bound" or "[noise]" in said


BRACKETS = "[bold]:cat:$\\x$"
"""What Rich and Matplotlib would take for markup."""


@pytest.mark.parametrize("missing", ["scene", "pose", "noise", "json"])
def test_a_message_keeps_the_brackets_of_a_name(missing, capsys):
    name = f"/nowhere/{BRACKETS}"
    arguments = [name] if missing == "scene" else [WALL, f"--{missing}", name]
    assert name in refused(capsys, "bound", *arguments)


def test_a_message_is_one_line_of_what_a_terminal_can_show(capsys):
    complain("a\nb\tc \x1b[2J\x00")
    assert capsys.readouterr().err == "mitsuba-crb: a b c \ufffd[2J\ufffd\n"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")  # few samples
def test_tables_and_pictures_keep_the_brackets_of_names(capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.chdir(tmp_path)
    text = Path(WALL).read_text(encoding="utf-8").replace("paint.exr", str(Path(WALL).parent / "paint.exr"))
    scene_file = Path(f"{BRACKETS}.xml")
    scene_file.write_text(text, encoding="utf-8")
    prior = Path(f"{BRACKETS}.toml")
    prior.write_text('frame = "camera"\nposition_std = 1\n')
    team = Path(f"{BRACKETS} team.toml")
    agents = "".join(
        f"[[agents]]\nname = '{BRACKETS} {k}'\nscene = '{scene_file}'\nnoise = 0.01\n" for k in (1, 2)
    )
    team.write_text(f"[body]\nname = '{BRACKETS} body'\n[measure]\nsize = [16, 12]\nspp = 8\n{agents}")
    small = ["--size", "16x12", "--spp", "8"]

    def said(*arguments):
        assert cli.run([*arguments]) in (0, 1, 3)
        return capsys.readouterr().out

    bound = said("bound", str(scene_file), *small, "--prior", str(prior), "--plot", "bound.png")
    assert str(scene_file) in bound
    assert str(prior) in bound
    fused = said("fuse", str(team), "--workers", "1")
    chosen = said("select", str(team), "--workers", "1", "--budget", "1", "--plot", "tiles")
    for table in (fused, chosen):
        assert str(team) in table
        assert f"{BRACKETS} 1" in table
    assert "body" in fused
    options = ["--trials", "8", "--workers", "1", "--perturb-deg", "0.1", "--plot", "trials.png"]
    assert str(scene_file) in said("validate", str(scene_file), *small, *options)


def test_sizes_and_defines():
    assert parse_size("256x192") == (256, 192)
    assert parse_size(" 256 X 192 ") == (256, 192)
    assert parse_size(None) is None
    assert parse_defines(["a=1", "a=2", "b="]) == {"a": "2", "b": ""}
    with pytest.raises(OptionError):
        parse_size("12")


def test_pose_from_numbers_and_files(tmp_path):
    pose = synthetic_view.POSE
    quaternion = "0 0 0.7071067811865476 0.7071067811865476"
    turned = np.array([[0, -1, 0, -1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1.0]])
    np.testing.assert_allclose(parse_pose(f"-1 2 3 {quaternion}"), turned, atol=1e-12)
    np.testing.assert_allclose(parse_pose(f"-1, 2, 3, {quaternion.replace(' ', ', ')}"), turned, atol=1e-12)
    np.save(tmp_path / "pose.npy", pose)
    np.savetxt(tmp_path / "pose.txt", pose)
    (tmp_path / "list.json").write_text(json.dumps(pose.tolist()))
    (tmp_path / "bound.json").write_text(json.dumps({"pose": pose.tolist()}))
    (tmp_path / "seven.txt").write_text(f"-1 2 3\n{quaternion}\n")
    for name in ("pose.npy", "pose.txt", "list.json", "bound.json"):
        np.testing.assert_allclose(parse_pose(str(tmp_path / name)), pose, atol=1e-12)
    np.testing.assert_allclose(parse_pose(str(tmp_path / "seven.txt")), turned, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.txt", b"1 0 0 0 0 1 0 0"),
        ("a.txt", b"one two"),
        ("a.txt", b""),
        ("a.txt", b"\xff\xfe\x00"),
        ("a.txt", b"-1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"),
        ("a.txt", b"2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1"),
        ("a.npy", b"not numpy"),
        ("a.npy", b""),
        ("a.json", b"{"),
        ("a.json", b"{}"),
        ("a.json", b'"text"'),
        ("a.json", b"[[1, 2], [3]]"),
    ],
)
def test_bad_pose_file_is_named(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(PoseError, match=name):
        parse_pose(str(tmp_path / name))


def test_pose_that_is_a_folder_or_absurdly_long_is_refused(tmp_path):
    with pytest.raises(PoseError):
        parse_pose(str(tmp_path))
    with pytest.raises(PoseError):
        parse_pose("x" * 5000)


class TestDisplacements:
    def test_hcr_is_printed_and_written_beside_the_local_bound(self, scenes, tmp_path, capsys):
        rows = tmp_path / "twists.txt"
        rows.write_text("# ρ, then φ\n0 0.5 0 0 0 0\n0.1 0 0 0 0 0\n")
        target = tmp_path / "bound.json"
        wall = str(scenes / "textured_wall" / "textured_wall.xml")
        arguments = ["--size", "24x18", "--spp", "16", "--displacements", str(rows), "--json", str(target)]
        assert cli.run(["bound", wall, "--hcr", *arguments]) == 0
        printed = capsys.readouterr().out.partition("Unbiased at 2 displaced poses")[2]
        assert "pitch, about camera x" in printed
        assert "none of them" in printed
        document = json.loads(target.read_text())
        assert document["hcr"]["repeats"] == [False, False]
        assert all(
            a >= b for a, b in zip(document["hcr"]["position_std"], document["position_std"], strict=True)
        )

    @pytest.mark.parametrize(
        ("arguments", "words"),
        [
            (["--hcr", "--displacements", "missing.txt"], "missing.txt"),
            (["--displacements", "{rows}"], "belongs to --hcr"),
            (["--hcr", "--displacements", "{rows}"], "expected rows of six"),
            (["--hcr", "--marginalize", "gain"], "neither priors nor nuisances"),
        ],
    )
    def test_bad_displacements_are_one_line_with_exit_code_2(
        self, scenes, tmp_path, capsys, arguments, words
    ):
        rows = tmp_path / "twists.txt"
        rows.write_text("1 2 3\n")
        wall = str(scenes / "textured_wall" / "textured_wall.xml")
        arguments = [text.format(rows=rows) for text in arguments]
        assert cli.run(["bound", wall, *arguments]) == 2
        assert words in capsys.readouterr().err


def test_a_noise_file_reaches_the_library_and_the_pictures(rendered, capsys, tmp_path):
    file = tmp_path / "camera.toml"
    file.write_text('[noise]\nmodel = "poisson_gaussian"\ngain = 0.01\nread_noise = 0.02\n')
    assert cli.run(["bound", "room.xml", "--noise", str(file), "--exr", str(tmp_path / "out.exr")]) == 0
    assert rendered.noise.gain == 0.01
    assert (tmp_path / "out.exr").exists()


def test_pictures_of_pixels_need_noise_that_does_not_couple_them(rendered, capsys, tmp_path):
    file = tmp_path / "correlated.toml"
    file.write_text('[noise]\nmodel = "stationary"\nautocovariance = [[0.1, 1.0, 0.1]]\n')
    assert cli.run(["bound", "room.xml", "--noise", str(file)]) == 0
    capsys.readouterr()
    assert "couples pixels" in refused(
        capsys, "bound", "room.xml", "--noise", str(file), "--plot", str(tmp_path / "out.png")
    )


def test_validate_prints_and_writes_what_it_found(tmp_path, scenes, capsys):
    wall = str(scenes / "textured_wall" / "textured_wall.xml")
    options = ["--size", "16x12", "--spp", "16", "--trials", "8", "--workers", "1", "--perturb-deg", "0.1"]
    files = {name: tmp_path / f"trials.{name}" for name in ("json", "png")}
    outputs = ["--json", str(files["json"]), "--plot", str(files["png"])]
    code = cli.run(["validate", wall, *options, *outputs])
    table = capsys.readouterr().out
    assert "variance ratio 6" in table
    assert "coverage at 95%" in table
    assert "all 192" in table
    document = json.loads(files["json"].read_text())
    assert document["schema"] == "mitsuba-crb/validate/2"
    assert document["trials"] == 8
    assert code == {"consistent": 0, "inconsistent": 1, "inconclusive": 3}[document["verdict"]]
    assert files["png"].read_bytes().startswith(b"\x89PNG")
    # Other settings are refused, and the file is left as it was.
    before = files["json"].read_bytes()
    assert cli.run(["validate", wall, *options, *outputs, "--seed", "1"]) == 2
    assert "name another file" in capsys.readouterr().err
    assert cli.run(["bound", wall, "--size", "16x12", "--json", str(files["json"])]) == 2
    assert "trials that would be lost" in capsys.readouterr().err
    assert files["json"].read_bytes() == before
    # Fewer are judged, and none is lost.
    assert cli.run(["validate", wall, *options, *outputs, "--trials", "7"]) != 2
    assert "7, of which 0 failed; the file holds 1 more" in capsys.readouterr().out
    assert len(json.loads(files["json"].read_text())["results"]) == 8
    assert cli.run(["validate", wall, *options, "--trials", "0"]) == 2
    assert "at least 7 trials" in capsys.readouterr().err
