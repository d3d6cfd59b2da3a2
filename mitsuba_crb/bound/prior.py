"""What is known of a pose before the image: by an IMU, a wheel, a survey; as information with its frame.

`PriorTable` says what stands in its TOML or JSON file: a frame and either information, or a covariance, or
standard deviations.

Standard deviations are of the camera's centre along the frame's axes [scene unit] and of its rotation about
axes through that centre [deg]: with R the frame's from the camera's axes, of (R ρ, R φ) with ξ the camera
twist, which in the world frame is not the world twist (`se3`). A matrix is of either, as `kind` says.

Messages of ROS (`geometry_msgs/PoseWithCovariance`) have 36 numbers row by row, in the order x, y, z and
rotations about them: those of `kind = "axes"` in a fixed frame. All zeros say there that nothing is known,
and a first number of −1 (`sensor_msgs/Imu`) that there is no such measurement.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import BeforeValidator, Field, PositiveFloat

from .. import se3
from ..errors import PriorError
from ..files import Record, Table, checked, expected, read_json, read_toml
from ..noise.covariance import positive_matrix
from ..se3 import Array, Frame

TWIST = ("x", "y", "z", "phi_x", "phi_y", "phi_z")
"""Names of a twist's entries, in messages."""


def _rows(value: Any) -> Any:
    """36 numbers in a row as six rows."""
    flat = isinstance(value, list) and len(value) == 36 and not any(isinstance(row, list) for row in value)
    return [value[i : i + 6] for i in range(0, 36, 6)] if flat else value


Matrix = Annotated[list[list[float]], expected("a 6 x 6 matrix of numbers"), BeforeValidator(_rows)]
Kind = Literal["twist", "axes"]
Axes = Annotated[tuple[PositiveFloat, PositiveFloat, PositiveFloat], Field(strict=False)]
Deviations = Annotated[PositiveFloat | Axes, expected("a positive number or three of them")]


class PriorTable(Table):
    """A prior's file."""

    frame: Frame
    """Whose axes."""
    information: Matrix | None = None
    """6 x 6, of the twist ξ = (ρ, φ) in that frame; zeros where nothing is known."""
    covariance: Matrix | None = None
    """6 x 6, likewise, positive definite."""
    kind: Kind | None = None
    """What a matrix is of, see `PosePrior`; without it a twist's, but 36 numbers in a row are not guessed."""
    position_std: Deviations = np.inf
    """Along the frame's axes [scene unit]; infinite where unknown."""
    rotation_std_deg: Deviations = np.inf
    """About the frame's axes [deg]; infinite where unknown."""


@dataclass(frozen=True, eq=False)
class PosePrior(Record):
    """Exact information about a pose, in a frame."""

    matrix: Array
    """(6, 6), symmetric and positive semi-definite, of the variable that `kind` says."""
    frame: Frame
    """Whose axes."""
    kind: Kind = "twist"
    """`"axes"`: of (R ρ, R φ), displacement and rotation of the camera's centre along the frame's axes."""

    def __post_init__(self) -> None:
        if self.frame not in ("camera", "world"):
            raise PriorError(f"the frame of a prior is 'camera' or 'world', not {self.frame!r}")
        object.__setattr__(self, "matrix", _information(self.matrix, "information"))

    def in_frame(self, frame: Frame, pose: ArrayLike) -> Array:
        """(6, 6), information of the twist in `frame` at `pose`, world_from_camera."""
        world_from_camera = np.asarray(pose, dtype=np.float64)
        own_from_camera: Array = np.eye(6)
        if self.frame == "world":
            own_from_camera = (
                se3.adjoint(world_from_camera)
                if self.kind == "twist"
                else np.asarray(np.kron(np.eye(2), world_from_camera[:3, :3]), dtype=np.float64)
            )
        camera = own_from_camera.T @ self.matrix @ own_from_camera
        return camera if frame == "camera" else se3.move_information(camera, se3.adjoint(world_from_camera))


def load_prior(path: Path) -> PosePrior:
    """The prior in a TOML or JSON file.

    Raises:
        PriorError: the file cannot be read, or says something else than `PriorTable` allows.
    """
    read = read_json if path.suffix.lower() == ".json" else read_toml
    document = read(path, PriorError)
    try:
        return prior_from_dict(document)
    except PriorError as error:
        raise PriorError(f"{path}: {error}") from error


def prior_from_dict(document: Any) -> PosePrior:
    """The prior that a file's contents describe.

    Raises:
        PriorError: as `load_prior`.
    """
    table = checked(PriorTable, document, PriorError, "a prior")
    given = table.model_fields_set - {"frame", "kind"}
    matrices = given & {"information", "covariance"}
    if not given or (matrices and len(given) > 1):
        raise PriorError(
            "a prior needs a frame and either information, or covariance, or position_std and "
            f"rotation_std_deg; got {', '.join(document)}"
        )
    if matrices:
        return _of_matrix(table, in_a_row=not isinstance(document[min(matrices)][0], list))
    if table.kind is not None:
        raise PriorError(f"kind goes with information or covariance, not with {', '.join(sorted(given))}")
    position, rotation = (np.broadcast_to(std, 3) for std in (table.position_std, table.rotation_std_deg))
    with np.errstate(over="ignore"):
        information = np.diag(np.concatenate([position, np.radians(rotation)]) ** -2.0)
    return PosePrior(information, table.frame, "axes")


def _of_matrix(table: PriorTable, *, in_a_row: bool) -> PosePrior:
    if in_a_row and table.frame == "world" and table.kind is None:
        raise PriorError(
            "36 numbers in a row in the world frame need kind = 'axes' if they are of the camera's centre "
            "and its rotation about it, as in ROS messages, or kind = 'twist' if of a world-frame twist"
        )
    kind = table.kind or "twist"
    if table.information is not None:
        return PosePrior(_information(table.information, "information"), table.frame, kind)
    covariance = table.covariance
    if covariance and covariance[0] and covariance[0][0] == -1.0:
        raise PriorError(
            "the covariance of a prior begins with -1, by which ROS messages say that there is none: leave "
            "the prior out"
        )
    matrix = _information(covariance, "covariance")
    return PosePrior(np.asarray(np.linalg.inv(matrix), dtype=np.float64), table.frame, kind)


def _information(value: Any, what: str) -> Array:
    definite = what == "covariance"
    cure = ""
    if definite:
        unknown = " (all zeros in ROS messages: leave the prior out)" if not any(map(any, value)) else ""
        cure = f"give information, in which zeros are allowed, where a direction is unknown{unknown}"
    return positive_matrix(
        value, f"the {what} of a prior", PriorError, size=6, definite=definite, cure=cure, names=TWIST
    )
