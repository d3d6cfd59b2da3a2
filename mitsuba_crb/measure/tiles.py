"""From a scene to the information of its image's tiles, in one streaming pass.

The counterpart of `pose_bound` for choosing what to send: a grid of tiles of any size, each with its
information about the camera's pose from two halves of the batches (`tile_grid`), and with the size of the
message that would carry it. `tiles.together` brings several cameras' tiles to the pose of a common body.
"""

from __future__ import annotations

from typing import Any, Unpack

import numpy as np

from ..agents.message import message_size
from ..agents.quantisation import Form, Precision
from ..agents.tile_grid import MINIMUM_HALVED_BATCHES, TileGrid
from ..agents.tiles import TileInformation, correlated_refusal
from ..errors import SelectionError
from ..noise import CoupledNoise, NoiseModel
from ..render.lending import in_turn
from .adaptive import Rounds
from .measurement import measurement
from .options import MeasurementKeywords

TILE_SIZE = 32
"""Default side of the tiles [pixel]."""


@in_turn
def tile_information(
    scene: Any,
    noise: NoiseModel | None = None,
    *,
    agent: str | None = None,
    tile_size: int | tuple[int, int] = TILE_SIZE,
    form: Form = "factor",
    message_precision: Precision = "float32",
    rank: int = 6,
    **options: Unpack[MeasurementKeywords],
) -> TileInformation:
    """What every tile of one agent's image tells about its camera's pose.

    Args:
        scene: as for `pose_bound`.
        noise: noise model of the measured image, of independent pixels; None as for `pose_bound`.
        agent: the agent's name; None is the sensor's.
        tile_size: side, or width and height, of the tiles [pixel]; those at the image's rim are cut.
        form: of the messages whose size is the tiles' cost.
        message_precision: of their numbers.
        rank: of these messages, if they are sketches.
        options: see `MeasurementOptions`; `batches` at least 8, the default, since each half of them is an
            estimate of its own.

    Returns:
        Tiles in the camera frame, translation in units of the camera's length scale.

    Raises:
        SelectionError: the noise is correlated between pixels, whose tiles do not add.
        MitsubaCRBError: as `pose_bound`.
    """
    options = {"batches": MINIMUM_HALVED_BATCHES, **options}
    with measurement(scene, **options) as run:
        name = run.view.variable if agent is None else agent
        variable = run.view.variable
        cost = message_size(agent=name, variable=variable, form=form, precision=message_precision, rank=rank)
        sampled = run.selection.kind == "random"
        grid = TileGrid(run.view.size, tile_size, batches=run.options.batches, sampled=sampled)
        model, _ = run.noise(noise)
        if isinstance(model, CoupledNoise):
            raise SelectionError(correlated_refusal([name]))
        run.warn_of_limits()
        for part, weights in Rounds(run, model).decided().weighted_tiles(model):
            grid.add(part.batch_values, weights, part.pixels)
        select, report = grid.halves(
            run.linearisation.scale,
            factor=run.selection.total / run.selection.selected if sampled else 1.0,
        )
        return TileInformation(
            agent=name,
            tiles=grid.tiles,
            select=select,
            report=report,
            cost_bytes=np.full(len(select), cost),
            linearisation=run.linearisation,
        )
