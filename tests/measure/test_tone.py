"""Gain and black level: what was put in comes out, whatever noise the renders have."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mitsuba_crb.measure.tone import Tone, ToneKind

GAIN, BLACK = np.array([1.3, 0.8, 2.0]), np.array([0.05, -0.02, 0.1])


def renders(noise: float, count: int = 4000, batches: int = 4) -> Any:
    rng = np.random.default_rng(1)
    image = rng.uniform(0.2, 0.6, (count, 3))
    return image, image + noise * rng.standard_normal((batches, count, 3))


@pytest.mark.parametrize("noise", [0.0, 0.2])
def test_gain_and_black_of_each_channel_come_out(noise: float) -> None:
    """Noise as large as the image's contrast: its square is not taken for contrast."""
    image, batches = renders(noise)
    weights = np.random.default_rng(2).uniform(0.5, 2.0, image.shape)
    found = Tone("channels").fitted(GAIN * image + BLACK, batches, weights)
    np.testing.assert_allclose(found.gain, GAIN, rtol=0.05 if noise else 1e-9)
    np.testing.assert_allclose(found.black, BLACK, atol=0.03 if noise else 1e-9)
    if noise:  # the negative control: the mean of the batches in their place
        mean = np.broadcast_to(batches.mean(axis=0), batches.shape)
        biased = Tone("channels").fitted(GAIN * image + BLACK, mean, weights)
        assert np.all(biased.gain < 0.75 * GAIN)


def test_what_is_common_is_one_and_what_is_known_stays() -> None:
    image, batches = renders(0.0)
    found = Tone("common").fitted(1.3 * image + 0.05, batches, np.ones_like(image))
    np.testing.assert_allclose(found.gain, 1.3, rtol=1e-9)
    np.testing.assert_allclose(found.black, 0.05, rtol=1e-9)
    known = Tone("known").fitted(1.3 * image + 0.05, batches, np.ones_like(image))
    np.testing.assert_array_equal([known.gain, known.black], [np.ones(3), np.zeros(3)])
    np.testing.assert_array_equal(known(image), image)


def test_values_without_weight_say_nothing() -> None:
    image, batches = renders(0.0, 200)
    measured = GAIN * image + BLACK
    measured[:50] = 1000.0
    weights = np.ones_like(image)
    weights[:50] = 0.0
    found = Tone("channels").fitted(measured, batches, weights)
    np.testing.assert_allclose(found.gain, GAIN, rtol=1e-9)
    nothing = Tone("channels").fitted(measured, batches, np.zeros_like(image))
    np.testing.assert_array_equal(nothing.gain, 0.0)


def test_a_channel_without_contrast_has_no_gain() -> None:
    image, _ = renders(0.0, 300)
    image[:, 2] = 0.4
    found = Tone("channels").fitted(GAIN * image + BLACK, np.stack([image] * 4), np.ones_like(image))
    np.testing.assert_allclose(found.gain, [*GAIN[:2], 0.0])
    np.testing.assert_allclose(found(image), GAIN * image + BLACK)


def test_an_unlike_render_has_some_gain_nevertheless() -> None:
    """Steps are as much too long as a gain is too small."""
    image, batches = renders(0.0)
    unlike = GAIN * image[::-1] + BLACK
    found = Tone("channels").fitted(unlike, batches, np.ones_like(image))
    np.testing.assert_allclose(found.gain, 0.3 * GAIN, rtol=0.05)
    np.testing.assert_allclose(found(image).mean(axis=0), unlike.mean(axis=0))


@pytest.mark.parametrize(("kind", "count"), [("known", 0), ("common", 2), ("channels", 6)])
def test_columns_are_the_derivatives(kind: ToneKind, count: int) -> None:
    image, _ = renders(0.0, 20)
    tone = Tone(kind, GAIN, BLACK)
    columns = tone.columns(image)
    assert columns.shape == (20, 3, count)
    assert len(tone.parameters) == count
    changes = [GAIN, BLACK]
    if count:
        steps = np.concatenate([np.full(3, 0.2), np.full(3, 0.01)]) if count == 6 else np.array([0.2, 0.01])
        moved = Tone(kind, changes[0] + 0.2, changes[1] + 0.01)
        np.testing.assert_allclose(moved(image) - tone(image), columns @ steps, rtol=1e-9)
