"""The floor plan: positions seen from above, along the two of the world's axes that are level."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..se3 import Array

_NAMES = "xyz"


def plan_axes(up: Array) -> tuple[Array, int]:
    """The world's axes, of which the one next to up is up, and the others level: rows (3, 3), and its index.

    That one points as the world's does, so perhaps down.
    """
    which = int(np.argmax(np.abs(up)))
    axes = np.eye(3)
    axes[which] = up * np.sign(up[which])
    first, second = (axis for axis in range(3) if axis != which)
    axes[first] -= (axes[first] @ axes[which]) * axes[which]
    axes[first] /= np.linalg.norm(axes[first])
    axes[second] = np.cross(axes[which], axes[first]) * (-1.0 if which == 1 else 1.0)
    return axes + 0.0, which  # no -0


@dataclass(frozen=True, eq=False)
class PlanView:
    """What is above what."""

    axes: Array
    """(3, 3) rows, see `plan_axes`."""
    up_axis: int
    """Which of them is up, or down."""

    @staticmethod
    def of(up: Array) -> PlanView:
        """From a unit vector (3,)."""
        return PlanView(*plan_axes(np.asarray(up, dtype=np.float64)))

    @property
    def level(self) -> tuple[int, int]:
        """Which two are level."""
        first, second = (axis for axis in range(3) if axis != self.up_axis)
        return first, second

    @property
    def names(self) -> tuple[str, str, str]:
        """Of the two that are level and of the one that is up or down; a dash where they are tilted."""
        tilted = np.abs(self.axes - np.eye(3)).max(axis=1) > 1e-6
        names = [name + ("′" if dash else "") for name, dash in zip(_NAMES, tilted, strict=True)]
        return names[self.level[0]], names[self.level[1]], names[self.up_axis]

    def mirrored(self, up: Array) -> bool:
        """Whether the second level axis points down the page if the first points right, seen from above."""
        first, second = self.level
        return bool(np.cross(self.axes[first], self.axes[second]) @ up < 0.0)

    def flat(self, points: Array) -> Array:
        """(n, 2) coordinates along the level axes of points, or vectors (n, 3)."""
        return np.asarray(points @ self.axes[list(self.level)].T)

    def height(self, points: Array) -> Array:
        """(n,) coordinates along the axis that is up, or down."""
        return np.asarray(points @ self.axes[self.up_axis])

    def points(self, flat: Array, height: Array | float) -> Array:
        """(n, 3) of both."""
        return np.asarray(
            flat @ self.axes[list(self.level)] + np.multiply.outer(height, self.axes[self.up_axis])
        )
