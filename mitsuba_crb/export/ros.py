"""Poses for ROS: `geometry_msgs/PoseWithCovarianceStamped` as YAML, a document for each.

Its covariance is of (x, y, z, rotation about X, Y, Z), about the fixed axes of `frame_id`, row by row. With
R ← Exp(θ) R, c ← c + δ and world_from_body exp(ξ) = (R Exp(φ), c + Rρ):

    δ = R ρ,    θ = R φ:    A = diag(R, R)

no left se(3) twist, whose translation turns the origin's lever arm along. ROS has no infinite variance.
`ros2 topic pub /pose geometry_msgs/msg/PoseWithCovarianceStamped --yaml-file FILE` sends what is written.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from .. import se3
from ..files import atomic
from ..se3 import Array
from .estimates import Estimate
from .headings import Heading, refuse_blind
from .pose_graph import numbers

ORDER = "x y z, rotation about the world's fixed axes X Y Z"


def about_fixed_axes(pose: Array) -> Array:
    """A (6, 6) with (δ, θ) = A ξ: the body's origin along the world's axes, and its rotation about them."""
    zero = np.zeros((3, 3))
    return np.block([[pose[:3, :3], zero], [zero, pose[:3, :3]]])


def write_ros(path: Path, estimates: Sequence[Estimate], heading: Heading) -> list[str]:
    """Write the messages; returns what there is to say of them.

    Raises:
        OutputError: something is unseen.
    """
    refuse_blind(estimates, "ROS has no infinite variances")
    kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
    head = heading.lines(estimates, kind, f"covariance: {ORDER}, row by row")
    messages = [_message(estimate) for estimate in estimates]
    text = "\n".join([*(f"# {line}" for line in head), "---\n".join(messages)])
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return []


def _message(estimate: Estimate) -> str:
    x, y, z, qx, qy, qz, qw = numbers(se3.vector_from_pose(estimate.pose)).split()
    covariance, _ = estimate.in_coordinates(about_fixed_axes(estimate.pose))
    rows = [numbers(row).replace(" ", ", ") for row in covariance]
    seconds, nanoseconds = stamp(estimate.name) or (0, 0)
    lines = [
        f"# {' '.join(estimate.name.split())}",
        "header:",
        f"  stamp: {{sec: {seconds}, nanosec: {nanoseconds}}}",
        "  frame_id: world",
        "pose:",
        "  pose:",
        f"    position: {{x: {x}, y: {y}, z: {z}}}",
        f"    orientation: {{x: {qx}, y: {qy}, z: {qz}, w: {qw}}}",
        "  covariance: [",
        *(f"    {row}," for row in rows),
        "  ]",
    ]
    return "\n".join(lines) + "\n"


def stamp(name: str) -> tuple[int, int] | None:
    """Seconds and nanoseconds of a time stamp in seconds or, of 15 digits and more, nanoseconds; or None."""
    found = re.fullmatch(r"(\d+)(?:\.(\d{1,9}))?", name)
    if found is None:
        return None
    whole = int(found[1])
    if found[2] is None and len(found[1]) >= 15:
        return divmod(whole, 10**9)
    return whole, int((found[2] or "0").ljust(9, "0"))
