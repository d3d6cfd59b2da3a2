"""Tiles of an image: their sums, their two halves, their transport to a common body, and their costs."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from small_scenes import textured_wall

from mitsuba_crb import fisher_information, pose_bound, pose_jacobian, se3
from mitsuba_crb.agents.fusion import Agent, to_common
from mitsuba_crb.agents.message import encode, message_size
from mitsuba_crb.agents.selection import select_tiles
from mitsuba_crb.agents.tile_grid import TileGrid
from mitsuba_crb.agents.tiles import Budget, about_common_body
from mitsuba_crb.errors import FrameError, OptionError, PoseError, SelectionError
from mitsuba_crb.measure import tiles as measure_tiles
from mitsuba_crb.measure.tiles import tile_information
from mitsuba_crb.noise import CoupledNoise, Gaussian

# Few samples on small images: that standard errors exceed 10 % is expected.
pytestmark = pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")

SIGMA = Gaussian(0.01)
FAST: dict[str, Any] = {"spp": 8, "batches": 8, "size": (40, 30)}
BODY = se3.exp([0.3, -0.2, 0.5, 0.2, 0.4, -0.1])


@pytest.fixture(scope="module")
def jacobian() -> Any:
    return pose_jacobian(textured_wall(), **FAST)


def _scaled(information: Any) -> Any:
    return information.scale[:, None] * information.matrix * information.scale


@pytest.mark.slow
def test_each_half_is_the_information_of_the_tile_s_pixels_from_its_batches(jacobian: Any) -> None:
    """The oracle assembles a Jacobian cut to the tile's pixels and to half of the batches."""
    own = tile_information(textured_wall(), SIGMA, tile_size=(16, 12), **FAST)
    (found,) = about_common_body([own], [BODY])
    assert found.tiles.tolist()[:3] == [[0, 0, 16, 12], [16, 0, 16, 12], [32, 0, 8, 12]]
    assert found.tiles.tolist()[-1] == [32, 24, 8, 6]
    for k, (x, y, width, height) in enumerate(found.tiles):
        column, row = jacobian.pixels.T
        inside = (column >= x) & (column < x + width) & (row >= y) & (row < y + height)
        for half, blocks in ((slice(0, 4), found.select), (slice(4, 8), found.report)):
            part = dataclasses.replace(
                jacobian, batch_values=jacobian.batch_values[half][:, inside], pixels=jacobian.pixels[inside]
            )
            agent = Agent("camera", fisher_information(part, SIGMA), BODY)
            expected = _scaled(to_common(agent, variable="body"))
            assert np.abs(blocks[k] - expected).max() < 1e-9 * np.abs(expected).max()
    assert found.pose == pytest.approx(jacobian.pose @ se3.inverse(BODY), abs=1e-12)
    assert found.length_scale == jacobian.length_scale


@pytest.mark.slow
@pytest.mark.parametrize("tile_size", [7, 16, (33, 5), 1000])
def test_tiles_of_any_size_add_up_to_the_image_whatever_the_streaming_tiles(tile_size: Any) -> None:
    found = tile_information(textured_wall(), SIGMA, tile_size=tile_size, tile=16, **FAST)
    whole = tile_information(textured_wall(), SIGMA, tile_size=40, **FAST)
    assert (found.tiles[:, 2] * found.tiles[:, 3]).sum() == 40 * 30
    for blocks, all_ in ((found.select, whole.select), (found.report, whole.report)):
        assert np.abs(blocks.sum(axis=0) - all_[0]).max() < 1e-9 * np.abs(all_[0]).max()


@pytest.mark.slow
def test_halves_agree_with_the_bound_s_information_within_its_errors() -> None:
    information = pose_bound(textured_wall(), SIGMA, **(FAST | {"spp": 64})).information
    found = tile_information(textured_wall(), SIGMA, tile_size=40, **(FAST | {"spp": 64}))
    middle = 0.5 * (found.select[0] + found.report[0])
    error = information.scale[:, None] * information.standard_error * information.scale
    # The halves leave out the pairs between them: their mean has some 1.5 times the error.
    assert np.all(np.abs(middle - _scaled(information)) < 5.0 * error)


@pytest.mark.slow
def test_a_mask_keeps_the_tiles_that_it_touches_and_a_sample_stands_for_all() -> None:
    mask = np.zeros((30, 40), dtype=bool)
    mask[:12, :20] = True
    masked = tile_information(textured_wall(), SIGMA, tile_size=16, pixels=mask, **FAST)
    assert masked.tiles.tolist() == [[0, 0, 16, 16], [16, 0, 16, 16]]
    whole = tile_information(textured_wall(), SIGMA, tile_size=40, **FAST)
    sampled = tile_information(textured_wall(), SIGMA, tile_size=2, pixels="random:0.5", **FAST)
    assert len(sampled.tiles) == 20 * 15
    ratio = np.trace(sampled.select.sum(axis=0)) / np.trace(whole.select[0])
    # 600 of 1200 pixels of one texture: about 5 % of sampling error.
    assert 0.8 < ratio < 1.2


def test_the_cost_is_the_size_of_the_message() -> None:
    own = tile_information(
        textured_wall(), SIGMA, agent="robot é", form="sketch", message_precision="float16", rank=2, **FAST
    )
    (found,) = about_common_body([own], [np.eye(4)])
    assert found.cost_bytes.tolist() == [
        message_size(agent="robot é", variable="body", form="sketch", precision="float16", rank=2)
    ] * len(found.tiles)
    information = pose_bound(textured_wall(), SIGMA, **FAST).information.about(variable="body")
    data = encode(
        information,
        agent="robot é",
        sequence=0,
        tile=tuple(found.tiles[0].tolist()),
        form="sketch",
        precision="float16",
        rank=2,
    )
    assert len(data) == found.cost_bytes[0]


def test_halves_have_no_bias_where_the_plain_product_has() -> None:
    """Mean of 400 draws within 4 standard errors of JᵀJ; ĴᵀĴ of the same draws is beyond 20."""
    rng = np.random.default_rng(3)
    J = rng.normal(size=(12, 3, 6))
    pixels = np.stack(np.divmod(np.arange(12), 4), axis=1)
    estimates, plain = [], []
    for _ in range(400):
        values = J + 2.0 * rng.normal(size=(8, *J.shape))
        grid = TileGrid((4, 4), 4, batches=8)
        grid.add(values, np.ones((12, 3)), pixels)
        estimates.append([half[0] for half in grid.halves(np.ones(6))])
        mean = values.mean(axis=0).reshape(-1, 6)
        plain.append(mean.T @ mean)
    F = J.reshape(-1, 6).T @ J.reshape(-1, 6)
    for half in np.moveaxis(np.array(estimates), 1, 0):
        error = half.std(axis=0) / np.sqrt(len(half))
        assert np.all(np.abs(half.mean(axis=0) - F) < 4.0 * error)
    bias = np.diagonal(np.mean(plain, axis=0) - F)
    assert np.all(bias > 20.0 * np.diagonal(np.std(plain, axis=0)) / np.sqrt(len(plain)))
    select, report = np.moveaxis(np.array(estimates), 1, 0)[:, :, 0, 0]
    assert abs(np.corrcoef(select, report)[0, 1]) < 4.0 / np.sqrt(400)


def test_agents_are_brought_to_one_pose_and_unit() -> None:
    a, b = (tile_information(textured_wall(), SIGMA, agent=name, **FAST) for name in "ab")
    units = np.repeat([2.0, 1.0], 3)
    wider = dataclasses.replace(
        a.about(length_scale=2.0 * a.length_scale),
        select=units[:, None] * a.select * units,
        report=units[:, None] * a.report * units,
    )
    common = about_common_body([b, wider], [BODY, BODY], variable="rig")
    assert {(agent.length_scale, agent.variable) for agent in common} == {(wider.length_scale, "rig")}
    assert common[0].cost_bytes[0] == b.cost_bytes[0] - len("camera") + len("rig")
    # The same tiles, said in another unit before.
    np.testing.assert_allclose(common[0].select, common[1].select, rtol=1e-9)
    # The same motion of the camera and of the body.
    motion = np.array([0.1, 0.2, -0.3, 0.01, 0.02, -0.03])
    own = se3.adjoint(se3.inverse(BODY)) @ motion / np.repeat([b.length_scale, 1.0], 3)
    body = motion / np.repeat([wider.length_scale, 1.0], 3)
    assert body @ common[0].select[0] @ body == pytest.approx(own @ b.select[0] @ own, rel=1e-9)
    assert len(select_tiles(common, Budget(tiles=3)).chosen) == 3
    assert about_common_body([], []) == []
    with pytest.raises(FrameError, match=r"agent 'b'.*0.1 scene units"):
        about_common_body([a, b], [BODY, se3.exp([0, 0, 0.1, 0, 0, 0]) @ BODY])
    with pytest.raises(PoseError, match="scale"):
        about_common_body([a], [np.diag([2.0, 2.0, 2.0, 1.0])])


def test_noise_that_mixes_a_pixel_s_channels_weighs_by_blocks() -> None:
    rng = np.random.default_rng(5)
    values, root = rng.normal(size=(8, 12, 3, 6)), rng.normal(size=(12, 3, 3))
    pixels = np.stack(np.divmod(np.arange(12), 4), axis=1)
    mixed, whitened = TileGrid((4, 4), 2, batches=8), TileGrid((4, 4), 2, batches=8)
    mixed.add(values, root.swapaxes(1, 2) @ root, pixels)
    whitened.add(np.einsum("ncd,kndi->knci", root, values), np.ones((12, 3)), pixels)
    for found, expected in zip(mixed.halves(np.ones(6)), whitened.halves(np.ones(6)), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-12 * np.abs(expected).max())


class Coupled(CoupledNoise):
    description = "coupled"

    def check(self, height: int, width: int, channels: int) -> None:
        pass

    def to_dict(self) -> dict[str, Any]:
        return {}

    def solve(self, pixels: Any, values: Any) -> Any:
        return values


@pytest.mark.parametrize(
    ("options", "error", "match"),
    [
        ({"batches": 4}, OptionError, "at least 8, not 4"),
        ({"tile_size": 0}, OptionError, "tile's size"),
        ({"tile_size": (8, -1)}, OptionError, "tile's size"),
        ({"tile_size": 1.5}, OptionError, "tile's size"),
        ({"noise": Coupled()}, SelectionError, "'camera' is correlated between pixels.*do.* not add"),
    ],
)
def test_what_cannot_be_is_refused_before_rendering(
    options: Any, error: Any, match: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(measure_tiles.TileGrid, "add", None)
    with pytest.raises(error, match=match):
        tile_information(textured_wall(), **(FAST | {"noise": SIGMA} | options))
