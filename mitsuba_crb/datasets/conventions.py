"""What a pose may mean: the camera's axes, which way it maps, and which of a quaternion's numbers is last.

Most formats say it, or custom does; `--convention` is for those that do not.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from difflib import get_close_matches

import numpy as np
from numpy.typing import ArrayLike

from ..errors import PoseError
from ..se3 import Array, as_pose, inverse

AXES = {"mitsuba": (1.0, 1.0, 1.0), "opencv": (-1.0, -1.0, 1.0), "opengl": (-1.0, 1.0, -1.0)}
"""Names of camera axes, and the diagonal matrix that turns them to ours, which are Mitsuba's."""

_IN_WORDS = {
    "mitsuba": "x left, y up, z forward",
    "opencv": "x right, y down, z forward",
    "opengl": "x right, y up, z back",
}
MAPS = ("world_from_camera", "camera_from_world")
ORDERS = ("xyzw", "wxyz")


@dataclass(frozen=True, eq=False)
class Convention:
    """Of a file of poses; None is what is not said."""

    axes: str | None = None
    """A name in `AXES`."""
    maps: str | None = None
    """One of `MAPS`."""
    order: str | None = None
    """One of `ORDERS`, of quaternions."""
    body_from_camera: Array | None = None
    """4 x 4, if the poses are those of a body that carries the camera."""

    @property
    def words(self) -> str:
        """In a sentence."""
        axes = f"camera axes {_IN_WORDS[self.axes or 'mitsuba']} ({self.axes or 'mitsuba'})"
        order = f", quaternions in the order {' '.join(self.order)}" if self.order else ""
        return f"{self.maps or MAPS[0]}, {axes}{order}"

    def ours(self, matrices: Array) -> Array:
        """Rigid motions (n, 4, 4) of this convention as world_from_camera in our axes."""
        if self.maps == "camera_from_world":
            matrices = np.array([inverse(matrix) for matrix in matrices]).reshape(-1, 4, 4)
        if self.body_from_camera is not None:
            matrices = matrices @ self.body_from_camera
        return np.asarray(matrices * np.array([*AXES[self.axes or "mitsuba"], 1.0]))


def parse_convention(text: str | None, body_from_camera: ArrayLike | None = None) -> Convention:
    """Of words such as "opencv", or "opengl camera_from_world wxyz", separated by blanks or commas.

    Raises:
        PoseError: a word is unknown, two contradict each other, or body_from_camera is no rigid motion.
    """
    found: dict[str, str] = {}
    for word in filter(None, re.split(r"[\s,]+", (text or "").strip().lower())):
        kinds = {"axes": tuple(AXES), "maps": MAPS, "order": ORDERS}
        kind = next((name for name, words in kinds.items() if word in words), None)
        known = [known for words in kinds.values() for known in words]
        if kind is None:
            near = get_close_matches(word, known, 1)
            hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(known)}"
            raise PoseError(f"the convention {word!r} is not known; {hint}")
        if found.setdefault(kind, word) != word:
            raise PoseError(f"the convention {text!r} says both {found[kind]} and {word}")
    body = None if body_from_camera is None else as_pose(body_from_camera, "body_from_camera")
    return Convention(found.get("axes"), found.get("maps"), found.get("order"), body)


def settled(given: Convention, custom: Convention, where: str, *, fixed: bool) -> Convention:
    """What holds for a file: its format's custom, and what the user says of it.

    Args:
        given: what the user says.
        custom: of the format; its order is None if it has no quaternions.
        where: what messages begin with.
        fixed: the format defines its convention, and the user may at most repeat it.

    Raises:
        PoseError: the user contradicts the format.
    """
    if given.order and custom.order is None:
        raise PoseError(f"{where} has no quaternions; leave {given.order} out of the convention")
    for mine, theirs in ((given.axes, custom.axes), (given.maps, custom.maps), (given.order, custom.order)):
        if fixed and mine is not None and mine != theirs:
            raise PoseError(f"{where} is {custom.words} by definition; leave {mine} out of the convention")
    if fixed and given.body_from_camera is not None:
        raise PoseError(f"{where} has the camera's own poses; leave body_from_camera out")
    # The body's poses say nothing of the camera's axes; body_from_camera does, which calibrations write.
    axes = custom.axes if given.body_from_camera is None else "opencv"
    return Convention(
        given.axes or axes,
        given.maps or custom.maps,
        given.order or custom.order,
        given.body_from_camera,
    )
