"""The derivative of an image in its camera's pose, as independent estimates, tagged with what it is about."""

from __future__ import annotations

from dataclasses import dataclass, field
from dataclasses import replace as dataclass_replace
from math import lcm
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import OptionError
from ..se3 import Array, Frame
from .linearisation import Linearised


@dataclass(frozen=True, eq=False)
class ImageJacobian(Linearised):
    """Independent estimates of the derivative of an image with respect to the camera's twist."""

    batch_values: Array
    """(K, n, C, 6 + m): K independent unbiased estimates of ∂I/∂ξ [radiance / scene unit], [radiance / rad],
    and of the derivatives in m nuisance parameters."""
    pixels: NDArray[np.integer]
    """(n, 2): column x and row y."""
    image: Array
    """(H, W, C) linear radiance, to be shown; NaN where it was not measured. By the derivative's own paths,
    whose errors it shares: what must be independent of them, or unbiased, needs a render of its own."""
    block: int = 1
    """Side [pixel] of the film blocks whose Monte Carlo errors are independent; 1: every pixel's own."""
    parameters: tuple[str, ...] = ()
    """Names of the nuisance parameters, in the order of their columns."""
    pilot: Array | None = None
    """(H, W, C) the same image by other random numbers, for noise that depends on it: `image` shares errors
    with the derivatives. None, as of a Jacobian made by hand, takes `image` for free of errors."""
    pilot_error: Array | None = None
    """(H, W, C) half of what two halves of the pilot's paths differ by; None without a pilot of two."""
    bias: Array | None = None
    """(n,) relative error, of one sign and all pixels' alike, that their information may have by the step of
    finite differences; None without any."""
    provenance: dict[str, Any] = field(default_factory=dict)
    """How it was computed, JSON-able."""

    @property
    def values(self) -> Array:
        """(n, C, 6 + m), the mean over the batches."""
        return np.asarray(self.batch_values.mean(axis=0), dtype=np.float64)

    @property
    def mean(self) -> Array:
        """(n, C), the image at the pixels [radiance]."""
        x, y = self.pixels.T
        return np.asarray(self.image[y, x], dtype=np.float64)

    @property
    def expected(self) -> Array:
        """(n, C), the pilot at the pixels, or the image where there is none: what noise may depend on."""
        x, y = self.pixels.T
        return np.asarray((self.image if self.pilot is None else self.pilot)[y, x], dtype=np.float64)

    @property
    def expected_error(self) -> Array | None:
        """(n, C), the pilot's error at the pixels; None where none is known."""
        x, y = self.pixels.T
        return None if self.pilot_error is None else np.asarray(self.pilot_error[y, x], dtype=np.float64)

    def only(self, mask: NDArray[np.bool_], description: str | None = None) -> ImageJacobian:
        """Of those of its pixels that are in a mask (H, W); they are all that an estimator has."""
        x, y = self.pixels.T
        kept = mask[y, x]
        return dataclass_replace(
            self._rows(slice(None) if kept.all() else kept, int(kept.sum()), description),
            image=np.where(mask[..., None], self.image, np.nan),
            pilot=None if self.pilot is None else np.where(mask[..., None], self.pilot, np.nan),
            pilot_error=None
            if self.pilot_error is None
            else np.where(mask[..., None], self.pilot_error, 0.0),
        )

    def to_frame(self, frame: Frame) -> ImageJacobian:
        """The same derivative with respect to the twist in another frame: J_a = J_b A for ξ_b = A ξ_a."""
        A = self.linearisation.old_from_new(frame)
        if A is None:
            return self
        twist, others = self.batch_values[..., :6] @ A, self.batch_values[..., 6:]
        batch_values = np.concatenate([twist, others], axis=-1)
        return dataclass_replace(self.about(frame=frame), batch_values=batch_values)

    def at(self, pixels: ArrayLike) -> ImageJacobian:
        """The same derivative at those of some pixels (n, 2) that it has, row by row."""
        own, wanted = (np.asarray(p).astype(np.int64) @ (1, 1 << 32) for p in (self.pixels, pixels))
        index = np.intersect1d(own, wanted, return_indices=True)[1]
        return self._rows(index, len(index) if len(index) < len(own) else None)

    def __sub__(self, other: ImageJacobian) -> ImageJacobian:
        """What two independent estimates of one derivative differ by, at the pixels that both have.

        Raises:
            FrameError: variable, frame or linearisation pose differ.
            OptionError: batches or nuisance parameters differ.
        """
        if not isinstance(other, ImageJacobian):
            return NotImplemented
        self.linearisation.refuse_to_mix(other.linearisation, "subtract derivatives")
        a, b = self.at(other.pixels), other.at(self.pixels)
        if a.batch_values.shape != b.batch_values.shape or a.parameters != b.parameters:
            raise OptionError(
                f"cannot subtract derivatives of shapes {a.batch_values.shape} and {b.batch_values.shape}: "
                "measure both with the same batches and nuisances"
            )
        # Only where neither side's errors are shared are the difference's independent.
        return dataclass_replace(
            a,
            bias=None,
            batch_values=a.batch_values - b.batch_values,
            block=lcm(a.block, b.block),
            provenance={"difference": [a.provenance, b.provenance]},
        )

    def _rows(self, index: Any, count: int | None, description: str | None = None) -> ImageJacobian:
        """Of some of its pixels, by their places; if their count is given, all that an estimator has."""
        selection = self.selection if count is None else self.selection.only(count, description)
        return dataclass_replace(
            self.about(selection=selection),
            batch_values=self.batch_values[:, index],
            pixels=self.pixels[index],
            bias=None if self.bias is None else self.bias[index],
            provenance={**self.provenance, "pixels": vars(selection).copy()} if self.provenance else {},
        )
