"""Worker processes share the cores, and end with their parent, however it ends."""

from __future__ import annotations

import operator
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import drjit as dr
import numpy as np
import pytest
from small_scenes import camera, scene, texture, wall

from mitsuba_crb import pose_bound, processes
from mitsuba_crb.noise import Gaussian
from mitsuba_crb.render.backend import use_mitsuba

PARENT = """
import os, time
from mitsuba_crb.processes import in_processes

def work(seconds):
    os.write(1, f"{os.getpid()}\\n".encode())  # at once, whatever the other one writes
    time.sleep(seconds)

if __name__ == "__main__":
    list(in_processes(work, [300.0, 300.0], 2))
"""


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    # Whoever inherits an orphan may be slow to collect it.
    state = Path(f"/proc/{process}/stat")
    return not (state.exists() and state.read_text().rsplit(")", 1)[1].split()[0] == "Z")


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_workers_of_a_killed_parent_end(tmp_path: Path, number: signal.Signals) -> None:
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    with subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        workers = [int(parent.stdout.readline()) for _ in range(2)]
        assert all(_runs(worker) for worker in workers)
        parent.send_signal(number)
        deadline = time.monotonic() + 20.0
        while any(_runs(worker) for worker in workers) and time.monotonic() < deadline:
            time.sleep(0.05)
        left = [worker for worker in workers if _runs(worker)]
        for worker in left:
            os.kill(worker, signal.SIGKILL)
    assert not left


def _cores_and_threads(_: int) -> tuple[int, int, int]:
    use_mitsuba()
    return os.getpid(), processes.cores(), dr.thread_count()


@pytest.mark.slow
def test_workers_share_the_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, "cores", lambda: 7)
    before = dr.thread_count()
    found = [seen for _, seen in processes.in_processes(_cores_and_threads, range(2), 2)]
    assert [seen[1:] for seen in found] == [(3, 3)] * 2
    assert os.getpid() not in [seen[0] for seen in found]
    assert dr.thread_count() == before


def test_workers_of_one_core_have_one_each(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, "_share", [1])
    found = processes.in_processes(operator.call, [processes.cores] * 2, 2)
    assert [share for _, share in found] == [1, 1]


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="cores cannot be forbidden here")
def test_only_cores_that_the_process_may_run_on_count() -> None:
    """So that on one of them nothing is spawned."""
    code = (
        "import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
        "from mitsuba_crb.processes import cores, in_processes\n"
        "assert cores() == 1\n"
        "ended = list(in_processes(lambda job: os.getpid(), [0, 1], None))\n"
        "assert ended == [(0, os.getpid()), (1, os.getpid())]\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.BlindSpotWarning")
@pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")
@pytest.mark.parametrize("method", ["flow", "forward", "finite_difference"])
def test_the_number_of_threads_changes_no_bit(method: str) -> None:
    box = {"type": "cube", "to_world": camera(origin=(0.3, 0.2, 4), target=(1, 2, 5))["to_world"]}
    before, found = dr.thread_count(), []
    try:
        for threads in (1, 2, 5):
            dr.set_thread_count(threads)
            shown = scene(wall=wall(texture(), depth=6.0), box=box)
            bound = pose_bound(shown, Gaussian(0.01), method=method, spp=16)
            found.append(bound.information.matrix)
    finally:
        dr.set_thread_count(before)
    assert found[0].any()
    assert np.all(found[0] == found)
