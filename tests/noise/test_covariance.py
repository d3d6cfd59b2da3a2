"""The check of a covariance or information matrix, and its roots, under scalings by units of any size."""

from __future__ import annotations

import numpy as np
import pytest

from mitsuba_crb.errors import FusionError, NoiseError
from mitsuba_crb.noise.covariance import (
    inverse_cholesky,
    nearest_semidefinite,
    positive_matrix,
    roots,
    symmetric_root,
    unit_diagonal,
)

UNITS = {
    "alike": np.ones(6),
    "mixed": 10.0 ** np.array([0, 0, 0, -5, -5, -5]),
    "extreme": 10.0 ** np.array([-15, -10, -5, 5, 10, 15]),
    "small": np.full(6, 1e-15),
}
"""Rows' units: a diagonal is their square, 1e-30 to 1e30."""

units = pytest.mark.parametrize("s", UNITS.values(), ids=UNITS)


def gram(rank: int, seed: int = 0) -> np.ndarray:
    A = np.random.default_rng(seed).standard_normal((6, rank))
    return A @ A.T


def in_units(matrix: np.ndarray, s: np.ndarray) -> np.ndarray:
    return matrix * np.outer(s, s)


def check(matrix: object, **options: object) -> np.ndarray:
    return positive_matrix(matrix, "the thing", FusionError, **options)


@units
class TestTheCheck:
    def test_passes_what_is_positive_in_any_units(self, s):
        for rank in range(7):
            matrix = in_units(gram(rank), s)
            np.testing.assert_array_equal(check(matrix, size=6), matrix)
        np.testing.assert_array_equal(check(in_units(gram(6), s), definite=True), in_units(gram(6), s))

    def test_takes_off_rounding_of_symmetry_and_passes_that_of_a_zero_eigenvalue(self, s):
        unit, _ = unit_diagonal(gram(5))
        _, axes = np.linalg.eigh(unit)
        slightly = unit - 1e-11 * np.outer(axes[:, 0], axes[:, 0])
        slightly[0, 1] += 1e-12
        passed = check(in_units(slightly, s))
        np.testing.assert_array_equal(passed, passed.T)
        np.testing.assert_allclose(passed / np.outer(s, s), slightly, rtol=0, atol=1e-11)

    @pytest.mark.parametrize("row", range(6))
    def test_refuses_a_negative_direction_however_small_its_units(self, s, row):
        """The negative control of the first test: a correlation above one, of two rows of the same units."""
        matrix = gram(6)
        other = (row + 1) % 6
        matrix[row, other] = matrix[other, row] = 1.001 * np.sqrt(matrix[row, row] * matrix[other, other])
        with pytest.raises(FusionError, match=r"^the thing is not positive semi-definite.* -\d[.\d]*"):
            check(in_units(matrix, s))

    @pytest.mark.parametrize("row", range(6))
    def test_refuses_asymmetry_however_small_its_units(self, s, row):
        matrix = gram(6)
        matrix[row, (row + 2) % 6] += 1e-6 * np.diagonal(matrix).max()
        with pytest.raises(FusionError, match=r"^the thing is not symmetric.*mirror"):
            check(in_units(matrix, s))

    def test_refuses_a_singular_matrix_only_where_it_must_be_definite(self, s):
        matrix = in_units(gram(5), s)
        check(matrix)
        with pytest.raises(NoiseError, match=r"it is not positive definite.*; ask somebody"):
            positive_matrix(matrix, "it", NoiseError, definite=True, cure="ask somebody")


@pytest.mark.parametrize("name", ["alike", "mixed", "small"])
def test_a_coupling_with_nothing_is_refused(name):
    matrix = gram(6)
    matrix[2, 2] = 0.0
    with pytest.raises(FusionError, match="semi-definite"):
        check(in_units(matrix, UNITS[name]))


def test_zero_passes_and_its_negative_neighbours_do_not():
    assert not check(np.zeros((6, 6))).any()
    assert check(np.diag([1.0, -1e-17])).shape == (2, 2)  # rounding of a row that shares the other's units
    for negative in (-1e-20 * np.eye(2), 1e-20 * np.array([[0.0, 1.0], [1.0, 0.0]]), np.diag([1.0, -1e-6])):
        with pytest.raises(FusionError, match="semi-definite"):
            check(negative)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("strong", "6 x 6 matrix of numbers"),
        ([[1.0, 2.0], [3.0]], "6 x 6 matrix of numbers"),
        (10**400, "6 x 6 matrix of numbers"),
        (np.eye(3), r"6 x 6 matrix of numbers, not of shape \(3, 3\)"),
        (np.ones((2, 6, 6)), r"not of shape \(2, 6, 6\)"),
        (np.diag([1.0, 1, 1, 1, 1, np.nan]), "not finite"),
        (np.diag([1.0, 1, 1, 1, 1, np.inf]), "not finite"),
    ],
)
def test_what_is_no_such_matrix_is_named(value, message):
    with pytest.raises(NoiseError, match=f"^the thing .*{message}"):
        positive_matrix(value, "the thing", NoiseError, size=6)


def test_one_bad_matrix_of_a_stack_is_enough():
    stack = np.stack([in_units(gram(6, seed), s) for seed, s in enumerate(UNITS.values())])
    np.testing.assert_array_equal(check(stack, definite=True), stack)
    stack[2, 0, 0] *= -1.0
    with pytest.raises(FusionError, match="not positive definite"):
        check(stack, definite=True)


@units
class TestTheRoots:
    @pytest.mark.parametrize("rank", range(7))
    def test_give_the_matrix_back_and_its_inverse_where_it_has_one(self, s, rank):
        matrix = in_units(gram(rank), s)
        R, W = roots(matrix, 1e-12)
        assert R.shape == W.shape == (6, rank)
        np.testing.assert_allclose((R @ R.T) / np.outer(s, s), gram(rank), rtol=0, atol=1e-13)
        np.testing.assert_allclose(W.T @ R, np.eye(rank), rtol=0, atol=1e-9)
        np.testing.assert_allclose(W.T @ (matrix @ W), np.eye(rank), rtol=0, atol=1e-9)
        if rank == 6:
            np.testing.assert_allclose((W @ W.T) * np.outer(s, s), np.linalg.inv(gram(6)), rtol=1e-8)
            inverse = inverse_cholesky(matrix)
            np.testing.assert_allclose(inverse @ matrix @ inverse.T, np.eye(6), rtol=0, atol=1e-9)

    def test_leave_out_what_is_negative_or_below_the_tolerance(self, s):
        axes = np.linalg.qr(gram(6))[0]
        for low, rank in ((1e-3, 6), (1e-8, 5), (-1e-8, 5), (-1.0, 5)):
            unit, _ = unit_diagonal((axes * [low, 1, 1, 2, 3, 4]) @ axes.T)
            R, W = roots(in_units(unit, s), 1e-6)
            assert R.shape == W.shape == (6, rank)
            assert np.isfinite(R).all()
            assert np.isfinite(W).all()


class TestTheSymmetricRoot:
    def test_is_symmetric_and_squares_to_the_positive_part(self):
        rng = np.random.default_rng(1)
        matrices = rng.standard_normal((5, 6, 6))
        matrices += matrices.mT
        root = symmetric_root(matrices)
        np.testing.assert_allclose(root, root.mT, atol=1e-14)
        np.testing.assert_allclose(root @ root, nearest_semidefinite(matrices), atol=1e-13)
        lost = nearest_semidefinite(matrices) - matrices
        assert np.linalg.eigvalsh(lost).min() > -1e-13
        np.testing.assert_allclose(lost, nearest_semidefinite(-matrices), atol=1e-13)

    def test_of_a_positive_matrix_gives_it_back(self):
        for rank in range(7):
            root = symmetric_root(gram(rank))
            np.testing.assert_allclose(root @ root, gram(rank), atol=1e-13)

    def test_does_not_depend_on_the_choice_of_eigenvectors(self):
        """A double eigenvalue's are any of a plane's; a permutation makes LAPACK choose others."""
        axes = np.linalg.qr(gram(6))[0]
        matrix = (axes * [1, 1, 1, 4, 4, 9]) @ axes.T
        order = np.array([3, 1, 5, 0, 4, 2])
        permuted = np.ix_(order, order)
        root = symmetric_root(matrix)
        np.testing.assert_allclose(symmetric_root(matrix[permuted]), root[permuted], atol=1e-13)
        values, vectors = np.linalg.eigh(matrix)
        others = np.linalg.eigh(matrix[permuted])[1]
        assert np.abs((vectors[order] - others) * np.sqrt(values)).max() > 0.1


@pytest.mark.parametrize("stack", [(), (3, 2)])
def test_rows_of_zeros_are_named_where_a_matrix_must_be_definite(stack):
    """Of the first such matrix of a stack; where it may be singular they pass."""
    matrices = np.broadcast_to(np.eye(4), (*stack, 4, 4)).copy()
    singular = matrices[1, 1] if stack else matrices
    singular[[1, 3]] = 0.0
    check(matrices)
    for names, rows in (((), "2, 4"), ("wxyz", "x, z")):
        with pytest.raises(
            NoiseError, match=f"it is not positive definite: all is zero in the rows of {rows}; mend"
        ):
            positive_matrix(matrices, "it", NoiseError, definite=True, cure="mend it", names=names)
    with pytest.raises(NoiseError, match=r"not positive definite: it is all zero$"):
        positive_matrix(np.zeros((*stack, 4, 4)), "it", NoiseError, definite=True)
