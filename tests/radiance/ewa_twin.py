"""The rasterised model of splats in NumPy, slow and readable, in float64: what the kernel must equal.

Every splat is laid over every pixel, nearest first. Columns are complex steps: the camera moves by i h ξ, and
the imaginary part over h is the derivative, exact to rounding, with every choice (order, clamps, cuts) as it
is without the step. So with cuts it is what automatic differentiation makes of a rasteriser with cuts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mitsuba_crb.camera import Camera
from mitsuba_crb.datasets.splats import Splats

STEP = 1e-30
DILATION = {"classic": 0.3, "antialiased": 0.3, "mip": 0.1}


@dataclass(frozen=True)
class Cuts:
    """What rasterisers leave out."""

    alpha: float = 0.0
    """Below which a splat is skipped in a pixel; INRIA's 1/255."""
    sigmas: float = np.inf
    """Beyond which it is not drawn."""
    transmittance: float = 0.0
    """What would leave less ends its pixel; INRIA's 1e-4."""


INRIA = Cuts(alpha=1.0 / 255.0, transmittance=1e-4)
"""And gsplat's. Their hulls, whole tiles about a square of 3 σ, hold about all that this leaves: 3.3 σ."""
ELLIPSE = Cuts(sigmas=3.0)


@dataclass(frozen=True)
class Picture:
    """Of some pixels."""

    values: np.ndarray
    """(n, 3)"""
    depth: np.ndarray
    """(n,)"""
    opacity: np.ndarray
    """(n,)"""
    columns: np.ndarray
    """(n, 3, 6); of no columns if they were not asked for."""


def picture(
    splats: Splats,
    camera: Camera,
    pose: np.ndarray,
    pixels: np.ndarray,
    *,
    variant: str = "classic",
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    near: float = 0.2,
    kept: np.ndarray | None = None,
    cuts: Cuts = Cuts(),
    columns: bool = True,
) -> Picture:
    """The image at the centres of pixels (n, 2), and its six columns in the camera's frame."""
    order_pose = pose if kept is None else kept
    z = (splats.means - order_pose[:3, 3]) @ order_pose[:3, 2]
    order = np.argsort(z, kind="stable")
    order = order[z[order] > near]
    twists = 1j * STEP * np.eye(6) if columns else np.zeros((1, 6))
    film = pixels + 0.5
    k = len(twists)
    kind = complex if columns else float
    transmittance, depth = np.ones((k, len(film)), dtype=kind), np.zeros((k, len(film)), dtype=kind)
    colour = np.zeros((k, len(film), 3), dtype=kind)
    unfinished = np.ones((k, len(film)), dtype=bool)
    drawn = project(splats, order, camera, pose, twists, DILATION[variant], variant != "classic")
    # What covers less than 1e-13 of every pixel would only cost time.
    beyond = np.maximum(film.min(axis=0) - drawn[0][:, 0].real, drawn[0][:, 0].real - film.max(axis=0))
    beyond = np.sum(np.maximum(beyond, 0.0) ** 2, axis=1)
    near_enough = beyond * np.linalg.eigvalsh(drawn[1][:, 0].real)[:, 0] < 60.0
    for mean, conic, opacity, light, distance in zip(*(part[near_enough] for part in drawn), strict=True):
        d = mean[:, None] - film
        power = -0.5 * np.einsum("kni,kij,knj->kn", d, conic, d)
        alpha = opacity[:, None] * np.exp(power)
        alpha = np.where(alpha.real > 0.99, 0.99, alpha)
        shown = (alpha.real >= cuts.alpha) & (power.real >= -0.5 * cuts.sigmas**2)
        unfinished &= ~(shown & ((transmittance * (1.0 - alpha)).real < cuts.transmittance))
        shown &= unfinished
        alpha = np.where(shown, alpha, 0.0)
        weight = alpha * transmittance
        colour += weight[:, :, None] * light[:, None]
        depth += weight * distance[:, None]
        transmittance = transmittance * (1.0 - alpha)
        if not unfinished.any() or transmittance.real.max() < 1e-14:
            break
    colour += transmittance[:, :, None] * np.asarray(background)
    covered = 1.0 - transmittance[0].real
    return Picture(
        colour[0].real,
        depth[0].real / np.where(covered > 0.0, covered, np.nan),
        covered,
        colour.imag.transpose(1, 2, 0) / STEP if columns else np.empty((len(film), 3, 0)),
    )


def project(splats, which, camera, pose, twists, dilation, compensated):
    """Per splat of `which`, for each twist's step: mean, conic, opacity, colour and depth in the image."""
    R, c = pose[:3, :3], pose[:3, 3]
    rho, phi = twists[:, :3], twists[:, 3:]
    seen = (splats.means[which] - c) @ R
    p = seen[:, None] - rho - np.cross(phi, seen[:, None])
    W = R.T - np.cross(phi[:, None], R).swapaxes(1, 2)
    x, y, z = np.moveaxis(p, -1, 0)
    kx, ky = 1.0 / camera.scale
    mean = np.stack([x / z * kx, y / z * ky], axis=-1) + camera.centre
    # 0.3 of the half field beyond the image: 1.3 of it where the principal point is in the middle.
    ends = np.sort([camera.offset, camera.offset + camera.scale * camera.size], axis=0)
    reach = 0.15 * (ends[1] - ends[0])
    low, high = ends[0] - reach, ends[1] + reach
    u, v = (held(t, low[j], high[j]) for j, t in enumerate((x / z, y / z)))
    J = np.zeros((*z.shape, 2, 3), dtype=z.dtype)
    J[..., 0, 0], J[..., 0, 2] = kx / z, -kx * u / z
    J[..., 1, 1], J[..., 1, 2] = ky / z, -ky * v / z
    A = J @ W
    bare = A @ splats.covariances[which][:, None] @ A.swapaxes(-1, -2)
    covariance = bare + dilation * np.eye(2)
    opacity = np.broadcast_to(splats.opacities[which][:, None], z.shape)
    if compensated:
        ratio = determinant(bare) / determinant(covariance)
        # Of a needle, which has no width, the ratio is rounding.
        opacity = opacity * np.sqrt(np.where(ratio.real > 1e-12, ratio, 0.0))
    conic = np.empty_like(covariance)
    conic[..., 0, 0], conic[..., 1, 1] = covariance[..., 1, 1], covariance[..., 0, 0]
    conic[..., 0, 1] = conic[..., 1, 0] = -covariance[..., 0, 1]
    conic /= determinant(covariance)[..., None, None]
    away = (splats.means[which] - c)[:, None] - rho @ R.T
    direction = away / np.sqrt(np.sum(away**2, axis=-1))[..., None]
    basis = harmonics(direction, splats.degree)
    light = np.einsum("nkh,nhc->nkc", basis, splats.coefficients[which].astype(float)) + 0.5
    return mean, conic, opacity, np.where(light.real > 0.0, light, 0.0), z


def held(value, low, high):
    """Between two ends, with no slope where it is held."""
    return np.where(value.real < low, low, np.where(value.real > high, high, value))


def determinant(m):
    return m[..., 0, 0] * m[..., 1, 1] - m[..., 0, 1] * m[..., 1, 0]


def harmonics(direction, degree):
    """(..., (degree + 1)²) real spherical harmonics as Kerbl et al. write them, up to degree 3."""
    x, y, z = np.moveaxis(direction, -1, 0)
    xx, yy, zz = x * x, y * y, z * z
    found = [0.28209479177387814 * np.ones_like(x)]
    if degree > 0:
        found += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if degree > 1:
        found += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2.0 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ]
    if degree > 2:
        found += [
            -0.5900435899266435 * y * (3.0 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4.0 * zz - xx - yy),
            0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
            -0.4570457994644658 * x * (4.0 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3.0 * yy),
        ]
    return np.stack(found, axis=-1)
