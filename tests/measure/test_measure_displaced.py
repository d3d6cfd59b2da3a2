"""Displaced renders: repetition is found, everything else stays local, and noise in them is not distance."""

from __future__ import annotations

import numpy as np
import pytest
from matrices import misfit
from small_scenes import T, camera, mi, scene, texture, wall

from mitsuba_crb import se3
from mitsuba_crb.errors import NoiseError, OptionError
from mitsuba_crb.measure.displaced import hcr_bound
from mitsuba_crb.measure.measurement import measurement
from mitsuba_crb.measure.pose import pose_bound
from mitsuba_crb.noise import Gaussian, IndependentNoise
from mitsuba_crb.render.pixels import render_pixels
from mitsuba_crb.render.view import open_view

NOISE = Gaussian(0.05)
PERIOD = 2.0
"""Of the wall's paper: 24 scene units with 12 repetitions."""

pytestmark = pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")


def _papered(cells=8, size=(24, 18)):
    """A wall whose texture repeats exactly, seen straight on from three units away."""
    paper = {**texture(cells=cells), "to_uv": T().scale(12)}
    return scene(wall=wall(paper, half=12.0), sensor=camera(*size, target=(0, 0, 3)))


def test_an_exactly_repeating_texture_makes_the_bound_infinite_along_its_period():
    along = [[PERIOD, 0, 0, 0, 0, 0], [0.9 * PERIOD, 0, 0, 0, 0, 0], [0.3, 0.2, 0, 0, 0, 0.1]]
    found = hcr_bound(_papered(), NOISE, displacements=along, spp=16)
    assert found.repeats.tolist() == [True, False, False]
    assert np.isinf(found.position_std).tolist() == [True, False, False]
    assert np.all(np.isfinite(found.rotation_std_deg))
    assert np.all(np.isfinite(found.cramer_rao.position_std))


def test_two_periods_at_once_are_infinite_in_both():
    found = hcr_bound(_papered(), NOISE, displacements=[[PERIOD, -PERIOD, 0, 0, 0, 0]], spp=16)
    assert np.isinf(found.position_std).tolist() == [True, True, False]


def test_the_default_displacements_leave_a_textured_wall_at_its_local_bound():
    options = {"spp": 16, "seed": 3}
    found = hcr_bound(_papered(), NOISE, **options)
    local = pose_bound(_papered(), NOISE, **options)
    assert np.all(found.position_std >= local.position_std)
    assert misfit(found.cramer_rao.covariance, local.covariance) < 1e-9
    assert not found.repeats.any()
    assert len(found.displacements) == 36


def test_distances_are_those_of_noise_free_images_within_their_errors():
    """Against differences of two long renders, and free of the plain estimate's excess (negative control)."""
    xi = np.array([[0.02, 0, 0, 0, 0, 0], [0, 0, 0.1, 0, 0, 0.05]])
    view_scene = scene(wall=wall(texture(cells=64)), sensor=camera(16, 12))
    found = hcr_bound(view_scene, NOISE, displacements=xi, spp=16, seed=1)
    with open_view(view_scene) as view:
        pixels = np.stack(np.meshgrid(np.arange(16), np.arange(12)), axis=-1).reshape(-1, 2)
        poses = [view.pose, *(view.pose @ se3.exp(x) for x in xi)]
        here, *there = (render_pixels(view, pixels, spp=4096, seed=9, pose=pose)[0] for pose in poses)
        rough = [render_pixels(view, pixels, spp=16, seed=9 + i, pose=p)[0] for i, p in enumerate(poses)]
    exact = np.array([np.sum((image - here) ** 2) for image in there]) / NOISE.sigma**2
    error = found.squared_distances_standard_error
    assert np.all(np.abs(found.squared_distances - exact) < 4.0 * error + 0.02 * exact)
    assert np.all(error < 0.2 * exact)
    plain = np.array([np.sum((image - rough[0]) ** 2) for image in rough[1:]]) / NOISE.sigma**2
    assert np.all(plain > exact + 4.0 * error)


def test_a_random_subset_estimates_the_whole_image():
    xi = [[0.05, 0, 0, 0, 0, 0]]
    whole = hcr_bound(_papered(size=(48, 36)), NOISE, displacements=xi, spp=16)
    part = hcr_bound(_papered(size=(48, 36)), NOISE, displacements=xi, spp=16, pixels="random:0.5")
    error = part.squared_distances_standard_error
    assert error > whole.squared_distances_standard_error
    assert abs(part.squared_distances - whole.squared_distances) < 4.0 * error


def test_a_random_subset_proves_no_repetition():
    """One mark in the whole paper breaks it: with all pixels it is seen, and most samples do not hold it."""
    sheet = np.tile(np.random.default_rng(1).uniform(0.2, 0.8, (8, 8, 3)), (1, 12, 1))
    sheet = np.kron(sheet, np.ones((4, 4, 1)))
    sheet[16:18, 200:202] = 0.0
    paper = {"type": "bitmap", "bitmap": mi.Bitmap(sheet.astype(np.float32)), "raw": True}
    paper |= {"to_uv": T().scale([1, 12, 1]), "filter_type": "nearest"}
    marked = mi.load_dict(scene(wall=wall(paper, half=12.0), sensor=camera(24, 18, target=(0, 0, 3))))
    options = {"displacements": [[PERIOD, 0, 0, 0, 0, 0]], "spp": 64, "seed": 8}
    whole = hcr_bound(marked, NOISE, **options)
    part = hcr_bound(marked, NOISE, pixels="random:0.3", **options)
    assert whole.squared_distances > 50.0
    assert part.squared_distances < 1.0
    assert not part.repeats.any()
    assert np.isfinite(part.position_std).all()
    with measurement(marked, pixels="random:0.3", seed=8) as run:
        mask = run.mask
    named = hcr_bound(marked, NOISE, pixels=mask, **options)
    assert named.repeats.all()


@pytest.mark.parametrize(
    ("displacements", "words"),
    [
        ([[0.0] * 6], "not zero"),
        ([[1.0, 2.0]], r"shape \(m, 6\)"),
        ("no", "rows of six"),
        ([], r"shape \(m, 6\)"),
    ],
)
def test_displacements_that_are_none_are_named(displacements, words):
    with pytest.raises(OptionError, match=words):
        hcr_bound(_papered(), NOISE, displacements=displacements, spp=4)


def test_noise_that_is_not_gaussian_is_refused():
    class Other(IndependentNoise):
        description = "other"
        depends_on_mean = False

        def check(self, height, width, channels):
            pass

        def weights(self, pixels, mean):
            return np.ones_like(mean)

        def to_dict(self):
            return {}

    with pytest.raises(NoiseError, match="finite displacements need Gaussian noise"):
        hcr_bound(_papered(), Other(), spp=4)


@pytest.mark.slow
def test_maximum_likelihood_over_renders_mistakes_one_repetition_for_another():
    """Nearly repeating paper, sideways steps only: HCR foresees what the search does, and CRB does not.

    The search covers 9 windows of ±8 local standard deviations, one about each repetition; elsewhere the
    images are hundreds of standard deviations away.
    """
    sheet = np.tile(np.random.default_rng(1).uniform(0.2, 0.8, (8, 8, 3)), (1, 12, 1))
    sheet += 0.002 * np.random.default_rng(2).normal(size=sheet.shape)
    paper = {"type": "bitmap", "bitmap": mi.Bitmap(sheet.astype(np.float32)), "raw": True}
    paper["to_uv"] = T().scale([1, 12, 1])
    papered = scene(wall=wall(paper, half=12.0), sensor=camera(24, 18, target=(0, 0, 3)))
    periods = PERIOD * np.array([k for k in range(-4, 5) if k])
    steps = np.zeros((8, 6))
    steps[:, 0] = periods
    found = hcr_bound(papered, NOISE, displacements=steps, spp=256)
    local = found.cramer_rao.information.matrix[0, 0] ** -0.5
    # One displacement at a time and all else known: no more than the whole set's bound.
    bound = np.max(periods**2 / np.expm1(found.squared_distances))
    assert bound >= 10.0 * local**2
    windows = np.array([*periods, 0.0])[:, None] + local * np.linspace(-8.0, 8.0, 33)
    candidates = windows.ravel()
    with open_view(papered) as view:
        pixels = np.stack(np.meshgrid(np.arange(24), np.arange(18)), axis=-1).reshape(-1, 2)
        images = np.array(
            [
                render_pixels(view, pixels, spp=1024, seed=9, pose=view.pose @ se3.exp([x, 0, 0, 0, 0, 0]))[0]
                for x in candidates
            ]
        ).reshape(len(candidates), -1)
    truth = images[np.argmin(np.abs(candidates))]
    noisy = truth + NOISE.sigma * np.random.default_rng(3).normal(size=(1000, truth.size))
    misfit = np.sum(images**2, axis=1) - 2.0 * noisy @ images.T
    estimates = candidates[np.argmin(misfit, axis=1)]
    assert np.mean(estimates**2) >= 3.0 * local**2
    # Negative control: among the steps about the true place alone, the error is the local bound's.
    near = np.abs(candidates) < 0.5 * PERIOD
    error = np.mean(candidates[near][np.argmin(misfit[:, near], axis=1)] ** 2)
    np.testing.assert_allclose(error, local**2, rtol=0.3)
