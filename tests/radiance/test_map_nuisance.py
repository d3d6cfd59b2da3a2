"""What not knowing a map costs is what the dense matrices of a small one say."""

from __future__ import annotations

import functools
import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from ewa_twin import picture
from splat_views import SMALL, VARIANTS, odd_splats, pixels_of, random_splats

from mitsuba_crb import se3
from mitsuba_crb.datasets.splat_set import SH_C0
from mitsuba_crb.datasets.splats import Splats
from mitsuba_crb.errors import FieldError
from mitsuba_crb.radiance.gaussians import Gaussians
from mitsuba_crb.radiance.map_nuisance import map_cost, map_information

POSE = se3.exp([0.1, -0.05, 0.2, 0.08, -0.1, 0.3])
PIXELS = pixels_of(SMALL)[::3]
SPLATS = random_splats(20, degree=1, seed=3)
WEIGHTS = np.random.default_rng(1).uniform(0.5, 2.0, (len(PIXELS), 3)) * 1e4


@functools.cache
def dense(variant: str, unknowns: str) -> np.ndarray:
    """(values, unknowns) S of `SPLATS`, by differences of the twin."""

    def values(coefficients: np.ndarray, opacities: np.ndarray) -> np.ndarray:
        changed = replace(SPLATS, coefficients=coefficients, opacities=opacities)
        return picture(changed, SMALL, POSE, PIXELS, variant=variant, columns=False).values

    plain, rows = SPLATS.coefficients.astype(np.float64), []
    at_rest = values(plain, SPLATS.opacities)
    for k in range(len(SPLATS)):
        if unknowns == "opacities":
            step = 1e-6 * np.eye(len(SPLATS))[k]
            ends = [values(plain, SPLATS.opacities + sign * step) for sign in (1, -1)]
            rows.append((ends[0] - ends[1]).ravel() / 2e-6)
        else:  # the image is linear in them, and a channel follows its own alone
            brighter = plain.copy()
            brighter[k, 0] += 1e-3 / SH_C0
            slope = (values(brighter, SPLATS.opacities) - at_rest) / 1e-3
            rows += [(slope * np.eye(3)[channel]).ravel() for channel in range(3)]
    return np.stack(rows, axis=1)


@pytest.mark.parametrize(
    ("unknowns", "variant"),
    [("colours", "classic"), ("colours", "mip"), *(("opacities", variant) for variant in VARIANTS)],
)
@pytest.mark.parametrize("precision", [30.0, 3e5])
def test_the_cost_of_a_map_is_the_dense_schur_complement(
    unknowns: str, variant: str, precision: float
) -> None:
    field = Gaussians(SPLATS, variant=variant)
    J = field.columns(SMALL, POSE, PIXELS)[1].reshape(-1, 6)
    S, W = dense(variant, unknowns), WEIGHTS.reshape(-1, 1)
    H = S.T @ (W * S)
    D = precision * np.random.default_rng(2).uniform(0.5, 1.5, len(H))
    cross = S.T @ (W * J)
    known, lost = J.T @ (W * J), cross.T @ np.linalg.solve(H + np.diag(D), cross)
    by_diagonal = cross.T @ (cross / (np.diag(H) + D)[:, None])

    prior = D if unknowns == "opacities" else D.reshape(-1, 3)
    cost = map_cost(field, SMALL, POSE, PIXELS, WEIGHTS, unknowns=unknowns, prior=prior)
    scale = np.sqrt(np.outer(np.diag(known), np.diag(known)))
    for found, expected in ((cost.known, known), (cost.lost, lost), (cost.lost_by_diagonal, by_diagonal)):
        assert np.abs((found - expected) / scale).max() < 1e-4 * max(1.0, np.abs(expected / scale).max())
    np.testing.assert_allclose(cost.information, cost.known - cost.lost)
    assert np.linalg.eigvalsh(cost.lost)[0] > 0.0
    assert np.linalg.eigvalsh(cost.information / scale)[0] > 0.0
    information = map_information(field, SMALL, POSE, PIXELS, WEIGHTS, unknowns=unknowns)
    np.testing.assert_allclose(information.ravel(), np.diag(H), rtol=2e-3, atol=1e-4 * np.diag(H).max())


def test_a_map_known_better_costs_less_and_one_known_exactly_nothing() -> None:
    field = Gaussians(random_splats(60, seed=5))
    costs = [
        map_cost(field, SMALL, POSE, PIXELS, WEIGHTS, unknowns="colours", prior=prior).lost
        for prior in (0.0, 1e2, 1e4, 1e12)
    ]
    known = map_cost(field, SMALL, POSE, PIXELS, WEIGHTS, unknowns="colours", prior=1.0).known
    for more, less in itertools.pairwise(costs):
        assert np.linalg.eigvalsh(more - less)[0] > -1e-6 * np.trace(more)
    assert np.trace(costs[-1]) < 1e-4 * np.trace(known)
    # Nothing known beforehand: some of it is left all the same.
    assert np.linalg.eigvalsh(known - costs[0])[0] > -1e-6 * np.trace(known)


def test_the_diagonal_alone_loses_more_than_there_is() -> None:
    """Two splats at one place are one unknown, and the diagonal counts them twice."""
    one = random_splats(20, seed=8)
    twice = Splats(*(np.concatenate([getattr(one, name)] * 6) for name in one.__dataclass_fields__))
    cost = map_cost(Gaussians(twice), SMALL, POSE, PIXELS, WEIGHTS, unknowns="colours", prior=1.0)
    assert np.linalg.eigvalsh(cost.information)[0] > 0.0
    assert np.linalg.eigvalsh(cost.known - cost.lost_by_diagonal)[0] < 0.0


def test_equal_calls_have_equal_bits_and_odd_splats_are_no_trouble() -> None:
    for unknowns in ("colours", "opacities"):
        costs = [
            map_cost(
                Gaussians(odd_splats(2), background=0.3),
                SMALL,
                POSE,
                PIXELS,
                1e4,
                unknowns=unknowns,
                prior=1e2,
            )
            for _ in range(2)
        ]
        np.testing.assert_array_equal(costs[0].lost, costs[1].lost)
        assert np.linalg.eigvalsh(costs[0].information)[0] > 0.0
    lone = map_information(Gaussians(random_splats(1)), SMALL, np.eye(4), PIXELS[:1], 1.0, unknowns="colours")
    assert lone.shape == (1, 3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"unknowns": "shapes"}, "colours or opacities"),
        ({"prior": -1.0}, "finite and not negative"),
        ({"prior": np.ones(7)}, "one precision for each"),
        ({"weights": np.ones(7)}, "weights must fit"),
        ({"weights": -1.0}, "not negative"),
    ],
)
def test_wrong_arguments_are_refused_in_one_line(options: dict[str, Any], message: str) -> None:
    given = {"weights": 1.0, "unknowns": "colours", "prior": 1.0} | options
    with pytest.raises(FieldError, match=message):
        map_cost(Gaussians(random_splats(5)), SMALL, POSE, PIXELS, **given)
