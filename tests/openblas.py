"""OpenBLAS picks its kernels, and so how sums are rounded, by processor, or as OPENBLAS_CORETYPE says."""

from __future__ import annotations

import ctypes
import re
from pathlib import Path

INSTRUCTIONS = {"Nehalem": "sse4_2", "Haswell": "avx2", "Zen": "avx2", "SkylakeX": "avx512f"}
"""Kernels, and what a processor must have to run them."""

_QUESTIONS = ("scipy_openblas_get_corename64_", "scipy_openblas_get_corename", "openblas_get_corename")


def lacking(core: str) -> str:
    """Why this processor cannot run such kernels; empty if it can."""
    needed = INSTRUCTIONS[core]
    processor = Path("/proc/cpuinfo")
    known = processor.read_text(encoding="utf-8") if processor.exists() else ""
    return "" if re.search(rf"^flags\b.*\b{needed}\b", known, re.MULTILINE) else f"{core} needs {needed}"


def in_use() -> dict[str, str]:
    """The kernels of each OpenBLAS that NumPy and SciPy have loaded, by the library's name."""
    import numpy  # noqa: F401  loads one
    import scipy.linalg  # noqa: F401  loads another

    maps = Path("/proc/self/maps").read_text(encoding="utf-8")
    found = {}
    for path in sorted(set(re.findall(r"/\S*openblas\S*", maps))):
        library = ctypes.CDLL(path)
        for question in _QUESTIONS:
            if hasattr(library, question):
                ask = getattr(library, question)
                ask.restype = ctypes.c_char_p
                found[Path(path).name] = ask().decode()
    return found
