"""Not knowing a map's colours or opacities costs a pose what `map_cost` says, and never pays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_splats import write_splats

from mitsuba_crb import pose_bound, pose_jacobian
from mitsuba_crb.camera import Camera
from mitsuba_crb.errors import NuisanceError
from mitsuba_crb.noise import Gaussian
from mitsuba_crb.radiance.beside import beside
from mitsuba_crb.radiance.files import as_field
from mitsuba_crb.radiance.map_nuisance import UNKNOWNS, map_cost, map_information

NOISE = Gaussian(0.02)


@pytest.mark.parametrize("name", UNKNOWNS)
def test_a_bound_loses_what_the_map_costs(tmp_path: Path, name: str) -> None:
    file = write_splats(tmp_path)
    field, found = as_field(file), beside(file)
    assert field is not None
    assert found is not None
    bound = pose_bound(file, NOISE, nuisances=[name])
    first = found.viewpoints[0]
    width, height = first.intrinsics.size
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2)
    known = sum(
        map_information(field, Camera.of(v.intrinsics), v.pose, pixels, 0.02**-2, unknowns=name)
        for v in found.viewpoints
    )
    camera = Camera.of(first.intrinsics)
    cost = map_cost(field, camera, first.pose, pixels, 0.02**-2, unknowns=name, prior=known)
    scale = np.sqrt(np.diagonal(cost.known))
    expected = cost.information / np.outer(scale, scale)
    np.testing.assert_allclose(bound.information.matrix / np.outer(scale, scale), expected, atol=1e-5)
    ratio = bound.rotation_std_deg / bound.if_known[name].rotation_std_deg
    assert (ratio > 1.0).all()
    alone = pose_bound(file, NOISE)
    np.testing.assert_allclose(bound.if_known[name].rotation_std_deg, alone.rotation_std_deg)


def test_what_is_not_known_is_refused_by_name(tmp_path: Path) -> None:
    file = write_splats(tmp_path)
    with pytest.raises(NuisanceError, match="colours have in common with other nuisances"):
        pose_bound(file, NOISE, nuisances=["colours", "gain"])
    with pytest.raises(NuisanceError, match="random subset"):
        pose_bound(file, NOISE, nuisances=["colours"], pixels="random:0.5")
    with pytest.raises(NuisanceError, match="independent between pixels"):
        pose_bound(file, NOISE, nuisances=["opacities"], channels="luminance")
    with pytest.raises(NuisanceError, match="no columns"):
        pose_jacobian(file, nuisances=["opacities"])
