"""A method's answer for some pixels of a view, in one go."""

from __future__ import annotations

from typing import Any

import numpy as np

from mitsuba_crb.jacobian.method import Estimates, Method, Paths, estimates


def estimated(
    method: type[Method], view: Any, pixels: Any, *, step_pixels: float | None = None, **paths: int
) -> Estimates:
    """All that it says."""
    mask = np.zeros(view.size[::-1], dtype=bool)
    mask[pixels[:, 1], pixels[:, 0]] = True
    chosen = Paths(**paths)
    return estimates(method.open(view, mask, chosen.seed, step_pixels=step_pixels), pixels, chosen)


def measured(method: type[Method], view: Any, pixels: Any, **options: Any) -> tuple[np.ndarray, np.ndarray]:
    """The columns (K, n, 3, 6) and each batch's image (K, n, 3)."""
    found = estimated(method, view, pixels, **options)
    return found.columns, found.images
