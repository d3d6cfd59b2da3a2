"""The filter: its state depends on which messages came, not on how; a moving body loses what motion costs."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from matrices import misfit
from rigs import definite, made, noisy, random_pose

from mitsuba_crb import se3
from mitsuba_crb.agents.information_filter import InformationFilter
from mitsuba_crb.agents.message import decode, encode
from mitsuba_crb.bound.cramer_rao import cramer_rao_bound
from mitsuba_crb.errors import FrameError, FusionError, MessageError, PoseError
from mitsuba_crb.information.significance import no_information

POSE = se3.exp([1.0, -2.0, 0.5, 0.4, -0.3, 0.8])


def _body(matrix, **changes):
    return made(matrix, **({"variable": "body", "pose": POSE} | changes))


def _empty():
    return InformationFilter(no_information(variable="body", pose=POSE, length_scale=2.0))


def _filled(messages):
    receiver = _empty()
    for data in messages:
        receiver.receive(data)
    return receiver


class Traffic:
    """Three agents, growing knowledge, tiles, deltas."""

    def __init__(self, seed):
        rng = np.random.default_rng(seed)
        first, more = definite(rng), definite(rng)
        self.base = encode(_body(first), agent="a", sequence=1, precision="float16")
        self.delta = encode(_body(first + more), agent="a", sequence=4, base=decode(self.base))
        self.messages = [
            self.base,
            encode(_body(first + 0.5 * more), agent="a", sequence=2, form="sketch", rank=4),
            self.delta,
            encode(_body(definite(rng)), agent="b", sequence=1, tile=(0, 0, 16, 16)),
            encode(_body(definite(rng)), agent="b", sequence=2, tile=(16, 0, 16, 16)),
            encode(_body(definite(rng)), agent="b", sequence=3, tile=(0, 0, 16, 16), form="full"),
            encode(_body(definite(rng), frame="world"), agent="c", sequence=7),
        ]


class TestState:
    def test_late_duplicated_and_reordered_messages_change_no_bit(self):
        rng = np.random.default_rng(1)
        messages = Traffic(1).messages
        expected = _filled(messages).information
        for _ in range(40):
            order = list(rng.permutation(len(messages))) + list(rng.integers(len(messages), size=5))
            rng.shuffle(order)
            again = _filled([messages[k] for k in order]).information
            np.testing.assert_array_equal(again.matrix, expected.matrix)
            np.testing.assert_array_equal(again.covariance_of_entries, expected.covariance_of_entries)
            assert again.selection == expected.selection

    def test_what_counts_is_the_newest_of_every_tile(self):
        traffic = Traffic(2)
        receiver = _filled(traffic.messages)
        counted = [(c.message.agent, c.message.tile, c.message.sequence) for c in receiver.contributions]
        assert counted == [
            ("a", None, 4),
            ("b", (0, 0, 16, 16), 3),
            ("b", (16, 0, 16, 16), 2),
            ("c", None, 7),
        ]
        decoded = [decode(traffic.messages[k]).information.to_frame("camera").matrix for k in (0, 2, 5, 4, 6)]
        assert misfit(receiver.information.matrix, sum(decoded)) < 1e-14

    def test_losses_cost_information_and_nothing_else(self):
        messages = Traffic(3).messages
        whole = _filled(messages).information.matrix
        for lost in range(1 << len(messages)):
            received = [m for k, m in enumerate(messages) if not lost >> k & 1]
            # Agents b's tiles are estimated anew rather than added to: only growing knowledge is compared.
            if lost >> 5 & 1 or lost >> 3 & 1:
                continue
            partial = _filled(received).information.matrix
            assert np.linalg.eigvalsh(whole - partial)[0] > -1e-12 * np.abs(whole).max()

    def test_it_never_claims_more_than_the_agents_know(self):
        """Negative control: adding up every message that arrives does."""
        rng = np.random.default_rng(4)
        F = {name: definite(rng) for name in "abc"}
        truth = sum(F.values())
        messages = [
            encode(_body(fraction * F[name]), agent=name, sequence=k, precision="float16", form="factor")
            for name in "abc"
            for k, fraction in enumerate((0.25, 0.5, 1.0))
        ]
        claimed = _filled(messages * 2).information.matrix
        assert np.linalg.eigvalsh(claimed - truth)[-1] <= 1e-12 * np.abs(truth).max()
        naive = sum(decode(data).information.matrix for data in messages * 2)
        assert np.linalg.eigvalsh(naive - truth)[0] > 0.0

    def test_a_delta_waits_for_its_base(self):
        traffic = Traffic(5)
        receiver = _filled([traffic.messages[1], traffic.delta])
        assert [m.sequence for m in receiver.waiting] == [4]
        assert [c.message.sequence for c in receiver.contributions] == [2]
        receiver.receive(traffic.base)
        assert not receiver.waiting
        assert [c.message.sequence for c in receiver.contributions] == [4]

    def test_the_whole_image_stands_for_its_tiles_and_no_pixel_counts_twice(self):
        rng = np.random.default_rng(6)
        tiles = [(0, 0, 32, 32), (16, 16, 32, 32), (48, 0, 16, 16), (31, 0, 4, 4)]
        parts = [encode(_body(definite(rng)), agent="a", sequence=k, tile=t) for k, t in enumerate(tiles)]
        for order in permutations(range(4)):
            kept = [c.message.tile for c in _filled([parts[k] for k in order]).contributions]
            assert kept == [(0, 0, 32, 32), (48, 0, 16, 16)]
        whole = encode(_body(definite(rng)), agent="a", sequence=0)
        other = encode(_body(definite(rng)), agent="b", sequence=0, tile=(0, 0, 32, 32))
        kept = [(c.message.agent, c.message.tile) for c in _filled([*parts, whole, other]).contributions]
        assert kept == [("a", None), ("b", (0, 0, 32, 32))]

    def test_two_different_messages_of_one_number_do_not_depend_on_who_was_first(self):
        rng = np.random.default_rng(7)
        pair = [encode(_body(definite(rng)), agent="a", sequence=1) for _ in range(2)]
        one, other = _filled(pair).information, _filled(pair[::-1]).information
        np.testing.assert_array_equal(one.matrix, other.matrix)

    def test_prior_and_messages_add(self):
        rng = np.random.default_rng(8)
        prior, F = definite(rng), definite(rng)
        receiver = InformationFilter(_body(prior).to_frame("world"))
        data = encode(_body(F), agent="a", sequence=1)
        receiver.receive(data)
        np.testing.assert_allclose(
            receiver.information.matrix, prior + decode(data).information.matrix, rtol=1e-13
        )

    @pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")
    def test_noise_of_many_agents_does_not_look_like_information(self):
        rng = np.random.default_rng(9)
        receiver = _empty()
        F = definite(rng, 4)
        for k in range(30):
            matrix, covariance = noisy(rng, F, error=0.05)
            receiver.receive(encode(_body(matrix, covariance=covariance), agent=f"{k}", sequence=0))
        assert cramer_rao_bound(receiver.information).rank == 4


class TestBadInput:
    def test_corrupt_and_foreign_messages_leave_it_as_it_was(self):
        receiver = _filled(Traffic(10).messages)
        before = receiver.information
        data = bytearray(Traffic(11).base)
        data[60] ^= 1
        with pytest.raises(MessageError):
            receiver.receive(bytes(data))
        F = definite(np.random.default_rng(12))
        for foreign in (_body(F, variable="other"), _body(F, pose=se3.exp([0, 0, 1e-3, 0, 0, 0]) @ POSE)):
            with pytest.raises(FrameError, match="message 9 of 'x'"):
                receiver.receive(encode(foreign, agent="x", sequence=9))
        np.testing.assert_array_equal(receiver.information.matrix, before.matrix)

    def test_impossible_motions(self):
        receiver = _empty()
        with pytest.raises(PoseError):
            receiver.predicted(np.diag([2.0, 2.0, 2.0, 1.0]), np.eye(6))
        for Q, match in (
            (-np.eye(6), "semi-definite"),
            (np.eye(5), "6 x 6"),
            (np.full((6, 6), np.nan), "fin"),
        ):
            with pytest.raises(FusionError, match=match):
                receiver.predicted(np.eye(4), Q)


class TestPrediction:
    def _moved(self, F, motion, Q, covariance=None):
        return InformationFilter(_body(F, covariance=covariance)).predicted(motion, Q).information

    def test_covariances_add(self):
        rng = np.random.default_rng(13)
        for rank in (6, 2):
            F, Q, motion = definite(rng), definite(rng, rank), random_pose(rng)
            A = se3.adjoint(se3.inverse(motion))
            expected = A @ np.linalg.inv(F) @ A.T + Q
            moved = self._moved(F, motion, Q)
            assert misfit(np.linalg.inv(moved.matrix), expected) < 1e-9
            np.testing.assert_allclose(moved.pose, POSE @ motion, atol=1e-14)

    def test_a_certain_motion_loses_nothing(self):
        rng = np.random.default_rng(14)
        F, motion = definite(rng, 3), random_pose(rng)
        back = InformationFilter(self._moved(F, motion, np.zeros((6, 6))))
        again = back.predicted(se3.inverse(motion), np.zeros((6, 6))).information
        np.testing.assert_allclose(again.matrix, F, atol=1e-12)

    @pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")
    def test_what_is_unseen_stays_unseen(self):
        rng = np.random.default_rng(15)
        matrix, covariance = noisy(rng, 100.0 * definite(rng, 4), error=0.1)
        for Q in (np.zeros((6, 6)), 1e-4 * definite(rng), 1e-2 * definite(rng)):
            moved = self._moved(matrix, random_pose(rng), Q, covariance)
            assert np.linalg.eigvalsh(moved.matrix)[0] > -1.0
            assert cramer_rao_bound(moved).rank == 4

    def test_noise_is_not_made_to_look_certain(self):
        """Negative control: shrinking unresolved noise as if it were information leaves it significant."""
        rng = np.random.default_rng(16)
        naive, right = 0, 0
        Q = 1e4 * np.eye(6)
        for _ in range(40):
            matrix, covariance = noisy(rng, np.diag([1e4, 1e4, 1e4, 1e4, 1e4, 0.0]), error=1.0)
            moved = self._moved(matrix, np.eye(4), Q, covariance)
            shrunk = np.linalg.solve(np.eye(6) + matrix @ Q, matrix)
            naive += np.linalg.eigvalsh(0.5 * (shrunk + shrunk.T))[0] > 1e-5
            right += np.linalg.eigvalsh(moved.matrix)[0] > 1e-5
        assert naive >= 10
        assert right <= 1

    def test_entries_uncertainty_is_the_derivative(self):
        rng = np.random.default_rng(17)
        F, Q, motion = definite(rng), definite(rng), random_pose(rng)
        direction = definite(rng) - definite(rng)
        direction = 0.5 * (direction + direction.T)
        step = 1e-6
        change = (
            self._moved(F + step * direction, motion, Q).matrix
            - self._moved(F - step * direction, motion, Q).matrix
        ) / (2.0 * step)
        packed = direction[np.triu_indices(6)]
        moved = self._moved(F, motion, Q, np.outer(step * packed, step * packed))
        np.testing.assert_allclose(moved.standard_error, step * np.abs(change), rtol=1e-4, atol=1e-12)

    def test_messages_about_the_old_pose_come_too_late(self):
        traffic = Traffic(18)
        moved = _filled(traffic.messages[:3]).predicted(se3.exp([0.1, 0, 0, 0, 0, 0]), 1e-4 * np.eye(6))
        with pytest.raises(FrameError):
            moved.receive(traffic.messages[6])
        F = definite(np.random.default_rng(19))
        now = _body(F, pose=moved.information.pose)
        before = moved.information.matrix
        moved.receive(encode(now, agent="b", sequence=1))
        assert np.linalg.eigvalsh(moved.information.matrix - before)[0] > 0.0
