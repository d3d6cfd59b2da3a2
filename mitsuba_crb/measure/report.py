"""A bound with what may be asked beside it: pictures of what each pixel tells, and errors over displacements.

All are of one view with one noise, in a file, so that what is written of them says how to get them again.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Unpack

from numpy.typing import ArrayLike

from ..bound.cramer_rao import PoseBound
from ..bound.hcr import HCRBound
from ..bound.prior import load_prior
from ..errors import OptionError
from ..files import Record
from ..noise import CoupledNoise, NoiseModel
from ..render.scene import SceneFile
from ..se3 import Frame
from .displaced import hcr_bound
from .opening import as_world, wanted
from .options import MeasurementKeywords, MeasurementOptions
from .pictures import Gathering, Pictures
from .pose import pose_bound
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

    @property
    def attributes(self) -> dict[str, str | int]:
        """What a picture's file should say of how it was made."""
        return {name: self.bound.provenance[name] for name in ("scene", "method", "spp", "seed")}


def bound_report(
    scene: Path,
    noise: NoiseModel | None = None,
    *,
    defines: Mapping[str, str] | None = None,
    prior: Path | None = None,
    nuisances: Sequence[str] = (),
    frame: Frame = "camera",
    hcr: bool = False,
    displacements: ArrayLike | None = None,
    pictures: bool = False,
    **options: Unpack[MeasurementKeywords],
) -> BoundReport:
    """The bound of a scene's file, and what is asked beside it.

    Args:
        scene: a file, as `pose_bound` takes it.
        noise: as for `pose_bound`.
        defines: the file's `<default>`s.
        prior: a file, see `load_prior`.
        nuisances: as for `pose_bound`.
        frame: of the bound's matrices and the pictures' Jacobian columns.
        hcr: whether to bound errors over finite displacements, too.
        displacements: those, as for `hcr_bound`; they ask for it themselves.
        pictures: whether to keep what each pixel tells.
        options: see `MeasurementOptions`.

    Raises:
        OptionError: displacements with a prior or nuisances, or pictures of noise that couples pixels.
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
    source: Any = SceneFile(scene, named)
    if hcr:  # which has no nuisances, so that one loaded scene serves both
        source, _ = as_world(source, wanted(MeasurementOptions(**options)))
    bound = pose_bound(
        source, noise, prior=known, nuisances=nuisances, **_gathered(options, gathering)
    ).to_frame(frame)
    beyond = hcr_bound(source, noise, displacements=displacements, **options) if hcr else None
    facts = {
        **bound.provenance,
        "scene": str(scene),
        "defines": named,
        "seconds": {**bound.provenance["seconds"], "total": time.perf_counter() - start},
    }
    if prior:
        facts["prior"] = str(prior)
    shown = None
    if gathering is not None:
        width, height = facts["size"]
        shown = gathering.pictures(bound.information, (width, height), frame=frame)
    return BoundReport(dataclasses.replace(bound, provenance=facts), beyond, shown)


def _gathered(options: MeasurementKeywords, gathering: Gathering | None) -> MeasurementKeywords:
    """The options of a measurement whose tiles are gathered before anybody else is told of them."""
    if gathering is None:
        return options
    told = options.get("on_tile")

    def on_tile(tile: TileJacobian, done: int, total: int) -> None:
        gathering.add(tile.pixels, tile.mean, tile.batch_values, tile.weights)
        if told is not None:
            told(tile, done, total)

    return {**options, "on_tile": on_tile}
