"""Messages: never above what was encoded, useful up to the stated condition, and safe to read whatever comes.

Random matrices are drawn with four kinds of spectra between 1 and 1/κ: spread evenly over the decades, one
strong direction, one weak one, three of each.
"""

from __future__ import annotations

import dataclasses
import struct
import zlib

import numpy as np
import pytest
from rigs import made

from mitsuba_crb import se3
from mitsuba_crb.agents.entry_noise import noise_bound
from mitsuba_crb.agents.message import decode, encode, message_size
from mitsuba_crb.agents.quantisation import FORMS, UNIT_ROUNDOFF, kept_fraction, quantise
from mitsuba_crb.bound.cramer_rao import cramer_rao_bound
from mitsuba_crb.errors import FrameError, MessageError
from mitsuba_crb.information.linearisation import PixelSelection
from mitsuba_crb.information.symmetric import congruence, pack

POSE = se3.exp([1.0, -2.0, 0.5, 0.4, -0.3, 0.8])
FAR = np.array([[1.0, 0, 0, 5e6], [0, 1, 0, -4e5], [0, 0, 1, 2e6], [0, 0, 0, 1]]) @ POSE

LIMITS = {"float16": (1e4, 0.94), "float32": (1e10, 0.99)}
"""Condition up to which factors keep at least this fraction in every direction."""

COMBINATIONS = [(form, precision) for form in FORMS for precision in LIMITS]


def _spectrum(rng, condition):
    kind = rng.integers(4)
    if kind == 0:
        values = condition ** -rng.uniform(size=6)
        values[:2] = 1.0, 1.0 / condition
        return values
    return np.where(np.arange(6) < (1, 3, 5)[kind - 1], 1.0, 1.0 / condition)


def _definite(rng, condition):
    Q = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    matrix = 10.0 ** rng.uniform(-12, 12) * (Q * _spectrum(rng, condition)) @ Q.T
    return 0.5 * (matrix + matrix.T)


def _singular(rng):
    """Rank 0 to 5, rows in mixed units; one in three of small integers, with no rounding to hide behind."""
    rank = int(rng.integers(6))
    if rng.integers(3) == 0:
        factor = rng.integers(-8, 9, size=(6, rank)).astype(float)
    else:
        factor = rng.normal(size=(6, rank)) * 10.0 ** rng.uniform(-4, 4, size=(6, 1))
    return factor @ factor.T


def _nearly_singular(rng):
    return _definite(rng, 10.0 ** rng.uniform(11, 18))


def _indefinite(rng):
    Q = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    values = _spectrum(rng, 1e4) * rng.choice([-1.0, 1.0], size=6)
    return 0.5 * ((Q * values) @ Q.T + ((Q * values) @ Q.T).T)


def _scaled(quantised, matrix):
    d = quantised.row_scales
    return matrix / np.outer(d, d)


def _made(matrix, covariance=None, **changes):
    return made(matrix, covariance, **({"pose": POSE} | changes))


def _some_covariance(rng, size=1.0):
    root = rng.normal(size=(21, 30))
    return size**2 * root @ root.T / 30


def _noisy_estimate(rng, J, *, batches=4, noise=1.0):
    """An information estimated without bias from noisy Jacobians (`information`)."""
    values = J + noise * rng.normal(size=(batches, *J.shape))
    total = values.sum(axis=0)
    matrix = (total.T @ total - sum(v.T @ v for v in values)) / (batches * (batches - 1))
    return 0.5 * (matrix + matrix.T)


class TestNeverOverConfident:
    def _check(self, rng, form, precision, kind):
        condition, kept = LIMITS[precision]
        u = UNIT_ROUNDOFF[precision]
        if kind == "definite":
            # The rotation's rounding and its own scaling move the condition by less than this.
            F = _definite(rng, condition ** rng.uniform(0.2, 1.0))
        else:
            F = {"singular": _singular, "near": _nearly_singular, "indefinite": _indefinite}[kind](rng)
        quantised = quantise(F, form=form, precision=precision)
        G, decoded = _scaled(quantised, F), quantised.scaled_matrix
        norm = np.linalg.norm(G, 2)
        assert np.linalg.eigvalsh(decoded - G)[-1] <= 1e-12 * norm
        assert np.linalg.eigvalsh(quantised.matrix - F)[-1] <= 1e-12 * np.linalg.norm(F, 2)
        if kind == "definite":
            assert kept_fraction(quantised.matrix, F) >= kept
            assert quantised.shift == 0.0
        elif kind != "indefinite":
            assert quantised.shift <= 8.0 * u * norm
            assert np.linalg.eigvalsh(decoded)[0] >= -2.0 * quantised.shift - 1e-14 * norm
        else:
            lowest = np.linalg.eigvalsh(G)[0]
            assert np.linalg.eigvalsh(decoded)[0] >= lowest - 2.0 * 8.0 * u * norm
            assert quantised.shift <= max(0.0, -lowest) + 8.0 * u * norm

    @pytest.mark.slow
    def test_ten_thousand_matrices(self):
        rng = np.random.default_rng(6)
        kinds = ["definite"] * 5 + ["singular", "singular", "near", "near", "indefinite"]
        for k in range(10_000):
            form, precision = COMBINATIONS[k // 10 % len(COMBINATIONS)]
            self._check(rng, form, precision, kinds[k % 10])

    @pytest.mark.slow
    @pytest.mark.parametrize(("form", "precision"), COMBINATIONS)
    @pytest.mark.parametrize("kind", ["definite", "singular", "near", "indefinite"])
    def test_ten_thousand_matrices_of_every_kind_in_every_form(self, form, precision, kind):
        rng = np.random.default_rng(7)
        for _ in range(10_000):
            self._check(rng, form, precision, kind)

    def test_rounding_to_nearest_would_be_over_confident(self):
        rng = np.random.default_rng(8)
        over = 0
        for _ in range(200):
            F = _definite(rng, 1e4)
            F /= np.abs(F).max()
            rounded = F.astype(np.float16).astype(float)
            over += np.linalg.eigvalsh(rounded - F)[-1] > 1e-12 * np.linalg.norm(F, 2)
        assert over >= 195

    def test_one_number_per_entry_could_not_keep_the_weak_direction(self):
        """Why the full form has two: all nearly equal float16 entries of two rows, over two octaves."""
        values = np.arange(np.float16(1).view(np.uint16), np.float16(4).view(np.uint16), dtype=np.uint16)
        near = values[:, None] + np.arange(-3, 4, dtype=np.int16).astype(np.uint16)
        corner, near = (bits.view(np.float16).astype(float) for bits in (values, near))
        corner, other, between = corner[:, None, None], near[:, :, None], near[:, None, :]
        along, across = corner + other - 2.0 * between, corner + other + 2.0 * between
        smallest = (along / across)[along > 0.0].min()
        assert smallest > 0.99 * UNIT_ROUNDOFF["float16"] / 4.0
        # λ_min / λ_max of P̂, kept along both, is at most 1 / (0.94 condition).
        assert 1.0 / (0.94 * smallest) < 9000.0
        F = np.eye(6)
        F[0, 1] = F[1, 0] = 1.0 - 2.0 / 1e4
        for form in FORMS:
            matrix = quantise(F, form=form, precision="float16").matrix
            assert kept_fraction(matrix, F) > 0.94

    def test_a_nearest_rounding_shrunk_to_be_safe_keeps_little(self):
        """The same for random matrices: G rounded entry by entry, less its largest error."""
        rng = np.random.default_rng(9)
        kept = {form: [] for form in FORMS}
        shrunk = []
        for _ in range(100):
            F = _definite(rng, 1e4)
            for form in FORMS:
                quantised = quantise(F, form=form, precision="float16")
                kept[form].append(kept_fraction(quantised.matrix, F))
            G = _scaled(quantised, F)
            rounded = G.astype(np.float16).astype(float)
            safe = rounded - np.linalg.eigvalsh(rounded - G)[-1] * np.eye(6)
            shrunk.append(kept_fraction(safe, G))
        assert min(min(fractions) for fractions in kept.values()) > 0.94
        assert np.median(shrunk) < 0.5

    @pytest.mark.parametrize("rank", range(1, 7))
    def test_a_sketch_keeps_its_strongest_directions(self, rank):
        rng = np.random.default_rng(10)
        for _ in range(50):
            F = _definite(rng, 1e4)
            quantised = quantise(F, form="sketch", precision="float16", rank=rank)
            assert np.linalg.eigvalsh(quantised.matrix - F)[-1] <= 1e-12 * np.linalg.norm(F, 2)
            assert kept_fraction(quantised.matrix, F, rank) >= 0.94
            assert np.linalg.matrix_rank(quantised.matrix, tol=1e-9 * np.linalg.norm(F, 2)) == rank
            # It cannot hold more of the trace than the largest eigenvalues do.
            best = np.linalg.eigvalsh(_scaled(quantised, F))[-rank:].sum()
            assert 0.94 * best <= np.trace(quantised.scaled_matrix) <= best * (1.0 + 1e-12)

    def test_negative_estimates_stay_negative(self):
        F = np.diag([4.0, 3.0, 2.0, 1.0, -0.5, -0.25])
        for form, precision in COMBINATIONS:
            np.testing.assert_allclose(
                np.diagonal(quantise(F, form=form, precision=precision).matrix), np.diagonal(F), atol=0.01
            )
        few = quantise(F, form="sketch", precision="float32", rank=2)
        assert few.shift >= 0.5
        assert np.linalg.eigvalsh(few.matrix - F)[-1] <= 1e-15

    def test_zero_and_units_far_apart(self):
        for form, precision in COMBINATIONS:
            assert not quantise(np.zeros((6, 6)), form=form, precision=precision).matrix.any()
            d = np.array([1e-30, 1e-12, 1.0, 1e9, 1e20, 1e33])
            F = np.outer(d, d) * (np.eye(6) + 0.5)
            decoded = quantise(F, form=form, precision=precision).matrix / np.outer(d, d)
            np.testing.assert_allclose(decoded, np.eye(6) + 0.5, atol=0.01)

    def test_numbers_beyond_the_scaling_are_refused(self):
        with pytest.raises(MessageError, match="length unit"):
            quantise(np.eye(6) * 1e80, form="factor", precision="float32")


class TestKeptFraction:
    def test_it_is_the_smallest_ratio_over_directions(self):
        rng = np.random.default_rng(11)
        F = _definite(rng, 100.0)
        decoded = quantise(F, form="factor", precision="float16").matrix
        directions = rng.normal(size=(20_000, 6)) @ np.linalg.inv(np.linalg.cholesky(F))
        ratios = np.einsum("ni,ij,nj->n", directions, decoded, directions)
        ratios /= np.einsum("ni,ij,nj->n", directions, F, directions)
        kept = kept_fraction(decoded, F)
        assert kept <= ratios.min() <= kept + 0.3 * (ratios.max() - kept)

    def test_directions_without_information_do_not_count(self):
        F = np.diag([1.0, 2.0, 3.0, 0.0, 0.0, 0.0])
        assert kept_fraction(0.9 * F, F) == pytest.approx(0.9)
        assert kept_fraction(np.zeros((6, 6)), np.zeros((6, 6))) == 1.0
        assert kept_fraction(np.diag([1.0, 1.0, 3.0, 0, 0, 0]), F, rank=2) == pytest.approx(1.0)
        assert kept_fraction(-F, F) == 0.0


class TestNoise:
    def test_the_bound_holds_in_the_loewner_order(self):
        rng = np.random.default_rng(12)
        for _ in range(200):
            G = _singular(rng) if rng.integers(2) else _indefinite(rng)
            G /= max(np.abs(G).max(), 1e-300)
            T = congruence(rng.normal(size=(6, 6)) * 10.0 ** rng.uniform(-3, 0, size=(1, 6)))
            covariance = T @ _some_covariance(rng, 10.0 ** rng.uniform(-6, 1)) @ T.T
            bounding = noise_bound(G, covariance).covariance(G)
            d = 1.0 / np.sqrt(np.diagonal(bounding))
            assert np.linalg.eigvalsh(np.outer(d, d) * (bounding - covariance))[0] >= -1e-12

    def test_exact_information_has_none(self):
        assert noise_bound(np.eye(6), np.zeros((21, 21))).inflation == 0.0
        assert not decode(encode(_made(np.eye(6)), agent="a", sequence=0)).information.standard_error.any()

    def test_noise_that_swamps_everything_is_refused(self):
        with pytest.raises(MessageError, match="standard errors"):
            encode(_made(np.zeros((6, 6)), np.eye(21) * 1e40), agent="a", sequence=0)

    @pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")
    @pytest.mark.parametrize("precision", ["float16", "float32"])
    @pytest.mark.slow
    def test_a_receiver_does_not_take_unseen_directions_for_seen_ones(self, precision):
        """Four agents that do not see two directions; without the noise bound many would claim to."""
        rng = np.random.default_rng(13)
        J = rng.normal(size=(400, 6))
        J[:, [2, 5]] = 0.0
        draws = np.array([_noisy_estimate(rng, J) for _ in range(2000)])
        covariance = np.cov(pack(draws).T)
        right, silent = 0, 0
        for trial in range(40):
            total, exact = None, np.zeros((6, 6))
            for agent in range(4):
                information = _made(draws[4 * trial + agent], covariance)
                received = decode(encode(information, agent=f"{agent}", sequence=0, precision=precision))
                exact += received.information.matrix
                total = received.information if total is None else total + received.information
            right += cramer_rao_bound(total).rank == 4
            silent += cramer_rao_bound(_made(exact)).rank == 4
        # 95 % of a binomial with the rank rule's own 99 %.
        assert right >= 38
        assert silent <= 20


class TestBytes:
    @pytest.mark.parametrize(("form", "precision"), COMBINATIONS)
    def test_everything_comes_back(self, form, precision):
        rng = np.random.default_rng(14)
        information = _made(
            _definite(rng, 100.0),
            _some_covariance(rng),
            variable="rig αβ",
            selection=PixelSelection("random", 4000, 400, "random:0.1"),
        ).to_frame("world")
        tile = (16, 32, 64, 8)
        data = encode(
            information, agent="robot é", sequence=2**63 + 5, tile=tile, form=form, precision=precision
        )
        assert len(data) == message_size(agent="robot é", variable="rig αβ", form=form, precision=precision)
        message = decode(data)
        assert (message.agent, message.sequence, message.tile) == ("robot é", 2**63 + 5, tile)
        assert message.base is None
        assert (message.size, message.checksum) == (len(data), zlib.crc32(data[:-4]))
        received = message.information
        assert (received.variable, received.frame) == ("rig αβ", "world")
        assert received.length_scale == 2.0
        np.testing.assert_allclose(received.pose, POSE, atol=1e-15)
        selection = received.selection
        assert (selection.kind, selection.total, selection.selected) == ("random", 4000, 400)
        received + information
        expected = quantise(information.to_frame("camera").matrix, form=form, precision=precision)
        np.testing.assert_array_equal(received.to_frame("camera").matrix, expected.matrix)
        exact = kept_fraction(expected.matrix, information.to_frame("camera").matrix)
        assert exact - 2 / 65535 <= message.kept <= exact

    def test_the_full_form_costs_twice_the_factor(self):
        sizes = [message_size(agent="a", variable="v", form=form, precision="float16") for form in FORMS]
        assert sizes == [150 + n * 2 for n in (42, 21, 36)]

    def test_a_sketch_costs_its_columns(self):
        sizes = [
            message_size(agent="a", variable="v", form="sketch", precision="float16", rank=rank)
            for rank in range(1, 7)
        ]
        assert np.diff(sizes).tolist() == [12] * 5
        assert sizes[0] == 144 + 2 + 12 + 4
        for rank, size in enumerate(sizes, start=1):
            data = encode(
                _made(np.eye(6), variable="v"),
                agent="a",
                sequence=1,
                form="sketch",
                precision="float16",
                rank=rank,
            )
            assert len(data) == size
            assert decode(data).quantised.rank == rank

    def test_the_layout_is_the_documented_one(self):
        information = _made(np.diag([4.0, 1.0, 16.0, 1.0, 1.0, 1.0]), variable="rig")
        base = decode(encode(information, agent="ab", sequence=7, tile=(1, 2, 3, 4)))
        more = dataclasses.replace(information, matrix=2.0 * information.matrix)
        data = encode(more, agent="ab", sequence=9, tile=(1, 2, 3, 4), precision="float16", base=base)

        def at(offset, code):
            return struct.unpack_from("<" + code, data, offset)

        assert data[:4] == b"MCRB"
        assert at(4, "10B") == (1, 1, 2, 0, 6, 0, 2, 3, 0, 1)
        assert at(14, "H")[0] >= 65500
        assert at(16, "6b") == (2, 1, 3, 1, 1, 1)
        assert at(22, "2QI") == (9, 7, base.checksum)
        assert at(42, "4H") == (1, 2, 3, 4)
        assert at(50, "2I") == (100, 100)
        np.testing.assert_allclose(at(58, "3d"), POSE[:3, 3])
        assert np.linalg.norm(at(82, "4d")) == pytest.approx(1.0)
        assert at(114, "d") == (2.0,)
        assert at(122, "f")[0] == pytest.approx(1.0, abs=1e-2)
        assert at(126, "3f6b") == (0.0,) * 9
        assert data[144:149] == b"abrig"
        assert len(data) == 149 + 2 * 21 + 4
        np.testing.assert_allclose(at(149, "21e")[::6], [0.5, 0, 0, 0], atol=0.02)
        assert at(len(data) - 4, "I") == (zlib.crc32(data[:-4]),)

    def test_far_from_the_origin_both_frames_lose_nothing(self):
        information = _made(_definite(np.random.default_rng(15), 1e3), pose=FAR)
        for frame in ("camera", "world"):
            data = encode(information.to_frame(frame), agent="a", sequence=1, precision="float16")
            message = decode(data)
            assert message.information.frame == frame
            assert message.kept > 0.97
            camera = message.information.to_frame("camera").matrix
            assert np.linalg.eigvalsh(camera - information.matrix)[-1] <= 1e-12 * np.abs(camera).max()


class TestDelta:
    def _states(self):
        rng = np.random.default_rng(16)
        first = _definite(rng, 100.0)
        second = first + np.abs(first).max() * _definite(rng, 50.0) / 1e12
        return _made(first), _made(second, 1e-6 * np.abs(first).max() ** 2 * np.eye(21))

    @pytest.mark.parametrize("form", FORMS)
    def test_base_and_delta_are_never_above_the_whole(self, form):
        rng = np.random.default_rng(17)
        for _ in range(50):
            F = _definite(rng, 1e3)
            whole = F + np.linalg.norm(F, 2) * _singular(rng) / 1e4
            base = decode(encode(_made(F), agent="a", sequence=1, precision="float16"))
            data = encode(_made(whole), agent="a", sequence=2, form=form, precision="float16", base=base)
            delta = decode(data)
            decoded = delta.on(base).matrix
            assert np.linalg.eigvalsh(decoded - whole)[-1] <= 1e-12 * np.linalg.norm(whole, 2)
            assert len(data) == message_size(agent="a", variable="camera", form=form, precision="float16")

    def test_it_makes_up_for_the_base_s_rounding(self):
        first, second = self._states()
        base = decode(encode(first, agent="a", sequence=1, precision="float16"))
        again = decode(encode(second, agent="a", sequence=2, precision="float16"))
        delta = decode(encode(second, agent="a", sequence=2, precision="float16", base=base))
        assert kept_fraction(delta.on(base).matrix, second.matrix) > kept_fraction(
            again.information.matrix, second.matrix
        )
        assert delta.kept == pytest.approx(kept_fraction(delta.on(base).matrix, second.matrix), abs=2e-5)

    def test_its_covariance_is_that_of_the_whole(self):
        first, second = self._states()
        base = decode(encode(first, agent="a", sequence=1))
        delta = decode(encode(second, agent="a", sequence=2, base=base))
        slack = delta.on(base).covariance_of_entries - second.covariance_of_entries
        assert np.linalg.eigvalsh(slack)[0] >= -1e-9 * np.abs(second.covariance_of_entries).max()

    def test_it_fits_its_own_base_only(self):
        first, second = self._states()
        base = decode(encode(first, agent="a", sequence=1))
        delta = decode(encode(second, agent="a", sequence=2, base=base))
        others = [
            encode(first, agent="b", sequence=1),
            encode(first, agent="a", sequence=0),
            encode(second, agent="a", sequence=1),
            encode(first, agent="a", sequence=1, tile=(0, 0, 8, 8)),
        ]
        for other in others:
            with pytest.raises(MessageError, match="does not add"):
                delta.on(decode(other))
        with pytest.raises(MessageError, match="another delta"):
            encode(second, agent="a", sequence=3, base=delta)
        with pytest.raises(MessageError, match="comes after its base"):
            encode(second, agent="a", sequence=1, base=base)
        with pytest.raises(MessageError, match="the base is about"):
            encode(second, agent="b", sequence=2, base=base)
        with pytest.raises(FrameError):
            encode(second.about(variable="other"), agent="a", sequence=2, base=base)


class TestBadInput:
    @pytest.mark.parametrize(
        ("changes", "match"),
        [
            ({"form": "fulll"}, "unknown form"),
            ({"precision": "float64"}, "unknown precision"),
            ({"rank": 0}, "1 to 6"),
            ({"rank": 7}, "1 to 6"),
            ({"agent": ""}, "1 to 255"),
            ({"agent": "é" * 128}, "1 to 255"),
            ({"sequence": -1}, "sequence"),
            ({"sequence": 2**64}, "sequence"),
            ({"sequence": 1.5}, "sequence"),
            ({"tile": (0, 0, 0, 5)}, "tile"),
            ({"tile": (0, 0, 65536, 5)}, "tile"),
            ({"tile": (-1, 0, 5, 5)}, "tile"),
            ({"tile": (0, 0, 5)}, "tile"),
        ],
    )
    def test_what_does_not_fit_is_named(self, changes, match):
        with pytest.raises(MessageError, match=match):
            encode(_made(np.eye(6)), **({"agent": "a", "sequence": 1} | changes))

    def test_so_are_poses_and_images_too_large(self):
        pose = np.eye(4)
        pose[0, 3] = 1e13
        with pytest.raises(MessageError, match="origin"):
            encode(_made(np.eye(6), pose=pose), agent="a", sequence=1)
        selection = PixelSelection("all", 2**32, 2**32, "all")
        with pytest.raises(MessageError, match="pixels"):
            encode(_made(np.eye(6), selection=selection), agent="a", sequence=1)

    def test_corrupt_messages_are_named(self):
        data = encode(_made(np.eye(6)), agent="a", sequence=1)
        flipped = data[:150] + bytes([data[150] ^ 1]) + data[151:]
        for broken, match in (
            (b"", "at least"),
            (data[:-1], "checksum"),
            (data + b"\0", "checksum"),
            (flipped, "checksum"),
            (b"JPEG" + data[4:], "starts with"),
            (data[:4] + b"\2" + data[5:], "version 2"),
            (_repaired(data[:-4] + b"\0" + data[-4:]), "announces"),
            (_repaired(data[:7] + b"\2" + data[8:]), "impossible frame"),
            (_repaired(data[:8] + b"\0" + data[9:]), "impossible rank"),
            (_repaired(data[:122] + struct.pack("<f", np.nan) + data[126:]), "impossible α"),
            (_repaired(data[:144] + b"\xff" + data[145:]), "UTF-8"),
        ):
            with pytest.raises(MessageError, match=match):
                decode(broken)

    def test_every_single_bit_flip_is_noticed(self):
        data = encode(_made(np.eye(6)), agent="a", sequence=1, precision="float16")
        for bit in range(8 * len(data)):
            broken = bytearray(data)
            broken[bit // 8] ^= 1 << bit % 8
            with pytest.raises(MessageError):
                decode(bytes(broken))

    @pytest.mark.slow
    def test_a_hundred_thousand_strange_byte_strings(self):
        """Noise, cut, damaged; and damaged with a good checksum, where only the fields' checks protect."""
        rng = np.random.default_rng(18)
        originals = [
            encode(_made(matrix, covariance).to_frame(frame), agent="ag", sequence=3, form=form, precision=p)
            for form, p in COMBINATIONS
            for matrix in (_definite(rng, 1e3), _singular(rng), _indefinite(rng))
            for covariance in (None, _some_covariance(rng))
            for frame in ("camera", "world")
        ]
        valid = 0
        for k in range(100_000):
            data = bytearray(originals[int(rng.integers(len(originals)))])
            kind = k % 4
            if kind == 0:
                data = bytearray(rng.bytes(int(rng.integers(400))))
                data[: len(data) // 2 * 2 // 50] = b"MCRB\1"[: len(data) // 50]
            elif kind == 1:
                del data[int(rng.integers(len(data))) :]
            else:
                for _ in range(int(rng.integers(1, 5))):
                    data[int(rng.integers(len(data)))] = int(rng.integers(256))
            if kind == 3:
                # A third of them with whole fields at once, where the extreme floats are.
                if k % 3 == 0:
                    start = int(rng.choice([58, 66, 82, 90, 106, 114, 122, 126, 130, 134, 138, 146, 154]))
                    data[start : start + 4] = rng.bytes(4)
                data = bytearray(_repaired(bytes(data)))
            try:
                message = decode(bytes(data))
            except MessageError:
                continue
            valid += 1
            information = message.information
            assert np.isfinite(information.matrix).all()
            assert np.isfinite(information.covariance_of_entries).all()
            assert np.array_equal(information.matrix, information.matrix.T)
            assert 0.0 <= message.kept <= 1.0
        # The checks are no blanket refusal.
        assert valid > 5_000


def _repaired(data):
    """With a checksum that fits."""
    return data[:-4] + struct.pack("<I", zlib.crc32(data[:-4]))
