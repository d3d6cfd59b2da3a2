"""Symmetric matrices compared on the scale of their diagonals: entries that nearly cancel have no digits."""

from __future__ import annotations

from typing import Any

import numpy as np


def misfit(found: Any, expected: Any) -> float:
    """The largest |A_ij − C_ij| / √|C_ii C_jj| of found A and expected C, both finite."""
    A, C = np.asarray(found, dtype=np.float64), np.asarray(expected, dtype=np.float64)
    assert A.shape == C.shape
    d = np.sqrt(np.abs(np.diagonal(C)))
    scale = np.outer(d, d)
    different = A != C  # where both are zero the diagonal may be, too
    return float(np.max(np.abs(A - C)[different] / scale[different], initial=0.0))
