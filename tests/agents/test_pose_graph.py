"""Poses tied by relative measurements: against the dense inverse; the gauge, noise, many poses."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from matrices import misfit
from rigs import definite, made, noisy, random_pose
from scipy.sparse.linalg import splu

from mitsuba_crb import se3
from mitsuba_crb.agents import joint_state
from mitsuba_crb.agents.pose_graph import PoseGraph, RelativePose
from mitsuba_crb.agents.shared_nuisance import SharedNuisance, map_error
from mitsuba_crb.bound.cramer_rao import cramer_rao_bound
from mitsuba_crb.errors import FusionError
from mitsuba_crb.information.significance import no_information


class World:
    """Poses with random information, tied in a ring or a chain."""

    def __init__(self, seed, *, count=4, absolute=True, origin=0.0):
        self.rng = np.random.default_rng(seed)
        rng = self.rng
        self.names = [f"r{k}" for k in range(count)]
        centre = random_pose(rng, origin=origin)
        self.pose = {n: centre @ random_pose(rng) for n in self.names}
        self.poses = [
            made(
                definite(rng) if absolute else np.zeros((6, 6)),
                variable=n,
                pose=self.pose[n],
                length_scale=float(rng.uniform(0.5, 3.0)),
            )
            for n in self.names
        ]
        self.links = [
            RelativePose(a, b, definite(rng)) for a, b in zip(self.names, self.names[1:], strict=False)
        ]

    def error_of_relative_pose(self, a, b):
        """H (6, 6A) with ε = H ξ, by differences: a_from_b' = a_from_b exp(ε)."""
        step, rows = 1e-6, []
        a_from_b = se3.inverse(self.pose[a]) @ self.pose[b]
        for name in self.names:
            for e in np.eye(6):
                values = []
                for sign in (1.0, -1.0):
                    moved = {n: self.pose[n] @ se3.exp(sign * step * e * (n == name)) for n in (a, b)}
                    now = se3.inverse(moved[a]) @ moved[b]
                    values.append(se3.log(se3.inverse(a_from_b) @ now))
                rows.append((values[0] - values[1]) / (2.0 * step))
        return np.array(rows).T


def test_nobody_can_change_the_matrix_that_a_graph_keeps():
    world = World(0)
    graph = PoseGraph(world.poses, world.links)
    with pytest.raises(ValueError, match="read-only"):
        graph.matrix.data[0] = 0.0
    with pytest.raises(ValueError, match="read-only"):
        graph.matrix *= 2.0
    b = np.ones(graph.matrix.shape[0])
    np.testing.assert_allclose(graph.matrix @ splu(graph.matrix).solve(b), b)


class TestAgainstTheDenseInverse:
    def test_the_matrix_is_the_sum_of_blocks_and_links(self):
        world = World(1)
        expected = np.zeros((24, 24))
        for k, pose in enumerate(world.poses):
            expected[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = pose.matrix
        for link in world.links:
            H = world.error_of_relative_pose(link.a, link.b)
            expected += H.T @ link.information @ H
        graph = PoseGraph(world.poses, world.links)
        assert misfit(graph.matrix.toarray(), expected) < 1e-8
        assert graph.variables == tuple(world.names)

    @pytest.mark.parametrize("origin", [0.0, 1e6])
    def test_marginals_conditionals_and_relative_poses(self, origin):
        world = World(2, origin=origin)
        graph = PoseGraph(world.poses, world.links)
        F = graph.matrix.toarray()
        C = np.linalg.inv(F)
        for k, name in enumerate(world.names):
            own = slice(6 * k, 6 * k + 6)
            marginal = graph.marginal(name)
            assert misfit(np.linalg.inv(marginal.matrix), C[own, own]) < 1e-9
            assert misfit(cramer_rao_bound(marginal).covariance, C[own, own]) < 1e-9
            assert misfit(graph.conditional(name).matrix, F[own, own]) < 1e-9
            np.testing.assert_array_equal(marginal.pose, world.pose[name])
        # r1 given r0 and r3: of r1 and r2 together, r2 is marginalised.
        rest = np.linalg.inv(F[6:18, 6:18])[:6, :6]
        assert misfit(np.linalg.inv(graph.conditional("r1", given=["r0", "r3"]).matrix), rest) < 1e-9
        if origin == 0.0:
            for a, b in (("r0", "r1"), ("r3", "r0"), ("r1", "r3")):
                H = world.error_of_relative_pose(a, b)
                relative = graph.relative(a, b)
                assert misfit(np.linalg.inv(relative.matrix), H @ C @ H.T) < 1e-7
                np.testing.assert_allclose(relative.pose, se3.inverse(world.pose[a]) @ world.pose[b])

    def test_marginal_is_below_conditional_and_links_only_help(self):
        world = World(3)
        graph, alone = PoseGraph(world.poses, world.links), PoseGraph(world.poses)
        for name, pose in zip(world.names, world.poses, strict=True):
            marginal = graph.marginal(name).matrix
            assert np.linalg.eigvalsh(graph.conditional(name).matrix - marginal)[0] > 0.0
            assert np.linalg.eigvalsh(marginal - pose.matrix)[0] > 0.0
            assert misfit(alone.marginal(name).matrix, pose.matrix) < 1e-9

    def test_a_rigid_link_makes_one_body_of_two_poses(self):
        world = World(4, count=2)
        stiff = PoseGraph(world.poses, [RelativePose("r0", "r1", 1e9 * np.eye(6))])
        A = se3.adjoint(se3.inverse(world.pose["r1"]) @ world.pose["r0"])
        expected = world.poses[0].matrix + A.T @ world.poses[1].matrix @ A
        assert misfit(stiff.marginal("r0").matrix, expected) < 1e-6

    def test_several_links_between_two_poses_add(self):
        world = World(5, count=2)
        one, other = definite(world.rng), definite(world.rng)
        both = PoseGraph(world.poses, [RelativePose("r0", "r1", one), RelativePose("r0", "r1", other)])
        summed = PoseGraph(world.poses, [RelativePose("r0", "r1", one + other)])
        assert misfit(both.marginal("r1").matrix, summed.marginal("r1").matrix) < 1e-9


class TestGauge:
    def test_without_absolute_information_all_poses_move_freely_together(self):
        world = World(6, absolute=False)
        graph = PoseGraph(world.poses, world.links)
        (gauge,) = graph.gauges
        assert (gauge.free, gauge.common) == (6, 6)
        assert "only relative poses are known" in str(gauge)
        for name in world.names:
            bound = cramer_rao_bound(graph.marginal(name))
            assert bound.rank == 0
            assert np.isinf(bound.position_std).all()
        assert misfit(graph.relative("r0", "r1").matrix, world.links[0].information) < 1e-9

    def test_relative_poses_are_what_fixing_the_gauge_gives(self):
        world = World(7, absolute=False)
        world.links.append(RelativePose("r3", "r0", definite(world.rng)))
        graph = PoseGraph(world.poses, world.links)
        fixed = graph.fixed("r0")
        assert fixed.variables == ("r1", "r2", "r3")
        assert [gauge.free for gauge in fixed.gauges] == [0]
        for name in fixed.variables:
            assert misfit(graph.relative("r0", name).matrix, fixed.marginal(name).matrix) < 1e-9
        # The choice of the gauge changes marginals and no relative pose.
        other = graph.fixed("r2")
        assert misfit(other.marginal("r3").matrix, graph.relative("r2", "r3").matrix) < 1e-9
        assert misfit(other.marginal("r3").matrix, fixed.marginal("r3").matrix) > 1e-9

    def test_one_absolute_camera_anchors_all(self):
        world = World(8, absolute=False)
        anchored = dataclasses.replace(world.poses[1], matrix=definite(world.rng))
        graph = PoseGraph([world.poses[0], anchored, *world.poses[2:]], world.links)
        assert str(graph.gauges[0]).endswith("anchored, nothing is free")
        assert all(cramer_rao_bound(graph.marginal(name)).rank == 6 for name in world.names)
        assert misfit(graph.marginal("r1").matrix, anchored.matrix) < 1e-9

    def test_a_partly_blind_anchor_leaves_its_own_direction_free(self):
        """Everything may still turn about the anchor's optical axis."""
        world = World(9, absolute=False)
        blind = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 0.0])
        graph = PoseGraph([dataclasses.replace(world.poses[0], matrix=blind), *world.poses[1:]], world.links)
        (gauge,) = graph.gauges
        assert (gauge.free, gauge.common) == (1, 1)
        bound = cramer_rao_bound(graph.marginal("r0"))
        assert [u.description for u in bound.unobserved] == ["rotation about the optical axis (roll)"]
        assert cramer_rao_bound(graph.marginal("r2")).rank == 5
        assert cramer_rao_bound(graph.relative("r0", "r2")).rank == 6

    def test_parts_without_links_are_stated_apart(self):
        world = World(10)
        poses = [world.poses[0], world.poses[1], dataclasses.replace(world.poses[2], matrix=np.zeros((6, 6)))]
        graph = PoseGraph(poses, world.links[:1])
        assert [(g.variables, g.free) for g in graph.gauges] == [(("r0", "r1"), 0), (("r2",), 6)]
        assert "only relative" not in str(graph.gauges[1])
        assert cramer_rao_bound(graph.relative("r0", "r2")).rank == 0
        assert cramer_rao_bound(graph.relative("r2", "r0")).rank == 0

    def test_poses_without_a_link_have_a_relative_pose_if_both_are_anchored(self):
        world = World(23, count=2)
        A = se3.adjoint(se3.inverse(world.pose["r1"]) @ world.pose["r0"])
        first, second = (np.linalg.inv(pose.matrix) for pose in world.poses)
        found = PoseGraph(world.poses).relative("r0", "r1").matrix
        assert misfit(np.linalg.inv(found), second + A @ first @ A.T) < 1e-9

    def test_a_link_that_does_not_see_distance_leaves_a_scale_of_the_pair_free(self):
        world = World(11, count=2)
        bearing = np.diag([1.0, 1.0, 0.0, 1.0, 1.0, 1.0])
        graph = PoseGraph(
            [world.poses[0], dataclasses.replace(world.poses[1], matrix=np.zeros((6, 6)))],
            [RelativePose("r0", "r1", bearing)],
        )
        (gauge,) = graph.gauges
        assert (gauge.free, gauge.common) == (1, 0)
        bound = cramer_rao_bound(graph.relative("r0", "r1"))
        assert bound.rank == 5
        assert bound.unobserved[0].description.endswith("the optical axis")


class TestNoise:
    def _blind_pair(self, rng, error=1.0):
        """Two cameras tied to each other, both blind to the same motion of the pair."""
        pose = {"a": random_pose(rng), "b": random_pose(rng)}
        null = rng.normal(size=6)
        poses = []
        for name in "ab":
            own = se3.adjoint(se3.inverse(pose[name]) @ pose["a"]) @ null
            own /= np.linalg.norm(own)
            P = np.eye(6) - np.outer(own, own)
            matrix, covariance = noisy(rng, P @ (1e3 * definite(rng)) @ P, error=error)
            poses.append(made(matrix, covariance, variable=name, pose=pose[name], length_scale=1.0))
        return poses, [RelativePose("a", "b", 1e3 * definite(rng))]

    @pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")
    @pytest.mark.slow
    def test_the_common_null_direction_of_noisy_cameras_stays_unseen(self):
        """40 seeds; taken as exact (negative control) many of the same matrices are of full rank."""
        rng = np.random.default_rng(12)
        right, exact = 0, 0
        for _ in range(40):
            poses, links = self._blind_pair(rng)
            graph = PoseGraph(poses, links)
            right += graph.gauges[0].free == 1 and all(
                cramer_rao_bound(graph.marginal(name)).rank == 5 for name in "ab"
            )
            exact += np.linalg.eigvalsh(graph.matrix.toarray())[0] > 1e-6
        assert right >= 38
        assert exact >= 10

    def test_marginals_uncertainty_is_the_derivative(self):
        world = World(13, count=3)
        rng = world.rng
        direction = 0.5 * (definite(rng) - definite(rng))
        direction = direction + direction.T
        packed = direction[np.triu_indices(6)]
        step = 1e-5

        def moved(factor, covariance=None):
            pose = dataclasses.replace(world.poses[1], matrix=world.poses[1].matrix + factor * direction)
            if covariance is not None:
                pose = dataclasses.replace(pose, covariance_of_entries=covariance)
            return PoseGraph([world.poses[0], pose, world.poses[2]], world.links)

        noisy_graph = moved(0.0, step**2 * np.outer(packed, packed))
        for ask in (
            lambda g: g.marginal("r0"),
            lambda g: g.marginal("r1"),
            lambda g: g.relative("r0", "r2"),
            lambda g: g.conditional("r1", given=["r2"]),
        ):
            change = 0.5 * (ask(moved(step)).matrix - ask(moved(-step)).matrix)
            scale = np.abs(change).max()
            np.testing.assert_allclose(ask(noisy_graph).standard_error, np.abs(change), atol=1e-5 * scale)

    def test_absolute_information_too_weak_for_float32_counts_as_unseen(self):
        world = World(14, count=2, absolute=False)
        weak = dataclasses.replace(world.poses[0], matrix=np.diag([1e12, 1e12, 1e12, 1e12, 1e12, 1.0]))
        assert PoseGraph([weak]).gauges[0].free == 1
        # The link to a camera with strong images is no image, and not drowned.
        strong = dataclasses.replace(world.poses[0], matrix=1e10 * np.eye(6))
        assert PoseGraph([strong, world.poses[1]], world.links).gauges[0].free == 0
        # A stiff link is no rendering: it does not drown the images.
        stiff = PoseGraph(World(15, count=2).poses, [RelativePose("r0", "r1", 1e8 * np.eye(6))])
        assert stiff.gauges[0].free == 0


class TestSharedNuisance:
    def _dense(self, world, nuisance):
        n = 6 * len(world.names)
        F = np.zeros((n + nuisance.size, n + nuisance.size))
        F[:n, :n] = PoseGraph(world.poses, world.links).matrix.toarray()
        F[n:, n:] = nuisance.total
        for name, X in nuisance.cross.items():
            k = 6 * world.names.index(name)
            F[k : k + 6, n:], F[n:, k : k + 6] = X, X.T
        return F

    def test_it_is_a_block_like_any_other(self):
        world = World(16)
        cross, own = {}, {}
        for name, pose in list(zip(world.names, world.poses, strict=True))[:3]:
            B = 1e3 * world.rng.normal(size=(6, 2)) * [1.0, 1e-6]
            cross[name], own[name] = pose.matrix @ B, B.T @ pose.matrix @ B
        nuisance = SharedNuisance("light", np.diag([1e4, 1e-8]), cross, own)
        graph = PoseGraph(world.poses, world.links, shared=nuisance)
        F = self._dense(world, nuisance)
        assert misfit(graph.matrix.toarray(), F) < 1e-12
        C = np.linalg.inv(F)
        for k, name in enumerate(world.names):
            own_block = C[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
            assert misfit(np.linalg.inv(graph.marginal(name).matrix), own_block) < 1e-7
        # Given all other poses the nuisance is still unknown.
        keep = [*range(6, 12), *range(24, 26)]
        given = np.linalg.inv(F[np.ix_(keep, keep)])[:6, :6]
        assert misfit(np.linalg.inv(graph.conditional("r1").matrix), given) < 1e-7

    def test_a_common_map_error_correlates_poses_and_cancels_between_them(self):
        """C = diag(F_a⁻¹) + A K⁻¹ Aᵀ; a relative pose in the map does not depend on where the map is."""
        world = World(17, count=3)
        K = definite(world.rng)
        nuisance = map_error("survey", world.poses, K, world_from_map=np.eye(4))
        graph, exact = PoseGraph(world.poses, shared=nuisance), PoseGraph(world.poses)
        for name, pose in zip(world.names, world.poses, strict=True):
            A = se3.adjoint(se3.inverse(world.pose[name]))
            expected = np.linalg.inv(pose.matrix) + A @ np.linalg.inv(K) @ A.T
            assert misfit(np.linalg.inv(graph.marginal(name).matrix), expected) < 1e-8
        assert misfit(graph.relative("r0", "r2").matrix, exact.relative("r0", "r2").matrix) < 1e-8

    def test_an_unknown_map_is_a_gauge(self):
        world = World(18, count=3)
        nuisance = map_error("m", world.poses, np.zeros((6, 6)), world_from_map=world.pose["r0"])
        graph = PoseGraph(world.poses, shared=nuisance)
        assert [gauge.free for gauge in graph.gauges] == [6]
        assert cramer_rao_bound(graph.marginal("r1")).rank == 0
        exact = PoseGraph(world.poses)
        assert misfit(graph.relative("r0", "r1").matrix, exact.relative("r0", "r1").matrix) < 1e-7


class TestManyPoses:
    def _graph(self, seed, count, *, absolute):
        world = World(seed, count=count, absolute=False)
        rng = world.rng
        links = [
            RelativePose(f"r{k}", f"r{(7 * k + 3) % count}", definite(rng))
            for k in range(0, count, 5)
            if k != (7 * k + 3) % count
        ]
        poses = list(world.poses)
        if absolute:
            for k in range(0, count, 10):
                matrix, covariance = noisy(rng, definite(rng, 5), error=1e-3)
                poses[k] = dataclasses.replace(poses[k], matrix=matrix, covariance_of_entries=covariance)
        return poses, world.links + links

    @pytest.mark.slow
    @pytest.mark.parametrize("absolute", [True, False])
    def test_the_sparse_way_gives_the_dense_way_s_numbers(self, monkeypatch, absolute):
        poses, links = self._graph(19, 40, absolute=absolute)
        dense = PoseGraph(poses, links)
        wanted = [dense.marginal("r7"), dense.relative("r3", "r30"), dense.fixed("r0").marginal("r20")]
        gauges = dense.gauges
        monkeypatch.setattr(joint_state, "DENSE", 12)
        sparse = PoseGraph(poses, links)
        assert sparse.gauges == gauges
        found = [sparse.marginal("r7"), sparse.relative("r3", "r30"), sparse.fixed("r0").marginal("r20")]
        for a, b in zip(found, wanted, strict=True):
            assert np.abs(a.matrix - b.matrix).max() <= 1e-8 * np.abs(b.matrix).max()
            assert np.abs(a.standard_error - b.standard_error).max() <= 1e-6 * np.abs(b.matrix).max()

    @pytest.mark.slow
    def test_a_thousand_poses_take_seconds_and_stay_sparse(self):
        poses, links = self._graph(20, 1000, absolute=False)
        graph = PoseGraph(poses, links)
        assert graph.matrix.shape == (6000, 6000)
        assert graph.matrix.nnz < 0.005 * 6000**2
        assert [(g.free, g.common) for g in graph.gauges] == [(6, 6)]
        relative = graph.relative("r0", "r900").matrix
        assert misfit(graph.fixed("r0").marginal("r900").matrix, relative) < 1e-8

    def test_too_many_undecided_directions_are_refused(self, monkeypatch):
        monkeypatch.setattr(joint_state, "DENSE", 12)
        world = World(21, count=20, absolute=False)
        one_axis = np.diag([1.0, 0, 0, 0, 0, 0])
        links = [dataclasses.replace(link, information=one_axis) for link in world.links]
        with pytest.raises(FusionError, match="unseen or drowned"):
            _ = PoseGraph(world.poses, links).gauges


class TestBadInput:
    def test_names_and_matrices(self):
        world = World(22, count=2)
        with pytest.raises(FusionError, match="no poses"):
            PoseGraph([])
        with pytest.raises(FusionError, match="'r0' occurs twice"):
            PoseGraph([world.poses[0], world.poses[0]])
        with pytest.raises(FusionError, match="'r11'; did you mean 'r1'"):
            PoseGraph(world.poses, [RelativePose("r0", "r11", np.eye(6))])
        with pytest.raises(FusionError, match="to itself"):
            RelativePose("r0", "r0", np.eye(6))
        with pytest.raises(FusionError, match="seen from 'r0' is not positive"):
            RelativePose("r0", "r1", -np.eye(6))
        with pytest.raises(FusionError, match="negative"):
            PoseGraph([dataclasses.replace(world.poses[0], matrix=-np.eye(6))])
        graph = PoseGraph(world.poses, world.links)
        with pytest.raises(FusionError, match="no pose is called"):
            graph.marginal("x")
        with pytest.raises(FusionError, match="twice"):
            graph.relative("r0", "r0")
        with pytest.raises(FusionError, match="is fixed"):
            graph.fixed("r0").marginal("r0")

    def test_nothing_known_at_all(self):
        graph = PoseGraph([no_information(variable="x", pose=np.eye(4))])
        assert graph.gauges[0].free == 6
        assert cramer_rao_bound(graph.marginal("x")).rank == 0
