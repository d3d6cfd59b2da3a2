"""What an estimated information shows for certain: the part that is seen, and no negative information.

An unbiased estimate of something that is zero is negative half of the time. Sums take it as it is, since
its noise averages out there; what is not linear (an inverse, an optimum) would turn unresolved noise into
something that looks resolved, and takes the seen part alone. Rule and units are those of `identifiability`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..errors import FusionError
from ..noise.covariance import symmetric_root
from ..se3 import Array
from .fisher import FisherInformation
from .identifiability import Identifiability, identify
from .linearisation import Linearisation, PixelSelection
from .symmetric import congruence, unpack

NEGATIVE = 4.0
"""Standard errors beyond which negative information is no estimation noise."""

_ROUNDING = 1e-9
_DRAWS = 2048


def no_information(*, variable: str, pose: ArrayLike, length_scale: float = 1.0) -> FisherInformation:
    """Exactly nothing, about a pose that only others' measurements will tell of."""
    return FisherInformation(
        matrix=np.zeros((6, 6)),
        covariance_of_entries=np.zeros((21, 21)),
        linearisation=Linearisation(
            variable=variable,
            frame="camera",
            pose=np.asarray(pose, dtype=np.float64),
            length_scale=length_scale,
            selection=PixelSelection("only", 0, 0, "none"),
        ),
    )


def identified(information: FisherInformation) -> Identifiability:
    """Seen and unseen directions, in the camera frame with translation in units of the length scale."""
    camera = information.to_frame("camera")
    return identify(_scaled(camera), scaled_covariance(camera))


def seen_root(information: FisherInformation) -> Array:
    """R (6, r) with R Rᵀ the seen part of the information, in the camera frame, unscaled."""
    found = identified(information)
    root: Array = found.seen * np.sqrt(found.eigenvalues[: found.rank]) / information.scale[:, None]
    return root


def scaled_covariance(camera: FisherInformation) -> Array:
    """(21, 21), of the entries with translation in units of the length scale."""
    T = congruence(np.diag(camera.scale))
    covariance: Array = T @ camera.covariance_of_entries @ T.T
    return covariance


def refuse_negative(information: FisherInformation, name: str, fault: type[Exception] = FusionError) -> None:
    """Refuse information that is negative beyond what estimation noise explains.

    The smallest of several unseen directions' eigenvalues is negative by chance: it may lie `NEGATIVE`
    standard errors below its mean under pure noise, which is zero for a single direction.

    Raises:
        fault: it lies lower.
    """
    camera = information.to_frame("camera")
    eigenvalues = np.linalg.eigvalsh(_scaled(camera))
    smallest, largest = float(eigenvalues[0]), float(np.abs(eigenvalues).max())
    if smallest >= -_ROUNDING * largest:
        return
    found = identified(camera)
    root = symmetric_root(scaled_covariance(camera))
    draws = np.random.default_rng(1997).standard_normal((_DRAWS, 21)) @ root
    noise = found.unseen.T @ unpack(draws) @ found.unseen
    # The last of the unseen directions is the smallest eigenvalue's.
    error = float(noise[:, -1, -1].std())
    mean = float(np.linalg.eigvalsh(noise)[:, 0].mean()) if found.rank < 5 else 0.0
    if smallest < mean - NEGATIVE * error - _ROUNDING * largest:
        size = f"by {(mean - smallest) / error:.1f} standard errors" if error > 0.0 else "and exact"
        raise fault(
            f"the information of {name!r} is negative {size} (smallest eigenvalue {smallest:.3g}); noise "
            f"explains {NEGATIVE:g}. Is a sign wrong, or the covariance of its entries?"
        )


def _scaled(camera: FisherInformation) -> Array:
    scaled: Array = camera.scale[:, None] * camera.matrix * camera.scale
    return scaled
