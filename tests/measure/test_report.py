"""What is asked beside a bound is of the same view, and does not change the bound."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mitsuba_crb import hcr_bound, pose_bound
from mitsuba_crb.errors import OptionError
from mitsuba_crb.measure import report
from mitsuba_crb.measure.report import bound_report
from mitsuba_crb.noise import Gaussian, Stationary

# Few samples on small images: that standard errors exceed 10 % is expected.
pytestmark = pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")

OPTIONS: dict[str, Any] = {"size": (24, 18), "spp": 16, "seed": 3}
TWISTS = [[0.0, 0.5, 0.0, 0.0, 0.0, 0.0]]


@pytest.fixture
def wall(scenes: Path) -> Path:
    return scenes / "textured_wall" / "textured_wall.xml"


@pytest.mark.slow
@pytest.mark.parametrize("noise", [None, Gaussian(0.02)])
def test_what_is_asked_beside_a_bound_leaves_it_as_it_is(wall: Path, noise: Gaussian | None) -> None:
    told: list[tuple[int, int]] = []
    found = bound_report(
        wall,
        noise,
        displacements=TWISTS,
        pictures=True,
        on_tile=lambda _, done, total: told.append((done, total)),
        **OPTIONS,
    )
    alone = pose_bound(wall, noise, **OPTIONS)
    np.testing.assert_array_equal(found.bound.information.matrix, alone.information.matrix)
    assert found.hcr is not None
    beyond = hcr_bound(wall, noise, displacements=TWISTS, **OPTIONS)
    np.testing.assert_array_equal(found.hcr.position_std, beyond.position_std)
    assert found.pictures is not None
    information = found.bound.information
    trace = np.trace(np.diag(information.scale) @ information.matrix @ np.diag(information.scale))
    assert np.sum(found.pictures.information) == pytest.approx(trace, rel=1e-5)
    assert told[-1] == (24 * 18, 24 * 18)


def test_nothing_is_beside_a_bound_that_nobody_asked_for(wall: Path) -> None:
    found = bound_report(wall, frame="world", defines={"spp": "8"}, **OPTIONS)
    assert found.hcr is None
    assert found.pictures is None
    assert found.bound.frame == "world"
    facts = found.bound.provenance
    assert facts["scene"] == str(wall)
    assert facts["defines"] == {"spp": "8"}
    assert "prior" not in facts
    assert facts["seconds"]["prepare"] <= facts["seconds"]["total"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"hcr": True, "nuisances": ["gain"]}, "neither priors nor nuisances"),
        ({"displacements": TWISTS, "prior": Path("imu.toml")}, "neither priors nor nuisances"),
        ({"noise": Stationary([[0.1, 1.0, 0.1]]), "pictures": True}, "couples pixels"),
    ],
)
def test_what_does_not_go_together_is_refused_before_the_scene_is_read(
    wall: Path, monkeypatch: pytest.MonkeyPatch, options: Any, message: str
) -> None:
    monkeypatch.setattr(report, "SceneFile", None)
    with pytest.raises(OptionError, match=message):
        bound_report(wall, **options, **OPTIONS)
