"""Do errors of an estimator behave as a bound says? NEES, covariance against bound, coverage.

For n independent errors ξ_i = log(truth⁻¹ estimate) ~ N(0, F⁻¹) of an estimator that attains the bound,

    ξᵀFξ ~ χ²_6,   Σ ξᵀFξ ~ χ²_6n (NEES),   n F^½ S F^½ ~ Wishart_6(n),  S = Σ ξξᵀ / n,

so the generalised eigenvalues of (S, F⁻¹), in descending order, have bands that do not depend on F; they are
simulated by Bartlett's decomposition with a fixed seed. Coverage at level p is the share of errors with
ξᵀFξ below the p quantile of χ²_6, with Wilson's interval.

References: Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001,
section 5.4.2 (NEES); Bartlett 1933; Wilson 1927.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from scipy import stats

from ..errors import TrialError
from ..files import Record
from ..information.fisher import FisherInformation
from ..noise.covariance import positive_matrix, roots
from ..se3 import Array

LEVELS = (0.50, 0.68, 0.90, 0.95, 0.99)
"""Nominal confidences at which coverage is reported."""

_SIMULATIONS = 20_000


@dataclass(frozen=True)
class Coverage:
    """How often the true pose lies in the confidence region of a nominal level."""

    nominal: float
    """The level."""
    empirical: float
    """The share of errors inside."""
    low: float
    """Wilson's interval at the confidence asked for."""
    high: float
    """Its upper end."""


@dataclass(frozen=True, eq=False)
class Consistency(Record):
    """Errors of an estimator beside the bound."""

    count: int
    """n."""
    nees: float
    """Mean of ξᵀFξ; 6 is expected."""
    nees_band: tuple[float, float]
    """Where it lies, at the confidence asked for, if the errors have the bound's covariance."""
    generalized_eigenvalues: Array
    """(6,) λ, descending, of (S, F⁻¹): 1 is expected; the largest is the worst ratio of variances."""
    directions: Array
    """(6, 6) D, by rows the camera-frame twists [scene unit, rad] that carry them, each one standard
    deviation of the bound long: DᵀD = F⁻¹ and Dᵀ diag(λ) D = S."""
    wishart_band: Array
    """(6, 2), where each of them lies; at the joint confidence of all six asked for."""
    coverage: tuple[Coverage, ...]
    """At `LEVELS`."""
    bias: Array
    """(6,), mean error in standard deviations of that mean; each about N(0, 1) if there is no bias."""

    @property
    def consistent(self) -> bool:
        """Whether NEES, all eigenvalues and all coverages are inside."""
        return self.within(0.0)

    def within(self, allowance: float) -> bool:
        """Whether they would be, if all variances were multiplied by some 1 ± `allowance` or less."""
        less, more = max(0.0, 1.0 - allowance), 1.0 + allowance
        low, high = self.nees_band
        values = self.generalized_eigenvalues
        inside = (less * self.wishart_band[:, 0] <= values) & (values <= more * self.wishart_band[:, 1])
        with np.errstate(divide="ignore"):
            covered = all(
                c.low <= stats.chi2.cdf(stats.chi2.ppf(c.nominal, 6) / np.float64(less), 6)
                and stats.chi2.cdf(stats.chi2.ppf(c.nominal, 6) / more, 6) <= c.high
                for c in self.coverage
            )
        return bool(less * low <= self.nees <= more * high and inside.all() and covered)


def consistency(errors: Array, information: FisherInformation, *, confidence: float = 0.95) -> Consistency:
    """Compare an estimator's errors with the bound.

    Args:
        errors: (n, 6), twists in the camera frame, log(truth⁻¹ estimate).
        information: at the truth, any frame; must see all six directions.
        confidence: of all bands and intervals.

    Raises:
        TrialError: fewer than 7 errors, or an information that is not positive definite.
    """
    twists = np.asarray(errors, dtype=np.float64)
    n = len(twists)
    if twists.ndim != 2 or twists.shape[1] != 6 or n < 7:
        raise TrialError(f"a covariance of six numbers needs at least 7 errors (n, 6), not {twists.shape}")
    camera = information.to_frame("camera")
    scaled = camera.scale[:, None] * camera.matrix * camera.scale
    cure = "errors have no bound in a direction that is not seen"
    F = positive_matrix(scaled, "the information", TrialError, definite=True, cure=cure)
    root, inverse_root = roots(F, 0.0)
    whitened = twists / camera.scale @ root
    squares = np.sum(whitened**2, axis=1)
    ratios, axes = np.linalg.eigh(whitened.T @ whitened / n)
    low, high = stats.chi2.interval(confidence, 6 * n)
    return Consistency(
        count=n,
        nees=float(squares.mean()),
        nees_band=(float(low) / n, float(high) / n),
        generalized_eigenvalues=ratios[::-1],
        directions=(inverse_root @ axes[:, ::-1]).T * camera.scale,
        wishart_band=wishart_band(n, confidence),
        coverage=tuple(_coverage(squares, level, confidence) for level in LEVELS),
        bias=np.sqrt(n) * twists.mean(axis=0) / twists.std(axis=0, ddof=1),
    )


@functools.cache
def wishart_band(n: int, confidence: float) -> Array:
    """(6, 2), bands of the ordered eigenvalues of Wishart_6(n)/n that hold jointly with this confidence."""
    rng = np.random.default_rng(0)
    factor = np.zeros((_SIMULATIONS, 6, 6))
    rows, columns = np.tril_indices(6, -1)
    factor[:, rows, columns] = rng.standard_normal((_SIMULATIONS, rows.size))
    for k in range(6):
        factor[:, k, k] = np.sqrt(rng.chisquare(n - k, _SIMULATIONS))
    eigenvalues = np.linalg.eigvalsh(factor @ factor.swapaxes(1, 2) / n)[:, ::-1]
    # The joint level: each eigenvalue's ranks, and the tail that keeps `confidence` of the simulations whole.
    ranks = eigenvalues.argsort(axis=0).argsort(axis=0)
    depth = np.minimum(ranks, _SIMULATIONS - 1 - ranks).min(axis=1)
    cut = int(np.quantile(depth, 1.0 - confidence))
    ordered = np.sort(eigenvalues, axis=0)
    band = np.stack([ordered[cut], ordered[_SIMULATIONS - 1 - cut]], axis=1)
    band.flags.writeable = False
    return band


def _coverage(squares: Array, level: float, confidence: float) -> Coverage:
    inside = int(np.sum(squares <= stats.chi2.ppf(level, 6)))
    interval = stats.binomtest(inside, len(squares)).proportion_ci(confidence, method="wilson")
    return Coverage(level, inside / len(squares), float(interval.low), float(interval.high))
