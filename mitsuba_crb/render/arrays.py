"""NumPy arrays into kernels and out of them, so that equal work has equal kernels."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray


def upload(kind: Any, values: NDArray[Any]) -> Any:
    """An array as kernel input of type `kind` (mi.Float, mi.UInt32), in aligned memory.

    Dr.Jit shares NumPy's memory, and compiles one kernel for aligned and another for unaligned inputs.
    NumPy's alignment is a matter of chance, so that kernels would be compiled again at random.
    """
    import mitsuba as mi

    dtype = np.float32 if kind is mi.Float else np.uint32
    memory = np.empty(4 * values.size + 64, dtype=np.uint8)
    start = -memory.ctypes.data % 64
    aligned = memory[start : start + 4 * values.size].view(dtype)
    aligned[:] = values
    return kind(aligned)


def widened(rows: NDArray[Any]) -> NDArray[Any]:
    """Rows (n, …) of n lanes, a lone one twice: Dr.Jit makes one entry a scalar, in a new kernel."""
    return np.repeat(rows, 2, axis=0) if len(rows) == 1 else rows


def download(value: Any) -> NDArray[np.float64]:
    """A Dr.Jit array of d components as (d, n) float64.

    Evaluated first, and by component: NumPy's conversion of the whole compiles its width into the kernel.
    """
    dr.eval(value)
    return np.array([np.array(component) for component in value], dtype=np.float64)
