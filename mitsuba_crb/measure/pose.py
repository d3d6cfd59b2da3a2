"""From a scene to its Jacobian and to its bound: the two functions that everything else is about."""

from __future__ import annotations

import dataclasses
import time
import warnings
from collections.abc import Sequence
from typing import Any, Unpack

from ..bound.cramer_rao import PoseBound, cramer_rao_bound, joint_bound
from ..errors import BlindSpotWarning, NuisanceError, OptionError, PrecisionWarning, SceneWarning
from ..information.fisher import FisherInformation
from ..information.image_jacobian import ImageJacobian
from ..noise import NoiseModel
from ..render.lending import in_turn
from .adaptive import answer
from .exposure import noise_facts
from .measurement import measurement
from .opening import as_world, wanted
from .options import MeasurementKeywords, MeasurementOptions
from .sensing import COLOUR, DEPTH, OF_DEPTH, RGBD

_NO_ERROR = (
    "rare paths decide on the errors of {}, and few have been met: what is stated is no error, whatever its "
    "size; more paths would tell"
)


@in_turn
def pose_jacobian(
    scene: Any, *, nuisances: Sequence[str] = (), **options: Unpack[MeasurementKeywords]
) -> ImageJacobian:
    """The Jacobian dI/dξ of every selected pixel, in the camera frame.

    Args:
        scene: as for `pose_bound`.
        nuisances: names of further parameters for further columns, see `nuisance`.
        options: see `MeasurementOptions`.

    Returns:
        `ImageJacobian` in the camera frame; translation columns [radiance / scene unit], rotation columns
        [radiance / rad]. Its pilot makes `fisher_information` under any noise that of `pose_bound`; for flow
        it costs up to as much again as the derivatives, which `pose_bound` pays for only where needed.

    Raises:
        MitsubaCRBError: one of its subclasses, in one line, with the cure.

    References:
        Muthukkumar 2025, section 3; design section 4.
    """
    with measurement(scene, nuisances=nuisances, **options) as run:
        without = [nuisance.name for nuisance in run.nuisances if nuisance.lost is not None]
        if without:
            raise NuisanceError(f"{', '.join(without)} have no columns; pose_bound says what they cost")
        run.warn_of_limits()
        return run.jacobian(pilot=True)


@in_turn
def pose_bound(
    scene: Any,
    noise: NoiseModel | None = None,
    *,
    prior: Any = None,
    nuisances: Sequence[str] = (),
    **options: Unpack[MeasurementKeywords],
) -> PoseBound:
    """The Cramér–Rao bound on the camera's pose, tile by tile; correlated noise needs the whole Jacobian.

    Args:
        scene: path of a Mitsuba XML file, of a world's or of a radiance field's, `SceneFile`, dictionary,
            `mi.Scene` or `Field`; the last `mi.Scene` is kept, and traced but once as long as its parameters
            stay.
        noise: noise model of the measured image; None is that of a camera exposed for the scene, Gaussian
            with 0.01 of white, above which it is saturated and tells nothing, see `exposure`.
        prior: information known beforehand, see `cramer_rao_bound`.
        nuisances: names of parameters that are not known either, see `nuisance`. The bound's `joint` can
            undo that, and its `if_known` says what each costs.
        options: see `MeasurementOptions`. Of "rgbd" the noise is the colour's, and the information is the sum
            of colour's and depth's.

    Returns:
        `PoseBound`, matrices in the camera frame; `.provenance` says how it was made.

    Raises:
        NoiseError: the image is black and no noise was given.
        MitsubaCRBError: as `pose_jacobian`.

    Warns:
        SceneWarning: nothing is visible, or something of the scene was left out or replaced.
        NuisanceWarning: the image does not see a nuisance, or too few paths do not resolve it.
        PrecisionWarning: as `joint_bound`; rare bright paths decide, so that the stated errors are none.
    """
    if options.get("measure") == RGBD:
        return _rgbd_bound(scene, noise, prior, nuisances, options)
    start = time.perf_counter()
    caught: list[warnings.WarningMessage] = []
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            with measurement(scene, nuisances=nuisances, **options) as run:
                model, origin = run.noise(noise)
                nothing = run.view.nothing_visible()
                if nothing:
                    warnings.warn(nothing, SceneWarning, stacklevel=2)
                run.warn_of_limits()
                prepared = time.perf_counter()
                found = answer(run, model, prior=prior)
            rendered = time.perf_counter()
            alone = found.joint.marginalize()
            bound = joint_bound(alone, prior=prior)
            rare = found.rare(bound)
            no_error = [_NO_ERROR.format(", ".join(rare))] if rare else []
            for text in no_error:
                warnings.warn(text, PrecisionWarning, stacklevel=2)
    finally:
        for warning in caught:
            warnings.warn(warning.message, warning.category, stacklevel=3)
    provenance = {
        **found.run.provenance(),
        **found.provenance,
        "noise": noise_facts(model, origin, found.run.view.measured, found.run.saturation),
        "noise_inflation": alone.information.noise_inflation,
        "finite_differences": found.run.differences.to_dict(alone),
        "warnings": list(dict.fromkeys(str(warning.message) for warning in caught)),
        "no_error": no_error,
        "no_bound": list(
            dict.fromkeys(str(w.message) for w in caught if issubclass(w.category, BlindSpotWarning))
        ),
        "seconds": {
            "prepare": prepared - start,
            "render": rendered - prepared,
            "total": time.perf_counter() - start,
        },
    }
    return dataclasses.replace(bound, provenance=provenance)


def _rgbd_bound(
    scene: Any, noise: NoiseModel | None, prior: Any, nuisances: Sequence[str], options: MeasurementKeywords
) -> PoseBound:
    """Of colour and depth with independent noise, seen from one pose; arguments as of `pose_bound`.

    Depth comes first, for it is nearly free: paths of colour go where they still tell something beside it.
    """
    given = MeasurementOptions(**options)
    if nuisances:
        raise OptionError(
            "what colour and depth have in common of a nuisance is not known: leave out --marginalize "
            "(nuisances=), or give --measure colour or depth"
        )
    start = time.perf_counter()
    loaded, label = as_world(scene, wanted(given))
    of_colour: tuple[str, ...] = ("channels", "exposure", "clip", "on_tile")
    alone: Any = {name: value for name, value in options.items() if name not in of_colour}
    depth = pose_bound(loaded, **{**alone, "measure": DEPTH})
    alone = {name: value for name, value in options.items() if name not in OF_DEPTH}
    known = _image_alone(depth)
    before = known if prior is None else cramer_rao_bound(known, prior=prior).information
    colour = pose_bound(loaded, noise, prior=before, **{**alone, "measure": COLOUR})
    both = cramer_rao_bound(known + _image_alone(colour), prior=prior)
    facts, others = colour.provenance, depth.provenance
    lists = ("warnings", "no_error", "no_bound")
    told = {name: list(dict.fromkeys([*facts[name], *others[name]])) for name in lists}
    provenance = {
        **facts,
        **told,
        "scene": label,
        "measures": {"what": RGBD, "colour": facts["measures"], "depth": others["measures"]},
        "depth": {name: others.get(name) for name in ("noise", "spp", "sampling", "finite_differences")},
        "noise_inflation": both.information.noise_inflation,
        "seconds": {
            "depth": others["seconds"]["total"],
            "colour": facts["seconds"]["total"],
            "total": time.perf_counter() - start,
        },
    }
    return dataclasses.replace(both, provenance=provenance)


def _image_alone(bound: PoseBound) -> FisherInformation:
    """The information of the image, without the prior."""
    assert bound.joint is not None
    return bound.joint.information
