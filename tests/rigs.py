"""Cameras that see random points: images and Jacobians in closed form, for rigs, formations and worlds."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsuba_crb import se3
from mitsuba_crb.information.fisher import FisherInformation
from mitsuba_crb.information.linearisation import Linearisation, PixelSelection

SELECTION = PixelSelection("all", 100, 100, "all")


def random_pose(rng: np.random.Generator, *, origin: float = 0.0) -> NDArray[Any]:
    """A pose within a few units of a point at this distance from the world's origin."""
    pose = se3.exp(np.concatenate([rng.normal(size=3), rng.normal(size=3)]))
    direction = rng.normal(size=3)
    pose[:3, 3] += origin * direction / np.linalg.norm(direction)
    return pose


def points_before(rng: np.random.Generator, count: int = 12) -> NDArray[Any]:
    """Points (n, 3) in a camera's frame, in front of it."""
    return rng.uniform([-1.0, -1.0, 2.0], [1.0, 1.0, 5.0], size=(count, 3))


def projection_slope(points: NDArray[Any]) -> NDArray[Any]:
    """∂(x/z, y/z)/∂p, (n, 2, 3)."""
    x, y, z = points.T
    zero = np.zeros_like(z)
    rows = [[1.0 / z, zero, -x / z**2], [zero, 1.0 / z, -y / z**2]]
    return np.moveaxis(np.array(rows), -1, 0)


def point_motion(points: NDArray[Any]) -> NDArray[Any]:
    """∂p/∂ξ of points seen from a frame that moves by exp(ξ) on the right: −ρ − φ × p, (n, 3, 6)."""
    turn = np.array([se3.skew(p) for p in points])
    return np.concatenate([np.broadcast_to(-np.eye(3), turn.shape), turn], axis=2)


def camera_jacobian(points: NDArray[Any]) -> NDArray[Any]:
    """(2n, 6), of the images of points in the camera's frame, camera-frame twist."""
    return (projection_slope(points) @ point_motion(points)).reshape(-1, 6)


def about(**changes: Any) -> Linearisation:
    """A camera at the world's origin, its own frame, with some fields changed."""
    fields: dict[str, Any] = {
        "variable": "camera",
        "frame": "camera",
        "pose": np.eye(4),
        "length_scale": 2.0,
        "selection": SELECTION,
    }
    return Linearisation(**(fields | changes))


def made(matrix: Any, covariance: Any = None, plain_matrix: Any = None, **changes: Any) -> FisherInformation:
    """An information with the given matrix, exact unless a covariance is given, of `about`."""
    covariance = np.zeros((21, 21)) if covariance is None else covariance
    return FisherInformation(np.asarray(matrix), covariance, plain_matrix, linearisation=about(**changes))


def definite(rng: np.random.Generator, rank: int = 6) -> NDArray[Any]:
    """A random information matrix of this rank."""
    factor = rng.normal(size=(6, rank))
    return factor @ factor.T + (0.1 * np.eye(6) if rank == 6 else 0.0)


def noisy(rng: np.random.Generator, F: NDArray[Any], *, error: float) -> tuple[NDArray[Any], NDArray[Any]]:
    """F plus symmetric noise, diagonal entries of standard deviation `error`, and the entries' covariance."""
    noise = rng.normal(size=(6, 6))
    i, j = np.triu_indices(6)
    variance = np.where(i == j, 1.0, 0.5) * error**2
    return F + error * (noise + noise.T) / 2.0, np.diag(variance)
