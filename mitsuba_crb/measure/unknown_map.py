"""A map of splats that is not known exactly, as a nuisance: all colours, or all opacities.

What is known of them beforehand is what the photographs told that the map was trained on: FisherRF's
diagonal, summed over the cameras that it comes with, each as precise as this view's pixels are on average.
See `radiance.map_nuisance`. Reference: Jiang, Lei and Daniilidis 2024, FisherRF.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..camera import Camera
from ..errors import NuisanceError
from ..information import subset
from ..information.joint import JointInformation
from ..noise import CoupledNoise, Luminance, NoiseModel
from ..radiance.field import Field, Floats, Pixels, Viewpoint
from ..radiance.gaussians import Gaussians
from ..radiance.map_nuisance import map_cost, map_information
from .nuisances import Nuisance

if TYPE_CHECKING:
    from .measurement import Measurement

_WIDEST, _MOST = 256, 50
"""Pixels across of a photograph, and photographs, that stand for all."""
_ERROR = 1e-4
"""Of an entry of what is lost: the kernel beside its twin, which the tests hold."""


def map_nuisance(
    field: Field, name: str, camera: Camera, pose: Floats, viewpoints: Sequence[Viewpoint]
) -> Nuisance:
    """All colours or opacities of a map.

    Args:
        field: the map.
        name: one of `map_nuisance.UNKNOWNS`.
        camera: intrinsics of the view whose pose is asked for.
        pose: (4, 4) that pose.
        viewpoints: cameras of the photographs that the map was trained on.

    Raises:
        NuisanceError: the field is none of splats.
    """
    if not isinstance(field, Gaussians):
        raise NuisanceError(f"{name} are of splats, which {field.label} has none of")

    def lost(pixels: Pixels, weights: Floats) -> Floats:
        known = _known(field, name, viewpoints, float(weights.mean()))
        return map_cost(field, camera, pose, pixels, weights, unknowns=name, prior=known).lost

    return Nuisance(name, f"exact; known from {len(viewpoints)} cameras", 0, lost=lost)


def with_unknown_map(joint: JointInformation, run: Measurement, noise: NoiseModel) -> JointInformation:
    """A joint information with the nuisances of its measurement that have no columns.

    Raises:
        NuisanceError: the noise or the pixels are such that what is lost is not known.
    """
    for nuisance in run.nuisances:
        if nuisance.lost is None:
            continue
        if len(run.nuisances) > 1:
            raise NuisanceError(
                f"what {nuisance.name} have in common with other nuisances is not known: give them alone"
            )
        if isinstance(noise, CoupledNoise | Luminance):
            raise NuisanceError(
                f"{nuisance.name} need noise that is independent between pixels and colour channels"
            )
        if run.selection.kind == "random":
            raise NuisanceError(
                f"a random subset of pixels does not tell what {nuisance.name} cost: leave out --pixels "
                "(pixels=)"
            )
        pixels = subset.selected(run.mask)
        expected = run.render(pixels, 0).mean(axis=0)
        lost = nuisance.lost(pixels, noise.weights(pixels, expected))
        joint = joint.without(nuisance.name, lost, _ERROR)
    return joint


def _known(field: Gaussians, name: str, viewpoints: Sequence[Viewpoint], weight: float) -> Floats:
    """The precision of each unknown: of some of the photographs, in fewer pixels, for all."""
    chosen = viewpoints[:: -(-len(viewpoints) // _MOST)]
    total: Floats = np.zeros(1)
    for viewpoint in chosen:
        intrinsics = viewpoint.intrinsics
        width, height = intrinsics.size
        if width > _WIDEST:
            intrinsics = intrinsics.scaled((_WIDEST, max(1, round(height * _WIDEST / width))))
        many = width * height / np.prod(intrinsics.size)
        pixels = subset.selected(np.ones(intrinsics.size[::-1], dtype=bool))
        camera = Camera.of(intrinsics)
        total = total + map_information(field, camera, viewpoint.pose, pixels, weight * many, unknowns=name)
    return total * (len(viewpoints) / len(chosen))
