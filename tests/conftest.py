"""What all tests share: where the shipped scenes and the data of others are; and how to do without Mitsuba.

`pytest --without-mitsuba` runs whatever needs neither Mitsuba nor Dr.Jit: what depends on how NumPy rounds.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import openblas
import pytest

from mitsuba_crb.render import llvm

# Test modules import mitsuba at their top, which loads whatever LLVM it finds.
llvm.configure()

ROOT = Path(__file__).parents[1]


class _Skipper:
    """Skips whatever imports Mitsuba or Dr.Jit, a module of tests or a test, there and then."""

    def find_spec(self, name: str, path: object = None, target: object = None) -> None:
        if name.partition(".")[0] in ("mitsuba", "drjit"):
            pytest.skip(f"imports {name}", allow_module_level=True)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--without-mitsuba", action="store_true", help="skip what imports Mitsuba or Dr.Jit")


def pytest_configure(config: pytest.Config) -> None:
    core = os.environ.get("OPENBLAS_CORETYPE", "")
    if core in openblas.INSTRUCTIONS and openblas.lacking(core):  # they would end the process
        pytest.exit(f"skipped: {openblas.lacking(core)}", returncode=0)
    if config.getoption("--without-mitsuba"):
        sys.meta_path.insert(0, _Skipper())


@pytest.fixture
def scenes() -> Path:
    """The folder of the shipped scenes."""
    return ROOT / "scenes"


@pytest.fixture
def real_scenes() -> Path:
    """Scenes by others; tests that need them are skipped where they are absent."""
    return _by_others("mitsuba")


@pytest.fixture
def captures() -> Path:
    """Posed photographs by others; tests that need them are skipped where they are absent."""
    return _by_others("multiview")


@pytest.fixture
def gaussians() -> Path:
    """Splats by others; tests that need them are skipped where they are absent."""
    return _by_others("gaussians")


def _by_others(kind: str) -> Path:
    folder = ROOT.parent / "shared" / "data" / kind
    if not folder.is_dir():
        pytest.skip(f"needs ../shared/data/{kind}")
    return folder
