"""The main job beside the renders that it is made of, and its memory against the image's size.

    python benchmarks/main_job.py            # both tables; about 6 minutes on 2 cores
    python benchmarks/main_job.py --quick    # smaller images

First table: warm `pose_bound` of textured_room at 256x256, by flow and by finite differences, beside twelve
`mi.render` calls with the same paths per pixel, in turns, as ratios. Second table: peak memory of one process
each, textured_wall by flow.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).parents[1]
SCENE = ROOT / "scenes" / "textured_room" / "textured_room.xml"
WALL = ROOT / "scenes" / "textured_wall" / "textured_wall.xml"

PROBE = """
import resource, sys
from mitsuba_crb import pose_bound
size = int(sys.argv[2])
pose_bound(sys.argv[1], size=(size, size), spp=8)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
"""


def timed(function: Callable[[], object]) -> float:
    """Seconds of one call."""
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def bound_beside_renders(size: int, spp: int, rounds: int) -> None:
    """Alternate pose_bound and twelve renders; print medians and ratios."""
    from mitsuba_crb import load_scene, pose_bound

    scene = load_scene(SCENE, width=str(size), height=str(size), spp=str(spp))
    import drjit as dr
    import mitsuba as mi

    def renders() -> None:
        for seed in range(12):
            dr.eval(mi.render(scene, spp=spp, seed=seed))
        dr.sync_thread()

    sides: dict[str, Callable[[], object]] = {
        "12 x mi.render": renders,
        "pose_bound, flow": lambda: pose_bound(scene, spp=spp, method="flow"),
        "pose_bound, finite_difference": lambda: pose_bound(scene, spp=spp, method="finite_difference"),
    }
    for side in sides.values():
        side()
    times = [{name: timed(side) for name, side in sides.items()} for _ in range(rounds)]
    print(f"textured_room {size}x{size}, {spp} paths per pixel, medians of {rounds} alternating rounds")
    for name in sides:
        seconds = statistics.median(row[name] for row in times)
        ratios = sorted(row[name] / row["12 x mi.render"] for row in times)
        print(
            f"  {name:32s} {seconds:7.2f} s   {statistics.median(ratios):6.3f} x twelve renders "
            f"({ratios[0]:.3f} to {ratios[-1]:.3f})",
            flush=True,
        )


def memory(sizes: tuple[int, ...]) -> None:
    """Peak memory of pose_bound in a process of its own."""
    peaks = []
    for size in sizes:
        output = subprocess.run(
            [sys.executable, "-c", PROBE, str(WALL), str(size)],
            check=True,
            capture_output=True,
            text=True,
            env=os.environ,
        ).stdout
        peaks.append(float(output))
        ratio = peaks[-1] / peaks[0]
        print(f"peak memory {size:5d}x{size:<5d} {peaks[-1]:8.0f} MiB   {ratio:5.2f} x the first", flush=True)


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="64x64 pixels and sizes up to 512")
    quick = parser.parse_args().quick
    bound_beside_renders(64 if quick else 256, 64 if quick else 16, 3)
    memory((128, 512) if quick else (512, 2048))


if __name__ == "__main__":
    main()
