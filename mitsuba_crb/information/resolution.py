"""What is unseen, and what so few paths only do not resolve.

"Not above the noise" says either that the image tells nearly nothing along a direction u, or that so few
paths tell nothing. An upper confidence limit of uᵀFu decides. With the trailing eigenvectors N of F̂
(`identifiability`) that the noise δF itself has chosen, to second order

    NᵀFN = Λ − δF_nn + 2 Σ_s δF_sn δF_snᵀ / (λ_s − λ_n),

the last term being the seen directions' information that a tilt lets in: twice, since it makes Λ too small
besides. The limit is the 99 % quantile over draws of δF, with max(Λ, 0) for Λ. Directions are taken in the
ascending order of the root second moment of that, so that noise in one hides nothing that is known of
another. What lies below 1e-3 of the best-seen eigenvalue is unseen; the rest is not resolved.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist
from typing import Literal

import numpy as np

from ..se3 import Array
from .identifiability import CONFIDENCE, FLOAT32_FLOOR, Identifiability
from .symmetric import pack

Verdict = Literal["seen", "unseen", "not resolved"]

UNSEEN = 1e-3
"""What certainly carries less than this part of the best-seen eigenvalue is unseen."""

_QUANTILE = NormalDist().inv_cdf(CONFIDENCE)


@dataclass(frozen=True, eq=False)
class Resolution:
    """The directions that are not seen, split into proven unseen ones and unresolved ones."""

    basis: Array
    """(6, q), orthonormal columns, those that carry the least information first."""
    count: int
    """How many of the first are unseen."""

    @property
    def unseen(self) -> Array:
        """(6, count), orthonormal columns: certainly next to no information."""
        return self.basis[:, : self.count]

    @property
    def unresolved(self) -> Array:
        """(6, q − count), orthonormal columns: too much noise to tell."""
        return self.basis[:, self.count :]


def resolve(found: Identifiability, part: Array) -> Resolution:
    """Split the unseen subspace, or the part (6, q) of it that a prior leaves, orthonormal columns."""
    if part.shape[1] == 0:
        return Resolution(part, 0)
    inner = found.unseen.T @ part
    informations = inner.T @ _trailing(found) @ inner
    order = np.linalg.eigh(np.mean(informations @ informations, axis=0))[1]
    informations = order.T @ informations @ order
    most, floor = UNSEEN * _best(found), _floor(found)
    count = 0
    for k in range(1, part.shape[1] + 1):
        largest = np.linalg.eigvalsh(informations[:, :k, :k])[:, -1]
        if float(np.quantile(largest, CONFIDENCE)) + floor > most:
            break
        count = k
    return Resolution(part @ order, count)


def upper_limits(found: Identifiability, vectors: Array) -> Array:
    """(m,), what the true uᵀFu of vectors u (m, 6) stays below with a confidence of 99 % each."""
    r = found.rank
    w = vectors @ found.eigenvectors
    if r == 6:  # no tilt, so that the quantile is a normal's
        gradient = pack(w[:, :, None] * w[:, None, :]) * pack(2.0 - np.eye(6))
        errors = np.linalg.norm(gradient @ found.noise_root.T, axis=1)
        return np.asarray(w**2 @ found.eigenvalues + _QUANTILE * errors, dtype=np.float64)
    noise = found.noise()
    values = np.concatenate([found.eigenvalues[:r], np.maximum(found.eigenvalues[r:], 0.0)])
    drawn = np.einsum("dmi,mi->dm", w @ noise, w)
    drawn += 2.0 * np.sum((w[:, r:] @ _tilting(found, noise)) ** 2, axis=2)
    own = w**2 @ values + _floor(found) * np.sum(w**2, axis=1)
    return np.asarray(own + np.quantile(drawn, CONFIDENCE, axis=0), dtype=np.float64)


def paths_to_decide(found: Identifiability, limit: float) -> int | None:
    """How many times the paths bring this limit to `UNSEEN`; None if nothing is seen.

    The noise of nothing falls with the paths, as products of errors do; what is more is seen before.
    """
    most = UNSEEN * _best(found)
    return math.ceil(limit / most) if most > 0.0 else None


def _trailing(found: Identifiability) -> Array:
    """(draws, q, q), what NᵀFN may be."""
    r = found.rank
    noise = found.noise()
    tilting = _tilting(found, noise)
    own = np.diag(np.maximum(found.eigenvalues[r:], 0.0))
    possible: Array = own + noise[:, r:, r:] + 2.0 * tilting @ tilting.mT
    return possible


def _tilting(found: Identifiability, noise: Array) -> Array:
    """(draws, q, r), δF_ns / √(λ_s − λ_n), with the largest λ_n."""
    r = found.rank
    rest = max(float(found.eigenvalues[r]), 0.0) if r < 6 else 0.0
    tilting: Array = noise[:, r:, :r] / np.sqrt(found.eigenvalues[:r] - rest)
    return tilting


def _best(found: Identifiability) -> float:
    return float(found.eigenvalues[0]) if found.rank else 0.0


def _floor(found: Identifiability) -> float:
    return FLOAT32_FLOOR * max(float(found.eigenvalues[0]), 0.0)
