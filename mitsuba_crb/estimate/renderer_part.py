"""What trials tell of a bound although the estimator's renders are noisy too.

With g and F as in `misfit` an estimate's error is ξ = F⁻¹ g to first order. The image's noise gives g the
covariance F; Ĵ's and R̂'s noise, independent of it, adds to the errors the covariance C of `misfit`. With
E = F^½ C F^½ and its eigenvalues ε_i,

    Cov ξ = F⁻¹ + C,   F^½ ξ ~ N(0, I + E),   ξᵀFξ ~ Σ (1 + ε_i) χ²_1,   E[ξᵀFξ] = 6 + tr E = 6 (1 + excess),

and of many errors the generalised eigenvalues of (S, F⁻¹) are 1 + ε_i, not 1. Beside

    F_e = (F⁻¹ + C)⁻¹ = F^½ (I + E)⁻¹ F^½

the same errors are *freed* of it: if the bound is right, ξᵀF_eξ ~ χ²_6 and n F_e^½ S F_e^½ ~ Wishart_6(n),
which `bound.consistency` judges. If F is wrong by a factor c, Cov ξ = c F⁻¹ + C, the freed variances are
1 + (c − 1) / (1 + ε): the more the renderer adds, the less is seen of c.

Two things are not known. F̂ has an error: in the direction d of one standard deviation, dᵀFd = 1, the
variances are wrong by u = Var[dᵀF̂d]^½. And C holds to first order: noise in R̂'s own slope multiplies what it
adds, so that the next order is of relative size ε² / (1 + ε). Bands are widened by both. Hence the verdict:

    inconsistent   the freed errors are outside of the widened bands
    consistent     they are inside, and the renderer's part, the larger of excess and u, is small
    inconclusive   they are inside, and it is not: what is inside then, any bound might explain

The bands of the verdict hold jointly: NEES, the eigenvalues, and five coverages share 1 − confidence.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Literal

import numpy as np
from scipy import stats

from ..bound.consistency import LEVELS, Consistency, consistency
from ..errors import TrialError
from ..files import Record
from ..information.fisher import FisherInformation
from ..information.symmetric import congruence
from ..noise.covariance import positive_matrix, roots
from ..se3 import Array

Verdict = Literal["consistent", "inconsistent", "inconclusive"]

SMALL = 0.05
"""The largest renderer's part beside which errors may be called consistent with the bound."""

_JUDGED = 2 + len(LEVELS)
"""NEES, the eigenvalues and the coverages."""


@dataclasses.dataclass(frozen=True, eq=False)
class RendererPart(Record):
    """What the renderer's noise has added to some errors, and what they say of the bound without it."""

    excess: float
    """tr E / 6, the part by which it raises the errors' variances."""
    uncertainty: float
    """u, the relative standard error of the bound's variances in the worst-known of six directions."""
    limit: float
    """The largest part beside which errors may be called consistent."""
    allowance: float
    """Relative width that is added to all bands."""
    freed: Consistency
    """The errors beside F_e; its bands hold jointly at the confidence asked for."""

    @property
    def part(self) -> float:
        """The larger of excess and u."""
        return max(self.excess, self.uncertainty)

    @property
    def verdict(self) -> Verdict:
        """What the errors say of the bound."""
        if not self.freed.within(self.allowance):
            return "inconsistent"
        return "consistent" if self.part <= self.limit else "inconclusive"

    @property
    def times(self) -> int:
        """So many times the paths, about, would make the part small; 1 if it is."""
        if self.part <= self.limit:
            return 1
        # Renders that cross edges have a variance in proportion to |ξ|, so that a large excess feeds on
        # itself: among the bound's errors it would be this.
        alone = self.excess / math.sqrt(1.0 + max(0.0, self.excess))
        return max(2, times_for(alone, self.uncertainty, self.limit))


def times_for(excess: float, uncertainty: float, limit: float) -> int:
    """By how much paths have to be multiplied, a power of two, until both are below a limit.

    Variances fall as the paths, standard errors as their root.
    """
    needed = max(excess / limit, (uncertainty / limit) ** 2)
    return 1 << max(0, math.ceil(math.log2(max(needed, 1.0))))


def whitening(information: FisherInformation) -> tuple[Array, Array]:
    """A and its inverse with AᵀA = F in the camera frame, so that A ξ ~ N(0, I).

    Raises:
        TrialError: the information is not positive definite.
    """
    camera = information.to_frame("camera")
    scaled = camera.scale[:, None] * camera.matrix * camera.scale
    cure = "errors have no bound in a direction that is not seen"
    F = positive_matrix(scaled, "the information", TrialError, definite=True, cure=cure)
    root, inverse = roots(F, 0.0)
    return root.T / camera.scale, camera.scale[:, None] * inverse


def uncertainty(information: FisherInformation) -> float:
    """u of the worst-known of F's six axes; see `RendererPart`.

    Raises:
        TrialError: the information is not positive definite.
    """
    inverse = whitening(information)[1]
    entries = information.to_frame("camera").covariance_of_entries
    variances = [T @ entries @ T for T in (congruence(axis[:, None])[0] for axis in inverse.T)]
    return float(np.sqrt(max(variances)))


def renderer_part(
    errors: Array,
    information: FisherInformation,
    added: Array,
    *,
    confidence: float = 0.95,
    limit: float = SMALL,
) -> RendererPart:
    """Judge errors beside the bound and what the renderer has added to them.

    Args:
        errors: (n, 6), twists in the camera frame, log(truth⁻¹ estimate).
        information: at the truth, any frame; must see all six directions.
        added: (6, 6), C, camera frame [scene unit, rad].
        confidence: of all bands together.
        limit: the largest renderer's part beside which errors may be called consistent.

    Raises:
        TrialError: fewer than 7 errors, or an information that is not positive definite.
    """
    A, _ = whitening(information)
    epsilon, axes = np.linalg.eigh(A @ added @ A.T)
    u = uncertainty(information)
    # An estimate of what is added may be negative where next to nothing is.
    more = np.maximum(epsilon, 0.0)
    root = axes.T @ A / np.sqrt(1.0 + more)[:, None]
    freed = dataclasses.replace(information.to_frame("camera"), matrix=root.T @ root)
    widened = float(stats.norm.ppf(0.5 + 0.5 * confidence)) * u + float(max(more**2 / (1.0 + more)))
    return RendererPart(
        excess=float(epsilon.mean()),
        uncertainty=u,
        limit=limit,
        allowance=widened,
        freed=consistency(errors, freed, confidence=1.0 - (1.0 - confidence) / _JUDGED),
    )
