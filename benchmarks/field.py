"""Fields of views of textured_room, 64x64, 5 %: rate, workers, clusters, and what 100 machines would need.

    python benchmarks/field.py --views 10000 --workers-views 256   # hours
    python benchmarks/field.py --views 48 --workers-views 32       # a short look
    python benchmarks/field.py --parts sizes --seconds 0.5         # some of it, with a rate from elsewhere

rate: one process, all its cores. After each batch of the field come the same views by `pose_bound`, warm:
scene loaded, kernels traced, exposure given. The target is at most 1.05 times these, no kernel compiled after
the first view of a worker, and memory that stays. workers: processes of one thread each, from when all have
answered; the target is 1.8 times one of them by two, and a local Dask cluster of two within 10 % of that.
sizes: what goes through the network and into the store, and what that and the rate make of 100,000 views on
100 machines, on paper.
"""

from __future__ import annotations

import argparse
import json
import os
import pickle
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import mitsuba_crb  # isort: split

import drjit as dr
import numpy as np

from mitsuba_crb import SceneFile, pose_bound
from mitsuba_crb.errors import SaturatedError
from mitsuba_crb.measure.opening import wanted
from mitsuba_crb.measure.options import MeasurementOptions
from mitsuba_crb.planning import field_run
from mitsuba_crb.planning.candidates import Candidates, parse_candidates
from mitsuba_crb.planning.executors import Here
from mitsuba_crb.planning.field_run import LARGEST_BATCH, measure_field
from mitsuba_crb.planning.free_space import view_status
from mitsuba_crb.planning.layout import TO_DO
from mitsuba_crb.planning.store import FieldStore
from mitsuba_crb.planning.view_field import open_field
from mitsuba_crb.processes import cores
from mitsuba_crb.render.scene import as_scene

SCENE = Path(__file__).parents[1] / "scenes" / "textured_room" / "textured_room.xml"
HEADINGS = 16
VIEWS, MACHINES, CORES = 100_000, 100, 8
"""Of the table on paper."""


def candidates(count: int, size: tuple[int, int]) -> Candidates:
    """So many free views: on a grid of the floor plan, with 16 directions each."""
    side = 1 + int(np.ceil(np.sqrt(2 * count / HEADINGS)))
    made = parse_candidates(f"grid:nx={side},ny={side},headings={HEADINGS}", SceneFile(SCENE), size=size)
    loaded, _ = as_scene(SceneFile(SCENE), wanted(MeasurementOptions(size=size)))
    free = np.flatnonzero(view_status(loaded, made.poses, {"size": size}) == TO_DO)
    chosen = free[np.linspace(0, len(free) - 1, count).astype(int)]
    print(f"{len(made)} views on the grid, of which {len(free)} are free; {count} are taken")
    return Candidates(made.poses[chosen], made.place[chosen], made.heading[chosen], made.up, made.description)


def memory() -> float:
    """Of this process now [MiB]; where the system does not say, the most that it had."""
    file = Path("/proc/self/statm")
    if file.exists():
        return int(file.read_text().split()[1]) * resource.getpagesize() / 2**20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10


def rate(views: Candidates, size: tuple[int, int], folder: Path) -> float:
    """Prints the first part; seconds of a view, all cores together."""
    loaded, _ = as_scene(SceneFile(SCENE), wanted(MeasurementOptions(size=size)))
    times: dict[str, list[float]] = {"field": [], "warm": []}
    compiled, held, counts = [], [], []
    before, last = 0, time.perf_counter()
    white: list[float] = []

    def after(done: int, _: int) -> None:
        nonlocal before, last
        field = time.perf_counter() - last
        compiled.append(sum(not kernel.get("cache_hit", True) for kernel in dr.kernel_history()))
        dr.kernel_history_clear()
        held.append(memory())
        if not done:
            print(f"{'before the first view [s]':36} {field:.1f}")
            white.append(open_field(folder / "rate.zarr").settings["white"])
        else:
            start = time.perf_counter()
            for pose in views.poses[before:done]:
                with suppress(SaturatedError):  # as the field has it: it sees nothing
                    pose_bound(loaded, pose=pose, size=size, exposure=white[0])
            counts.append(done - before)
            times["field"].append(field)
            times["warm"].append(time.perf_counter() - start)
        before, last = done, time.perf_counter()

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        field = measure_field(loaded, views, folder / "rate.zarr", size=size, on_view=after)
    # The first batch compiles, if there are others.
    counted = slice(1 if len(counts) > 1 else 0, None)
    seconds, warm = sum(times["field"][counted]), sum(times["warm"][counted])
    each = seconds / sum(counts[counted])
    ratios = np.divide(times["field"], times["warm"])[counted]
    rows = {
        "views": len(views),
        "views per second and core": round(1.0 / each / cores(), 3),
        "field / warm bounds": round(seconds / warm, 3),
        "of batches, quartiles": np.percentile(ratios, (25, 50, 75)).round(3).tolist(),
        "kernels compiled after the first batch": sum(compiled[2:]),
        "memory after 1st, half, all [MiB]": [round(held[k]) for k in (1, len(held) // 2, -1)],
        "rank 6": int((field.rank == 6).sum()),
        "paths of a view, median": float(np.median(field.dataset["paths"].values)),
    }
    _print(rows)
    return each * cores()


@contextmanager
def cluster(folder: Path, workers: int) -> Iterator[str]:
    """Address of a local scheduler with workers of one thread each."""
    file = folder / "scheduler.json"
    quiet: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": folder}
    command = [sys.executable, "-m", "dask"]
    where = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file)]
    started = [subprocess.Popen([*command, "scheduler", *where], **quiet)]
    try:
        while not file.exists():
            time.sleep(0.2)
        time.sleep(1.0)
        options = ["--scheduler-file", str(file), "--nthreads", "1", "--no-dashboard", "--no-nanny"]
        started += [subprocess.Popen([*command, "worker", *options], **quiet) for _ in range(workers)]
        yield str(json.loads(file.read_text())["address"])
    finally:
        for process in reversed(started):
            process.kill()
            process.wait()


class Timed(NamedTuple):
    """The views that were left when the clock began, and how long they took."""

    left: np.ndarray
    seconds: float

    def rate(self, cost: np.ndarray) -> float:
        """Work per second, by what each view (n,) costs one worker: some cost a hundred times others."""
        return float(cost[self.left].sum() / self.seconds)


def timed(views: Candidates, size: tuple[int, int], store: Path, count: int, **options: Any) -> Timed:
    """From when each of so many workers has answered about twice."""
    told: list[float] = []
    left = np.zeros(0, dtype=bool)

    def on_view(done: int, _: int) -> None:
        nonlocal left
        told.append(time.perf_counter())
        if len(told) == 2 * count + 1:
            left = ~FieldStore(store).done
            assert left.sum() == len(left) - done

    measure_field(str(SCENE), views, store, size=size, on_view=on_view, **options)
    return Timed(left, told[-1] - told[2 * count])


def workers(views: Candidates, size: tuple[int, int], folder: Path) -> None:
    """Prints the second part."""
    threads = dr.thread_count()
    dr.set_thread_count(1)
    found = [timed(views, size, folder / "one.zarr", 1)]
    dr.set_thread_count(threads)
    found.append(timed(views, size, folder / "two.zarr", 2, workers=2))
    with cluster(folder, 2) as address:
        time.sleep(5.0)
        found.append(timed(views, size, folder / "dask.zarr", 2, scheduler=address))
    stores = [open_field(folder / f"{name}.zarr").dataset for name in ("one", "two", "dask")]
    same = all(
        stores[0][name].values.tobytes() == other[name].values.tobytes()
        for other in stores[1:]
        for name in stores[0].data_vars
        if name != "seconds"
    )
    cost = stores[0]["seconds"].values
    one, two, dask = (each.rate(cost) for each in found)
    _print(
        {
            "views, seconds of one worker": f"{len(views)}, {cost.sum():.0f}",
            "work per second by one, two, Dask": [round(each, 3) for each in (one, two, dask)],
            "two / one": round(two / one, 3),
            "local Dask cluster of two / two": round(dask / two, 3),
            "all the same, bit for bit": same,
        }
    )


class Counting:
    """This process, counting the bytes that would go through the network."""

    elsewhere = False

    def __init__(self) -> None:
        self.bytes: dict[str, int] = {}

    def close(self) -> None:
        """See `Executor`."""

    def run(self, work: Callable[[Any], Any], jobs: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        """See `Executor`."""
        for index, result in Here().run(work, jobs):
            parts = {"settings": work, "job": jobs[index], "result": result}
            self.bytes = {name: len(pickle.dumps(part)) for name, part in parts.items()}
            yield index, result


def sizes(size: tuple[int, int], folder: Path, seconds: float) -> None:
    """Prints the third part."""
    counting, writes, write = Counting(), [], FieldStore.write
    few = LARGEST_BATCH
    task = candidates(few, size)

    def timed_write(self: FieldStore, *given: Any) -> None:
        start = time.perf_counter()
        write(self, *given)
        writes.append(time.perf_counter() - start)

    before = field_run.executor_for
    field_run.executor_for, FieldStore.write = lambda *_: counting, timed_write
    try:
        measure_field(SCENE, task, folder / "sizes.zarr", size=size, spp=8, batch=few)
    finally:
        field_run.executor_for, FieldStore.write = before, write
    files = [file for file in (folder / "sizes.zarr").rglob("*") if file.is_file() and "/c/" in str(file)]
    stored = sum(file.stat().st_size for file in files)
    sent, came = counting.bytes["settings"] + counting.bytes["job"], counting.bytes["result"]
    _print(
        {
            "views of a task": few,
            "bytes to a worker, of a task": sent,
            "of these, of the settings": counting.bytes["settings"],
            "bytes from a worker, of a task": came,
            "bytes in the store, of a view": round(stored / few),
            "files of a task": len(files),
            "the parent writes a task in [s]": round(float(np.median(writes)), 3),
        }
    )
    tasks = -(-VIEWS // few)
    of_task = few * seconds
    wall = VIEWS * seconds / (MACHINES * CORES)
    print(
        f"\non paper: {VIEWS} views on {MACHINES} machines of {CORES} cores, {seconds:.2f} s of a core each"
    )
    _print(
        {
            "wall time [h]": round(wall / 3600, 2),
            "tasks": tasks,
            "tasks ended per second": round(tasks / wall, 2),
            "the last tasks, of the wall time": f"{of_task / wall:.1%}",
            "parent busy with writing": f"{tasks * float(np.median(writes)) / wall:.1%}",
            "scheduler, at 1 ms a task": f"{tasks * 1e-3 / wall:.2%}",
            "network of the parent [kB/s]": round((sent + came) * tasks / wall / 1e3, 1),
            "store [MB]": round(stored / few * VIEWS / 1e6),
            "files": len(files) * tasks,
            "workers that one parent can write for": round(of_task / float(np.median(writes))),
            "the same by --batch 128": round(128 * seconds / float(np.median(writes))),
        }
    )


def _print(rows: dict[str, Any]) -> None:
    for name, value in rows.items():
        print(f"{name:38} {value}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--views", type=int, default=400)
    parser.add_argument("--workers-views", type=int, default=128)
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument(
        "--seconds", type=float, default=1.0, help="of a core, of a view, without the first part"
    )
    parser.add_argument("--parts", nargs="+", default=["rate", "workers", "sizes"])
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    size = (arguments.size, arguments.size)
    print(f"mitsuba_crb {mitsuba_crb.__version__}, {os.cpu_count()} processors, {size[0]}x{size[1]}")
    seconds = arguments.seconds
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        views = candidates(arguments.views, size)
        if "rate" in arguments.parts:
            seconds = rate(views, size, folder)
        if "workers" in arguments.parts:
            workers(candidates(arguments.workers_views, size), size, folder)
        if "sizes" in arguments.parts:
            sizes(size, folder, seconds)


if __name__ == "__main__":
    main()
