"""One Monte Carlo trial: noise on the expected image, a perturbed pose, an alignment, and its error.

The error is ξ = log(truth⁻¹ estimate). Random numbers follow from the seed and the trial's number: neither
the number of processes nor an interruption changes a result.
"""

from __future__ import annotations

import dataclasses
import functools
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from .. import se3
from ..errors import OutOfViewError
from ..files import Record
from ..information.symmetric import pack
from ..measure.opening import as_world, wanted
from ..measure.options import MeasurementKeywords, MeasurementOptions
from ..noise import Gaussian
from ..render.fit import Wanted
from ..render.scene import SceneFile
from ..se3 import Array
from .align import align
from .misfit import Anchor
from .optimisers import Status


@dataclasses.dataclass(frozen=True)
class Trial(Record):
    """How one trial ended."""

    index: int
    """Its number."""
    status: Status
    """Of the search."""
    error: tuple[float, ...]
    """(6,), log(truth⁻¹ estimate), camera frame [scene unit, rad]."""
    residual: float
    """Root mean square of the whitened residual."""
    iterations: int
    """Of the search."""
    excess: float
    """Relative excess of its covariance over the bound from the renderer's noise."""
    added: tuple[float, ...]
    """(21,), the covariance behind it, its upper triangle in `numpy.triu_indices(6)` order, camera frame."""
    invalid: int
    """Pixels, of those that the bound counts, that it left out (`drop_invalid`)."""


@dataclasses.dataclass(frozen=True, eq=False)
class Setup:
    """What all trials share."""

    scene: Any
    """A path, with `defines`, where processes load it, or what `align` takes."""
    defines: dict[str, str]
    """The scene file's `<default>`s."""
    anchor: Anchor
    """The truth, and the expected image there."""
    sigma: float
    """Standard deviation of the pixel noise [radiance]."""
    settings: dict[str, Any]
    """What the trials depend on, JSON-able."""
    options: MeasurementKeywords
    """Of the measurements."""


def run_trials(work: tuple[Setup, list[int]]) -> list[Trial]:
    """The trials of some numbers, in a process of their own or in this one."""
    setup, indices = work
    scene = setup.scene
    if isinstance(scene, str | Path):
        scene = _loaded(str(scene), wanted(MeasurementOptions(**setup.options)), *setup.defines.items())
    return [_trial(setup, scene, index) for index in indices]


@functools.lru_cache(maxsize=1)
def _loaded(scene: str, of_it: Wanted, *defines: tuple[str, str]) -> Any:
    """A process loads its scene once: the first render of a loaded scene costs as much as a trial."""
    return as_world(SceneFile(scene, dict(defines)), of_it)[0]


def _trial(setup: Setup, scene: Any, index: int) -> Trial:
    settings, truth = setup.settings, setup.anchor.pose
    rng = np.random.default_rng([settings["seed"], index])
    image = setup.anchor.batches[0]
    measured = image + setup.sigma * rng.standard_normal(image.shape)
    start = truth @ se3.exp(
        np.concatenate(
            [
                settings["perturb_trans"] * _in_ball(rng),
                np.radians(settings["perturb_deg"]) * _in_ball(rng),
            ]
        )
    )
    options: MeasurementKeywords = {
        **setup.options,
        "pose": start,
        "seed": int(rng.integers(1 << 62)),
        "pixels": np.isfinite(image).all(axis=2),
    }
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = align(
                scene,
                measured,
                Gaussian(setup.sigma),
                estimator=settings["estimator"],
                levels=settings["levels"],
                iterations=settings["iterations"],
                anchor=setup.anchor,
                **options,
            )
    except OutOfViewError:
        # The start was drawn behind a wall, say. Its residual is that of a black image.
        error = se3.log(se3.inverse(truth) @ start)
        residual = float(np.sqrt(np.nanmean((measured / setup.sigma) ** 2)))
        return Trial(index, "diverged", tuple(error.tolist()), residual, 0, 0.0, (0.0,) * 21, 0)
    error = se3.log(se3.inverse(truth) @ found.pose)
    return Trial(
        index=index,
        status=found.status,
        error=tuple(error.tolist()),
        residual=found.residual,
        iterations=found.iterations,
        excess=found.excess,
        added=tuple(pack(found.added).tolist()),
        invalid=found.invalid,
    )


def _in_ball(rng: np.random.Generator) -> Array:
    direction = rng.standard_normal(3)
    return np.asarray(direction / np.linalg.norm(direction) * rng.uniform() ** (1.0 / 3.0))
