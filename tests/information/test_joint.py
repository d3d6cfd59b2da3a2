"""Information of the pose together with nuisance parameters: more columns, Schur complements, undoing."""

from __future__ import annotations

from itertools import pairwise, permutations

import numpy as np
import pytest
from matrices import misfit
from rigs import about

from mitsuba_crb.errors import NoiseError, NuisanceError, OptionError, PixelsError
from mitsuba_crb.information.accumulate import InformationAccumulator
from mitsuba_crb.information.blocks import BLOCK
from mitsuba_crb.information.joint import JointAccumulator
from mitsuba_crb.information.linearisation import PixelSelection
from mitsuba_crb.information.symmetric import pack

ALL = PixelSelection("all", 16 * 32, 16 * 32, "all")


class Columns:
    """A Jacobian of six columns of the twist and some more, and estimates of it with independent errors."""

    def __init__(self, nuisances: int = 2, *, noise: float = 0.8, batches: int = 4, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        y, x = np.divmod(np.arange(16 * 32), 32)
        self.pixels = np.stack([x, y], axis=1)
        mixing = rng.normal(size=(6 + nuisances, 6 + nuisances))
        self.J = (rng.normal(size=(len(x), 3, 6 + nuisances)) + 0.5) @ mixing
        self.weights = rng.uniform(0.5, 2.0, size=(len(x), 3))
        self.noise, self.batches = noise, batches
        self.rng = np.random.default_rng(seed + 1)
        self.truth = np.einsum("nci,nc,ncj->ij", self.J, self.weights, self.J)

    def draw(self):
        return self.J + self.noise * self.rng.normal(size=(self.batches, *self.J.shape))

    def sums(self, values, *, block=1, sampled=False, selection=ALL):
        accumulator = InformationAccumulator(
            batches=len(values), block=block, sampled=sampled, columns=values.shape[-1]
        )
        accumulator.add(values, self.weights, self.pixels)
        return accumulator.sums(selection)


class TestMoreColumns:
    @pytest.mark.parametrize("block", [1, BLOCK])
    @pytest.mark.parametrize("kind", ["all", "random"])
    def test_the_pose_block_is_the_information_of_six_columns(self, block, kind):
        view = Columns(3)
        values = view.draw()
        selection = PixelSelection(kind, 1024, 512, kind)
        joint = view.sums(values, block=block, sampled=True, selection=selection)
        six = view.sums(values[..., :6], block=block, sampled=True, selection=selection)
        assert misfit(joint.matrix[:6, :6], six.matrix) < 1e-10
        assert misfit(joint.plain_matrix[:6, :6], six.plain_matrix) < 1e-10
        rows, columns = np.triu_indices(9)
        pose = (rows < 6) & (columns < 6)
        part = joint.covariance_of_entries[np.ix_(pose, pose)]
        # The positive part is taken of the whole, which changes little of the part.
        scale = np.sqrt(np.diagonal(six.covariance_of_entries))
        assert np.abs(part - six.covariance_of_entries).max() / np.outer(scale, scale).max() < 0.2
        np.testing.assert_allclose(np.diagonal(part), np.diagonal(six.covariance_of_entries), rtol=1e-8)

    def test_without_monte_carlo_noise_it_is_the_gram_matrix(self):
        view = Columns(2, noise=0.0)
        sums = view.sums(view.draw())
        assert misfit(sums.matrix, view.truth) < 1e-10

    def test_covariance_of_entries_is_the_enumeration_of_disjoint_pairs(self):
        view = Columns(1)
        values = view.draw()
        accumulator = InformationAccumulator(batches=4, columns=7)
        accumulator.add(values, view.weights, view.pixels)
        unit = (view.pixels // 4) @ [1, 1000]
        members = (np.unique(unit)[:, None] == unit).astype(float)
        h = {
            (k, j): members
            @ (
                pack(np.einsum("nci,nc,ncj->nij", values[k], view.weights, values[j]))
                + pack(np.einsum("nci,nc,ncj->nji", values[k], view.weights, values[j]))
            )
            for k, j in permutations(range(4), 2)
        }
        mean = np.mean(list(h.values()), axis=0)
        expected = mean.T @ mean - np.mean(
            [h[k, j].T @ h[p, q] for k, j, p, q in permutations(range(4), 4)], axis=0
        )
        actual = accumulator._units.unbiased
        np.testing.assert_allclose(actual, 0.25 * expected, atol=1e-9 * np.abs(expected).max())


def _joint(view: Columns, names: tuple[str, ...], values=None, **options):
    accumulator = JointAccumulator(names, batches=view.batches, **options)
    accumulator.add(view.draw() if values is None else values, view.weights, view.pixels)
    return accumulator.information(about(selection=ALL))


def _schur(matrix, unknown):
    """By the inverse: the pose's block of F⁻¹, inverted."""
    kept = [*range(6), *unknown]
    return np.linalg.inv(np.linalg.inv(matrix[np.ix_(kept, kept)])[:6, :6])


class TestMarginal:
    names = ("gain", "fov", "point", "point")
    columns = {"gain": [6], "fov": [7], "point": [8, 9]}  # noqa: RUF012  read only

    @pytest.mark.parametrize(
        "unknown", [(), ("gain",), ("point",), ("point", "gain"), ("gain", "fov", "point")]
    )
    def test_it_is_the_inverse_of_the_pose_block_of_the_inverse(self, unknown):
        joint = _joint(Columns(4), self.names)
        information = joint.marginalize(*unknown).fix().information if unknown else joint.fix().information
        expected = _schur(joint.matrix, [c for name in unknown for c in self.columns[name]])
        np.testing.assert_allclose(
            information.matrix, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max()
        )

    def test_unknown_is_never_more_than_known_and_each_nuisance_only_takes(self):
        """The Loewner order, to rounding; the negative control has the order reversed."""
        joint = _joint(Columns(4, noise=2.0), self.names)
        chain = [joint.fix().information]
        for count in (1, 2, 3):
            chain.append(joint.marginalize(*("gain", "fov", "point")[:count]).fix().information)
        for more, less in pairwise(chain):
            smallest = np.linalg.eigvalsh(more.matrix - less.matrix)[0]
            assert smallest > -1e-9 * np.abs(more.matrix).max()
            assert np.linalg.eigvalsh(less.matrix - more.matrix)[0] < -1e-6 * np.abs(more.matrix).max()

    def test_restoring_gives_back_every_bit(self):
        joint = _joint(Columns(4), self.names)
        known = joint.fix().information
        undone = joint.marginalize().restore("gain").marginalize("gain").restore().fix().information
        assert np.array_equal(undone.matrix, known.matrix)
        assert np.array_equal(undone.covariance_of_entries, known.covariance_of_entries)
        unknown = joint.marginalize().information
        assert not np.array_equal(unknown.matrix, known.matrix)
        assert np.array_equal(joint.fix().restore().marginalize().information.matrix, unknown.matrix)

    def test_knowing_everything_is_the_information_of_six_columns(self):
        view = Columns(4)
        values = view.draw()
        six = view.sums(values[..., :6])
        known = _joint(view, self.names, values).fix().information
        assert misfit(known.matrix, six.matrix) < 1e-10
        assert misfit(known.plain_matrix, six.plain_matrix) < 1e-10

    def test_what_was_not_decided_is_asked_for(self):
        joint = _joint(Columns(4), self.names)
        with pytest.raises(NuisanceError, match="say of gain, point whether"):
            _ = joint.fix("fov").information
        for act in (joint.fix, joint.marginalize, joint.restore):
            with pytest.raises(NuisanceError, match="no nuisance glow; it has: gain, fov, point"):
                act("glow")

    @pytest.mark.slow
    def test_covariance_of_entries_is_that_of_repetitions(self):
        """Of 200 draws; relative error of a variance 10 %, so 21 of them stay within 4 errors. The covariance
        with η known instead is the negative control."""
        view = Columns(2, noise=1.5)
        draws, predicted, known = [], [], []
        for _ in range(200):
            joint = _joint(view, ("gain", "fov"))
            information = joint.marginalize().information
            draws.append(pack(information.matrix))
            predicted.append(np.diagonal(information.covariance_of_entries))
            known.append(np.diagonal(joint.fix().information.covariance_of_entries))
        variance = np.var(draws, axis=0, ddof=1)
        assert np.abs(np.mean(predicted, axis=0) / variance - 1.0).max() < 4 * np.sqrt(2 / 200)
        assert np.abs(np.mean(known, axis=0) / variance - 1.0).max() > 4 * np.sqrt(2 / 200)
        error = np.sqrt(variance / 200)
        expected = pack(_schur(view.truth, [6, 7]))
        # Second order in the noise: a bias well below one draw's standard error.
        assert np.abs((np.mean(draws, axis=0) - expected) / np.sqrt(variance)).max() < 0.5
        assert np.abs((np.mean(draws, axis=0) - expected) / error).max() < 8.0


class TestUnseen:
    def test_a_nuisance_without_derivative_costs_exactly_nothing(self):
        view = Columns(2)
        values = view.draw()
        values[..., 6] = 0.0
        joint = _joint(view, ("dark", "fov"), values)
        assert joint.unseen == ("dark",)
        assert joint.marginalize().unresolved == ()
        assert np.array_equal(
            joint.marginalize("dark").fix().information.matrix, joint.fix().information.matrix
        )

    def test_noise_alone_is_not_resolved_and_takes_nothing(self):
        """It may hide something, so that nobody can say that it costs nothing."""
        view = Columns(2, noise=1.0)
        view.J[..., 6] = 0.0
        joint = _joint(view, ("dark", "fov"))
        assert joint.unseen == ()
        assert joint.marginalize().unresolved == ("dark",)
        assert joint.fix().unresolved == ()
        assert np.array_equal(
            joint.marginalize("dark").fix().information.matrix, joint.fix().information.matrix
        )

    def test_two_that_cannot_be_told_apart_cost_as_much_as_one(self):
        view = Columns(2, noise=0.0)
        view.J[..., 7] = -3.0 * view.J[..., 6]
        joint = _joint(view, ("gain", "lamp"))
        assert joint.unseen == joint.marginalize().unresolved == ()
        both, one = joint.marginalize().information, joint.marginalize("gain").fix().information
        assert misfit(both.matrix, one.matrix) < 1e-9


class TestPerTile:
    def test_it_is_the_schur_complement_of_a_column_in_every_tile(self):
        """Exact Jacobians: two tiles of 16 x 16, each with its own gain, and one field of view."""
        view = Columns(3, noise=0.0)
        values = view.draw()
        joint = _joint(view, ("gain:16", "fov", "black:16"), values)
        assert joint.parameters == ("fov",)
        assert joint.per_tile == ("gain:16", "black:16")
        right = view.pixels[:, 0] >= 16
        pose, (gain, fov, black) = view.J[..., :6], np.moveaxis(view.J[..., 6:], -1, 0)
        columns = [
            gain * right[:, None],
            gain * ~right[:, None],
            fov,
            black * right[:, None],
            black * ~right[:, None],
        ]
        J = np.concatenate([pose, np.stack(columns, axis=-1)], axis=-1)
        whole = np.einsum("nci,nc,ncj->ij", J, view.weights, J)
        for unknown, own in (
            (("gain:16",), [6, 7]),
            (("black:16",), [9, 10]),
            (("gain:16", "fov"), [6, 7, 8]),
            (("gain:16", "fov", "black:16"), [6, 7, 8, 9, 10]),
        ):
            information = joint.marginalize(*unknown).fix().information
            np.testing.assert_allclose(
                information.matrix, _schur(whole, own), rtol=1e-8, atol=1e-8 * whole.max()
            )
        one = _joint(view, ("gain", "fov", "black"), values).marginalize("gain").fix().information
        many = joint.marginalize("gain:16").fix().information
        costs = np.linalg.eigvalsh(one.matrix - many.matrix)  # a gain per tile costs more
        assert costs[0] > -1e-9 * whole.max()
        assert costs[-1] > 1e-5 * whole.max()

    @pytest.mark.parametrize("case", ["ignored", "missing", "none in a call", "unlit", "of one pixel"])
    @pytest.mark.parametrize("noise", [0.0, 0.5])
    def test_a_tile_that_tells_nothing_of_it_costs_nothing(self, case, noise):
        """The right one of two: what is left is the Schur complement with a pseudo-inverse, exactly so
        without noise, and with it to 10 % of √(F_ii F_jj)."""
        view = Columns(2, noise=noise)
        right = view.pixels[:, 0] >= 16
        kept = np.ones(len(view.pixels), dtype=bool)
        if case == "ignored":
            view.weights[right] = 0.0
        elif case in ("missing", "none in a call"):
            kept = ~right
        elif case == "unlit":
            view.J[right, :, 6:] = 0.0
        else:
            view.weights[right] = 0.0
            view.weights[np.flatnonzero(right)[0]] = 1.0
        values = view.draw()
        accumulator = JointAccumulator(("gain:16", "black:16"), batches=4)
        parts = [~right & kept, right & kept] if case == "none in a call" else [kept]
        for part in parts:
            accumulator.add(values[:, part], view.weights[part], view.pixels[part])
        joint = accumulator.information(about(selection=PixelSelection("only", 512, 512, "")))
        columns = [view.J[..., k] * side[:, None] for k in (6, 7) for side in (right, ~right)]
        J = np.concatenate([view.J[..., :6], np.stack(columns, axis=-1)], axis=-1)[kept]
        whole = np.einsum("nci,nc,ncj->ij", J, view.weights[kept], J)
        for unknown, own in ((("gain:16",), [6, 7]), (("gain:16", "black:16"), [6, 7, 8, 9])):
            B, D = whole[:6, own], whole[np.ix_(own, own)]
            expected = whole[:6, :6] - B @ np.linalg.pinv(D, rcond=1e-12, hermitian=True) @ B.T
            found = joint.marginalize(*unknown).fix().information.matrix
            scale = np.sqrt(np.outer(np.diagonal(expected), np.diagonal(expected)))
            np.testing.assert_allclose(found / scale, expected / scale, atol=1e-8 if noise == 0.0 else 0.1)

    def test_an_image_that_tells_nothing_is_still_refused(self):
        view = Columns(1)
        accumulator = JointAccumulator(("gain:16",), batches=4)
        accumulator.add(view.draw(), 0.0 * view.weights, view.pixels)
        with pytest.raises(NoiseError, match="no information in any of 512 pixels"):
            accumulator.information(about(selection=ALL))

    def test_a_random_subset_is_refused_by_name(self):
        with pytest.raises(OptionError, match=r"gain:8, black:8 with random:f pixels.*a mask or gradient:f"):
            JointAccumulator(("gain:8", "fov", "black:8"), batches=4, sampled=True)
        JointAccumulator(("gain", "fov"), batches=4, sampled=True)

    @pytest.mark.parametrize(("name", "biased"), [("gain:8", True), ("gain", False)])
    def test_a_random_subset_of_a_tile_does_not_tell_what_a_nuisance_costs(self, name, biased):
        """The mean cost by an eighth of the pixels, eight times, is off by 6 standard errors; that of a
        nuisance of the whole image is within 4."""
        view = Columns(1, noise=0.0)
        values, rng = view.draw(), np.random.default_rng(4)

        def cost(index):
            accumulator = JointAccumulator((name,), batches=4)
            accumulator.add(values[:, index], view.weights[index], view.pixels[index])
            joint = accumulator.information(about(selection=ALL))
            lost = joint.fix().information.matrix - joint.marginalize().information.matrix
            return np.trace(lost) * 512 / len(index)

        costs = [cost(rng.permutation(512)[:64]) for _ in range(60)]
        deviation = (np.mean(costs) - cost(np.arange(512))) / (np.std(costs) / np.sqrt(len(costs)))
        assert deviation > 6.0 if biased else abs(deviation) < 4.0

    def test_a_tile_in_two_calls_is_refused(self):
        view = Columns(1)
        values = view.draw()
        accumulator = JointAccumulator(("gain:32",), batches=4)
        accumulator.add(values[:, :100], view.weights[:100], view.pixels[:100])
        with pytest.raises(PixelsError, match="32 x 32 tile came in two calls"):
            accumulator.add(values[:, 100:], view.weights[100:], view.pixels[100:])

    def test_tiles_that_do_not_fit_are_refused(self):
        with pytest.raises(NuisanceError, match="the same tiles, not 16, 32"):
            JointAccumulator(("gain:16", "black:32"), batches=4)
        with pytest.raises(NuisanceError, match="multiple of 8, not 20"):
            JointAccumulator(("gain:20",), batches=4)
