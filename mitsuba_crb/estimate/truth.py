"""The truth of all trials: the expected image there, its Jacobian, and the noise."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..errors import TrialError
from ..information.image_jacobian import ImageJacobian
from ..information.subset import selected
from ..jacobian.method import Paths
from ..measure.measurement import measurement
from ..measure.options import MeasurementKeywords, MeasurementOptions
from ..noise import Gaussian
from ..render.lending import in_turn
from .misfit import Anchor

TIMES = 16
"""Paths per pixel of the expected image and its Jacobian, over those of a trial's renders."""
_EXPECTED = 0x45585045
"""Purpose of the random numbers of the expected image."""


class Truth(NamedTuple):
    """What trials start from."""

    anchor: Anchor
    """The pose, and the expected image and the Jacobian there."""
    jacobian: ImageJacobian
    """The anchor's."""
    sigma: float
    """Standard deviation of the pixel noise [radiance]."""
    names: dict[str, str | None]
    """What scene and integrator are called; a field has no integrator."""


@in_turn
def truth_of(scene: Any, sigma: float | None, options: MeasurementKeywords) -> Truth:
    """Measure it, with 16 times the paths of the trials' renders.

    Args:
        scene: as `measurement` takes it.
        sigma: standard deviation of the pixel noise [radiance]; None is that of the default camera.
        options: of the trials' renders.

    Raises:
        TrialError: the camera does not measure colour.
        MitsubaCRBError: as `pose_jacobian`.
    """
    many: MeasurementKeywords = {**options, "spp": TIMES * MeasurementOptions(**options).uniform_spp}
    with measurement(scene, **many) as run:
        run = run.only()
        if not run.view.measured.is_colour:
            raise TrialError(
                f"the camera measures {run.view.measured.name} alone; trials need rgb, of the film "
                "(pixel_format) and of --channels"
            )
        model = Gaussian(run.exposure.sigma if sigma is None else sigma)
        if sigma is not None:
            run.noise(model)  # refuses what does not go with it
        run.warn_of_limits()
        image = np.full((1, *run.mask.shape, 3), np.nan)
        one = Paths(run.options.uniform_spp, run.options.seed, 1)
        image[0, run.mask] = run.render(selected(run.mask), _EXPECTED, paths=one)[0]
        jacobian = run.jacobian()
        valid = np.isfinite(image[0]).all(axis=2) & np.isfinite(jacobian.image).all(axis=2)
        invalid = int((run.mask & ~valid).sum())
        run.check_valid(invalid, run.selection.selected)
        if invalid:
            image[0, ~valid] = np.nan
            jacobian = jacobian.only(valid, f"{run.selection.description}, where the radiance is finite")
        names = {"scene": run.view.label, "integrator": run.view.provenance().get("integrator")}
        return Truth(Anchor(run.view.pose, image, jacobian), jacobian, model.sigma, names)
