"""What all tests share: where the shipped scenes and the data of others are."""

from __future__ import annotations

from pathlib import Path

import pytest

from mitsuba_crb import llvm

# Test modules import mitsuba at their top, which loads whatever LLVM it finds.
llvm.configure()

ROOT = Path(__file__).parents[1]


@pytest.fixture
def scenes() -> Path:
    """The folder of the shipped scenes."""
    return ROOT / "scenes"


@pytest.fixture
def real_scenes() -> Path:
    """Scenes by others; tests that need them are skipped where they are absent."""
    folder = ROOT.parent / "shared" / "data" / "mitsuba"
    if not folder.is_dir():
        pytest.skip("needs ../shared/data/mitsuba")
    return folder
