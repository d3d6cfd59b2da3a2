"""What odometry adds to a pose's uncertainty: white noise of speed and of rate of turn, along a straight way.

A body that moves by v and turns by ω per unit of length, both measured with white noise of the densities q_t²
and q_r² per unit of length, equal in all directions, has the error

    dΣ/ds = Ad(x) diag(q_t² 1, q_r² 1) Ad(x)ᵀ,    x = world_from_body at s,

of the twist in the world frame, where known motions change nothing (`se3`). It does not depend on the body's
axes, and over a straight way of length ℓ with direction d and middle m the integral is

    Q_ρρ = ℓ q_t² 1 + ℓ q_r² ([m]× [m]×ᵀ + ℓ²/12 [d]× [d]×ᵀ),    Q_ρφ = ℓ q_r² [m]×,    Q_φφ = ℓ q_r² 1,

which is the same for a way and for its parts one after the other. Seen from its end (m = −d ℓ/2) the position
has the covariance ℓ q_t² 1 + ℓ³/3 q_r² (1 − d dᵀ): standard deviations grow with the root of the length, and
sideways with its power 3/2 by the heading. A turn by θ on the spot at p adds θ q_θ² Ad diag(0, 1) Adᵀ there.

Reference: Barfoot, "State Estimation for Robotics", 2nd ed., chapter 8.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from .. import se3
from ..errors import PlanError
from ..files import Record, Table, checked, read_toml
from ..se3 import Array


class OdometryTable(Table):
    """An odometry's file."""

    translation_per_sqrt_length: float = Field(ge=0.0, allow_inf_nan=False)
    """Standard deviation of the position, per direction, after one scene unit [scene unit]; it grows with the
    root of the length."""
    rotation_deg_per_sqrt_length: float = Field(ge=0.0, allow_inf_nan=False)
    """Standard deviation of the rotation, per axis, after one scene unit [deg]."""
    rotation_deg_per_sqrt_turn: float = Field(default=0.0, ge=0.0, allow_inf_nan=False)
    """Standard deviation of the rotation, per axis, after turning by one radian [deg]."""


@dataclass(frozen=True)
class Odometry(Record):
    """How well relative motion is known."""

    translation: float
    """q_t [√(scene unit)]: standard deviation per direction after one scene unit."""
    rotation_deg: float
    """q_r [deg/√(scene unit)], per axis."""
    turn_deg: float = 0.0
    """q_θ [deg/√rad], per axis, of turns on the spot."""

    def moved(self, start: ArrayLike, end: ArrayLike) -> Array:
        """(6, 6), Q of a straight way between two points (3,), of the twist in their frame."""
        a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
        length = float(np.linalg.norm(b - a))
        rate = length * np.radians(self.rotation_deg) ** 2
        arm, way = se3.skew(0.5 * (a + b)), se3.skew(b - a)
        Q = np.zeros((6, 6))
        Q[:3, :3] = length * self.translation**2 * np.eye(3) + rate * (arm @ arm.T + way @ way.T / 12.0)
        Q[:3, 3:], Q[3:, :3] = rate * arm, rate * arm.T
        Q[3:, 3:] = rate * np.eye(3)
        return Q

    def turned(self, point: ArrayLike, angle: ArrayLike) -> Array:
        """(..., 6, 6), Q of turns on the spot at a point (3,), by angles (...) [rad]."""
        arm = se3.skew(point)
        block = np.block([[arm @ arm.T, arm], [arm.T, np.eye(3)]])
        rate = np.radians(self.turn_deg) ** 2 * np.asarray(angle, dtype=np.float64)
        Q: Array = rate[..., None, None] * block
        return Q


def load_odometry(path: Path) -> Odometry:
    """The odometry in a TOML file, see `OdometryTable`.

    Raises:
        PlanError: the file cannot be read, or says something else.
    """
    table = checked(OdometryTable, read_toml(path, PlanError), PlanError, str(path))
    return Odometry(
        table.translation_per_sqrt_length,
        table.rotation_deg_per_sqrt_length,
        table.rotation_deg_per_sqrt_turn,
    )
