"""Flow live against finite differences on shipped scenes, and its intervals; references: test_flow_table.py.

Both sides have independent random numbers; the tolerance covers the step bias of finite differences, and 4
combined standard errors the noise of both.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mitsuba_crb import fisher_information, pose_bound, pose_jacobian
from mitsuba_crb.information.fisher import FisherInformation
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


@pytest.mark.slow
@pytest.mark.parametrize("name", ["textured_wall", "checkerboard_wall", "sky", "striped_wall", "radial_wall"])
def test_flow_agrees_on_shipped_walls(name: str, scenes: Path) -> None:
    flow, fd = _informations(scenes / name / f"{name}.xml", (64, 64), size=(64, 48))
    _assert_agree(flow, fd, 0.04)


def _diagonal_and_trace(F: FisherInformation) -> tuple[np.ndarray, np.ndarray]:
    """The six diagonal entries and the scaled trace, and their standard errors."""
    rows, columns = np.triu_indices(6)
    combine = np.vstack([np.eye(6), F.scale**2])
    covariance = F.covariance_of_entries[np.ix_(rows == columns, rows == columns)]
    return combine @ np.diag(F.matrix), np.sqrt(np.diag(combine @ covariance @ combine.T))


@pytest.mark.slow
def test_intervals_cover_where_contours_share_samples(scenes: Path) -> None:
    """200 seeds of `boxes` at its own size, whose information is in few blocks along its silhouettes: 95 %
    intervals cover in 90 to 99 %, each entry's and the trace's, and standard errors are the scatter within
    15 % (the scatter of 200 values is uncertain by 5 %, with the tails of smooth rims by more)."""
    boxes = scenes / "boxes" / "boxes.xml"
    truth, _ = _diagonal_and_trace(pose_bound(boxes, SIGMA, spp=4096, seed=10**6).information)
    runs = [
        _diagonal_and_trace(pose_bound(boxes, SIGMA, spp=16, seed=seed).information) for seed in range(200)
    ]
    estimates, errors = (np.array(column) for column in zip(*runs, strict=True))
    ratio = estimates.std(axis=0, ddof=1) / np.sqrt((errors**2).mean(axis=0))
    assert np.all(np.abs(ratio - 1.0) < 0.15)
    covered = np.mean(np.abs(estimates - truth) < 1.96 * errors, axis=0)
    assert np.all((covered >= 0.90) & (covered <= 0.99))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "tolerance"), [("boxes", 0.04), ("shadows", 0.05), ("plain_room", 0.05), ("textured_room", 0.06)]
)
def test_flow_agrees_on_shipped_rooms(name: str, tolerance: float, scenes: Path) -> None:
    flow, fd = _informations(scenes / name / f"{name}.xml", (512, 512), size=(64, 48))
    _assert_agree(flow, fd, tolerance)
