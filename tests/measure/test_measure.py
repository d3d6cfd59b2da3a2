"""From scene to bound: unbiased, covered, indifferent to tiles, honest about bad input."""

from __future__ import annotations

import dataclasses
import warnings
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from matrices import misfit
from PIL import Image
from small_scenes import T, camera, scene, texture, textured_wall, wall

from mitsuba_crb import cramer_rao_bound, fisher_information, pose_bound, pose_jacobian, se3
from mitsuba_crb.errors import (
    BlindSpotWarning,
    NoiseError,
    OptionError,
    PixelsError,
    PrecisionError,
    RadianceError,
)
from mitsuba_crb.information.blocks import BLOCK
from mitsuba_crb.information.joint import joint_information
from mitsuba_crb.information.linearisation import PixelSelection
from mitsuba_crb.information.subset import tiles
from mitsuba_crb.jacobian.finite_difference import steps_of
from mitsuba_crb.jacobian.lint import precision_findings
from mitsuba_crb.measure.measurement import measurement
from mitsuba_crb.measure.versions import versions
from mitsuba_crb.noise import (
    SRGB,
    ColourBlocks,
    Gaussian,
    Heteroscedastic,
    Luminance,
    NoiseModel,
    Periodic,
    PerPixel,
    PoissonGaussian,
    Quantisation,
    Sensor,
    Stationary,
    StudentT,
)
from mitsuba_crb.render.pixels import render_pixels
from mitsuba_crb.render.view import open_view

# Few samples on small images: that standard errors exceed 10 % is expected.
pytestmark = pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")

SIGMA = Gaussian(0.01)
DIRECT = {"type": "direct", "emitter_samples": 0, "bsdf_samples": 1}
FAST = {"method": "finite_difference", "spp": 8}


def _same(a: Any, b: Any) -> None:
    assert misfit(a.matrix, b.matrix) < 1e-12
    assert misfit(a.covariance_of_entries, b.covariance_of_entries) < 1e-9


@pytest.mark.slow
def test_streaming_equals_assembling_and_calls_repeat_bit_for_bit() -> None:
    bound = pose_bound(textured_wall(), SIGMA, **FAST)
    again = pose_bound(textured_wall(), SIGMA, **FAST)
    jacobian = pose_jacobian(textured_wall(), **FAST)
    assert np.array_equal(bound.information.matrix, again.information.matrix)
    assert np.array_equal(jacobian.batch_values, pose_jacobian(textured_wall(), **FAST).batch_values)
    _same(bound.information, fisher_information(jacobian, SIGMA))
    assert jacobian.values.shape == (32 * 24, 3, 6)
    assert jacobian.values.dtype == np.float64
    assert jacobian.image.shape == (24, 32, 3)
    assert np.isfinite(jacobian.image).all()


@pytest.mark.slow
def test_tiles_and_pixel_order_do_not_change_the_result() -> None:
    whole = pose_bound(textured_wall(), SIGMA, size=(40, 35), **FAST).information
    for tile in (16, 32):
        _same(pose_bound(textured_wall(), SIGMA, size=(40, 35), tile=tile, **FAST).information, whole)
    jacobian = pose_jacobian(textured_wall(), size=(40, 35), **FAST)
    order = np.random.default_rng(0).permutation(len(jacobian.pixels))
    shuffled = dataclasses.replace(
        jacobian, batch_values=jacobian.batch_values[:, order], pixels=jacobian.pixels[order]
    )
    _same(fisher_information(shuffled, SIGMA), whole)


def test_a_mask_sees_only_its_pixels_and_two_halves_add_up(tmp_path: Path) -> None:
    left = np.zeros((24, 32), dtype=bool)
    left[:, :16] = True
    halves = [pose_bound(textured_wall(), SIGMA, pixels=mask, **FAST).information for mask in (left, ~left)]
    whole = pose_bound(textured_wall(), SIGMA, **FAST).information
    total = halves[0] + halves[1]
    assert total.matrix == pytest.approx(whole.matrix, abs=1e-9 * np.abs(whole.matrix).max())
    path = tmp_path / "left.png"
    Image.fromarray((left * 255).astype(np.uint8)).save(path)
    from_file = pose_bound(textured_wall(), SIGMA, pixels=str(path), **FAST)
    _same(from_file.information, halves[0])
    assert from_file.provenance["pixels"] == {
        "kind": "only",
        "total": 768,
        "selected": 384,
        "description": "left.png",
    }


def test_gradient_pixels_carry_more_than_their_share() -> None:
    squares = scene(wall=wall({"type": "checkerboard", "to_uv": T().scale(4)}))
    whole, rich = (
        pose_bound(squares, SIGMA, pixels=pixels, method="finite_difference", spp=32).information
        for pixels in ("all", "gradient:0.25")
    )
    assert np.all(np.diag(rich.matrix) > 0.5 * np.diag(whole.matrix))
    assert np.all(np.diag(rich.matrix) < 1.01 * np.diag(whole.matrix))


@pytest.mark.slow
def test_random_pixels_estimate_the_whole_image() -> None:
    """Each of 6 diagonal entries within 4 of its standard errors, which hold the sampling variance."""
    whole = pose_bound(textured_wall(), SIGMA, **FAST).information
    part = pose_bound(textured_wall(), SIGMA, pixels="random:0.25", seed=3, method="finite_difference", spp=8)
    error = np.diag(part.information.standard_error)
    assert np.all(np.abs(np.diag(part.information.matrix - whole.matrix)) < 4 * error)
    # Noise alone would make it twice the whole's, of which the step's bias is a part that does not grow.
    assert np.all(error > 2.5 * np.diag(whole.standard_error))
    every = pose_bound(textured_wall(), SIGMA, pixels="random:1", **FAST).information
    _same(every, whole)


def test_a_part_of_a_measurement_is_measured_and_nothing_else() -> None:
    """Of a part that an estimator takes in one step (Adam's batches) there are no rows beyond its pixels."""
    with measurement(textured_wall(), pixels="random:0.5", **FAST) as run:
        whole, part = run.jacobian(), run.mask.copy()
        part[:12] = False
        jacobian = run.only(part, "lower half").jacobian()
        bare = dataclasses.replace(run, mask=part).jacobian()
    assert jacobian.batch_values.shape[1] == bare.batch_values.shape[1] == len(jacobian.pixels) == part.sum()
    kept = part[whole.pixels[:, 1], whole.pixels[:, 0]]
    assert np.array_equal(jacobian.batch_values, whole.batch_values[:, kept])
    assert np.array_equal(bare.batch_values, jacobian.batch_values)
    assert jacobian.selection == PixelSelection("only", 768, int(part.sum()), "lower half")
    assert run.only().selection == PixelSelection("only", 768, 384, "random:0.5")
    cut = whole.only(part, "lower half")
    assert np.array_equal(cut.batch_values, jacobian.batch_values)
    assert np.array_equal(cut.image, jacobian.image, equal_nan=True)
    assert cut.selection == jacobian.selection


def test_noise_scales_the_bound_and_sigma_has_a_stated_default() -> None:
    one = pose_bound(textured_wall(), SIGMA, **FAST)
    two = pose_bound(textured_wall(), Gaussian(0.02), **FAST)
    assert two.position_std == pytest.approx(2 * one.position_std)
    default = pose_bound(textured_wall(), **FAST)
    facts = default.provenance["noise"]
    assert facts["origin"] == f"0.01 of white {facts['white']:.3g} (99th percentile)"
    assert facts["sigma"] == pytest.approx(0.01 * facts["white"])
    black = scene(wall=wall({"type": "rgb", "value": 0.0}))
    with pytest.raises(NoiseError, match="--sigma"):
        pose_bound(black, **FAST)
    with pytest.raises(NoiseError):
        pose_bound(textured_wall(), PerPixel(np.ones((3, 3))), **FAST)


def test_moving_scene_and_camera_by_100_m_changes_nothing_in_the_camera_frame() -> None:
    """Float32 at 100 m: each diagonal entry within 3 combined standard errors (independent seeds)."""
    move = np.eye(4)
    move[:3, 3] = [100.0, -60.0, 80.0]
    near_wall, sensor = wall(texture()), camera()
    far = scene(
        wall=near_wall | {"to_world": T(move) @ near_wall["to_world"]},
        sensor=sensor | {"to_world": T(move) @ sensor["to_world"]},
    )
    options = {"method": "finite_difference", "spp": 64}
    there = pose_bound(far, SIGMA, seed=1, size=(64, 48), **options).information
    here = pose_bound(textured_wall(), SIGMA, seed=2, size=(64, 48), **options).information
    error = np.hypot(np.diag(here.standard_error), np.diag(there.standard_error))
    assert np.all(np.abs(np.diag(here.matrix - there.matrix)) < 3 * error)


def test_float32_is_named_where_it_is_too_coarse_and_refused_where_numbers_would_be_wrong() -> None:
    """Both sides of both limits, of the spacing over the finite-difference step."""
    with open_view(textured_wall()) as view:
        step = float(steps_of(view)[:3].min())
        for ratio, found in ((0.004, 0), (0.018, 1), (0.09, 1), (0.11, None), (4.0, None)):
            pose = np.eye(4)
            pose[1, 3] = -(2.0 ** (23 + np.floor(np.log2(ratio * step))))
            spacing = np.spacing(np.float32(abs(pose[1, 3])))
            scale = spacing / (ratio * step)  # the spacing is a power of two: the view's depth gives way
            there = dataclasses.replace(view, pose=pose)
            vars(there)["visible_depth"] = view.visible_depth * scale
            assert np.spacing(np.float32(abs(pose[1, 3]))) / steps_of(there)[:3].min() == pytest.approx(ratio)
            if found is None:
                with pytest.raises(PrecisionError, match="by more than 5 %: subtract what the coordinates"):
                    precision_findings(there)
            else:
                findings = precision_findings(there)
                assert len(findings) == found
                assert all("may be wrong by 5 %" in text for text in findings)


def test_a_geo_referenced_scene_is_refused_and_the_same_one_about_the_origin_is_not() -> None:
    """A metre-sized scene in UTM coordinates, where a direction that is unseen would look seen."""
    move = np.eye(4)
    move[:3, 3] = [500_000.0, 0.0, 5_400_000.0]
    far_wall, sensor = wall(texture()), camera()
    utm = scene(
        wall=far_wall | {"to_world": T(move) @ far_wall["to_world"]},
        sensor=sensor | {"to_world": T(move) @ sensor["to_world"]},
    )
    with pytest.raises(PrecisionError, match=r"5\.4e\+06 scene units from the origin") as caught:
        pose_bound(utm, SIGMA, **FAST)
    assert "\n" not in str(caught.value)
    assert np.isfinite(pose_bound(textured_wall(), SIGMA, **FAST).position_std).all()


def test_scaling_the_scenes_units_scales_the_answer_and_not_the_rank() -> None:
    metres = pose_bound(textured_wall(), SIGMA, **FAST)
    big_wall = wall(texture(), depth=300.0, half=600.0)
    centimetres = pose_bound(scene(wall=big_wall), SIGMA, **FAST)
    assert centimetres.length_scale == pytest.approx(100 * metres.length_scale, rel=1e-4)
    assert centimetres.position_std == pytest.approx(100 * metres.position_std, rel=0.05)
    assert centimetres.rotation_std_deg == pytest.approx(metres.rotation_std_deg, rel=0.05)
    assert centimetres.rank == metres.rank == 6
    assert centimetres.eigenvalues == pytest.approx(metres.eigenvalues, rel=0.05)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"spp": 30}, "the nearest is 32"),
        ({"spp": 1}, "the nearest is 4"),
        ({"spp": 0}, "spp must be positive"),
        ({"spp": 2.5}, "whole number"),
        ({"spp": 9, "batches": 3}, "at least 4"),
        ({"seed": -1}, "seed"),
        ({"tile": 20}, "tile"),
        ({"method": "magic"}, "methods: "),
        ({"size": (0, 3)}, "size"),
    ],
)
def test_options_out_of_range_are_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(OptionError, match=message):
        pose_bound(textured_wall(), SIGMA, **options)


@pytest.mark.parametrize(
    ("pixels", "message"),
    [
        ("random:0", r"\(0, 1\]"),
        ("random:1.5", r"\(0, 1\]"),
        ("gradient:x", r"\(0, 1\]"),
        ("nowhere.png", "neither"),
        (np.zeros((24, 32), dtype=bool), "empty"),
        (np.ones((3, 4), dtype=bool), "4 x 3, the image 32 x 24"),
        (np.ones((24, 32)), "boolean"),
    ],
)
def test_pixel_selections_that_cannot_be_are_named(pixels: Any, message: str) -> None:
    with pytest.raises(PixelsError, match=message):
        pose_bound(textured_wall(), SIGMA, pixels=pixels, **FAST)


def _half_invalid() -> Any:
    """A textured wall, and before its left half a lamp whose radiance is not a number."""
    lamp = {
        "type": "rectangle",
        "to_world": T().translate([1.5, 0, 2.5]).rotate([0, 1, 0], 180),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 1.0}},
    }
    loaded = mi.load_dict(textured_wall(lamp=lamp))
    params = mi.traverse(loaded)
    params["lamp.emitter.radiance.value"] = mi.Color3f(np.nan)
    params.update()
    return loaded


def test_radiance_that_is_no_number_is_counted_and_left_out_only_on_request() -> None:
    with pytest.raises(RadianceError, match=r"\d+ of 768 pixels.*--drop-invalid") as error:
        pose_bound(_half_invalid(), SIGMA, integrator=DIRECT, **FAST)
    count = int(str(error.value).split()[0])
    assert 0 < count < 768
    jacobian = pose_jacobian(_half_invalid(), integrator=DIRECT, drop_invalid=True, **FAST)
    assert len(jacobian.pixels) == 768 - count
    assert np.isnan(jacobian.image).any()
    assert np.isfinite(jacobian.values).all()


@pytest.mark.slow
def test_a_measurement_that_fails_has_warned_before() -> None:
    with pytest.warns(BlindSpotWarning) as caught, pytest.raises(RadianceError):
        pose_bound(_half_invalid(), SIGMA, integrator=DIRECT, method="forward", spp=4)
    assert any("silhouettes" in str(warning.message) for warning in caught)
    assert {warning.filename for warning in caught} == {__file__}


@pytest.mark.parametrize("measure", [pose_bound, pose_jacobian])
def test_warnings_point_at_the_caller(measure: Any) -> None:
    square = T().translate([0, 0, 2]).rotate([0, 1, 0], 180).scale(0.3)
    jumps = textured_wall(nearer={**wall(), "to_world": square})
    with pytest.warns(BlindSpotWarning) as caught:
        measure(jumps, method="forward", spp=4)
    assert {warning.filename for warning in caught if warning.category is BlindSpotWarning} == {__file__}


def test_nobody_can_change_the_versions_that_the_next_one_gets() -> None:
    versions()["mitsuba"] = "0"
    assert versions()["mitsuba"] == mi.__version__


def test_the_provenance_says_how_the_numbers_were_made() -> None:
    seen = []
    bound = pose_bound(
        textured_wall(), SIGMA, seed=7, on_tile=lambda tile, done, total: seen.append((done, total)), **FAST
    )
    assert seen[-1] == (768, 768)
    p = bound.provenance
    assert (p["method"], p["spp"], p["seed"], p["batches"], p["size"]) == (
        "finite_difference",
        8,
        7,
        4,
        [32, 24],
    )
    assert p["sensor"] == "camera"
    assert p["integrator"] == "PathIntegrator"
    assert p["versions"]["mitsuba"] == mi.__version__
    assert p["seconds"]["total"] > p["seconds"]["render"] > 0
    assert p["noise_inflation"] > 0


def test_the_bound_of_the_world_frame_is_the_same_bound() -> None:
    jacobian = pose_jacobian(textured_wall(), **FAST)
    camera_bound = cramer_rao_bound(fisher_information(jacobian, SIGMA))
    world_bound = cramer_rao_bound(fisher_information(jacobian, SIGMA).to_frame("world"))
    assert world_bound.position_std == pytest.approx(camera_bound.position_std)
    adjoint = se3.adjoint(jacobian.pose)
    moved = adjoint @ camera_bound.covariance @ adjoint.T
    assert world_bound.covariance == pytest.approx(moved, rel=1e-6, abs=1e-9 * np.abs(moved).max())


@pytest.mark.slow
def test_the_batched_estimate_is_unbiased_and_its_intervals_cover() -> None:
    """200 seeds, 16 spp in 4 batches: mean within 4 standard errors of a many-sample reference, 95 %
    intervals of each diagonal entry cover in 90 to 99 %; the plain ĴᵀWĴ lies beyond 10 (negative control)."""
    noisy = scene(wall=wall({"type": "checkerboard", "to_uv": T().scale(6)}), sensor=camera(24, 16))
    options = {"method": "finite_difference", "batches": 4}
    reference = pose_bound(noisy, SIGMA, spp=1 << 14, seed=10**6, **options).information
    truth = np.diag(reference.matrix)
    runs = [pose_bound(noisy, SIGMA, spp=16, seed=seed, **options).information for seed in range(200)]
    estimates = np.array([np.diag(run.matrix) for run in runs])
    errors = np.array([np.diag(run.standard_error) for run in runs])
    plain = np.array([np.diag(run.plain_matrix) for run in runs])
    of_mean = np.hypot(estimates.std(axis=0, ddof=1) / np.sqrt(200), np.diag(reference.standard_error))
    assert np.all(np.abs(estimates.mean(axis=0) - truth) < 4 * of_mean)
    assert np.all(plain.mean(axis=0) - truth > 10 * of_mean)
    covered = np.mean(np.abs(estimates - truth) < 1.96 * errors, axis=0)
    assert np.all((covered >= 0.90) & (covered <= 0.99))


@pytest.mark.slow
@pytest.mark.parametrize(
    "file",
    [
        "cbox/cbox.xml",
        "cornell-box/scene_m39.xml",
        "cornell-picture/scene_picture.xml",
        "matpreview/matpreview.xml",
        "sponza/scene_m39.xml",
        "staircase2/scene.xml",
    ],
)
def test_scenes_by_others_are_bounded_and_look_like_themselves(file: str, real_scenes: Path) -> None:
    """Their own light is noisy at 64 paths: what is not resolved is infinite, and said to be only that."""
    tiles: list[Any] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        bound = pose_bound(
            real_scenes / file, size=(128, 96), spp=64, on_tile=lambda tile, done, total: tiles.append(tile)
        )
    deviations = np.concatenate([bound.position_std, bound.rotation_std_deg])
    assert 2 <= bound.rank <= 6
    assert np.all(deviations > 0.0)
    assert np.isfinite(bound.length_scale)
    if bound.rank < 6:
        unresolved = any(u.verdict == "not resolved" for u in bound.unobserved)
        assert any("not resolved: " in str(warning.message) for warning in caught) >= unresolved
    with open_view(real_scenes / file, size=(128, 96)) as view:
        pixels = np.concatenate([tile.pixels for tile in tiles])
        render = render_pixels(view, pixels, spp=64, seed=9)[0]
    image = np.concatenate([tile.mean for tile in tiles])
    white = np.percentile(render, 99)
    clipped = [np.clip(values, 0.0, white).ravel() for values in (image, render)]
    assert np.corrcoef(clipped[0], clipped[1])[0, 1] > 0.85


def test_correlated_noise_takes_the_whole_image_at_once() -> None:
    """A flat spectrum is white noise; of a random subset nothing follows for the whole image."""
    white = pose_bound(textured_wall(), SIGMA, **FAST).information
    flat = pose_bound(textured_wall(), Periodic(np.full((24, 32), 1e-4)), tile=16, **FAST).information
    assert misfit(flat.matrix, white.matrix) < 1e-12
    with pytest.raises(NoiseError, match="random subset"):
        pose_bound(textured_wall(), Periodic(np.full((24, 32), 1e-4)), pixels="random:0.5", **FAST)
    with pytest.raises(NoiseError, match="24 rows x 32 columns"):
        pose_bound(textured_wall(), Periodic(np.full((32, 24), 1e-4)), **FAST)


PHOTONS = PoissonGaussian(gain=1e-3, read_noise=2e-3)
CHECKERS = {"type": "checkerboard", "to_uv": T().scale(8)}
MODELS: dict[str, NoiseModel] = {
    "gaussian": SIGMA,
    "per pixel": PerPixel(np.full((24, 32), 1e-4)),
    "colour blocks": ColourBlocks(1e-4 * np.eye(3) + 1e-5),
    "heteroscedastic": Heteroscedastic((1e-6, 1e-3)),
    "photons": PHOTONS,
    "one channel of photons": Luminance(PHOTONS),
    "noise after a curve": Sensor(SIGMA, "after", SRGB),
    "codes of photons": Sensor(PHOTONS, "before", SRGB, quantisation=Quantisation(64)),
    "heavy tails": StudentT(0.01, 4.0),
    "correlated": Stationary([[1e-5, 1e-4, 1e-5]]),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "pixels"),
    [
        (name, pixels)
        for name in MODELS
        for pixels in ("all", "random:0.5", "gradient:0.3")
        if (name, pixels) != ("correlated", "random:0.5")  # which tells nothing of the whole
    ],
)
def test_a_jacobian_held_whole_tells_what_the_stream_does_under_every_noise(name: str, pixels: str) -> None:
    options: dict[str, Any] = {"spp": 16, "pixels": pixels, "tile": 16}
    streamed = pose_bound(scene(wall=wall(CHECKERS)), MODELS[name], **options).information
    held = fisher_information(pose_jacobian(scene(wall=wall(CHECKERS)), **options), MODELS[name])
    assert misfit(held.matrix, streamed.matrix) < 1e-10
    assert misfit(held.covariance_of_entries, streamed.covariance_of_entries) < 1e-8


def test_a_jacobian_with_nuisances_held_whole_tells_what_the_stream_does() -> None:
    options: dict[str, Any] = {"spp": 16, "nuisances": ["gain", "fov"]}
    streamed = pose_bound(scene(wall=wall(CHECKERS)), PHOTONS, **options).information
    jacobian = pose_jacobian(scene(wall=wall(CHECKERS)), **options)
    held = joint_information(jacobian, PHOTONS).marginalize().information
    assert misfit(held.matrix, streamed.matrix) < 1e-10


def test_the_mean_that_noise_depends_on_has_other_errors_than_the_jacobian() -> None:
    """At edges of a texture; a pilot of half of the same random numbers is the negative control."""
    edges = scene(wall=wall(CHECKERS))
    jacobian = pose_jacobian(edges, spp=64)
    assert jacobian.pilot is not None
    x, y = jacobian.pixels.T
    reference = np.empty((24, 32, 3))
    with open_view(edges) as view:
        reference[y, x] = render_pixels(view, jacobian.pixels, spp=4096, seed=9)[0]
    half = pose_jacobian(edges, spp=32).pilot
    assert half is not None
    images = (jacobian.pilot, jacobian.image, half)
    pilots, own, halves = ((image - reference).ravel() for image in images)
    assert abs(np.corrcoef(pilots, own)[0, 1]) < 4.0 / np.sqrt(reference.size)
    assert np.corrcoef(pilots, halves)[0, 1] > 0.4
    true = np.diagonal(fisher_information(jacobian, PHOTONS, reference).matrix)
    # Weights are not linear in the image: 64 paths leave some per cent.
    assert np.diagonal(fisher_information(jacobian, PHOTONS).matrix) == pytest.approx(true, rel=0.05)
    with pytest.raises(NoiseError, match="the mean has shape"):
        fisher_information(jacobian, PHOTONS, reference[:, :5])


@pytest.mark.parametrize("noise", [SIGMA, PHOTONS], ids=["fixed", "photons"])
def test_a_tile_has_a_pilot_where_noise_depends_on_it(noise: NoiseModel) -> None:
    seen: list[Any] = []
    pose_bound(textured_wall(), noise, on_tile=lambda tile, *_: seen.append(tile.pilot), **FAST)
    assert [pilot is not None for pilot in seen] == [noise.depends_on_mean] * len(seen)


def test_a_saturated_image_is_refused() -> None:
    camera = Sensor(Heteroscedastic((1e-6, 1e-6)), "before", exposure=1e4, quantisation=Quantisation(256))
    with pytest.raises(NoiseError, match="all are saturated or ignored"):
        pose_bound(textured_wall(), camera, **FAST)


@pytest.mark.parametrize("share", [0.002, 0.02, 0.3, 1.0])
def test_parts_hold_every_selected_pixel_once_in_whole_blocks(share: float) -> None:
    tile = 64
    mask = np.random.default_rng(1).random((500, 300)) < share
    parts = list(tiles(mask, tile))
    together = np.concatenate(parts)
    found = np.zeros_like(mask)
    found[together[:, 1], together[:, 0]] = True
    assert len(together) == np.count_nonzero(mask)
    assert np.array_equal(found, mask)
    blocks = [set(map(tuple, part // BLOCK)) for part in parts]
    assert sum(map(len, blocks)) == len(set.union(*blocks))
    sizes = [len(part) for part in parts]
    if share < 0.1:  # several parts, the last of which is small
        assert max(sizes) <= max(tile**2 // 8, len(together) // 3)
        assert sizes[-1] <= tile**2 // 8 + tile
    assert max(sizes) <= tile**2


def test_what_one_pose_has_summed_is_not_another_poses() -> None:
    """`at` and `only` are measurements of their own."""
    with measurement(textured_wall(), spp=4, size=(16, 12)) as run:
        run.information(run.noise(None)[0])
        assert run.saturation.values
        for other in (run.at(run.view.pose), run.only()):
            assert other.saturation.values == 0
            assert other.differences is not run.differences
