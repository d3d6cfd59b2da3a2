"""Band-limited noise with natural statistics, and the patterns of the walls and the sky (linear, float16)."""

from __future__ import annotations

import numpy as np

Array = np.ndarray


def natural_noise(
    seed: int, shape: tuple[int, ...], *, cutoff: float, exponent: float = 1.0, stretch: float = 1.0
) -> Array:
    """Periodic noise with amplitude ``f^-exponent exp(-(f/cutoff)²)`` and random phases.

    Args:
        seed: of the phases.
        shape: (height, width) or (length,) [texel].
        cutoff: band limit [cycles/texel]; below 0.2, bilinear interpolation follows the pattern closely.
        exponent: 1 is the statistics of natural images (power ∝ 1/f²).
        stretch: of the last axis; above 1, the noise is elongated along it (wood grain).

    Returns:
        Array of the given shape, zero mean, unit standard deviation.
    """
    frequencies = list(np.meshgrid(*[np.fft.fftfreq(n) for n in shape], indexing="ij"))
    frequencies[-1] = frequencies[-1] * stretch
    f = np.sqrt(sum(g**2 for g in frequencies))
    f.flat[0] = np.inf  # no mean
    phases = np.random.Generator(np.random.PCG64(seed)).random(shape)
    noise = np.fft.ifftn(f**-exponent * np.exp(-((f / cutoff) ** 2)) * np.exp(2j * np.pi * phases)).real
    return noise / noise.std()


def stretch_to(values: Array, low: float, high: float) -> Array:
    """Affine map of the array onto [low, high]: unlike clipping it keeps the band limit."""
    return low + (high - low) * (values - values.min()) / (values.max() - values.min())


def coloured(light: Array, warm: Array, green: Array, *, mean: float, contrast: float) -> Array:
    """Linear RGB from one brightness and two weaker opponent-colour patterns, within mean ± contrast/2."""
    rgb = np.stack([light + 0.55 * warm, light + 0.25 * green, light - 0.55 * warm - 0.1 * green], axis=-1)
    return stretch_to(rgb, mean - contrast / 2, mean + contrast / 2)


def textured_wall() -> Array:
    """Weathered paint, 256x256, periodic."""
    light, warm, green = (natural_noise(seed, (256, 256), cutoff=0.2) for seed in (11, 12, 13))
    return coloured(light, warm, green, mean=0.45, contrast=0.8).astype(np.float16)


def striped_wall() -> Array:
    """One row of a periodic profile: constant along the second texture axis, exactly."""
    light, warm, green = (natural_noise(seed, (512,), cutoff=0.1, exponent=0.5) for seed in (21, 22, 23))
    return coloured(light, warm, green, mean=0.45, contrast=0.8)[None].astype(np.float16)


def radial_wall() -> Array:
    """One row, a profile over the radius of Mitsuba's `disk`, whose first texture axis is the radius."""
    light, warm, green = (natural_noise(seed, (1024,), cutoff=0.07, exponent=0.5) for seed in (31, 32, 33))
    return coloured(light, warm, green, mean=0.45, contrast=0.8)[None].astype(np.float16)


def _row(profile: Array) -> Array:
    """One row of linear RGB texels from (length, 3): constant along the second texture axis, exactly."""
    return np.clip(profile, 0.02, None)[None].astype(np.float16)


def cartons() -> Array:
    """Cardboard in all browns behind the warehouse's racks, 12 m."""
    light, warm, green = (natural_noise(seed, (768,), cutoff=0.1, exponent=0.5) for seed in (51, 52, 53))
    return _row(np.array([0.42, 0.30, 0.20]) * coloured(light, warm, green, mean=1.0, contrast=1.5))


def shutter() -> Array:
    """Slats of a roller shutter, 5 m, 0.16 m each, with weathered paint."""
    height = np.arange(512)
    slat = np.sin(2 * np.pi * height / 16) + 0.35 * np.sin(4 * np.pi * height / 16 + 0.6)
    worn = natural_noise(61, (512,), cutoff=0.08, exponent=0.6)
    shade = stretch_to(slat + 0.6 * worn, 0.35, 1.2)[:, None]
    return _row(shade * np.array([0.36, 0.42, 0.46]))


def lanes() -> Array:
    """A concrete floor, 12 m, with yellow lines of soft edges and tyre marks."""
    position = 12.0 * (np.arange(1024) + 0.5) / 1024 - 6.0
    light, warm, green = (natural_noise(seed, (1024,), cutoff=0.12, exponent=0.6) for seed in (71, 72, 73))
    concrete = np.array([0.40, 0.39, 0.37]) * coloured(light, 0.3 * warm, 0.3 * green, mean=1.0, contrast=0.9)

    def stripe(centre: float, width: float) -> Array:
        return np.exp(-((np.abs(position - centre) / width) ** 4))[:, None]

    for centre in (-4.3, -1.0, 1.45, 4.6):
        concrete += stripe(centre, 0.06) * (np.array([0.75, 0.52, 0.05]) - concrete)
    for centre in (0.75, 1.0):
        concrete *= 1.0 - 0.5 * stripe(centre, 0.09)
    return _row(concrete)


def rings() -> Array:
    """An air duct's louvre, a profile over the radius, 1.9 m, of Mitsuba's `disk`."""
    radius = np.arange(1024) / 1024
    worn = natural_noise(81, (1024,), cutoff=0.07, exponent=0.5)
    shade = stretch_to(np.sin(2 * np.pi * 14 * radius) + 0.7 * worn, 0.15, 0.75)[:, None]
    return _row(shade * np.array([0.92, 1.0, 1.05]))


def sky() -> Array:
    """Environment map, 448x224, y up: clouds over haze, a veiled sun.

    Smooth and without a seam: the clouds are plane waves in space, summed on the unit sphere.
    """
    height, width = 224, 448
    azimuth = 2 * np.pi * (np.arange(width) + 0.5) / width
    polar = np.pi * (np.arange(height) + 0.5) / height
    y = np.cos(polar)[:, None] * np.ones(width)
    direction = np.stack(
        [np.sin(polar)[:, None] * np.sin(azimuth), y, -np.sin(polar)[:, None] * np.cos(azimuth)], -1
    )

    uniform = np.random.Generator(np.random.PCG64(41)).random((4, 400))
    frequency = 2.5 * 18.0 ** uniform[0]  # up to 45 rad/rad: the shortest wave spans 10 texels
    z = 2 * uniform[1] - 1
    angle = 2 * np.pi * uniform[2]
    axis = np.stack([np.sqrt(1 - z**2) * np.cos(angle), z, np.sqrt(1 - z**2) * np.sin(angle)], -1)
    wave = np.cos(direction @ (frequency[:, None] * axis * [1.0, 1.8, 1.0]).T + 2 * np.pi * uniform[3])
    clouds = wave @ frequency**-0.4
    clouds /= clouds.std()

    cover = 1 / (1 + np.exp(-2.5 * (clouds - 0.3)))
    above = 1 / (1 + np.exp(-14 * y))  # a soft horizon
    zenith, horizon = np.array([0.10, 0.24, 0.62]), np.array([0.55, 0.68, 0.85])
    blue = horizon + (zenith - horizon) * np.clip(y, 0, 1)[..., None] ** 0.6
    white = np.array([0.95, 0.93, 0.90]) * (0.75 + 0.12 * clouds[..., None])
    ground = np.array([0.20, 0.19, 0.16]) * (1 + 0.15 * clouds[..., None])
    sun = np.exp(
        (direction @ np.array([0.40, 0.62, -0.82]) / np.linalg.norm([0.40, 0.62, -0.82]) - 1) / 0.004
    )
    heaven = blue + (white - blue) * cover[..., None] + sun[..., None] * [1.2, 1.05, 0.8]
    return (ground + (heaven - ground) * above[..., None]).astype(np.float16)
