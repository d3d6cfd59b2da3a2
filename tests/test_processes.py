"""Worker processes end with their parent, however it ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

PARENT = """
import os, time
from mitsuba_crb.processes import each

def work(seconds):
    os.write(1, f"{os.getpid()}\\n".encode())  # at once, whatever the other one writes
    time.sleep(seconds)

if __name__ == "__main__":
    list(each(work, [300.0, 300.0], 2))
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
