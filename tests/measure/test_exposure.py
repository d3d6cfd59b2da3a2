"""The default camera: exposed for what is lit, saturated above white, the same for every count of paths."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matrices import misfit
from numpy.typing import NDArray
from small_scenes import T, camera, scene, texture, textured_wall, wall

from mitsuba_crb import hcr_bound, pose_bound, pose_jacobian
from mitsuba_crb.errors import NoiseError, OptionError
from mitsuba_crb.information.accumulate import InformationAccumulator, Sums
from mitsuba_crb.information.image_information import fisher_information
from mitsuba_crb.measure.exposure import exposed
from mitsuba_crb.measure.tile_jacobian import TileJacobian
from mitsuba_crb.noise import Clipped, Gaussian, IndependentNoise, PoissonGaussian
from mitsuba_crb.render.pixels import render_pixels
from mitsuba_crb.render.view import open_view

# Few samples on small images: that standard errors exceed 10 % is expected.
pytestmark = pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")

SCENES = sorted(path.parent.name for path in (Path(__file__).parents[2] / "scenes").glob("*/*.xml"))


def lamp(radiance: float) -> dict[str, Any]:
    """A textured wall with a lamp before it, in about one pixel of a hundred."""
    ball = {
        "type": "sphere",
        "to_world": T().translate([0.4, 0.5, 2.6]).scale(0.08),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": radiance}},
    }
    return scene(wall=wall(texture()), lamp=ball, sensor=camera(64, 48))


def image_of(path: Any, size: tuple[int, int], spp: int) -> NDArray[np.float64]:
    """(n, 3) a render of every pixel, by random numbers that no pilot has."""
    pixels = np.stack(np.meshgrid(*map(np.arange, size)), axis=-1).reshape(-1, 2)
    with open_view(path, size=size) as view:
        return render_pixels(view, pixels, spp=spp, seed=99)[0]


def rule(image: NDArray[np.float64]) -> float:
    """White, written out: the smaller of 99th percentile and log-average over 0.18, of what is lit."""
    values = image[image > 0.0]
    lit = values[values > 1e-4 * np.percentile(values, 99)]
    return float(min(np.percentile(lit, 99), np.exp(np.mean(np.log(lit))) / 0.18))


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(SCENES) - {"warehouse"}))
def test_the_default_sigma_is_the_rule_of_an_image_of_many_paths(scenes: Path, name: str) -> None:
    size = (48, 36)
    path = scenes / name / f"{name}.xml"
    found = pose_bound(path, size=size, spp=16, pixels="random:0.05").provenance["noise"]
    image = image_of(path, size, 1024)
    assert found["sigma"] == pytest.approx(0.01 * rule(image), rel=0.05)
    lit = image[image > 1e-4 * np.percentile(image, 99)]
    assert found["sigma"] < 1.02 * 0.01 * np.exp(np.mean(np.log(lit))) / 0.18


class TestTheRule:
    def test_a_few_highlights_do_not_count_and_many_are_held_by_the_average(self) -> None:
        values = np.full(10_000, 0.5)
        values[:50] = 1e3
        few = exposed(values)
        assert few is not None
        assert few.white == pytest.approx(0.5)
        assert few.rule == "99th percentile"
        values[:500] = 1e3
        many = exposed(values)
        assert many is not None
        assert many.white == pytest.approx(0.5 * 2000**0.05 / 0.18)
        assert many.rule == "log-average"

    def test_the_dark_around_a_star_is_not_lit(self) -> None:
        values = np.zeros((100, 100, 3))
        values[50, 50] = 7.0
        values[:10] = 7e-5 * 0.99
        star = exposed(values[10:])
        assert star is not None
        assert star.white == pytest.approx(7.0)
        values[:10] = 7e-3  # which is
        assert exposed(values).white < 0.05

    def test_the_renders_own_noise_is_not_taken_for_highlights(self) -> None:
        """Of a plain wall, and of one whose shades spread as the noise does, more than half is undone."""
        rng = np.random.default_rng(3)
        error = 0.05
        for spread in (0.0, 0.05):
            shades = 0.5 * np.exp(spread * rng.normal(size=20_000))
            noisy = shades * (1.0 + error * rng.normal(size=shades.shape))
            found, taken = exposed(noisy, (error * shades) ** 2), exposed(noisy)
            assert found is not None
            assert taken is not None
            off, before = np.log(np.array([found.white, taken.white]) / np.percentile(shades, 99))
            assert before > 0.03
            assert abs(off) < 0.5 * before

    def test_black_has_none(self) -> None:
        assert exposed(np.zeros((4, 4, 3))) is None
        assert exposed(np.full((4, 4, 3), np.nan)) is None


class TestALampInView:
    """A thousand times as bright as the wall, in one pixel of a hundred."""

    @pytest.mark.slow
    def test_the_wall_is_seen_by_default_as_by_a_camera_that_is_said_to_clip(self) -> None:
        bound = pose_bound(lamp(500.0), spp=64)
        facts = bound.provenance["noise"]
        assert bound.rank == 6
        assert facts["model"] == "clipped"
        assert facts["white"] < 20.0
        assert facts["sigma"] == pytest.approx(0.01 * facts["white"])
        assert 0.003 < facts["saturated"] < 0.06
        explicit = pose_bound(lamp(500.0), Clipped(facts["sigma"], facts["white"]), spp=64)
        assert np.array_equal(explicit.information.matrix, bound.information.matrix)
        given = pose_bound(lamp(500.0), exposure=facts["white"], spp=64)
        assert np.array_equal(given.information.matrix, bound.information.matrix)

    @pytest.mark.slow
    def test_without_clipping_the_lamp_drowns_the_wall(self) -> None:
        """The negative control."""
        clipped, bare = (pose_bound(lamp(500.0), clip=clip, spp=64) for clip in (True, False))
        assert bare.provenance["noise"]["model"] == "gaussian"
        assert np.trace(bare.information.matrix) > 30.0 * np.trace(clipped.information.matrix)
        assert bare.rank < 6

    def test_what_is_saturated_contributes_nothing(self) -> None:
        """The information is that of the other pixels, to rounding; without clipping it is not."""
        told: list[Any] = []
        whole = pose_bound(lamp(500.0), spp=64, on_tile=lambda tile, *_: told.append(tile))
        seen = np.zeros((48, 64), dtype=bool)
        for tile in told:
            seen[tile.pixels[:, 1], tile.pixels[:, 0]] = tile.weights.any(axis=1)
        assert 0.9 < seen.mean() < 0.99
        white = whole.provenance["noise"]["white"]
        others, lamps = (
            pose_bound(lamp(500.0), Gaussian(0.01 * white), spp=64, pixels=mask).information
            for mask in (seen, ~seen)
        )
        part = pose_bound(lamp(500.0), exposure=white, spp=64, pixels=seen).information
        assert misfit(part.matrix, whole.information.matrix) < 1e-9
        assert np.trace(lamps.matrix) > 100.0 * np.trace(others.matrix)
        with pytest.raises(NoiseError, match="all are saturated or ignored"):
            pose_bound(lamp(500.0), exposure=white, spp=64, pixels=~seen)


def test_where_all_is_brighter_than_white_nothing_is_told() -> None:
    with pytest.raises(NoiseError, match="all are saturated or ignored; change the exposure"):
        pose_bound(textured_wall(), exposure=0.01, spp=16)


def test_where_nothing_is_near_white_it_is_gaussian_to_the_last_bit() -> None:
    clipped = pose_bound(textured_wall(), Clipped(0.01, 10.0), spp=16)
    gaussian = pose_bound(textured_wall(), Gaussian(0.01), spp=16)
    assert np.array_equal(clipped.information.matrix, gaussian.information.matrix)
    assert clipped.provenance["noise"]["saturated"] == 0.0
    assert "saturated" not in gaussian.provenance["noise"]


def test_few_pilots_tell_what_a_pilot_of_every_pixel_does() -> None:
    """Of a quarter of the paths, where nothing is far above white; the control does not clip."""
    camera = Clipped(0.01, 0.7)
    jacobian = pose_jacobian(textured_wall(), spp=64)
    streamed = pose_bound(textured_wall(), camera, spp=64, tile=16).information
    assert misfit(fisher_information(jacobian, camera).matrix, streamed.matrix) < 0.05
    assert misfit(fisher_information(jacobian, Gaussian(0.01)).matrix, streamed.matrix) > 0.1


@pytest.mark.parametrize("noise", [Clipped(0.01, 1.0), PoissonGaussian(gain=1e-3, read_noise=0.002)])
def test_the_pilots_noise_is_in_the_error_of_what_its_weights_make(noise: IndependentNoise) -> None:
    """Edges up to white: the mean's noise takes some for saturated, and nothing beyond makes up for it."""
    rng = np.random.default_rng(3)
    pixels = np.stack(np.meshgrid(np.arange(40), np.arange(40)), axis=-1).reshape(-1, 2)
    mean = np.repeat(rng.uniform(0.3, 1.0, (1600, 1)), 3, axis=1)
    values = np.repeat(rng.normal(size=(1, 1600, 3, 6)), 4, axis=0)
    true = np.diag(summed(TileJacobian(values, pixels, mean).weighed(noise)).matrix)
    misses, errors = [], []
    for _ in range(40):
        halves = mean + 0.04 * mean * rng.normal(size=(2, 1600, 3))
        pilot, error = halves.mean(axis=0), 0.5 * (halves[0] - halves[1])
        found = summed(TileJacobian(values, pixels, mean, None, pilot, error).weighed(noise))
        misses.append(np.diag(found.matrix) - true)
        errors.append(np.sqrt(np.diag(found.covariance_of_entries))[[0, 6, 11, 15, 18, 20]])
    assert np.mean(np.abs(misses) < 3.0 * np.array(errors)) > 0.97
    # The errors are no larger than that takes, and the seeds' scatter alone would not do.
    assert np.mean(errors) < 3.0 * np.sqrt(np.mean(np.square(misses)))
    assert np.abs(np.mean(misses, axis=0)).max() > 3.0 * np.std(misses, axis=0).min() / np.sqrt(40)


def summed(tile: TileJacobian) -> Sums:
    accumulator = InformationAccumulator(batches=4)
    accumulator.add(tile.batch_values, tile.weights, tile.pixels, tile.bias, tile.weight_bias)
    return accumulator.added


def test_hcr_is_of_the_same_camera() -> None:
    """Its local part is the bound that stands beside it."""
    options: dict[str, Any] = {"spp": 64, "tile": 64}
    twist = [[0.0, 0.1, 0.0, 0.0, 0.0, 0.0]]
    beyond = hcr_bound(lamp(500.0), displacements=twist, **options)
    alone = pose_bound(lamp(500.0), **options)
    np.testing.assert_allclose(beyond.cramer_rao.position_std, alone.position_std, rtol=1e-9)


@pytest.mark.filterwarnings("ignore:nothing is visible")  # by the rays of a coarse grid
@pytest.mark.parametrize("scale", [0.02, 0.3])
def test_a_star_in_the_dark_is_not_black(scale: float) -> None:
    """One luminous thing in a world without other light, in a pixel or in some."""
    star = {
        "type": "sphere",
        "to_world": T().translate([0.1, 0.2, 3.0]).scale(scale),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 9.0}},
    }
    dark = {"type": "scene", "integrator": {"type": "path"}, "camera": camera(64, 48), "star": star}
    facts = pose_bound(dark, spp=16).provenance["noise"]
    assert 0.05 < facts["white"] < 9.5


def test_a_black_image_is_refused_by_name() -> None:
    black = scene(wall=wall({"type": "rgb", "value": 0.0}))
    with pytest.raises(NoiseError, match=r"the image is black .*--sigma"):
        pose_bound(black, spp=16)
    assert pose_bound(black, exposure=1.0, spp=16).rank == 0


@pytest.mark.parametrize("exposure", [0.0, -1.0, float("inf"), float("nan"), "bright", [1.0]])
def test_an_impossible_exposure_is_refused(exposure: Any) -> None:
    with pytest.raises(OptionError, match="exposure must be a radiance"):
        pose_bound(textured_wall(), exposure=exposure, spp=16)


@pytest.mark.parametrize("options", [{"exposure": 1.0}, {"exposure": "auto"}, {"clip": False}])
def test_a_camera_that_is_given_is_not_exposed(options: Any) -> None:
    with pytest.raises(OptionError, match="leave out one or the other"):
        pose_bound(textured_wall(), Gaussian(0.01), spp=16, **options)
