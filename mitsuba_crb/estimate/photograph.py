"""The pose that a photograph was taken from, by where the scene looks like it (`align`).

Of several starts each is searched through reduced images, coarse to fine; the one whose render comes closest
on the last of them goes on to the photograph itself. Gain and black level of the photograph are fitted where
the scene has radiance; a field has the values of photographs itself (`measure.tone`).

A search that has converged may still have ended where the scene looks like something else: the verdict asks
whether the render explains the photograph, too.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Unpack

import numpy as np

from .. import se3
from ..datasets.photographs import Capture
from ..datasets.pictures import Comparable, Encoding, comparable, read_picture
from ..errors import AlignmentError, OutOfViewError
from ..files import Record
from ..measure.held_out import HeldOut, held_out_residuals
from ..measure.likeness import LEAST_GAIN_DB, POOR_DB, psnr_db
from ..measure.opening import as_world, open_measurable, wanted
from ..measure.options import MeasurementKeywords, MeasurementOptions
from ..measure.stations import Station, named
from ..measure.tone import ToneKind
from ..noise import SRGB, NoiseModel
from ..render.lending import in_turn
from ..render.scene import SceneFile
from ..se3 import Array
from .align import Alignment, align, approach
from .optimisers import Status

_COARSEST = 16
"""Shortest side of the image that a search begins with, about, by default [pixel]."""

_EXCESS = 0.1
"""Part of the pose's covariance that the renderer's noise may add, where the paths are not given, …"""
_MOST = 1024
"""… by at most so many paths per pixel."""

Verdict = Literal["aligned", "unlike", "not converged"]
"""Of an alignment: the search ended where the render explains the photograph, elsewhere, or not at all."""
Progress = Callable[[int, int], None]
"""Called after each start with those that are searched and all of them."""


@dataclasses.dataclass(frozen=True, eq=False)
class Candidate(Record):
    """A start, and where the search through reduced images went from there."""

    name: str
    """What its file calls it."""
    start: Array
    """(4, 4), world_from_camera."""
    pose: Array
    """(4, 4), where the search ended."""
    status: Status
    """Of the search."""
    rms: float
    """Root mean square of the residuals on the last reduced image [value]; infinite if it went nowhere."""

    @property
    def moved(self) -> tuple[float, float]:
        """How far: distance of the centres [scene unit], angle [deg]."""
        motion = se3.inverse(self.start) @ self.pose
        angle = float(np.degrees(np.linalg.norm(se3.log(motion)[3:])))
        return float(np.linalg.norm(motion[:3, 3])), angle


@dataclasses.dataclass(frozen=True, eq=False)
class PhotographAlignment(Record):
    """Where a photograph was taken from."""

    alignment: Alignment
    """The pose, its covariance, gain and black."""
    candidates: tuple[Candidate, ...]
    """In the order of their residuals, the one that went on first."""
    measured: Comparable
    """The photograph's values that were compared."""
    display: bool
    """Whether they are display-referred, and not linear."""
    psnr_db: float
    """Of the render, in display values [dB]."""
    even_psnr_db: float
    """Of an even colour in its place [dB]."""
    held_out: HeldOut | None
    """Other photographs at their given poses, if a capture was given."""
    settings: dict[str, Any]
    """What it depends on, JSON-able."""

    @property
    def verdict(self) -> Verdict:
        """Whether to believe the pose."""
        if self.alignment.status != "converged":
            return "not converged"
        explains = self.psnr_db >= POOR_DB and self.psnr_db - self.even_psnr_db >= LEAST_GAIN_DB
        return "aligned" if explains else "unlike"

    @property
    def exit_code(self) -> int:
        """0 aligned, 1 the render is unlike the photograph, 3 the search did not end."""
        return {"aligned": 0, "unlike": 1, "not converged": 3}[self.verdict]


@in_turn
def align_photograph(
    scene: Any,
    photograph: Path,
    noise: NoiseModel | None = None,
    *,
    mask: Path | None = None,
    encoding: Encoding = "srgb",
    tone: ToneKind | None = None,
    starts: Sequence[Station] = (),
    capture: Capture | None = None,
    estimator: str = "levenberg_marquardt",
    iterations: int = 30,
    levels: int | None = None,
    defines: Mapping[str, str] | None = None,
    on_start: Progress | None = None,
    **options: Unpack[MeasurementKeywords],
) -> PhotographAlignment:
    """Estimate the pose that a photograph was taken from.

    Args:
        scene: as for `align`.
        photograph: an image file, turned as its EXIF orientation says. Where it has more pixels than the
            camera's image they are averaged; where it has fewer, the camera's image has so many.
        noise: of its values (white is 1); None: that of the residuals of the capture, or else of its own.
        mask: an image file of the same size; its black pixels show nothing of the scene.
        encoding: of the photograph.
        tone: what is fitted of gain and black level; None: those of each channel for a scene, nothing for a
            field, whose values are the photographs' own.
        starts: where searches start, in place of the camera's pose.
        capture: of other photographs at known poses in the scene's frame, of which those held out say what
            the model does not explain.
        estimator, iterations: as for `align`.
        levels: how many times the image is reduced by two; None: to about 16 pixels.
        defines: the scene file's `<default>`s.
        on_start: called after each start.
        options: see `MeasurementOptions`; a `camera` is of the photograph's shape. Without `spp` there are as
            many paths as let the renderer add less than a tenth to the pose's covariance, at most 1024.

    Raises:
        AlignmentError: the photograph cannot be read, is of another shape than the camera's image, or shows
            nothing; or no start sees the scene.
        MitsubaCRBError: as `align`.
    """
    origin = "given" if noise is not None else "residuals" if capture is None else "held out"
    picture = read_picture(photograph, mask)
    source = SceneFile(scene, dict(defines or {})) if isinstance(scene, str | Path) else scene
    first = starts[0].options(options) if starts else options
    loaded, label = as_world(source, wanted(MeasurementOptions(**first)))
    with open_measurable(loaded, MeasurementOptions(**first)) as view:
        size, own = view.size, Station("start", view.pose, None)
        display, deterministic = view.white is not None, view.deterministic
    if options.get("size") is None:
        size = min(size, picture.size)
    measured = comparable(picture, size, encoding=encoding, display=display)
    kind: ToneKind = ("known" if display else "channels") if tone is None else tone
    rest = _halvings(size) if levels is None else levels
    options["size"] = size
    others = None
    if capture is not None:
        others = held_out_residuals(
            loaded,
            capture,
            longest=max(size),
            tone=kind,
            encoding=encoding,
            display=display,
            **options,
        )
        noise = others.noise.model if noise is None else noise
    common: dict[str, Any] = {"estimator": estimator, "iterations": iterations, "tone": kind}
    found = []
    for index, start in enumerate(starts or [own]):
        here = start.options(options)
        with named(start):
            found.append((_searched(loaded, measured.values, noise, start, rest, common, here), here))
        if on_start is not None:
            on_start(index + 1, len(starts) or 1)
    found.sort(key=lambda each: each[0].rms)  # stable: of equals the first
    best, here = found[0]
    if len(found) > 1 and math.isinf(best.rms):
        raise AlignmentError(f"from none of the {len(found)} starts the scene is seen; give others")
    last: MeasurementKeywords = {**here, "pose": best.pose}
    residuals = None if others is None else others.covariance()
    result = align(loaded, measured.values, noise, residuals=residuals, **common, **last)
    spp = MeasurementOptions(**last).uniform_spp
    given = deterministic or options.get("spp") is not None
    if not given and result.status == "converged" and result.excess > _EXCESS:
        # The renderer's part of the covariance falls as the paths.
        batches = MeasurementOptions(**last).batches
        spp = batches * math.ceil(min(spp * result.excess / _EXCESS, max(spp, _MOST)) / batches)
        last = {**last, "pose": result.pose, "spp": spp}
        result = align(loaded, measured.values, noise, residuals=residuals, **common, **last)
    return PhotographAlignment(
        result,
        tuple(candidate for candidate, _ in found),
        measured,
        display,
        *_likeness(measured.values, result.image, display=display),
        others,
        {
            "scene": label,
            "defines": dict(defines or {}),
            "photograph": str(photograph),
            "photograph_size": list(picture.size),
            "size": list(size),
            "mask": None if mask is None else str(mask),
            "encoding": encoding,
            "levels": rest,
            "noise": origin,
            **common,
            "sensor": result.bound.information.variable,
            "seed": MeasurementOptions(**options).seed,
            "spp": 0 if deterministic else spp,
        },
    )


def _halvings(size: tuple[int, int]) -> int:
    """How many leave the shortest side about as long as `_COARSEST`."""
    return max(0, round(math.log2(min(size) / _COARSEST)))


def _searched(
    loaded: Any,
    image: Array,
    noise: NoiseModel | None,
    start: Station,
    levels: int,
    common: dict[str, Any],
    options: MeasurementKeywords,
) -> Candidate:
    """From one start through reduced images, or through the image itself where there are none."""
    here: MeasurementKeywords = {**options, "pose": start.pose}
    try:
        if levels:
            near = approach(loaded, image, noise, levels=levels, **common, **here)
            pose, status, rms = near.options["pose"], near.status, near.rms
        else:
            whole = align(loaded, image, noise, **common, **here)
            pose, status, rms = whole.pose, whole.status, whole.rms
    except OutOfViewError:
        return Candidate(start.name, start.pose, start.pose, "diverged", math.inf)
    return Candidate(start.name, start.pose, pose, status, math.inf if status == "diverged" else rms)


def _likeness(measured: Array, image: Array, *, display: bool) -> tuple[float, float]:
    """PSNR of the render, and of an even colour in its place, in display values."""
    seen = np.isfinite(measured).all(axis=2) & np.isfinite(image).all(axis=2)
    values, render = measured[seen], image[seen]
    even = np.broadcast_to(values.mean(axis=0), values.shape)

    def shown(linear: Array) -> Array:
        inside = np.clip(linear, 0.0, 1.0)
        return inside if display else np.asarray(SRGB(inside))

    means = [float(np.mean((shown(values) - shown(other)) ** 2)) for other in (render, even)]
    return psnr_db(means[0]), psnr_db(means[1])
