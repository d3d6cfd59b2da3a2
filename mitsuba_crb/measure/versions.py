"""What the numbers depend on beside scene and options: versions."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Mapping
from functools import cache

from ..render import llvm
from ..render.backend import use_mitsuba


def versions() -> dict[str, str]:
    """Versions of everything that the numbers depend on, and Mitsuba's variant."""
    return dict(_versions(use_mitsuba()))


@cache
def _versions(variant: str) -> Mapping[str, str]:
    packages = ("mitsuba_crb", "mitsuba", "drjit", "numpy", "scipy")
    found = {name: importlib.metadata.version(name) for name in packages}
    return {**found, "variant": variant, **({"llvm": llvm.configure().version} if "llvm" in variant else {})}
