"""How many paths trials need, before they start: until the renderer's part of their errors is small.

A pilot measures the truth with few paths, and displaces the pose by twists drawn from the bound, as if an
estimate had ended there: what Ĵ's and R̂'s noise adds to an estimate's covariance there (`misfit`) falls as
the paths, and F̂'s error as their root, whence the number that the trials need. All this has random numbers
of its own: the trials' results know of the pilot nothing but that number.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from .. import se3
from ..errors import TrialError
from ..information.image_information import fisher_information
from ..measure.measurement import measurement
from ..measure.opening import kind_of
from ..measure.options import MeasurementKeywords, MeasurementOptions
from ..noise import Gaussian
from ..render.lending import in_turn
from .misfit import Misfit
from .renderer_part import SMALL, times_for, uncertainty, whitening
from .truth import TIMES, Truth, truth_of

_PILOT = 0x50494C4F54000000
"""Added to the seed, modulo 2^64."""
_DRAWS = 24
"""Displacements, each by random numbers of its own: they know what is added to 10 or 15 %."""
_TRUTH = 1 << 24
"""Most paths of the expected image, in all, by default."""
_FEWEST_MOST = 256
"""The least that `max_spp` is by default."""
_MARGIN = 0.7
"""The pilot's aim, over the limit: it is not exact, and what is added lets errors end further away."""


def settled(scene: Any, sigma: float | None, options: MeasurementKeywords) -> MeasurementKeywords:
    """The trials' options, with as many paths per pixel as make the renderer's part small, or as allowed.

    Args:
        scene: loaded.
        sigma: standard deviation of the pixel noise [radiance]; None is that of the default camera.
        options: of the trials' renders, without `spp`; `precision` is the part to get below (`SMALL`), and
            `max_spp` the most paths per pixel (`_most`).

    Raises:
        MitsubaCRBError: as `pose_jacobian`.
    """
    given = MeasurementOptions(**options)
    limit = SMALL if given.precision is None else given.precision
    fixed: MeasurementKeywords = {**options, "precision": None, "max_spp": None}
    if kind_of(scene).deterministic:
        return {**fixed, "spp": given.uniform_spp}
    pilot: MeasurementKeywords = {**fixed, "seed": (given.seed + _PILOT) % (1 << 64)}
    spp, most = given.uniform_spp, given.max_spp
    while most is None or spp < most:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the trials' truth says the same
            truth = truth_of(scene, sigma, {**pilot, "spp": spp})
            most = _most(len(truth.jacobian.pixels)) if most is None else most
            try:
                excess, u = _foretold(scene, truth, {**pilot, "spp": spp})
            except TrialError:  # so few paths' noise hides a direction
                spp *= 4
                continue
        spp *= times_for(excess, u, _MARGIN * limit)
        break
    return {**fixed, "spp": min(spp, most - most % given.batches)}


def _most(pixels: int) -> int:
    """Default of `max_spp`: trials take some ten renders each."""
    return max(_FEWEST_MOST, _TRUTH // (TIMES * pixels))


@in_turn
def _foretold(scene: Any, truth: Truth, options: MeasurementKeywords) -> tuple[float, float]:
    """Excess among the bound's errors, and F̂'s error; see `renderer_part.RendererPart`."""
    image, noise, pose = truth.anchor.batches[0], Gaussian(truth.sigma), truth.anchor.pose
    information = fisher_information(truth.jacobian, noise)
    inverse = whitening(information)[1]
    rng = np.random.default_rng(options["seed"])
    own: MeasurementKeywords = {**options, "pixels": np.isfinite(image).all(axis=2)}
    excess = []
    with measurement(scene, **own) as run:
        for twist in rng.standard_normal((_DRAWS, 6)) @ inverse.T:
            here = run.at(run.view.pose, seed=int(rng.integers(1 << 62)))
            misfit = Misfit(here.only(), image, noise, truth.anchor)
            difference = misfit.difference(pose @ se3.exp(twist))
            excess.append(misfit.excess(difference, information.matrix))
    return float(np.mean(excess)), uncertainty(information)
