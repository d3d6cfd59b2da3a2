"""Odometry's covariance: of a way in parts as of the whole, by quadrature, and by simulated motion."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from matrices import misfit
from synthetic_field import heading_pose

from mitsuba_crb import se3
from mitsuba_crb.errors import PlanError
from mitsuba_crb.planning.odometry import Odometry, load_odometry

ODOMETRY = Odometry(0.05, 2.0, 3.0)
START, END = np.array([1.0, -2.0, 0.5]), np.array([4.0, 1.0, 0.0])


def test_a_way_in_parts_is_the_whole_way() -> None:
    points = [START + t * (END - START) for t in (0.0, 0.2, 0.7, 1.0)]
    parts = sum(ODOMETRY.moved(a, b) for a, b in itertools.pairwise(points))
    assert misfit(parts, ODOMETRY.moved(START, END)) < 1e-12


def test_it_is_the_integral_of_white_noise_carried_to_the_world() -> None:
    density = np.diag([0.05**2] * 3 + [np.radians(2.0) ** 2] * 3)
    length, steps = np.linalg.norm(END - START), 2000
    total = np.zeros((6, 6))
    for t in (np.arange(steps) + 0.5) / steps:
        A = se3.adjoint(heading_pose(START + t * (END - START), 0.7))  # whatever the body's axes
        total += length / steps * A @ density @ A.T
    assert misfit(ODOMETRY.moved(START, END), total) < 1e-6


def test_simulated_odometry_ends_as_far_off_as_it_says() -> None:
    """Small steps with independent errors, composed as motions; the position at the end and its rotation."""
    rng = np.random.default_rng(0)
    draws, steps = 4000, 40
    length, d = float(np.linalg.norm(END - START)), (END - START) / np.linalg.norm(END - START)
    sigma = np.array([0.05] * 3 + [np.radians(2.0)] * 3) * np.sqrt(length / steps)
    poses = np.broadcast_to(heading_pose(START, 0.0), (draws, 4, 4))
    step = heading_pose(d * length / steps, 0.0)
    for _ in range(steps):
        poses = poses @ step @ se3.exp(sigma * rng.normal(size=(draws, 6)))
    error = se3.log(poses @ se3.inverse(heading_pose(END, 0.0)))
    Q = ODOMETRY.moved(START, END)
    ratio = np.linalg.eigvals(np.linalg.solve(Q, np.cov(error.T))).real
    # A Wishart matrix's relative eigenvalues are within 1 ± 2√(6/n); the steps add half of one in forty.
    assert (abs(ratio - 1.0) < 2.0 * np.sqrt(6 / draws) + 0.06).all()
    J = np.hstack([np.eye(3), -se3.skew(END)])
    position = length * 0.05**2 * np.eye(3)
    position += length**3 / 3.0 * np.radians(2.0) ** 2 * (np.eye(3) - np.outer(d, d))
    np.testing.assert_allclose(J @ Q @ J.T, position, atol=1e-12)


def test_a_turn_on_the_spot_leaves_the_position_alone() -> None:
    Q = ODOMETRY.turned(END, np.array([0.0, 0.5]))
    assert not Q[0].any()
    J = np.hstack([np.eye(3), -se3.skew(END)])
    np.testing.assert_allclose(J @ Q[1] @ J.T, 0.0, atol=1e-15)
    np.testing.assert_allclose(Q[1, 3:, 3:], 0.5 * np.radians(3.0) ** 2 * np.eye(3))


def test_a_file_says_it(tmp_path: Path) -> None:
    file = tmp_path / "odometry.toml"
    file.write_text("translation_per_sqrt_length = 0.05\nrotation_deg_per_sqrt_length = 2.0\n")
    assert load_odometry(file) == Odometry(0.05, 2.0)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("translation_per_length = 1.0", "unknown key .*; did you mean 'translation_per_sqrt_length'"),
        ("translation_per_sqrt_length = 0.1", "has no rotation_deg_per_sqrt_length"),
        ("translation_per_sqrt_length = -0.1\nrotation_deg_per_sqrt_length = 1.0", "must be at least 0"),
        ('translation_per_sqrt_length = "a"\nrotation_deg_per_sqrt_length = 1.0', "must be a number"),
        ("translation_per_sqrt_length = inf\nrotation_deg_per_sqrt_length = 1.0", "finite"),
        ("translation_per_sqrt_length", "is no TOML"),
    ],
)
def test_a_file_that_says_something_else_is_refused(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "odometry.toml"
    file.write_text(text)
    with pytest.raises(PlanError, match=words) as caught:
        load_odometry(file)
    assert "odometry.toml" in str(caught.value)
