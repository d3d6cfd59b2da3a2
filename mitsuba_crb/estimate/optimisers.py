"""Down a misfit from pose to pose: Gauss–Newton and Levenberg–Marquardt on SE(3), and iNeRF's recipe.

With E, g and F as in `misfit`,

    Gauss–Newton        x ← x exp(F⁻¹ g)
    Levenberg–Marquardt x ← x exp((F + λ diag F)⁻¹ g), λ lowered where E falls and raised where it does not
    iNeRF               Adam on ξ, g from a random batch of pixels

References: Yen-Chen et al., "iNeRF: Inverting Neural Radiance Fields for Pose Estimation", IROS 2021, section
3; Nocedal and Wright, "Numerical Optimization", 2nd ed., sections 10.2 and 10.3.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from .. import se3
from ..se3 import Array
from .misfit import Misfit

Status = Literal["converged", "diverged", "out of iterations"]
"""Of a search."""

SMALL_MOTION = 0.1
"""A step that moves the image by less ends a search without an anchor, where the renderer's noise is larger
than the image's [pixel]."""
DAMPING = 1e-3
"""First λ of Levenberg–Marquardt."""

_SMALL_STEP = 0.1
"""A step below this many standard deviations of the bound ends the search at an anchor."""
_NEAR = 3.0
"""Steps shorter than this many standard deviations that do not shrink are damped: 1/2, 1/3, …"""
_VISIBLE_FALL = 1e-3
"""Relative fall of E that the renderer's noise does not hide; smaller ones are not insisted on."""
_LOST = 10.0
"""Growth of E at which a search is given up."""
_FIRST, _SECOND = 0.9, 0.999
"""Adam's decay of the mean and of the mean square."""
_FAR = 1.0
"""A step that turns the camera by more [rad], or moves it by more [length scale], has lost it."""


def least_squares(misfit: Misfit, pose: Array, damping: float, iterations: int) -> tuple[Array, Status, int]:
    """Levenberg–Marquardt, or Gauss–Newton without damping."""
    difference = misfit.difference(pose)
    first = error = misfit.error(difference)
    gain, last = 1.0, np.inf
    for iteration in range(1, iterations + 1):
        step = _step(misfit, difference.mean(axis=0), damping)
        if step is None or _lost(misfit, step):
            return pose, "diverged", iteration
        if misfit.anchored:
            length = float(
                np.sqrt(step @ misfit.plain @ step / (1.0 + misfit.excess(difference, misfit.plain)))
            )
            # Edges cross samples one by one: close by, R̂ is a staircase on which full steps never end.
            # Steps as in stochastic approximation average over it (Robbins and Monro 1951).
            if 0.5 * last < length < _NEAR:
                gain = gain / (1.0 + gain)
            last = length
            small = gain * length < _SMALL_STEP
        else:
            small = misfit.motion(pose, pose @ se3.exp(step)) < SMALL_MOTION
        candidate = pose @ se3.exp(gain * step)
        attempt = misfit.difference(candidate)
        new = misfit.error(attempt)
        if damping > 0.0 and not new < error:
            expected_fall = 0.5 * float(step @ misfit.gradient(difference.mean(axis=0)))
            if expected_fall > _VISIBLE_FALL * error:
                damping *= 10.0
                continue
        damping *= 0.1
        pose, difference, error = candidate, attempt, new
        if not error < _LOST * first:
            return pose, "diverged", iteration
        if small:
            return pose, "converged", iteration
        misfit.differentiate(pose)
        if not np.diagonal(misfit.plain).all():
            return pose, "diverged", iteration
    return pose, "out of iterations", iterations


def adam(misfit: Misfit, pose: Array, rate: float, count: int, iterations: int) -> tuple[Array, Status, int]:
    """Adam on the twist, from random batches of pixels."""
    rng = np.random.default_rng(misfit.run.options.seed)
    scale = misfit.run.linearisation.scale
    first, second = np.zeros(6), np.zeros(6)
    for iteration in range(1, iterations + 1):
        chosen = np.sort(rng.permutation(len(misfit.pixels))[:count])
        slope = -scale * misfit.slope(pose, chosen, misfit.run.options.seed + iteration)
        first = _FIRST * first + (1.0 - _FIRST) * slope
        second = _SECOND * second + (1.0 - _SECOND) * slope**2
        mean, square = first / (1.0 - _FIRST**iteration), second / (1.0 - _SECOND**iteration)
        falling = rate * 0.8 ** (iteration / 100.0)
        pose = pose @ se3.exp(-falling * scale * mean / (np.sqrt(square) + np.finfo(float).tiny))
    misfit.differentiate(pose)
    step = _step(misfit, misfit.difference(pose).mean(axis=0), 0.0)
    near = step is not None and float(step @ misfit.plain @ step) < 1.0
    return pose, "converged" if near else "out of iterations", iterations


def _step(misfit: Misfit, difference: Array, damping: float) -> Array | None:
    """(F + λ diag F)⁻¹ g, or None if F is singular."""
    matrix = misfit.plain + damping * np.diag(np.diagonal(misfit.plain))
    # In units in which the diagonal is one: radians and scene units are not comparable.
    d = 1.0 / np.sqrt(np.maximum(np.diagonal(matrix), np.finfo(float).tiny))
    try:
        step = d * np.linalg.solve(d[:, None] * matrix * d, d * misfit.gradient(difference))
    except np.linalg.LinAlgError:
        return None
    return step if np.isfinite(step).all() else None


def _lost(misfit: Misfit, step: Array) -> bool:
    moved = np.linalg.norm(step[:3]) / misfit.run.length_scale
    return bool(moved > _FAR or np.linalg.norm(step[3:]) > _FAR)
