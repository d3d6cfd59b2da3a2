"""Estimate a camera's pose from one image: where the scene looks like it (`misfit`, `optimisers`).

A search goes through reduced images first, if asked to (`approach`), then through the image itself; then
anchors are rendered, each where the search from the one before has ended, until that stays.
"""

from __future__ import annotations

import dataclasses
import warnings
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..bound.cramer_rao import PoseBound, joint_bound
from ..bound.misspecified import MisspecifiedCovariance, misspecified_covariance
from ..camera import Camera
from ..errors import AlignmentError, NoiseError, PrecisionWarning
from ..files import Record
from ..information.image_information import as_noise_model
from ..information.joint import joint_information
from ..measure.measurement import measurement
from ..measure.opening import as_world, open_measurable, wanted
from ..measure.options import MeasurementKeywords, MeasurementOptions
from ..measure.tone import TONES, Tone, ToneKind
from ..noise import CoupledNoise, Gaussian, IndependentNoise, NoiseModel
from ..noise.residuals import ResidualCovariance
from ..radiance.field import Field
from ..render.lending import in_turn
from ..se3 import Array
from .misfit import Anchor, Misfit
from .optimisers import DAMPING, SMALL_MOTION, Status, adam, least_squares
from .reduction import pyramid, reduced
from .searched_field import SearchedField, reduced_world

ESTIMATORS = ("gauss_newton", "levenberg_marquardt", "adam")

_ANCHORS = 3
"""At most so many, each where the search from the one before has ended."""
_LEAST_SIGMA = 1e-6
"""Of noise that residuals tell, over the largest value: of an image without noise they are rounding."""


@dataclasses.dataclass(frozen=True, eq=False)
class Alignment(Record):
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
    added: Array
    """(6, 6), the covariance behind it, camera frame [scene unit, rad]."""
    masked: int
    """Pixels left out because the measured image is NaN or infinite there."""
    invalid: int
    """Pixels left out because the scene's radiance is, from the estimate (`drop_invalid`)."""
    tone: Tone
    """Gain and black level of the measured image, at the estimate."""
    rms: float
    """Root mean square of y − R [value], without the renderer's noise."""
    noise: dict[str, Any]
    """What the bound assumes, JSON-able; its "origin" is "given" or "residuals"."""
    image: Array
    """(H, W, 3), R at the estimate [value]; NaN where it is not compared."""
    misspecified: MisspecifiedCovariance | None = None
    """What the estimate is worth by residuals of other images, if there were any."""


@in_turn
def align(
    scene: Any,
    image: ArrayLike,
    noise: NoiseModel | None,
    *,
    estimator: str = "gauss_newton",
    iterations: int = 30,
    levels: int = 0,
    tone: ToneKind = "known",
    residuals: ResidualCovariance | None = None,
    anchor: Anchor | None = None,
    learning_rate: float = 0.01,
    batch_pixels: int = 512,
    **options: Unpack[MeasurementKeywords],
) -> Alignment:
    """Estimate the pose that an image was taken from.

    Args:
        scene: as for `pose_bound`.
        image: (H, W, 3) measured linear RGB [radiance], or another value of which `tone` says what is not
            known; pixels that are not finite are left out.
        noise: its noise, independent between pixels and channels; None: white, as large as the residuals.
        estimator: one of `ESTIMATORS`.
        iterations: at most, on each level.
        levels: how many times the image is first reduced by two, for starts that are further away.
        tone: whether gain and black level are "known" to be 1 and 0, "common" to the channels, or those of
            each of the "channels"; the bound is then that of a pose among them.
        residuals: of other images at known poses, for `Alignment.misspecified`.
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
    _check_arguments(estimator, iterations, levels, tone)
    model = Gaussian(1.0) if noise is None else _checked_noise(noise, measured)
    options["size"] = _size(measured, scene, options)
    loaded, _ = as_world(scene, wanted(MeasurementOptions(**options)))
    damping, count, words = _damping(estimator), 0, None
    if levels:
        near = approach(
            loaded,
            measured,
            noise,
            levels=levels,
            estimator=estimator,
            iterations=iterations,
            tone=tone,
            **options,
        )
        options, words, count = near.options, near.words, near.iterations
    drafted = isinstance(loaded, Field) and anchor is None
    with measurement(SearchedField(loaded) if drafted else loaded, **options) as run:
        if not run.view.measured.is_colour:
            raise AlignmentError(
                f"the camera measures {run.view.measured.name} alone; an alignment needs rgb, of the film "
                "(pixel_format) and of --channels"
            )
        run.warn_of_limits()
        misfit = Misfit(run.only(description=words), measured, model, anchor, Tone(tone))
        if estimator == "adam":
            pose, status, steps = adam(misfit, run.view.pose, learning_rate, batch_pixels, iterations)
        else:
            pose, status, steps = least_squares(misfit, run.view.pose, damping, iterations)
            for _ in range(_ANCHORS if anchor is None else int(noise is None)):
                if status != "converged":
                    break
                start = pose
                if anchor is None:
                    misfit.tie(misfit.anchor(start))
                if noise is None:  # what a small step is depends on it
                    misfit.assume(_noise_of_residuals(misfit, start))
                pose, status, more = least_squares(misfit, start, damping, iterations)
                steps += more
                if misfit.motion(start, pose) < SMALL_MOTION:
                    break
        if noise is None:
            misfit.differentiate(pose)
            misfit.assume(_noise_of_residuals(misfit, pose))
        count += steps
        origin = "residuals" if noise is None else "given"
        if not drafted:
            return _result(misfit, pose, status, count, origin, residuals)
    options["pose"] = pose
    with measurement(loaded, **options) as run:
        misfit = Misfit(run.only(description=words), measured, misfit.noise, None, Tone(tone))
        return _result(misfit, pose, status, count, origin, residuals)


@dataclasses.dataclass(frozen=True, eq=False)
class Approach:
    """Where a search through reduced images has ended."""

    options: MeasurementKeywords
    """Of the image itself, with the pose to go on from, and the chosen pixels by name."""
    words: str
    """What these pixels are called."""
    status: Status
    """On the last level."""
    rms: float
    """Root mean square of y − R on the last level [value]; infinite where no level was searched."""
    iterations: int
    """Over all levels."""


@in_turn
def approach(
    scene: Any,
    image: ArrayLike,
    noise: NoiseModel | None,
    *,
    levels: int,
    estimator: str = "levenberg_marquardt",
    iterations: int = 30,
    tone: ToneKind = "known",
    **options: Unpack[MeasurementKeywords],
) -> Approach:
    """Search through reduced images alone, for a start of `align` without levels; arguments as there.

    Raises:
        MitsubaCRBError: as `align`.
    """
    measured = _checked_image(image)
    _check_arguments(estimator, iterations, levels, tone)
    model = Gaussian(1.0) if noise is None else _checked_noise(noise, measured)
    options["size"] = _size(measured, scene, options)
    loaded, _ = as_world(scene, wanted(MeasurementOptions(**options)))
    count, rms = 0, np.inf
    status: Status = "out of iterations"
    with measurement(loaded, **options) as run:
        # Chosen once, where the search starts: a reduced image is of the same pixels.
        found: MeasurementKeywords = {**options, "pixels": run.mask}
        words, view = run.selection.description, run.view
    left = run.mask[..., None] & np.isfinite(measured).all(axis=2, keepdims=True)
    chosen = np.where(left, measured, np.nan)
    for small, of_small in pyramid(chosen, model, levels):
        coarse: MeasurementKeywords = {
            **found,
            "size": (small.shape[1], small.shape[0]),
            "pixels": None,
        }
        world = loaded
        if isinstance(loaded, Field):
            factor = round(len(measured) / len(small))
            before = chosen if factor == 2 else reduced(chosen, factor // 2)
            camera = view.intrinsics.scaled((before.shape[1], before.shape[0]))
            world, small = reduced_world(loaded, Camera.of(camera), before)
            coarse["camera"] = camera
        with measurement(world, **coarse) as run:
            misfit = Misfit(run, small, of_small, None, Tone(tone))
            pose, status, steps = least_squares(misfit, run.view.pose, _damping(estimator), iterations)
            rms = misfit.rms(misfit.difference(pose))
            count += steps
        if status != "diverged":
            found["pose"] = pose
    return Approach(found, words, status, rms, count)


def _damping(estimator: str) -> float:
    return DAMPING if estimator == "levenberg_marquardt" else 0.0


def _noise_of_residuals(misfit: Misfit, pose: Array) -> Gaussian:
    """White noise that is as large as the residuals, of whose degrees of freedom the parameters take some."""
    values = int(np.count_nonzero(misfit.weights))
    taken = 6 + len(misfit.tone.parameters)
    if values <= taken:
        raise AlignmentError(f"{values} values do not tell {taken} parameters and the noise; give --sigma")
    sigma = misfit.rms(misfit.difference(pose)) * np.sqrt(values / (values - taken))
    return Gaussian(max(sigma, _LEAST_SIGMA * float(np.abs(misfit.measured).max())))


def _result(
    misfit: Misfit,
    pose: Array,
    status: Status,
    iterations: int,
    origin: str,
    residuals: ResidualCovariance | None,
) -> Alignment:
    """What is known at the end."""
    misfit.differentiate(pose)
    difference = misfit.difference(pose)
    jacobian = misfit.image_jacobian(pose)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PrecisionWarning)
        bound = joint_bound(joint_information(jacobian, misfit.noise).marginalize())
        beside = None if residuals is None else misspecified_covariance(jacobian, misfit.noise, residuals)
    matrix = bound.information.matrix
    return Alignment(
        pose=pose,
        status=status,
        residual=misfit.residual(difference),
        iterations=iterations,
        bound=bound,
        excess=misfit.excess(difference, matrix),
        added=misfit.added(difference, matrix),
        masked=misfit.masked,
        invalid=misfit.invalid,
        tone=misfit.tone,
        rms=misfit.rms(difference),
        noise={**misfit.noise.to_dict(), "description": misfit.noise.description, "origin": origin},
        image=misfit.image(pose),
        misspecified=beside,
    )


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


def _size(image: NDArray[Any], scene: Any, options: MeasurementKeywords) -> tuple[int, int]:
    """The image's size; one that the film's shape does not explain must be confirmed."""
    height, width = image.shape[:2]
    size, camera = options.get("size"), options.get("camera")
    if size is not None and tuple(size) != (width, height):
        raise AlignmentError(f"the measured image is {width}x{height}, and size says {size[0]}x{size[1]}")
    if size is None and camera is None:  # a calibration refuses another shape by itself
        own: MeasurementKeywords = {"sensor": options.get("sensor", 0), "pose": options.get("pose")}
        with open_measurable(scene, MeasurementOptions(**own)) as view:
            across, down = view.size
        # As close to the film's shape as whole pixels can be.
        if abs(width * down - height * across) >= max(across, down):
            raise AlignmentError(
                f"the measured image is {width}x{height}, the film {across}x{down}, another field of view; "
                f"say size=({width}, {height}) if the sensor shall have it"
            )
    return width, height


def _check_arguments(estimator: str, iterations: int, levels: int, tone: str) -> None:
    if estimator not in ESTIMATORS:
        raise AlignmentError(f"unknown estimator {estimator!r}; estimators: {', '.join(ESTIMATORS)}")
    if iterations < 1:
        raise AlignmentError(f"iterations must be at least 1; got {iterations}")
    if levels < 0:
        raise AlignmentError(f"levels must not be negative; got {levels}")
    if tone not in TONES:
        raise AlignmentError(
            f"unknown tone {tone!r}; what may be known of gain and black: {', '.join(TONES)}"
        )
