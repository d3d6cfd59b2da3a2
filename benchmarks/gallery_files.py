"""What the gallery's scenes name: textures, volumes, meshes, curves and ellipsoids of fixed numbers."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np

CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float32)
QUADS = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
FACES = [[q[i] for i in t] for q in QUADS for t in ((0, 1, 2), (0, 2, 3))]
CURVES = [
    [(-1.0, -1.0, 2.2, 0.12), (-0.4, 0.4, 2.0, 0.14), (0.2, -0.2, 2.0, 0.14), (0.9, 1.2, 2.2, 0.12)],
    [(0.8, -1.2, 1.9, 0.1), (0.5, -0.2, 1.8, 0.12), (0.8, 0.3, 1.8, 0.12), (0.2, 1.4, 1.9, 0.1)],
]
"""Control points x, y, z and radius."""


def write_files(folder: Path) -> None:
    """All of them into a folder."""
    random = np.random.default_rng(0)
    pictures = {
        "texture": random.uniform(0.1, 0.9, (32, 32, 3)),
        "smooth": random.uniform(0.1, 0.9, (8, 8, 3)),
        "heights": random.uniform(0.0, 1.0, (12, 12, 1)),
        "normals": np.concatenate([random.normal(0.5, 0.08, (8, 8, 2)), np.ones((8, 8, 1))], axis=-1),
        "sky": random.uniform(0.1, 2.0, (16, 32, 3)),
    }
    grids = {
        "distance": _distances(24),
        "colours": random.uniform(0.1, 0.9, (12, 12, 12, 3)),
        "density": random.uniform(0.2, 1.0, (6, 6, 6, 1)),
        "sggx": np.broadcast_to([0.4, 1.0, 0.4, 0.0, 0.0, 0.0], (2, 2, 2, 6)),
    }
    _write_pictures(folder, pictures, grids)
    for name, text in {"cube.ply": _ply(CORNERS, FACES), "cube.obj": _obj(), "sheet.ply": _sheet()}.items():
        (folder / name).write_text(text)
    lines = "\n\n".join("\n".join(" ".join(map(str, point)) for point in curve) for curve in CURVES)
    (folder / "curve.txt").write_text(lines + "\n")
    (folder / "cube.serialized").write_bytes(_serialized())
    (folder / "cloud.ply").write_bytes(_cloud())


def _write_pictures(folder: Path, pictures: dict[str, np.ndarray], grids: dict[str, np.ndarray]) -> None:
    import mitsuba as mi

    for name, values in pictures.items():
        mi.Bitmap(values.astype(np.float32)).write(str(folder / f"{name}.exr"))
    for name, values in grids.items():
        mi.VolumeGrid(np.ascontiguousarray(values, dtype=np.float32)).write(str(folder / f"{name}.vol"))


def _distances(n: int) -> np.ndarray:
    """(n, n, n, 1) of a torus in the unit cube, at the points of a grid."""
    z, y, x = np.meshgrid(*3 * [np.linspace(-0.5, 0.5, n)], indexing="ij")
    return (np.hypot(np.hypot(x, y) - 0.28, z) - 0.13)[..., None]


def _ply(vertices: np.ndarray, faces: list[list[int]], colours: np.ndarray | None = None) -> str:
    names = ("x", "y", "z", *(("r", "g", "b") if colours is not None else ()))
    rows = vertices if colours is None else np.concatenate([vertices, colours], axis=1)
    header = ["ply", "format ascii 1.0", f"element vertex {len(rows)}"]
    header += [f"property float {name}" for name in names]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    body = [" ".join(f"{value:.6g}" for value in row) for row in rows]
    return "\n".join([*header, *body, *(" ".join(map(str, [len(face), *face])) for face in faces)]) + "\n"


def _obj() -> str:
    lines = ["v " + " ".join(f"{value:g}" for value in vertex) for vertex in CORNERS]
    return "\n".join([*lines, *("f " + " ".join(str(i + 1) for i in face) for face in FACES)]) + "\n"


def _sheet(n: int = 16) -> str:
    """A square of n x n coloured vertices."""
    y, x = np.meshgrid(*2 * [np.linspace(-1.0, 1.0, n)], indexing="ij")
    vertices = np.stack([x, y, 0.0 * x], axis=-1).reshape(-1, 3)
    corner = [row * n + column for row in range(n - 1) for column in range(n - 1)]
    faces = [face for i in corner for face in ([i, i + 1, i + n + 1], [i, i + n + 1, i + n])]
    return _ply(vertices, faces, np.random.default_rng(1).uniform(0.1, 0.9, (n * n, 3)))


def _serialized() -> bytes:
    """Mitsuba's own format, version 4: one mesh in single precision, then where it begins."""
    flags = 0x1000
    body = struct.pack("<I", flags) + b"cube\0" + struct.pack("<QQ", len(CORNERS), len(FACES))
    body += CORNERS.astype("<f4").tobytes() + np.array(FACES, dtype="<u4").tobytes()
    return struct.pack("<HH", 0x041C, 4) + zlib.compress(body) + struct.pack("<QI", 0, 1)


def _cloud() -> bytes:
    """Three ellipsoids as gaussian splatting stores them: logarithms of scales, logits of opacities."""
    centres = [[0.0, 0.1, 2.0], [0.5, 0.3, 3.0], [-0.4, 0.0, 2.5]]
    scales = np.log([[0.2, 0.1, 0.1], [0.1, 0.3, 0.1], [0.1, 0.1, 0.2]])
    colours = [[1.5, 0.2, 0.4], [0.1, 1.2, 0.3], [0.5, 0.2, 1.0]]
    columns = {
        "x y z": centres,
        "nx ny nz": [[0.0] * 3] * 3,
        "f_dc_0 f_dc_1 f_dc_2": colours,
        "opacity": [[1.4]] * 3,
        "scale_0 scale_1 scale_2": scales,
        "rot_0 rot_1 rot_2 rot_3": [[1.0, 0.0, 0.0, 0.0]] * 3,
    }
    names = " ".join(columns).split()
    header = ["ply", "format binary_little_endian 1.0", "element vertex 3"]
    header += [f"property float {name}" for name in names] + ["end_header"]
    rows = np.concatenate([np.asarray(part, dtype=float) for part in columns.values()], axis=1)
    return ("\n".join(header) + "\n").encode() + rows.astype("<f4").tobytes()
