"""Thirty Gaussian splats in a file, with INRIA's cameras beside it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

SIZE, FOCAL = (32, 24), (30.0, 31.0)


def write_splats(folder: Path, *, cameras: int = 2, seed: int = 0, on_axis: bool = False) -> Path:
    """The file `splats.ply`, and `cameras.json` unless there shall be none.

    Args:
        on_axis: all are round, and on the first camera's optical axis.
    """
    rng = np.random.default_rng(seed)
    count = 30
    z = rng.uniform(2.0, 6.0, count)
    columns = {
        "x": rng.uniform(-0.5, 0.5, count) * z,
        "y": rng.uniform(-0.4, 0.4, count) * z,
        "z": z,
        **{f"f_dc_{k}": rng.uniform(-1.5, 1.5, count) for k in range(3)},
        "opacity": rng.uniform(-1.0, 3.0, count),
        **{f"scale_{k}": np.log(rng.uniform(0.05, 0.4, count)) for k in range(3)},
        **{f"rot_{k}": rng.standard_normal(count) for k in range(4)},
    }
    if on_axis:
        columns |= {name: np.zeros(count) for name in "xy"}
        columns |= {f"scale_{k}": columns["scale_0"] for k in range(3)}
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    lines += [f"property float {name}" for name in columns]
    header = "\n".join([*lines, "end_header", ""]).encode()
    file = folder / "splats.ply"
    file.write_bytes(header + np.stack(list(columns.values()), axis=1).astype("<f4").tobytes())
    if cameras:
        (folder / "cameras.json").write_text(json.dumps([_camera(k) for k in range(cameras)]))
    return file


def _camera(k: int) -> dict[str, object]:
    """Looking along the world's z, each a little to the right of the one before."""
    return {
        "id": k,
        "img_name": f"view{k}",
        "width": SIZE[0],
        "height": SIZE[1],
        "fx": FOCAL[0],
        "fy": FOCAL[1],
        "position": [0.2 * k, 0.0, 0.0],
        "rotation": np.eye(3).tolist(),
    }
