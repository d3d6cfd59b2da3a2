"""Poses for pose graphs: the lines `VERTEX_SE3:QUAT` and `EDGE_SE3:QUAT`, as g2o and as GTSAM read them.

Vertex 0 is the world, which is to be fixed; an edge from it to vertex k measures pose k. Both tools see the
error of measured⁻¹ world_from_body = exp(ξ) in the body's frame, a right perturbation as ours, but

    g2o      y = (ρ, q_v), q_v the quaternion's vector part, sin(|φ|/2) φ/|φ| ≈ φ/2: A = diag(1, ½)
    GTSAM    y = (φ, ρ), Pose3's tangent; `readG2o` swaps the file's blocks, and takes q_v for φ: A = 1

so that F_g2o = A⁻ᵀ F A⁻¹ has 4 times the information of the rotation that GTSAM must be given: two files.
GTSAM's Cholesky factor of a singular information is wrong without a word: unseen directions are g2o's alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from .. import se3
from ..files import atomic
from .estimates import Estimate
from .headings import UPPER, Heading, blind, refuse_blind

_HALF = np.diag([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])
_WORLD = "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1"


def write_g2o(path: Path, estimates: Sequence[Estimate], heading: Heading) -> list[str]:
    """Write a graph for g2o; returns what there is to say of it."""
    more = (
        "information: right perturbation (the body's frame), order x y z qx qy qz, the vector part of the "
        f"error's quaternion, half an angle; {UPPER}",
        "not for GTSAM, whose readG2o takes that part for an angle: export --to gtsam",
    )
    _write(path, estimates, heading.lines(estimates, *more), _HALF)
    return [
        f"{estimate.name}: no information about {'; '.join(estimate.words)}" for estimate in blind(estimates)
    ]


def write_gtsam(path: Path, estimates: Sequence[Estimate], heading: Heading) -> list[str]:
    """Write a graph for GTSAM's `readG2o(file, True)`, whose factors have the covariance of Pose3's tangent.

    Raises:
        OutputError: something is unseen.
    """
    refuse_blind(estimates, "GTSAM reads no singular information")
    more = (
        "for GTSAM: graph, values = gtsam.readG2o(file, True); fix vertex 0, the world, by a prior",
        "information: right perturbation (the body's frame); here x y z, then rotation [rad], in GTSAM "
        f"rotation first; {UPPER}",
        "not for g2o, whose edges want half angles: export --to g2o",
    )
    _write(path, estimates, heading.lines(estimates, *more), np.eye(6))
    return []


def _write(path: Path, estimates: Sequence[Estimate], head: Sequence[str], jacobian: se3.Array) -> None:
    vertices, edges = [_WORLD], []
    for k, estimate in enumerate(estimates, 1):
        pose = numbers(se3.vector_from_pose(estimate.pose))
        information = estimate.in_coordinates(jacobian)[1][np.triu_indices(6)]
        vertices += [f"# {k} is {' '.join(estimate.name.split())}", f"VERTEX_SE3:QUAT {k} {pose}"]
        edges.append(f"EDGE_SE3:QUAT 0 {k} {pose} {numbers(information)}")
    lines = [*(f"# {line}" for line in head), *vertices, "FIX 0", *edges]
    with atomic(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def numbers(values: se3.Array) -> str:
    """Numbers as text that is read back to the last bit, separated by blanks."""
    return " ".join(repr(float(value) + 0.0) for value in values)  # no -0.0
