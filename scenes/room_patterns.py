"""Surfaces of the rooms: floor boards, bricks, plaster, cloth, rug, picture, books. sRGB colour, uint8."""

from __future__ import annotations

import numpy as np
from patterns import Array, natural_noise, stretch_to


def _random(seed: int, *shape: int) -> Array:
    return np.random.Generator(np.random.PCG64(seed)).random(shape)


def _bytes(rgb: Array) -> Array:
    return np.round(255 * np.clip(rgb, 0, 1)).astype(np.uint8)


def _ramp(value: Array, *colours: tuple[float, float, float]) -> Array:
    """Colour ramp over [0, 1] in 64 steps, which halves the file and is finer than the surfaces' relief."""
    value = np.round(63 * np.clip(value, 0, 1)) / 63
    position = np.linspace(0, 1, len(colours))
    return np.stack([np.interp(value, position, channel) for channel in zip(*colours, strict=True)], -1)


def floor_boards() -> Array:
    """Oak boards along the second axis, 16 texels wide, 448x448, periodic."""
    size, width = 448, 16
    row, column = np.mgrid[:size, :size]
    board = column // width
    shift = np.floor(size * _random(101, size // width)).astype(int)[board]
    piece = ((row + shift) % size) // (size // 2)
    tone = _random(102, size // width, 2)[board, piece]
    grain = natural_noise(103, (size, size), cutoff=0.45, stretch=1).T
    grain = 0.7 * np.take_along_axis(
        natural_noise(104, (size, size), cutoff=0.4, stretch=12).T, (row + shift) % size, 0
    )
    grain += 0.3 * natural_noise(105, (size, size), cutoff=0.45)
    value = 0.35 + 0.35 * tone + 0.13 * grain
    gap = (column % width == 0) | ((row + shift) % (size // 2) == 0)
    value = np.where(gap, 0.35 * value, value)
    return _bytes(_ramp(value, (0.20, 0.11, 0.06), (0.52, 0.34, 0.20), (0.80, 0.62, 0.42)))


def walnut() -> Array:
    """Dark furniture wood, grain along the second axis, 128x256, periodic."""
    grain = 0.75 * natural_noise(111, (128, 256), cutoff=0.4, stretch=14) + 0.25 * natural_noise(
        112, (128, 256), cutoff=0.45
    )
    return _bytes(_ramp(0.5 + 0.16 * grain, (0.16, 0.08, 0.04), (0.38, 0.22, 0.13), (0.58, 0.38, 0.23)))


def bricks() -> Array:
    """Running bond, bricks of 40 x 12 texels, 240x320, periodic."""
    height, width, tall, long = 240, 320, 12, 40
    row, column = np.mgrid[:height, :width]
    course = row // tall
    x = (column + (course % 2) * (long // 2)) % width
    tone = _random(121, height // tall, width // long)[course, x // long]
    rough = natural_noise(122, (height, width), cutoff=0.45)
    wobble = 0.5 * natural_noise(123, (height, width), cutoff=0.1)
    edge = np.minimum(np.minimum(row % tall, tall - row % tall), np.minimum(x % long, long - x % long))
    mortar = 1 / (1 + np.exp(4 * (edge - 1.2 + 0.5 * wobble)))
    clay = _ramp(0.25 + 0.5 * tone + 0.13 * rough, (0.30, 0.14, 0.10), (0.58, 0.29, 0.20), (0.76, 0.50, 0.37))
    joint = _ramp(0.6 + 0.12 * rough, (0.35, 0.32, 0.29), (0.74, 0.71, 0.66))
    return _bytes(clay + (joint - clay) * mortar[..., None])


def plaster() -> Array:
    """Lime wash, 256x256, periodic."""
    value = 0.5 + 0.17 * natural_noise(131, (256, 256), cutoff=0.35, exponent=1.1)
    return _bytes(_ramp(value, (0.62, 0.60, 0.53), (0.80, 0.78, 0.71), (0.92, 0.90, 0.85)))


def linen() -> Array:
    """Sofa cloth: a weave over slow fading, 128x128, periodic."""
    row, column = np.mgrid[:128, :128]
    weave = np.sin(2 * np.pi * row / 4) * np.sin(2 * np.pi * column / 4)
    value = 0.5 + 0.17 * natural_noise(141, (128, 128), cutoff=0.45) + 0.07 * weave
    return _bytes(_ramp(value, (0.14, 0.22, 0.28), (0.27, 0.40, 0.46), (0.48, 0.61, 0.64)))


def ikat() -> Array:
    """Cushion cloth: bleeding diamonds, 96x96, periodic."""
    row, column = np.mgrid[:96, :96] / 96
    bleed = 0.03 * natural_noise(151, (96, 96), cutoff=0.3)
    diamond = np.abs((row * 2) % 1 - 0.5) + np.abs((column * 2 + bleed) % 1 - 0.5)
    rings = 0.5 + 0.5 * np.tanh(4 * np.sin(2 * np.pi * (1.5 * diamond + bleed)))
    value = rings + 0.06 * natural_noise(152, (96, 96), cutoff=0.45)
    return _bytes(_ramp(value, (0.72, 0.36, 0.14), (0.84, 0.60, 0.34), (0.93, 0.88, 0.76)))


def rug() -> Array:
    """Red rug with a medallion and borders, 192x256."""
    height, width = 192, 256
    y, x = np.mgrid[:height, :width]
    pile = natural_noise(161, (height, width), cutoff=0.45)
    u, v = (x + 0.5) / width * 2 - 1, (y + 0.5) / height * 2 - 1
    border = np.minimum(np.minimum(x, width - 1 - x), np.minimum(y, height - 1 - y))
    radius, angle = np.hypot(u * 1.2, v), np.arctan2(v, u * 1.2)
    petals = np.cos(8 * angle) * 0.08
    medallion = np.tanh(9 * np.sin(14 * (radius + petals)))
    tracery = np.tanh(3 * (np.sin(0.32 * x) * np.sin(0.32 * y) + 0.3 * np.sin(0.16 * (x + y)) - 0.25))
    pattern = np.where(radius < 0.72 + petals, medallion, tracery)
    zigzag = np.tanh(5 * np.sin(2 * np.pi * (x + y) / 16) * np.sin(2 * np.pi * (x - y) / 16))
    pattern = np.where(border < 22, zigzag, pattern)
    red = np.array([0.50, 0.11, 0.11]) + np.array([0.30, 0.42, 0.32]) * (0.5 + 0.5 * pattern)[..., None]
    navy = np.array([0.10, 0.13, 0.27]) + np.array([0.62, 0.50, 0.30]) * (0.5 + 0.5 * pattern)[..., None]
    rgb = np.where((border < 22)[..., None], navy, red)
    rgb = np.where(((border < 5) | (np.abs(border - 22) < 2))[..., None], [0.76, 0.67, 0.50], rgb)
    return _bytes(np.round(48 * rgb * (1 + 0.10 * pile[..., None])) / 48)


def picture() -> Array:
    """A landscape in oil: evening sky, three ridges, a lake, 192x256."""
    height, width = 192, 256
    y, x = np.mgrid[:height, :width] / np.array([height, width])[:, None, None]
    brush = natural_noise(171, (height, width), cutoff=0.4, stretch=3)
    clouds = natural_noise(172, (height, width), cutoff=0.25, exponent=1.4, stretch=2.5)
    rgb = _ramp(
        y / 0.62 + 0.10 * clouds,
        (0.24, 0.34, 0.55),
        (0.62, 0.62, 0.68),
        (0.96, 0.76, 0.50),
        (0.98, 0.86, 0.62),
    )
    ridges = [
        (0.44, 0.10, 1.6, (0.47, 0.50, 0.60)),
        (0.55, 0.07, 1.4, (0.30, 0.37, 0.40)),
        (0.66, 0.05, 1.1, (0.15, 0.22, 0.17)),
    ]
    for index, (level, relief, exponent, colour) in enumerate(ridges):
        line = level + relief / 2 * natural_noise(173 + index, (width,), cutoff=0.3, exponent=exponent)
        below = (y > line)[..., None]
        rgb = np.where(
            below, np.array(colour) * (1 + 0.16 * brush[..., None] + 0.3 * (y - line)[..., None]), rgb
        )
    lake = (y > 0.78 + 0.02 * np.sin(9 * x))[..., None]
    mirrored = rgb[np.clip(np.round((1.38 - y[:, 0]) * height * 0.62).astype(int), 0, height - 1)]
    rgb = np.where(lake, 0.8 * mirrored + 0.04 * np.sin(150 * y + 3 * clouds)[..., None], rgb)
    return _bytes(rgb + 0.035 * brush[..., None])


def books() -> Array:
    """Spines side by side, 16 texels each, 64x512: cloth colour, title bar, bands."""
    count, wide, height = 32, 16, 64
    hues = np.array(
        [
            (0.45, 0.12, 0.10),
            (0.12, 0.22, 0.36),
            (0.16, 0.30, 0.20),
            (0.62, 0.52, 0.34),
            (0.25, 0.16, 0.24),
            (0.70, 0.66, 0.58),
        ]
    )
    pick = (len(hues) * _random(181, count)).astype(int)
    tone = 0.75 + 0.6 * _random(182, count)
    rgb = np.repeat(hues[pick] * tone[:, None], wide, axis=0)[None].repeat(height, 0)
    row, column = np.mgrid[:height, : count * wide]
    book = column // wide
    place = (0.15 + 0.35 * _random(183, count))[book] * height
    title = (np.abs(row - place) < 7) & (np.abs(column % wide - wide / 2 + 0.5) < 4)
    letters = title & (_random(184, height, count * wide) < 0.6)
    band = (np.abs(row - 0.85 * height) < 1.5) & (_random(185, count)[book] < 0.6)
    rgb = np.where((letters | band)[..., None], [0.85, 0.75, 0.48], rgb)
    rgb = rgb * (1 + 0.12 * natural_noise(186, (height, count * wide), cutoff=0.45)[..., None])
    spine = np.sin(np.pi * (column % wide + 0.5) / wide) ** 0.4
    return _bytes(rgb * spine[..., None])


def leaf() -> Array:
    """Leaves of the palm, 64x64, periodic."""
    value = stretch_to(natural_noise(191, (64, 64), cutoff=0.4, stretch=4), 0, 1)
    return _bytes(_ramp(value, (0.08, 0.20, 0.06), (0.22, 0.40, 0.14), (0.42, 0.56, 0.24)))
