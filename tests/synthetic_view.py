"""A camera before a textured relief whose image and Jacobian are known in closed form, without Mitsuba."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsuba_crb import se3
from mitsuba_crb.bound.cramer_rao import PoseBound, cramer_rao_bound
from mitsuba_crb.information.image_information import fisher_information
from mitsuba_crb.information.image_jacobian import ImageJacobian
from mitsuba_crb.information.linearisation import Linearisation, PixelSelection
from mitsuba_crb.noise import Gaussian

SIGMA = 0.01
POSE = se3.exp([1.0, -2.0, 3.0, 0.2, -0.4, 0.1])


def columns(height: int, width: int, *, seed: int = 0) -> tuple[NDArray[Any], NDArray[Any]]:
    """Image (H, W, 3) and dI/dξ (H, W, 3, 6) of a 1/f texture on a slanted plane with a bump."""
    y, x = np.mgrid[:height, :width]
    u, v = -(x - width / 2) / width, -(y - height / 2) / width
    depth = 3.0 + 1.5 * u - 0.8 * (np.hypot(u - 0.2, v) < 0.2)
    rng = np.random.default_rng(seed)
    frequency = np.fft.fftfreq(height)[:, None] ** 2 + np.fft.fftfreq(width)[None] ** 2
    frequency[0, 0] = 1.0
    spectrum = np.fft.fft2(rng.normal(size=(height, width))) / frequency**0.75
    texture = np.real(np.fft.ifft2(spectrum))
    texture = (texture - texture.min()) / np.ptp(texture)
    du, dv = -np.gradient(texture, axis=1) * width, -np.gradient(texture, axis=0) * width
    # the image moves by −flow: dI/dξ = −∇I · f(u, v; depth)
    derivative = np.stack(
        [
            du / depth,
            dv / depth,
            -(u * du + v * dv) / depth,
            -dv - v * (u * du + v * dv),
            du + u * (u * du + v * dv),
            u * dv - v * du,
        ],
        axis=-1,
    )
    paint = np.array([0.9, 0.7, 0.5])
    return texture[..., None] * paint, derivative[:, :, None, :] * paint[:, None]


def jacobian(
    height: int = 48,
    width: int = 64,
    *,
    fraction: float = 1.0,
    kind: str = "all",
    noise: float = 0.3,
    unseen: tuple[int, ...] = (),
    seed: int = 0,
) -> ImageJacobian:
    """`columns` with independent errors in each of 4 batches, at a random fraction of the pixels."""
    image, values = columns(height, width, seed=seed)
    values[..., list(unseen)] = 0.0
    rng = np.random.default_rng(seed + 1)
    measured = rng.random((height, width)) < fraction
    row, column = np.nonzero(measured)
    scale = noise * values.std(axis=(0, 1, 2))
    batch_values = values[row, column] + scale * rng.normal(size=(4, len(row), 3, 6))
    return ImageJacobian(
        batch_values=batch_values,
        pixels=np.stack([column, row], axis=1),
        image=np.where(measured[..., None], image, np.nan),
        linearisation=Linearisation(
            variable="sensor 0",
            frame="camera",
            pose=POSE,
            length_scale=2.5,
            selection=PixelSelection(kind, height * width, len(row), "all" if kind == "all" else f"{kind}:x"),  # type: ignore[arg-type]
        ),
    )


def bound(view: ImageJacobian) -> PoseBound:
    """Its bound under `SIGMA`, with the provenance that `pose_bound` would give it."""
    result = cramer_rao_bound(fisher_information(view, Gaussian(SIGMA)))
    height, width = view.image.shape[:2]
    provenance = {
        "scene": "scenes/relief/relief.xml",
        "sensor": view.variable,
        "method": "finite_difference",
        "spp": 64,
        "seed": 0,
        "batches": 4,
        "size": [width, height],
        "fov_deg": [40.0, 30.5],
        "pixels": dataclasses.asdict(view.selection),
        "integrator": "PathIntegrator",
        "noise": {"model": "gaussian", "sigma": SIGMA, "origin": "0.01 of white 1 (99th percentile)"},
        "noise_inflation": result.information.noise_inflation,
        "warnings": ["one thing to know"],
        "versions": {"mitsuba_crb": "0.1.0"},
        "seconds": {"prepare": 0.5, "render": 1.5, "total": 2.0},
    }
    return dataclasses.replace(result, provenance=provenance)
