"""Flow live against finite differences on shipped scenes, and its intervals; references: test_flow_table.py.

Both sides have independent random numbers; the tolerance covers the step bias of finite differences, and 4
combined standard errors the noise of both.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_scenes import T, scene, wall

from mitsuba_crb import fisher_information, pose_bound, pose_jacobian
from mitsuba_crb.information import FisherInformation
from mitsuba_crb.noise import Gaussian

# Few samples on small images: that standard errors exceed 10 % is expected.
pytestmark = pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")

SIGMA = Gaussian(0.01)


def _informations(which: Any, spp: tuple[int, int], **options: Any) -> tuple[FisherInformation, ...]:
    return tuple(
        fisher_information(pose_jacobian(which, method=method, spp=n, seed=seed, **options), SIGMA)
        for method, n, seed in (("flow", spp[0], 1), ("finite_difference", spp[1], 2))
    )


def _assert_agree(flow: FisherInformation, fd: FisherInformation, tolerance: float) -> None:
    root = np.sqrt(np.maximum(np.diag(fd.matrix), 0.0))  # an unseen direction's estimate may be negative
    allowed = tolerance * np.outer(root, root) + 4 * np.hypot(flow.standard_error, fd.standard_error)
    assert np.all(np.abs(flow.matrix - fd.matrix) <= allowed)


BOX = {
    "type": "cube",
    "to_world": T().translate([0.1, 0.2, 2.0]).rotate([1, 1, 0], 35).scale(0.25),
    "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.9}},
}
# A lamp before the box lights it, and has a silhouette that only other cameras would see.
HIDDEN = scene(
    wall=wall(),
    box=BOX,
    lamp={"type": "sphere", "center": [0.15, 0.2, 1.5], "radius": 0.15, "emitter": {"type": "area"}},
) | {"integrator": {"type": "path", "max_depth": 2, "hide_emitters": True}}


def test_flow_agrees_with_finite_differences_where_emitters_are_hidden() -> None:
    _assert_agree(*_informations(HIDDEN, (256, 256)), 0.05)


@pytest.mark.parametrize("name", ["textured_wall", "checkerboard_wall", "sky", "striped_wall", "radial_wall"])
def test_flow_agrees_on_shipped_walls(name: str, scenes: Path) -> None:
    flow, fd = _informations(scenes / name / f"{name}.xml", (64, 64), size=(64, 48))
    _assert_agree(flow, fd, 0.04)


@pytest.mark.slow
def test_intervals_cover_where_contours_share_samples(scenes: Path) -> None:
    """200 seeds of `boxes`, whose information is in few blocks along its silhouettes: standard errors have no
    bias (ratio to the scatter within 15 %), but are uncertain themselves by 10 to 15 %, as if from 20 to 50
    degrees of freedom, for which 1.96 standard errors cover 93.5 to 94.5 %. So: 90 to 99 % on average, and no
    entry more than three binomial errors (1.8 % each) below that."""
    boxes = scenes / "boxes" / "boxes.xml"
    options: dict[str, Any] = {"size": (96, 72), "method": "flow"}
    reference = pose_bound(boxes, SIGMA, spp=4096, seed=10**6, **options).information
    runs = [pose_bound(boxes, SIGMA, spp=16, seed=seed, **options).information for seed in range(200)]
    estimates = np.array([np.diag(run.matrix) for run in runs])
    errors = np.array([np.diag(run.standard_error) for run in runs])
    ratio = estimates.std(axis=0, ddof=1) / np.sqrt((errors**2).mean(axis=0))
    assert np.all(np.abs(ratio - 1.0) < 0.15)
    covered = np.mean(np.abs(estimates - np.diag(reference.matrix)) < 1.96 * errors, axis=0)
    assert 0.90 <= covered.mean() <= 0.99
    assert np.all(covered >= 0.85)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "tolerance"), [("boxes", 0.04), ("shadows", 0.05), ("plain_room", 0.05), ("textured_room", 0.06)]
)
def test_flow_agrees_on_shipped_rooms(name: str, tolerance: float, scenes: Path) -> None:
    flow, fd = _informations(scenes / name / f"{name}.xml", (512, 512), size=(64, 48))
    _assert_agree(flow, fd, tolerance)
