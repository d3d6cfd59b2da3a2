"""A lens' distortion D where an image can show it: checked, invertible, in float64.

A calibration's polynomials hold as far as its image reaches. Beyond they may fold back, so that what is far
outside would appear inside; there D goes on straight, as it left the disc that holds the image:

    D(u) + D'(u) (w − u)   for |w| > R, u = w R/|w|

so that all of the plane has one place each, and only what the image shows lands in it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ..errors import CameraError
from ..se3 import Array
from . import lens
from .intrinsics import Intrinsics

WIDEST_DEG = 88.0
"""Farthest off the axis that a film point may look: towards 90° its place at depth one goes to infinity."""
_LEAST = 0.01
"""Least motion on the film per angle, over that on the axis: below, a lens as good as folds."""
_STEPS, _ANGLES = 2048, 64
"""Of the grid on which a model is checked."""
_INVERTED = 1e-6
"""How closely film points must come back from their directions [pixel]."""
_NODES = 1024
"""Of the table that Newton's method starts from."""


@dataclass(frozen=True, eq=False)
class Distortion:
    """D of `lens` within |u| ≤ R, goes on straight beyond; its inverse; in axes x right, y down."""

    model: str
    coefficients: tuple[float, ...]
    limit: float
    """R: all that the image shows has |u| below."""
    reach: float
    """Largest |D(u)| there."""
    start: Array = field(repr=False)
    """(n,) what `lens.undistorted` starts from, over |D(u)| at even steps from 0 to `reach`."""

    @staticmethod
    def of(intrinsics: Intrinsics, margin: float) -> Distortion | None:
        """That of a calibration, None if it has none.

        Args:
            margin: how far beyond the image its pixels' filters reach [pixel].

        Raises:
            CameraError: within the image the model folds over, or looks too far off the axis.
        """
        if not intrinsics.distorts:
            return None
        model, k = intrinsics.model, intrinsics.distortion
        focal, centre, size = (np.asarray(x) for x in (intrinsics.focal, intrinsics.centre, intrinsics.size))
        corners = np.array([[x, y] for x in (-margin, size[0] + margin) for y in (-margin, size[1] + margin)])
        farthest = float(np.linalg.norm((corners - centre) / focal, axis=1).max())
        off_axis = np.linspace(0.0, np.radians(WIDEST_DEG), _STEPS + 1)
        # Of D itself: without tangential coefficients one direction tells of all.
        angle = np.arange(_ANGLES if model == "opencv" and any(k[2:4]) else 1) * (2.0 * np.pi / _ANGLES)
        r = np.tan(off_axis)[:, None]
        x, y = r * np.cos(angle), r * np.sin(angle)
        rho = np.hypot(*lens.distorted(np, model, k, x, y))
        # As motion per angle off the axis.
        least = lens.least_stretch(np, model, k, x, y) * (1.0 + r * r)
        bad = np.flatnonzero((least < _LEAST).any(axis=1))
        usable = bad[0] if len(bad) else len(r)
        outside = np.flatnonzero(rho[:usable].min(axis=1) >= farthest)
        pixels = float(np.sqrt(np.prod(focal)))
        if not len(outside):
            last = rho[: max(usable, 1)].min(axis=1).max() * pixels
            at = f"{last:.4g} pixels from the principal point, and the image reaches {farthest * pixels:.4g}"
            if len(bad):
                raise CameraError(
                    f"lens model {model} with {intrinsics.words} folds the image over at {at}: fit the "
                    "calibration to the whole image, or crop the image to where it holds"
                )
            raise CameraError(
                f"lens model {model} with {intrinsics.words} comes to {WIDEST_DEG:g}° off the axis at {at}: "
                "so wide an angle is not supported; crop the image to what is nearer to the axis"
            )
        last = outside[0]
        nodes = np.linspace(0.0, rho[last].max(), _NODES)
        ratio = np.interp(nodes, rho[: last + 1].mean(axis=1), lens.start_of(np, model, r[: last + 1, 0]))
        ratio[1:] /= nodes[1:]
        ratio[0] = 1.0
        found = Distortion(model, k, float(r[last, 0]), float(nodes[-1]), ratio)
        across, down = (np.linspace(-margin, side + margin, 33) for side in size)
        film = np.stack([axis.ravel() for axis in np.meshgrid(across, down)], axis=1)
        v = (film - centre) / focal
        missed = np.abs(found.distorted(found.undistorted(v)) - v).max(axis=1) * pixels
        if not missed.max() < _INVERTED:
            x, y = film[np.nanargmax(missed)]
            raise CameraError(
                f"lens model {model} with {intrinsics.words} cannot be inverted near film point ({x:.4g}, "
                f"{y:.4g}): it all but folds the image over there; fit the calibration to the whole image, "
                "or crop the image"
            )
        return found

    def distorted(self, u: Array) -> Array:
        """D(u) of (..., 2)."""
        inner, beyond = self._split(u)
        x, y = lens.distorted(np, self.model, self.coefficients, inner[..., 0], inner[..., 1])
        return np.stack([x, y], axis=-1) + self._stretched(inner, beyond)

    def stretched(self, u: Array, along: Array) -> Array:
        """D'(u) of vectors (..., 2) at (..., 2); of covectors likewise, for it is symmetric."""
        return self._stretched(self._split(u)[0], along)

    def least_stretch(self, u: Array) -> Array:
        """The smaller eigenvalue of D'(u) at (..., 2)."""
        inner, _ = self._split(u)
        return np.asarray(lens.least_stretch(np, self.model, self.coefficients, inner[..., 0], inner[..., 1]))

    def undistorted(self, v: Array) -> Array:
        """The u (..., 2) with D(u) = v (..., 2) within the disc; beyond it, a point of its rim."""
        rho = np.hypot(v[..., 0], v[..., 1])
        shorter = self.reach / np.maximum(rho, self.reach)
        start = np.interp(rho * shorter, np.linspace(0.0, self.reach, len(self.start)), self.start)
        x, y = v[..., 0] * shorter, v[..., 1] * shorter
        return np.stack(lens.undistorted(np, self.model, self.coefficients, x, y, start), axis=-1)

    def _stretched(self, u: Array, along: Array) -> Array:
        a, b, c = lens.stretch(np, self.model, self.coefficients, u[..., 0], u[..., 1])
        x, y = along[..., 0], along[..., 1]
        return np.stack([a * x + b * y, b * x + c * y], axis=-1)

    def _split(self, w: Array) -> tuple[Array, Array]:
        """The nearest point of the disc, and how far beyond it."""
        r = np.hypot(w[..., 0], w[..., 1])[..., None]
        inner = w * (self.limit / np.maximum(r, self.limit))
        return inner, w - inner
