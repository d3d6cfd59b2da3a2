"""Van Trees' bound: the information averaged over a prior, for estimators that may be biased.

With x = x̄ exp(η), x̄ the prior's mean and η ~ N(0, P⁻¹) in the camera frame, any estimator of η obeys

    E[(η̂ − η)(η̂ − η)ᵀ] ⪰ (E_prior[F_η(η)] + P)⁻¹,   F_η(η) = J_r(η)ᵀ F(x) J_r(η),

F(x) the information of the camera-frame twist at x and J_r the right Jacobian of SE(3), which brings it to
the tangent of the mean: exp(η + δ) = exp(η) exp(J_r(η) δ) to first order. The expectation is a mean over
poses drawn from the prior; their spread gives its standard errors, noise of the renders included.

Source: van Trees, "Detection, Estimation, and Modulation Theory", part I, 1968, section 2.4.3;
Solà, Deray and Atchuthan 2018 for J_r.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm

from .. import se3
from ..bound.cramer_rao import PoseBound, cramer_rao_bound
from ..bound.prior import PosePrior
from ..errors import PriorError
from ..information.fisher import FisherInformation
from ..information.symmetric import pack
from ..noise import NoiseModel
from ..noise.covariance import ROUNDING, roots
from ..render.lending import in_turn
from ..se3 import Array
from .exposure import noise_facts
from .measurement import measurement
from .options import MeasurementKeywords


@in_turn
def van_trees(
    scene: Any,
    noise: NoiseModel | None,
    prior: PosePrior,
    *,
    draws: int = 32,
    **options: Unpack[MeasurementKeywords],
) -> PoseBound:
    """The van Trees bound on the camera's pose, in the camera frame at the prior's mean.

    Args:
        scene: as for `pose_bound`; its camera, or `pose`, is the mean.
        noise: as in `pose_bound`; the default follows from the image at the mean.
        prior: positive definite.
        draws: poses drawn from the prior, at least two; each is measured with `spp` paths per pixel.
        options: see `MeasurementOptions`.

    Raises:
        PriorError: the prior leaves a direction open, so that no poses can be drawn, or too few draws.
        MitsubaCRBError: as `pose_bound`.
    """
    if draws < 2:
        raise PriorError(f"the average over the prior needs at least two draws, not {draws}")
    with measurement(scene, **options) as run:
        model, origin = run.noise(noise)
        run.warn_of_limits()
        offsets = _draw(prior.in_frame("camera", run.view.pose), draws, run.options.seed)
        seed = run.options.seed
        informations = [
            run.at(run.view.pose @ se3.exp(offset), seed=seed + number).information(model)
            for number, offset in enumerate(offsets, start=1)
        ]
        bound = cramer_rao_bound(prior_average(informations, offsets, run.view.pose), prior=prior)
        provenance = {
            **run.provenance(),
            "noise": noise_facts(model, origin, run.view.measured, run.saturation),
            "draws": draws,
        }
    return dataclasses.replace(bound, provenance=provenance)


def prior_average(
    informations: Sequence[FisherInformation], offsets: ArrayLike, mean_pose: ArrayLike
) -> FisherInformation:
    """The mean of informations at poses mean_pose exp(η), brought to the tangent of the mean.

    Args:
        informations: at least two, of the camera-frame twist.
        offsets: (n, 6), η of each.
        mean_pose: world_from_camera, 4 x 4.
    """
    moved = []
    for information, offset in zip(informations, np.asarray(offsets), strict=True):
        J = right_jacobian(offset)
        moved.append(J.T @ information.to_frame("camera").matrix @ J)
    spread = np.cov(pack(np.array(moved)), rowvar=False) / len(moved)
    return dataclasses.replace(
        informations[0].to_frame("camera"),
        matrix=np.mean(moved, axis=0),
        covariance_of_entries=spread,
        plain_matrix=None,
    ).about(pose=mean_pose)


def right_jacobian(twist: ArrayLike) -> Array:
    """J_r(η) = ∫₀¹ exp(−s ad(η)) ds, (6, 6): exp(η + δ) = exp(η) exp(J_r(η) δ) to first order."""
    rho, phi = np.split(np.asarray(twist, dtype=np.float64), 2)
    ad = np.block([[se3.skew(phi), se3.skew(rho)], [np.zeros((3, 3)), se3.skew(phi)]])
    # The integral is a block of the exponential of a larger matrix.
    integral = expm(np.block([[-ad, np.eye(6)], [np.zeros((6, 12))]]))
    return np.asarray(integral[:6, 6:], dtype=np.float64)


def _draw(information: Array, draws: int, seed: int) -> Array:
    """(draws, 6) of N(0, P⁻¹)."""
    _, inverse = roots(information, ROUNDING)
    if inverse.shape[1] < 6:
        raise PriorError(
            "no poses can be drawn from a prior that leaves a direction open; give six finite deviations"
        )
    normals = np.random.default_rng([seed, 1968]).standard_normal((draws, 6))
    return np.asarray(normals @ inverse.T, dtype=np.float64)
