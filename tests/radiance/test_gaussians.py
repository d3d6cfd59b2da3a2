"""Splats as a field: the kernel is the slow twin; its columns are its differences, which cuts spoil."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ewa_twin import ELLIPSE, INRIA, Cuts, picture
from splat_views import (
    REAL,
    SMALL,
    VARIANTS,
    odd_splats,
    pixels_of,
    random_splats,
    real_camera,
    real_splats,
    real_views,
    sized_splats,
    turned_by_flow,
    wall_of_splats,
)

from mitsuba_crb import se3
from mitsuba_crb.camera import Camera, Intrinsics
from mitsuba_crb.datasets.splats import Splats
from mitsuba_crb.errors import FieldError
from mitsuba_crb.radiance import splat_tiles
from mitsuba_crb.radiance.field import Shown
from mitsuba_crb.radiance.gaussians import Gaussians, load_gaussians

POSE = se3.exp([0.1, -0.05, 0.2, 0.08, -0.1, 0.3])
BACKGROUND = (0.2, 0.1, 0.4)
ALL = pixels_of(SMALL)


def steps(camera: Camera, depth: float, motion: float = 0.02) -> np.ndarray:
    """(6,) twist components that move the image by about `motion` [pixel]."""
    turn = camera.angles(motion)
    return np.concatenate([turn[[1, 0]] * depth, [motion / max(camera.size) * depth], turn])


def differences(field: Gaussians, camera: Camera, pose: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """(n, 3, 6) central differences at frozen order."""
    depth = np.nanmedian(field.show(camera, pose, pixels).depth)
    found = []
    for k, step in enumerate(steps(camera, depth)):
        twist = step * np.eye(6)[k]
        ends = (
            field.show(camera, pose @ se3.exp(sign * twist), pixels, kept=pose).values for sign in (1, -1)
        )
        found.append(np.subtract(*ends) / (2.0 * step))
    return np.stack(found, axis=-1)


def assert_slopes(columns: np.ndarray, found: np.ndarray) -> None:
    """Each column is the differences: slope 0.99 to 1.01, correlation above 0.999."""
    for k in range(6):
        column, difference = columns[..., k].ravel(), found[..., k].ravel()
        slope = column @ difference / (column @ column)
        assert 0.99 < slope < 1.01, (k, slope)
        assert np.corrcoef(column, difference)[0, 1] > 0.999, k


def assert_twin(field: Gaussians, camera: Camera, pose: np.ndarray, pixels: np.ndarray) -> None:
    """Colour, depth and opacity to 1e-4 of the range, columns to 1e-3 of their norm."""
    twin = picture(
        field.splats, camera, pose, pixels, variant=field.variant, background=tuple(field.background)
    )
    values, columns = field.columns(camera, pose, pixels)
    shown = field.show(camera, pose, pixels)
    assert np.abs(shown.values - twin.values).max() < 1e-4 * np.ptp(twin.values)
    np.testing.assert_allclose(values, shown.values, rtol=0.0, atol=1e-6 * np.ptp(twin.values))
    np.testing.assert_allclose(shown.opacity, twin.opacity, rtol=0.0, atol=1e-4)
    seen = np.isfinite(shown.depth)
    np.testing.assert_array_equal(seen[twin.opacity > 0.004], True)
    # What covers little has a depth that ε cuts: weigh by how much it covers.
    miss = np.abs(shown.depth - twin.depth) * twin.opacity
    assert miss[seen].max() < 1e-4 * np.nanmax(twin.depth)
    for k in range(6):
        norm = np.linalg.norm(twin.columns[..., k])
        assert np.linalg.norm(columns[..., k] - twin.columns[..., k]) < 1e-3 * norm, k


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("degree", [0, 3])
def test_the_kernel_is_the_twin(variant: str, degree: int) -> None:
    field = Gaussians(odd_splats(degree), variant=variant, background=BACKGROUND)
    assert_twin(field, SMALL, POSE, ALL)


@pytest.mark.parametrize("degree", [1, 2])
def test_the_kernel_is_the_twin_of_other_degrees(degree: int) -> None:
    field = Gaussians(odd_splats(degree), background=BACKGROUND)
    assert_twin(field, SMALL, POSE, ALL)


@pytest.mark.parametrize("variant", VARIANTS)
def test_each_column_is_its_central_difference(variant: str) -> None:
    field = Gaussians(random_splats(degree=2), variant=variant, background=BACKGROUND)
    assert_slopes(field.columns(SMALL, POSE, ALL)[1], differences(field, SMALL, POSE, ALL))


def test_the_columns_of_degree_four_are_central_differences() -> None:
    field = Gaussians(random_splats(degree=4))
    assert_slopes(field.columns(SMALL, POSE, ALL)[1], differences(field, SMALL, POSE, ALL))


def test_one_round_splat_before_the_camera_is_a_gaussian_on_the_film() -> None:
    sigma, depth, opacity = 0.2, 2.0, 0.6
    splats = Splats(
        np.array([[0.0, 0.0, depth]]),
        np.array([[1.0, 0.0, 0.0, 0.0]]),
        np.full((1, 3), sigma),
        np.array([opacity]),
        np.full((1, 1, 3), 1.0, dtype=np.float32),
    )
    camera = Camera.pinhole(30.0, (12.0, 9.0), (24, 18))
    pixels = pixels_of(camera)
    values, columns = Gaussians(splats).columns(camera, np.eye(4), pixels)
    away = pixels + 0.5 - camera.centre
    variance = (30.0 * sigma / depth) ** 2 + 0.3
    colour = 0.5 + 0.28209479177387814
    expected = colour * opacity * np.exp(-0.5 * np.sum(away**2, axis=1) / variance)
    np.testing.assert_allclose(values[:, 1], expected, rtol=0.0, atol=2e-6)
    # x is left: where the camera goes left, what it sees goes right, by focal / depth.
    slope = expected[:, None] * away / variance * 30.0 / depth
    scale = np.abs(slope).max()
    np.testing.assert_allclose(columns[:, 1, 0], slope[:, 0], rtol=0.0, atol=1e-5 * scale)
    np.testing.assert_allclose(columns[:, 1, 1], slope[:, 1], rtol=0.0, atol=1e-5 * scale)
    # Nearer by δ it is larger, variance' = 2 (variance − 0.3) / depth.
    growth = expected * 0.5 * np.sum(away**2, axis=1) / variance**2 * 2.0 * (variance - 0.3) / depth
    np.testing.assert_allclose(columns[:, 1, 2], growth, rtol=0.0, atol=1e-5 * scale)
    np.testing.assert_allclose(columns[:, 1, 5], 0.0, atol=1e-5 * scale)  # it is round


def test_rotation_columns_of_small_splats_are_the_filter_term() -> None:
    camera = Camera.pinhole(60.0, (32.0, 32.0), (64, 64))
    field = Gaussians(sized_splats(camera, POSE, 5.0), background=BACKGROUND)
    pixels = pixels_of(camera)
    columns = field.columns(camera, POSE, pixels)[1][..., 3:]
    expected = turned_by_flow(field, camera, POSE, pixels)
    for k in range(3):
        assert np.linalg.norm(columns[..., k] - expected[..., k]) < 0.01 * np.linalg.norm(expected[..., k])


def information(J: np.ndarray) -> np.ndarray:
    """(6,) what each twist component alone would have of it."""
    return np.sum(J**2, axis=(0, 1))


def by_differences_with_cuts(
    splats: Splats, camera: Camera, pose: np.ndarray, pixels: np.ndarray, taken: np.ndarray, cuts: Cuts
) -> np.ndarray:
    """(6,) `information` of the twin's central differences at frozen order."""
    found = []
    for twist in np.diag(taken):
        ends = (
            picture(
                splats, camera, pose @ se3.exp(sign * twist), pixels, kept=pose, cuts=cuts, columns=False
            ).values
            for sign in (1, -1)
        )
        found.append(np.subtract(*ends) / (2.0 * twist.max()))
    return information(np.stack(found, axis=-1))


def test_with_a_cut_at_three_sigmas_the_analytic_columns_are_too_small() -> None:
    splats, pixels = wall_of_splats(), ALL[::3]
    cut = information(picture(splats, SMALL, POSE, pixels, cuts=ELLIPSE).columns)
    taken = steps(SMALL, 3.5, 0.005)
    assert (cut / by_differences_with_cuts(splats, SMALL, POSE, pixels, taken, ELLIPSE) < 0.95).all()
    # And without it they are not.
    field = Gaussians(splats)
    honest = information(field.columns(SMALL, POSE, pixels)[1])
    found = information(differences(field, SMALL, POSE, pixels))
    np.testing.assert_allclose(honest / found, 1.0, rtol=0.0, atol=0.01)


@pytest.mark.slow
def test_a_rasterisers_threshold_spoils_the_columns_of_a_real_splat(gaussians: Path) -> None:
    camera, pose = real_camera(128), real_views("hall")[0]
    rows, columns = np.indices((24, 24))
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 2) + 52
    field = load_gaussians(gaussians / REAL["hall"])
    uncut = field.columns(camera, pose, pixels)[1]
    cut = picture(field.splats, camera, pose, pixels, cuts=INRIA)
    honest = information(uncut) / information(differences(field, camera, pose, pixels))
    np.testing.assert_allclose(honest, 1.0, rtol=0.0, atol=0.01)
    spoilt = by_differences_with_cuts(field.splats, camera, pose, pixels, steps(camera, 220.0), INRIA)
    assert (information(cut.columns) / spoilt < 0.95).all()


@pytest.mark.parametrize("order", [0, 1])
def test_equal_calls_tiles_and_subsets_have_the_same_bits(order: int) -> None:
    field = Gaussians(odd_splats(), variant="antialiased", background=BACKGROUND)
    values, columns = field.columns(SMALL, POSE, ALL, order=order)
    shown = field.show(SMALL, POSE, ALL, order=order)
    some = np.random.default_rng(0).permutation(len(ALL))[:101]
    for subset in (np.arange(len(ALL)), some, some[:1], np.arange(160)):
        again = Gaussians(odd_splats(), variant="antialiased", background=BACKGROUND)
        part = again.columns(SMALL, POSE, ALL[subset], order=order)
        np.testing.assert_array_equal(part[0], values[subset])
        np.testing.assert_array_equal(part[1], columns[subset])
        one = again.show(SMALL, POSE, ALL[subset], order=order)
        for name in ("values", "depth", "opacity"):
            np.testing.assert_array_equal(getattr(one, name), getattr(shown, name)[subset])


def test_orders_of_summation_differ_by_rounding_and_do_differ() -> None:
    field = Gaussians(random_splats(300, degree=2), background=BACKGROUND)
    first, second = (field.columns(SMALL, POSE, ALL, order=order) for order in (0, 1))
    for one, other in zip(first, second, strict=True):
        assert 0.0 < np.abs(one - other).max() < 1e-5 * np.abs(one).max()


def test_kept_keeps_the_order_of_depth() -> None:
    far, near = [0.0, 0.0, 2.0], [0.0, 0.0, 1.9]
    splats = Splats(
        np.array([far, near]),
        np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)),
        np.full((2, 3), 0.3),
        np.full(2, 0.9),
        np.array([[[1.0, -1.0, -1.0]], [[-1.0, 1.0, -1.0]]], dtype=np.float32),
    )
    field, camera = Gaussians(splats), Camera.pinhole(8.0, (4.0, 4.0), (8, 8))
    pixel = np.array([[4, 4]])
    behind = np.diag([-1.0, 1.0, -1.0, 1.0])  # looks back from the other side
    behind[2, 3] = 4.0
    green = field.show(camera, np.eye(4), pixel).values[0]
    red = field.show(camera, behind, pixel).values[0]
    assert green[1] > green[0]
    assert red[0] > red[1]
    swapped = field.show(camera, behind, pixel, kept=np.eye(4)).values[0]
    assert swapped[1] > swapped[0]


def test_splats_sorted_from_a_pose_keep_its_order_in_all_images() -> None:
    moved = POSE @ se3.exp([0.05, 0.0, 0.0, 0.02, 0.1, 0.0])
    free = Gaussians(odd_splats(), background=BACKGROUND)
    held = Gaussians(odd_splats(), background=BACKGROUND, sorted_from=POSE)
    kept = free.show(SMALL, moved, ALL, kept=POSE).values
    np.testing.assert_array_equal(held.show(SMALL, moved, ALL).values, kept)
    np.testing.assert_allclose(held.columns(SMALL, moved, ALL)[0], kept, atol=1e-6)
    assert np.abs(free.show(SMALL, moved, ALL).values - kept).max() > 1e-3
    assert held.provenance()["sorted from"] == POSE.tolist()


def test_nothing_is_seen_behind_the_camera_or_too_near() -> None:
    field = Gaussians(random_splats(), background=BACKGROUND)
    back = np.diag([-1.0, 1.0, -1.0, 1.0])
    shown = field.show(SMALL, back, ALL)
    np.testing.assert_allclose(shown.values, np.broadcast_to(BACKGROUND, (len(ALL), 3)), rtol=1e-6)
    assert np.isnan(shown.depth).all()
    assert (shown.opacity == 0.0).all()
    assert (field.columns(SMALL, back, ALL)[1] == 0.0).all()
    blind = Gaussians(random_splats(), near=50.0)
    assert (blind.show(SMALL, POSE, ALL).opacity == 0.0).all()
    assert field.show(SMALL, POSE, ALL[:0]).values.shape == (0, 3)


def test_scenes_far_from_the_origin_look_the_same() -> None:
    splats, far = random_splats(), np.array([4.2e5, -7.5e5, 120.0])
    moved = replace(splats, means=splats.means + far)
    pose = POSE.copy()
    pose[:3, 3] += far
    here = Gaussians(splats).columns(SMALL, POSE, ALL)[1]
    there = Gaussians(moved).columns(SMALL, pose, ALL)[1]
    assert np.abs(here - there).max() < 1e-4 * np.abs(here).max()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"variant": "sharp"}, "variant classic, antialiased, mip, not 'sharp'"),
        ({"background": (1.0, 2.0)}, "one number or three"),
        ({"background": "white"}, "one number or three"),
        ({"background": np.nan}, "one number or three"),
        ({"near": 0.0}, "positive depth"),
    ],
)
def test_wrong_options_are_refused_in_one_line(options: dict[str, object], message: str) -> None:
    with pytest.raises(FieldError, match=message):
        Gaussians(random_splats(3), **options)  # type: ignore[arg-type]


def test_lenses_that_no_rasteriser_draws_are_refused_by_name() -> None:
    field = Gaussians(random_splats(3), label="room.ply")
    bent = Intrinsics((24, 20), (26.0, 26.0), (12.0, 10.0), "opencv", (0.1, *[0.0] * 7))
    with pytest.raises(FieldError, match=r"room\.ply: .*distorts: undistort the photographs"):
        field.refuse(Camera.of(bent))
    with pytest.raises(FieldError, match="aperture"):
        field.show(replace(SMALL, radius=0.1, focus=2.0), POSE, ALL)
    with pytest.raises(FieldError, match="order of summation"):
        field.show(SMALL, POSE, ALL, order=2)


def test_splats_beyond_memory_are_refused_with_a_cure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(splat_tiles, "_MOST", 20)
    with pytest.raises(FieldError, match=r"more than 2e\+01 splats together.*smaller image \(--size\)"):
        Gaussians(random_splats()).show(SMALL, POSE, ALL)


def test_parts_that_are_tried_together_do_not_change_the_list(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = Gaussians(random_splats()).show(SMALL, POSE, ALL)
    monkeypatch.setattr(splat_tiles, "_CHUNK", 7)
    parts = Gaussians(random_splats()).show(SMALL, POSE, ALL)
    np.testing.assert_array_equal(parts.values, whole.values)


def test_what_the_image_depends_on_is_told() -> None:
    first, same, other = (Gaussians(random_splats(9, seed=seed)).provenance() for seed in (0, 0, 1))
    assert first == same
    assert first["fingerprint"] != other["fingerprint"]
    assert (first["splats"], first["degree"], first["variant"]) == (9, 1, "classic")


@pytest.mark.slow
@pytest.mark.parametrize("name", REAL)
def test_the_kernel_is_the_twin_of_real_splats(name: str, gaussians: Path) -> None:
    camera = real_camera(128)
    rows, columns = np.indices((12, 12))
    corner = np.array([58, 52])
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 2) + corner
    for variant, pose in zip(VARIANTS, real_views(name), strict=True):
        assert_twin(Gaussians(real_splats(name, gaussians), variant=variant), camera, pose, pixels)


@pytest.mark.slow
@pytest.mark.parametrize("name", REAL)
@pytest.mark.parametrize("view", range(3))
def test_each_column_of_real_splats_is_its_central_difference(name: str, view: int, gaussians: Path) -> None:
    camera, pose = real_camera(128), real_views(name)[view]
    field = load_gaussians(gaussians / REAL[name])
    pixels = pixels_of(camera)
    assert_slopes(field.columns(camera, pose, pixels)[1], differences(field, camera, pose, pixels))


def test_a_file_is_its_own_label(gaussians: Path) -> None:
    path = gaussians / "playbot_lod/playbot_lod5_3000.ply"
    field = load_gaussians(path, background=1.0)
    camera = real_camera(48)
    shown: Shown = field.show(camera, real_views("playbot")[0], pixels_of(camera))
    assert field.label == str(path)
    assert field.viewpoints == ()
    assert 0.2 < shown.opacity.mean() < 0.99
    assert np.nanmedian(shown.depth) == pytest.approx(1.6, abs=0.6)
