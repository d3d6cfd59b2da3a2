"""A method's answer for some pixels of a view, in one go."""

from __future__ import annotations

from typing import Any

import numpy as np

from mitsuba_crb.jacobian.finite_difference import STEP_PIXELS
from mitsuba_crb.jacobian.method import Method, Paths, estimates


def measured(
    method: type[Method], view: Any, pixels: Any, *, step_pixels: float = STEP_PIXELS, **paths: int
) -> tuple[np.ndarray, np.ndarray]:
    """The columns (K, n, 3, 6) and each batch's image (K, n, 3)."""
    mask = np.zeros(view.size[::-1], dtype=bool)
    mask[pixels[:, 1], pixels[:, 0]] = True
    found = estimates(method.open(view, mask, Paths(**paths), step_pixels=step_pixels), pixels)
    return found.columns, found.images
