"""Correlated noise models against dense matrices on a 24 x 24 image, for all pixels and for some."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from scipy import sparse

from mitsuba_crb import noise
from mitsuba_crb.errors import NoiseError
from mitsuba_crb.noise.covariance import unit_diagonal

SIDE = 24
Y, X = np.divmod(np.arange(SIDE * SIDE), SIDE)
PIXELS = np.stack([X, Y], axis=1)
DX, DY = np.subtract.outer(X, X), np.subtract.outer(Y, Y)
RNG = np.random.default_rng(4)

_d = np.arange(-4, 5)
# A tent of reach 4 plus white noise: positive definite as a sum of such.
TENT = np.outer(1 - np.abs(_d) / 5, 1 - np.abs(_d) / 5)
TENT[4, 4] += 0.3
_wrapped = np.minimum(np.arange(SIDE), SIDE - np.arange(SIDE))
SPECTRUM = np.fft.fft2(np.exp(-np.hypot(_wrapped[:, None], _wrapped) / 2.0)).real + 0.05
_chain = sparse.diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(SIDE, SIDE))
PRECISION = sparse.kronsum(_chain, _chain) + 0.2 * sparse.eye_array(SIDE * SIDE)
MODES = RNG.normal(size=(3, SIDE, SIDE))
VARIANCE = RNG.uniform(0.5, 2.0, (SIDE, SIDE))


def _stationary():
    inside = (np.abs(DX) <= 4) & (np.abs(DY) <= 4)
    return np.where(inside, TENT[np.clip(DY + 4, 0, 8), np.clip(DX + 4, 0, 8)], 0.0)


def _periodic():
    return np.fft.ifft2(SPECTRUM).real[DY % SIDE, DX % SIDE]


def _low_rank():
    U = MODES.reshape(3, -1).T
    return np.kron(np.diag(VARIANCE.ravel()) + U @ U.T, np.diag([1.0, 1.0])) + np.kron(
        U @ U.T, np.array([[0.0, 1.0], [1.0, 0.0]])
    )


CASES = {
    "stationary": (noise.Stationary(TENT), lambda: np.kron(_stationary(), np.eye(2))),
    "periodic": (noise.Periodic(SPECTRUM), lambda: np.kron(_periodic(), np.eye(2))),
    "sparse": (
        noise.SparsePrecision(PRECISION, (SIDE, SIDE)),
        lambda: np.kron(np.linalg.inv(PRECISION.toarray()), np.eye(2)),
    ),
    "sparse with channels": (
        noise.SparsePrecision(sparse.kron(PRECISION, [[2.0, 0.5], [0.5, 1.0]]), (SIDE, SIDE)),
        lambda: np.linalg.inv(np.kron(PRECISION.toarray(), [[2.0, 0.5], [0.5, 1.0]])),
    ),
    "low rank": (noise.LowRankPlusDiagonal(VARIANCE, MODES), _low_rank),
}


@pytest.fixture(params=CASES)
def case(request):
    model, covariance = CASES[request.param]
    return model, covariance()


@pytest.mark.parametrize("subset", ["all", "shuffled", "some"])
def test_it_is_the_dense_inverse_of_the_selected_pixels_covariance(case, subset):
    model, covariance = case
    rng = np.random.default_rng(9)
    kept = {"all": np.arange(SIDE**2), "shuffled": rng.permutation(SIDE**2)}.get(
        subset, rng.permutation(SIDE**2)[:200]
    )
    values = rng.normal(size=(len(kept), 2, 5))
    solved = model.solve(PIXELS[kept], values)
    index = (kept[:, None] * 2 + np.arange(2)).ravel()
    expected = np.linalg.solve(covariance[np.ix_(index, index)], values.reshape(-1, 5)).reshape(values.shape)
    np.testing.assert_allclose(solved, expected, atol=1e-10 * np.abs(expected).max())
    if subset == "some":
        # Negative control: rows and columns of the whole image's inverse.
        wrong = np.linalg.inv(covariance)[np.ix_(index, index)] @ values.reshape(-1, 5)
        assert np.abs(wrong.reshape(values.shape) - expected).max() > 1e-3 * np.abs(expected).max()


def test_it_describes_itself(case):
    model, _ = case
    assert isinstance(model, noise.CoupledNoise)
    assert isinstance(model, noise.NoiseModel)
    assert not isinstance(model, noise.IndependentNoise)
    assert model.couples_pixels
    assert not model.depends_on_mean
    assert "\n" not in model.description
    assert json.loads(json.dumps(model.to_dict(), allow_nan=False))["model"]
    model.check(SIDE, SIDE, 2)


def test_autocovariance_and_power_spectrum_are_one():
    covariance = np.fft.ifft2(SPECTRUM).real
    np.testing.assert_allclose(
        noise.Periodic.from_autocovariance(covariance).power_spectrum, SPECTRUM, rtol=1e-9
    )
    wide = np.zeros((15, 15))
    wide[3:12, 3:12] = TENT
    spectrum = np.fft.fft2(np.fft.ifftshift(wide)).real
    again = noise.Stationary.from_power_spectrum(spectrum)
    np.testing.assert_allclose(again.autocovariance, wide, atol=1e-14)


def test_periodic_and_open_borders_differ():
    values = np.ones((SIDE**2, 1, 1))
    wrapped = np.zeros((SIDE, SIDE))
    wrapped[:9, :9] = TENT
    periodic = noise.Periodic.from_autocovariance(np.roll(wrapped, (-4, -4), axis=(0, 1)))
    np.testing.assert_allclose(periodic.solve(PIXELS, values), 1.0 / TENT.sum(), rtol=1e-9)
    open_borders = noise.Stationary(TENT).solve(PIXELS, values)
    assert open_borders.sum() > 1.1 * SIDE**2 / TENT.sum()


def test_a_sparse_precision_is_checked_by_its_pivots_where_its_diagonal_does_not_dominate():
    A = sparse.random_array((400, 400), density=0.01, rng=np.random.default_rng(0))
    positive = (A.T @ A + 0.1 * sparse.eye_array(400)).tocsc()
    noise.SparsePrecision(positive, (20, 20))
    smallest = np.linalg.eigvalsh(positive.toarray())[0]
    shifted = positive - (smallest + 0.05) * sparse.eye_array(400)
    unit, _ = unit_diagonal(shifted.toarray())
    found = re.escape(f"smallest eigenvalue is {np.linalg.eigvalsh(unit)[0]:.3g}")
    with pytest.raises(NoiseError, match=found):
        noise.SparsePrecision(shifted, (20, 20))


SKEWED = TENT.copy()
SKEWED[0, 0] += 0.1
NEGATIVE = np.array([[0.0, 0.6, 0.0], [0.6, 1.0, 0.6], [0.0, 0.6, 0.0]])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: noise.Stationary(np.ones((2, 3))), "odd number of rows"),
        (lambda: noise.Stationary(SKEWED), "not symmetric"),
        (lambda: noise.Stationary(NEGATIVE), "smallest eigenvalue is -1.4"),
        (lambda: noise.Stationary(-TENT), "smallest eigenvalue is -"),
        (lambda: noise.Stationary([[np.nan]]), "not finite"),
        (lambda: noise.Periodic(np.ones(3)), "shape (H, W)"),
        (lambda: noise.Periodic(SPECTRUM - 0.4), "smallest eigenvalue is -"),
        (lambda: noise.Periodic(SPECTRUM).check(SIDE, SIDE + 1, 3), "but the image is 24 rows x 25"),
        (lambda: noise.SparsePrecision(np.eye(4), (2, 2)), "sparse matrix"),
        (lambda: noise.SparsePrecision(sparse.eye_array(5), (2, 2)), "but the image is 2 rows"),
        (lambda: noise.SparsePrecision(sparse.eye_array(4), (1, 0)), "but the image is 1 rows x 0 columns"),
        (
            lambda: noise.SparsePrecision(sparse.eye_array(4), (2, 2)).check(2, 3, 3),
            "but the image is 2 rows",
        ),
        (lambda: noise.SparsePrecision(-sparse.eye_array(4), (2, 2)), "smallest eigenvalue is -1"),
        (lambda: noise.SparsePrecision(sparse.csc_array((4, 4)), (2, 2)), "smallest eigenvalue is 0"),
        (lambda: noise.SparsePrecision(sparse.csc_array(np.triu(np.ones((4, 4)))), (2, 2)), "not symmetric"),
        (lambda: noise.LowRankPlusDiagonal(np.ones((2, 2)), np.ones((1, 3, 3))), "modes must have shape"),
        (lambda: noise.LowRankPlusDiagonal(np.zeros((2, 2)), np.ones((1, 2, 2))), "4 of 4 variances"),
        (lambda: noise.LowRankPlusDiagonal(np.ones((2, 2)), np.full((1, 2, 2), np.inf)), "not finite"),
        (
            lambda: noise.LowRankPlusDiagonal(np.ones((2, 2)), np.ones((1, 2, 2))).check(2, 3, 3),
            "but the image",
        ),
    ],
)
def test_impossible_parameters_are_one_line(make, message):
    with pytest.raises(NoiseError, match=re.escape(message)) as caught:
        make()
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_512_x_512_pixels_are_solved_in_little_memory():
    """Three channels, six columns, 2 GB; benchmarks/correlated.py says how long it takes."""
    import resource

    y, x = np.divmod(np.arange(512 * 512), 512)
    values = np.random.default_rng(0).normal(size=(512 * 512, 3, 6))
    solved = noise.Stationary(TENT).solve(np.stack([x, y], axis=1), values)
    assert np.isfinite(solved).all()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < 2e6


@pytest.mark.parametrize("name", ["stationary", "periodic"])
def test_the_number_of_cores_changes_no_bit(name, monkeypatch):
    model, values = CASES[name][0], RNG.normal(size=(len(PIXELS), 3, 6))
    solved = []
    for count in (1, 2, 5):
        monkeypatch.setattr(noise.stationary, "cores", lambda count=count: count)
        solved.append(model.solve(PIXELS, values))
    assert np.all(solved[0] == solved)
