"""The derivative of an image in its camera's pose, as independent estimates, tagged with what it is about."""

from __future__ import annotations

from dataclasses import dataclass, field
from dataclasses import replace as dataclass_replace
from math import lcm
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import se3
from ..errors import FrameError, OptionError
from ..se3 import Array, Frame


@dataclass(frozen=True)
class PixelSelection:
    """Which pixels were measured, and what that means for the information."""

    kind: Literal["all", "random", "only"]
    """`"random"` estimates the whole image's information; `"only"`: the estimator sees just those pixels."""
    total: int
    """Pixels of the whole image."""
    selected: int
    """Pixels chosen, including those dropped afterwards because they were invalid."""
    description: str
    """As the user gave it: `"all"`, `"random:0.1"`, `"gradient:0.1"`, `"mask.png"`."""

    def only(self, selected: int, description: str | None = None) -> PixelSelection:
        """So many of these pixels as all that an estimator has, whatever they were chosen to stand for."""
        if selected == self.total:
            return PixelSelection("all", self.total, selected, "all")
        words = self.description if description is None else description
        return PixelSelection("only", self.total, selected, words)


@dataclass(frozen=True, eq=False)
class ImageJacobian:
    """Independent estimates of the derivative of an image with respect to the camera's twist."""

    batch_values: Array
    """(K, n, C, 6 + m): K independent unbiased estimates of ∂I/∂ξ [radiance / scene unit], [radiance / rad],
    and of the derivatives in m nuisance parameters."""
    pixels: NDArray[np.integer]
    """(n, 2): column x and row y."""
    image: Array
    """(H, W, C) linear radiance, to be shown; NaN where it was not measured. By the derivative's own paths,
    whose errors it shares: what must be independent of them, or unbiased, needs a render of its own."""
    frame: Frame
    """The twist's frame, `"camera"` or `"world"`."""
    pose: Array
    """world_from_camera, the linearisation point."""
    selection: PixelSelection
    """What the pixels stand for."""
    length_scale: float
    """Median visible depth [scene unit]; 1 if nothing finite is visible."""
    variable: str
    """The camera's name."""
    block: int = 1
    """Side [pixel] of the film blocks whose Monte Carlo errors are independent; 1: every pixel's own."""
    parameters: tuple[str, ...] = ()
    """Names of the nuisance parameters, in the order of their columns."""
    pilot: Array | None = None
    """(H, W, C) the same image by other random numbers, for noise that depends on it: `image` shares errors
    with the derivatives. None, as of a Jacobian made by hand, takes `image` for free of errors."""
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

    def only(self, mask: NDArray[np.bool_], description: str | None = None) -> ImageJacobian:
        """Of those of its pixels that are in a mask (H, W); they are all that an estimator has."""
        x, y = self.pixels.T
        kept = mask[y, x]
        selection = self.selection.only(int(kept.sum()), description)
        return dataclass_replace(
            self,
            batch_values=self.batch_values if kept.all() else self.batch_values[:, kept],
            pixels=self.pixels[kept],
            image=np.where(mask[..., None], self.image, np.nan),
            pilot=None if self.pilot is None else np.where(mask[..., None], self.pilot, np.nan),
            selection=selection,
            provenance={**self.provenance, "pixels": vars(selection).copy()} if self.provenance else {},
        )

    def to_frame(self, frame: Frame) -> ImageJacobian:
        """The same derivative with respect to the twist in another frame: J_a = J_b A for ξ_b = A ξ_a."""
        A = old_from_new(self.frame, frame, self.pose)
        if A is None:
            return self
        twist, others = self.batch_values[..., :6] @ A, self.batch_values[..., 6:]
        return dataclass_replace(self, batch_values=np.concatenate([twist, others], axis=-1), frame=frame)

    def at(self, pixels: ArrayLike) -> ImageJacobian:
        """The same derivative at those of some pixels (n, 2) that it has, row by row."""
        own, wanted = (np.asarray(p).astype(np.int64) @ (1, 1 << 32) for p in (self.pixels, pixels))
        index = np.intersect1d(own, wanted, return_indices=True)[1]
        selection = self.selection
        if len(index) < len(own):
            selection = dataclass_replace(selection, kind="only", selected=len(index))
        return dataclass_replace(
            self, batch_values=self.batch_values[:, index], pixels=self.pixels[index], selection=selection
        )

    def __sub__(self, other: ImageJacobian) -> ImageJacobian:
        """What two independent estimates of one derivative differ by, at the pixels that both have.

        Raises:
            FrameError: variable, frame or linearisation pose differ.
            OptionError: batches or nuisance parameters differ.
        """
        if not isinstance(other, ImageJacobian):
            return NotImplemented
        refuse_to_mix(self, other, "subtract derivatives")
        a, b = self.at(other.pixels), other.at(self.pixels)
        if a.batch_values.shape != b.batch_values.shape or a.parameters != b.parameters:
            raise OptionError(
                f"cannot subtract derivatives of shapes {a.batch_values.shape} and {b.batch_values.shape}: "
                "measure both with the same batches and nuisances"
            )
        # Only where neither side's errors are shared are the difference's independent.
        return dataclass_replace(
            a,
            batch_values=a.batch_values - b.batch_values,
            block=lcm(a.block, b.block),
            provenance={"difference": [a.provenance, b.provenance]},
        )


def old_from_new(old: Frame, new: Frame, pose: Array) -> Array | None:
    """A with ξ_old = A ξ_new, or None if the frames agree."""
    if new not in ("camera", "world"):
        raise FrameError(f"unknown frame {new!r}; expected 'camera' or 'world'")
    if old == new:
        return None
    return se3.adjoint(pose if old == "world" else se3.inverse(pose))


def refuse_to_mix(a: Any, b: Any, act: str) -> None:
    """Refuse two objects of different variables, frames or linearisation poses, with a FrameError."""
    if a.variable != b.variable:
        raise FrameError(f"cannot {act} about {a.variable!r} and about {b.variable!r}")
    if a.frame != b.frame:
        raise FrameError(
            f"cannot {act} in the {a.frame} and in the {b.frame} frame; call to_frame on one of them"
        )
    tolerance = 1e-9 * max(1.0, float(np.abs(a.pose[:3, 3]).max()))
    if not np.allclose(a.pose, b.pose, rtol=0.0, atol=tolerance):
        raise FrameError(f"cannot {act} linearised at two different poses")
