"""Covariances that stay finite where the image sees nothing. They are no bounds; hence by name only.

With U Λ Uᵀ the seen part of the information and N the unseen directions (`identifiability`), in the camera
frame with translation in units of the length scale,

    ridge           (F + ε 1)⁻¹ = U (Λ + ε)⁻¹ Uᵀ + N Nᵀ / ε,
    Moore–Penrose   F⁺ = U Λ⁻¹ Uᵀ.

A ridge is a Gaussian prior of standard deviation 1/√ε length scales and radians that nobody stated; the
pseudo-inverse claims certainty (zero) where nothing is known.

References: Hoerl and Kennard, "Ridge Regression", Technometrics 1970; Stoica and Marzetta, "Parameter
Estimation Problems with Singular Information Matrices", 2001 (when F⁺ bounds anything).
"""

from __future__ import annotations

import numpy as np

from .. import se3
from ..errors import OptionError
from ..information.fisher import FisherInformation
from ..information.significance import identified
from ..se3 import Array


def ridge(information: FisherInformation, epsilon: float) -> Array:
    """(6, 6), (F + ε 1)⁻¹ in the information's frame; not for what nobody knows: its size there is 1/ε.

    Raises:
        OptionError: ε is not positive and finite.
    """
    if not (np.isfinite(epsilon) and epsilon > 0.0):
        raise OptionError(f"a ridge must be positive and finite, not {epsilon}; moore_penrose needs none")
    return _inverse(information, epsilon, 1.0 / epsilon)


def moore_penrose(information: FisherInformation) -> Array:
    """(6, 6), F⁺ in the information's frame; zero, and no bound, along what is unseen."""
    return _inverse(information, 0.0, 0.0)


def _inverse(information: FisherInformation, epsilon: float, unseen: float) -> Array:
    found = identified(information)
    U, N = found.seen, found.unseen
    scaled = (U / (found.eigenvalues[: found.rank] + epsilon)) @ U.T + unseen * N @ N.T
    frame = np.eye(6) if information.frame == "camera" else se3.adjoint(information.pose)
    return se3.move_covariance(scaled, frame * information.scale)
