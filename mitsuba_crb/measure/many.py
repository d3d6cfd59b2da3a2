"""What bounds at many poses have in common: the world, loaded once; noise, prior and options; the exposure.

Each bound is that of `pose_bound` at its pose, with the same random numbers, bit for bit: it depends neither
on the other poses nor on their order. The one thing that they share is the default camera's exposure, from
their pooled pixels (design section 11).
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..bound.cramer_rao import PoseBound, cramer_rao_bound
from ..errors import NoiseError, SaturatedError, SceneWarning
from ..files import jsonable
from ..information.significance import no_information
from ..noise import NoiseModel
from ..render.fingerprint import mask_fingerprint
from .exposure import exposed, start_metering
from .measurable import method_of
from .nuisances import name_parameters
from .opening import as_world, fingerprint, kind_of, wanted
from .options import MeasurementKeywords, MeasurementOptions
from .pose import pose_bound
from .sensing import DEPTH
from .stations import Station, named, open_stations
from .versions import versions

_POOLED = 1 << 14
"""Pixels that the exposure is taken from, at least."""
_COARSEST = 16
_BLACK = 1.0
"""White of a camera that sees nothing anywhere: its information is zero whatever that is."""
_LONGEST = 200
"""Letters of a setting that is told as it is; of a longer one its fingerprint."""
_INDIFFERENT = ("pose", "tile", "on_tile", "on_progress", "on_round")
"""Options that no bound depends on."""


@dataclasses.dataclass(frozen=True, eq=False)
class Shared:
    """What the bounds of all poses are measured with."""

    scene: Any
    noise: NoiseModel | None
    prior: Any
    nuisances: Sequence[str]
    options: MeasurementKeywords

    def bound(self, station: Station) -> PoseBound:
        """At one pose.

        Raises:
            KeyboardInterrupt: also where `pose_bound` would have answered with what it had.
        """
        options: MeasurementKeywords = station.options(self.options)
        with warnings.catch_warnings():  # they stand in the provenance
            warnings.simplefilter("ignore")
            with named(station):
                try:
                    found = self._measured(options)
                except SaturatedError as error:
                    found = self._nothing(station, error)
                except NoiseError:
                    if self.noise is not None or options.get("exposure") != "auto":
                        raise
                    found = self._measured({**options, "exposure": _BLACK})  # black, and set by itself
        if found.provenance.get("sampling", {}).get("interrupted"):
            raise KeyboardInterrupt
        return found

    def _nothing(self, station: Station, error: SaturatedError) -> PoseBound:
        """Of a view that is saturated everywhere, such as one into a lamp."""
        blank = cramer_rao_bound(no_information(variable="camera", pose=station.pose), prior=self.prior)
        return dataclasses.replace(blank, provenance={**blank.provenance, "warnings": [str(error)]})

    def _measured(self, options: MeasurementKeywords) -> PoseBound:
        return pose_bound(self.scene, self.noise, prior=self.prior, nuisances=self.nuisances, **options)


def load_shared(
    scene: Any, nuisances: Sequence[str], stations: Sequence[Station], options: MeasurementKeywords
) -> tuple[Any, str]:
    """The world of all poses, and what to call it."""
    first = MeasurementOptions(**stations[0].options(options))
    asked = dataclasses.replace(wanted(first), apart=name_parameters(nuisances))
    return as_world(scene, asked)


def with_white(options: MeasurementKeywords, white: float | None) -> MeasurementKeywords:
    """The options with the exposure of `common_white`."""
    return options if white is None else {**options, "exposure": white}


def common_white(
    loaded: Any, stations: Sequence[Station], noise: NoiseModel | None, options: MeasurementKeywords
) -> float | None:
    """That of the default camera, from all poses' pixels if they do not say; None if it is not asked for.

    The more poses, the fewer pixels of each.
    """
    if noise is not None or options.get("exposure") is not None or options.get("measure") == DEPTH:
        return None
    white = kind_of(loaded).white
    if white is not None:
        return white
    side = max(_COARSEST, math.ceil(math.sqrt(_POOLED / len(stations))))
    seed = MeasurementOptions(**options).seed
    with open_stations(loaded, stations, options) as opened:
        views = list(opened)
        parts = [start_metering(view, seed, side)().reshape(2, -1) for view in views]
        # In an order that is not that of the poses, for sums of floats depend on it.
        found = exposed(*np.concatenate(sorted(parts, key=lambda part: part.tobytes()), axis=1))
        if found is None:
            why = views[0].nothing_visible(black=True)
            warnings.warn(f"every image is black; of the first, {why}", SceneWarning, stacklevel=3)
    return _BLACK if found is None else found.white


def shared_settings(
    loaded: Any,
    label: str,
    source: Any,
    defines: Mapping[str, str] | None,
    options: MeasurementKeywords,
    noise: NoiseModel | None,
    prior: Any,
    nuisances: Sequence[str],
) -> dict[str, Any]:
    """What the bounds depend on beside poses, cameras and the exposure, JSON-able.

    Args:
        loaded, label: from `load_shared`.
        source: what it was loaded from, a path or an object.
        defines: the scene file's `<default>`s.
        options, noise, prior, nuisances: of every measurement.
    """
    kind = kind_of(loaded)
    return {
        "scene": label,
        "scene_contents": fingerprint(loaded, source, defines),
        "defines": dict(defines or {}),
        **_options_said(options),
        "method": method_of(kind.methods, options.get("method")).name,
        **({"deterministic": True} if kind.deterministic else {}),
        "noise": said(noise),
        "prior": said(prior),
        "nuisances": list(nuisances),
        "versions": versions(),
    }


def _options_said(options: MeasurementKeywords) -> dict[str, Any]:
    """The options that rows depend on, with their defaults, JSON-able."""
    given = MeasurementOptions(**options)
    names = [field.name for field in dataclasses.fields(given) if field.name not in _INDIFFERENT]
    return {name: said(getattr(given, name)) for name in names}


def said(value: Any) -> Any:
    """A setting as JSON can hold it; of what is long, and of files, a fingerprint."""
    if isinstance(value, np.ndarray):
        return mask_fingerprint(value)
    if isinstance(value, str | Path) and os.path.isfile(value):
        return {"file": str(value), "contents": hashlib.sha256(Path(value).read_bytes()).hexdigest()[:16]}
    try:
        plain = jsonable(value.to_dict() if hasattr(value, "to_dict") else value)
        text = json.dumps(plain)
    except (TypeError, ValueError):
        plain = text = str(value)
    if len(text) <= _LONGEST:
        return plain
    kind = {"model": plain["model"]} if isinstance(plain, dict) and "model" in plain else {}
    return {**kind, "contents": hashlib.sha256(text.encode()).hexdigest()[:16]}
