"""Photographs as images to compare with: what was encoded comes out, and what says nothing is NaN."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mitsuba_crb.datasets.pictures import averaged, comparable, read_picture
from mitsuba_crb.errors import AlignmentError
from mitsuba_crb.noise import SRGB

SIZE = (12, 8)


def linear(seed: int = 0, size: tuple[int, int] = SIZE) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.01, 0.8, (size[1], size[0], 3))


def written(file: Path, stored: np.ndarray, **options: Any) -> Path:
    """An 8-bit image of values from 0 to 1."""
    Image.fromarray(np.rint(255.0 * stored).astype(np.uint8)).save(file, **options)
    return file


def test_srgb_is_decoded_for_scenes_and_kept_for_displays(tmp_path: Path) -> None:
    values = linear()
    picture = read_picture(written(tmp_path / "a.png", SRGB(values)))
    decoded = comparable(picture, SIZE)
    step = 1.0 / 255.0 / SRGB.derivative(values)
    assert np.all(np.abs(decoded.values - values) < 0.51 * step)
    kept = comparable(picture, SIZE, display=True)
    assert np.abs(kept.values - SRGB(values)).max() < 0.51 / 255.0
    assert (decoded.masked, decoded.saturated) == (0, 0)


def test_linear_values_are_kept_for_scenes_and_encoded_for_displays(tmp_path: Path) -> None:
    values = linear()
    picture = read_picture(written(tmp_path / "a.png", values))
    assert np.abs(comparable(picture, SIZE, encoding="linear").values - values).max() < 0.51 / 255.0
    shown = comparable(picture, SIZE, encoding="linear", display=True).values
    np.testing.assert_allclose(shown, SRGB(np.rint(255.0 * values) / 255.0), rtol=1e-6)


def test_areas_are_averaged_in_linear_light(tmp_path: Path) -> None:
    """A checkerboard of black and white is half as bright as white, not as bright as its middle code."""
    board = np.indices((16, 24)).sum(axis=0) % 2 * np.ones((3, 1, 1)) * 0.9
    board[:, :, :8] = 0.2
    picture = read_picture(written(tmp_path / "a.png", np.moveaxis(board, 0, 2)))
    small = comparable(picture, SIZE)
    assert small.values[4, 8, 0] == pytest.approx(0.5 * float(SRGB.inverse(np.array(0.9))), rel=0.02)
    odd = comparable(picture, (9, 6)).values  # not a whole number of pixels each
    assert odd[3, 7, 1] == pytest.approx(0.5 * float(SRGB.inverse(np.array(0.9))), rel=0.1)
    np.testing.assert_allclose(averaged(linear()[..., 0], (3, 2)).mean(), linear()[..., 0].mean(), rtol=1e-6)


def test_it_is_turned_upright(tmp_path: Path) -> None:
    """EXIF orientation 6: stored lying on its side."""
    values = linear()
    exif = Image.Exif()
    exif[0x0112] = 6
    turned = written(tmp_path / "a.png", np.rot90(values), exif=exif)
    mask = np.ones(values.shape[:2])
    mask[:2, :3] = 0.0
    masked = written(tmp_path / "mask.png", mask)
    upright = comparable(read_picture(turned, masked), SIZE, encoding="linear").values
    assert np.isnan(upright[:2, :3]).all()
    np.testing.assert_allclose(upright[2:], values[2:], atol=0.51 / 255.0)


def test_what_is_masked_transparent_or_white_says_nothing(tmp_path: Path) -> None:
    values = linear(size=(24, 16))
    values[0, 0] = 1.0, 0.5, 0.5
    alpha = np.ones((16, 24, 1))
    alpha[4:6, 4:6] = 0.0
    mask = np.ones((16, 24))
    mask[8:10, 8:10] = 0.0
    file = written(tmp_path / "a.png", np.concatenate([values, alpha], axis=2))
    picture = read_picture(file, written(tmp_path / "mask.png", mask))
    found = comparable(picture, SIZE, encoding="linear")
    assert {tuple(place) for place in np.argwhere(np.isnan(found.values[..., 0])).tolist()} == {
        (0, 0),
        (2, 2),
        (4, 4),
    }
    assert (found.masked, found.saturated) == (2, 1)
    display = comparable(picture, SIZE, display=True)
    assert (display.masked, display.saturated) == (2, 0)
    assert np.isfinite(display.values[0, 0]).all()


def test_what_cannot_be_compared_is_refused_in_a_line(tmp_path: Path) -> None:
    picture = read_picture(written(tmp_path / "a.png", linear()))
    with pytest.raises(AlignmentError, match=r"a.png has 12x8 pixels, .* the camera's 8x8: crop it"):
        comparable(picture, (8, 8))
    with pytest.raises(AlignmentError, match=r"encoding 'rec709'.*srgb, linear"):
        comparable(picture, SIZE, encoding="rec709")  # type: ignore[arg-type]
    black = read_picture(written(tmp_path / "black.png", np.zeros((8, 12, 3))))
    with pytest.raises(AlignmentError, match=r"black.png is of one colour"):
        comparable(black, SIZE)
    white = read_picture(written(tmp_path / "white.png", np.ones((8, 12, 3))))
    with pytest.raises(AlignmentError, match="every pixel is masked, transparent or white"):
        comparable(white, SIZE)
    with pytest.raises(AlignmentError, match=r"mask.png has 8x8 pixels, .* 12x8"):
        read_picture(tmp_path / "a.png", written(tmp_path / "mask.png", np.ones((8, 8))))
    with pytest.raises(AlignmentError, match="No such file"):
        read_picture(tmp_path / "missing.png")
    (tmp_path / "text.png").write_text("not an image")
    with pytest.raises(AlignmentError, match=r"text.png is no image"):
        read_picture(tmp_path / "text.png")
    Image.fromarray(np.full((8, 12), 40000, dtype=np.uint16)).save(tmp_path / "deep.png")
    with pytest.raises(AlignmentError, match=r"mode I;16; save it with 8 bits"):
        read_picture(tmp_path / "deep.png")
