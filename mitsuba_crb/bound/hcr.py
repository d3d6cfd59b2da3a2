"""Beyond the local bound: Hammersley, Chapman and Robbins over finite displacements of the camera.

Let p₀ be the image's distribution at the pose and p_i at the pose displaced by ξ_i, with Gaussian noise Σ and
the change δ_i = μ_i − μ₀ of the noise-free image. Let y be the centre–rotation coordinates of the pose, which
the displacement changes by Δ_i. If an estimator ŷ is unbiased at all these poses, then p_i/p₀ − 1 and
the score s = JᵀΣ⁻¹(I − μ₀) have with it the covariances Δ_i and 1, and among themselves

    E[s sᵀ] = F,    E[s (p_i/p₀ − 1)] = B_i = JᵀΣ⁻¹δ_i,    E[(p_i/p₀ − 1)(p_j/p₀ − 1)] = G_ij = exp(A_ij) − 1,

A_ij = δ_iᵀΣ⁻¹δ_j. Cauchy–Schwarz gives Cov(ŷ) ⪰ [1 Δ] [[F, B], [Bᵀ, G]]⁻¹ [1 Δ]ᵀ, and by Schur's complement

    Cov(ŷ) ⪰ F⁻¹ + R S⁻¹ Rᵀ,    R = Δ − F⁻¹B,    S = G − BᵀF⁻¹B ⪰ 0,

never below the Cramér–Rao bound, and equal to it where the image is linear in the displacement. Without the
score (F⁻¹ = 0) it is Δ G⁻¹ Δᵀ. Both grow with the set of displacements. Rows and columns of S are scaled by
exp(−A_ii / 2), which keeps all of its entries at most 1: G_ij becomes exp(−½‖δ_i − δ_j‖²) − exp(−½(‖δ_i‖² +
‖δ_j‖²)), and no distance overflows.

References: Hammersley 1950; Chapman and Robbins, "Minimum variance estimation without regularity
assumptions", 1951; Abel, "A bound on mean-square-estimate error", 1993 (both kinds of functions together).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import se3
from ..camera import Camera
from ..errors import OptionError
from ..files import Record
from ..information.fisher import FisherInformation
from ..information.identifiability import SMALLEST_SHARE
from ..se3 import Array
from .cramer_rao import PoseBound, cramer_rao_bound

QUANTILE = 2.33
"""Standard errors of a squared distance below which a displaced image counts as the same (99 %)."""

_SINGULAR = 1e-10


@dataclass(frozen=True, eq=False)
class HCRBound(Record):
    """Lower bounds on the errors of every estimator that is unbiased at the pose and at displaced ones."""

    position_std: Array
    """(3,), of the camera centre along the world's axes [scene unit]; `inf` where the image repeats."""
    rotation_std_deg: Array
    """(3,), of the rotation vector about the camera's own axes: pitch x, yaw y, roll z [deg]."""
    covariance: Array
    """(6, 6), of the camera centre (world axes) and the rotation vector [rad]; `inf`, `nan` as elsewhere."""
    cramer_rao: PoseBound
    """The local bound, which this one contains."""
    displacements: Array
    """(m, 6), the camera-frame twists ξ_i of the displaced poses."""
    squared_distances: Array
    """(m,), δ_iᵀΣ⁻¹δ_i, estimates without bias: the deflection, in noise standard deviations squared."""
    squared_distances_standard_error: Array
    """(m,), their Monte Carlo standard errors."""
    repeats: NDArray[np.bool_]
    """(m,), the displaced images that cannot be told from the image, though the local information could."""

    def __str__(self) -> str:
        local = self.cramer_rao
        rows = (
            ("position std", self.position_std, "[scene unit], world axes"),
            ("  locally", local.position_std, ""),
            ("rotation std", self.rotation_std_deg, "[deg], camera axes"),
            ("  locally", local.rotation_std_deg, ""),
        )
        lines = [
            f"{n:12s}  {', '.join(f'{v:.3g}' for v in values)} {unit}".rstrip() for n, values, unit in rows
        ]
        lines.append(f"{int(self.repeats.sum())} of {len(self.repeats)} displaced images repeat the image")
        return "\n".join(lines)


def hammersley_chapman_robbins(
    information: FisherInformation,
    displacements: ArrayLike,
    inner: ArrayLike,
    cross: ArrayLike,
    *,
    standard_error: ArrayLike = 0.0,
    floor: float = 0.0,
) -> HCRBound:
    """The bound F⁻¹ + R S⁻¹ Rᵀ over a set of displacements, for Gaussian noise that the pose does not change.

    S is enlarged by three standard errors and its null directions are left out, so that Monte Carlo noise
    makes the bound smaller, not larger. A coordinate is infinite where the local bound is, and where it
    changes along a displacement whose image is the same: its squared distance is below `QUANTILE` standard
    errors plus the floor, where F would have it above. A random subset of the pixels cannot show that: the
    displacement is left out then.

    Args:
        information: of the pose, without a prior.
        displacements: (m, 6), camera-frame twists ξ_i: the displaced pose is world_from_camera @ exp(ξ_i).
        inner: (m, m), A_ij = δ_iᵀΣ⁻¹δ_j, that is ½ (d_i² + d_j² − d_ij²) of squared distances d².
        cross: (m, 6), δ_iᵀΣ⁻¹J, J with respect to the camera-frame twist.
        standard_error: (m,) or a number, of the diagonal of `inner`.
        floor: squared distance that float32 rendering cannot tell from zero.

    Raises:
        OptionError: shapes do not fit, or a displacement is zero.
    """
    xi, A, B = (np.asarray(value, dtype=np.float64) for value in (displacements, inner, cross))
    m = len(xi)
    if xi.shape != (m, 6) or A.shape != (m, m) or B.shape != (m, 6):
        raise OptionError(
            f"displacements {xi.shape}, inner {A.shape} and cross {B.shape} must have shapes "
            "(m, 6), (m, m) and (m, 6)"
        )
    if not np.isfinite(xi).all() or not xi.any(axis=1).all():
        raise OptionError("a displacement must be finite and not zero: the pose itself is always included")
    errors = np.broadcast_to(np.asarray(standard_error, dtype=np.float64), m)
    local = cramer_rao_bound(information)
    inverse = local.inverse
    pose, scale = inverse.total.pose, inverse.scale
    U = inverse.identifiability.seen
    seen_inverse = (U / inverse.identifiability.eigenvalues[: U.shape[1]]) @ U.T
    change = _centre_rotation(pose, xi) / scale
    cross_scaled = B * scale
    expected = np.einsum("mi,ij,mj->m", xi / scale, inverse.precision, xi / scale)
    threshold = QUANTILE * errors + floor
    distances = np.diagonal(A).copy()
    certain = information.selection.kind != "random"
    repeats = (distances <= threshold) & (expected > threshold) & certain
    used = distances > threshold
    excess = _excess(
        (change - cross_scaled @ seen_inverse)[used],
        A[np.ix_(used, used)],
        cross_scaled[used] @ seen_inverse @ cross_scaled[used].T,
        errors[used],
    )
    functionals = np.block(
        [[pose[:3, :3] * inverse.length_scale, np.zeros((3, 3))], [np.zeros((3, 3)), np.eye(3)]]
    )
    added = functionals @ excess @ functionals.T
    covariance = inverse.covariance(functionals) + added
    repeated = _changes(functionals, change[repeats])
    covariance[repeated] = covariance[:, repeated] = np.nan
    infinite = repeated | ~np.isfinite(np.concatenate([local.position_std, local.rotation_std_deg]))
    covariance[infinite, infinite] = np.inf
    # From the local deviations, so that rounding makes none smaller.
    more = np.where(infinite, np.inf, np.diagonal(added))
    position_std = np.sqrt(local.position_std**2 + more[:3])
    rotation_std = np.sqrt(local.rotation_std_deg**2 + np.degrees(np.degrees(more[3:])))
    return HCRBound(
        position_std=position_std,
        rotation_std_deg=rotation_std,
        covariance=covariance,
        cramer_rao=local,
        displacements=xi,
        squared_distances=distances,
        squared_distances_standard_error=errors.copy(),
        repeats=repeats,
    )


def chapman_robbins(changes: ArrayLike, inner: ArrayLike) -> Array:
    """Δ (exp(A) − 1)⁻¹ Δᵀ: the bound on any q quantities from displacements alone, for exact distances.

    Args:
        changes: (m, q), Δ_i, how the quantities change.
        inner: (m, m), A, as for `hammersley_chapman_robbins`.

    Returns:
        (q, q); infinite where a quantity changes while the image does not (A_ii = 0).
    """
    change, A = np.asarray(changes, dtype=np.float64), np.asarray(inner, dtype=np.float64)
    moved = np.diagonal(A) > 0.0
    A_moved = A[np.ix_(moved, moved)]
    covariance = _excess(change[moved], A_moved, np.zeros_like(A_moved), np.zeros(len(A_moved)))
    infinite = change[~moved].any(axis=0)
    covariance[infinite] = covariance[:, infinite] = np.nan
    covariance[infinite, infinite] = np.inf
    return covariance


def axis_displacements(motions: ArrayLike, camera: Camera, length_scale: float) -> Array:
    """(m, 6): both ways along and about the camera's three axes, so that the image moves by given distances.

    Args:
        motions: image motions [pixel].
        camera: whose image moves.
        length_scale: depth at which a translation moves by them [scene unit].
    """
    angles = camera.angles(motions)
    steps = np.concatenate([length_scale * angles, angles], axis=1)
    one_way = (steps[:, :, None] * np.eye(6)).reshape(-1, 6)
    return np.concatenate([one_way, -one_way])


def _centre_rotation(pose: Array, xi: Array) -> Array:
    """(m, 6): the camera centre's change along the camera's axes, and the rotation vector."""
    return np.hstack([se3.exp(xi)[:, :3, 3], se3.log(se3.exp(xi))[:, 3:]])


def _excess(R: Array, A: Array, P: Array, errors: Array) -> Array:
    """R S⁻¹ Rᵀ, R (m, q), of S = exp(A) − 1 − P, with its errors' share left out."""
    half = 0.5 * np.diagonal(A)
    together = half[:, None] + half
    # Of small A, exp(A) − 1 − A is exact and A − P cancels only as far as it must.
    small = np.exp(-together) * ((np.expm1(np.minimum(A, 1.0)) - A) + (A - P))
    # Noise in A must not make two images closer than equal.
    large = np.exp(np.minimum(A - together, 0.0)) - np.exp(-together) * (1.0 + P)
    S = np.where(A > 1.0, large, small)
    R = np.exp(-half)[:, None] * R
    error = np.exp(-2.0 * half) * errors
    kept = np.diagonal(S) > np.maximum(3.0 * error, _SINGULAR * np.exp(-2.0 * half) * 2.0 * half)
    root = 1.0 / np.sqrt(np.diagonal(S)[kept])
    values, vectors = np.linalg.eigh(root[:, None] * S[np.ix_(kept, kept)] * root)
    values = values + 3.0 * float(np.linalg.norm(error[kept] * root**2))
    resolved = values > _SINGULAR
    projected = vectors[:, resolved].T @ (root[:, None] * R[kept]) / np.sqrt(values[resolved])[:, None]
    return np.asarray(projected.T @ projected, dtype=np.float64)


def _changes(functionals: Array, changes: Array) -> NDArray[np.bool_]:
    """Which functionals (q, 6) some of the changes (r, 6) alter, beyond rounding."""
    a = functionals / np.linalg.norm(functionals, axis=1, keepdims=True)
    b = changes / np.linalg.norm(changes, axis=1, keepdims=True)
    return np.asarray((np.abs(a @ b.T) > SMALLEST_SHARE).any(axis=1))
