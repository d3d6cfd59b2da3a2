"""Small scenes of splats, and views of the real ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from mitsuba_crb.camera import Camera
from mitsuba_crb.datasets.splats import Splats, load_splats
from mitsuba_crb.radiance.gaussians import Gaussians

VARIANTS = ("classic", "antialiased", "mip")
SMALL = Camera.pinhole((26.0, 24.0), (11.0, 10.5), (24, 20))


def random_splats(count: int = 60, degree: int = 1, seed: int = 0, spread: float = 0.9) -> Splats:
    """Before a camera at the origin that looks along z: small and large ones, round and flat."""
    rng = np.random.default_rng(seed)
    quaternions = rng.normal(size=(count, 4))
    coefficients = rng.normal(size=(count, (degree + 1) ** 2, 3)) * 0.3
    coefficients[:, 0] += 0.5
    return Splats(
        rng.normal(size=(count, 3)) * spread + [0.0, 0.0, 3.5],
        quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        np.exp(rng.uniform(np.log(0.01), np.log(0.4), (count, 3))),
        rng.uniform(0.05, 1.0, count),
        coefficients.astype(np.float32),
    )


def odd_splats(degree: int = 1) -> Splats:
    """Some of everything that a kernel may stumble over."""
    few = random_splats(40, degree, seed=4)
    means, scales, opacities = few.means.copy(), few.scales.copy(), few.opacities.copy()
    scales[:4, 0] = 0.0  # discs
    scales[4:8, :2] = 0.0  # needles
    scales[4:8, 2] = 2.0
    scales[8:10] = 1.0
    means[8:10] = [[2.5, 0.1, 0.8], [0.3, -2.0, 0.9]]  # beyond the affine map's reach
    means[10] = [0.0, 0.0, 0.19]  # too near
    means[11] = [0.0, 0.0, -3.0]  # behind
    opacities[12:16] = 1.0  # held at 0.99
    opacities[16:18] = 0.0
    coefficients = few.coefficients.copy()
    coefficients[18:22, 0] = -3.0  # colours held at 0
    return Splats(means, few.rotations, scales, opacities, coefficients)


def sized_splats(camera: Camera, pose: np.ndarray, std: float, count: int = 150) -> Splats:
    """Those whose largest standard deviation on the film is `std`, about [pixel]."""
    splats = random_splats(count, degree=2, seed=2)
    depth = np.maximum((splats.means - pose[:3, 3]) @ pose[:3, 2], 0.1)
    size = std * depth / camera.focal_length / splats.scales.max(axis=1)
    return replace(splats, scales=splats.scales * size[:, None])


def turned_by_flow(field: Gaussians, camera: Camera, pose: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """(n, 3, 3) −∇I·f, f the film flow of a rotation: its columns by the picture's own slopes on the film."""
    slopes = []
    for axis in range(2):
        shift = 0.05 * np.eye(2)[axis]
        ends = (
            field.show(Camera.pinhole(camera.focal, camera.centre - sign * shift, camera.size), pose, pixels)
            for sign in (1, -1)
        )
        slopes.append(np.subtract(*(end.values for end in ends)) / 0.1)
    flow = camera.flow(camera.directions(pixels + 0.5))[:, :, 3:]
    return -np.einsum("dnc,ndk->nck", slopes, flow)


def wall_of_splats(count: int = 250) -> Splats:
    """A wall that many overlapping splats paint smoothly."""
    rng = np.random.default_rng(0)
    quaternions = rng.normal(size=(count, 4))
    means = np.concatenate([rng.uniform(-2, 2, (count, 2)), rng.normal(3.5, 0.1, (count, 1))], axis=1)
    x, y, _ = means.T
    colours = 0.5 + 0.5 * np.stack([np.sin(2 * x), np.cos(2 * y), np.sin(x + y)], axis=1)
    return Splats(
        means,
        quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        rng.uniform(0.15, 0.3, (count, 3)),
        rng.uniform(0.1, 0.9, count),
        colours[:, None].astype(np.float32),
    )


def pixels_of(camera: Camera) -> np.ndarray:
    """All, row by row."""
    rows, columns = np.indices(camera.size[::-1])
    return np.stack([columns, rows], axis=-1).reshape(-1, 2)


def looking(eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """`world_from_camera` at a point, towards another."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(up, z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3] = np.stack([x, np.cross(z, x), z, eye], axis=1)
    return pose


REAL = {
    "guitar": "guitar_90854/guitar_inria.ply",
    "hall": "indoor_hall_9080/point_cloud.ply",
    "playbot": "playbot_lod/playbot_lod3_31000.ply",
}
"""Names of the real ones, and their files."""


def real_splats(name: str, folder: Path) -> Splats:
    return load_splats(folder / REAL[name])


def real_views(name: str) -> list[np.ndarray]:
    """Three poses of each; all have y down."""
    up = np.array([0.0, -1.0, 0.0])
    if name == "hall":
        targets = np.array([[0.0, 0.0, 400.0], [60.0, 0.0, 400.0], [-120.0, -40.0, 400.0]])
        eyes = np.array([[0.0, 0.0, 0.0], [20.0, -20.0, -40.0], [-40.0, 20.0, 20.0]])
        return [looking(eye, target, up) for eye, target in zip(eyes, targets, strict=True)]
    target, distance = {
        "guitar": (np.array([0.2, -1.8, 0.2]), 4.0),
        "playbot": (np.array([0.0, -0.35, 0.0]), 1.6),
    }[name]
    turns = [(0.3, 0.1), (2.2, 0.35), (4.1, 0.2)]
    return [
        looking(
            target + distance * np.array([np.sin(a) * np.cos(b), -np.sin(b), np.cos(a) * np.cos(b)]),
            target,
            up,
        )
        for a, b in turns
    ]


def real_camera(width: int) -> Camera:
    """A square image of 53 degrees."""
    return Camera.pinhole(float(width), (width / 2, width / 2), (width, width))
