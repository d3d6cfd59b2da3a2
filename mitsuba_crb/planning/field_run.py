"""The bounds at thousands of views: measured wherever there are workers, kept as they are done, gone on with.

What a view's numbers are depends on the world, its pose and the settings, bit for bit, and neither on who has
measured it nor when. The default camera's exposure is that of `pose_bounds` at the candidates, or of many at
a choice of them, made by their poses alone.
"""

from __future__ import annotations

import functools
import hashlib
import json
import math
import os
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from ..bound.prior import load_prior
from ..errors import OptionError, OutputError, StoreError, WorkerError
from ..files import jsonable
from ..measure.many import Shared, common_white, load_shared, shared_settings, with_white
from ..measure.options import MeasurementKeywords
from ..measure.stations import Station, stations_of
from ..noise import NoiseModel
from ..render.lending import in_turn
from ..render.scene import SceneFile
from ..se3 import Array
from .candidates import Candidates
from .executors import Executor, executor_for
from .free_space import view_status
from .layout import TO_DO
from .store import FieldStore, earlier, refuse_others
from .view_field import ViewField, open_field
from .view_work import Setup, Views, at_hand, check_limit, measure_views

Progress = Callable[[int, int], None]
"""Called before the first view with what is done, and after each batch, with all views."""

LARGEST_BATCH = 32
"""Views of a task, and of a chunk of the store, at most."""
_BATCHES = 32
"""In fewer batches nobody would see them go, nor could many workers share them."""
_METERED = 256
"""Views that the common exposure is taken from, at most."""


@in_turn
def measure_field(
    world: Any,
    candidates: Candidates,
    store: str | Path,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    noise: NoiseModel | None = None,
    prior: Any = None,
    nuisances: Sequence[str] = (),
    defines: dict[str, str] | None = None,
    limit: float | None = None,
    on_view: Progress | None = None,
    resume: bool = True,
    batch: int | None = None,
    **options: Unpack[MeasurementKeywords],
) -> ViewField:
    """The bounds at many views, in a store that grows as they are measured.

    Args:
        world: as for `pose_bound`; for workers the path of its file.
        candidates: the views.
        store: folder of the Zarr store; one of the same world, views and settings is gone on with.
        workers: processes of this machine; None or 1: this one.
        scheduler: address of a Dask scheduler, whose workers measure.
        noise, prior, nuisances: as for `pose_bounds`, or of the prior its file.
        defines: the scene file's `<default>`s.
        limit: position bound of interest [scene unit]: a view that is certainly on one side of it is measured
            coarsely, see `view_work`.
        on_view: told of progress.
        resume: whether there may be a store already.
        batch: views of a task and of a chunk, all or none of which are kept; None: a few of few views, 32 of
            many. A store keeps its own.
        options: see `MeasurementOptions`.

    Returns:
        What has been measured: all views, or of a run that was interrupted (Ctrl-C) fewer.

    Raises:
        StoreError: the store is of something else (says what differs), or a package is missing.
        OutputError: it cannot be written.
        WorkerError: a worker died, has other versions, or no scheduler answers; what is done is kept.
        OptionError: an option that cannot be used, or a world without a file for workers.
        PoseError: a view is no rigid motion; names it.
        MitsubaCRBError: as `pose_bound`, the view named.
        KeyboardInterrupt: before the store was made.
    """
    path = Path(store)
    if isinstance(world, SceneFile):
        world, defines = world.path, dict(world.defines)
    check_limit(limit, options)
    if batch is not None and batch < 1:
        raise OptionError(f"a batch has at least one view, not {batch}")
    if not resume and os.path.lexists(path):
        raise StoreError(f"{path} exists: name another store, or go on with it (resume)")
    if not path.parent.is_dir():
        raise OutputError(f"{path}: the folder {path.parent} does not exist; create it first")
    stations = stations_of(candidates.poses, None, None, options)
    before = earlier(path)
    file = os.path.abspath(world) if isinstance(world, str | Path) else ""
    with closing(executor_for(workers, scheduler)) as executor:
        if executor.elsewhere and not file:
            raise OptionError(
                "workers open the world themselves: give the path of its file, or leave them out"
            )
        known = load_prior(prior) if isinstance(prior, Path) else prior
        source = SceneFile(world, dict(defines or {})) if file else world
        loaded, label = load_shared(source, nuisances, stations, options)
        settings = {
            **shared_settings(loaded, label, world, defines, options, noise, prior, nuisances),
            "limit": limit,
            "views": {"count": len(stations), "contents": _fingerprint(candidates)},
        }
        if before is None:
            status = view_status(loaded, candidates.poses, options)
            free = [station for station, code in zip(stations, status, strict=True) if code == TO_DO]
            settings["white"] = common_white(loaded, _metered(free), noise, options) if free else None
            _create(path, candidates, status, settings, batch)
        else:
            settings["white"] = before.settings.get("white")  # of the same views, if all else is the same
            refuse_others(path, before.settings, settings)
        shared = Shared(loaded, noise, known, nuisances, with_white(options, settings["white"]))
        setup = Setup(
            key=hashlib.sha256(json.dumps(jsonable(settings), sort_keys=True).encode()).hexdigest(),
            path=file,
            defines=dict(defines or {}),
            contents=settings["scene_contents"],
            versions=settings["versions"],
            noise=noise,
            prior=known,
            nuisances=tuple(nuisances),
            options=shared.options,
            limit=limit,
        )
        with at_hand(setup, shared):
            _measure(FieldStore(path), candidates.poses, setup, executor, on_view)
    return open_field(path)


def _measure(
    kept: FieldStore, poses: Array, setup: Setup, executor: Executor, on_view: Progress | None
) -> None:
    """All views that are not done yet, or as many as there is time for until Ctrl-C."""

    def told() -> None:
        if on_view is not None:
            on_view(int(kept.done.sum()), len(kept.done))

    told()
    chunks, jobs = [], []
    for views in kept.chunks():
        seen = views[kept.to_measure[views]]
        if len(seen):
            chunks.append(views)
            jobs.append(Views(tuple(seen.tolist()), poses[seen]))
        else:
            kept.write(views, None)
    try:
        for index, measured in executor.run(functools.partial(measure_views, setup), jobs):
            kept.write(chunks[index], measured)
            told()
    except KeyboardInterrupt:
        return
    except (WorkerError, OutputError) as error:
        done = f"{int(kept.done.sum())} of {len(kept.done)} views are done"
        raise type(error)(f"{error}; {done}, and the same command goes on from there") from error


def _create(
    path: Path, candidates: Candidates, status: Any, settings: dict[str, Any], batch: int | None
) -> None:
    few = math.ceil(len(candidates.poses) / _BATCHES)
    FieldStore.create(
        path,
        {
            "world_from_camera": candidates.poses,
            "place": candidates.place,
            "heading": candidates.heading,
            "status": status,
        },
        jsonable(settings),
        {
            "candidates": json.dumps(jsonable(candidates.description), ensure_ascii=False),
            "up": [float(value) for value in candidates.up],
        },
        min(few, LARGEST_BATCH) if batch is None else batch,
    )


def _metered(stations: Sequence[Station]) -> list[Station]:
    """Those that the exposure is taken from, in an order that is not that of the views."""
    if len(stations) <= _METERED:
        return list(stations)
    return sorted(stations, key=lambda one: hashlib.sha256(one.pose.tobytes()).digest())[:_METERED]


def _fingerprint(candidates: Candidates) -> str:
    digest = hashlib.sha256()
    for values, kind in ((candidates.poses, "f8"), (candidates.place, "i4"), (candidates.heading, "i4")):
        digest.update(np.ascontiguousarray(values, dtype=kind).tobytes())
    return digest.hexdigest()[:16]
