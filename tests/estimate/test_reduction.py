"""Reduced images: what smaller films measure, of the pixels that there are, with the noise of their means."""

from __future__ import annotations

import numpy as np
from small_scenes import camera, scene, texture, wall

from mitsuba_crb.estimate.reduction import pyramid, reduced, reduced_variance
from mitsuba_crb.noise import Gaussian, PerPixel
from mitsuba_crb.render.pixels import render_pixels
from mitsuba_crb.render.view import open_view


def test_a_reduced_image_is_what_a_smaller_film_measures() -> None:
    large, small = (
        scene(wall=wall(texture(cells=64))),
        scene(wall=wall(texture(cells=64)), sensor=camera(16, 12)),
    )
    images = []
    for which in (large, small):
        with open_view(which) as view:
            width, height = view.size
            pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2)
            images.append(render_pixels(view, pixels, spp=512, seed=1).reshape(height, width, 3))
    inner = np.s_[1:-1, 1:-1]  # the small film's filter reaches beyond the large film's border
    reduction = reduced(images[0], 2)[inner] - images[1][inner]
    subsampling = images[0][::2, ::2][inner] - images[1][inner]
    assert np.std(reduction) < 0.3 * np.std(subsampling)


def test_a_reduced_images_noise_is_that_of_its_means() -> None:
    """Against 4000 images of noise: each variance within six of its errors, and far below a pixel's."""
    rng = np.random.default_rng(0)
    variance = rng.uniform(0.5, 2.0, (12, 17, 1))
    variance[3:6, 4:9] = np.inf
    images = np.where(np.isinf(variance), np.nan, np.sqrt(variance) * rng.standard_normal((12, 17, 4000)))
    for factor in (2, 4):
        predicted = reduced_variance(variance, factor)[..., 0]
        seen = np.isfinite(predicted)
        assert np.array_equal(seen, np.isfinite(reduced(images, factor)[..., 0]))
        found = reduced(images, factor)[seen].var(axis=1)
        np.testing.assert_allclose(found, predicted[seen], rtol=6.0 * np.sqrt(2.0 / 4000))
        assert np.all(predicted[seen] < 1.0)
        assert predicted[seen].min() > 0.5 / (4.0 * np.pi * 0.25 * factor**2)


def test_scattered_pixels_make_a_reduced_image_without_the_others() -> None:
    """A slope is found again in means of 30 % of its pixels; where there are none, there is nothing."""
    image = np.tile(np.linspace(0.0, 1.0, 64)[:, None], (48, 1, 3))
    image[np.random.default_rng(1).random((48, 64)) > 0.3] = np.nan
    image[:, 48:] = np.nan
    small = reduced(image, 4)
    assert np.isnan(small[:, 13:]).all()
    left = small[:, :11]
    assert np.isfinite(left).mean() > 0.6
    slope = np.broadcast_to(np.linspace(0.0, 1.0, 64)[2::4][:11, None] - 0.5 / 63.0, left.shape)
    assert np.nanstd(left - slope) < 0.02


def test_noise_of_any_size_stays_and_too_small_images_are_left_out() -> None:
    image = np.ones((24, 32, 3))
    assert [small.shape for small, noise in pyramid(image, Gaussian(0.1), 3)] == [(12, 16, 3)]
    ((_, noise),) = pyramid(image, Gaussian(0.1), 1)
    assert noise == Gaussian(0.1)
    ((_, noise),) = pyramid(image, PerPixel(np.ones((24, 32))), 1)
    assert isinstance(noise, PerPixel)
    assert noise.variance.shape == (12, 16, 3)
