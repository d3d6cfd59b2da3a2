"""The covariance of an estimate by a model that is wrong: a sandwich.

An estimator that weighs residuals by W ends where JᵀW r = 0. If they have the covariance S, and not Σ = W⁻¹,
the estimate's is to first order

    C = F⁻¹ M F⁻¹,   F = JᵀWJ,   M = JᵀW S W J,

which is F⁻¹, the bound, for S = Σ alone. Photographs differ from a model of the scene by more than a camera's
noise: by the map's errors, which are alike over many pixels, so that there is less to average over than white
residuals of the same size would tell. C is no bound: it is what this estimator gets with this map.

S is that of other images, at their given poses (`noise.residuals`). At an aligned view's own pose JᵀW r = 0:
its r rᵀ in the place of S would say that nothing is uncertain.

Estimates of J with independent errors, J_1 .. J_K, enter M as they enter F, by products of different
batches: M is the information of the columns W J_k with S in the place of Σ⁻¹, and comes from the same sums
(`information.accumulate`), standard errors included. Nuisances are eliminated beforehand
(`information.joint`).

Reference: White, "Maximum likelihood estimation of misspecified models", 1982, theorem 3.2.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..errors import OptionError
from ..files import Record
from ..information.accumulate import InformationAccumulator
from ..information.fisher import FisherInformation
from ..information.image_information import as_noise_model
from ..information.image_jacobian import ImageJacobian
from ..information.joint import joint_information
from ..information.symmetric import pack
from ..noise import CoupledNoise, NoiseModel
from ..noise.covariance import nearest_semidefinite
from ..noise.residuals import ResidualCovariance
from ..se3 import Array
from .cramer_rao import TURN, PoseBound, joint_bound, position_functionals, twist_functionals


@dataclass(frozen=True, eq=False)
class MisspecifiedCovariance(Record):
    """What an estimator that takes residuals for white gets where they are not; beside it the ideal bound."""

    ideal: PoseBound
    """F⁻¹: if the map had no error, and the noise were the one that the estimator assumes."""
    covariance: Array
    """(6, 6), F⁻¹ M F⁻¹ in the frame of `ideal`, `inf` and `nan` as there."""
    position_std: Array
    """(3,), the camera centre's along the world's axes [scene unit]."""
    position_std_standard_error: Array
    """(3,), their Monte Carlo standard errors [scene unit]; that of S is not in them."""
    rotation_std_deg: Array
    """(3,), about the camera's own axes: pitch x, yaw y, roll z [deg]."""
    rotation_std_deg_standard_error: Array
    """(3,), their Monte Carlo standard errors [deg]."""
    middle: FisherInformation = field(repr=False)
    """M, in the camera frame, the nuisances eliminated; an unbiased estimate."""
    residuals: str
    """What S is, in words."""

    @property
    def ratios(self) -> Array:
        """(6,), of position and rotation: standard deviations over the ideal ones; `nan` where unseen."""
        ideal = np.concatenate([self.ideal.position_std, self.ideal.rotation_std_deg])
        with np.errstate(invalid="ignore"):
            return np.asarray(np.concatenate([self.position_std, self.rotation_std_deg]) / ideal)

    @property
    def gap(self) -> str:
        """What the two say of the map, in a sentence."""
        ratios = self.ratios[np.isfinite(self.ratios)]
        if not ratios.size:
            return "nothing of the pose is seen, so that there is no gap to tell"
        low, high = ratios.min(), ratios.max()
        times = f"misspecified deviations are {low:.2g} to {high:.2g} times the ideal ones"
        if low > 1.1:
            return f"{times}: the map's error, residuals that are larger than noise or alike over pixels"
        if high < 0.9:
            return f"{times}: residuals of other views are smaller than the assumed noise"
        return f"{times}: residuals of other views are like the assumed noise"

    def __str__(self) -> str:
        def numbers(names: str, values: Array) -> str:
            return ", ".join(f"{name} {value:.3g}" for name, value in zip(names.split(), values, strict=True))

        return "\n".join(
            (
                f"position std  {numbers('x y z', self.position_std)} [scene unit], world axes",
                f"     if ideal {numbers('x y z', self.ideal.position_std)}",
                f"rotation std  {numbers('pitch yaw roll', self.rotation_std_deg)} [deg], camera axes",
                f"     if ideal {numbers('pitch yaw roll', self.ideal.rotation_std_deg)}",
                f"residuals     {self.residuals}",
                f"gap           {self.gap}",
            )
        )


def misspecified_covariance(
    jacobian: ImageJacobian, noise: NoiseModel, residuals: ResidualCovariance
) -> MisspecifiedCovariance:
    """F⁻¹ (JᵀW S W J) F⁻¹ of a pose, its nuisances unknown, in the Jacobian's frame.

    Args:
        jacobian: of the image that the pose is estimated from, in the residuals' unit, with columns of what
            else is estimated.
        noise: what the estimator assumes, W = Σ⁻¹.
        residuals: S, of other images.

    Raises:
        OptionError: a random subset stands for the whole image, or nuisances have a value per tile: neither
            tells what correlated residuals do.
        NoiseError: the noise or the residuals do not fit the image.
        RadianceError: the Jacobian is not finite somewhere.

    Warns:
        PrecisionWarning: as `joint_bound`.
    """
    if jacobian.selection.kind == "random":
        raise OptionError(
            "a random subset of the pixels does not tell what correlated residuals do; give all"
        )
    camera = jacobian.to_frame("camera")
    joint = joint_information(camera, as_noise_model(noise)).marginalize()
    if joint.per_tile:
        raise OptionError(f"correlated residuals span the tiles of {', '.join(joint.per_tile)}; leave it out")
    ideal = joint_bound(joint)
    accumulator = InformationAccumulator(batches=len(camera.batch_values), block=camera.block, coupled=True)
    weighed = _weighed(camera.batch_values @ joint.elimination, camera, noise)
    accumulator.add_coupled(weighed, _InPlaceOfPrecision(residuals), camera.pixels)
    middle = accumulator.information(camera.linearisation)
    return _sandwich(ideal.to_frame(jacobian.frame), middle, residuals.description)


def _sandwich(ideal: PoseBound, middle: FisherInformation, residuals: str) -> MisspecifiedCovariance:
    inverse, scale = ideal.inverse, middle.scale
    # Its errors may leave M a negative eigenvalue, and no variance is negative.
    M = nearest_semidefinite(scale[:, None] * middle.matrix * scale) / scale[:, None] / scale

    def spread(functionals: Array) -> tuple[Array, Array]:
        """Covariance of linear functionals of the pose, and the standard errors of their deviations."""
        b = inverse.sensitivity(functionals)[0]
        covariance = b @ M @ b.T
        # δ(aᵀCa) = bᵀ δM b − 2 bᵀ δF d, d = F⁻¹ M b, as if the two errors were independent.
        d = inverse.sensitivity(b @ M * scale)[0]
        of_M = _error_of_form(b, b, middle.covariance_of_entries)
        of_F = 2.0 * _error_of_form(b, d, ideal.inverse.total.covariance_of_entries)
        unseen = inverse.kinds(functionals)[1]
        covariance[unseen] = covariance[:, unseen] = np.nan
        covariance[unseen, unseen] = np.inf
        with np.errstate(invalid="ignore", divide="ignore"):
            return covariance, np.hypot(of_M, of_F) / (2.0 * np.sqrt(np.diagonal(covariance)))

    position, position_error = spread(position_functionals(inverse))
    rotation, rotation_error = spread(TURN)
    return MisspecifiedCovariance(
        ideal=ideal,
        covariance=spread(twist_functionals(inverse, ideal.frame))[0],
        position_std=np.sqrt(np.diagonal(position)),
        position_std_standard_error=position_error,
        rotation_std_deg=np.sqrt(np.diagonal(rotation)),
        rotation_std_deg_standard_error=rotation_error,
        middle=middle,
        residuals=residuals,
    )


def _error_of_form(left: Array, right: Array, covariance_of_entries: Array) -> Array:
    """(m,) standard errors of lᵀ A r for vectors l and r (m, 6) and a symmetric A."""
    products = 0.5 * (left[:, :, None] * right[:, None, :] + right[:, :, None] * left[:, None, :])
    gradient = pack(products) * pack(2.0 - np.eye(6))
    variance = np.einsum("mi,ij,mj->m", gradient, covariance_of_entries, gradient)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _weighed(values: Array, jacobian: ImageJacobian, noise: NoiseModel) -> Array:
    """W J_k (K, n, C, 6)."""
    if isinstance(noise, CoupledNoise):
        K, n, C, P = values.shape
        columns = values.transpose(1, 2, 0, 3).reshape(n, C, K * P)
        solved = noise.solve(jacobian.pixels, columns).reshape(n, C, K, P)
        return np.asarray(solved.transpose(2, 0, 1, 3))
    weights = noise.weights(jacobian.pixels, jacobian.expected)
    if weights.ndim == 2:
        return np.asarray(weights[..., None] * values)
    return np.asarray(np.einsum("nij,knjp->knip", weights, values))


@dataclass(frozen=True)
class _InPlaceOfPrecision:
    """S as what an accumulator takes for Σ⁻¹."""

    residuals: ResidualCovariance

    def solve(self, pixels: NDArray[np.integer], values: Array) -> Array:
        return self.residuals.times(pixels, values)
