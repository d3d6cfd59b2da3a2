"""The bound: F⁻¹ where the image sees, infinity where it does not, and words for the latter.

Oracles: closed forms, NumPy's inverse, poses drawn from the bound, and repeated noisy estimates.
"""

from __future__ import annotations

import dataclasses
import json
import re
import warnings
from typing import ClassVar

import numpy as np
import pytest
from matrices import misfit
from rigs import about, made
from scipy.spatial.transform import Rotation

from mitsuba_crb import se3
from mitsuba_crb.bound.cramer_rao import cramer_rao_bound
from mitsuba_crb.errors import FrameError, OptionError, PrecisionWarning
from mitsuba_crb.export.documents import bound_document
from mitsuba_crb.information.accumulate import InformationAccumulator
from mitsuba_crb.information.identifiability import identify
from mitsuba_crb.information.linearisation import PixelSelection
from mitsuba_crb.information.symmetric import pack, unpack

PIXELS = 5000
"""Fewer of them do not tell an axis from a null direction that noise has tilted towards it."""

POSE = se3.exp([1.0, -2.0, 0.5, 0.4, -0.3, 0.8])
R = POSE[:3, :3]


def _information(matrix, covariance=None, **changes):
    return made(matrix, covariance, **({"pose": POSE, "length_scale": 1.0} | changes))


def _random(seed, rank=6, strength=1e4):
    J = np.random.default_rng(seed).normal(size=(30, rank)) * np.sqrt(strength)
    Q = np.linalg.qr(np.random.default_rng(seed + 100).normal(size=(6, 6)))[0][:, :rank]
    return Q @ J.T @ J @ Q.T


def _without(*directions, strength=1e4, seed=0):
    """An exact information that sees everything but some directions."""
    N = np.linalg.qr(np.array(directions, dtype=float).T)[0]
    S = np.eye(6) - N @ N.T
    return S @ _random(seed, strength=strength) @ S


def _noisy(J, noise, rng, *, pose=POSE, length_scale=1.0):
    """A batched estimate of JᵀJ with independent errors, J (n, 3, 6)."""
    n = len(J)
    accumulator = InformationAccumulator(batches=4)
    values = J + noise * rng.normal(size=(4, *J.shape))
    accumulator.add(values, np.ones(J.shape[:2]), np.stack([np.arange(n), np.zeros(n, int)], axis=1))
    selection = PixelSelection("all", n, n, "all")
    return accumulator.information(about(pose=pose, length_scale=length_scale, selection=selection))


def _quietly(information, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PrecisionWarning)
        return cramer_rao_bound(information, **options)


class TestFullRank:
    def test_covariance_is_the_inverse(self):
        F = _random(1)
        bound = cramer_rao_bound(_information(F))
        assert misfit(bound.covariance, np.linalg.inv(F)) < 1e-10
        assert misfit(bound.seen_covariance, bound.covariance) < 1e-10
        assert (bound.rank, bound.unobserved, bound.frame) == (6, (), "camera")

    def test_a_diagonal_information_has_closed_form_answers(self):
        bound = cramer_rao_bound(_information(np.diag([1.0, 4, 9, 16, 25, 36]), pose=np.eye(4)))
        np.testing.assert_allclose(bound.position_std, [1, 1 / 2, 1 / 3])
        np.testing.assert_allclose(bound.rotation_std_deg, np.degrees([1 / 4, 1 / 5, 1 / 6]))
        np.testing.assert_allclose(bound.eigenvalues, [36, 25, 16, 9, 4, 1])
        assert np.all(bound.eigenvalues_standard_error == 0.0)

    def test_eigenvalues_count_translation_in_length_scales(self):
        bound = cramer_rao_bound(_information(np.diag([1.0, 4, 9, 16, 25, 36]), length_scale=10.0))
        np.testing.assert_allclose(bound.eigenvalues, [900, 400, 100, 36, 25, 16])

    def test_reports_are_the_spread_of_poses_drawn_from_the_bound(self):
        """20000 draws give standard deviations to 0.5 %; six of them stay within 2 %."""
        F = _random(2, strength=1e6)
        bound = cramer_rao_bound(_information(F))
        twists = np.random.default_rng(3).multivariate_normal(np.zeros(6), bound.covariance, 20000)
        poses = POSE @ se3.exp(twists)
        np.testing.assert_allclose(poses[:, :3, 3].std(axis=0), bound.position_std, rtol=0.02)
        turns = Rotation.from_matrix(R.T @ poses[:, :3, :3]).as_rotvec(degrees=True)
        np.testing.assert_allclose(turns.std(axis=0), bound.rotation_std_deg, rtol=0.02)
        scale = np.outer(bound.position_std, bound.position_std)
        np.testing.assert_allclose(
            np.cov(poses[:, :3, 3].T) / scale, bound.position_covariance / scale, atol=0.05
        )
        # Negative control: ρ of the world frame is not the camera centre.
        world = cramer_rao_bound(_information(F).to_frame("world"))
        wrong = np.sqrt(np.diagonal(world.covariance)[:3])
        assert np.abs(poses[:, :3, 3].std(axis=0) / wrong - 1.0).max() > 0.1

    @pytest.mark.parametrize("length_scale", [1e-3, 1.0, 50.0])
    def test_the_length_scale_does_not_change_the_reports(self, length_scale):
        bound = cramer_rao_bound(_information(_random(1), length_scale=length_scale))
        reference = cramer_rao_bound(_information(_random(1)))
        # In units of 1e-3 lengths the matrix that is inverted has 1e6 times the condition number.
        np.testing.assert_allclose(bound.position_std, reference.position_std, rtol=1e-8)
        assert misfit(bound.covariance, reference.covariance) < 1e-8

    def test_mixed_units_keep_their_digits(self):
        """A scene in millimetres seen from 10 m: entries of F differ by 1e14."""
        scale = np.diag([1e-6] * 3 + [10.0] * 3)
        F = scale @ _random(4) @ scale
        bound = cramer_rao_bound(_information(F, length_scale=1e7))
        np.testing.assert_allclose(bound.covariance @ F, np.eye(6), atol=1e-6)


class TestFrames:
    @pytest.mark.parametrize("rank", [6, 5])
    def test_the_frame_turns_matrices_and_nothing_else(self, rank):
        information = _information(_random(5, rank=rank), 1e-6 * np.eye(21), length_scale=3.0)
        camera = cramer_rao_bound(information)
        world = cramer_rao_bound(information.to_frame("world"))
        for name in ("position_std", "rotation_std_deg", "eigenvalues", "position_std_standard_error"):
            np.testing.assert_array_equal(getattr(world, name), getattr(camera, name))
        assert (world.frame, world.information.frame, world.rank) == ("world", "world", camera.rank)
        A = se3.adjoint(POSE)
        assert misfit(world.seen_covariance, A @ camera.seen_covariance @ A.T) < 1e-8
        if rank == 6:
            assert misfit(world.covariance, np.linalg.inv(world.information.matrix)) < 1e-8

    @pytest.mark.parametrize("unseen", [(), ([1, 0, 0, 0, 0, 0],), ([0.3, 0.5, 0, 0, 1, 0],)])
    def test_ten_kilometres_away_the_answer_is_the_same(self, unseen):
        F = _without(*unseen) if unseen else _random(6)
        far = POSE.copy()
        far[:3, 3] += [1e4, -8e3, 3e3]
        near = cramer_rao_bound(_information(F))
        for frame in ("camera", "world"):
            bound = cramer_rao_bound(_information(F, pose=far).to_frame(frame))
            np.testing.assert_array_equal(bound.position_std, near.position_std)
            np.testing.assert_array_equal(bound.rotation_std_deg, near.rotation_std_deg)
            assert [u.description for u in bound.unobserved] == [u.description for u in near.unobserved]

    def test_scene_units_scale_the_answer_and_not_the_rank(self):
        rng = np.random.default_rng(7)
        J = rng.normal(size=(200, 3, 6)) @ np.diag([1, 1, 0.0, 1, 1, 1])
        metres = _noisy(J, 0.3, rng, length_scale=2.0)
        scale = np.diag([0.01] * 3 + [1.0] * 3)
        pose = POSE.copy()
        pose[:3, 3] *= 100.0
        T = np.stack([pack(scale @ E @ scale) for E in unpack(np.eye(21))], axis=1)
        centimetres = dataclasses.replace(
            metres,
            matrix=scale @ metres.matrix @ scale,
            covariance_of_entries=T @ metres.covariance_of_entries @ T.T,
        ).about(pose=pose, length_scale=200.0)
        a, b = _quietly(metres), _quietly(centimetres)
        assert a.rank == b.rank == 5
        np.testing.assert_allclose(b.position_std, 100.0 * a.position_std, rtol=1e-9)
        np.testing.assert_allclose(b.rotation_std_deg, a.rotation_std_deg, rtol=1e-9)
        np.testing.assert_allclose(b.eigenvalues, a.eigenvalues, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(
            b.position_std_standard_error, 100.0 * a.position_std_standard_error, rtol=1e-9
        )


class TestRank:
    """Pure noise must pass for information in at most 1 % of cases, whatever else is seen."""

    @pytest.mark.slow
    @pytest.mark.parametrize(("rank", "noise"), [(0, 1.0), (3, 0.3), (3, 2.0), (5, 0.3), (5, 2.0)])
    def test_noise_is_not_taken_for_information(self, rank, noise):
        rng = np.random.default_rng(8)
        Q = np.linalg.qr(rng.normal(size=(6, 6)))[0][:, :rank]
        J = rng.normal(size=(150, 3, rank)) @ np.diag(np.linspace(1, 3, rank)) @ Q.T
        ranks = [_rank(_noisy(J, noise, rng)) for _ in range(150)]
        # At 1 % each, 6 or more of 150 have a probability of 0.5 %.
        assert sum(r > rank for r in ranks) < 6
        # What is there is seen.
        assert np.mean(np.array(ranks) == rank) > 0.9

    @pytest.mark.slow
    def test_a_fixed_number_of_standard_errors_would_take_it(self):
        """Negative control: with the rule that the design rejects some eigenvalue passes in 81 % of cases."""
        rng = np.random.default_rng(9)
        covariance = np.diag(pack(0.5 + 0.5 * np.eye(6)))
        fooled, right = 0, 0
        for noise in unpack(rng.multivariate_normal(np.zeros(21), covariance, 150)):
            bound = _quietly(_information(noise, covariance))
            fooled += bool(np.any(bound.eigenvalues > 2 * bound.eigenvalues_standard_error))
            right += bound.rank == 0
        assert fooled > 0.7 * 150
        assert right >= 0.96 * 150

    def test_the_threshold_is_the_quantile_of_the_largest_noise_eigenvalue(self):
        """Second oracle: a fresh sample. 20000 draws and 4096 inside give the 99 % quantile to about 1 %."""
        root = np.random.default_rng(10).normal(size=(21, 21))
        covariance = root @ root.T
        found = identify(np.zeros((6, 6)), covariance)
        noise = unpack(np.random.default_rng(11).multivariate_normal(np.zeros(21), covariance, 20000))
        assert found.threshold == pytest.approx(np.quantile(np.linalg.eigvalsh(noise)[:, -1], 0.99), rel=0.05)
        assert found.rank == 0

    def test_the_same_information_gives_the_same_rank_and_numbers(self):
        information = _noisy(
            np.random.default_rng(12).normal(size=(50, 3, 6)), 0.5, np.random.default_rng(13)
        )
        np.testing.assert_array_equal(_quietly(information).covariance, _quietly(information).covariance)

    def test_float32_rendering_has_a_floor(self):
        assert cramer_rao_bound(_information(np.diag([1.0, 1, 1, 1, 1, 2e-9]))).rank == 6
        assert cramer_rao_bound(_information(np.diag([1.0, 1, 1, 1, 1, 0.5e-9]))).rank == 5

    def test_nothing_seen_has_rank_zero_and_no_finite_number(self):
        for matrix in (np.zeros((6, 6)), -np.eye(6)):
            bound = cramer_rao_bound(_information(matrix))
            assert bound.rank == 0
            assert np.isinf(bound.position_std).all()
            assert np.isinf(bound.rotation_std_deg).all()
            assert np.isnan(bound.position_std_standard_error).all()
            np.testing.assert_array_equal(bound.seen_covariance, 0.0)


def _rank(information):
    return identify(information.matrix, information.covariance_of_entries).rank


class TestUnseenDirections:
    def test_an_unseen_axis_is_infinite_and_the_seen_block_exact(self):
        F = _without([0, 1, 0, 0, 0, 0])
        bound = cramer_rao_bound(_information(F, pose=np.eye(4)))
        np.testing.assert_array_equal(np.isinf(bound.position_std), [False, True, False])
        assert np.isfinite(bound.rotation_std_deg).all()
        seen = [0, 2, 3, 4, 5]
        inverse = np.linalg.inv(F[np.ix_(seen, seen)])
        assert misfit(bound.covariance[np.ix_(seen, seen)], inverse) < 1e-9
        assert bound.covariance[1, 1] == np.inf
        assert np.isnan(bound.covariance[1, seen]).all()
        assert np.isnan(bound.covariance[seen, 1]).all()

    def test_every_axis_that_the_unseen_direction_touches_is_infinite(self):
        bound = cramer_rao_bound(_information(_without([0.8, 0, 0, 0, 0.6, 0]), pose=np.eye(4)))
        np.testing.assert_array_equal(np.isinf(bound.position_std), [True, False, False])
        np.testing.assert_array_equal(np.isinf(bound.rotation_std_deg), [False, True, False])

    def test_reports_follow_world_axes_for_position_and_camera_axes_for_rotation(self):
        along_world_y = np.concatenate([R[1], np.zeros(3)])
        bound = cramer_rao_bound(_information(_without(along_world_y)))
        np.testing.assert_array_equal(np.isinf(bound.position_std), [False, True, False])
        assert np.isinf(np.diagonal(bound.covariance)[:3]).all()  # ρ in the camera's axes is mixed

    @pytest.mark.slow
    def test_noise_leaves_no_plausible_number_on_an_unseen_direction(self):
        """A mixed null direction, noisy estimates: both axes are infinite but for the rank rule's 1 %."""
        rng = np.random.default_rng(14)
        N = np.array([0.8, 0, 0, 0, 0.6, 0])
        J = rng.normal(size=(PIXELS, 3, 6)) @ (np.eye(6) - np.outer(N, N))
        plausible, spurious, naive = 0, 0, []
        for _ in range(100):
            information = _noisy(J, 0.3, rng, pose=np.eye(4))
            bound = _quietly(information)
            plausible += not (np.isinf(bound.position_std[0]) and np.isinf(bound.rotation_std_deg[1]))
            spurious += not np.isfinite([*bound.position_std[1:], *bound.rotation_std_deg[::2]]).all()
            naive.append(np.sqrt(abs(np.linalg.inv(information.matrix)[0, 0])))
        # At 1 % each, 5 or more of 100 have a probability of 0.3 %; so have 3 errors on any of 4 axes.
        assert plausible < 5
        assert spurious < 5
        # Negative control: the plain inverse gives a finite number some ten times the neighbour's.
        assert np.median(naive) < 100 * bound.position_std[1]

    @pytest.mark.parametrize("tilt", [0.0, 1e-6, 1e-3, 0.0099])
    def test_a_small_share_is_finite_and_adds_share_squared_over_the_threshold(self, tilt):
        direction = np.array([tilt, np.sqrt(1 - tilt**2), 0, 0, 0, 0])
        F = _without(direction)
        bound = cramer_rao_bound(_information(F, pose=np.eye(4)))
        threshold = 1e-9 * bound.eigenvalues[0]
        expected = np.linalg.pinv(F, rcond=1e-10)[0, 0] + tilt**2 / threshold
        np.testing.assert_allclose(bound.position_std[0] ** 2, expected, rtol=1e-5)
        assert np.isinf(bound.position_std[1])
        pseudo_inverse = np.linalg.pinv(F, rcond=1e-10)[0, 0]
        if tilt > 1e-4:
            assert bound.position_std[0] > 2 * np.sqrt(pseudo_inverse)

    def test_a_share_above_one_percent_is_infinite(self):
        direction = np.array([0.0101, np.sqrt(1 - 0.0101**2), 0, 0, 0, 0])
        bound = cramer_rao_bound(_information(_without(direction), pose=np.eye(4)))
        np.testing.assert_array_equal(np.isinf(bound.position_std), [True, True, False])

    @pytest.mark.slow
    def test_a_share_that_noise_explains_is_not_infinite(self):
        """One null direction, an axis: noise tilts it by more than 0.01, but the other axes stay finite."""
        rng = np.random.default_rng(15)
        J = rng.normal(size=(PIXELS, 3, 6)) @ np.diag([1, 0.0, 1, 1, 1, 1])
        J[100:] = 0.0  # few pixels see; all have noise along the null direction
        noise = np.where(np.arange(6) == 1, 0.6, 0.05)
        tilts, spurious = [], 0
        for _ in range(100):
            information = _noisy(J, noise, rng, pose=np.eye(4))
            bound = _quietly(information)
            others = np.concatenate([bound.position_std[[0, 2]], bound.rotation_std_deg])
            spurious += np.isinf(others).any()
            tilts.extend(np.abs(np.delete(u.direction, 1)).max() for u in bound.unobserved)
        assert len(tilts) >= 96
        assert np.median(tilts) > 0.02
        # Beyond three standard errors on one of 5 axes: 1.3 % of runs.
        assert spurious <= 5

    @pytest.mark.slow
    def test_standard_error_of_a_share_is_the_scatter_of_repetitions(self):
        rng = np.random.default_rng(16)
        J = rng.normal(size=(150, 3, 6)) @ np.diag([1, 0.0, 1, 1, 1, 1])
        shares, errors = [], []
        for _ in range(150):
            information = _noisy(J, 0.4, rng)
            found = identify(information.matrix, information.covariance_of_entries)
            if found.rank != 5:
                continue
            n, s = found.unseen[:, 0], found.seen[3]
            shares.append(n[3] * np.sign(n[1]))
            errors.append(np.sqrt(np.einsum("s,sntm,t->", s, found.tilt_covariance, s)))
        assert len(shares) > 140
        assert np.mean(errors) == pytest.approx(np.std(shares), rel=0.25)


class TestWords:
    AXES: ClassVar = {
        "translation along world axis x": [*R[0], 0, 0, 0],
        "translation along world axis y": [*R[1], 0, 0, 0],
        "translation along world axis z": [*R[2], 0, 0, 0],
        "translation along the camera's x axis": [1, 0, 0, 0, 0, 0],
        "translation along the camera's y axis": [0, 1, 0, 0, 0, 0],
        "translation along the optical axis": [0, 0, 1, 0, 0, 0],
        "rotation about the camera's x axis (pitch)": [0, 0, 0, 1, 0, 0],
        "rotation about the camera's y axis (yaw)": [0, 0, 0, 0, 1, 0],
        "rotation about the optical axis (roll)": [0, 0, 0, 0, 0, 1],
        "rotation about world axis z through the camera": [0, 0, 0, *R[2]],
        "translation along (0.71, 0.71, 0) in the world": [*(R[0] + R[1]), 0, 0, 0],
        "translation along (0.71, 0, -0.71) in the world": [*(R[0] - R[2]), 0, 0, 0],
        "rotation about (0.71, 0.71, 0) in the camera's axes": [0, 0, 0, 1, 1, 0],
        "a rotation about the camera's y axis (yaw) together with a translation along the camera's x axis, "
        "0.0524 scene units per degree": [3, 0, 0, 0, 1, 0],
        "a rotation about the optical axis (roll) together with a translation against world axis y, "
        "0.0175 scene units per degree": [*-R[1], 0, 0, 1],
        "a rotation about world axis y through the camera together with a translation along (0.6, 0, 0.8) "
        "in the world, 0.175 scene units per degree": [*(6 * R[0] + 8 * R[2]), *R[1]],
    }

    @pytest.mark.parametrize("sign", [1.0, -1.0])
    @pytest.mark.parametrize("words", AXES)
    def test_one_unseen_direction(self, words, sign):
        direction = sign * np.asarray(self.AXES[words], dtype=float)
        bound = cramer_rao_bound(_information(_without(direction), length_scale=2.0))
        (unseen,) = bound.unobserved
        assert unseen.description == words
        scaled = direction / [2, 2, 2, 1, 1, 1]
        scaled /= np.linalg.norm(scaled)
        assert abs(unseen.direction @ scaled) == pytest.approx(1.0)
        assert np.linalg.norm(unseen.direction) == pytest.approx(1.0)

    def test_world_axes_are_preferred_for_translation_and_camera_axes_for_rotation(self):
        for direction, words in (
            ([0, 1, 0, 0, 0, 0], "translation along world axis y"),
            ([0, 0, 0, 0, 1, 0], "rotation about the camera's y axis (yaw)"),
        ):
            bound = cramer_rao_bound(_information(_without(direction), pose=np.eye(4)))
            assert bound.unobserved[0].description == words

    def test_rank_zero_names_six_axes(self):
        bound = cramer_rao_bound(_information(np.zeros((6, 6))))
        assert [u.description for u in bound.unobserved] == [
            "translation along world axis x",
            "translation along world axis y",
            "translation along world axis z",
            "rotation about the camera's x axis (pitch)",
            "rotation about the camera's y axis (yaw)",
            "rotation about the optical axis (roll)",
        ]

    def test_no_translation_at_all_is_said_so(self):
        bound = cramer_rao_bound(_information(np.diag([0, 0, 0, 1.0, 2, 3])))
        assert [u.description for u in bound.unobserved] == [
            f"translation in any direction: along world axis {axis}" for axis in "xyz"
        ]

    @pytest.mark.parametrize("seed", range(4))
    def test_the_basis_is_orthonormal_and_spans_what_is_unseen(self, seed):
        rng = np.random.default_rng(seed)
        directions = [
            [*R[1], 0, 0, 0],
            [0, 0, 0, 0, 0, 1],
            rng.normal(size=6),
            [*rng.normal(size=3), 0, 0, 0],
        ]
        bound = cramer_rao_bound(_information(_without(*directions[: seed + 1])))
        basis = np.array([u.direction for u in bound.unobserved])
        assert len(basis) == 6 - bound.rank == seed + 1
        np.testing.assert_allclose(basis @ basis.T, np.eye(seed + 1), atol=1e-9)
        np.testing.assert_allclose(basis @ _without(*directions[: seed + 1]), 0.0, atol=1e-6)
        words = [u.description for u in bound.unobserved]
        assert words[0] == "translation along world axis y"
        if seed >= 1:
            assert words[1] == "rotation about the optical axis (roll)"
        if seed == 3:
            assert words[2].startswith("translation along (")
            assert "together with" in words[3]

    @pytest.mark.slow
    def test_noise_does_not_hide_the_name(self):
        rng = np.random.default_rng(17)
        N = np.linalg.qr(np.array([[*R[1], 0, 0, 0], [0, 0, 0, 0, 0, 1.0]]).T)[0]
        J = rng.normal(size=(150, 3, 6)) @ (np.eye(6) - N @ N.T)
        expected = ["translation along world axis y", "rotation about the optical axis (roll)"]
        named = [
            [u.description for u in _quietly(_noisy(J, 0.3, rng)).unobserved] == expected for _ in range(50)
        ]
        assert np.mean(named) >= 0.9

    def test_a_direction_between_axes_does_not_get_an_axis_name(self):
        """Negative control: five degrees off an axis, without noise, is no axis."""
        direction = [*(np.cos(0.09) * R[1] + np.sin(0.09) * R[0]), 0, 0, 0]
        (unseen,) = cramer_rao_bound(_information(_without(direction))).unobserved
        assert unseen.description == "translation along (0.09, 1, 0) in the world"


class TestEllipsoid:
    def test_it_is_the_eigendecomposition_of_the_reported_covariance(self):
        bound = cramer_rao_bound(_information(_random(18)))
        for which, covariance in (
            ("position", bound.position_covariance),
            ("rotation", bound.rotation_covariance_deg2),
        ):
            semi_axes, directions = bound.ellipsoid(which)
            assert misfit(directions * semi_axes**2 @ directions.T, covariance) < 1e-9
            np.testing.assert_allclose(directions.T @ directions, np.eye(3), atol=1e-12)
            assert np.all(np.diff(semi_axes) <= 0.0)
            np.testing.assert_allclose(bound.ellipsoid(which, sigma=3.0)[0], 3.0 * semi_axes)

    def test_an_unseen_direction_is_an_infinite_axis_even_between_the_reported_ones(self):
        F = _without([*(R[0] + R[1]), 0, 0, 0])
        bound = cramer_rao_bound(_information(F))
        np.testing.assert_array_equal(np.isinf(bound.position_std), [True, True, False])
        semi_axes, directions = bound.ellipsoid("position")
        np.testing.assert_array_equal(np.isinf(semi_axes), [True, False, False])
        np.testing.assert_allclose(np.abs(directions[:, 0]), [np.sqrt(0.5), np.sqrt(0.5), 0], atol=1e-9)
        for axis, semi_axis in zip(directions.T[1:], semi_axes[1:], strict=True):
            functional = np.concatenate([R.T @ axis, np.zeros(3)])
            np.testing.assert_allclose(
                semi_axis**2, functional @ bound.seen_covariance @ functional, rtol=1e-6
            )

    def test_nothing_seen_is_infinite_all_around(self):
        semi_axes, _ = cramer_rao_bound(_information(np.zeros((6, 6)))).ellipsoid("rotation")
        assert np.isinf(semi_axes).all()

    def test_another_name_is_refused(self):
        with pytest.raises(OptionError, match="'position' or 'rotation'"):
            cramer_rao_bound(_information(_random(18))).ellipsoid("velocity")


class TestStandardErrors:
    @pytest.mark.slow
    @pytest.mark.parametrize("unseen", [(), ([0, 0, 0, 0, 0, 1],)])
    @pytest.mark.parametrize("length_scale", [1.0, pytest.param(4.0, marks=pytest.mark.slow)])
    def test_they_are_the_scatter_of_repetitions(self, unseen, length_scale):
        """The scatter of 100 runs is known to 7 %; 12 of them stay within 25 %."""
        rng = np.random.default_rng(19)
        mixed = np.eye(6) + 0.2 * rng.normal(size=(6, 6)) if unseen else rng.normal(size=(6, 6))
        J = rng.normal(size=(PIXELS if unseen else 150, 3, 6)) @ mixed
        for direction in unseen:
            J = J @ (np.eye(6) - np.outer(direction, direction))
        bounds = [_quietly(_noisy(J, 0.6, rng, length_scale=length_scale)) for _ in range(100)]
        for name in ("position_std", "rotation_std_deg", "eigenvalues"):
            values = np.array([getattr(bound, name) for bound in bounds])
            errors = np.array([getattr(bound, f"{name}_standard_error") for bound in bounds])
            np.testing.assert_array_equal(np.isnan(errors), np.isinf(values))
            # An axis whose share of the null direction is three of its errors is infinite now and then.
            finite = np.isfinite(values).mean(axis=0) > 0.95
            assert finite.sum() >= len(finite) - len(unseen)
            values[np.isinf(values)] = np.nan
            ratio = np.nanmean(errors[:, finite], axis=0) / np.nanstd(values[:, finite], axis=0)
            np.testing.assert_allclose(ratio, 1.0, atol=0.25)

    def test_no_noise_no_error(self):
        bound = cramer_rao_bound(_information(_random(20)))
        assert np.all(bound.position_std_standard_error == 0.0)

    def test_one_uncertain_eigenvalue_has_a_closed_form_error(self):
        """σ = F^(-1/2), so δσ = σ δF / (2F)."""
        covariance = np.zeros((21, 21))
        covariance[0, 0] = 0.3**2
        bound = _quietly(_information(np.diag([4.0, 1, 1, 1, 1, 1]), covariance, pose=np.eye(4)))
        np.testing.assert_allclose(bound.position_std_standard_error, [0.5 * 0.3 / 8.0, 0, 0], atol=1e-15)
        np.testing.assert_allclose(bound.eigenvalues_standard_error, [0.3, 0, 0, 0, 0, 0], atol=1e-15)

    def test_more_than_ten_percent_is_a_warning_that_says_which(self):
        covariance = np.zeros((21, 21))
        covariance[20, 20] = 0.3**2
        with pytest.warns(PrecisionWarning, match="roll is uncertain by 15%.*3 times the samples"):
            cramer_rao_bound(_information(np.eye(6), covariance))
        covariance[20, 20] = 0.19**2
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            cramer_rao_bound(_information(np.eye(6), covariance))


class TestPrior:
    def test_a_full_information_takes_a_matrix_or_an_information(self):
        F, P = _random(21), _random(22, rank=2)
        expected = np.linalg.inv(F + P)
        for prior in (P, _information(P), P.tolist()):
            bound = cramer_rao_bound(_information(F), prior=prior)
            assert misfit(bound.covariance, expected) < 1e-9
            assert misfit(bound.information.matrix, F + P) < 1e-12
        np.testing.assert_allclose(bound.eigenvalues, np.linalg.eigvalsh(F + P)[::-1], rtol=1e-12)

    def test_a_matrix_is_read_in_the_frame_of_the_information(self):
        information = _information(_random(21))
        P = _random(22, rank=2)
        world = cramer_rao_bound(
            information.to_frame("world"), prior=se3.move_information(P, se3.adjoint(POSE))
        )
        np.testing.assert_allclose(
            world.position_std, cramer_rao_bound(information, prior=P).position_std, rtol=1e-9
        )

    def test_it_makes_an_unseen_direction_as_certain_as_itself(self):
        """A position known to a kilometre makes the bound a kilometre, however weak beside the noise."""
        rng = np.random.default_rng(23)
        J = rng.normal(size=(150, 3, 6)) @ np.diag([0.0, 1, 1, 1, 1, 1])
        information = _noisy(J, 0.5, rng, pose=np.eye(4))
        assert np.isinf(_quietly(information).position_std[0])
        bound = _quietly(information, prior=np.diag([1e-6, 0, 0, 0, 0, 0]))
        assert bound.rank == 6
        assert bound.position_std[0] == pytest.approx(1e3, rel=0.05)

    @pytest.mark.slow
    def test_a_strong_prior_elsewhere_does_not_inform_a_tilted_null_direction(self):
        rng = np.random.default_rng(24)
        J = rng.normal(size=(150, 3, 6)) @ np.diag([0.0, 1, 1, 1, 1, 1])
        finite = 0
        for _ in range(100):
            information = _noisy(J, 0.5, rng, pose=np.eye(4))
            bound = _quietly(information, prior=np.diag([0, 0, 0, 0, 0, 1e9]))
            finite += bound.rank > 5 or np.isfinite(bound.position_std[0])
        assert finite < 5
        # Negative control: the prior's own value for the estimated null direction claims centimetres.
        tilt = identify(information.matrix, information.covariance_of_entries).unseen[5, 0]
        assert 1.0 / np.sqrt(1e9 * tilt**2) < 0.05

    def test_it_informs_one_of_two_unseen_directions(self):
        F = _without([1, 0, 0, 0, 0, 0], [0, 1, 0, 0, 0, 0])
        bound = cramer_rao_bound(_information(F, pose=np.eye(4)), prior=np.diag([4.0, 0, 0, 0, 0, 0]))
        np.testing.assert_allclose(bound.position_std[0], 0.5)
        assert [u.description for u in bound.unobserved] == ["translation along world axis y"]
        np.testing.assert_array_equal(np.isinf(bound.position_std), [False, True, False])

    def test_without_any_information_the_prior_is_the_answer(self):
        P = _random(25, strength=1.0)
        bound = cramer_rao_bound(_information(np.zeros((6, 6))), prior=P)
        assert misfit(bound.covariance, np.linalg.inv(P)) < 1e-8
        partial = cramer_rao_bound(
            _information(np.zeros((6, 6)), pose=np.eye(4)), prior=np.diag([1.0, 4, 0, 0, 0, 0])
        )
        assert partial.rank == 2
        np.testing.assert_allclose(partial.position_std, [1.0, 0.5, np.inf])

    @pytest.mark.slow
    @pytest.mark.parametrize("noise", [0.1, pytest.param(0.8, marks=pytest.mark.slow)])
    def test_it_never_makes_anything_worse(self, noise):
        """Random informations of every rank with noise, random priors of every rank and strength."""
        rng = np.random.default_rng(26)
        for _ in range(50):
            Q = np.linalg.qr(rng.normal(size=(6, 6)))[0]
            seen = np.diag(np.arange(6) < rng.integers(0, 7)).astype(float)
            J = rng.normal(size=(60, 3, 6)) @ seen @ Q.T
            root = rng.normal(size=(6, rng.integers(1, 7))) * 10.0 ** rng.uniform(-4, 4)
            prior = root @ root.T
            information = _noisy(J, noise, rng)
            alone, with_prior = _quietly(information), _quietly(information, prior=prior)
            assert with_prior.rank >= alone.rank
            for name in ("position_std", "rotation_std_deg"):
                assert np.all(getattr(with_prior, name) <= getattr(alone, name) * (1 + 1e-9))
            assert np.all(with_prior.eigenvalues >= alone.eigenvalues - 1e-9 * abs(with_prior.eigenvalues[0]))
            if root.shape[1] == 6:
                own = np.sqrt(np.diagonal(R @ np.linalg.inv(prior)[:3, :3] @ R.T))
                assert np.all(with_prior.position_std <= own * (1 + 1e-6))
            finite = np.isfinite(np.diagonal(with_prior.covariance))
            block = with_prior.covariance[np.ix_(finite, finite)]
            d = np.sqrt(np.diagonal(block))
            assert block.size == 0 or np.linalg.eigvalsh(block / np.outer(d, d))[0] > -1e-9

    def test_a_noisy_information_as_prior_counts_with_what_it_sees(self):
        rng = np.random.default_rng(27)
        J = rng.normal(size=(150, 3, 6))
        image = _noisy(J @ np.diag([0.0, 1, 1, 1, 1, 1]), 0.3, rng, pose=np.eye(4))
        blind = _noisy(J @ np.diag([0.0, 1, 1, 1, 1, 0]), 0.3, rng, pose=np.eye(4))
        assert np.isinf(_quietly(image, prior=blind).position_std[0])
        assert _quietly(image, prior=blind).rank == 5

    def test_a_prior_beyond_float64_is_refused(self):
        F, v = _random(21), np.ones(6) / np.sqrt(6)
        C = np.linalg.inv(F)
        for strength in (1e6, 1e12):
            bound = cramer_rao_bound(_information(F), prior=strength * np.outer(v, v))
            # Sherman–Morrison, which does not form the sum.
            expected = C - np.outer(C @ v, C @ v) / (1.0 / strength + v @ C @ v)
            np.testing.assert_allclose(bound.covariance, expected, atol=1e-6 * np.abs(expected).max())
        with pytest.raises(OptionError, match="float64"):
            cramer_rao_bound(_information(_random(21)), prior=1e20 * np.outer(v, v))

    def test_information_about_something_else_is_refused(self):
        for changes in ({"variable": "other"}, {"frame": "world"}, {"pose": np.eye(4)}):
            with pytest.raises(FrameError):
                cramer_rao_bound(_information(np.eye(6)), prior=_information(np.eye(6), **changes))

    @pytest.mark.parametrize(
        ("prior", "message"),
        [
            (np.diag([1.0, 1, 1, 1, 1, -1]), "not positive semi-definite"),
            (-np.eye(6), "not positive semi-definite"),
            (
                _information(np.diag([1.0, 1, 1, 1, 1, -1])),
                "information of 'the prior' is negative and exact",
            ),
            (np.triu(np.ones((6, 6))), "not symmetric"),
            (np.eye(3), "6 x 6"),
            (np.diag([np.inf, 1, 1, 1, 1, 1]), "finite"),
            ("strong", "6 x 6"),
        ],
    )
    def test_what_is_no_information_is_refused(self, prior, message):
        with pytest.raises(OptionError, match=message):
            cramer_rao_bound(_information(np.eye(6)), prior=prior)


class TestOutput:
    def test_six_lines_with_units(self):
        lines = str(
            cramer_rao_bound(_information(_without([0, 0, 0, 0, 0, 1]), 1e-9 * np.eye(21)))
        ).splitlines()
        assert len(lines) == 6
        assert "[scene unit], world axes" in lines[0]
        assert re.search(r"roll inf, > \d\S+ \[deg\], camera axes", lines[1])
        assert "5 of 6" in lines[2]
        assert "rotation about the optical axis (roll)" in lines[3]
        assert "unseen        nothing" in str(cramer_rao_bound(_information(_random(28))))

    def test_json_has_infinities_as_text_and_nan_as_null(self):
        bound = cramer_rao_bound(_information(_without([0, 0, 0, 0, 0, 1]), pose=np.eye(4)))
        written = json.loads(json.dumps(bound_document(bound), allow_nan=False))
        keys = list(written)
        assert keys[keys.index("pose") :] == [
            "pose",
            "frame",
            "twist_order",
            "units",
            "length_scale",
            "information",
            "information_standard_error",
            "covariance",
            "position_std",
            "position_std_standard_error",
            "rotation_std_deg",
            "rotation_std_deg_standard_error",
            "position_verdict",
            "rotation_verdict",
            "position_std_lower_limit",
            "rotation_std_deg_lower_limit",
            "eigenvalues",
            "eigenvalues_standard_error",
            "rank",
            "unobserved",
            "weakest",
            "optimality",
            "ellipsoids",
            "nuisances",
            "noise_inflation",
            "finite_differences",
            "no_bound",
            "warnings",
            "versions",
            "seconds",
        ]
        assert written["rotation_std_deg"][2] == "inf"
        assert written["rotation_std_deg_standard_error"][2] is None
        assert written["covariance"][5][5] == "inf"
        assert written["covariance"][5][0] is None
        assert written["covariance"][0][0] == bound.covariance[0, 0]
        assert written["unobserved"][0]["description"] == "rotation about the optical axis (roll)"
        assert len(written["unobserved"][0]["direction"]) == 6

    def test_provenance_is_filled_in_later(self):
        bound = cramer_rao_bound(_information(_random(28)))
        filled = dataclasses.replace(bound, provenance={"scene": "room.xml"})
        assert filled.provenance == {"scene": "room.xml"}
        np.testing.assert_array_equal(filled.ellipsoid("position")[0], bound.ellipsoid("position")[0])


class TestScalars:
    def test_optimality_is_dense_linear_algebra_in_scaled_units(self):
        F, L = _random(31), 7.0
        S = np.diag([L] * 3 + [1.0] * 3)
        for frame in ("camera", "world"):
            found = cramer_rao_bound(_information(F, length_scale=L).to_frame(frame)).optimality
            np.testing.assert_allclose(found.log_det, np.linalg.slogdet(S @ F @ S)[1])
            np.testing.assert_allclose(found.trace_inverse, np.trace(np.linalg.inv(S @ F @ S)))
            np.testing.assert_allclose(found.smallest_eigenvalue, np.linalg.eigvalsh(S @ F @ S)[0])

    def test_an_unseen_direction_is_worth_nothing_until_a_prior_sees_it(self):
        information = _information(_without([0, 0, 0, 0, 0, 1]))
        found = cramer_rao_bound(information).optimality
        assert (found.log_det, found.trace_inverse, found.smallest_eigenvalue) == (-np.inf, np.inf, 0.0)
        prior = np.diag([0.0, 0, 0, 0, 0, 25.0])
        assert cramer_rao_bound(information, prior=prior).optimality.smallest_eigenvalue == pytest.approx(
            25.0
        )

    def test_the_weakest_seen_direction_is_named(self):
        F = np.diag([1e4, 1e4, 1e4, 1e4, 1e2, 0.0])
        weakest = cramer_rao_bound(_information(F)).weakest
        assert weakest.description == "rotation about the camera's y axis (yaw)"
        np.testing.assert_allclose(np.abs(weakest.direction), np.eye(6)[4], atol=1e-12)
        assert cramer_rao_bound(_information(np.zeros((6, 6)))).weakest is None
