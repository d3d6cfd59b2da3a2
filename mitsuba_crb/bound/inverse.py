"""F⁻¹ for an information that does not see everything, with or without a prior.

With the eigenvectors of F̂ split into seen ones U and unseen ones N (`identifiability`) and a prior P,

    F_seen = U Λ Uᵀ,    M = (F_seen + P + λ_99 N Nᵀ)⁻¹,    var(aᵀξ) = aᵀ M a,

for a functional a whose share of N is insignificant: a small share (a slightly tilted null direction) adds
share² / λ_99, and for no share M is the inverse of the seen block. With a significant share the variance is
infinite, unless the prior sees all of that share: then N in M is replaced by what the prior leaves of it.
So what the image sees is decided without the prior, which can only help: var(aᵀξ) never exceeds its value
without the prior, nor the prior's own.

Failing to find a share proves none. With b = M a the share t = λ_99 Nᵀb has the covariance Σ of δF_ns b_s.
It adds ‖t‖² / λ_99, with the error √(4 tᵀΣt + 2 tr Σ²) / λ_99, if the true eigenvalue λ is about λ_99, but
of λ nothing is known save λ < λ_99. So a share is shown to be small only if three errors e = √tr Σ more,
((‖t‖ + 3e)² − ‖t‖²) / λ_99, are 8 % of the variance at most, which λ_99 / 12 then doubles; otherwise the
variance is infinite. Of a truly null N that part falls with the square root of the number of pixels.

Whatever u, var(aᵀξ) ≥ (aᵀu)² / uᵀ(F + P)u (Cauchy–Schwarz), and uᵀFu has an upper limit (`resolution`): with
u = M a, its seen part, and a's projections on what carries least, the largest is var(aᵀξ)'s lower limit.
"""

from __future__ import annotations

from dataclasses import dataclass
from dataclasses import replace as dataclass_replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..errors import OptionError
from ..information.fisher import FisherInformation
from ..information.identifiability import FLOAT32_FLOOR, SIGNIFICANT, Identifiability, identify
from ..information.resolution import Resolution, Verdict, resolve, upper_limits
from ..information.significance import refuse_negative
from ..information.symmetric import congruence, pack, symmetrised
from ..noise.covariance import nearest_semidefinite, roots
from ..se3 import Array
from .prior import PosePrior

LARGEST_TILT = 0.08
"""Part of a variance that three errors of the tilt may add to it; beyond, it is not shown to be finite."""

# Off-diagonal entries of a symmetric matrix occur twice in a trace but once in `pack`.
_MULTIPLICITY = pack(2.0 - np.eye(6))

# Smallest eigenvalue of a correlation matrix that leaves three digits of its inverse.
_SMALLEST_CORRELATION = 1e-13


class _Tilt(NamedTuple):
    error: Array
    """(m,), standard errors of the variances by the tilt, at λ_99."""
    most: Array
    """(m,), what three errors more of the tilt would add to them, at λ_99."""


@dataclass(eq=False)
class Inverse:
    """Variances of linear functionals of the pose, in the camera frame with scaled translation.

    hidden: N, what the information does not see; open: the part of it that the prior does not see either.
    """

    information: FisherInformation
    """Of the image, in any frame."""
    prior: FisherInformation | PosePrior | Array | None
    """What is known beforehand; a matrix is (6, 6) in `information`'s frame."""

    def __post_init__(self) -> None:
        information, prior = self.information, self.prior
        camera = information.to_frame("camera")
        self.length_scale = camera.length_scale
        self.scale = camera.scale
        S = np.diag(self.scale)
        self.identifiability = identify(
            S @ camera.matrix @ S, _scaled(camera.covariance_of_entries, self.scale)
        )
        U, N = self.identifiability.seen, self.identifiability.unseen
        F = (U * self.identifiability.eigenvalues[: U.shape[1]]) @ U.T
        self.total, self.open, self.known = camera, N, np.zeros((6, 6))
        if prior is not None:
            self.total, P = _with_prior(information, camera, prior)
            self.open, self.known = _unseen_by_prior(self.identifiability, P), P
            F = F + P
        # Without any information nor noise there is no threshold; then every functional is hidden, and only
        # the scale of what the prior leaves open needs a floor.
        floor = self.identifiability.threshold or FLOAT32_FLOOR * float(np.trace(F)) or 1.0
        self.precision, self.floor = F, floor
        self.tilted = _inverse_root(F + floor * N @ N.T)
        self.informed = self.tilted if self.open is N else _inverse_root(F + floor * self.open @ self.open.T)
        self.covariance_of_entries = _scaled(self.total.covariance_of_entries, self.scale)

    def kinds(self, functionals: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which functionals (m, 6) the information does not see, and which the prior does not see either."""
        variance = np.sum((functionals @ self.tilted) ** 2, axis=1)
        hidden, unseen = (
            self.identifiability.has_share(functionals, part)
            | (self._tilt(functionals, part).most > LARGEST_TILT * variance)
            for part in (self.identifiability.unseen, self.open)
        )
        return hidden, hidden & unseen

    @cached_property
    def resolution(self) -> Resolution:
        """What neither the information nor the prior sees, and which part of it is proven unseen."""
        return resolve(self.identifiability, self.open)

    def verdicts(self, functionals: Array) -> tuple[Verdict, ...]:
        """Of each functional (m, 6): finite, or a share of what is proven unseen, or neither."""
        infinite = self.kinds(functionals)[1]
        unseen = self.identifiability.has_share(functionals, self.resolution.unseen)
        return tuple(
            "seen" if not open_ else "unseen" if blind else "not resolved"
            for open_, blind in zip(infinite, unseen, strict=True)
        )

    def is_blurred(self, functionals: Array) -> NDArray[np.bool_]:
        """Which functionals (m, 6) are infinite and have a share of what is not resolved."""
        shares = self.identifiability.has_share(functionals, self.resolution.unresolved)
        unresolved = np.array(self.verdicts(functionals)) == "not resolved"
        return np.asarray(self.kinds(functionals)[1] & (shares | unresolved))

    def lower_limits(self, functionals: Array) -> Array:
        """(m,), what each functional's true standard deviation exceeds with a confidence of 99 %."""
        hidden, _ = self.kinds(functionals)
        tilted, informed = (functionals @ root @ root.T for root in (self.tilted, self.informed))
        best = np.where(hidden[:, None], informed, tilted)
        U, V = self.identifiability.seen, self.resolution.basis
        parts = [V[:, :k] for k in range(1, V.shape[1] + 1)]
        u = np.stack([best, best @ U @ U.T, *(functionals @ part @ part.T for part in parts)])
        norms = np.linalg.norm(u, axis=-1)
        u /= np.where(norms > 0.0, norms, 1.0)[..., None]
        most = upper_limits(self.identifiability, u.reshape(-1, 6)).reshape(norms.shape)
        most += np.einsum("kmi,ij,kmj->km", u, self.known, u)
        shares = np.einsum("mi,kmi->km", functionals, u) ** 2
        nothing = np.where(shares > 0.0, np.inf, 0.0)
        squares = np.divide(shares, most, out=nothing, where=most > 0.0)
        return np.asarray(np.sqrt(squares.max(axis=0)), dtype=np.float64)

    def covariance(self, functionals: Array) -> Array:
        """(m, m), with inf on the diagonal and nan off it for what is unseen."""
        hidden, unseen = self.kinds(functionals)
        tilted, informed = functionals @ self.tilted, functionals @ self.informed
        covariance = tilted @ tilted.T
        informed = informed @ informed.T
        # M of the tilted null directions plus a positive semi-definite block: the whole stays a covariance.
        covariance[np.ix_(hidden, hidden)] = informed[np.ix_(hidden, hidden)]
        covariance = 0.5 * (covariance + covariance.T)
        covariance[unseen] = covariance[:, unseen] = np.nan
        covariance[unseen, unseen] = np.inf
        return covariance

    def standard_error(self, functionals: Array, std: Array) -> Array:
        """(m,), of standard deviations: δ(σ²) = −bᵀ δF b with b = U Uᵀ M a, and the tilt's.

        Where a prior alone makes one finite, also by how much what noise hides could lower it.
        """
        hidden, _ = self.kinds(functionals)
        U = self.identifiability.seen
        tilted, informed = (functionals @ root @ (root.T @ U) @ U.T for root in (self.tilted, self.informed))
        b = np.where(hidden[:, None], informed, tilted)
        tilt = np.where(hidden, 0.0, self._tilt(functionals, self.identifiability.unseen).error)
        variance_error = np.hypot(_quadratic_error(b, self.covariance_of_entries), tilt)
        lowered = np.linalg.norm(functionals @ self.tilted, axis=1)
        with np.errstate(invalid="ignore"):
            errors = np.hypot(variance_error / (2.0 * std), np.where(hidden, std - lowered, 0.0))
            return np.where(np.isfinite(std), errors, np.nan)

    def sensitivity(self, functionals: Array) -> tuple[Array, Array]:
        """b = M a (m, 6) of the columns in the camera frame, unscaled, and aᵀ M a (m,): δ(σ²) = −bᵀ δF b.

        With the noise's floor as the information of what is not seen, so that everything is finite.
        """
        vectors = functionals @ self.tilted @ self.tilted.T
        return self.scale * vectors, np.asarray(np.sum(functionals * vectors, axis=1))

    def seen_covariance(self, functionals: Array) -> Array:
        """(m, m), of the inverse restricted to everything that is seen."""
        U = np.linalg.svd(self.open, full_matrices=True)[0][:, self.open.shape[1] :]
        root = functionals @ U @ _inverse_root(U.T @ self.precision @ U)
        return np.asarray(root @ root.T, dtype=np.float64)

    def eigenvalues(self) -> tuple[Array, Array]:
        """(6,) and (6,), of the whole information, descending, with first-order standard errors."""
        S = np.diag(self.scale)
        values, vectors = np.linalg.eigh(S @ self.total.matrix @ S)
        return values[::-1].copy(), _quadratic_error(vectors.T[::-1], self.covariance_of_entries)

    def ellipsoid(self, functionals: Array) -> tuple[Array, Array]:
        """Semi-axes (3,), descending, and directions (3, 3) in columns, of three functionals."""
        # Directions sorted by their share of what is unseen, so that whole axes are infinite or finite.
        directions = np.linalg.svd(functionals @ self.open, full_matrices=True)[0]
        _, unseen = self.kinds(directions.T @ functionals)
        finite = directions[:, ~unseen]
        variances, axes = np.linalg.eigh(self.covariance(finite.T @ functionals))
        semi_axes = np.concatenate([np.full(unseen.sum(), np.inf), np.sqrt(np.maximum(variances[::-1], 0.0))])
        return semi_axes, np.hstack([directions[:, unseen], finite @ axes[:, ::-1]])

    def _tilt(self, functionals: Array, part: Array) -> _Tilt:
        """What the tilt of a part (6, q) of the unseen subspace means for the variances of functionals."""
        found = self.identifiability
        if part.shape[1] == 0:
            return _Tilt(np.zeros(len(functionals)), np.zeros(len(functionals)))
        b = functionals @ self.tilted @ self.tilted.T
        share = self.floor * b @ part
        inner = found.unseen.T @ part
        gaps = found.eigenvalues[: found.rank, None] - found.eigenvalues[None, found.rank :]
        response = np.einsum("as,sn,nq->asnq", b @ found.seen, gaps, inner)
        covariance = np.einsum(
            "asnq,snto,atop->aqp", response, found.tilt_covariance, response, optimize=True
        )
        square, spread = np.sum(share**2, axis=1), np.trace(covariance, axis1=1, axis2=2)
        own = 4.0 * np.einsum("aq,aqp,ap->a", share, covariance, share)
        own += 2.0 * np.sum(covariance**2, axis=(1, 2))
        most = (np.sqrt(square) + SIGNIFICANT * np.sqrt(np.maximum(spread, 0.0))) ** 2
        return _Tilt(np.sqrt(np.maximum(own, 0.0)) / self.floor, (most - square) / self.floor)


def _with_prior(
    information: FisherInformation,
    camera: FisherInformation,
    prior: FisherInformation | PosePrior | Array,
) -> tuple[FisherInformation, Array]:
    """The sum in the camera frame, and the prior's own scaled positive semi-definite matrix."""
    S = np.diag(camera.scale)
    if isinstance(prior, PosePrior):
        prior, information = prior.in_frame("camera", camera.pose), camera
    if isinstance(prior, FisherInformation):
        total = (information + prior).to_frame("camera")
        total = total.about(length_scale=camera.length_scale)
        own = prior.to_frame("camera")
        matrix = S @ own.matrix @ S
        if own.covariance_of_entries.any():
            found = identify(matrix, _scaled(own.covariance_of_entries, camera.scale))
            return total, (found.seen * found.eigenvalues[: found.rank]) @ found.seen.T
        refuse_negative(own, "the prior", OptionError)
        return total, nearest_semidefinite(matrix)
    A = se3.adjoint(camera.pose) if information.frame == "world" else np.eye(6)
    own_matrix = A.T @ prior @ A
    P = nearest_semidefinite(symmetrised(S @ own_matrix @ S))
    plain = None if camera.plain_matrix is None else camera.plain_matrix + own_matrix
    return dataclass_replace(camera, matrix=camera.matrix + own_matrix, plain_matrix=plain), P


def _unseen_by_prior(identifiability: Identifiability, prior: Array) -> Array:
    """The part (6, q) of the unseen subspace N that a prior P does not see.

    An eigenvector of P sees N only if its share of N is significant: a strong prior elsewhere must not seem
    to inform a null direction that noise has tilted towards it.
    """
    N = identifiability.unseen
    values, vectors = np.linalg.eigh(prior)
    informative = values > np.finfo(np.float64).eps * 6 * max(values[-1], 0.0)
    vectors = vectors[:, informative]
    vectors = vectors[:, identifiability.has_share(vectors.T)]
    if N.shape[1] == 0 or vectors.shape[1] == 0:
        return N
    left, singular, _ = np.linalg.svd(N.T @ vectors, full_matrices=True)
    sees = int(np.count_nonzero(singular > 1e-6))
    return np.asarray(N @ left[:, sees:], dtype=np.float64)


def _scaled(covariance_of_entries: Array, scale: Array) -> Array:
    T = congruence(np.diag(scale))
    scaled: Array = T @ covariance_of_entries @ T.T
    return scaled


def _inverse_root(matrix: Array) -> Array:
    """L with L Lᵀ = A⁻¹ for a symmetric positive definite A, by its correlation form against mixed scales.

    A functional a ⟂ N gets ‖Lᵀa‖² exact even where A⁻¹ itself is dominated by a nearly null direction N.

    Raises:
        OptionError: A is singular to float64, which only a prior can make it.
    """
    _, inverse = roots(matrix, _SMALLEST_CORRELATION)
    if inverse.shape[1] < len(matrix):
        raise OptionError("the prior is so strong in one direction that float64 loses all others; weaken it")
    return inverse


def _quadratic_error(vectors: Array, covariance_of_entries: Array) -> Array:
    """Standard errors (m,) of vᵀ F v for vectors (m, 6)."""
    gradient = pack(vectors[:, :, None] * vectors[:, None, :]) * _MULTIPLICITY
    variance = np.einsum("mi,ij,mj->m", gradient, covariance_of_entries, gradient)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)), dtype=np.float64)
