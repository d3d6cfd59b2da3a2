"""What a worker does: it opens the world on its first task, and measures views, as many tasks as it gets.

Each view's bound is that of `pose_bound` at its pose, bit for bit. A worker that has other versions, no LLVM,
or another world in the file of that name says so, and its own name, before it measures anything. After each
task it gives freed memory back, so that it holds no more after thousands of views than after some.

Where a limit is given, a first look, coarse and with random numbers of its own, decides how precisely a view
is measured: as coarsely again if the 99 % interval of its position bound is wholly on one side of the limit,
else to the precision. What is reported is that measurement, by the random numbers of `pose_bound`; so no
choice made here biases it.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..bound.cramer_rao import PoseBound
from ..errors import MitsubaCRBError, OptionError, WorkerError
from ..information.identifiability import CONFIDENCE
from ..measure.many import Shared, load_shared
from ..measure.opening import fingerprint
from ..measure.options import MeasurementKeywords, MeasurementOptions
from ..measure.stations import Station
from ..measure.versions import versions
from ..noise import NoiseModel
from ..render.backend import give_back_memory, use_mitsuba
from ..render.lending import in_turn
from ..render.random import derived_seed
from ..render.scene import SceneFile
from ..se3 import Array
from .executors import this_worker
from .layout import MEASURED, MEASUREMENTS, VERDICTS

COARSE = 4.0
"""Times the precision, that a view is measured to whose decision is clear."""
LOOK = 0x4C4F4F4B
"""Purpose of the first look's random numbers."""
_SIDES = NormalDist().inv_cdf(0.5 + CONFIDENCE / 2.0)


@dataclass(frozen=True, eq=False)
class Setup:
    """What a worker needs to know, once; it comes with every task."""

    key: str
    """Tells one run's settings from another's."""
    path: str
    """Of the world's file; empty if the world is at hand."""
    defines: dict[str, str]
    contents: str
    """The world's fingerprint."""
    versions: dict[str, str]
    noise: NoiseModel | None
    prior: Any
    nuisances: Sequence[str]
    options: MeasurementKeywords
    """The common exposure among them."""
    limit: float | None
    """Position bound that decides [scene unit]."""


class Views(NamedTuple):
    """A task: some views, by their numbers."""

    indices: tuple[int, ...]
    poses: Array
    """(m, 4, 4)."""


_opened: dict[str, Shared] = {}
"""In each process the world of one run, by its key."""


@contextlib.contextmanager
def at_hand(setup: Setup, shared: Shared) -> Iterator[None]:
    """In this process the world is open already, meanwhile."""
    _opened[setup.key] = shared
    try:
        yield
    finally:
        _opened.pop(setup.key, None)


@in_turn
def measure_views(setup: Setup, views: Views) -> dict[str, NDArray[Any]]:
    """The variables of some views, stacked.

    Raises:
        WorkerError: this process has other versions or another world than the one that asks.
        MitsubaCRBError: as `pose_bound`, the view named.
    """
    if setup.key not in _opened:
        _opened.clear()
        _opened[setup.key] = _open(setup, views)
    shared = _opened[setup.key]
    rows = [
        _measured(shared, Station(str(index), pose, None), setup.limit)
        for index, pose in zip(views.indices, views.poses, strict=True)
    ]
    give_back_memory()
    return {
        name: np.array([row[name] for row in rows], dtype=variable.dtype)
        for name, variable in MEASUREMENTS.items()
    }


def _open(setup: Setup, views: Views) -> Shared:
    me = this_worker()
    try:
        use_mitsuba(setup.versions["variant"])
        own = versions()
        different = [
            f"{name} {own.get(name)}, not {version}"
            for name, version in setup.versions.items()
            if own.get(name) != version
        ]
        if different:
            raise WorkerError(f"{me} has {', '.join(different)}: give all workers the same versions")
        first = [Station(str(views.indices[0]), views.poses[0], None)]
        loaded, _ = load_shared(SceneFile(setup.path, setup.defines), setup.nuisances, first, setup.options)
        if fingerprint(loaded, setup.path, setup.defines) != setup.contents:
            raise WorkerError(f"{me} has another world in {setup.path}")
    except WorkerError:
        raise
    except (MitsubaCRBError, OSError) as error:
        kind = type(error) if isinstance(error, MitsubaCRBError) else WorkerError
        raise kind(f"{me}: {error}") from error
    return Shared(loaded, setup.noise, setup.prior, setup.nuisances, setup.options)


def _measured(shared: Shared, station: Station, limit: float | None) -> dict[str, Any]:
    start = time.perf_counter()
    spent = 0
    if limit is not None:
        coarse = _coarser(shared)
        seed = derived_seed(MeasurementOptions(**shared.options).seed, LOOK)
        look = replace(coarse, options={**coarse.options, "seed": seed}).bound(station)
        spent = paths_of(look)
        if is_clear(look, limit):
            shared = coarse
    bound = shared.bound(station)
    values = view_values(bound)
    return {**values, "paths": spent + values["paths"], "seconds": time.perf_counter() - start}


def _coarser(shared: Shared) -> Shared:
    options = shared.options
    precision = min(COARSE * MeasurementOptions(**options).goal, 0.5)
    return replace(shared, options={**options, "precision": precision})


def check_limit(limit: float | None, options: MeasurementKeywords) -> None:
    """Refuse a limit that cannot decide anything.

    Raises:
        OptionError: it is not positive, or paths are counted instead of a precision.
    """
    if limit is None:
        return
    if not 0.0 < limit < float("inf"):
        raise OptionError(f"limit must be a position bound [scene unit], positive and finite; got {limit}")
    if options.get("spp") is not None:
        raise OptionError("--limit decides on the precision, and --spp leaves none: leave out one of them")


def is_clear(bound: PoseBound, limit: float) -> bool:
    """Whether the 99 % interval of a position bound is wholly on one side of a limit."""
    if np.isfinite(bound.position_std).all():
        value = float(np.linalg.norm(bound.position_std))
        # Errors of the three axes as if they were one: no smaller than that of the root of the trace.
        error = float(bound.position_std @ bound.position_std_standard_error) / value
        return abs(value - limit) > _SIDES * error
    return float(np.max(bound.position_std_lower_limit)) > limit


def view_values(bound: PoseBound) -> dict[str, Any]:
    """The variables of one view, of the bound there."""
    alone = bound.inverse.information.to_frame("camera")
    facts = bound.provenance
    return {
        "information": alone.to_frame("world").matrix,
        "information_camera": alone.matrix,
        "covariance_of_entries": alone.covariance_of_entries,
        "length_scale": bound.length_scale,
        "position_std": bound.position_std,
        "position_std_standard_error": bound.position_std_standard_error,
        "position_std_lower_limit": bound.position_std_lower_limit,
        "position_verdict": [VERDICTS.index(verdict) for verdict in bound.position_verdict],
        "rotation_std_deg": bound.rotation_std_deg,
        "rotation_std_deg_standard_error": bound.rotation_std_deg_standard_error,
        "rotation_std_deg_lower_limit": bound.rotation_std_deg_lower_limit,
        "rotation_verdict": [VERDICTS.index(verdict) for verdict in bound.rotation_verdict],
        "position_bound": np.linalg.norm(bound.position_std),
        "rotation_bound_deg": np.linalg.norm(bound.rotation_std_deg),
        "rank": bound.rank,
        "weakest": np.full(6, np.nan) if bound.weakest is None else bound.weakest.direction,
        "eigenvalues": bound.eigenvalues,
        "pixels": alone.selection.selected,
        "paths": paths_of(bound),
        "no_bound": bool(facts.get("no_bound")),
        "status": MEASURED,
    }


def paths_of(bound: PoseBound) -> int:
    """How many it took, over all rounds; none where nothing is random."""
    facts = bound.provenance
    return sum(_paths(part) for part in (facts, facts.get("depth") or {}))


def _paths(facts: dict[str, Any]) -> int:
    sampling = facts.get("sampling") or {}
    if "paths" in sampling:
        return int(sampling["paths"])
    return round(float(facts.get("spp", 0)) * int(facts.get("pixels", {}).get("selected", 0)))
