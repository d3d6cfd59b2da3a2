"""Estimate a camera's pose from one image: Gauss–Newton and Levenberg–Marquardt on SE(3), and iNeRF's recipe.

For a measured image y with noise precision W and the expected image R(x), the pose minimises
E(x) = ½ (y − R(x))ᵀ W (y − R(x)). With J = ∂R/∂ξ in the camera frame, g = JᵀW (y − R(x)) and F = JᵀWJ,

    Gauss–Newton        x ← x exp(F⁻¹ g)
    Levenberg–Marquardt x ← x exp((F + λ diag F)⁻¹ g), λ lowered where E falls and raised where it does not
    iNeRF               Adam on ξ, g from a random batch of pixels

The renderer's own noise must not pass for the image's. (1) R̂(x) uses the same random numbers at every x, so
that E is one smooth function and its minimum exists. (2) They are independent of Ĵ's, so that E[ĴᵀW(y − R̂)] =
JᵀW(y − R): the root is not shifted; nor does it depend on the matrix that multiplies g. E itself comes from
products of different batches of R̂, without which it would be least where R̂'s noise is. (3) What remains is
variance. Near the end R̂(x) = A + R̂(x; s) − R̂(x_A; s) with A a render of many paths at an anchor
x_A: unbiased at every x, and without the noise of s at x_A. What is left is reported as `excess`, the part by
which the estimate's covariance exceeds the bound because of Ĵ's and R̂'s noise:

    excess = tr(F⁻¹ [ĴᵀWĴ − F + Cov(ĴᵀW R̂)]) / 6.

References: Yen-Chen et al., "iNeRF: Inverting Neural Radiance Fields for Pose Estimation", IROS 2021, section
3; Nocedal and Wright, "Numerical Optimization", 2nd ed., sections 10.2 and 10.3.
"""

from __future__ import annotations

import dataclasses
import warnings
from typing import Any, Literal, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import se3
from ..bound.cramer_rao import PoseBound, cramer_rao_bound
from ..errors import AlignmentError, NoiseError, OutOfViewError, PrecisionWarning
from ..information.accumulate import as_noise_model, fisher_information
from ..information.image_jacobian import ImageJacobian
from ..information.subset import selected
from ..jacobian.method import Paths
from ..measure.measurement import Measurement, measurement
from ..measure.options import MeasurementKeywords
from ..noise import CoupledNoise, IndependentNoise, NoiseModel
from ..render.lending import in_turn
from ..render.scene import as_scene
from ..render.view import open_view
from ..se3 import Array
from .reduction import pyramid

Status = Literal["converged", "diverged", "out of iterations"]
ESTIMATORS = ("gauss_newton", "levenberg_marquardt", "adam")

ANCHOR_SPP = 16
"""Paths per pixel of the anchor's render, over those of the others."""

_SMALL_STEP = 0.1
"""A step below this many standard deviations of the bound ends the search at an anchor."""
_NEAR = 3.0
"""Steps shorter than this many standard deviations that do not shrink are damped: 1/2, 1/3, …"""
_SMALL_MOTION = 0.1
"""The same before that, where the renderer's noise is larger than the image's [pixel]."""
_ANCHORS = 3
"""At most so many, each where the search from the one before has ended."""
_REFRESH = 0.5
"""The Jacobian is measured anew where the image has moved by this since it last was [pixel]."""
_DAMPING = 1e-3
"""First λ."""
_VISIBLE_FALL = 1e-3
"""Relative fall of E that the renderer's noise does not hide; smaller ones are not insisted on."""
_LOST = 10.0
"""Growth of E at which a search is given up."""
_FIRST, _SECOND = 0.9, 0.999
"""Adam's decay of the mean and of the mean square."""
_FAR = 1.0
"""A step that turns the camera by more [rad], or moves it by more [length scale], has lost it."""
_RENDER = 0x414C474E
"""Purpose of the random numbers of R̂."""


@dataclasses.dataclass(frozen=True, eq=False)
class Alignment:
    """Where an image was taken from, as an estimator has it."""

    pose: Array
    """(4, 4), world_from_camera."""
    status: Status
    """Whether the search ended by itself; of the pose of one that did not, nothing is known."""
    residual: float
    """Root mean square of W^½ (y − R): 1 is expected of an image of this scene with this noise."""
    iterations: int
    """Over all levels."""
    bound: PoseBound
    """At the estimate."""
    excess: float
    """Relative excess of the estimate's covariance over the bound from the renderer's own noise."""
    masked: int
    """Pixels left out because the measured image is NaN or infinite there."""
    invalid: int
    """Pixels left out because the scene's radiance is, from the estimate (`drop_invalid`)."""


@dataclasses.dataclass(frozen=True, eq=False)
class Anchor:
    """A render of many paths that R̂ is tied to; many alignments may share one."""

    pose: Array
    """(4, 4), where it was rendered from."""
    batches: Array
    """(K, H, W, 3), independent renders, or (1, H, W, 3), taken to be exact [radiance]."""
    jacobian: ImageJacobian | None = None
    """Measured near there; spares the searches from measuring their own."""


@in_turn
def align(
    scene: Any,
    image: ArrayLike,
    noise: NoiseModel,
    *,
    estimator: str = "gauss_newton",
    iterations: int = 30,
    levels: int = 0,
    anchor: Anchor | None = None,
    learning_rate: float = 0.01,
    batch_pixels: int = 512,
    **options: Unpack[MeasurementKeywords],
) -> Alignment:
    """Estimate the pose that an image was taken from.

    Args:
        scene: path of a Mitsuba XML file, dictionary, or `mi.Scene`.
        image: (H, W, 3) measured linear RGB [radiance]; pixels that are not finite are left out.
        noise: its noise, independent between pixels and channels.
        estimator: one of `ESTIMATORS`.
        iterations: at most, on each level.
        levels: how many times the image is first reduced by two, for starts that are further away.
        anchor: of the last level; by default rendered where the search would otherwise have ended.
        learning_rate: of Adam, first step [rad, length scales]; falls to 0.8 of it every 100 steps.
        batch_pixels: of Adam, pixels of each step.
        options: see `MeasurementOptions`; `pose` is where the search starts (default: the scene's own), and
            `size` the image's. The search has the pixels that `pixels` chooses and no others, and the bound
            is theirs.

    Returns:
        `Alignment`; look at its `status` first.

    Raises:
        AlignmentError: the image has the wrong shape or nothing finite, or an unknown estimator.
        OutOfViewError: the start sees nothing of the scene.
        NoiseError: the noise couples pixels or channels, or cannot be that of a reduced image.
        MitsubaCRBError: as `pose_jacobian`.
    """
    measured = _checked_image(image)
    _check_arguments(estimator, iterations, levels)
    model = _checked_noise(noise, measured)
    loaded, _ = as_scene(scene)
    options["size"] = _size(measured, options.get("size"), loaded, options.get("sensor", 0))
    damping = _DAMPING if estimator == "levenberg_marquardt" else 0.0
    count, words = 0, None
    if levels:
        with measurement(loaded, **options) as run:
            # Chosen once, where the search starts: a reduced image is of the same pixels.
            options["pixels"], words = run.mask, run.selection.description
        left = run.mask[..., None] & np.isfinite(measured).all(axis=2, keepdims=True)
        for small, of_small in pyramid(np.where(left, measured, np.nan), model, levels):
            coarse: MeasurementKeywords = {
                **options,
                "size": (small.shape[1], small.shape[0]),
                "pixels": None,
            }
            with measurement(loaded, **coarse) as run:
                search = _Search(run, small, of_small, None)
                pose, status, steps = search.least_squares(run.view.pose, damping, iterations)
                count += steps
            if status != "diverged":
                options["pose"] = pose
    with measurement(loaded, **options) as run:
        run.warn_of_limits()
        search = _Search(run.only(description=words), measured, model, anchor)
        if estimator == "adam":
            pose, status, steps = search.adam(run.view.pose, learning_rate, batch_pixels, iterations)
        else:
            pose, status, steps = search.least_squares(run.view.pose, damping, iterations)
            for _ in range(_ANCHORS if anchor is None else 0):
                if status != "converged":
                    break
                start = pose
                search.tie(search.anchor(start))
                pose, status, more = search.least_squares(start, damping, iterations)
                steps += more
                if search.motion(start, pose) < _SMALL_MOTION:
                    break
        return search.result(pose, status, count + steps)


class _Search:
    """One image, one scene, and what was last measured of it."""

    def __init__(
        self, run: Measurement, image: Array, noise: IndependentNoise, anchor: Anchor | None
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
        self.seen = np.ones(len(self.pixels), dtype=bool)
        self.anchored = False
        self.correction: Array | float = 0.0
        self.rendered: tuple[Array, Array] | None = None
        if anchor is not None:
            self.tie(anchor)
        known = None if anchor is None else anchor.jacobian
        if known is None or not _covers(known, run.mask):
            known = run.jacobian(pilot=noise.depends_on_mean)
        self._use(known.only(run.mask, run.selection.description))
        self.differentiate(run.view.pose)
        if not np.diagonal(self.plain).all():
            raise OutOfViewError(
                "from the start pose the image does not depend on the pose: the scene is out of view; start "
                "nearer"
            )

    def anchor(self, pose: Array) -> Anchor:
        """A render of many paths from here."""
        run = self.run
        paths = Paths(ANCHOR_SPP * run.options.spp, run.options.seed + 1, run.options.batches)
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
            self.rendered = pose, self.run.render(self.pixels, _RENDER, pose=pose)
        return self.rendered[1] + self.correction

    def differentiate(self, pose: Array) -> None:
        """Measure J anew where the image has moved since it last was."""
        if self.motion(self.jacobian.pose, pose) > _REFRESH:
            self._use(self.run.at(pose).jacobian(pilot=self.noise.depends_on_mean))

    def _use(self, jacobian: ImageJacobian) -> None:
        self.jacobian = jacobian
        self.values, self.own_weights, self.measurable = self._rows(jacobian, self.pixels)
        self._weigh()

    def _rows(
        self, jacobian: ImageJacobian, pixels: NDArray[np.int64]
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Ĵ (n, 3, 6) and W (n, 3) at some pixels, zero where it was not finite, and where it was (n,)."""
        row = np.full(self.run.mask.shape, -1)
        row[jacobian.pixels[:, 1], jacobian.pixels[:, 0]] = np.arange(len(jacobian.pixels))
        row = row[pixels[:, 1], pixels[:, 0]]
        finite = row >= 0
        values, weights = np.zeros((len(pixels), 3, 6)), np.zeros((len(pixels), 3))
        values[finite] = jacobian.values[row[finite]]
        weights[finite] = self.noise.weights(pixels[finite], jacobian.expected[row[finite]])
        return values, weights, finite

    def _weigh(self) -> None:
        """W, and ĴᵀWĴ, of the pixels that are finite in both Ĵ and R̂."""
        self.weights = np.where(self.seen[:, None], self.own_weights, 0.0)
        self.plain = np.einsum("ncp,nc,ncq->pq", self.values, self.weights, self.values, optimize=True)

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
        difference = np.asarray(self.measured - self.expected(pose), dtype=np.float64)
        seen = np.asarray(np.isfinite(difference).all(axis=(0, 2)))
        self.run.check_valid(int((~seen).sum()), len(seen))
        difference[:, ~seen] = 0.0
        if not np.array_equal(seen, self.seen):
            self.seen = seen
            self._weigh()
        return difference

    def excess(self, difference: Array, information: Array) -> float:
        """tr(F⁻¹ [ĴᵀWĴ − F + Cov(ĴᵀW R̂)]) / 6."""
        gradients = np.stack([self.gradient(batch) for batch in difference])
        extra = self.plain - information + np.cov(gradients.T) / len(difference)
        return float(np.trace(np.linalg.pinv(information, hermitian=True) @ extra)) / 6.0

    def least_squares(self, pose: Array, damping: float, iterations: int) -> tuple[Array, Status, int]:
        """Levenberg–Marquardt, or Gauss–Newton without damping."""
        difference = self.difference(pose)
        first = error = self.error(difference)
        gain, last = 1.0, np.inf
        for iteration in range(1, iterations + 1):
            step = self.step(difference.mean(axis=0), damping)
            if step is None or self._lost(step):
                return pose, "diverged", iteration
            if self.anchored:
                length = float(
                    np.sqrt(step @ self.plain @ step / (1.0 + self.excess(difference, self.plain)))
                )
                # Edges cross samples one by one: close by, R̂ is a staircase on which full steps never end.
                # Steps as in stochastic approximation average over it (Robbins and Monro 1951).
                if 0.5 * last < length < _NEAR:
                    gain = gain / (1.0 + gain)
                last = length
                small = gain * length < _SMALL_STEP
            else:
                small = self.motion(pose, pose @ se3.exp(step)) < _SMALL_MOTION
            candidate = pose @ se3.exp(gain * step)
            attempt = self.difference(candidate)
            new = self.error(attempt)
            if damping > 0.0 and not new < error:
                expected_fall = 0.5 * float(step @ self.gradient(difference.mean(axis=0)))
                if expected_fall > _VISIBLE_FALL * error:
                    damping *= 10.0
                    continue
            damping *= 0.1
            pose, difference, error = candidate, attempt, new
            if not error < _LOST * first:
                return pose, "diverged", iteration
            if small:
                return pose, "converged", iteration
            self.differentiate(pose)
            if not np.diagonal(self.plain).all():
                return pose, "diverged", iteration
        return pose, "out of iterations", iterations

    def adam(self, pose: Array, rate: float, count: int, iterations: int) -> tuple[Array, Status, int]:
        """Adam on the twist, from random batches of pixels."""
        rng = np.random.default_rng(self.run.options.seed)
        scale = np.array([self.run.length_scale] * 3 + [1.0] * 3)
        first, second = np.zeros(6), np.zeros(6)
        for iteration in range(1, iterations + 1):
            chosen = np.sort(rng.permutation(len(self.pixels))[:count])
            part = np.zeros_like(self.run.mask)
            part[self.pixels[chosen, 1], self.pixels[chosen, 0]] = True
            here = self.run.at(pose, seed=self.run.options.seed + iteration).only(part)
            values, weights, _ = self._rows(
                here.jacobian(pilot=self.noise.depends_on_mean), self.pixels[chosen]
            )
            difference = self.difference(pose).mean(axis=0)[chosen]
            slope = -scale * np.einsum("ncp,nc->p", values, weights * difference)
            first = _FIRST * first + (1.0 - _FIRST) * slope
            second = _SECOND * second + (1.0 - _SECOND) * slope**2
            mean, square = first / (1.0 - _FIRST**iteration), second / (1.0 - _SECOND**iteration)
            falling = rate * 0.8 ** (iteration / 100.0)
            pose = pose @ se3.exp(-falling * scale * mean / (np.sqrt(square) + np.finfo(float).tiny))
        self.differentiate(pose)
        step = self.step(self.difference(pose).mean(axis=0), 0.0)
        near = step is not None and float(step @ self.plain @ step) < 1.0
        return pose, "converged" if near else "out of iterations", iterations

    def error(self, difference: Array) -> float:
        """E, from products of different batches: the square of one batch's noise is no error of the pose."""
        K = len(difference)
        whole = np.sum(self.weights * difference.sum(axis=0) ** 2) - np.sum(self.weights * difference**2)
        return float(0.5 * whole / (K * (K - 1)))

    def residual(self, difference: Array) -> float:
        """Root mean square of the whitened difference, without the renderer's noise."""
        return float(np.sqrt(max(2.0 * self.error(difference), 0.0) / np.count_nonzero(self.weights)))

    def step(self, difference: Array, damping: float) -> Array | None:
        """(F + λ diag F)⁻¹ g, or None if F is singular."""
        matrix = self.plain + damping * np.diag(np.diagonal(self.plain))
        # In units in which the diagonal is one: radians and scene units are not comparable.
        d = 1.0 / np.sqrt(np.maximum(np.diagonal(matrix), np.finfo(float).tiny))
        try:
            step = d * np.linalg.solve(d[:, None] * matrix * d, d * self.gradient(difference))
        except np.linalg.LinAlgError:
            return None
        return step if np.isfinite(step).all() else None

    def _lost(self, step: Array) -> bool:
        moved = np.linalg.norm(step[:3]) / self.run.length_scale
        return bool(moved > _FAR or np.linalg.norm(step[3:]) > _FAR)

    def result(self, pose: Array, status: Status, iterations: int) -> Alignment:
        """What is known at the end."""
        self.differentiate(pose)
        difference = self.difference(pose)
        jacobian, valid = self.jacobian, self.measurable & self.seen
        if not valid.all():
            mask = np.zeros_like(self.run.mask)
            mask[self.run.mask] = valid
            jacobian = jacobian.only(mask, f"{jacobian.selection.description}, where the radiance is finite")
        information = fisher_information(dataclasses.replace(jacobian, pose=pose), self.noise)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PrecisionWarning)
            bound = cramer_rao_bound(information)
        return Alignment(
            pose=pose,
            status=status,
            residual=self.residual(difference),
            iterations=iterations,
            bound=bound,
            excess=self.excess(difference, information.matrix),
            masked=self.masked,
            invalid=int((~valid).sum()),
        )


def _covers(jacobian: ImageJacobian, mask: NDArray[np.bool_]) -> bool:
    missing = mask.copy()
    missing[jacobian.pixels[:, 1], jacobian.pixels[:, 0]] = False
    return not missing.any()


def _checked_image(image: ArrayLike) -> Array:
    values = np.asarray(image, dtype=np.float64)
    if values.ndim != 3 or values.shape[2] != 3:
        raise AlignmentError(f"the measured image must have shape (H, W, 3), linear RGB, not {values.shape}")
    if not np.isfinite(values).all(axis=2).any():
        raise AlignmentError("no pixel of the measured image is finite")
    return values


def _checked_noise(noise: object, image: Array) -> IndependentNoise:
    model = as_noise_model(noise)
    if isinstance(model, CoupledNoise):
        raise NoiseError("an alignment needs noise that is independent between pixels")
    model.check(*image.shape)
    if model.weights(np.zeros((1, 2), dtype=np.int64), np.zeros((1, 3))).shape != (1, 3):
        raise NoiseError("an alignment needs noise that is independent between channels")
    return model


def _size(
    image: NDArray[Any], size: tuple[int, int] | None, scene: Any, sensor: int | str
) -> tuple[int, int]:
    """The image's size; one that the film's shape does not explain must be confirmed."""
    height, width = image.shape[:2]
    if size is not None and tuple(size) != (width, height):
        raise AlignmentError(f"the measured image is {width}x{height}, and size says {size[0]}x{size[1]}")
    if size is None:
        with open_view(scene, sensor=sensor) as view:
            across, down = view.size
        # As close to the film's shape as whole pixels can be.
        if abs(width * down - height * across) >= max(across, down):
            raise AlignmentError(
                f"the measured image is {width}x{height}, the film {across}x{down}, another field of view; "
                f"say size=({width}, {height}) if the sensor shall have it"
            )
    return width, height


def _check_arguments(estimator: str, iterations: int, levels: int) -> None:
    if estimator not in ESTIMATORS:
        raise AlignmentError(f"unknown estimator {estimator!r}; estimators: {', '.join(ESTIMATORS)}")
    if iterations < 1:
        raise AlignmentError(f"iterations must be at least 1; got {iterations}")
    if levels < 0:
        raise AlignmentError(f"levels must not be negative; got {levels}")
