"""`mitsuba-crb field`: mistakes in one line, and runs that something ends, which go on."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_splats import write_splats

from mitsuba_crb import se3
from mitsuba_crb.cli import app as cli
from mitsuba_crb.errors import WorkerError
from mitsuba_crb.measure.opening import open_measurable
from mitsuba_crb.measure.options import MeasurementOptions
from mitsuba_crb.planning import dask_cluster, view_field
from mitsuba_crb.planning.candidates import candidates_of
from mitsuba_crb.planning.field_run import measure_field
from mitsuba_crb.planning.view_field import ViewField, open_field

_START = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
"""Before the command: what shells start in the background ignores Ctrl-C, and so does all that it starts."""
COMMAND = [sys.executable, "-c", f"{_START}; from mitsuba_crb.cli.app import main; main()", "field"]
FEW = ["--size", "12x8", "--spp", "16"]
pytestmark = pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")


@pytest.fixture
def splats(tmp_path: Path) -> Path:
    return write_splats(tmp_path)


def poses_in(folder: Path, world: Path, count: int) -> Path:
    with open_measurable(world, MeasurementOptions()) as view:
        first = view.pose
    file = folder / "poses.npy"
    np.save(file, [first @ se3.exp([0.02 * k, 0, 0.03 * k, 0, 0.01 * k, 0]) for k in range(count)])
    return file


def values(field: ViewField) -> dict[str, bytes]:
    """All bits, but for how long it took."""
    data = field.dataset.data_vars.items()
    return {name: array.values.tobytes() for name, array in data if name != "seconds"}


@pytest.mark.slow
def test_it_says_what_became_of_the_views_and_goes_on(
    splats: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = tmp_path / "views.zarr"
    page = tmp_path / "page.png"
    arguments = ["field", str(splats), "--poses", str(poses_in(tmp_path, splats, 4)), "--out", str(store)]
    arguments += ["--plot", str(page)]
    for _ in range(2):
        assert cli.run(arguments) == 0
        said = capsys.readouterr().out
        for words in ("4 views", "measured 4 (100%)", "rank   6 at 4", "position std [scene unit]", "median"):
            assert words in said
    assert open_field(store).usable.all()
    assert page.stat().st_size > 1000


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (
            {"--scheduler": "tcp://127.0.0.1:1"},
            ["no scheduler answers at tcp://127.0.0.1:1", "dask scheduler"],
        ),
        ({"--scheduler": "machine7"}, ["machine7", "no address", "tcp://"]),
        ({"--scheduler": "tcp://127.0.0.1:1", "--workers": "2"}, ["leave out"]),
        ({"--workers": "0"}, ["at least one worker"]),
        ({"--limit": "-1"}, ["limit", "positive"]),
        ({"--limit": "1", "--spp": "16"}, ["--limit", "--spp"]),
        ({"--out": "notes.txt"}, ["notes.txt", "is left alone"]),
        ({"--out": "missing/views.zarr"}, ["missing", "create it first"]),
        ({"--out": "page", "--report": "page"}, ["--out", "--report", "both name page"]),
        ({"--report": "poses.npy"}, ["--report", "poses.npy", "would overwrite an input"]),
        ({"--poses": "gird:nx=2"}, ["gird", "grid"]),
        ({"--poses": "scaled.npy"}, ["scaled.npy", "scale"]),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, dict) else "",
)
def test_a_mistake_is_one_line_and_leaves_everything_as_it_was(
    given: dict[str, str],
    words: list[str],
    splats: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(dask_cluster, "PATIENCE", 1.0)
    poses = poses_in(tmp_path, splats, 2)
    np.save(tmp_path / "scaled.npy", np.load(poses) * [[2.0], [2.0], [2.0], [1.0]])
    (tmp_path / "notes.txt").write_text("mine")
    before = sorted(tmp_path.rglob("*"))
    options = {"--poses": str(poses), "--out": "views.zarr"} | given
    start = time.monotonic()
    assert cli.run(["field", str(splats), *(word for pair in options.items() for word in pair)]) == 2
    assert time.monotonic() - start < 30.0
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert all(word in said for word in words)
    assert sorted(tmp_path.rglob("*")) == before
    assert (tmp_path / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize("missing", ["zarr", "xarray", "distributed"])
def test_what_is_not_installed_is_named(
    missing: str,
    splats: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, missing, None)  # what makes Python refuse to import it
    arguments = ["field", str(splats), "--poses", str(poses_in(tmp_path, splats, 2))]
    more = ["--scheduler", "tcp://127.0.0.1:1"] if missing == "distributed" else []
    assert cli.run([*arguments, "--out", str(tmp_path / "views.zarr"), *more]) == 2
    said = capsys.readouterr().err
    assert f"need {missing}: pip install 'mitsuba_crb[field]'" in said
    assert said.count("\n") == 1


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.parametrize(
    ("number", "workers"), [(signal.SIGINT, "1"), (signal.SIGINT, "2"), (signal.SIGKILL, "2")]
)
def test_a_command_that_is_ended_goes_on(
    number: signal.Signals, workers: str, scenes: Path, tmp_path: Path
) -> None:
    world = scenes / "textured_wall" / "textured_wall.xml"
    arguments = [*COMMAND, str(world), "--poses", str(poses_in(tmp_path, world, 40)), *FEW]
    store = tmp_path / "views.zarr"
    command = [*arguments, "--workers", workers, "--out", str(store)]
    with subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, start_new_session=True
    ) as run:
        deadline = time.monotonic() + 300.0
        while not (store.exists() and open_field(store).done.any()) and time.monotonic() < deadline:
            time.sleep(0.05)
        os.killpg(run.pid, number)  # as a terminal does
        said = run.communicate()[1]
    done = int(open_field(store).done.sum())
    assert 0 < done < 40
    if number == signal.SIGINT:
        assert run.returncode == 130
        assert f"interrupted; {done} of 40 views are done, and the same command goes on" in said
        assert said.count("\n") == 1
    subprocess.run(command, check=True, capture_output=True)
    subprocess.run([*arguments, "--out", str(tmp_path / "whole.zarr")], check=True, capture_output=True)
    assert values(open_field(store)) == values(open_field(tmp_path / "whole.zarr"))


@contextmanager
def cluster(folder: Path, workers: int) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """Address and processes of a scheduler and its workers; these are not restarted when they die."""
    file = folder / "scheduler.json"
    quiet: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": folder}
    dask = [sys.executable, "-m", "dask"]
    started = [
        subprocess.Popen(
            [
                *dask,
                "scheduler",
                "--host",
                "127.0.0.1",
                "--port",
                "0",
                "--no-dashboard",
                "--scheduler-file",
                str(file),
            ],
            **quiet,
        )
    ]
    try:
        while not file.exists():
            time.sleep(0.1)
        address = _address(file)
        for name in range(workers):
            options = ["--nthreads", "1", "--no-nanny", "--no-dashboard", "--name", f"w{name}"]
            started.append(subprocess.Popen([*dask, "worker", address, *options], **quiet))
        yield address, started
    finally:
        for process in reversed(started):
            process.kill()
            process.wait()


def _address(file: Path) -> str:
    import json

    for _ in range(100):
        try:
            return str(json.loads(file.read_text())["address"])
        except ValueError:  # half written
            time.sleep(0.1)
    raise AssertionError("no scheduler")


@pytest.mark.slow
def test_a_cluster_measures_the_same_and_outlives_its_workers_but_not_its_scheduler(
    splats: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    views = candidates_of(np.load(poses_in(tmp_path, splats, 12)))
    whole = measure_field(splats, views, tmp_path / "whole.zarr", batch=1)
    monkeypatch.setattr(dask_cluster, "PATIENCE", 20.0)
    with cluster(tmp_path, 2) as (address, processes):
        scheduler, first, _ = processes

        def kill(done: int, _: int) -> None:
            if done == 3:
                first.kill()

        store = tmp_path / "views.zarr"
        field = measure_field(splats, views, store, scheduler=address, batch=1, on_view=kill)
        assert values(field) == values(whole)
        assert field.dataset.attrs == whole.dataset.attrs

        def lose(done: int, _: int) -> None:
            if done == 2:
                scheduler.kill()

        lost = tmp_path / "lost.zarr"
        start = time.monotonic()
        with pytest.raises(WorkerError, match=r"scheduler.*of 12 views are done, and the same command"):
            measure_field(splats, views, lost, scheduler=address, batch=1, on_view=lose)
        assert time.monotonic() - start < 120.0
        assert 2 <= int(view_field.open_field(lost).done.sum()) < 12
        assert values(measure_field(splats, views, lost)) == values(whole)
