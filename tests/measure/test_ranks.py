"""Every shipped scene has the rank and the infinite standard deviations that its table derives in words."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from mitsuba_crb import pose_bound

ROOT = Path(__file__).parents[2]
NAMES = ("x", "y", "z", "pitch", "yaw", "roll")


def _table() -> dict[str, tuple[int, set[str]]]:
    """Rank and infinite standard deviations from scenes/README.md."""
    rows = {}
    for line in (ROOT / "scenes" / "README.md").read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        name = re.fullmatch(r"`(\w+)`", cells[0])
        if name and len(cells) == 5:
            infinite = {cell.strip() for cell in cells[4].split(",")} - {"none"}
            rows[name.group(1)] = (int(cells[3].strip("* ")), infinite)
    return rows


TABLE = _table()


def test_the_table_lists_every_scene() -> None:
    assert set(TABLE) == {path.parent.name for path in ROOT.glob("scenes/*/*.xml")}
    assert all(infinite <= set(NAMES) for _, infinite in TABLE.values())


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")
@pytest.mark.parametrize("name", sorted(TABLE))
def test_rank_and_infinities_are_those_of_the_table(name: str, scenes: Path) -> None:
    bound = pose_bound(scenes / name / f"{name}.xml", spp=64, size=(64, 48), seed=2)
    rank, infinite = TABLE[name]
    deviations = np.concatenate([bound.position_std, bound.rotation_std_deg])
    assert bound.rank == rank
    assert {NAMES[i] for i in range(6) if np.isinf(deviations[i])} == infinite
    assert len(bound.unobserved) == 6 - rank
    assert np.all(deviations > 0.0)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")  # nothing of it is resolved
def test_what_a_white_wall_and_the_sky_hide_is_said_in_words(scenes: Path) -> None:
    wall = pose_bound(scenes / "white_wall" / "white_wall.xml", spp=8, size=(32, 24))
    said = " | ".join(direction.description for direction in wall.unobserved)
    for words in ("translation along world axis x", "pitch", "yaw", "rotation about the optical axis (roll)"):
        assert words in said
    sky = pose_bound(scenes / "sky" / "sky.xml", spp=16, size=(32, 24))
    assert all("translation in any direction" in direction.description for direction in sky.unobserved)
    assert sky.length_scale == 1.0
    assert "length scale  1 [scene unit]" in str(sky)
