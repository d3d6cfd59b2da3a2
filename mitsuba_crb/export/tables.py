"""Poses with their matrices as a table (CSV) and as arrays (NPZ), which know infinity and what is no number.

y = ξ = (ρ, φ), translation first, right perturbation `world_from_body exp(ξ)`, as in `se3`: A = 1. What is
unseen is `inf` on the covariance's diagonal and `nan` off it; the information has zeros there. The NPZ's
`axes`, `side`, `order` and `units` say how it is to be read, the CSV's last column does.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from .. import se3
from ..files import atomic
from .estimates import Estimate
from .headings import Heading
from .pose_graph import numbers

COMPONENTS = ("rho_x", "rho_y", "rho_z", "phi_x", "phi_y", "phi_z")
"""Of ξ, as columns are called: translation [scene unit] and rotation [rad]."""
_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_SIDE = "right: world_from_body exp(xi)"
_UNITS = "scene unit for rho, rad for phi"


def write_csv(path: Path, estimates: Sequence[Estimate], heading: Heading) -> list[str]:
    """Write a row for each pose: its position and quaternion, and the 21 numbers of its covariance."""
    upper = list(zip(*np.triu_indices(6), strict=True))
    names = [f"cov_{COMPONENTS[row]}_{COMPONENTS[column]}" for row, column in upper]
    convention = (
        f"{heading.kind}; world_from_body, {estimates[0].body}; covariance of (rho, phi), {_SIDE}, {_UNITS}"
    )
    with atomic(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["name", *_POSE, *names, "convention"])
        for estimate in estimates:
            pose = se3.vector_from_pose(estimate.pose)
            values = [estimate.covariance[entry] for entry in upper]
            writer.writerow([estimate.name, *numbers(np.array([*pose, *values])).split(), convention])
    return []


def write_npz(path: Path, estimates: Sequence[Estimate], heading: Heading) -> list[str]:
    """Write arrays: names (n,), poses (n, 4, 4), covariances and informations (n, 6, 6)."""
    with atomic(path) as temporary, temporary.open("wb") as file:
        np.savez(
            file,
            names=np.array([estimate.name for estimate in estimates]),
            poses=np.stack([estimate.pose for estimate in estimates]),
            covariances=np.stack([estimate.covariance for estimate in estimates]),
            informations=np.stack([estimate.information for estimate in estimates]),
            order=np.array(COMPONENTS),
            side=np.array(_SIDE),
            units=np.array(_UNITS),
            axes=np.array(estimates[0].body),
            source=np.array("; ".join(heading.lines(estimates)[:1])),
        )
    return []
