"""The information of a whole image, held as its Jacobian: summed up by one accumulator under one noise model.

F = JᵀΣ⁻¹J, as `accumulate` estimates it without bias.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import NoiseError, OptionError
from ..noise import CoupledNoise, NoiseModel
from ..noise.pilot import pilot_weights
from .accumulate import InformationAccumulator
from .fisher import FisherInformation
from .image_jacobian import ImageJacobian


class Accumulator(Protocol):
    """What sums up the information of pixels: of a pose alone, or jointly with nuisance parameters."""

    def add(
        self,
        batch_values: ArrayLike,
        weights: ArrayLike,
        pixels: ArrayLike,
        bias: NDArray[np.float64] | None = None,
        weight_bias: NDArray[np.float64] | None = None,
    ) -> None:
        """See `InformationAccumulator.add`."""

    def add_coupled(
        self,
        batch_values: ArrayLike,
        noise: CoupledNoise,
        pixels: ArrayLike,
        bias: NDArray[np.float64] | None = None,
    ) -> None:
        """See `InformationAccumulator.add_coupled`."""


def sum_image(
    accumulator: Accumulator, jacobian: ImageJacobian, noise: NoiseModel, mean: ArrayLike | None = None
) -> None:
    """Add a whole Jacobian under a noise model of either kind.

    Args:
        accumulator: of as many columns, and made for coupled pixels if the noise's are.
        jacobian: of the whole image, or of the selected pixels.
        noise: independent or correlated between pixels.
        mean: (H, W, C) noise-free image for models that depend on it, rendered with other random numbers than
            the Jacobian; by default the Jacobian's pilot. A Jacobian without one should have an image free of
            errors: those that its derivatives share can make the information several times too large.

    Raises:
        NoiseError: the noise model does not fit the image.
        RadianceError: the Jacobian is not finite somewhere.
    """
    noise.check(*jacobian.image.shape)
    if isinstance(noise, CoupledNoise):
        accumulator.add_coupled(jacobian.batch_values, noise, jacobian.pixels, jacobian.bias)
        return
    if mean is not None:
        jacobian = replace(jacobian, pilot=np.asarray(mean, dtype=np.float64))
    if jacobian.pilot is not None and jacobian.pilot.shape != jacobian.image.shape:
        raise NoiseError(
            f"the mean has shape {jacobian.pilot.shape}, but the image is {jacobian.image.shape}"
        )
    weights, weight_bias = pilot_weights(
        noise, jacobian.pixels, jacobian.expected, jacobian.expected_error if mean is None else None
    )
    accumulator.add(jacobian.batch_values, weights, jacobian.pixels, jacobian.bias, weight_bias)


def as_noise_model(noise: object) -> NoiseModel:
    """The object itself, if it has what a noise model must have.

    Raises:
        NoiseError: it has not.
    """
    if not isinstance(noise, NoiseModel):
        raise NoiseError(f"expected a noise model such as noise.Gaussian(0.01), not {noise!r}")
    return noise


def fisher_information(
    jacobian: ImageJacobian, noise: NoiseModel, mean: ArrayLike | None = None
) -> FisherInformation:
    """The Fisher information F = JᵀΣ⁻¹J of the pose, estimated without bias, in the Jacobian's frame.

    Args:
        jacobian: the image's derivative.
        noise: noise model of the measured image.
        mean: see `sum_image`.

    Raises:
        NoiseError: the noise model does not fit the image.
        RadianceError: the Jacobian is not finite somewhere.
        OptionError: the Jacobian has columns of nuisance parameters, see `joint.joint_information`.
    """
    if jacobian.parameters:
        raise OptionError(
            f"the Jacobian has columns of nuisance parameters ({', '.join(jacobian.parameters)}): use "
            "joint_information, which can marginalize them"
        )
    camera = jacobian.to_frame("camera")
    accumulator = InformationAccumulator(
        batches=len(camera.batch_values),
        block=camera.block,
        sampled=camera.selection.kind == "random",
        coupled=as_noise_model(noise).couples_pixels,
    )
    sum_image(accumulator, camera, noise, mean)
    return accumulator.information(camera.linearisation).to_frame(jacobian.frame)
