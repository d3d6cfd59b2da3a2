"""Fisher information of a pose: a 6 x 6 matrix that knows what it is about and how uncertain it is."""

from __future__ import annotations

from dataclasses import dataclass, field
from dataclasses import replace as dataclass_replace

import numpy as np
from numpy.typing import ArrayLike

from ..errors import FrameError
from ..se3 import Array, Frame
from .linearisation import Linearised
from .symmetric import congruence, symmetrised, unpack


@dataclass(frozen=True, eq=False)
class FisherInformation(Linearised):
    """Fisher information of one pose, tagged with what it is about, and with its own uncertainty."""

    matrix: Array
    """(6, 6), F for ξ = (ρ, φ) in `frame`; an unbiased estimate, so possibly indefinite."""
    covariance_of_entries: Array
    """(21, 21), covariance of F's upper triangle in `numpy.triu_indices(6)` order."""
    plain_matrix: Array | None = None
    """(6, 6) ĴᵀWĴ, biased upwards by Monte Carlo noise, a diagnostic; None where it is not known."""
    # The camera-frame matrix that this one was derived from: far from the origin the way back loses digits.
    # Not an argument, so that `dataclasses.replace` cannot carry it over to other values.
    _origin: FisherInformation | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        shapes = {"matrix": (6, 6), "covariance_of_entries": (21, 21), "plain_matrix": (6, 6)}
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is None:
                continue
            array = np.array(value, dtype=np.float64)
            if array.shape != shape or not np.isfinite(array).all():
                raise FrameError(f"{name} must be a finite array of shape {shape}, not {array.shape}")
            array = symmetrised(array)
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    @property
    def standard_error(self) -> Array:
        """(6, 6), the standard error of every entry of `matrix`."""
        return unpack(np.sqrt(np.maximum(np.diagonal(self.covariance_of_entries), 0.0)))

    @property
    def noise_inflation(self) -> float | None:
        """trace(plain) / trace(F) − 1 in scaled units, camera frame: what the plain estimate adds by noise.

        None if the plain matrix is not known; infinite if the unbiased trace is not positive.
        """
        camera = self.to_frame("camera")
        if camera.plain_matrix is None:
            return None
        squares = self.scale**2
        plain = float(np.diagonal(camera.plain_matrix) @ squares)
        unbiased = float(np.diagonal(camera.matrix) @ squares)
        if unbiased > 0.0:
            return plain / unbiased - 1.0
        return np.inf if plain > 0.0 else 0.0

    def to_frame(self, frame: Frame) -> FisherInformation:
        """The same information for the twist in another frame.

        Raises:
            FrameError: `frame` is neither `"camera"` nor `"world"`.
        """
        A = self.linearisation.old_from_new(frame)
        if A is None:
            return self
        if self._origin is not None:
            return self._origin
        moved = self.transform(A, variable=self.variable, frame=frame, pose=self.pose)
        if frame == "world":
            object.__setattr__(moved, "_origin", self)
        return moved

    def transform(
        self, old_from_new: ArrayLike, *, variable: str, frame: Frame, pose: ArrayLike
    ) -> FisherInformation:
        """F_new = Aᵀ F A for ξ_old = A ξ_new, and the covariance of its entries exactly.

        Args:
            old_from_new: (6, 6), A; `se3.adjoint(agent_from_common)` for a body frame.
            variable: what the new twist belongs to.
            frame: the new twist's frame.
            pose: the new variable's pose, 4 x 4.
        """
        A = np.asarray(old_from_new, dtype=np.float64)
        T = congruence(A)
        return dataclass_replace(
            self.about(variable=variable, frame=frame, pose=pose),
            matrix=A.T @ self.matrix @ A,
            covariance_of_entries=T @ self.covariance_of_entries @ T.T,
            plain_matrix=None if self.plain_matrix is None else A.T @ self.plain_matrix @ A,
        )

    def __add__(self, other: FisherInformation) -> FisherInformation:
        """Information from independent measurements of the same pose.

        The sum keeps the larger length scale; its selection counts the pixels of both.

        Raises:
            FrameError: variable, frame or linearisation pose differ.
        """
        if not isinstance(other, FisherInformation):
            return NotImplemented
        self.linearisation.refuse_to_mix(other.linearisation, "add information")
        if self.frame == "world":
            return (self.to_frame("camera") + other.to_frame("camera")).to_frame("world")
        plain = None
        if self.plain_matrix is not None and other.plain_matrix is not None:
            plain = self.plain_matrix + other.plain_matrix
        return FisherInformation(
            matrix=self.matrix + other.matrix,
            covariance_of_entries=self.covariance_of_entries + other.covariance_of_entries,
            plain_matrix=plain,
            linearisation=self.linearisation.with_pixels_of(other.linearisation),
        )
