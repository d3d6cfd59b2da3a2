"""From a scene to its Hammersley–Chapman–Robbins bound: the image rendered at displaced poses.

Each batch renders the image at the pose and at all displaced ones with the same random numbers, so that what
does not change cancels, and with numbers of its own, so that products of different batches are without bias:
the squared distance of an image to itself is zero on average, not the Monte Carlo noise's power. The changes
δ_i stand beside the Jacobian's columns, and one Gram matrix [J δ]ᵀ Σ⁻¹ [J δ] holds F, B and A (`hcr`).
"""

from __future__ import annotations

from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import se3
from ..bound.hcr import HCRBound, axis_displacements, hammersley_chapman_robbins
from ..errors import NoiseError, OptionError, RadianceError
from ..information.accumulate import InformationAccumulator
from ..information.linearisation import PixelSelection
from ..information.ustatistic import gram, square_root, whiten
from ..noise import Clipped, Gaussian, NoiseModel, PerChannel, PerPixel
from ..render.lending import in_turn
from ..se3 import Array
from .measurement import Measurement, measurement
from .options import DISPLACING, MeasurementKeywords

MOTIONS_PIXELS = (0.5, 2.0, 8.0, 32.0, 128.0)
"""Image motions of the default displacements, up to half of the image's width [pixel]."""

FLOAT32_RADIANCE = 1e-6
"""Relative changes of the radiance that float32 rendering does not resolve."""

_PURPOSE = 0x48435242


@in_turn
def hcr_bound(
    scene: Any,
    noise: NoiseModel | None = None,
    *,
    displacements: ArrayLike | None = None,
    **options: Unpack[MeasurementKeywords],
) -> HCRBound:
    """The Hammersley–Chapman–Robbins bound on the camera's pose, which sees repetition; one render each.

    Args:
        scene: as for `pose_bound`.
        noise: Gaussian noise that the image does not change; None as for `pose_bound`. What is clipped at the
            pose is left out at the displaced ones, too, as by an estimator that has masked it.
        displacements: (m, 6), camera-frame twists; None: both ways along and about the camera's axes, by
            `MOTIONS_PIXELS`. A repetition is found only if one of them meets it, and not in a random subset
            of the pixels, from which the others may differ.
        options: see `MeasurementOptions`.

    Raises:
        OptionError: displacements of the wrong shape, not finite, or zero.
        NoiseError: noise that is not Gaussian with fixed variances of independent pixels.
        MitsubaCRBError: as `pose_bound`.
    """
    options = {**DISPLACING, **options}
    with measurement(scene, **options) as run:
        xi = _default(run) if displacements is None else _checked(displacements)
        model, _ = run.noise(noise)
        if not isinstance(model, Clipped | Gaussian | PerChannel | PerPixel):
            raise NoiseError(
                f"finite displacements need Gaussian noise with fixed variances, not {type(model).__name__}"
            )
        run.warn_of_limits()
        sampled = run.selection.kind == "random"
        local = InformationAccumulator(batches=run.options.batches, block=run.block, sampled=sampled)
        sums = _Sums(run.options.batches, len(xi), sampled)
        for part, weights in run.weighted_tiles(model):
            local.add(part.batch_values, weights, part.pixels, part.bias)
            sums.add(part.batch_values, _changes(run, part.pixels, xi), part.mean, weights, part.pixels)
        information = local.information(run.linearisation)
        inner, cross, errors, floor = sums.result(run.selection)
    return hammersley_chapman_robbins(information, xi, inner, cross, standard_error=errors, floor=floor)


class _Sums:
    """A and B by the products of different batches, and the standard errors of A's diagonal."""

    def __init__(self, batches: int, count: int, sampled: bool) -> None:
        self._batches = batches
        self._gram = np.zeros((6 + count, 6 + count))
        self._power = 0.0
        self._diagonal = [
            InformationAccumulator(batches=batches, sampled=sampled, columns=1) for _ in range(count)
        ]

    def add(
        self, jacobian: Array, changes: Array, mean: Array, weights: Array, pixels: NDArray[np.integer]
    ) -> None:
        """Add pixels: J (K, n, C, 6), δ (K, n, C, m), the image (n, C), and inverse variances (n, C)."""
        K = self._batches
        columns = np.concatenate([jacobian, changes], axis=-1)
        whitened = whiten(columns, square_root(weights)).mT
        each = gram(whitened).sum(axis=1)
        self._gram += (gram(whitened.sum(axis=1)) - each).sum(axis=0) / (K * (K - 1))
        self._power += float(np.sum(weights * mean**2))
        for i, accumulator in enumerate(self._diagonal):
            accumulator.add(changes[..., i : i + 1], weights, pixels)

    def result(self, selection: PixelSelection) -> tuple[Array, Array, Array, float]:
        """A (m, m), B (m, 6), standard errors (m,), and the distance that float32 does not resolve."""
        factor = selection.total / selection.selected if selection.kind == "random" else 1.0
        variances = [a.sums(selection).covariance_of_entries[0, 0] for a in self._diagonal]
        errors = np.sqrt(np.maximum(variances, 0.0))
        products = factor * self._gram
        return products[6:, 6:], products[6:, :6], errors, FLOAT32_RADIANCE**2 * factor * self._power


def _changes(run: Measurement, pixels: NDArray[np.int64], xi: Array) -> Array:
    """δ (K, n, 3, m), each batch with its own random numbers, the same for all poses."""
    here = run.render(pixels, _PURPOSE)
    poses = [run.view.pose @ se3.exp(x) for x in xi]
    changes = np.stack([run.render(pixels, _PURPOSE, pose=pose) - here for pose in poses], axis=-1)
    if not np.isfinite(changes).all():
        raise RadianceError("a displaced image has radiance that is NaN or infinite; mend the scene there")
    return changes


def _default(run: Measurement) -> Array:
    widest = max(0.5 * run.view.size[0], MOTIONS_PIXELS[0])
    motions = [motion for motion in MOTIONS_PIXELS if motion <= widest]
    return axis_displacements(motions, run.view.camera, run.length_scale)


def _checked(displacements: ArrayLike) -> Array:
    try:
        xi = np.array(displacements, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise OptionError(f"displacements are rows of six numbers: {error}") from None
    if xi.ndim != 2 or xi.shape[1] != 6 or len(xi) == 0:
        raise OptionError(f"displacements must have shape (m, 6), one twist a row, not {xi.shape}")
    if not np.isfinite(xi).all() or not xi.any(axis=1).all():
        raise OptionError("a displacement must be finite and not zero: the pose itself is always included")
    return xi
