"""How badly an image fits a pose, with gradient and curvature, by renders that are noisy themselves.

For a measured image y with noise precision W and the expected image R(x), E(x) = ½ (y − R(x))ᵀ W (y − R(x)).
With J = ∂R/∂ξ in the camera frame, g = JᵀW (y − R(x)) and F = JᵀWJ. Where gain and black level of the image
are not known (`measure.tone`), R stands for its values with those that fit best at x, J for theirs, and F for
the Schur complement: E is then least over all of them (variable projection; Golub and Pereyra 1973).

The renderer's own noise must not pass for the image's. (1) R̂(x) uses the same random numbers at every x, so
that E is one smooth function and its minimum exists. (2) They are independent of Ĵ's, so that E[ĴᵀW(y − R̂)] =
JᵀW(y − R): the root is not shifted; nor does it depend on the matrix that multiplies g. E itself comes from
products of different batches of R̂, without which it would be least where R̂'s noise is. (3) What remains is
variance. Near the end R̂(x) = A + R̂(x; s) − R̂(x_A; s) with A a render of many paths at an anchor
x_A: unbiased at every x, and without the noise of s at x_A. What is left is reported: the covariance C that
Ĵ's and R̂'s noise adds to the estimate's, and as `excess` the part of the bound that it is,

    C = F⁻¹ [ĴᵀWĴ − F + Cov(ĴᵀW R̂)] F⁻¹,   excess = tr(F C) / 6.

A Jacobian that an anchor brings along serves wherever it is near, since it has more paths than a new one.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..errors import AlignmentError, OutOfViewError
from ..information.image_jacobian import ImageJacobian
from ..information.subset import selected
from ..jacobian.method import Paths
from ..measure.measurement import Measurement
from ..measure.tone import Tone
from ..noise import IndependentNoise
from ..se3 import Array

ANCHOR_SPP = 16
"""Paths per pixel of the anchor's render, over those of the others."""

_REFRESH = 0.5
"""The Jacobian is measured anew where the image has moved by this since it last was [pixel]."""
_RENDER = 0x414C474E
"""Purpose of the random numbers of R̂."""


@dataclasses.dataclass(frozen=True, eq=False)
class Anchor:
    """A render of many paths that R̂ is tied to; many alignments may share one."""

    pose: Array
    """(4, 4), where it was rendered from."""
    batches: Array
    """(K, H, W, 3), independent renders, or (1, H, W, 3), taken to be exact [radiance]."""
    jacobian: ImageJacobian | None = None
    """Measured near there; spares the searches from measuring their own."""


class Misfit:
    """One image, one scene, and what was last measured of it."""

    def __init__(
        self,
        run: Measurement,
        image: Array,
        noise: IndependentNoise,
        anchor: Anchor | None,
        tone: Tone = Tone("known"),  # noqa: B008  # nobody changes it
    ) -> None:
        finite = np.asarray(np.isfinite(image).all(axis=2))
        self.masked = int((run.mask & ~finite).sum())
        if self.masked:
            run = run.only(finite, f"{run.selection.description}, where the image is finite")
        if not run.mask.any():
            raise AlignmentError("the measured image is finite in none of the chosen pixels; choose others")
        self.run = run
        self.noise = noise
        self.pixels = selected(run.mask)
        self.measured = image[run.mask]
        self.tone = tone
        """Of the last difference."""
        self.there = tone
        """Where F and g are of."""
        self.shown = np.zeros((run.options.batches, len(self.pixels), 3))
        """(K, n, 3), R̂ there, before the tone."""
        self.seen = np.ones(len(self.pixels), dtype=bool)
        self.anchored = False
        self.correction: Array | float = 0.0
        self.rendered: tuple[Array, Array] | None = None
        if anchor is not None:
            self.tie(anchor)
        known = None if anchor is None else anchor.jacobian
        self.known = None
        if known is not None and _covers(known, run.mask):
            self.known = known.only(run.mask, run.selection.description)
        self._use(self.known or run.jacobian(pilot=noise.depends_on_mean))
        self.differentiate(run.view.pose)
        if not np.diagonal(self.plain).all():
            raise OutOfViewError(
                "from the start pose the image does not depend on the pose: the scene is out of view; start "
                "nearer"
            )

    def anchor(self, pose: Array) -> Anchor:
        """A render of many paths from here."""
        run = self.run
        paths = Paths(ANCHOR_SPP * run.options.uniform_spp, run.options.seed + 1, run.options.batches)
        batches = np.full((paths.batches, *run.mask.shape, 3), np.nan)
        values = run.render(self.pixels, _RENDER, paths=paths, pose=pose)
        batches[:, self.pixels[:, 1], self.pixels[:, 0]] = values
        return Anchor(pose, batches)

    def tie(self, anchor: Anchor) -> None:
        """Add to R̂ what makes it the anchor's image at the anchor."""
        if anchor.batches.shape[1:] != (*self.run.mask.shape, 3):
            raise AlignmentError(
                f"the anchor's image has shape {anchor.batches.shape[1:]}, the measured one "
                f"{(*self.run.mask.shape, 3)}"
            )
        self.correction = 0.0
        image = anchor.batches[:, self.pixels[:, 1], self.pixels[:, 0]]
        self.correction = image - self.expected(anchor.pose)
        self.anchored = True

    def expected(self, pose: Array) -> Array:
        """(K, n, 3), K independent estimates of R(x); the last render is kept."""
        if self.rendered is None or not np.array_equal(pose, self.rendered[0]):
            self.rendered = pose, self.run.render(self.pixels, _RENDER, pose=pose, even=True)
        return self.rendered[1] + self.correction

    def differentiate(self, pose: Array) -> None:
        """Measure J anew where the image has moved since it last was; near the anchor's, take that."""
        if self.known is not None and self.motion(self.known.pose, pose) <= _REFRESH:
            if self.jacobian is not self.known:
                self._use(self.known)
        elif self.motion(self.jacobian.pose, pose) > _REFRESH:
            self._use(self.run.at(pose).jacobian(pilot=self.noise.depends_on_mean))
        if self.tone.parameters:
            self.difference(pose)
            self.there, self.shown = self.tone, self._finite(self.expected(pose))
            self.assume(self.noise)

    def assume(self, noise: IndependentNoise) -> None:
        """Another noise from now on."""
        self.noise = noise
        self._use(self.jacobian)

    def _use(self, jacobian: ImageJacobian) -> None:
        self.jacobian = jacobian
        self.values, self.own_weights, self.measurable = self._rows(jacobian, self.pixels)
        self._weigh()

    def _rows(
        self, jacobian: ImageJacobian, pixels: NDArray[np.int64]
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Ĵ (n, 3, 6) and W (n, 3) at some pixels, zero where it was not finite, and where it was (n,).

        Ĵ is that of the values, by the gain.
        """
        row = np.full(self.run.mask.shape, -1)
        row[jacobian.pixels[:, 1], jacobian.pixels[:, 0]] = np.arange(len(jacobian.pixels))
        row = row[pixels[:, 1], pixels[:, 0]]
        finite = row >= 0
        values, weights = np.zeros((len(pixels), 3, 6)), np.zeros((len(pixels), 3))
        values[finite] = self.there.gain[:, None] * jacobian.values[row[finite]]
        expected = self.there(jacobian.expected[row[finite]])
        weights[finite] = self.noise.weights(pixels[finite], expected)
        return values, weights, finite

    def _weigh(self) -> None:
        """W, and ĴᵀWĴ, of the pixels that are finite in both Ĵ and R̂."""
        self.weights = np.where(self.seen[:, None], self.own_weights, 0.0)
        self.plain = np.einsum("ncp,nc,ncq->pq", self.values, self.weights, self.values, optimize=True)
        if self.tone.parameters:
            columns = self.there.columns(self.shown)
            K, mean = len(columns), columns.mean(axis=0)
            rooted = np.sqrt(self.weights)[..., None] * columns
            whole, own = K**2 * _gram(rooted.mean(axis=0)), sum(_gram(batch) for batch in rooted)
            coupling = np.einsum("ncp,nc,ncm->pm", self.values, self.weights, mean, optimize=True)
            inverse = np.linalg.pinv((whole - own) / (K * (K - 1)), hermitian=True)
            self.plain = self.plain - coupling @ inverse @ coupling.T
            self.projected = self.values - mean @ (inverse @ coupling.T)
        else:
            self.projected = self.values

    def motion(self, a: Array, b: Array) -> float:
        """How far the image moves between two poses, about [pixel]."""
        twist = se3.log(se3.inverse(a) @ b)
        moved = np.linalg.norm(twist[:3]) / self.run.length_scale + np.linalg.norm(twist[3:])
        return float(moved) * self.run.view.camera.focal_length

    def gradient(self, image: Array) -> Array:
        """JᵀW of an image or a difference of images (n, 3)."""
        return np.asarray(np.einsum("ncp,nc->p", self.values, self.weights * image), dtype=np.float64)

    def difference(self, pose: Array) -> Array:
        """(K, n, 3), y − R̂; zero and without weight where R̂ is not finite."""
        expected = self.expected(pose)
        seen = np.asarray(np.isfinite(expected).all(axis=(0, 2)))
        self.run.check_valid(int((~seen).sum()), len(seen))
        if not np.array_equal(seen, self.seen):
            self.seen = seen
            self._weigh()
        expected = self._finite(expected)
        self.tone = self.tone.fitted(self.measured, expected, self.weights)
        difference = np.asarray(self.measured - self.tone(expected), dtype=np.float64)
        difference[:, ~seen] = 0.0
        return difference

    def _finite(self, images: Array) -> Array:
        """(K, n, 3) with zeros for what is not seen."""
        return images if self.seen.all() else np.where(self.seen[:, None], images, 0.0)

    def error(self, difference: Array) -> float:
        """E, from products of different batches: the square of one batch's noise is no error of the pose."""
        K = len(difference)
        whole = np.sum(self.weights * difference.sum(axis=0) ** 2) - np.sum(self.weights * difference**2)
        return float(0.5 * whole / (K * (K - 1)))

    def residual(self, difference: Array) -> float:
        """Root mean square of the whitened difference, without the renderer's noise."""
        return float(np.sqrt(max(2.0 * self.error(difference), 0.0) / np.count_nonzero(self.weights)))

    def rms(self, difference: Array) -> float:
        """Root mean square of the difference of what has weight, without the renderer's noise [value]."""
        K, seen = len(difference), self.weights > 0.0
        sums = difference.sum(axis=0)[seen]
        square = (np.sum(sums**2) - np.sum(difference[:, seen] ** 2)) / (K * (K - 1))
        return float(np.sqrt(max(square, 0.0) / max(np.count_nonzero(seen), 1)))

    def slope(self, pose: Array, chosen: NDArray[np.int64], seed: int) -> Array:
        """(6,), JᵀW (y − R̂) of some of the pixels (n,), with a Jacobian of their own."""
        difference = self.difference(pose).mean(axis=0)[chosen]
        self.there = self.tone
        part = np.zeros_like(self.run.mask)
        part[self.pixels[chosen, 1], self.pixels[chosen, 0]] = True
        here = self.run.at(pose, seed=seed).only(part)
        values, weights, _ = self._rows(here.jacobian(pilot=self.noise.depends_on_mean), self.pixels[chosen])
        return np.asarray(np.einsum("ncp,nc->p", values, weights * difference), dtype=np.float64)

    def added(self, difference: Array, information: Array) -> Array:
        """(6, 6), C = F⁻¹ [ĴᵀWĴ − F + Cov(ĴᵀW R̂)] F⁻¹."""
        weighted = self.weights * difference
        gradients = np.stack([np.einsum("ncp,nc->p", self.projected, batch) for batch in weighted])
        extra = self.plain - information + np.cov(gradients.T) / len(difference)
        inverse = np.linalg.pinv(information, hermitian=True)
        return np.asarray(inverse @ extra @ inverse)

    def excess(self, difference: Array, information: Array) -> float:
        """tr(F C) / 6."""
        return float(np.trace(information @ self.added(difference, information))) / 6.0

    @property
    def invalid(self) -> int:
        """Pixels that are not finite in Ĵ or in R̂."""
        return int((~(self.measurable & self.seen)).sum())

    def image_jacobian(self, pose: Array) -> ImageJacobian:
        """About a pose, of the pixels that are finite in both Ĵ and R̂: of the values and what is fitted."""
        jacobian = self.jacobian
        if self.invalid:
            mask = np.zeros_like(self.run.mask)
            mask[self.run.mask] = self.measurable & self.seen
            jacobian = jacobian.only(mask, f"{jacobian.selection.description}, where the radiance is finite")
        jacobian = jacobian.about(pose=pose)
        if not self.tone.parameters:
            return jacobian
        x, y = jacobian.pixels.T
        row = np.full(self.run.mask.shape, -1)
        row[self.run.mask] = np.arange(len(self.pixels))
        others = self.there.columns(self.shown[:, row[y, x]])
        own = self.there.gain[:, None] * jacobian.batch_values
        return dataclasses.replace(
            jacobian,
            batch_values=np.concatenate([own, others], axis=-1),
            parameters=self.there.parameters,
            image=self.there(jacobian.image),
            pilot=None if jacobian.pilot is None else self.there(jacobian.pilot),
            pilot_error=None if jacobian.pilot_error is None else self.there.gain * jacobian.pilot_error,
        )

    def image(self, pose: Array) -> Array:
        """(H, W, 3), what the measured image should be at a pose; NaN where it is not compared."""
        image = np.full((*self.run.mask.shape, 3), np.nan)
        values = self.tone(self.expected(pose).mean(axis=0))
        image[self.run.mask] = np.where((self.measurable & self.seen)[:, None], values, np.nan)
        return image


def _gram(columns: Array) -> Array:
    """AᵀA of columns (n, 3, m)."""
    rows = columns.reshape(-1, columns.shape[-1])
    return np.asarray(rows.T @ rows)


def _covers(jacobian: ImageJacobian, mask: NDArray[np.bool_]) -> bool:
    missing = mask.copy()
    missing[jacobian.pixels[:, 1], jacobian.pixels[:, 0]] = False
    return not missing.any()
