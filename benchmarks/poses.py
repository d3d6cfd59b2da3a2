"""Many poses at once beside one at a time: along a path through textured_room, 128x96, 5 %.

    python benchmarks/poses.py                  # 200 poses
    python benchmarks/poses.py --poses 20       # a short look

warm: `pose_bound` at each pose in this process, the scene loaded and its kernels traced; it alternates with
`pose_table`, both the same poses, in chunks. Seconds are the processor's, of all threads, which a busy
machine changes less than those of the clock. separate: a process of `mitsuba-crb bound` for each of a sample
of the poses, scaled to all of them. The target is at most 1.1 times the warm bounds.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np

from mitsuba_crb import SceneFile, pose_bound, pose_table
from mitsuba_crb.measure.opening import wanted
from mitsuba_crb.measure.options import MeasurementOptions
from mitsuba_crb.render.scene import as_scene

ROOT = Path(__file__).parents[1]
SCENE = ROOT / "scenes" / "textured_room" / "textured_room.xml"
SIZE = (128, 96)
SAMPLE = 3
CHUNK = 25


def path(count: int) -> np.ndarray:
    """(count, 4, 4), an arc through the room, looking at the wall that the scene's own camera looks at."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    for pose, s in zip(poses, np.linspace(-1.0, 1.0, count), strict=True):
        eye = np.array([0.85 + 0.5 * s, -0.75 - 0.2 * s**2, 1.5 + 0.1 * np.sin(4 * s)])
        target = np.array([0.3 + 0.3 * s, 1.5, 1.2])
        forward = (target - eye) / np.linalg.norm(target - eye)
        left = np.cross([0.0, 0.0, 1.0], forward)
        left /= np.linalg.norm(left)
        pose[:3] = np.column_stack([left, np.cross(forward, left), forward, eye])
    return poses


def separate(pose: np.ndarray) -> float:
    """Processor seconds of a process."""
    command = [sys.executable, "-c", "from mitsuba_crb.cli.app import main; main()", "bound", str(SCENE)]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "pose.npy"
        np.save(file, pose)
        before = os.times()
        begin = before.children_user + before.children_system
        subprocess.run(
            [*command, "--size", "x".join(map(str, SIZE)), "--pose", str(file)],
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            stdout=subprocess.DEVNULL,
            check=True,
        )
        after = os.times()
        return after.children_user + after.children_system - begin


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--poses", type=int, default=200)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    poses = path(arguments.poses)
    loaded, _ = as_scene(SceneFile(SCENE), wanted(MeasurementOptions(size=SIZE)))
    pose_bound(loaded, pose=poses[0], size=SIZE)  # traces
    times: dict[str, list[float]] = {"many": [], "warm": []}
    rows = []
    for first in range(0, len(poses), CHUNK):
        chunk = poses[first : first + CHUNK]
        start = time.process_time()
        rows += pose_table(loaded, chunk, size=SIZE).rows
        times["many"].append(time.process_time() - start)
        start = time.process_time()
        for pose in chunk:
            pose_bound(loaded, pose=pose, size=SIZE)
        times["warm"].append(time.process_time() - start)
    sample = [separate(pose) for pose in poses[:: max(1, len(poses) // SAMPLE)][:SAMPLE]]
    many, warm = (sum(times[name]) for name in ("many", "warm"))
    ratios = np.divide(times["many"], times["warm"])
    alone = float(np.mean(sample)) * len(poses)
    row = {
        "poses": len(poses),
        "many [s]": round(many, 2),
        "warm [s]": round(warm, 2),
        "many / warm": f"{many / warm:.3f}, chunks {ratios.min():.3f} to {ratios.max():.3f}",
        f"separate, of {len(sample)} [s]": round(alone, 1),
        "many / separate": round(many / alone, 3),
        "rank 6": sum(one.rank == 6 for one in rows),
        "largest relative error": round(float(np.nanmax([r.relative_standard_error for r in rows])), 3),
    }
    for name, value in row.items():
        print(f"{name:28} {value}")


if __name__ == "__main__":
    main()
