"""The measurement: each pixel's filter integral, without bias, repeatable, whatever else is rendered."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from small_scenes import camera, scene, textured_wall

from mitsuba_crb.information.blocks import BLOCK
from mitsuba_crb.render.film import OffsetTable
from mitsuba_crb.render.pixels import render_pixels
from mitsuba_crb.render.random import EVEN, EvenNumbers, seeding
from mitsuba_crb.render.rays import Lanes, first_hits
from mitsuba_crb.render.sobol import sobol_point
from mitsuba_crb.render.view import View, open_view

FILTERS = ("gaussian", "box", "tent", "mitchell", "catmullrom", "lanczos")


def _grid(view: View) -> Any:
    width, height = view.size
    return np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2)


def _with_filter(name: str) -> dict[str, Any]:
    sensor = camera(16, 12, target=(0, 0, 1))
    sensor["film"] |= {"rfilter": {"type": name}}
    return textured_wall(sensor=sensor)


@pytest.mark.parametrize("name", FILTERS)
def test_offsets_integrate_the_filter(name: str) -> None:
    """∫h = 1, ∫h x = 0, ∫h x² and ∫h cos(3x) by quadrature, at 4 standard errors of 2^18 samples."""
    with open_view(_with_filter(name)) as view:
        pixel_filter = view.pixel_filter
        rng = mi.PCG32(1 << 18)
        offset, weight = pixel_filter.sample(mi.Point2f(rng.next_float32(), rng.next_float32()))
        w, x, y = (np.array(value, dtype=np.float64) for value in (weight, offset.x, offset.y))
        t = np.linspace(-pixel_filter.radius, pixel_filter.radius, 20001)[1:-1]
        h = np.array(pixel_filter.eval(mi.Float(t)), dtype=np.float64)
    for f in (np.ones_like, lambda v: v, np.square, lambda v: np.cos(3 * v)):
        expected = np.sum(h * f(t)) * (t[1] - t[0])
        for samples in (w * f(x), w * f(y)):
            error = max(samples.std() / np.sqrt(samples.size), 1e-7)
            assert abs(samples.mean() - expected) < 4 * error + 2e-4
    assert np.abs(x).max() <= pixel_filter.radius
    if name in ("mitchell", "catmullrom", "lanczos"):
        assert w.min() < 0


@pytest.mark.parametrize(
    "rfilter",
    [
        {"type": "gaussian"},
        {"type": "gaussian", "stddev": 0.4},
        {"type": "tent", "radius": 0.75},
        {"type": "box"},
        {"type": "lanczos", "lobes": 2},
    ],
)
def test_interpolation_is_the_filter_inside_and_zero_outside(rfilter: dict[str, Any]) -> None:
    """Also in the footprint of contours' samples, which ends at a whole pixel; ∫h = 1."""
    sensor = camera(16, 12)
    sensor["film"] |= {"rfilter": rfilter}
    with open_view(scene(sensor=sensor)) as view:
        pixel_filter = view.pixel_filter
        x = np.linspace(-1.0, 1.0, 20002) * (np.ceil(2.0 * pixel_filter.radius) + 1.0)
        inside = np.abs(x) < pixel_filter.radius
        expected = np.where(inside, np.array(pixel_filter.eval(mi.Float(x)), dtype=np.float64), 0.0)
    h = pixel_filter.interpolate(x)
    border = np.abs(np.abs(x) - pixel_filter.radius) < 2.0 * pixel_filter.radius / len(pixel_filter.values)
    assert h[~border] == pytest.approx(expected[~border], abs=3e-5)
    assert np.all(h[np.abs(x) > pixel_filter.radius] == 0.0)
    assert h.sum() * (x[1] - x[0]) == pytest.approx(1.0, abs=1e-3)


def test_an_offset_table_has_the_density_that_it_reports() -> None:
    grid = np.linspace(-2.0, 2.0, 4001)
    table = OffsetTable.of(np.exp(-(grid**2)), 2.0, count=64)
    x, density = table.sample(mi.Float((np.arange(100000) + 0.5) / 100000))
    counts, edges = np.histogram(np.array(x), bins=np.linspace(-2, 2, 41), density=True)
    reported = np.interp(0.5 * (edges[1:] + edges[:-1]), np.array(x), np.array(density))
    assert counts == pytest.approx(reported, abs=0.03)


@pytest.mark.parametrize("name", ["gaussian", "box", "tent"])
def test_pixels_agree_with_mitsuba_where_its_film_does_not_cut_the_filter(name: str) -> None:
    """Two renderers, one image: within 4 standard errors of the mean difference over interior pixels."""
    with open_view(_with_filter(name)) as view:
        ours = render_pixels(view, _grid(view), spp=256, seed=2)[0].reshape(12, 16, 3)[3:-3, 3:-3]
        theirs = [np.array(mi.render(view.scene, spp=256, seed=k))[3:-3, 3:-3] for k in (0, 1)]
    noise = np.abs(theirs[0] - theirs[1]).mean()
    # The view stands at the origin of its own frame here, as the scene's own camera does.
    assert np.abs(ours - theirs[0]).mean() < 1.5 * noise
    assert abs((ours - theirs[0]).mean()) < 4 * noise / np.sqrt(ours[..., 0].size)  # channels share paths


def test_a_pixels_random_numbers_are_its_own() -> None:
    """Subsets, order and neighbours change no bit; seeds, batches and purposes change all."""
    with open_view(textured_wall()) as view:
        grid = _grid(view)
        whole = render_pixels(view, grid, spp=4, seed=3, batches=2)
        chosen = np.random.default_rng(0).permutation(len(grid))[:100]
        part = render_pixels(view, grid[chosen], spp=4, seed=3, batches=2)
        other_seed = render_pixels(view, grid, spp=4, seed=4, batches=2)
        other_purpose = render_pixels(view, grid, spp=4, seed=3, batches=2, purpose=1)
    assert np.array_equal(whole[:, chosen], part)
    for other in (other_seed, other_purpose, whole[::-1]):
        assert np.mean(whole == other) < 0.01


def test_streams_of_pixels_batches_and_seeds_are_uncorrelated() -> None:
    """Correlations of 4096 first numbers stay within 4.5 standard errors of zero."""
    from mitsuba_crb.render.random import lane_sampler

    pixel = dr.arange(mi.UInt32, 4096)
    draws = [
        np.array(lane_sampler(pixel, dr.full(mi.UInt32, batch, 4096), seeding(seed, purpose)).next_1d())
        for batch in (0, 1)
        for seed in (0, 1, 1 << 40)
        for purpose in (0, 1)
    ]
    matrix = np.corrcoef(np.stack([*draws, np.roll(draws[0], 1)]))
    assert np.abs(matrix - np.eye(len(matrix))).max() < 4.5 / np.sqrt(4096)
    assert np.mean(draws) == pytest.approx(0.5, abs=0.01)


def test_depth_is_along_the_optical_axis() -> None:
    sensor = camera(9, 7, target=(0, 0, 1))
    with open_view(textured_wall(sensor=sensor)) as view:
        _, depth = first_hits(view, _grid(view))
    assert depth == pytest.approx(3.0, rel=1e-5)
    with open_view(scene(sensor=sensor)) as view:
        _, depth = first_hits(view, _grid(view))
    assert np.all(np.isinf(depth))


def test_the_pixels_of_a_block_share_out_random_numbers_evenly() -> None:
    """Orders are permutations that keep neighbours together; a block's uniform numbers are even."""
    batches, count = 16, BLOCK * BLOCK
    with open_view(textured_wall(sensor=camera(4 * BLOCK, 4 * BLOCK))) as view:
        even = EvenNumbers.of(Lanes.of(view, _grid(view), batches), seeding(5, EVEN), (4, 4))
        x, *_ = np.array(sobol_point(even.rank, even.seeds[1]), dtype=np.float64)
    by_block = (batches, 4, BLOCK, 4, BLOCK)
    ranks, x = (
        np.array(value).reshape(by_block).transpose(1, 3, 0, 2, 4).reshape(-1, count)
        for value in (even.rank, x)
    )
    assert np.array_equal(np.sort(ranks, axis=1), np.tile(np.arange(count), (len(ranks), 1)))
    quads = ranks.reshape(-1, BLOCK // 2, 2, BLOCK // 2, 2) // 4
    assert np.array_equal(quads, np.broadcast_to(quads[:, :, :1, :, :1], quads.shape))
    assert np.all(np.abs(x.mean(axis=0) - 0.5) < 5.0 * np.sqrt(1.0 / 12.0 / len(x)))
    independent = (1.0 / 5.0 - 1.0 / 9.0) / count
    assert (x**2).mean(axis=1).var() < 0.2 * independent
    alone = np.random.default_rng(0).permuted(x, axis=0)  # the same numbers, no longer shared out
    assert (alone**2).mean(axis=1).var() > 0.5 * independent
