"""Where a field keeps its scene: all of space in a cube, what the cameras surround in its middle.

A point x of the capture lies at z = (x − centre) / scale; the ball |z| ≤ 1 holds the cameras and what they
look at, or, where photographs are transparent but for one thing, that thing. Beyond, space is contracted,

    y = z                      |z| ≤ 1
    y = (2 − 1/|z|) z/|z|      beyond, so that infinity is the sphere |y| = 2

and u = (y + 2) / 4 lies in the unit cube. The map is continuous with its first derivative.

Source: Barron et al., "Mip-NeRF 360", CVPR 2022, equation 10.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from ..se3 import Array

if TYPE_CHECKING:
    import mitsuba as mi

_RIDGE = 1e-3
"""Of the centre: how much the cameras' own middle counts where their axes do not meet."""
_SMALLEST = 1e-6
"""Scale of cameras that all stand in one place, over their distance from the origin: taken as 1 below."""


@dataclass(frozen=True)
class SceneSpace:
    """Centre and scale of a scene."""

    centre: tuple[float, float, float]
    """What the cameras look at [unit of the capture]."""
    scale: float
    """Distance of the farthest camera from it, or radius of the only thing there is [unit of the capture]."""

    @staticmethod
    def around(poses: Array) -> SceneSpace:
        """The centre is the point nearest to all optical axes; poses (n, 4, 4)."""
        axes, positions = poses[:, :3, 2], poses[:, :3, 3]
        middle = positions.mean(axis=0)
        across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
        normal = across.mean(axis=0) + _RIDGE * np.eye(3)
        pull = np.einsum("nij,nj->i", across, positions - middle) / len(poses)
        centre = middle + np.linalg.solve(normal, pull)
        scale = float(np.linalg.norm(positions - centre, axis=1).max())
        if scale < _SMALLEST * max(1.0, float(np.abs(middle).max())):
            scale = 1.0
        return SceneSpace((float(centre[0]), float(centre[1]), float(centre[2])), scale)

    def normalised(self, points: Array) -> Array:
        """z of points (..., 3)."""
        return np.asarray((points - np.asarray(self.centre)) / self.scale)


def contracted(z: mi.Vector3f) -> mi.Vector3f:
    """U of z."""
    import mitsuba as mi

    return mi.Vector3f(0.25 * _shrinking(z)[0] * z + 0.5)


def pulled(z: mi.Vector3f, slope: mi.Vector3f) -> mi.Vector3f:
    """∇ in z of what has the gradient `slope` in u: (∂u/∂z)ᵀ slope; ∂u/∂z is symmetric."""
    import mitsuba as mi

    a, b = _shrinking(z)
    return mi.Vector3f(0.25 * (a * slope + (b * dr.dot(z, slope)) * z))


def stretch(z: Array) -> Array:
    """How much longer z is than 4 u where a cell of u is: 1/a of points (..., 3), across the radius."""
    r = np.maximum(np.linalg.norm(z, axis=-1), 1.0)
    return np.asarray(r / (2.0 - 1.0 / r))


def expanded(u: Array) -> Array:
    """Z of u (..., 3); of what lies at infinity or beyond, a point far away."""
    y = 4.0 * u - 2.0
    length = np.linalg.norm(y, axis=-1, keepdims=True)
    beyond = 1.0 / np.maximum(2.0 - length, 1e-3)
    return np.asarray(y * np.where(length > 1.0, beyond / np.maximum(length, 1.0), 1.0))


def _shrinking(z: mi.Vector3f) -> tuple[mi.Float, mi.Float]:
    """A and b, with y = a z and ∂y/∂z = a 1 + b z zᵀ."""
    q = dr.rsqrt(dr.maximum(dr.dot(z, z), 1.0))
    return (2.0 - q) * q, 2.0 * q * q * q * (q - 1.0)
