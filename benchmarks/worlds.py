"""A scanned room of a million triangles: seconds of load, prepare, render and bound.

    python benchmarks/worlds.py                    # 1,000,000 triangles, 320x240, 64 paths a pixel
    python benchmarks/worlds.py --triangles 100000 --size 160x120

A room of 6 x 5 x 3 metres with furniture, all its surfaces bumpy as scanners make them, one texture of 4096
pixels square, written as GLB. It is measured baked (its texture is the radiance) and lit (constant light
through a missing wall). read: from file to arrays and textures; scene: Mitsuba's, with what traces rays in
it; edges: the table of all edges; contours: which of them this camera sees, and how they are sampled;
render: the image alone, of as many paths; bound: all from the loaded scene on. "first" includes what is
compiled, or made once of a scene. Numbers also go to benchmarks/worlds.json.
"""

from __future__ import annotations

import argparse
import io
import json
import struct
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from rich.console import Console
from rich.table import Table

from mitsuba_crb import load_world, pose_bound
from mitsuba_crb.noise import Gaussian
from mitsuba_crb.render.backend import use_mitsuba

use_mitsuba()

import mitsuba as mi  # noqa: E402  the variant comes first

from mitsuba_crb.jacobian.silhouettes import find_contours  # noqa: E402
from mitsuba_crb.jacobian.surfaces import edge_table  # noqa: E402
from mitsuba_crb.render.pixels import render_pixels  # noqa: E402
from mitsuba_crb.render.view import open_view  # noqa: E402

ROOM = np.array([6.0, 3.0, 5.0])
"""Width, height and depth [m]; y is up."""
BUMPS = 3e-3
"""Of a scanner [m]."""


def sheet(origin: Any, u: Any, v: Any, cells: tuple[int, int], rng: np.random.Generator) -> tuple[Any, Any]:
    """A bumpy rectangle: vertices (V, 3) and faces (F, 3)."""
    s, t = np.meshgrid(np.linspace(0, 1, cells[0] + 1), np.linspace(0, 1, cells[1] + 1), indexing="ij")
    points = np.array(origin) + s[..., None] * np.array(u) + t[..., None] * np.array(v)
    normal = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
    points += BUMPS * rng.standard_normal(s.shape)[..., None] * normal
    i, j = (x.ravel() for x in np.meshgrid(np.arange(cells[0]), np.arange(cells[1]), indexing="ij"))
    a = i * (cells[1] + 1) + j
    right, below = a + cells[1] + 1, a + 1
    faces = [np.stack([a, right, below], axis=1), np.stack([below, right, right + 1], axis=1)]
    return points.reshape(-1, 3), np.concatenate(faces)


def rectangles(rng: np.random.Generator) -> list[tuple[Any, Any, Any]]:
    """Walls of the room, and boxes in it: origin and two sides of each."""
    w, h, d = ROOM
    found: list[tuple[Any, Any, Any]] = [
        ((0, 0, 0), (w, 0, 0), (0, 0, d)),
        ((0, h, 0), (w, 0, 0), (0, 0, d)),
        ((0, 0, 0), (w, 0, 0), (0, h, 0)),
        ((0, 0, 0), (0, 0, d), (0, h, 0)),
        ((w, 0, 0), (0, 0, d), (0, h, 0)),
    ]
    for _ in range(24):
        size = rng.uniform(0.2, 0.9, 3)
        low = rng.uniform(0.0, 1.0, 3) * (np.array([w, 0.8, d - 2.0]) - size)
        low[1] = max(low[1], 0.0)
        for axis in range(3):
            across, along = np.eye(3)[axis - 2] * size, np.eye(3)[axis - 1] * size
            for end in (low, low + np.eye(3)[axis] * size):
                found.append((end, across, along))
    return found


def write_room(file: Path, triangles: int, seed: int = 0) -> int:
    """Write the room as GLB; returns how many triangles it has."""
    rng = np.random.default_rng(seed)
    parts = rectangles(rng)
    area = np.array([np.linalg.norm(np.cross(u, v)) for _, u, v in parts])
    cell = np.sqrt(2.0 * area.sum() / triangles)
    vertices, faces, uv, count = [], [], [], 0
    for number, (origin, u, v) in enumerate(parts):
        cells = tuple(max(1, round(float(np.linalg.norm(side)) / cell)) for side in (u, v))
        points, index = sheet(origin, u, v, (cells[0], cells[1]), rng)
        place = np.array([number % 13, number // 13]) / 13.0
        s, t = np.meshgrid(np.linspace(0, 1, cells[0] + 1), np.linspace(0, 1, cells[1] + 1), indexing="ij")
        uv.append(place + np.stack([s, t], axis=-1).reshape(-1, 2) / 13.0)
        vertices.append(points)
        faces.append(index + count)
        count += len(points)
    picture = np.kron(rng.uniform(0.15, 0.85, (256, 256, 3)), np.ones((16, 16, 1)))
    encoded = io.BytesIO()
    Image.fromarray((255.0 * picture).astype(np.uint8)).save(encoded, format="png", compress_level=1)
    arrays = [
        np.concatenate(vertices).astype(np.float32),
        np.concatenate(uv).astype(np.float32),
        np.concatenate(faces).astype(np.uint32),
    ]
    blobs = [*(array.tobytes() for array in arrays), encoded.getvalue()]
    starts = np.cumsum([0, *(len(blob) + -len(blob) % 4 for blob in blobs)])
    rough = {"baseColorTexture": {"index": 0}, "metallicFactor": 0.0}
    document = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0, 1]}],
        "nodes": [
            {"mesh": 0},
            # It looks from the missing wall towards -z, into the room.
            {"camera": 0, "translation": [0.5 * ROOM[0], 1.5, ROOM[2] - 0.3]},
        ],
        "cameras": [
            {"type": "perspective", "perspective": {"yfov": 0.9, "aspectRatio": 4 / 3, "znear": 0.01}}
        ],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}]}
        ],
        "materials": [{"name": "scan", "pbrMetallicRoughness": rough}],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 3, "mimeType": "image/png"}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": len(arrays[0]), "type": "VEC3"},
            {"bufferView": 1, "componentType": 5126, "count": len(arrays[1]), "type": "VEC2"},
            {"bufferView": 2, "componentType": 5125, "count": arrays[2].size, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": int(start), "byteLength": len(blob)}
            for start, blob in zip(starts, blobs, strict=False)
        ],
        "buffers": [{"byteLength": int(starts[-1])}],
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    binary = b"".join(blob + bytes(-len(blob) % 4) for blob in blobs)
    chunks = (
        struct.pack("<II", len(text), 0x4E4F534A)
        + text
        + struct.pack("<II", len(binary), 0x004E4942)
        + binary
    )
    file.write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks)
    return len(arrays[2])


def timed(function: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds, and what it returned."""
    start = time.perf_counter()
    found = function()
    return time.perf_counter() - start, found


def measured(file: Path, light: str, size: tuple[int, int], spp: int) -> dict[str, float]:
    """Seconds of each part."""
    seconds: dict[str, float] = {}
    seconds["read"], world = timed(lambda: load_world(file, light=light))
    seconds["scene"], scene = timed(lambda: mi.load_dict(world))
    seconds["edges"], table = timed(lambda: edge_table(scene))
    rows, columns = np.indices(size[::-1])
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 2)
    with open_view(scene, size=size) as view:
        # The first one also compiles its kernels.
        seconds["contours, first"], _ = timed(lambda: find_contours(view))
        seconds["contours"], contours = timed(lambda: find_contours(view))
        seconds["render, first"], _ = timed(lambda: render_pixels(view, pixels, spp=spp, seed=0))
        seconds["render"], _ = timed(lambda: render_pixels(view, pixels, spp=spp, seed=1))
    for name in ("bound, first", "bound"):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            seconds[name], _ = timed(lambda: pose_bound(scene, Gaussian(0.01), size=size, spp=spp))
    print(f"{light}: {len(table.ends)} edges, {len(contours.pieces)} pieces of contours")
    return seconds


def main() -> None:
    """Measure, print and keep."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--triangles", type=int, default=1_000_000)
    parser.add_argument("--size", default="320x240")
    parser.add_argument("--spp", type=int, default=64, help="paths per pixel")
    parser.add_argument("--file", type=Path, default=Path("/tmp/room.glb"), help="where the room is written")
    parser.add_argument("--light", action="append", help="default: baked and constant:1")
    parser.add_argument("--output", type=Path, default=Path(__file__).with_suffix(".json"))
    given = parser.parse_args()
    width, height = map(int, given.size.split("x"))
    count = write_room(given.file, given.triangles)
    rows = {
        light: measured(given.file, light, (width, height), given.spp)
        for light in given.light or ["baked", "constant:1"]
    }
    table = Table(
        title=f"{count:,} triangles, {given.size}, {given.spp} paths",
        title_justify="left",
    )
    table.add_column("seconds of")
    for light in rows:
        table.add_column(light, justify="right")
    for name in next(iter(rows.values())):
        table.add_row(name, *(f"{row[name]:.2f}" for row in rows.values()))
    Console(width=120).print(table)
    given.output.write_text(
        json.dumps({"triangles": count, "size": given.size, "spp": given.spp, "seconds": rows}, indent=1),
        encoding="utf-8",
    )


if __name__ == "__main__":
    main()
