"""Batches of two orders of summation: what they mean, how they scatter, and what rounding is taken for."""

from __future__ import annotations

import numpy as np
import pytest
import soft_blobs
from soft_blobs import POSE

from mitsuba_crb import se3
from mitsuba_crb.camera import Camera
from mitsuba_crb.radiance.exact import as_batches


def _all_pixels(size: tuple[int, int]) -> np.ndarray:
    return np.stack(np.meshgrid(*(np.arange(n) for n in size)), axis=-1).reshape(-1, 2)


def test_the_doubles_columns_are_those_of_its_image() -> None:
    """Central differences of 2e-6, float64: 1e-8 of the largest; of a tenth more they are not."""
    field, pixels = soft_blobs.many(), _all_pixels((32, 24))
    camera = Camera.of(soft_blobs.INTRINSICS)
    image, columns = field.columns(camera, POSE, pixels)
    assert np.array_equal(image, field.show(camera, POSE, pixels).values)
    for axis in range(6):
        step = 2e-6 * np.eye(6)[axis]
        plus, minus = (field.show(camera, POSE @ se3.exp(xi), pixels).values for xi in (step, -step))
        found = (plus - minus) / 4e-6
        largest = np.abs(columns[..., axis]).max()
        assert np.abs(found - columns[..., axis]).max() < 1e-8 * largest
        assert np.abs(found - 1.1 * columns[..., axis]).max() > 0.09 * largest


@pytest.mark.parametrize("batches", [4, 5, 8, 9])
def test_batches_scatter_as_independent_ones_of_their_mean(batches: int) -> None:
    orders = np.random.default_rng(batches).standard_normal((2, 50, 3))
    found = as_batches(orders, batches)
    assert found.shape == (batches, 50, 3)
    np.testing.assert_allclose(found.mean(axis=0), orders.mean(axis=0), atol=1e-14)
    # Of the mean, twice: half of what the orders differ by, and a K-th of the batches' own variance.
    own = 0.25 * (orders[0] - orders[1]) ** 2
    np.testing.assert_allclose(found.var(axis=0, ddof=1) / batches, own, rtol=1e-12)
    # Products of different batches are on average the orders' own product.
    square = (found.sum(axis=0) ** 2 - (found**2).sum(axis=0)) / (batches * (batches - 1))
    np.testing.assert_allclose(square, orders[0] * orders[1], atol=1e-13)
