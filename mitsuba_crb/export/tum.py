"""A trajectory as TUM writes it, with the 21 numbers of a covariance behind each pose.

    timestamp tx ty tz qx qy qz qw c11 c12 ... c16 c22 ... c66

of (x, y, z, rotation about the world's fixed axes X, Y, Z), as in `ros`: A = diag(R, R). A text of plain
numbers has no infinity that every reader knows: if something is unseen, all rows have informations instead,
F_y = A⁻ᵀ F A⁻¹, and the header and the names of the columns say so.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from .. import se3
from ..files import atomic
from .estimates import Estimate
from .headings import UPPER, Heading, said_blind
from .pose_graph import numbers
from .ros import ORDER, about_fixed_axes, stamp

_POSE = "tx ty tz qx qy qz qw"


def write_tum(path: Path, estimates: Sequence[Estimate], heading: Heading) -> list[str]:
    """Write the trajectory; returns what there is to say of it."""
    notes = said_blind(estimates)
    what, letter = ("information", "f") if notes else ("covariance", "c")
    upper = np.triu_indices(6)
    names = " ".join(f"{letter}{row + 1}{column + 1}" for row, column in zip(*upper, strict=True))
    timed = all(stamp(estimate.name) for estimate in estimates)
    head = heading.lines(
        estimates,
        *notes,
        f"{what}: {ORDER}; {UPPER}",
        *([] if timed else ["the time stamp is the pose's place, from 0, as the result has none"]),
        f"timestamp {_POSE} {names}",
    )
    lines = [f"# {line}" for line in head]
    for place, estimate in enumerate(estimates):
        matrices = estimate.in_coordinates(about_fixed_axes(estimate.pose))
        time = estimate.name if timed else str(place)
        pose = numbers(se3.vector_from_pose(estimate.pose))
        lines.append(f"{time} {pose} {numbers(matrices[bool(notes)][upper])}")
    with atomic(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return notes
