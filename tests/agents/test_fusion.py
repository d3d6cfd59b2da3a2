"""Agents on one body: transport against derivatives taken anew, sums against one stacked Jacobian."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from matrices import misfit
from rigs import (
    camera_jacobian,
    definite,
    made,
    noisy,
    point_motion,
    points_before,
    projection_slope,
    random_pose,
)

from mitsuba_crb import se3
from mitsuba_crb.agents.fusion import Agent, agents_in_world, fuse, to_common
from mitsuba_crb.agents.shared_nuisance import SharedNuisance, map_error
from mitsuba_crb.bound.cramer_rao import cramer_rao_bound
from mitsuba_crb.errors import FrameError, FusionError, PoseError
from mitsuba_crb.information.significance import refuse_negative

ORIGINS = [0.0, 1e3, 1e6]


def _world_jacobian(points, pose):
    """(2n, 6), of the same images when exp(ξ) moves the camera on the left, derived from T⁻¹ exp(−ξ) p."""
    R = pose[:3, :3]
    world_points = points @ R.T + pose[:3, 3]
    return (projection_slope(points) @ R.T @ point_motion(world_points)).reshape(-1, 6)


class Rig:
    """Four cameras on a body, each seeing its own points."""

    def __init__(self, seed, *, origin=0.0, points=12):
        rng = np.random.default_rng(seed)
        self.world_from_common = random_pose(rng, origin=origin)
        self.common_from_agent = {name: random_pose(rng) for name in "abcd"}
        self.points = {name: points_before(rng, points) for name in "abcd"}

    def pose(self, name):
        return self.world_from_common @ self.common_from_agent[name]

    def information(self, name):
        J = camera_jacobian(self.points[name])
        return made(J.T @ J, variable=name, pose=self.pose(name))

    @property
    def agents(self):
        return [Agent(name, self.information(name), self.common_from_agent[name]) for name in "abcd"]

    def stacked_jacobian(self):
        """Of all images when the body moves by exp(ξ) on the right, through points in the body's frame."""
        rows = []
        for name in "abcd":
            g = self.common_from_agent[name]
            on_body = self.points[name] @ g[:3, :3].T + g[:3, 3]
            motion = g[:3, :3].T @ point_motion(on_body)
            rows.append((projection_slope(self.points[name]) @ motion).reshape(-1, 6))
        return np.vstack(rows)

    def images(self, twist):
        """(m,), of all points after the body has moved; the world's points stay."""
        moved = self.world_from_common @ se3.exp(twist)
        values = []
        for name in "abcd":
            now = se3.inverse(moved @ self.common_from_agent[name]) @ self.pose(name)
            p = self.points[name] @ now[:3, :3].T + now[:3, 3]
            values.append((p[:, :2] / p[:, 2:]).ravel())
        return np.concatenate(values)


class TestTransport:
    def test_the_closed_forms_are_derivatives(self):
        rig = Rig(0)
        step = 1e-6
        numeric = [(rig.images(step * e) - rig.images(-step * e)) / (2.0 * step) for e in np.eye(6)]
        np.testing.assert_allclose(rig.stacked_jacobian(), np.transpose(numeric), atol=1e-8)

    @pytest.mark.parametrize("origin", ORIGINS)
    def test_it_is_the_jacobian_derived_anew_in_the_other_frame(self, origin):
        rng = np.random.default_rng(1)
        for _ in range(20):
            pose, points = random_pose(rng, origin=origin), points_before(rng)
            J = camera_jacobian(points)
            F = made(J.T @ J, pose=pose)
            world = _world_jacobian(points, pose)
            # float64 at a lever arm of `origin`: the world frame's own entries are that large.
            assert misfit(F.to_frame("world").matrix, world.T @ world) < 1e-9
            # The body's frame has no such lever arm: every entry to 1e-12 of the largest.
            g = random_pose(rng)
            on_body = points @ g[:3, :3].T + g[:3, 3]
            body = (projection_slope(points) @ g[:3, :3].T @ point_motion(on_body)).reshape(-1, 6)
            moved = to_common(Agent("a", F, g), variable="body")
            assert misfit(moved.matrix, body.T @ body) < 1e-12
            np.testing.assert_allclose(moved.pose, pose @ se3.inverse(g), atol=1e-15 * max(origin, 10.0))

    @pytest.mark.parametrize("origin", ORIGINS)
    def test_the_information_of_a_motion_is_invariant(self, origin):
        rng = np.random.default_rng(2)
        worst = 0.0
        for _ in range(200):
            F = made(definite(rng), pose=random_pose(rng, origin=origin))
            g, twist = random_pose(rng, origin=rng.choice([0.0, 10.0])), rng.normal(size=6)
            body = to_common(Agent("a", F, g), variable="body")
            own = se3.adjoint(se3.inverse(g)) @ twist
            expected = own @ F.matrix @ own
            worst = max(worst, abs(twist @ body.matrix @ twist - expected) / expected)
            # In the world's frame relative to ‖F‖‖ξ‖²: there the terms of the sum cancel.
            world = F.to_frame("world")
            left = se3.adjoint(F.pose) @ twist
            scale = np.linalg.norm(world.matrix, 2) * (left @ left)
            assert abs(left @ world.matrix @ left - twist @ F.matrix @ twist) < 1e-9 * scale
        assert worst < 1e-9

    def test_rotations_first_or_an_inverted_transform_would_show(self):
        """Negative control of the two tests above."""
        rng = np.random.default_rng(3)
        F, g, twist = made(definite(rng)), random_pose(rng), rng.normal(size=6)
        own = se3.adjoint(se3.inverse(g)) @ twist
        expected = own @ F.matrix @ own
        inverted = to_common(Agent("a", F, se3.inverse(g)), variable="body")
        assert abs(twist @ inverted.matrix @ twist - expected) > 1e-2 * expected
        swapped = np.roll(twist, 3)
        body = to_common(Agent("a", F, g), variable="body")
        assert abs(swapped @ body.matrix @ swapped - expected) > 1e-2 * expected


class TestJointInformation:
    @pytest.mark.parametrize("origin", ORIGINS)
    def test_it_is_that_of_one_stacked_jacobian(self, origin):
        for seed in range(10):
            rig = Rig(seed, origin=origin)
            J = rig.stacked_jacobian()
            joint = fuse(rig.agents, variable="rig").information
            assert misfit(joint.matrix, J.T @ J) < 1e-9
            assert (joint.variable, joint.frame) == ("rig", "camera")
            np.testing.assert_allclose(joint.pose, rig.world_from_common, atol=1e-15 * max(origin, 10.0))

    def test_body_frames_need_the_adjoint_of_the_inverse_and_world_frames_the_identity(self):
        rig = Rig(4)
        body = rig.stacked_jacobian()
        world = np.vstack([_world_jacobian(rig.points[name], rig.pose(name)) for name in "abcd"])

        def summed(frame, A):
            return sum(A(name).T @ rig.information(name).to_frame(frame).matrix @ A(name) for name in "abcd")

        adjoints = {
            "identity": lambda name: np.eye(6),
            "Ad(g⁻¹)": lambda name: se3.adjoint(se3.inverse(rig.common_from_agent[name])),
            "Ad(g)": lambda name: se3.adjoint(rig.common_from_agent[name]),
        }
        for frame, J, right in (("camera", body, "Ad(g⁻¹)"), ("world", world, "identity")):
            for name, A in adjoints.items():
                error = misfit(summed(frame, A), J.T @ J)
                assert error < 1e-12 if name == right else error > 1e-2
        joint = fuse(rig.agents).information
        assert misfit(joint.matrix, body.T @ body) < 1e-12
        assert misfit(joint.to_frame("world").matrix, world.T @ world) < 1e-12

    def test_order_changes_no_bit_and_grouping_no_digit(self):
        rig = Rig(5)
        agents = rig.agents
        joint = fuse(agents).information
        for order in ([3, 2, 1, 0], [1, 3, 0, 2]):
            again = fuse([agents[k] for k in order]).information
            np.testing.assert_array_equal(again.matrix, joint.matrix)
            np.testing.assert_array_equal(again.pose, joint.pose)
        # Two cameras make a body of their own, which then sits on the larger one.
        pair_from_common = se3.exp([0.3, -1.0, 2.0, 0.5, 0.1, -0.7])
        pair = [
            Agent(a.name, a.information, pair_from_common @ a.common_from_agent)
            for a in (agents[0], agents[2])
        ]
        pair_information = fuse(pair, variable="pair").information
        grouped = fuse(
            [agents[3], Agent("pair", pair_information, se3.inverse(pair_from_common)), agents[1]]
        ).information
        assert misfit(grouped.matrix, joint.matrix) < 1e-12

    def test_log_det_is_the_same_in_any_frame(self):
        rig = Rig(6)
        joint = fuse(rig.agents).information
        expected = np.linalg.slogdet(joint.matrix)[1]
        assert np.linalg.slogdet(joint.to_frame("world").matrix)[1] == pytest.approx(expected, abs=1e-9)
        other = se3.exp([1.0, 2.0, -0.5, 0.3, 0.2, 1.0])
        moved = [Agent(a.name, a.information, other @ a.common_from_agent) for a in rig.agents]
        assert np.linalg.slogdet(fuse(moved).information.matrix)[1] == pytest.approx(expected, abs=1e-9)

    def test_it_is_above_each_agent_s(self):
        for seed in range(20):
            fusion = fuse(Rig(seed, points=2).agents)
            for agent in fusion.agents:
                gain = fusion.information.matrix - agent.information.matrix
                assert np.linalg.eigvalsh(gain)[0] > -1e-12 * np.abs(gain).max()

    def test_covariances_of_entries_add(self):
        rng = np.random.default_rng(7)
        rig = Rig(7)
        agents = []
        for agent in rig.agents:
            root = rng.normal(size=(21, 21))
            estimated = dataclasses.replace(agent.information, covariance_of_entries=root @ root.T)
            agents.append(dataclasses.replace(agent, information=estimated))
        fusion = fuse(agents)
        expected = sum(agent.information.covariance_of_entries for agent in fusion.agents)
        assert misfit(fusion.information.covariance_of_entries, expected) < 1e-12

    def test_agents_placed_by_their_poses_in_the_world(self):
        rig = Rig(8)
        agents = agents_in_world({n: rig.information(n) for n in "abcd"}, rig.world_from_common)
        expected = fuse(rig.agents).information.matrix
        assert misfit(fuse(agents).information.matrix, expected) < 1e-12

    def test_one_agent_on_the_body_itself_changes_nothing(self):
        F = made(definite(np.random.default_rng(9)), pose=se3.exp([1.0, 0, 2, 0, 1, 0]))
        fusion = fuse([Agent("only", F, np.eye(4))])
        np.testing.assert_array_equal(fusion.information.matrix, F.matrix)
        assert fusion.agents[0].share == pytest.approx(1.0)


class TestShares:
    def test_they_are_the_traces_and_add_up_to_one(self):
        fusion = fuse(Rig(10).agents)
        inverse = np.linalg.inv(fusion.information.matrix)
        for agent in fusion.agents:
            assert agent.share == pytest.approx(np.trace(inverse @ agent.information.matrix) / 6.0)
        assert sum(agent.share for agent in fusion.agents) == pytest.approx(1.0)
        assert [agent.name for agent in fusion.agents] == list("abcd")

    def test_each_agent_is_blind_somewhere_and_all_together_are_not(self):
        """Four agents of rank 3, with noise in their estimates."""
        rng = np.random.default_rng(11)
        pose = random_pose(rng)
        agents = []
        for name in "abcd":
            g = random_pose(rng)
            matrix, covariance = noisy(rng, 1e4 * definite(rng, 3), error=3.0)
            agents.append(Agent(name, made(matrix, covariance, variable=name, pose=pose @ g), g))
        fusion = fuse(agents)
        assert [agent.rank for agent in fusion.agents] == [3] * 4
        assert fusion.bound.rank == 6
        assert np.isfinite(fusion.bound.position_std).all()
        one = fuse(agents[:1])
        assert one.bound.rank == 3
        assert one.agents[0].share == pytest.approx(1.0)

    def test_an_agent_that_sees_nothing_has_no_share(self):
        pose = np.eye(4)
        fusion = fuse(
            [
                Agent("sees", made(definite(np.random.default_rng(12)), pose=pose), pose),
                Agent("blind", made(np.zeros((6, 6)), pose=pose), pose),
            ]
        )
        assert [(a.rank, round(a.share, 12)) for a in fusion.agents] == [(6, 1.0), (0, 0.0)]
        nothing = fuse([Agent("blind", made(np.zeros((6, 6)), pose=pose), pose)])
        assert (nothing.bound.rank, nothing.agents[0].share) == (0, 0.0)

    def test_as_text(self):
        fusion = fuse(Rig(13).agents)
        assert str(fusion).startswith(str(fusion.bound))
        assert "b: rank 6, share" in str(fusion)


class TestNegativeInformation:
    def _agent(self, deviations):
        """One unseen direction whose estimate lies this many of its standard errors from zero."""
        rotation = np.linalg.qr(np.random.default_rng(14).normal(size=(6, 6)))[0]
        error = 2.0
        matrix = rotation @ np.diag([1e4, 1e4, 1e4, 1e4, 1e4, deviations * error]) @ rotation.T
        i, j = np.triu_indices(6)
        covariance = np.diag(np.where(i == j, 1.0, 0.5) * error**2)
        return Agent("x", made(matrix, covariance, length_scale=1.0), np.eye(4))

    @pytest.mark.parametrize("deviations", [0.5, -1.0, -3.0, -3.8])
    def test_noise_is_fine(self, deviations):
        assert fuse([self._agent(deviations)]).bound.rank == 5

    @pytest.mark.parametrize("deviations", [-4.2, -10.0, -1000.0])
    def test_more_is_refused(self, deviations):
        with pytest.raises(FusionError, match="negative"):
            fuse([self._agent(deviations)])

    def test_a_camera_that_sees_nothing_is_not_refused_for_its_most_negative_direction(self):
        """Of six noise directions the lowest is beyond four single standard errors in some percent."""
        rng = np.random.default_rng(15)
        beyond = 0
        for _ in range(800):
            matrix, covariance = noisy(rng, np.zeros((6, 6)), error=1.0)
            if np.linalg.eigvalsh(matrix)[0] < -4.0:
                beyond += 1
                refuse_negative(made(matrix, covariance, length_scale=1.0), "x")
        assert beyond > 8

    def test_exact_information_is_allowed_to_round(self):
        matrix = np.diag([1.0, 1, 1, 1, 1, -1e-12])
        assert fuse([Agent("x", made(matrix), np.eye(4))]).bound.rank == 5
        with pytest.raises(FusionError, match="exact"):
            fuse([Agent("x", made(np.diag([1.0, 1, 1, 1, 1, -1e-3])), np.eye(4))])


class TestSharedNuisance:
    def _nuisance(self, rng, rig, m=2, known=None):
        """Measurements with extra columns, known[η] beforehand; returns it and the stacked columns."""
        cross, own, columns = {}, {}, []
        for name in "abcd":
            J = camera_jacobian(rig.points[name])
            B = rng.normal(size=(len(J), m)) if name != "d" else np.zeros((len(J), m))
            columns.append(B)
            if name != "d":
                cross[name], own[name] = J.T @ B, B.T @ B
        known = np.zeros((m, m)) if known is None else known
        return SharedNuisance("light", known, cross, own), np.vstack(columns)

    @pytest.mark.parametrize("known", [None, np.diag([3.0, 50.0])])
    def test_it_is_the_schur_complement_of_all_columns(self, known):
        rng, rig = np.random.default_rng(16), Rig(16)
        nuisance, B = self._nuisance(rng, rig, known=known)
        J = rig.stacked_jacobian()
        middle = np.linalg.inv(B.T @ B + (0.0 if known is None else known))
        expected = J.T @ J - J.T @ B @ middle @ B.T @ J
        fusion = fuse(rig.agents, shared=nuisance)
        assert misfit(fusion.information.matrix, expected) < 1e-12
        lost = fuse(rig.agents).information.matrix - fusion.information.matrix
        assert np.linalg.eigvalsh(lost)[0] > -1e-12 * np.abs(lost).max()
        assert sum(agent.share for agent in fusion.agents) > 1.0

    def test_knowing_it_exactly_or_not_measuring_it_costs_nothing(self):
        rng, rig = np.random.default_rng(17), Rig(17)
        free = fuse(rig.agents).information.matrix
        certain, _ = self._nuisance(rng, rig, known=1e14 * np.eye(2))
        assert misfit(fuse(rig.agents, shared=certain).information.matrix, free) < 1e-10
        unmeasured = SharedNuisance("x", np.zeros((1, 1)), {"a": np.zeros((6, 1))}, {"a": np.zeros((1, 1))})
        np.testing.assert_array_equal(fuse(rig.agents, shared=unmeasured).information.matrix, free)

    @pytest.mark.parametrize("origin", ORIGINS)
    def test_the_error_of_a_common_map_does_not_average_out(self, origin):
        rng, rig = np.random.default_rng(18), Rig(18, origin=origin)
        K = definite(rng)
        informations = [rig.information(name) for name in "abcd"]
        world_from_map = rig.world_from_common @ se3.exp([0.5, 0, 0, 0, 0.3, 0])
        nuisance = map_error("survey", informations, K, world_from_map=world_from_map)
        joint = fuse(rig.agents, shared=nuisance).information.matrix
        # C = F⁻¹ + Ad K⁻¹ Adᵀ, however many cameras there are.
        A = se3.adjoint(se3.inverse(rig.world_from_common) @ world_from_map)
        expected = np.linalg.inv(fuse(rig.agents).information.matrix) + A @ np.linalg.inv(K) @ A.T
        assert misfit(np.linalg.inv(joint), expected) < 1e-8

    def test_an_unknown_map_leaves_no_absolute_information(self):
        rig = Rig(19)
        informations = [rig.information(name) for name in "abcd"]
        nuisance = map_error("m", informations, np.zeros((6, 6)), world_from_map=np.eye(4))
        joint = fuse(rig.agents, shared=nuisance).information
        assert np.abs(joint.matrix).max() < 1e-9 * np.abs(fuse(rig.agents).information.matrix).max()

    def test_bad_nuisances_are_named(self):
        X, N = np.zeros((6, 2)), np.eye(2)
        for arguments, match in (
            ((N, {"a": X[:5]}, {"a": N}), r"shape \(6, 2\)"),
            ((N, {"a": X}, {"b": N}), "same variables"),
            ((-N, {"a": X}, {"a": N}), "positive semi-definite"),
            ((N, {"a": X}, {"a": np.array([[1.0, 0.5], [0.0, 1.0]])}), "not symmetric"),
            ((N, {"a": X}, {"a": np.eye(3)}), "2 x 2"),
        ):
            with pytest.raises(FusionError, match=match):
                SharedNuisance("light", *arguments)
        with pytest.raises(FusionError, match="'z', which no agent observes"):
            fuse(Rig(20).agents, shared=SharedNuisance("light", N, {"z": X}, {"z": N}))


class TestBadInput:
    def test_no_agents(self):
        with pytest.raises(FusionError, match="no agents"):
            fuse([])

    def test_duplicate_names(self):
        agent = Rig(21).agents[0]
        with pytest.raises(FusionError, match="'a' occurs twice"):
            fuse([agent, agent])

    @pytest.mark.parametrize(
        ("transform", "match"),
        [
            (np.diag([2.0, 2.0, 2.0, 1.0]), "'a'.*scale"),
            (np.diag([-1.0, 1.0, 1.0, 1.0]), "'a'.*reflection"),
            (np.array([[1, 0.3, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]), "'a'.*shear"),
            (np.eye(3), "'a'.*shape"),
            (np.full((4, 4), np.nan), "'a'.*NaN"),
        ],
    )
    def test_transforms_that_are_no_rigid_motions(self, transform, match):
        with pytest.raises(PoseError, match=match):
            Agent("a", made(np.eye(6)), transform)

    def test_transforms_and_poses_that_disagree(self):
        rig = Rig(22)
        agents = rig.agents
        agents[2] = dataclasses.replace(agents[2], common_from_agent=se3.inverse(agents[2].common_from_agent))
        with pytest.raises(FrameError, match=r"agent 'c'.*inverted"):
            fuse(agents)

    def test_two_cameras_frames_are_different_frames(self):
        rig = Rig(23)
        a, b = rig.information("a"), rig.information("b")
        with pytest.raises(FrameError):
            a + b
        with pytest.raises(FrameError):
            a + b.about(variable="a")
        with pytest.raises(FrameError):
            a + a.about(frame="world")
        with pytest.raises(FrameError, match="unknown frame"):
            a.about(frame="body")

    def test_the_bound_of_the_rig_is_the_body_s(self):
        rig = Rig(24)
        joint = fuse(rig.agents)
        direct = cramer_rao_bound(joint.information)
        np.testing.assert_array_equal(joint.bound.position_std, direct.position_std)
