"""Files of splats as tools write them, from the numbers in them."""

from __future__ import annotations

import numpy as np

from mitsuba_crb.datasets.splat_set import SH_C0


def some_columns(count: int = 30, degree: int = 1, seed: int = 0) -> dict[str, np.ndarray]:
    """INRIA's columns of random splats, in its order."""
    rng = np.random.default_rng(seed)
    rest = 3 * ((degree + 1) ** 2 - 1)
    names = [
        *"xyz",
        "nx",
        "ny",
        "nz",
        *(f"f_dc_{k}" for k in range(3)),
        *(f"f_rest_{k}" for k in range(rest)),
    ]
    names += ["opacity", *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4))]
    return {name: rng.normal(size=count) - 3.0 * name.startswith("scale") for name in names}


def ply(columns: dict[str, np.ndarray], form: str = "binary_little_endian", kind: str = "float") -> bytes:
    """A PLY file of one element."""
    count = len(next(iter(columns.values())))
    lines = ["ply", f"format {form} 1.0", "comment made by a test", f"element vertex {count}"]
    lines += [f"property {kind} {name}" for name in columns]
    header = "\n".join([*lines, "end_header", ""]).encode()
    if form == "ascii":
        rows = zip(*columns.values(), strict=True)
        return header + "\n".join(" ".join(repr(float(x)) for x in row) for row in rows).encode() + b"\n"
    code = ("<" if "little" in form else ">") + {"float": "f4", "double": "f8"}[kind]
    table = np.zeros(count, dtype=[(name, code) for name in columns])
    for name, values in columns.items():
        table[name] = values
    return header + table.tobytes()


def mesh_ply() -> bytes:
    """A triangle."""
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
    header += "property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    return header.encode() + np.eye(3, dtype="<f4").tobytes() + b"\x03" + np.arange(3, dtype="<i4").tobytes()


def records(columns: dict[str, np.ndarray]) -> bytes:
    """antimatter15's `.splat` of the same splats, as its converter rounds them."""
    kind = [("means", "<f4", 3), ("scales", "<f4", 3), ("colour", "u1", 4), ("rotation", "u1", 4)]
    table = np.zeros(len(columns["x"]), dtype=kind)
    table["means"] = np.stack([columns[name] for name in "xyz"], axis=1)
    table["scales"] = np.exp(np.stack([columns[f"scale_{k}"] for k in range(3)], axis=1))
    colour = [0.5 + SH_C0 * columns[f"f_dc_{k}"] for k in range(3)]
    colour.append(1.0 / (1.0 + np.exp(-columns["opacity"])))
    table["colour"] = np.clip(np.stack(colour, axis=1) * 255.0, 0, 255)
    q = np.stack([columns[f"rot_{k}"] for k in range(4)], axis=1)
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    table["rotation"] = np.clip(q * 128.0 + 128.0, 0, 255)
    return table.tobytes()
