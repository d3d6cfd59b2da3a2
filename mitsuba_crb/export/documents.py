"""What a run leaves on disk: a JSON document and a multi-channel OpenEXR image.

Every file is written beside its destination and moved there in one step, so that an interrupted run
leaves the old file or none, never half of one. `check_target` asks the folder before anything is
rendered.
"""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from .. import se3
from ..errors import OutputError
from ..files import atomic, beside
from ..information.identifiability import weakest_direction
from ..information.pixel_information import along, pixel_information
from ..information.significance import identified
from ..information.symmetric import pack

if TYPE_CHECKING:
    from ..agents.selection import TileSelection
    from ..agents.team import Team
    from ..bound.cramer_rao import PoseBound
    from ..information.fisher import FisherInformation, ImageJacobian
    from ..information.identifiability import PoseDirection
    from ..measure.teams import TeamFusion, TeamSelection
    from ..noise import IndependentNoise

SCHEMA = "mitsuba-crb/bound/1"
FUSE_SCHEMA = "mitsuba-crb/fuse/1"
SELECT_SCHEMA = "mitsuba-crb/select/1"

COLUMN_NAMES = ("dI_drho_x", "dI_drho_y", "dI_drho_z", "dI_dphi_x", "dI_dphi_y", "dI_dphi_z")
"""EXR layers of the six Jacobian columns, in twist order: translation [radiance / scene unit], then
rotation [radiance / rad]. The channels of a layer are `R`, `G`, `B`, as in `dI_drho_x.R`."""

SHARE_NAME = "weakest_share"
"""EXR layer of each pixel's share of the information about the weakest direction, with channel `Y`."""

_BREAK = re.compile(r",\n\s*")
_PROVENANCE_KEYS = (
    "scene",
    "defines",
    "sensor",
    "method",
    "spp",
    "seed",
    "batches",
    "size",
    "pixels",
    "noise",
    "prior",
)
_BOUND_KEYS = (
    "frame",
    "twist_order",
    "units",
    "length_scale",
    "information",
    "information_standard_error",
    "covariance",
    "position_std",
    "position_std_standard_error",
    "rotation_std_deg",
    "rotation_std_deg_standard_error",
    "eigenvalues",
    "eigenvalues_standard_error",
    "rank",
    "unobserved",
    "weakest",
    "optimality",
)


@dataclass(frozen=True)
class Pictures:
    """The image, its Jacobian and its information density; NaN where a pixel was not measured."""

    image: npt.NDArray[np.float32]
    """(H, W, C) linear RGB [radiance]."""
    columns: npt.NDArray[np.float32]
    """(H, W, C, 6) dI/dξ in `frame` [radiance / scene unit], then [radiance / rad]."""
    information: npt.NDArray[np.float64]
    """(H, W) each pixel's unbiased share of the trace of the Fisher information in the camera frame with
    translation scaled by the length scale; negative by chance where there is hardly any."""
    weakest_share: npt.NDArray[np.float64]
    """(H, W) each pixel's share of the information about `weakest`, without bias; NaN if nothing is seen."""
    weakest: PoseDirection | None
    """The direction that the image sees worst but does see."""
    frame: Literal["camera", "world"]
    """Frame of `columns`."""
    pose: npt.NDArray[np.float64]
    """`world_from_camera`, 4x4, the linearisation point."""
    length_scale: float
    """Median visible depth [scene unit]."""


class Gathering:
    """Takes tiles as they are measured, keeps of each what `Pictures` need, and composes them.

    Args:
        noise: the model whose weights give the information; None: unit variance.
    """

    def __init__(self, noise: IndependentNoise | None = None) -> None:
        self._noise = noise
        self._tiles: list[tuple[npt.NDArray[Any], ...]] = []

    def add(
        self,
        pixels: npt.NDArray[np.integer],
        mean: npt.NDArray[np.float64],
        batch_values: npt.NDArray[np.float64],
        expected: npt.NDArray[np.float64] | None = None,
    ) -> None:
        """Take over some pixels.

        Args:
            pixels: (n, 2) columns and rows.
            mean: (n, C) the image there.
            batch_values: (K, n, C, 6) independent estimates of dI/dξ in the camera frame.
            expected: (n, C) the image by other random numbers, for noise that depends on it; None: `mean`.
        """
        expected = mean if expected is None else expected
        weights = np.ones_like(mean) if self._noise is None else self._noise.weights(pixels, expected)
        values = np.mean(batch_values, axis=0).astype(np.float32)
        own = pixel_information(batch_values, weights)
        self._tiles.append((np.array(pixels), mean.astype(np.float32), values, own))

    def pictures(
        self,
        information: FisherInformation,
        size: tuple[int, int],
        *,
        frame: Literal["camera", "world"] = "camera",
        variance: float = 1.0,
    ) -> Pictures:
        """Compose what was gathered.

        Args:
            information: what became of the same pixels: its pose, length scale and selection.
            size: width and height of the image [pixel].
            frame: of the columns.
            variance: of the noise where no model was given [radiance²].
        """
        width, height = size
        channels = self._tiles[0][1].shape[1] if self._tiles else 3
        image = np.full((height, width, channels), np.nan, np.float32)
        columns = np.full((height, width, channels, 6), np.nan, np.float32)
        density, share = np.full((2, height, width), np.nan)
        found = identified(information)
        weakest = weakest_direction(found, information.pose, information.length_scale)
        selection, length = information.selection, information.length_scale
        diagonal = pack(np.diag(information.scale**2))
        scale = (selection.total / selection.selected if selection.kind == "random" else 1.0) / variance
        turn = np.eye(6) if frame == "camera" else se3.adjoint(se3.inverse(information.pose))
        for pixels, mean, values, own in self._tiles:
            x, y = pixels.T
            image[y, x] = mean
            columns[y, x] = values @ turn  # dI/dξ_world = dI/dξ_camera · Ad(camera_from_world)
            density[y, x] = scale * (own @ diagonal)
            if weakest is not None:
                share[y, x] = along(own, weakest.direction * information.scale)
        if weakest is not None:
            share /= np.nansum(share)
        return Pictures(image, columns, density, share, weakest, frame, information.pose, length)


def pictures_of(
    jacobian: ImageJacobian, information: FisherInformation, noise: IndependentNoise | None = None
) -> Pictures:
    """The pictures of a Jacobian held whole, its columns in the camera frame."""
    jacobian = jacobian.to_frame("camera")
    gathering = Gathering(noise)
    gathering.add(jacobian.pixels, jacobian.mean, jacobian.batch_values, jacobian.expected)
    height, width = jacobian.image.shape[:2]
    return gathering.pictures(information, (width, height))


def check_target(path: Path, option: str, inputs: Sequence[Path] = (), *, resumes: bool = False) -> None:
    """Raise `OutputError` unless `path` can be written, without touching what is there.

    Args:
        path: the file to be written.
        option: the option's name, for the message.
        inputs: files that this run reads, and that must not be overwritten.
        resumes: whether this run keeps the trials that the file holds.
    """
    target = Path(os.path.realpath(path)) if os.path.islink(path) else path
    folder = target.parent
    if not os.path.isdir(folder):
        raise OutputError(f"{option} {path}: the folder {folder} does not exist; create it first")
    if os.path.isdir(target):
        raise OutputError(f"{option} {path}: this is a folder; name a file in it")
    if os.path.lexists(target) and not os.path.isfile(target):
        raise OutputError(f"{option} {path}: this is not a regular file; name another")
    for source in inputs:
        if os.path.exists(target) and os.path.exists(source) and os.path.samefile(target, source):
            raise OutputError(
                f"{option} {path}: this would overwrite an input of this run; name another file"
            )
    if not resumes and os.path.isfile(path) and _holds_trials(path):
        raise OutputError(f"{option} {path}: this holds trials that would be lost; name another file")
    # asking by writing: permission bits say nothing about root, read-only mounts and quotas
    probe = beside(target)
    try:
        probe.touch(exist_ok=False)
        probe.unlink()
    except OSError as error:
        raise OutputError(
            f"{option} {path}: cannot write in the folder {folder} ({error.strerror})"
        ) from error


def _holds_trials(path: Path) -> bool:
    from ..estimate.trials import SCHEMA as TRIALS  # late: it imports what measures

    with path.open("rb") as file:
        return TRIALS.encode() in file.read(100)


def check_folder(path: Path, option: str) -> None:
    """Make the folder `path` if it is missing; raise `OutputError` unless files can be written in it."""
    if os.path.lexists(path) and not os.path.isdir(path):
        raise OutputError(f"{option} {path}: this is a file; name a folder")
    if not os.path.lexists(path):
        try:
            path.mkdir()
        except OSError as error:
            raise OutputError(f"{option} {path}: cannot make this folder ({error.strerror})") from error
    check_target(path / "probe", option)


def bound_document(bound: PoseBound) -> dict[str, Any]:
    """The bound and its provenance as strict JSON: infinities are "inf", not-a-number is None."""
    values, provenance = bound.to_dict(), bound.provenance
    document = {
        "schema": SCHEMA,
        **{key: provenance.get(key) for key in _PROVENANCE_KEYS},
        "pose": bound.information.pose,
        **{key: values[key] for key in _BOUND_KEYS},
        "nuisances": values["nuisances"],
        "noise_inflation": provenance.get("noise_inflation"),
        "warnings": provenance.get("warnings", []),
        "versions": provenance.get("versions", {}),
        "seconds": provenance.get("seconds", {}),
    }
    plain: dict[str, Any] = _plain(document)
    return plain


def fusion_document(team: Team, result: TeamFusion) -> dict[str, Any]:
    """A team's joint bound, each agent's share and how it was measured, as strict JSON."""
    values = result.fusion.to_dict()
    agents = [
        {**share, **{key: bound.provenance.get(key) for key in (*_PROVENANCE_KEYS, "warnings")}}
        for share, bound in zip(values["agents"], result.bounds, strict=True)
    ]
    document = {
        "schema": FUSE_SCHEMA,
        "config": team.path,
        "body": team.body,
        "pose": result.fusion.information.pose,
        **{key: values[key] for key in _BOUND_KEYS},
        "agents": agents,
        "versions": result.bounds[0].provenance.get("versions", {}),
    }
    plain: dict[str, Any] = _plain(document)
    return plain


def selection_document(team: Team, result: TeamSelection) -> dict[str, Any]:
    """A team's chosen tiles, their worth, bounds and other budgets, as strict JSON."""
    document = {
        "schema": SELECT_SCHEMA,
        "config": team.path,
        "body": team.body,
        "length_scale": result.agents[0].length_scale,
        **result.selection.to_dict(),
        "agents": [
            {"name": agent.agent, "tiles": agent.tiles, "cost_bytes": agent.cost_bytes}
            for agent in result.agents
        ],
        "curve": [{result.counts: budget, **_worth(other)} for budget, other in result.curve],
        "warnings": result.warnings,
    }
    plain: dict[str, Any] = _plain(document)
    return plain


def _worth(selection: TileSelection) -> dict[str, Any]:
    values = selection.to_dict()
    return {key: values[key] for key in ("value", "value_heldout", "upper_bound", "baselines")}


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else ("inf" if value > 0 else "-inf")
    return str(value) if isinstance(value, Path) else value


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write `document`, which holds no infinity and no NaN (see `bound_document`), as UTF-8 JSON."""
    text = json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    # innermost lists on one line, so that a matrix looks like one; JSON strings hold no raw line breaks
    text = re.sub(r"\[\n\s*([^\[\]{}]*?)\n\s*\]", lambda found: f"[{re.sub(_BREAK, ', ', found[1])}]", text)
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_exr(
    path: Path, pictures: Pictures, attributes: Mapping[str, str | int | float] | None = None
) -> None:
    """Write the image (`R`, `G`, `B`) and the six columns (`dI_drho_x.R` ... `dI_dphi_z.B`) in float32.

    The channel `weakest_share.Y` is each pixel's share of the information about the weakest direction that is
    seen; the header entries `weakest` and `weakest_direction` say which one that is.

    Args:
        path: the file to write.
        pictures: what to write; pixels that were not measured are NaN in every channel.
        attributes: further header entries beside frame, twist order, units, pose and length scale.
    """
    import OpenEXR

    channels = dict(zip("RGB", np.moveaxis(pictures.image, -1, 0), strict=True))
    for axis, name in enumerate(COLUMN_NAMES):
        for channel, plane in zip("RGB", np.moveaxis(pictures.columns[..., axis], -1, 0), strict=True):
            channels[f"{name}.{channel}"] = plane
    header: dict[str, Any] = {}
    if pictures.weakest is not None:
        channels[f"{SHARE_NAME}.Y"] = pictures.weakest_share.astype(np.float32)
        header["weakest"] = pictures.weakest.description
        header["weakest_direction"] = " ".join(f"{v:.9g}" for v in pictures.weakest.direction)
    header |= {
        **(attributes or {}),
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "frame": pictures.frame,
        "twist_order": " ".join(name.removeprefix("dI_d") for name in COLUMN_NAMES),
        "units": "radiance, radiance / scene unit (rho), radiance / rad (phi)",
        "world_from_camera": np.asarray(pictures.pose, np.float64),
        "length_scale": float(pictures.length_scale),
    }
    planes = {name: np.ascontiguousarray(plane) for name, plane in channels.items()}
    with atomic(path) as temporary:
        try:
            OpenEXR.File(header, planes).write(str(temporary))
        except RuntimeError as error:  # how OpenEXR reports a full disk
            raise OutputError(f"cannot write {path}: {error}") from error
