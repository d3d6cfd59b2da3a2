"""Closure: flow says by itself where its geometry is wrong, and leaves those blocks to finite differences."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from matrices import misfit
from small_scenes import T, camera, scene, wall

from mitsuba_crb import pose_bound, pose_jacobian
from mitsuba_crb.information.accumulate import InformationAccumulator, Sums
from mitsuba_crb.information.joint import joint_information
from mitsuba_crb.jacobian import closure, flow
from mitsuba_crb.jacobian.closure import FilmBlocks, _square, apart, breaches, matters, suspects, together
from mitsuba_crb.jacobian.finite_difference import BIAS, edge_bias, edge_misfit, order_of, step_for
from mitsuba_crb.jacobian.silhouettes import Contours
from mitsuba_crb.noise import CoupledNoise, Gaussian, LowRankPlusDiagonal, Stationary
from mitsuba_crb.render.film import PixelFilter
from mitsuba_crb.se3 import Array

pytestmark = pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")

RNG = np.random.default_rng(0)
GRID = np.stack(np.meshgrid(np.arange(16), np.arange(8)), axis=-1).reshape(-1, 2)
BLOCKS = FilmBlocks.of(GRID)


# The statistic


@pytest.mark.slow
@pytest.mark.parametrize("batches", [4, 5, 16])
def test_u_is_without_bias_and_its_error_is_right_where_pixels_share_noise(batches: int) -> None:
    """2,000 trials of noise that all pixels of a block have in common, and of a breach of 1 in one block."""
    squares, traces = [], []
    for _ in range(2000):
        residual = np.ones((3, batches, 128)) * RNG.normal(size=(3, batches, 1))
        residual[..., BLOCKS.home == 1] += 1.0
        squares.append(_square(residual, BLOCKS))
        traces.append(together(residual, BLOCKS))
    mean, spread = np.mean(squares, axis=0), np.std(squares, axis=0)
    assert np.all(np.abs(mean - [0.0, 192.0]) < 4.0 * spread / np.sqrt(2000))
    error = np.sqrt(2.0 / (batches * (batches - 1)) * np.mean(traces, axis=0))
    assert error[0] == pytest.approx(spread[0], rel=0.2)
    # The control: pixels' errors are not independent here.
    assert np.mean(apart(residual, BLOCKS)) < 0.1 * np.mean(traces)


def test_the_trace_of_the_squared_covariance_is_the_mean_over_disjoint_pairs() -> None:
    """Which is free of the mean: ((R_k − R_l)·(R_m − R_n))² / 4 has the expectation tr(Σ²)."""
    one = FilmBlocks.of(np.array([[0, 0]]))
    R = RNG.normal(size=(6, 3)) + 5.0
    products = [
        ((R[k] - R[j]) @ (R[m] - R[n])) ** 2 / 4.0
        for (k, j), (m, n) in combinations(combinations(range(6), 2), 2)
        if len({k, j, m, n}) == 4
    ]
    assert together(R.T[..., None], one)[0] == pytest.approx(np.mean(products))
    assert apart(R.T[..., None], one)[0] == pytest.approx(np.sum(np.cov(R.T) ** 2))


def test_blocks_are_those_of_the_film_in_order() -> None:
    pixels = np.array([[17, 30], [16, 24], [3, 24], [8, 100]])
    blocks = FilmBlocks.of(pixels)
    assert [(number >> 32, number & 0xFFFFFFFF) for number in blocks.number] == [(3, 0), (3, 2), (12, 1)]
    assert list(blocks.home) == [1, 1, 0, 2]
    part = blocks.part(np.array([0, 1, 3]))
    assert list(part.home) == [0, 0, 1]
    assert list(part.number) == [blocks.number[1], blocks.number[2]]


def test_noise_raises_few_suspects_and_no_blame() -> None:
    pixels = np.stack(np.meshgrid(np.arange(256), np.arange(256)), axis=-1).reshape(-1, 2)
    blocks = FilmBlocks.of(pixels)
    few, many = (RNG.normal(size=(3, k, len(pixels))) for k in (4, 16))
    image = RNG.random((len(pixels), 3))
    columns = RNG.normal(size=(4, len(pixels), 3, 3))
    assert suspects(few, columns, image, blocks).mean() < 0.01
    assert breaches(many, blocks).mean() < 0.002
    # The control: half a standard deviation of one batch, in one block.
    many[..., blocks.home == 7] += 0.5
    assert breaches(many, blocks)[7]


@pytest.mark.slow
def test_few_samples_that_make_all_pixels_errors_raise_no_blame() -> None:
    # A wave of one random phase over a block's rows, as evenly spaced samples of one edge make: two degrees
    # of freedom, and bounded.
    blocks = FilmBlocks.of(np.stack(np.meshgrid(np.arange(256), np.arange(256)), axis=-1).reshape(-1, 2))
    phase = RNG.random((closure.BATCHES, len(blocks.number)))[:, blocks.home]
    wave = np.sin(2.0 * np.pi * (phase + np.arange(len(blocks.home)) // 256 / 4.0))
    residual = np.stack([wave, 0.0 * wave, 0.5 * wave])
    # The control: standard errors of U alone blame some.
    assert closure._exceeds(residual, blocks, closure.LIMIT).mean() > 0.005
    assert not breaches(residual, blocks).any()
    residual[:, :, blocks.home == 7] += 1.0
    assert breaches(residual, blocks)[7]


def test_what_is_measured_again_must_still_matter() -> None:
    residual = RNG.normal(size=(3, 32, 128)) + 10.0
    columns, image = np.ones((4, 128, 3, 3)), RNG.random((128, 1)) * np.ones(3)
    found = breaches(residual, BLOCKS)
    assert found.all()
    assert matters(residual, columns, image, BLOCKS, found).all()
    assert not matters(residual, 1e4 * columns, image, BLOCKS, found).any()


def test_a_breach_that_no_contrast_shows_is_no_suspect() -> None:
    residual = RNG.normal(size=(3, 4, 128)) + 10.0
    columns = np.ones((4, 128, 3, 3))
    image = RNG.random((128, 1)) * np.ones(3)
    assert suspects(residual, columns, image, BLOCKS).all()
    assert not suspects(residual, columns, np.full((128, 3), 0.7), BLOCKS).any()
    assert not suspects(residual, 1e4 * columns, image, BLOCKS).any()


# What it leads to

SQUARE = {
    "type": "rectangle",
    "to_world": T().translate([0.1, 0.05, 2.0]).rotate([0, 1, 0], 180).scale(0.3),
    "bsdf": {"type": "diffuse", "reflectance": 0.0},
}


def information(which: dict[str, Any], spp: int = 256, **options: Any) -> Any:
    return pose_bound(which, Gaussian(0.05), spp=spp, **options)


def agree(a: Any, b: Any, tolerance: float = 0.03) -> bool:
    """Whether two informations' diagonals agree within 4 errors, or 3 %."""
    one, other = np.diag(a.matrix), np.diag(b.matrix)
    error = np.hypot(np.diag(a.standard_error), np.diag(b.standard_error))
    return bool(np.all(np.abs(one - other) <= np.maximum(tolerance * np.abs(other), 4.0 * error)))


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.0, 2.0])
def test_contours_that_count_wrongly_are_found_and_mended(
    factor: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    which = scene(wall=wall(), square=SQUARE)
    right = information(which)
    assert not right.provenance["finite_differences"]["blocks"]
    jump = Contours.jump
    monkeypatch.setattr(Contours, "jump", lambda *args: factor * jump(*args))
    mended = information(which)
    found = mended.provenance["finite_differences"]
    assert set(found["blocks"]) == {"stacked edges"}
    assert found["share"] > 0.3
    assert agree(mended.information, right.information)
    monkeypatch.setattr(flow, "suspects", lambda *args: np.zeros(len(args[-1].number), dtype=bool))
    assert not agree(information(which).information, right.information)


def test_an_instance_has_the_information_of_its_mesh() -> None:
    mesh = information(scene(wall=wall(), square=SQUARE))
    group = {"type": "shapegroup", "square": SQUARE | {"to_world": T()}}
    placed = {"type": "instance", "group": {"type": "ref", "id": "group"}, "to_world": SQUARE["to_world"]}
    instance = information(scene(wall=wall(), group=group, placed=placed))
    assert agree(instance.information, mesh.information)
    assert set(instance.provenance["finite_differences"]["blocks"]) <= {"instances"}


def clipped_floor(plane: str) -> dict[str, Any]:
    sensor = {
        "type": "perspective",
        "fov": 60.0,
        f"{plane}_clip": 4.0,
        "film": {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}},
    }
    floor = {
        "type": "rectangle",
        "to_world": T().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(400.0),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 0.5}},
    }
    return {"type": "scene", "sensor": sensor, "floor": floor}


@pytest.mark.slow
@pytest.mark.parametrize("plane", ["far", "near"])
def test_a_clip_plane_moves_with_the_camera(plane: str) -> None:
    """A bright floor that ends at the plane: its edge tells height and pitch as one number, and roll.

    The edge is the film line y/z = −1/4, whose motion is −ρy/4 + φx − φz x/z. Over a box film's row of pixels
    it changes the image by C f per unit, f the focal length.
    """
    found = information(clipped_floor(plane), spp=4096)
    F, error = found.information.matrix, found.information.standard_error
    focal = 8.0 / np.tan(np.radians(30.0))
    x = (np.arange(16) - 7.5) / focal
    columns = np.outer(np.ones(16), [0.0, -0.25, 0.0, 1.0, 0.0, 0.0])
    columns[:, 5] = x
    expected = 3.0 * (0.5 * focal / 0.05) ** 2 * columns.T @ columns
    if plane == "near":  # the horizon is far beyond the plane: what lies there tells of rotation
        expected[3:, 3:] *= 2.0
    size = np.sqrt(np.maximum(np.diag(expected), np.diag(F)))
    assert set(found.provenance["finite_differences"]["blocks"]) == {f"{plane} plane"}
    assert np.all(np.abs(F - expected) <= np.maximum(0.03 * np.outer(size, size), 4.0 * error))


# The price: bias by the step


def test_the_step_for_a_filter_hides_little_of_an_edge() -> None:
    """Of a box of width 1 and a step h, the trapezoid's ∫ is 1 − 2h/3: linear in the step."""
    box = PixelFilter.of(mi.load_dict({"type": "box"}))
    assert edge_bias(box, 0.15) == pytest.approx(0.1, rel=0.01)
    assert edge_bias(box, 0.075) == pytest.approx(0.05, rel=0.01)
    for name in ("box", "tent", "gaussian", "mitchell", "catmullrom", "lanczos"):
        pixel_filter = PixelFilter.of(mi.load_dict({"type": name}))
        assert 0.0 < edge_bias(pixel_filter, step_for(pixel_filter)) <= BIAS
        assert order_of(pixel_filter, step_for(pixel_filter)) == (1 if name == "box" else 2)
        misfit = [edge_misfit(pixel_filter, step_for(pixel_filter) * factor) for factor in (1.0, 2.0)]
        # Two ends, each a ramp of width 2h in the place of a jump: h/6 of its square.
        assert name != "box" or misfit[0] == pytest.approx(step_for(pixel_filter) / 3.0, rel=0.02)
        assert 0.0 < misfit[0] < edge_bias(pixel_filter, step_for(pixel_filter)) < 1.0
        assert misfit[1] > 1.9 * misfit[0]


@pytest.mark.slow
@pytest.mark.parametrize("spp", [64, 1024])
def test_a_bound_by_finite_differences_on_a_box_film_is_flow_s_within_its_errors(spp: int) -> None:
    sensor = camera(24, 18)
    sensor["film"] |= {"rfilter": {"type": "box"}}
    which = scene(sensor=sensor, wall=wall(), square=SQUARE)
    true = information(which, spp=1024, seed=7).information
    found = information(which, spp=spp, method="finite_difference")
    assert agree(found.information, true, tolerance=0.0)
    assert found.provenance["step_pixels"] == pytest.approx(0.01875)
    assert not found.provenance["finite_differences"]["blocks"]
    coarse = information(which, spp=spp, method="finite_difference", step_pixels=0.3)
    assert coarse.provenance["step_pixels"] == 0.3
    assert agree(coarse.information, true, tolerance=0.0)
    # Its step is in its errors.
    errors = np.diag(coarse.information.standard_error)
    F = np.diag(coarse.information.matrix)
    assert np.all(errors > 0.99 * edge_bias(PixelFilter.of(mi.load_dict({"type": "box"})), 0.3) * F)


@pytest.mark.parametrize("coupled", [False, True])
def test_a_bias_in_common_enters_the_covariance_with_its_square(coupled: bool) -> None:
    """Also where one mode couples all pixels; the part of some of them is then half of what F loses."""
    values = RNG.normal(size=(4, 128, 3, 6)) + 3.0
    modes = np.sin(np.arange(128.0)).reshape(1, 8, 16)
    noise = LowRankPlusDiagonal(np.ones((8, 16)), modes) if coupled else Gaussian(1.0)
    rows = BLOCKS.home == 1

    def sums(scale: float = 0.0, bias: Array | None = None) -> Sums:
        scaled = values * np.where(rows, 1.0 + scale, 1.0)[:, None, None]
        accumulator = InformationAccumulator(batches=4, block=8, coupled=coupled)
        if isinstance(noise, CoupledNoise):
            accumulator.add_coupled(scaled, noise, GRID, bias)
        else:
            accumulator.add(scaled, np.ones((128, 3)), GRID, bias)
        return accumulator.added

    plain, biased = sums(), sums(bias=np.where(rows, 0.1, 0.0))
    # An error of 0.1 of the rows' information is one of 0.05 of their derivative.
    slope = 0.05 * (sums(1e-3).matrix - sums(-1e-3).matrix) / 2e-3
    np.testing.assert_allclose(biased.bias, slope, rtol=1e-8)
    np.testing.assert_array_equal(plain.bias, np.zeros((6, 6)))
    np.testing.assert_array_equal(plain.matrix, biased.matrix)
    difference = biased.covariance_of_entries - plain.covariance_of_entries
    part = slope[np.triu_indices(6)]
    np.testing.assert_allclose(
        difference, np.outer(part, part), rtol=1e-6, atol=1e-9 * np.abs(difference).max()
    )


@pytest.mark.parametrize("nuisances", [[], ["gain"]])
@pytest.mark.slow
def test_noise_that_hardly_couples_pixels_says_of_differences_what_independent_noise_does(
    nuisances: list[str],
) -> None:
    """Of a Jacobian held whole, too."""
    options: dict[str, Any] = {"spp": 64, "nuisances": nuisances}
    coupled = Stationary([[1e-12, 0.05**2, 1e-12]])
    one, other = (pose_bound(clipped_floor("near"), noise, **options) for noise in (Gaussian(0.05), coupled))
    facts, others = (bound.provenance["finite_differences"] for bound in (one, other))
    assert facts["step_bias"] > 0.01
    assert 0.1 < facts["share"] < 1.0 + 1e-9
    assert others == {**facts, "share": pytest.approx(facts["share"], rel=1e-6)}
    joint = joint_information(pose_jacobian(clipped_floor("near"), **options), coupled).marginalize()
    for found in (other.information, joint.information):
        assert misfit(found.covariance_of_entries, one.information.covariance_of_entries) < 1e-6


@pytest.mark.slow
def test_a_random_subset_says_of_differences_what_all_pixels_do() -> None:
    shares = [
        information(clipped_floor("near"), pixels=pixels).provenance["finite_differences"]["share"]
        for pixels in ("all", "random:0.5")
    ]
    assert shares[1] == pytest.approx(shares[0], rel=0.3)
