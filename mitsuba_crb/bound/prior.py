"""What is known of a pose before the image: by an IMU, a wheel, a survey; as information with its frame.

A file, TOML or JSON, has a `frame`, "camera" or "world", and one of

    information = [[...], ...]     6 x 6, of the twist ξ = (ρ, φ) in that frame; zeros where nothing is known
    covariance = [[...], ...]      6 x 6, likewise, positive definite
    position_std, rotation_std_deg a number or three of the frame's axes, `inf` (or left out) where unknown

Standard deviations are of the camera's centre along the frame's axes [scene unit] and of its rotation about
axes through that centre [deg]: with R the frame's from the camera's axes, of (R ρ, R φ) with ξ the camera
twist, which in the world frame is not the world twist (`se3`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from .. import se3
from ..errors import PriorError
from ..files import read_json, read_toml
from ..se3 import Array, Frame

_KEYS = ("information", "covariance", "position_std", "rotation_std_deg")


@dataclass(frozen=True, eq=False)
class PosePrior:
    """Exact information about a pose, in a frame."""

    matrix: Array
    """(6, 6), symmetric and positive semi-definite, of the variable that `kind` says."""
    frame: Frame
    """Whose axes."""
    kind: Literal["twist", "axes"] = "twist"
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
        PriorError: the file cannot be read, or says something else than the module's docstring allows.
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
    if not isinstance(document, Mapping):
        raise PriorError("a prior is a table with the keys frame and one of " + ", ".join(_KEYS))
    unknown = [key for key in document if key not in (*_KEYS, "frame")]
    if unknown:
        raise PriorError(f"unknown key {', '.join(unknown)}; keys: frame, {', '.join(_KEYS)}")
    given = [key for key in _KEYS if key in document]
    matrices = [key for key in given if key in ("information", "covariance")]
    if "frame" not in document or not given or (matrices and len(given) > 1):
        raise PriorError(
            "a prior needs a frame and either information, or covariance, or position_std and "
            f"rotation_std_deg; got {', '.join(document) or 'nothing'}"
        )
    if not matrices:
        deviations = [*_three(document, "position_std"), *np.radians(_three(document, "rotation_std_deg"))]
        with np.errstate(over="ignore"):
            information = np.diag(np.array(deviations) ** -2.0)
        return PosePrior(information, document["frame"], "axes")
    matrix: Array = _information(document[matrices[0]], matrices[0])
    if matrices[0] == "covariance":
        scale = np.sqrt(np.diagonal(matrix))
        if not (scale > 0.0).all() or np.linalg.eigvalsh(matrix / np.outer(scale, scale))[0] < 1e-12:
            raise PriorError("a covariance must be positive definite; give information where one is unknown")
        return PosePrior(np.asarray(np.linalg.inv(matrix), dtype=np.float64), document["frame"])
    return PosePrior(matrix, document["frame"])


def _three(document: Mapping[str, Any], key: str) -> Array:
    """Standard deviations along three axes, infinite where unknown."""
    try:
        values = np.broadcast_to(np.array(document.get(key, np.inf), dtype=np.float64), (3,))
    except (TypeError, ValueError, OverflowError):
        values = np.full(3, np.nan)
    if not (values > 0.0).all():
        raise PriorError(f"{key} must be a positive number or three of them, not {document[key]!r}")
    return np.asarray(values)


def _information(value: Any, what: str) -> Array:
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise PriorError(f"the {what} of a prior must be a 6 x 6 matrix of numbers ({error})") from None
    if matrix.shape != (6, 6) or not np.isfinite(matrix).all():
        raise PriorError(f"the {what} of a prior must be a finite 6 x 6 matrix, not of shape {matrix.shape}")
    if not np.allclose(matrix, matrix.T, rtol=1e-9, atol=1e-9 * np.abs(matrix).max()):
        raise PriorError(f"the {what} of a prior must be symmetric")
    d = np.sqrt(np.abs(np.diagonal(matrix)))
    d = 1.0 / np.where(d > 0.0, d, 1.0)
    smallest = float(np.linalg.eigvalsh(d[:, None] * matrix * d)[0])
    if smallest < -1e-9:
        raise PriorError(
            f"the {what} of a prior has the scaled eigenvalue {smallest:.3g}; none may be negative"
        )
    return 0.5 * (matrix + matrix.T)
