"""A radiance field in NumPy whose image and columns are known in closed form: blobs that add up.

    I(u) = b + Σ_k c_k exp(−|π(p_k) − u|² / 2 s_k²),   s_k² = s_0² + (f r_k / z_k)²,

p_k the centres in the camera's frame, r_k their radii. It stands for splats and hash grids wherever only what
all fields have in common counts.
"""

from __future__ import annotations

import dataclasses
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsuba_crb import se3
from mitsuba_crb.camera import Camera, Intrinsics
from mitsuba_crb.errors import FieldError
from mitsuba_crb.radiance.field import Shown, Viewpoint

Floats = NDArray[np.float64]

NARROWEST = 0.8
"""s_0 [pixel]."""
INTRINSICS = Intrinsics((32, 24), (30.0, 31.0), (16.5, 11.0))
POSE = se3.exp([0.1, -0.2, 0.3, 0.2, -0.4, 0.1])


@dataclasses.dataclass(frozen=True, eq=False)
class SoftBlobs:
    """A field; see `Field`."""

    centres: Floats
    """(k, 3) in the world."""
    radii: Floats
    """(k,)"""
    colours: Floats
    """(k, 3)"""
    background: float = 0.2
    viewpoints: tuple[Viewpoint, ...] = ()
    rounding: float = 0.0
    """Standard deviation of what stands for rounding, other for each order of summation and pose: of the
    image, and of columns over the focal length [1 / pixel], about their largest entry."""
    draw: int = 0
    """Which of it."""
    scaled: tuple[float, ...] = (1.0,) * 6
    """Factors of the columns: others than 1 make them wrong."""
    label: str = "blobs"

    def refuse(self, camera: Camera) -> None:
        if camera.distortion is not None:
            raise FieldError(f"{self.label} is seen through pinholes only: undistort the images")

    def show(
        self,
        camera: Camera,
        pose: Floats,
        pixels: NDArray[np.int64],
        *,
        order: int = 0,
        kept: Floats | None = None,
    ) -> Shown:
        p, weights, _ = self._weights(camera, pose, pixels)
        total = weights.sum(axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            depth = np.where(total > 1e-6, weights @ p[:, 2] / total, np.nan)
        values = self.background + weights @ self.colours
        return Shown(values + self._noise(camera, pose, pixels, order)[..., 0], depth, 1.0 - np.exp(-total))

    def columns(
        self, camera: Camera, pose: Floats, pixels: NDArray[np.int64], *, order: int = 0
    ) -> tuple[Floats, Floats]:
        p, weights, (offset, square, growth) = self._weights(camera, pose, pixels)
        flow = camera.flow(p)
        # ½ d(|o|²/s²) = (o·dv)/s² − |o|² ds² / 2 s⁴
        slope = np.einsum("nka,kai->nki", offset, flow) / square
        slope -= 0.5 * np.sum(offset**2, axis=2)[..., None] / square**2 * growth
        values = np.einsum("nk,nki,kc->nci", -weights, slope, self.colours) * np.array(self.scaled)
        noise = self._noise(camera, pose, pixels, order)
        image = self.background + weights @ self.colours + noise[..., 0]
        return image, values + camera.focal_length * noise[..., 1:]

    def provenance(self) -> Mapping[str, Any]:
        return {"model": "blobs", "blobs": len(self.centres)}

    def _weights(
        self, camera: Camera, pose: Floats, pixels: NDArray[np.int64]
    ) -> tuple[Floats, Floats, tuple[Floats, Floats, Floats]]:
        """p (k, 3), weights (n, k); offsets (n, k, 2), s² (k,), and its derivative (k, 6)."""
        p = (self.centres - pose[:3, 3]) @ pose[:3, :3]
        offset = camera.project(p) - (pixels[:, None] + 0.5)
        spread = (camera.focal_length * self.radii / p[:, 2]) ** 2
        square = (NARROWEST**2 + spread)[:, None]
        weights = np.exp(-0.5 * np.sum(offset**2, axis=2) / square.T) * (p[:, 2] > 0.0)
        zero = np.zeros(len(p))
        falling = np.stack([zero, zero, zero - 1.0, -p[:, 1], p[:, 0], zero], axis=1)
        return p, weights, (offset, square, (-2.0 * spread / p[:, 2])[:, None] * falling)

    def _noise(self, camera: Camera, pose: Floats, pixels: NDArray[np.int64], order: int) -> Floats:
        """(n, 3, 7) what stands for rounding."""
        if not self.rounding:
            return np.zeros((len(pixels), 3, 7))
        width, height = camera.size
        rng = np.random.default_rng([self.draw, order, zlib.crc32(np.ascontiguousarray(pose).tobytes())])
        whole = rng.standard_normal((height, width, 3, 7))
        return np.asarray(self.rounding * whole[pixels[:, 1], pixels[:, 0]])


def viewpoints(count: int = 1) -> tuple[Viewpoint, ...]:
    """Cameras of `INTRINSICS` in a row from `POSE` on."""
    return tuple(
        Viewpoint(f"view{k}", INTRINSICS, POSE @ se3.exp([0.3 * k, 0.0, 0.0, 0.0, 0.05 * k, 0.0]))
        for k in range(count)
    )


def many(count: int = 40, seed: int = 0, **others: Any) -> SoftBlobs:
    """Blobs of all colours at depths from 2 to 6 before `POSE`."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(2.0, 6.0, count)
    film = rng.uniform([-2.0, -2.0], [34.0, 26.0], (count, 2))
    points = Camera.of(INTRINSICS).directions(film) * depth[:, None]
    return SoftBlobs(
        points @ POSE[:3, :3].T + POSE[:3, 3],
        rng.uniform(0.05, 0.3, count),
        rng.uniform(-0.1, 0.6, (count, 3)),
        **({"viewpoints": viewpoints()} | others),
    )


def target(faint: float = 0.0, **others: Any) -> SoftBlobs:
    """Two wide blobs on the optical axis, the same all around it; beside it, perhaps a faint one."""
    middle = Intrinsics((32, 24), (30.0, 30.0), (16.0, 12.0))
    points = np.array([[0.0, 0.0, 3.0], [0.0, 0.0, 5.0], [0.5, 0.3, 3.0]])
    count = 3 if faint else 2
    return SoftBlobs(
        (points @ POSE[:3, :3].T + POSE[:3, 3])[:count],
        np.array([0.5, 0.3, 0.1])[:count],
        np.array([[0.6, 0.4, 0.5], [0.2, 0.3, 0.1], [faint] * 3])[:count],
        **({"viewpoints": (Viewpoint("middle", middle, POSE),)} | others),
    )
