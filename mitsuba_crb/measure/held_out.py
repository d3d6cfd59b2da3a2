"""Residuals of photographs at their given poses: what a model of the scene does not explain of them.

Only those count that the model was not fitted to: what a capture holds out. Gain and black level are fitted
as in an alignment (`tone`), poses are not.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, Unpack

import numpy as np

from ..camera import Intrinsics
from ..datasets.photographs import Capture
from ..datasets.pictures import Encoding, Picture, comparable
from ..errors import CaptureError
from ..files import Record
from ..information.subset import selected
from ..jacobian.method import Paths
from ..noise import NoiseEstimate, PerChannel, estimate_noise
from ..noise.residuals import ResidualCovariance, residual_covariance
from ..render.lending import in_turn
from ..se3 import Array
from .measurable import Measurable
from .opening import open_measurable
from .options import MeasurementKeywords, MeasurementOptions
from .tone import Tone, ToneKind

MOST = 16
"""Photographs that are compared, evenly chosen where there are more."""

_TIMES = 4
"""Paths per pixel, over those of an alignment's renders: photographs are few, and rendered but once."""
_HELD_OUT = 0x48454C44
"""Purpose of the renders' random numbers."""


@dataclasses.dataclass(frozen=True, eq=False)
class HeldOut(Record):
    """Photographs at their given poses, beside renders there."""

    names: tuple[str, ...]
    """What the capture calls them."""
    residuals: tuple[Array, ...]
    """(H, W, 3) each, measured minus expected [value]; NaN where nothing is compared."""
    renderer: Array
    """(n, 3, 3), covariance of each render's own noise, of a pixel [value²]."""
    tones: tuple[Tone, ...]
    """Gain and black of each photograph."""

    @property
    def rms(self) -> Array:
        """Of each photograph's residuals [value]."""
        return np.array([math.sqrt(np.nanmean(image**2)) for image in self.residuals])

    @property
    def noise(self) -> NoiseEstimate:
        """White noise of each channel, as large as the residuals without the renderer's noise."""
        seen = np.concatenate([image[np.isfinite(image).all(axis=2)] for image in self.residuals])
        found = estimate_noise(seen[None, None], by="channel")
        variance = np.maximum(found.estimate - np.diagonal(self.renderer.mean(axis=0)), 1e-12)
        return NoiseEstimate(PerChannel(np.sqrt(variance)), variance, found.standard_error)

    def covariance(self, reach: int | None = None) -> ResidualCovariance:
        """S, pooled over the photographs; arguments and errors as of `residual_covariance`."""
        return residual_covariance(self.residuals, reach=reach, renderer=self.renderer.mean(axis=0))

    def in_radiance(self) -> HeldOut:
        """The same in the renders' unit [radiance]: photographs may have different gains."""
        with np.errstate(divide="ignore"):
            scales = [np.where(tone.gain > 0.0, 1.0 / tone.gain, np.nan) for tone in self.tones]
        images = zip(self.residuals, scales, strict=True)
        noises = zip(self.renderer, scales, strict=True)
        return dataclasses.replace(
            self,
            residuals=tuple(image * scale for image, scale in images),
            renderer=np.array([noise * np.outer(scale, scale) for noise, scale in noises]),
        )


@in_turn
def held_out_residuals(
    scene: Any,
    capture: Capture,
    *,
    longest: int | None = None,
    tone: ToneKind = "channels",
    encoding: Encoding = "srgb",
    display: bool = False,
    **options: Unpack[MeasurementKeywords],
) -> HeldOut:
    """Compare the photographs that a capture holds out with renders at their given poses.

    Args:
        scene: loaded, in the frame of the capture's poses.
        capture: with what is held out.
        longest: side of the images that are compared [pixel], of larger ones; correlations reach over so many
            pixels as in an image of this size.
        tone: what of gain and black level is fitted.
        encoding, display: as of `comparable`.
        options: of the renders; poses and cameras are the capture's.

    Raises:
        CaptureError: nothing is held out, or an image cannot be read.
        AlignmentError: a photograph shows nothing.
        MitsubaCRBError: as `measurement`.
    """
    if not capture.test:
        raise CaptureError(f"this capture ({capture.format}) holds no photographs out ({capture.split})")
    places = np.unique(np.linspace(0, len(capture.test) - 1, min(len(capture.test), MOST)).round())
    chosen = [capture.photographs[capture.test[int(place)]] for place in places]
    first: MeasurementKeywords = {
        **options,
        "pose": chosen[0].pose,
        "camera": chosen[0].intrinsics,
        "size": None,
    }
    given = MeasurementOptions(**first)
    paths = Paths(_TIMES * given.uniform_spp, given.seed, given.batches)
    found = []
    with open_measurable(scene, given) as opened:
        for photograph in chosen:
            view = opened.seen_through(_reduced(photograph.intrinsics, longest)).at(photograph.pose)
            picture = Picture(
                photograph.image,
                photograph.colours().astype(np.float64),
                photograph.opacity().astype(np.float64),
            )
            values = comparable(picture, view.size, encoding=encoding, display=display).values
            found.append(_compared(view, values, Tone(tone), paths))
    residuals, noises, tones = zip(*found, strict=True)
    return HeldOut(tuple(photograph.name for photograph in chosen), residuals, np.array(noises), tones)


def _reduced(camera: Intrinsics, longest: int | None) -> Intrinsics:
    """Of an image whose longer side is at most so long [pixel]."""
    if longest is None or longest >= max(camera.size):
        return camera
    width, height = (max(1, round(side * longest / max(camera.size))) for side in camera.size)
    return camera.scaled((width, height))


def _compared(view: Measurable, values: Array, tone: Tone, paths: Paths) -> tuple[Array, Array, Tone]:
    """Residuals of a photograph's values (H, W, 3), the render's noise (3, 3), and the fitted tone."""
    pixels = selected(np.asarray(np.isfinite(values).all(axis=2)))
    batches = view.start_image(pixels, paths, purpose=_HELD_OUT, even=True)()
    seen = np.isfinite(batches).all(axis=(0, 2))
    (x, y), batches = pixels[seen].T, batches[:, seen]
    measured, mean = values[y, x], batches.mean(axis=0)
    fitted = tone.fitted(measured, batches, np.ones_like(measured))
    residual = np.full_like(values, np.nan)
    residual[y, x] = measured - fitted(mean)
    off, K = fitted.gain * (batches - mean), len(batches)
    noise = np.einsum("knc,kne->ce", off, off) / (K * (K - 1) * max(len(mean), 1))
    return residual, noise, fitted
