"""Fisher information of a pose from independent estimates of the image's Jacobian, without noise bias.

For K independent, unbiased estimates J_1 .. J_K of the Jacobian J and a noise precision W = Σ⁻¹,

    F̂ = [ (Σ J_k)ᵀ W (Σ J_k) − Σ J_kᵀ W J_k ] / (K (K − 1))  =  mean over k < l of  sym(J_kᵀ W J_l)

is unbiased for F = JᵀWJ, where the plain ĴᵀWĴ of the mean Ĵ is too large by E[δJᵀ W δJ]. It is symmetric, but
positive semi-definite only in expectation. The covariance of its entries (`ustatistic`) is summed over units
with independent errors: groups of pixels, or the blocks of pixels that share samples; what a random subset
of the pixels says of the whole image is `sampled`'s. Conventions: `se3`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from dataclasses import replace as dataclass_replace
from itertools import pairwise
from math import lcm
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import se3
from ..errors import FrameError, NoiseError, OptionError, PixelsError, RadianceError
from ..noise import CoupledNoise, NoiseModel
from ..se3 import Array, Frame
from .coupled import CoupledComponents, ordered_products
from .sampled import SampledComponents
from .symmetric import congruence, entries, symmetrised, unpack
from .ustatistic import (
    VarianceComponents,
    gram,
    mean_of_batches,
    square_root,
    unit_grams,
    unit_products,
    whiten,
)

BLOCK = 8
"""Side [pixel] of the film blocks, on a fixed grid (x // 8, y // 8), whose pixels may share samples.

Smaller blocks would waste samples on what lies between them; with larger ones, a contour on a small image
would lie in so few that its variance, estimated from them, is itself too uncertain for intervals to cover."""

MINIMUM_BATCHES = 4
"""Two disjoint pairs of batches are needed to estimate the variance without bias."""

_UNIT = 4
"""Side [pixel] of the units whose products are summed where pixels are independent: larger units would say
less of the variance, single pixels take ten times as long."""

_CHUNK = 4096  # pixels whose products are held at once, about


def in_squares(pixels: NDArray[np.integer], side: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Pixels (n, 2) square by square of so many pixels' side: first squares of one pixel, then those of two.

    Returns:
        (n,) Which pixel comes when; (squares + 1,) where each square starts, and n.

    Raises:
        PixelsError: a pixel comes twice.
    """
    pixels = pixels.astype(np.int64, copy=False)
    square = pixels // side
    column, row = square.T
    x, y = (pixels - side * square).T
    place = ((row << 32 | column) * side + y) * side + x
    order = np.argsort(place, kind="stable")
    place = place[order]
    if np.any(np.diff(place) == 0):
        raise PixelsError("a pixel was given twice in one call")
    sizes = np.diff(np.append(np.flatnonzero(np.diff(place // side**2, prepend=-1)), len(pixels)))
    few = np.minimum(sizes, 3).astype(np.uint8)
    sorted_sizes = sizes[np.argsort(few, kind="stable")]
    order = order[np.argsort(np.repeat(few, sizes), kind="stable")]
    return order, np.concatenate([[0], np.cumsum(sorted_sizes)])


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
        A = _old_from_new(self.frame, frame, self.pose)
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
        _refuse_to_mix(self, other, "subtract derivatives")
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


@dataclass(frozen=True, eq=False)
class FisherInformation:
    """Fisher information of one pose, tagged with what it is about, and with its own uncertainty."""

    matrix: Array
    """(6, 6), F for ξ = (ρ, φ) in `frame`; an unbiased estimate, so possibly indefinite."""
    covariance_of_entries: Array
    """(21, 21), covariance of F's upper triangle in `numpy.triu_indices(6)` order."""
    frame: Frame
    """The twist's frame, `"camera"` or `"world"`."""
    variable: str
    """Which camera or body the pose belongs to."""
    pose: Array
    """world_from_camera, the linearisation point."""
    length_scale: float
    """Length [scene unit] that makes translation comparable with rotation."""
    selection: PixelSelection
    """Which pixels it is the information of."""
    plain_matrix: Array | None = None
    """(6, 6) ĴᵀWĴ, biased upwards by Monte Carlo noise, a diagnostic; None where it is not known."""
    # The camera-frame matrix that this one was derived from: far from the origin the way back loses digits.
    # Not an argument, so that `dataclasses.replace` cannot carry it over to other values.
    _origin: FisherInformation | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        if self.frame not in ("camera", "world"):
            raise FrameError(f"unknown frame {self.frame!r}; expected 'camera' or 'world'")
        if not (np.isfinite(self.length_scale) and self.length_scale > 0.0):
            raise FrameError(f"the length scale must be positive and finite, not {self.length_scale}")
        shapes = {"matrix": (6, 6), "covariance_of_entries": (21, 21), "pose": (4, 4), "plain_matrix": (6, 6)}
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is None:
                continue
            array = np.array(value, dtype=np.float64)
            if array.shape != shape or not np.isfinite(array).all():
                raise FrameError(f"{name} must be a finite array of shape {shape}, not {array.shape}")
            if name != "pose":
                array = symmetrised(array)
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    @property
    def standard_error(self) -> Array:
        """(6, 6), the standard error of every entry of `matrix`."""
        return unpack(np.sqrt(np.maximum(np.diagonal(self.covariance_of_entries), 0.0)))

    @property
    def scale(self) -> Array:
        """(6,), camera-frame twist per twist in scaled units: the length scale three times, then ones."""
        return np.array([self.length_scale] * 3 + [1.0] * 3)

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
        A = _old_from_new(self.frame, frame, self.pose)
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
            self,
            matrix=A.T @ self.matrix @ A,
            covariance_of_entries=T @ self.covariance_of_entries @ T.T,
            frame=frame,
            variable=variable,
            pose=se3.as_pose(pose),
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
        _refuse_to_mix(self, other, "add information")
        if self.frame == "world":
            return (self.to_frame("camera") + other.to_frame("camera")).to_frame("world")
        plain = None
        if self.plain_matrix is not None and other.plain_matrix is not None:
            plain = self.plain_matrix + other.plain_matrix
        return dataclass_replace(
            self,
            matrix=self.matrix + other.matrix,
            covariance_of_entries=self.covariance_of_entries + other.covariance_of_entries,
            length_scale=max(self.length_scale, other.length_scale),
            selection=_joint_selection(self.selection, other.selection),
            plain_matrix=plain,
        )

    def to_dict(self) -> dict[str, Any]:
        """All fields as JSON-able values."""
        return {
            "matrix": self.matrix.tolist(),
            "covariance_of_entries": self.covariance_of_entries.tolist(),
            "frame": self.frame,
            "variable": self.variable,
            "pose": self.pose.tolist(),
            "length_scale": self.length_scale,
            "selection": vars(self.selection).copy(),
            "plain_matrix": None if self.plain_matrix is None else self.plain_matrix.tolist(),
        }


@dataclass(frozen=True, eq=False)
class Sums:
    """What an `InformationAccumulator` has summed, for all of its P columns."""

    matrix: Array
    """(P, P), F̂."""
    covariance_of_entries: Array
    """(E, E), E = P (P + 1) / 2, of its upper triangle in `numpy.triu_indices(P)` order."""
    plain_matrix: Array
    """(P, P), ĴᵀWĴ."""

    def transform(self, old_from_new: Array) -> Sums:
        """Aᵀ F A of the columns J A, A (P, Q), and the covariance of its entries."""
        A, T = old_from_new, congruence(old_from_new)
        return Sums(
            symmetrised(A.T @ self.matrix @ A),
            T @ self.covariance_of_entries @ T.T,
            symmetrised(A.T @ self.plain_matrix @ A),
        )


class InformationAccumulator:
    """Streams the information of an image, block by block; the tiles' sizes and order do not matter.

    Every call adds whole blocks: all selected pixels of one block of the film must come in the same call,
    because the variance is estimated per block. Tiles with sides that are multiples of `BLOCK` satisfy this.
    """

    def __init__(
        self,
        *,
        batches: int,
        block: int = 1,
        sampled: bool = False,
        columns: int = 6,
        coupled: bool = False,
    ) -> None:
        """Start from nothing.

        Args:
            batches: K ≥ 4, independent estimates per pixel.
            block: side [pixel] of the film blocks whose errors are independent of one another. The smaller,
                the more certain the standard errors.
            sampled: also sum what the sampling variance of a random pixel subset needs (slower).
            columns: P, six of the twist and one for each nuisance parameter.
            coupled: the noise is correlated between pixels: `add_coupled` takes the place of `add`.

        Raises:
            OptionError: fewer than four batches.
            NoiseError: correlated noise and a random subset, which tells nothing of the whole image.
        """
        if batches < MINIMUM_BATCHES:
            raise OptionError(f"batches must be at least {MINIMUM_BATCHES}, not {batches}")
        if coupled and sampled:
            raise NoiseError(
                "noise is correlated between pixels, so a random subset cannot stand for the whole image; "
                "measure all pixels, or give a mask"
            )
        self._batches = batches
        self._block = block
        self._blocks: set[int] = set()
        self._count = 0
        self._informative = False
        self._columns = columns
        self._sum = np.zeros(entries(columns))
        self._plain = np.zeros((columns, columns))
        components = CoupledComponents if coupled else SampledComponents if sampled else VarianceComponents
        self._units = components(batches, columns)

    def add(self, batch_values: ArrayLike, weights: ArrayLike, pixels: ArrayLike) -> None:
        """Add the pixels of some whole blocks.

        Args:
            batch_values: (K, n, C, P), independent estimates of ∂I/∂ξ, then in the nuisance parameters.
            weights: (n, C) inverse noise variances, or (n, C, C) information that pixels carry about their
                means, see `IndependentNoise.weights`.
            pixels: (n, 2), column x and row y.

        Raises:
            OptionError: the number of batches is not the one announced.
            PixelsError: shapes do not fit, a pixel comes twice, or a block comes in two calls.
            NoiseError: a weight is negative or not finite.
            RadianceError: a derivative is not finite.
        """
        values = np.asarray(batch_values, dtype=np.float64)
        precision = np.asarray(weights, dtype=np.float64)
        positions = np.asarray(pixels)
        self._check(values, positions)
        if precision.shape not in (values.shape[1:3], (*values.shape[1:3], values.shape[2])):
            raise NoiseError(
                f"weights must have shape {values.shape[1:3]}, or blocks of channels, not {precision.shape}"
            )
        if len(positions) == 0:
            return
        root = square_root(precision)
        order, starts = self._order(positions)
        in_order = not np.any(np.diff(order) < 0)
        self._count += len(positions)
        self._informative = self._informative or bool(precision.any())
        edges = np.array([0, len(order)])
        if isinstance(self._units, SampledComponents):  # units of one pixel and of two come apart
            edges = np.insert(edges, 1, starts[np.searchsorted(np.diff(starts), [2, 3])])
        even = [np.linspace(a, b, -(-(b - a) // _CHUNK), endpoint=False) for a, b in pairwise(edges)]
        cuts = np.unique(np.searchsorted(starts, np.append(np.concatenate(even), len(order))))
        for low, high in pairwise(cuts):
            part: Any = slice(starts[low], starts[high])
            part = part if in_order else order[part]
            whitened = whiten(values[:, part], root[part])
            own = starts[low : high + 1] - starts[low]
            if isinstance(self._units, SampledComponents):
                self._sum += self._units.add(whitened, own)
                self._plain += gram(whitened.mean(axis=1).mT).sum(axis=0)
            else:
                grams = unit_grams(whitened, own)
                self._sum += self._units.add(unit_products(grams, self._batches)).sum(axis=1)
                self._plain += mean_of_batches(grams.sum(axis=0), self._batches)

    def add_coupled(self, batch_values: ArrayLike, noise: CoupledNoise, pixels: ArrayLike) -> None:
        """Add all pixels of an image whose noise is correlated between them: they must come in one call.

        Args:
            batch_values: (K, n, C, P), as for `add`.
            noise: solves with the covariance of these pixels' noise.
            pixels: (n, 2), column x and row y.

        Raises:
            NoiseError: the accumulator was not made for coupled pixels.
            MitsubaCRBError: as `add`, and whatever `noise.solve` raises.
        """
        components = self._units
        if not isinstance(components, CoupledComponents):
            raise NoiseError("noise that couples pixels needs InformationAccumulator(..., coupled=True)")
        values = np.asarray(batch_values, dtype=np.float64)
        positions = np.asarray(pixels)
        self._check(values, positions)
        if len(positions) == 0:
            return
        order, starts = self._order(positions)
        self._count += len(positions)
        columns = values[:, order].transpose(1, 2, 0, 3)
        n, C, K, P = columns.shape
        solved = noise.solve(positions[order], columns.reshape(n, C, K * P)).reshape(n, C, K, P)
        self._informative = self._informative or bool(solved.any())
        self._plain += symmetrised(
            columns.mean(axis=2).reshape(n * C, P).T @ solved.mean(axis=2).reshape(n * C, P)
        )
        for low in range(0, len(starts) - 1, _CHUNK):
            units = [
                ordered_products(
                    columns[start:stop].reshape(1, -1, K, P), solved[start:stop].reshape(1, -1, K, P)
                )
                for start, stop in pairwise(starts[low : low + _CHUNK + 1])
            ]
            self._sum += components.add(np.concatenate(units, axis=-1)).sum(axis=1)

    def information(
        self, *, frame: Frame, variable: str, pose: ArrayLike, length_scale: float, selection: PixelSelection
    ) -> FisherInformation:
        """The information of everything added so far, scaled to the whole image for a random subset.

        Raises:
            PixelsError: nothing was added, more pixels than selected, or a random subset without `sampled`.
        """
        sums = self.sums(selection)
        return FisherInformation(
            matrix=sums.matrix,
            covariance_of_entries=sums.covariance_of_entries,
            frame=frame,
            variable=variable,
            pose=se3.as_pose(pose),
            length_scale=length_scale,
            selection=selection,
            plain_matrix=sums.plain_matrix,
        )

    @property
    def added(self) -> Sums:
        """F̂ of all P columns from the pixels added so far and of no others; zero if they tell nothing."""
        return Sums(unpack(self._sum), self._units.positive, self._plain)

    def sums(self, selection: PixelSelection) -> Sums:
        """F̂ of all P columns from everything added so far, scaled to the whole image for a random subset.

        Raises:
            PixelsError: as `information`.
        """
        n, N = selection.selected, selection.total
        if self._count == 0:
            raise PixelsError("no pixels were measured, so there is no information to report")
        if self._count > n or n > N:
            raise PixelsError(f"{self._count} pixels were added, {n} selected, of {N} in the image")
        if not self._informative:
            raise NoiseError(
                f"the noise model leaves no information in any of {self._count} pixels: all are saturated or "
                "ignored; change the exposure, or the variances"
            )
        if selection.kind != "random" or n == N:
            return self.added
        if not isinstance(self._units, SampledComponents):
            raise PixelsError("a random pixel subset needs InformationAccumulator(batches=..., sampled=True)")
        if n < 2:
            raise PixelsError("a random subset of one pixel has no sampling variance; select at least two")
        covariance = self._units.covariance(self._sum, n, N)
        return Sums(N / n * unpack(self._sum), covariance, N / n * self._plain)

    def _order(self, pixels: NDArray[np.integer]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """By unit, then by pixel, so that the sums do not depend on the order given: see `in_squares`."""
        alone = 1 if isinstance(self._units, SampledComponents) else _UNIT
        side = self._block if self._block > 1 else alone
        order, starts = in_squares(pixels, side)
        if self._block > 1:
            column, row = pixels[order[starts[:-1]]].T.astype(np.int64) // side
            blocks = (row << 32 | column).tolist()
            if not self._blocks.isdisjoint(blocks):
                raise PixelsError(
                    f"a {side} x {side} block came in two calls; use tile sides that are multiples of {side}"
                )
            self._blocks.update(blocks)
        return order, starts

    def _check(self, values: Array, pixels: NDArray[Any]) -> None:
        if values.ndim != 4 or values.shape[-1] != self._columns:
            raise PixelsError(f"batch values must have shape (K, n, C, {self._columns}), not {values.shape}")
        if values.shape[0] != self._batches:
            raise OptionError(f"got {values.shape[0]} batches, expected {self._batches}")
        if pixels.shape != (values.shape[1], 2) or not np.issubdtype(pixels.dtype, np.integer):
            raise PixelsError(f"pixels must be integers of shape ({values.shape[1]}, 2), not {pixels.shape}")
        if pixels.size and pixels.min() < 0:
            raise PixelsError("pixel coordinates must not be negative")
        if not np.isfinite(values.sum()):
            bad = int(np.count_nonzero(~np.isfinite(values).all(axis=(0, 2, 3))))
            raise RadianceError(f"the Jacobian is not finite at {bad} of {len(pixels)} pixels")


class Accumulator(Protocol):
    """What sums up the information of pixels: of a pose alone, or jointly with nuisance parameters."""

    def add(self, batch_values: ArrayLike, weights: ArrayLike, pixels: ArrayLike) -> None:
        """See `InformationAccumulator.add`."""

    def add_coupled(self, batch_values: ArrayLike, noise: CoupledNoise, pixels: ArrayLike) -> None:
        """See `InformationAccumulator.add_coupled`."""


def feed(
    accumulator: Accumulator, jacobian: ImageJacobian, noise: NoiseModel, mean: ArrayLike | None = None
) -> None:
    """Add a whole Jacobian under a noise model of either kind.

    Args:
        accumulator: of as many columns, and made for coupled pixels if the noise's are.
        jacobian: of the whole image, or of the selected pixels.
        noise: independent or correlated between pixels.
        mean: (H, W, C) noise-free image for models that depend on it, rendered with other random numbers than
            the Jacobian; by default the Jacobian's pilot. A Jacobian without one should have an image free of
            errors: those that its derivatives share can make the information several times too large.

    Raises:
        NoiseError: the noise model does not fit the image.
        RadianceError: the Jacobian is not finite somewhere.
    """
    noise.check(*jacobian.image.shape)
    if isinstance(noise, CoupledNoise):
        accumulator.add_coupled(jacobian.batch_values, noise, jacobian.pixels)
        return
    if mean is not None:
        jacobian = dataclass_replace(jacobian, pilot=np.asarray(mean, dtype=np.float64))
    if jacobian.pilot is not None and jacobian.pilot.shape != jacobian.image.shape:
        raise NoiseError(
            f"the mean has shape {jacobian.pilot.shape}, but the image is {jacobian.image.shape}"
        )
    weights = noise.weights(jacobian.pixels, jacobian.expected)
    accumulator.add(jacobian.batch_values, weights, jacobian.pixels)


def as_noise_model(noise: object) -> NoiseModel:
    """The object itself, if it has what a noise model must have.

    Raises:
        NoiseError: it has not.
    """
    if not isinstance(noise, NoiseModel):
        raise NoiseError(f"expected a noise model such as noise.Gaussian(0.01), not {noise!r}")
    return noise


def fisher_information(
    jacobian: ImageJacobian, noise: NoiseModel, mean: ArrayLike | None = None
) -> FisherInformation:
    """The Fisher information F = JᵀΣ⁻¹J of the pose, estimated without bias, in the Jacobian's frame.

    Args:
        jacobian: the image's derivative.
        noise: noise model of the measured image.
        mean: see `feed`.

    Raises:
        NoiseError: the noise model does not fit the image.
        RadianceError: the Jacobian is not finite somewhere.
        OptionError: the Jacobian has columns of nuisance parameters, see `joint.joint_information`.
    """
    if jacobian.parameters:
        raise OptionError(
            f"the Jacobian has columns of nuisance parameters ({', '.join(jacobian.parameters)}): use "
            "joint_information, which can marginalize them"
        )
    camera = jacobian.to_frame("camera")
    accumulator = InformationAccumulator(
        batches=len(camera.batch_values),
        block=camera.block,
        sampled=camera.selection.kind == "random",
        coupled=as_noise_model(noise).couples_pixels,
    )
    feed(accumulator, camera, noise, mean)
    information = accumulator.information(
        frame="camera",
        variable=jacobian.variable,
        pose=jacobian.pose,
        length_scale=jacobian.length_scale,
        selection=jacobian.selection,
    )
    return information.to_frame(jacobian.frame)


def _old_from_new(old: Frame, new: Frame, pose: Array) -> Array | None:
    """A with ξ_old = A ξ_new, or None if the frames agree."""
    if new not in ("camera", "world"):
        raise FrameError(f"unknown frame {new!r}; expected 'camera' or 'world'")
    if old == new:
        return None
    return se3.adjoint(pose if old == "world" else se3.inverse(pose))


def _refuse_to_mix(
    a: ImageJacobian | FisherInformation, b: ImageJacobian | FisherInformation, act: str
) -> None:
    if a.variable != b.variable:
        raise FrameError(f"cannot {act} about {a.variable!r} and about {b.variable!r}")
    if a.frame != b.frame:
        raise FrameError(
            f"cannot {act} in the {a.frame} and in the {b.frame} frame; call to_frame on one of them"
        )
    tolerance = 1e-9 * max(1.0, float(np.abs(a.pose[:3, 3]).max()))
    if not np.allclose(a.pose, b.pose, rtol=0.0, atol=tolerance):
        raise FrameError(f"cannot {act} linearised at two different poses")


def _joint_selection(a: PixelSelection, b: PixelSelection) -> PixelSelection:
    kinds: tuple[Literal["only", "random", "all"], ...] = ("only", "random", "all")
    kind = next(kind for kind in kinds if kind in (a.kind, b.kind))
    return PixelSelection(
        kind, a.total + b.total, a.selected + b.selected, f"{a.description} + {b.description}"
    )
