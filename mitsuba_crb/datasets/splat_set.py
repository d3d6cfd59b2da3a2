"""3D Gaussian splats as they are drawn: activations applied, rotations normalised, nothing that is no number.

    density of one   o exp(−½ (x − μ)ᵀ Σ⁻¹ (x − μ)),   Σ = R diag(s)² Rᵀ

Coefficients of real spherical harmonics (Kerbl et al. 2023) are in their order, k = l² + l + m, and without
the ½ that is added to a colour.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import FieldError, FieldWarning

Floats = NDArray[np.float64]

SH_C0 = 0.28209479177387814
"""The constant spherical harmonic, 1 / (2 √π)."""
DEGREES = (0, 1, 2, 3, 4)
"""Of spherical harmonics that are drawn."""

_ABSURD = 1e6
"""A splat so many times the scene's size away, or as large, is damage, and beyond float32."""


@dataclass(frozen=True, eq=False)
class Splats:
    """Gaussians of a scene, in the frame and unit of their file."""

    means: Floats
    """(n, 3)"""
    rotations: Floats
    """(n, 4) unit quaternions, w x y z, of the axes that `scales` are along."""
    scales: Floats
    """(n, 3) standard deviations; 0 is a disc's or a needle's."""
    opacities: Floats
    """(n,) from 0 to 1."""
    coefficients: NDArray[np.float32]
    """(n, k, 3) of spherical harmonics, k = (degree + 1)², of red, green and blue."""

    def __len__(self) -> int:
        return len(self.means)

    @property
    def degree(self) -> int:
        """Of the spherical harmonics."""
        return int(np.sqrt(self.coefficients.shape[1])) - 1

    @property
    def factors(self) -> Floats:
        """(n, 3, 3) M with Σ = M Mᵀ: the axes of each, times the standard deviation along it."""
        w, x, y, z = self.rotations.T
        rotation = np.array(
            [
                [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
                [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
                [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
            ]
        )
        return np.ascontiguousarray(rotation.transpose(2, 0, 1)) * self.scales[:, None]

    @property
    def covariances(self) -> Floats:
        """(n, 3, 3) Σ."""
        factors = self.factors
        return factors @ factors.transpose(0, 2, 1)


def checked(
    where: str,
    means: ArrayLike,
    rotations: ArrayLike,
    scales: ArrayLike,
    opacities: ArrayLike,
    coefficients: ArrayLike,
) -> Splats:
    """Splats without those that cannot be drawn, which a warning counts.

    Args:
        where: what messages call them, such as a file.
        means, rotations, scales, opacities, coefficients: as in `Splats`; quaternions of any length.

    Raises:
        FieldError: shapes that do not fit one another, a number of coefficients that is no (degree + 1)², or
            no splat is left.
    """
    mu, q, s, o = (np.asarray(array, dtype=np.float64) for array in (means, rotations, scales, opacities))
    c = np.asarray(coefficients, dtype=np.float32)
    if c.ndim != 3 or c.shape[1] not in [(degree + 1) ** 2 for degree in DEGREES] or c.shape[2] != 3:
        raise FieldError(
            f"{where}: spherical harmonics of degree 0 to {DEGREES[-1]} have 1, 4, 9, 16 or 25 coefficients "
            f"for each of three colours, and these have the shape {c.shape[1:]}"
        )
    n = len(c)
    if (mu.shape, q.shape, s.shape, o.shape) != ((n, 3), (n, 4), (n, 3), (n,)):
        raise FieldError(
            f"{where}: means (n, 3), rotations (n, 4), scales (n, 3), opacities (n,) and coefficients "
            f"(n, k, 3) are wanted, not {mu.shape}, {q.shape}, {s.shape}, {o.shape}, {c.shape}"
        )
    length = np.linalg.norm(q, axis=1)
    numbers = np.concatenate([mu, q, o[:, None]], axis=1)
    whole = ~np.isnan(numbers).any(axis=1) & ~np.isnan(s).any(axis=1) & np.isfinite(c).all(axis=(1, 2))
    finite = whole & np.isfinite(numbers).all(axis=1) & np.isfinite(s).all(axis=1)
    turned = finite & (length > 1e-12) & (o >= 0.0) & (o <= 1.0) & (s >= 0.0).all(axis=1)
    kept = turned.copy()
    if turned.any():
        middle = np.median(mu[turned], axis=0)
        with np.errstate(over="ignore", invalid="ignore"):
            away = np.linalg.norm(mu - middle, axis=1)
        # Of a single splat its own size.
        size = max(float(np.median(away[turned])), float(np.median(s[turned].max(axis=1))))
        kept &= (away <= _ABSURD * size) & (s.max(axis=1) <= _ABSURD * size)
    reasons = {
        "NaN": np.count_nonzero(~whole),
        "infinite": np.count_nonzero(whole & ~finite),
        "without a rotation, or of an opacity or scale that is none": np.count_nonzero(finite & ~turned),
        f"more than {_ABSURD:.0e} times the scene's size away, or as large": np.count_nonzero(turned & ~kept),
    }
    told = "; ".join(f"{count} {reason}" for reason, count in reasons.items() if count)
    if not kept.any():
        raise FieldError(f"{where} has no splat that can be drawn{f' ({told})' if told else ''}")
    if told:
        warnings.warn(FieldWarning(f"{where}: left out of {n} splats: {told}"), stacklevel=3)
    return Splats(mu[kept], q[kept] / length[kept, None], s[kept], o[kept], np.ascontiguousarray(c[kept]))


def colours_of(coefficients: ArrayLike) -> NDArray[np.float32]:
    """(n, 1, 3) coefficients of plain colours (n, 3) from 0 to 1."""
    return ((np.asarray(coefficients, dtype=np.float64) - 0.5) / SH_C0).astype(np.float32)[:, None]


def quaternions_of(smaller: Floats, largest: NDArray[np.int64]) -> Floats:
    """Unit quaternions (n, 4), w x y z, of three of their numbers (n, 3), and which (n,) the largest is."""
    which = largest[:, None]
    place = np.arange(3) + (np.arange(3) >= which)
    quaternions = np.empty((len(smaller), 4))
    np.put_along_axis(quaternions, place, smaller, axis=1)
    rest = np.maximum(1.0 - np.sum(smaller**2, axis=1, keepdims=True), 0.0)
    np.put_along_axis(quaternions, which, np.sqrt(rest), axis=1)
    return quaternions
