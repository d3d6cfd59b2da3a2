"""A bound with what may be asked beside it: pictures of what each pixel tells, and errors over displacements.

All are of one view with one noise, in a file, so that what is written of them says how to get them again.
"""

from __future__ import annotations

import dataclasses
import time
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Unpack

from numpy.typing import ArrayLike

from ..bound.cramer_rao import PoseBound
from ..bound.hcr import HCRBound
from ..bound.misspecified import MisspecifiedCovariance, misspecified_covariance
from ..bound.prior import load_prior
from ..datasets.photographs import Capture
from ..datasets.pictures import Encoding
from ..errors import OptionError, PrecisionWarning
from ..files import Record
from ..noise import CoupledNoise, NoiseModel
from ..render.scene import SceneFile
from ..se3 import Frame
from .displaced import hcr_bound
from .held_out import HeldOut, held_out_residuals
from .opening import as_world, open_measurable, wanted
from .options import MeasurementKeywords, MeasurementOptions
from .pictures import Gathering, Pictures
from .pose import pose_bound, pose_jacobian
from .sensing import COLOUR
from .tile_jacobian import TileJacobian


@dataclasses.dataclass(frozen=True, eq=False)
class BoundReport(Record):
    """A bound and what was asked beside it."""

    bound: PoseBound
    """In the frame asked for; its provenance names the scene's file, its defaults and the prior's file."""
    hcr: HCRBound | None
    """Over finite displacements, in the camera frame."""
    pictures: Pictures | None
    """Of the same measurement as the bound, in its frame."""
    misspecified: MisspecifiedCovariance | None = None
    """What least squares has with this map, by photographs that a capture holds out."""
    held_out: HeldOut | None = None
    """Those photographs, beside renders."""

    @property
    def attributes(self) -> dict[str, str | int]:
        """What a picture's file should say of how it was made."""
        return {name: self.bound.provenance[name] for name in ("scene", "method", "spp", "seed")}


def bound_report(
    scene: Any,
    noise: NoiseModel | None = None,
    *,
    defines: Mapping[str, str] | None = None,
    prior: Path | None = None,
    nuisances: Sequence[str] = (),
    frame: Frame = "camera",
    hcr: bool = False,
    displacements: ArrayLike | None = None,
    pictures: bool = False,
    capture: Capture | None = None,
    encoding: Encoding = "srgb",
    **options: Unpack[MeasurementKeywords],
) -> BoundReport:
    """The bound of a scene, and what is asked beside it.

    Args:
        scene: as for `pose_bound`.
        noise: as for `pose_bound`.
        defines: the file's `<default>`s.
        prior: a file, see `load_prior`.
        nuisances: as for `pose_bound`.
        frame: of the bound's matrices and the pictures' Jacobian columns.
        hcr: whether to bound errors over finite displacements, too.
        displacements: those, as for `hcr_bound`; they ask for it themselves.
        pictures: whether to keep what each pixel tells.
        capture: photographs in the scene's frame, of which those that it holds out tell the noise, if none is
            given, and what correlated errors of the map make of the bound.
        encoding: of the photographs.
        options: see `MeasurementOptions`.

    Raises:
        OptionError: displacements with a prior or nuisances, pictures of noise that couples pixels, or a
            capture with a prior or with anything but colour.
        PriorError: an impossible prior.
        MitsubaCRBError: as `load_scene`, `pose_bound` and `hcr_bound`.
    """
    start = time.perf_counter()
    hcr = hcr or displacements is not None
    if hcr and options.get("measure", COLOUR) != COLOUR:
        raise OptionError(
            "--hcr (hcr=True) is of colour: pixels of a displaced camera may measure no depth, and what that "
            "tells is not defined; leave it out"
        )
    if hcr and (prior or nuisances):
        raise OptionError(
            "--hcr (hcr=True) knows neither priors nor nuisances; leave out --prior and --marginalize"
        )
    if capture is not None and (prior or options.get("measure", COLOUR) != COLOUR):
        raise OptionError(
            "--photographs (capture=) tells what an estimator of colour without a prior has; leave out "
            "--prior and --measure"
        )
    gathering = None
    if pictures:
        if isinstance(noise, CoupledNoise):
            raise OptionError(
                "--exr and --plot (pictures=True) show what each pixel tells, but this noise couples pixels; "
                "leave them out"
            )
        gathering = Gathering()
    known = load_prior(prior) if prior else None
    named = dict(defines or {})
    from_file = isinstance(scene, str | Path)
    source: Any = SceneFile(scene, named) if from_file else scene
    held_out, origin = None, "given"
    if capture is not None:
        held_out = _held_out(source, capture, encoding, options)
        if noise is None:
            noise = held_out.noise.model
            origin = f"residuals of {len(held_out.names)} photographs held out"
    if hcr:  # which has no nuisances, so that one loaded scene serves both
        source, _ = as_world(source, wanted(MeasurementOptions(**options)))
    bound = pose_bound(
        source, noise, prior=known, nuisances=nuisances, **_gathered(options, gathering)
    ).to_frame(frame)
    beyond = hcr_bound(source, noise, displacements=displacements, **options) if hcr else None
    facts = {
        **bound.provenance,
        "scene": str(scene) if from_file else bound.provenance["scene"],
        "defines": named,
        "seconds": {**bound.provenance["seconds"], "total": time.perf_counter() - start},
    }
    if prior:
        facts["prior"] = str(prior)
    beside = None
    if held_out is not None and noise is not None:
        facts["noise"] = {**facts["noise"], "origin": origin}
        beside = _misspecified(source, noise, held_out, nuisances, options, frame)
    shown = None
    if gathering is not None:
        width, height = facts["size"]
        shown = gathering.pictures(bound.information, (width, height), frame=frame)
    return BoundReport(dataclasses.replace(bound, provenance=facts), beyond, shown, beside, held_out)


def _held_out(scene: Any, capture: Capture, encoding: Encoding, options: MeasurementKeywords) -> HeldOut:
    """Residuals of photographs held out, of images as large as the one that is measured [radiance]."""
    given = MeasurementOptions(**options)
    loaded, _ = as_world(scene, wanted(given))
    with open_measurable(loaded, given) as view:
        longest, display = max(view.size), view.white is not None
    return held_out_residuals(
        loaded,
        capture,
        longest=longest,
        tone="known" if display else "channels",
        encoding=encoding,
        display=display,
        **options,
    ).in_radiance()


def _misspecified(
    scene: Any,
    noise: NoiseModel,
    held_out: HeldOut,
    nuisances: Sequence[str],
    options: MeasurementKeywords,
    frame: Frame,
) -> MisspecifiedCovariance:
    """By a Jacobian of its own, for it is needed as a whole."""
    uniform: MeasurementKeywords = {
        **options,
        "precision": None,
        "max_spp": None,
        "on_tile": None,
        "on_progress": None,
        "on_round": None,
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PrecisionWarning)  # the bound has had its own
        jacobian = pose_jacobian(scene, nuisances=nuisances, **uniform)
        return misspecified_covariance(jacobian.to_frame(frame), noise, held_out.covariance())


def _gathered(options: MeasurementKeywords, gathering: Gathering | None) -> MeasurementKeywords:
    """The options of a measurement whose tiles are gathered before anybody else is told of them."""
    if gathering is None:
        return options
    told = options.get("on_tile")

    def on_tile(tile: TileJacobian, done: int, total: int) -> None:
        gathering.add(tile.pixels, tile.mean, tile.batch_values, tile.weights, tile.spp)
        if told is not None:
            told(tile, done, total)

    return {**options, "on_tile": on_tile}
