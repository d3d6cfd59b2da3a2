"""A hash grid of random numbers in a file, with two cameras."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mitsuba_crb import Intrinsics, se3
from mitsuba_crb.radiance.field import Viewpoint
from mitsuba_crb.radiance.field_file import Standing, save_field
from mitsuba_crb.radiance.hashgrid import HashGrid
from mitsuba_crb.radiance.network import Design, new_weights
from mitsuba_crb.radiance.occupancy import everywhere
from mitsuba_crb.radiance.scene_space import SceneSpace
from mitsuba_crb.render.backend import use_mitsuba

SIZE = (16, 12)
POSE = se3.exp([0.3, -0.2, -2.1, 0.1, 0.2, -0.3])


def write_grid(folder: Path, seed: int = 3) -> Path:
    """The file `grid.npz`."""
    use_mitsuba()
    design = Design(levels=4, features=2, coarsest=4, finest=24, table=2**10, hidden=16, cells=16, steps=160)
    rng = np.random.default_rng(seed)
    weights = new_weights(design, seed)
    weights["w2"][0] *= 3.0
    intrinsics = Intrinsics(SIZE, (20.0, 20.0), (8.0, 6.0))
    field = HashGrid(
        "made",
        design,
        SceneSpace((0.2, -0.1, 0.4), 2.5),
        rng.normal(size=design.encoding(0).n_params).astype(np.float32),
        weights,
        everywhere(design.cells),
        (0.1, 0.5, 0.9),
        tuple(
            Viewpoint(f"view{k}", intrinsics, POSE @ se3.exp([0.1 * k, 0.0, 0.0, 0.0, 0.0, 0.0]))
            for k in range(2)
        ),
    )
    file = folder / "grid.npz"
    save_field(file, field, Standing({}, {}, {}))
    return file
