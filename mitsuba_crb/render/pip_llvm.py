"""Names pip's LLVM library to Dr.Jit, for scripts that import Mitsuba right after this package.

Dr.Jit chooses its LLVM when it is first imported, so it is named when `mitsuba_crb` is imported, for whatever
purpose: in about a millisecond, from the package's own record alone. To import `importlib.metadata` takes
twenty, and whether a library works takes a process, which `llvm` starts.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import suppress

PACKAGE = "karellen-llvm-core"

VARIABLE = "DRJIT_LIBLLVM_PATH"
"""The environment variable from which Dr.Jit takes the path of its LLVM library."""


def libraries() -> list[str]:
    """Paths of the LLVM libraries that pip has installed, each once."""
    recorded = (path for folder in sys.path for path in _recorded(folder))
    names = ("libLLVM.", "libLLVM-")
    found = dict.fromkeys(os.path.realpath(p) for p in recorded if os.path.basename(p).startswith(names))
    return [path for path in found if os.path.isfile(path)]


def name_to_drjit() -> None:
    """Set the variable, unless somebody has, or Dr.Jit has loaded a library."""
    if "drjit" in sys.modules or os.environ.get(VARIABLE):
        return
    for path in libraries()[:1]:
        os.environ[VARIABLE] = path


def _recorded(folder: str) -> Iterator[str]:
    """The files of the package if it is installed in this folder."""
    with suppress(OSError):  # no such folder, or no record
        for entry in os.listdir(folder):
            if entry.startswith(f"{PACKAGE.replace('-', '_')}-") and entry.endswith(".dist-info"):
                with open(os.path.join(folder, entry, "RECORD"), encoding="utf-8") as record:
                    yield from (os.path.join(folder, line.partition(",")[0]) for line in record)
