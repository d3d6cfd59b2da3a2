"""Writes every texture and mesh file of the scenes next to their XML: ``python scenes/make_textures.py``.

Deterministic: random phases from PCG64 with fixed seeds. Arrays of uint8 become PNG files and hold sRGB
colour; arrays of float16 become OpenEXR files and hold linear values, for patterns whose derivative matters
(8-bit steps would add information that the pattern does not have).
"""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import OpenEXR
from PIL import Image

Array = np.ndarray

SCENES = Path(__file__).parent


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


def box(*, shared: bool) -> tuple[Array, Array]:
    """Cube with corners at ±1, outward faces: 8 vertices, or 24 that split at the edges."""
    corner = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    quad = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    if not shared:
        corner, quad = corner[quad.ravel()], np.arange(24).reshape(6, 4)
    return corner, np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])


def frond() -> tuple[Array, Array]:
    """A flat palm frond in the plane z = 0, about 2 long, from the origin along y: midrib and leaflets."""
    vertices: list[Array] = []
    faces: list[list[int]] = []

    def polygon(*points: Array) -> None:
        faces.extend(
            [len(vertices), len(vertices) + i, len(vertices) + i + 1] for i in range(1, len(points) - 1)
        )
        vertices.extend(points)

    def midrib(t: float) -> Array:
        return np.array([0.35 * t**2, 2 * t - 0.25 * t**3, 0.0])

    def along(t: float) -> Array:
        direction = np.array([0.7 * t, 2 - 0.75 * t**2, 0.0])
        return direction / np.linalg.norm(direction)

    steps = np.linspace(0, 1, 13)
    for t0, t1 in pairwise(steps):
        side0, side1 = (np.array([along(t)[1], -along(t)[0], 0]) * 0.02 * (1 - 0.8 * t) for t in (t0, t1))
        polygon(midrib(t0) - side0, midrib(t0) + side0, midrib(t1) + side1, midrib(t1) - side1)
    for i, t in enumerate(np.linspace(0.18, 0.98, 15)):
        for side in (-1, 1):
            length = 0.75 * np.sin(np.pi * (0.2 + 0.72 * t)) * (1 + 0.12 * np.sin(2.3 * i + side))
            turn = side * np.radians(62 - 30 * t + 5 * np.sin(1.7 * i))
            ahead = along(t)
            axis = np.array(
                [
                    ahead[0] * np.cos(turn) + ahead[1] * np.sin(turn),
                    -ahead[0] * np.sin(turn) + ahead[1] * np.cos(turn),
                    0,
                ]
            )
            across = np.array([axis[1], -axis[0], 0]) * 0.045
            root = midrib(t)
            polygon(
                root,
                root + 0.35 * length * axis + across,
                root + length * axis,
                root + 0.35 * length * axis - across,
            )
    return np.array(vertices), np.array(faces)


def meshes() -> dict[str, tuple[Array, Array]]:
    """Path below the scenes folder -> vertices (n, 3) [local unit], triangles (m, 3)."""
    return {
        "boxes/shared_box.ply": box(shared=True),
        "boxes/split_box.ply": box(shared=False),
        "shadows/frond.ply": frond(),
    }


def ply(vertices: Array, faces: Array) -> str:
    """The mesh as an ASCII PLY file."""
    head = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}"]
    head += [f"property float {axis}" for axis in "xyz"]
    head += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    rows = [" ".join(f"{value:.6g}" for value in vertex) for vertex in vertices]
    rows += ["3 " + " ".join(map(str, face)) for face in faces]
    return "\n".join(head + rows) + "\n"


def textures() -> dict[str, Array]:
    """Path below the scenes folder -> (height, width, 3): uint8 is sRGB (PNG), float16 linear (OpenEXR)."""
    return {
        "textured_wall/paint.exr": textured_wall(),
        "striped_wall/stripes.exr": striped_wall(),
        "radial_wall/rings.exr": radial_wall(),
        "sky/sky.exr": sky(),
    }


def write(folder: Path) -> list[Path]:
    """Writes all files below the folder and returns their paths."""
    paths = []
    for name, pixels in textures().items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if pixels.dtype == np.uint8:
            Image.fromarray(pixels).save(path, optimize=True)
        else:
            header = {"compression": OpenEXR.PIZ_COMPRESSION, "type": OpenEXR.scanlineimage}
            with OpenEXR.File(header, {"RGB": pixels}) as file:
                file.write(str(path))
        paths.append(path)
    for name, (vertices, faces) in meshes().items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(ply(vertices, faces), encoding="ascii", newline="\n")
        paths.append(path)
    return paths


if __name__ == "__main__":
    for written in write(Path(sys.argv[1]) if len(sys.argv) > 1 else SCENES):
        print(f"{written}  {written.stat().st_size / 1024:.0f} kB")
