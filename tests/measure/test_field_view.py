"""Radiance fields under the bound: what scenes are asked, fields answer, without paths."""

from __future__ import annotations

import dataclasses
import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soft_blobs
from small_splats import write_splats
from soft_blobs import INTRINSICS, POSE

from mitsuba_crb import (
    Intrinsics,
    PosePrior,
    check_jacobian,
    fisher_information,
    hcr_bound,
    pose_bound,
    pose_bounds,
    pose_jacobian,
    pose_table,
    se3,
    tile_information,
    van_trees,
)
from mitsuba_crb.camera import Camera
from mitsuba_crb.errors import FieldError, NuisanceError, OptionError, PrecisionWarning, SensorError
from mitsuba_crb.estimate.align import align
from mitsuba_crb.estimate.trials import validate
from mitsuba_crb.noise import Gaussian
from mitsuba_crb.radiance import exact

SIGMA = Gaussian(0.01)
PIXELS = np.stack(np.meshgrid(np.arange(32), np.arange(24)), axis=-1).reshape(-1, 2)


def _closed_form(field: Any, sigma: float = 0.01) -> np.ndarray:
    """(6, 6), of all pixels of `POSE`."""
    _, columns = field.columns(Camera.of(INTRINSICS), POSE, PIXELS)
    return np.einsum("nci,ncj->ij", columns, columns) / sigma**2


def _stds(bound: Any) -> np.ndarray:
    return np.concatenate([bound.position_std, bound.rotation_std_deg])


def test_the_bound_is_that_of_the_fields_own_columns() -> None:
    field = soft_blobs.many()
    bound = pose_bound(field, SIGMA)
    F = _closed_form(field)
    np.testing.assert_allclose(bound.information.matrix, F, rtol=1e-10, atol=1e-10 * np.abs(F).max())
    C = np.linalg.inv(F)
    R = POSE[:3, :3]
    np.testing.assert_allclose(bound.position_std, np.sqrt(np.diag(R @ C[:3, :3] @ R.T)), rtol=1e-9)
    np.testing.assert_allclose(bound.rotation_std_deg, np.degrees(np.sqrt(np.diag(C)[3:])), rtol=1e-9)
    facts = bound.provenance
    assert (facts["method"], facts["deterministic"], facts["spp"]) == ("exact", True, 0)
    assert "sampling" not in facts
    assert facts["sensor"] == "view0"
    assert facts["field"] == {"model": "blobs", "blobs": 40}
    assert facts["noise"]["unit"] == facts["measures"]["unit"] == "display-referred"
    json.dumps({key: value for key, value in facts.items() if key != "pixels"}, default=list)


def test_paths_and_tiles_and_subsets_mean_nothing_to_it() -> None:
    field = soft_blobs.many(rounding=1e-6)
    whole = pose_bound(field, SIGMA)
    for options in ({"spp": 8}, {"precision": 0.001}, {"seed": 7}, {"tile": 16}):
        found = pose_bound(field, SIGMA, **options).information.matrix
        np.testing.assert_allclose(found, whole.information.matrix, rtol=1e-12)
    left = np.zeros((24, 32), dtype=bool)
    left[:, :16] = True
    parts = [pose_bound(field, SIGMA, pixels=mask).information.matrix for mask in (left, ~left)]
    np.testing.assert_allclose(parts[0] + parts[1], whole.information.matrix, rtol=1e-9)
    again = pose_bound(field, SIGMA).information.matrix
    assert np.array_equal(again, whole.information.matrix)


def test_rounding_is_the_only_error_and_is_stated() -> None:
    """Errors of 24 draws of it, over those that are stated, have the root mean square 1, within a half."""
    true = _stds(pose_bound(soft_blobs.many(), SIGMA))
    found = [pose_bound(soft_blobs.many(rounding=1e-4, draw=k), SIGMA) for k in range(1, 25)]
    errors = np.array([bound.relative_standard_error for bound in found])
    off = np.array([_stds(bound) for bound in found]) / true - 1.0
    assert np.all(errors < 1e-2)
    ratio = np.sqrt(np.mean((off / errors) ** 2, axis=0))
    assert np.all((ratio > 0.6) & (ratio < 1.6)), ratio


def test_a_turn_that_changes_nothing_is_unseen_whatever_the_rounding() -> None:
    """Rounding of 1e-6 and 1e-4 of the largest column in every pixel of the roll's, which is zero."""
    for rounding in (0.0, 1e-6, 1e-4):
        bound = pose_bound(soft_blobs.target(rounding=rounding), SIGMA)
        assert np.isinf(bound.rotation_std_deg[2])
        assert np.isfinite(bound.rotation_std_deg[:2]).all()
        assert bound.rank == 5


def test_a_turn_that_changes_little_is_seen() -> None:
    """A faint blob off the axis: the roll's information is some 1e-6 of the pitch's."""
    field = soft_blobs.target(faint=1e-2, rounding=1e-6)
    bound = pose_bound(field, SIGMA)
    assert bound.rank == 6
    F = np.diag(bound.information.matrix)
    assert F[5] < 1e-4 * F[3]
    assert bound.relative_standard_error[5] < 0.01


def test_batches_that_repeat_the_orders_would_see_rounding(monkeypatch: pytest.MonkeyPatch) -> None:
    """Negative control of the construction of batches."""
    monkeypatch.setattr(
        exact, "as_batches", lambda orders, batches: np.resize(orders, (batches, *orders.shape[1:]))
    )
    assert np.isfinite(pose_bound(soft_blobs.target(rounding=1e-4), SIGMA).rotation_std_deg[2])


def test_differences_agree_and_their_step_is_stated() -> None:
    field = soft_blobs.many()
    bounds = [pose_bound(field, SIGMA, method="finite_difference", step_pixels=h) for h in (0.05, 0.4)]
    true = _closed_form(field)
    for bound, most in zip(bounds, (5e-3, 0.2), strict=True):
        ratio = np.diag(bound.information.matrix) / np.diag(true)
        assert np.all(np.abs(ratio - 1.0) < most)
    off = 1.0 - np.trace(bounds[1].information.matrix[3:, 3:]) / np.trace(true[3:, 3:])
    stated = np.sqrt(np.diag(bounds[1].information.covariance_of_entries))[-1] / true[5, 5]
    assert 0.3 < stated / off < 3.0


def test_check_agrees_and_finds_columns_that_are_wrong() -> None:
    """The control: one column is too large by a tenth."""
    found = check_jacobian(soft_blobs.many(rounding=1e-7))
    assert (found.verdict, found.exit_code, found.spp, found.paths) == ("agree", 0, None, None)
    assert found.detectable < 0.01
    wrong = check_jacobian(soft_blobs.many(scaled=(1.0, 1.0, 1.1, 1.0, 1.0, 1.0)))
    assert (wrong.verdict, wrong.exit_code) == ("disagree", 1)
    assert wrong.rows[0].disagrees.tolist() == [False, False, True, False, False, False]
    with pytest.raises(OptionError, match="methods to check: exact; got flow"):
        check_jacobian(soft_blobs.many(), methods=("flow",))


def test_the_default_noise_is_a_hundredth_of_a_white_that_is_one() -> None:
    field = soft_blobs.many()
    bound = pose_bound(field)
    facts = bound.provenance["noise"]
    assert facts["origin"] == "0.01 of white 1 (display-referred)"
    assert (facts["sigma"], facts["white"]) == (0.01, 1.0)
    image = field.show(Camera.of(INTRINSICS), POSE, PIXELS).values
    assert (image > 1.0).any()
    assert facts["saturated"] == pytest.approx(np.mean(image > 1.0), abs=0.02)
    assert pose_bound(field, exposure=2.0).provenance["noise"]["sigma"] == 0.02
    open_ended = pose_bound(field, clip=False)
    np.testing.assert_allclose(open_ended.information.matrix, pose_bound(field, SIGMA).information.matrix)


def test_an_unknown_gain_costs_what_the_closed_form_says() -> None:
    field = soft_blobs.many()
    bound = pose_bound(field, SIGMA, nuisances=("gain", "black"))
    image, columns = field.columns(Camera.of(INTRINSICS), POSE, PIXELS)
    J = np.concatenate([columns, image[..., None], np.ones((*image.shape, 1))], axis=2).reshape(-1, 8)
    C = np.linalg.inv(J.T @ J / 0.01**2)
    np.testing.assert_allclose(bound.rotation_std_deg, np.degrees(np.sqrt(np.diag(C)[3:6])), rtol=1e-6)
    assert set(bound.if_known) >= {"gain", "black"}


@pytest.mark.parametrize("name", ["fx", "fy", "cx", "cy", "fov"])
def test_intrinsics_are_nuisances(name: str) -> None:
    """Their columns are those of an image seen through another camera."""
    field = soft_blobs.many()
    jacobian = pose_jacobian(field, nuisances=(name,))
    column = (
        jacobian.values[..., 6:]
        if jacobian.values.shape[-1] > 6
        else jacobian.batch_values[..., 6:].mean(axis=0)
    )
    h = 1e-4

    def image(by: float) -> np.ndarray:
        if name == "fov":
            half = np.radians(0.5 * INTRINSICS.plain_fov_deg)
            longer = np.tan(half) / np.tan(half + np.radians(0.5 * by))
            focal = (INTRINSICS.focal[0] * longer, INTRINSICS.focal[1] * longer)
            other = dataclasses.replace(INTRINSICS, focal=focal)
        else:
            other = INTRINSICS.moved(name, by)
        return field.show(Camera.of(other), POSE, jacobian.pixels).values

    expected = (image(h) - image(-h)) / (2.0 * h)
    assert np.abs(column[..., 0] - expected).max() < 3e-3 * np.abs(expected).max()


def test_names_that_are_none_of_a_fields_nuisances_are_refused() -> None:
    with pytest.raises(NuisanceError, match=r"is named light\.radiance\.value; there are: gain"):
        pose_bound(soft_blobs.many(), SIGMA, nuisances=("light.radiance.value",))
    with pytest.raises(NuisanceError, match="near ones: gain"):
        pose_bound(soft_blobs.many(), SIGMA, nuisances=("gains",))
    with pytest.raises(NuisanceError, match="coefficient"):
        pose_bound(soft_blobs.many(), SIGMA, nuisances=("k1",))


def test_a_field_is_seen_by_a_camera_that_is_given_or_that_it_comes_with() -> None:
    field = soft_blobs.many(viewpoints=soft_blobs.viewpoints(3))
    second = pose_bound(field, SIGMA, sensor=1)
    assert second.provenance["sensor"] == "view1"
    named = pose_bound(field, SIGMA, sensor="view1")
    assert np.array_equal(named.information.matrix, second.information.matrix)
    bare = soft_blobs.many(viewpoints=())
    given = pose_bound(bare, SIGMA, camera=INTRINSICS, pose=soft_blobs.viewpoints(2)[1].pose)
    np.testing.assert_allclose(given.information.matrix, second.information.matrix, rtol=1e-9)
    small = pose_bound(field, SIGMA, size=(16, 12))
    assert small.provenance["size"] == [16, 12]
    with pytest.raises(SensorError, match="comes with 3 cameras, none of which is 3"):
        pose_bound(field, SIGMA, sensor=3)
    with pytest.raises(SensorError, match="such as view"):
        pose_bound(field, SIGMA, sensor="vew1")
    for options in ({"camera": INTRINSICS}, {"pose": POSE}, {}):
        with pytest.raises(FieldError, match=r"comes with no camera: .*--camera FILE.*--pose"):
            pose_bound(bare, SIGMA, **options)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"measure": "depth"}, "whose depth is not measured"),
        ({"measure": "rgbd"}, "whose depth is not measured"),
        ({"integrator": "path"}, "has no integrator"),
        ({"method": "flow"}, "methods: exact, finite_difference"),
        (
            {"camera": dataclasses.replace(INTRINSICS, model="opencv", distortion=(0.1,) + 7 * (0.0,))},
            "undistort",
        ),
        ({"camera": Intrinsics((40, 40), (30.0, 30.0), (20.0, 20.0)), "size": (32, 24)}, "another shape"),
    ],
)
def test_what_a_field_has_not_is_refused_in_a_line(options: dict[str, Any], words: str) -> None:
    from mitsuba_crb.errors import MitsubaCRBError

    with pytest.raises(MitsubaCRBError, match=words) as caught:
        pose_bound(soft_blobs.many(), SIGMA if "measure" not in options else None, **options)
    assert "\n" not in str(caught.value)


def test_where_nothing_is_visible_it_says_why() -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        bound = pose_bound(soft_blobs.many(), SIGMA, pose=POSE @ se3.exp([0, 0, 0, 0, np.pi, 0]))
    assert bound.rank == 0
    assert any("looks away" in str(warning.message) for warning in caught)


def test_many_poses_are_rows_of_one_white(tmp_path: Path) -> None:
    field = soft_blobs.many(viewpoints=soft_blobs.viewpoints(3))
    poses = [viewpoint.pose for viewpoint in field.viewpoints]
    alone = [pose_bound(field, sensor=k) for k in range(3)]
    for bound, other in zip(pose_bounds(field, poses), alone, strict=True):
        assert np.array_equal(bound.information.matrix, other.information.matrix)
    table = pose_table(field, poses, names=["a", "b", "c"])
    assert table.settings["white"] == 1.0
    assert (table.settings["method"], table.settings["deterministic"]) == ("exact", True)
    assert [row.rank for row in table.rows] == [6, 6, 6]
    other = pose_table(soft_blobs.many(count=41, viewpoints=field.viewpoints), poses)
    assert other.settings["scene_contents"] != table.settings["scene_contents"]


def test_alignment_recovers_the_pose() -> None:
    field = soft_blobs.many()
    rng = np.random.default_rng(3)
    clean = field.show(Camera.of(INTRINSICS), POSE, PIXELS).values.reshape(24, 32, 3)
    start = POSE @ se3.exp([0.02, -0.01, 0.02, 0.003, 0.004, -0.003])
    exact_end = align(field, clean, SIGMA, pose=start)
    assert exact_end.status == "converged"
    found = align(field, clean + 0.01 * rng.standard_normal(clean.shape), SIGMA, pose=start)
    assert found.status == "converged"
    assert found.residual == pytest.approx(1.0, abs=0.1)
    assert abs(found.excess) < 1e-9
    error = se3.log(se3.inverse(POSE) @ found.pose)
    nees = error @ _closed_form(field) @ error
    assert nees < 22.5  # 99.9 % of χ² with 6 degrees of freedom


def test_trials_attain_the_bound_and_not_that_of_half_the_noise() -> None:
    options: dict[str, Any] = {"perturb_deg": 0.3, "perturb_trans": 0.01, "sigma": 0.01}
    result = validate(soft_blobs.many(), trials=16, confidence=0.999, **options)
    assert result.settings["spp"] == 0
    assert abs(result.excess) < 1e-6
    assert not result.failed
    assert result.verdict == "consistent"
    half = validate(soft_blobs.many(), trials=16, assumed_sigma=0.005, confidence=0.999, **options)
    assert half.verdict == "inconsistent"


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["blobs", "splats"])
def test_many_trials_attain_the_bound_and_not_that_of_half_the_noise(kind: str, tmp_path: Path) -> None:
    """200 trials, bands of 99.9 %."""
    field = soft_blobs.many() if kind == "blobs" else write_splats(tmp_path)
    options: dict[str, Any] = {"perturb_deg": 0.3, "perturb_trans": 0.01, "sigma": 0.01}
    file = tmp_path / "trials.json"
    result = validate(field, trials=200, confidence=0.999, resume=file, **options)
    assert (result.verdict, result.failed) == ("consistent", ())
    assert result.efficiency == pytest.approx(1.0, abs=0.15)
    half = validate(field, trials=200, assumed_sigma=0.005, confidence=0.999, resume=file, **options)
    assert half.verdict == "inconsistent"


def test_displaced_images_and_tiles_are_measured() -> None:
    field = soft_blobs.many()
    beyond = hcr_bound(field, SIGMA, displacements=0.01 * np.eye(6))
    local = pose_bound(field, SIGMA)
    assert np.all(beyond.position_std >= 0.99 * local.position_std)
    tiles = tile_information(field, SIGMA, tile_size=8)
    np.testing.assert_allclose(
        tiles.report.sum(axis=0), tiles.select.sum(axis=0), rtol=1e-6, atol=1e-6 * np.abs(tiles.select).max()
    )
    assert len(tiles.tiles) == 12


def test_streaming_equals_assembling() -> None:
    field = soft_blobs.many(rounding=1e-6)
    bound = pose_bound(field, SIGMA)
    assembled = fisher_information(pose_jacobian(field), SIGMA)
    np.testing.assert_allclose(assembled.matrix, bound.information.matrix, rtol=1e-12)
    with warnings.catch_warnings():
        warnings.simplefilter("error", PrecisionWarning)
        pose_bound(field, SIGMA, pixels="random:0.9")


def test_whatever_scenes_are_asked_fields_are_asked() -> None:
    field = soft_blobs.many()
    colour, grey = pose_bound(field, SIGMA), pose_bound(field, SIGMA, channels="luminance")
    assert np.all(np.diag(grey.information.matrix) < np.diag(colour.information.matrix))
    rich = pose_bound(field, SIGMA, pixels="gradient:0.25").information.matrix
    assert np.all(np.diag(rich) > 0.5 * np.diag(colour.information.matrix))
    assert np.all(np.diag(rich) < np.diag(colour.information.matrix))
    prior = PosePrior(1e6 * np.eye(6), "camera")
    mean = van_trees(field, SIGMA, prior, draws=4)
    assert np.all(mean.position_std < colour.position_std * 1.2)
