"""Each pixel's own Fisher information, and its share of what is known about one direction of the pose.

With independent pixels F = Σ_u F_u. From K independent batches each F_u is estimated without bias, as is the
image's (`ustatistic`), so that in a direction v the shares

    vᵀF̂_u v / Σ_w vᵀF̂_w v

sum to one; single ones may be negative by chance, where a pixel knows hardly anything. The plain vᵀĴ_uᵀWĴ_u v
would show Monte Carlo noise instead, just where the image knows least.
"""

from __future__ import annotations

import numpy as np

from ..errors import NoiseError, OptionError
from ..noise import CoupledNoise, NoiseModel
from ..se3 import Array
from .image_information import fisher_information
from .image_jacobian import ImageJacobian
from .symmetric import pack
from .ustatistic import pixel_products, square_root, whiten

_CHUNK = 4096  # pixels whose products are held at once


def pixel_information(batch_values: Array, weights: Array) -> Array:
    """F̂_u of every pixel, as the upper triangles (n, 21) of 6 x 6 matrices.

    Args:
        batch_values: (K, n, C, 6), independent estimates of ∂I/∂ξ.
        weights: (n, C), or (n, C, C) for noise that mixes a pixel's channels.
    """
    root = square_root(weights)
    parts = (slice(start, start + _CHUNK) for start in range(0, len(root), _CHUNK))
    products = [pixel_products(whiten(batch_values[:, part], root[part])).mean(axis=0).T for part in parts]
    return np.concatenate(products) if products else np.zeros((0, 21))


def along(information: Array, direction: Array) -> Array:
    """vᵀF_u v (n,) of triangles (n, 21), for a direction v (6,)."""
    weight = pack(np.outer(direction, direction) * (2.0 - np.eye(6)))
    return np.asarray(information @ weight, dtype=np.float64)


def information_share(jacobian: ImageJacobian, noise: NoiseModel, direction: Array) -> Array:
    """Each pixel's share of the information about one direction, (H, W); NaN where it was not measured.

    Args:
        jacobian: of the image, held whole.
        noise: of independent pixels.
        direction: (6,), v in the camera frame with translation in units of the length scale, such as
            `PoseBound.weakest.direction`.

    Raises:
        OptionError: a direction of the wrong shape, or one that the image does not see.
        NoiseError: the noise model does not fit the image, or couples pixels, which then have no shares.
    """
    if isinstance(noise, CoupledNoise):
        raise NoiseError("this noise couples pixels: what one of them tells depends on the others")
    v = np.asarray(direction, dtype=np.float64)
    if v.shape != (6,) or not np.isfinite(v).all() or not v.any():
        raise OptionError(f"a direction is six finite numbers, not all zero; got {direction!r}")
    camera = jacobian.to_frame("camera")
    information = fisher_information(camera, noise)
    v = v * information.scale
    total = float(v @ information.matrix @ v)
    if not total > 0.0:
        raise OptionError(
            f"the image has no information about this direction ({total:.3g}), so there is nothing to share"
        )
    weights = noise.weights(camera.pixels, camera.expected)
    own = along(pixel_information(camera.batch_values, weights), v)
    x, y = camera.pixels.T
    share = np.full(camera.image.shape[:2], np.nan)
    share[y, x] = own / own.sum()
    return share
