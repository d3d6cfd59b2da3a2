"""Scanned surfaces by flow: whether seeds agree within their stated errors, and with finite differences.

    python benchmarks/scans.py            # three surfaces, ten sizes from 64 to 512, five seeds; an hour
    python benchmarks/scans.py --quick    # sizes 64 and 96; some minutes

Three grey surfaces before a bright sky, as scanners make them: a ball whose vertices are off by 5e-4 of its
radius, a shell of two such balls 1e-3 of the radius apart, and a crumpled sheet that touches itself. Their
silhouettes lie within hundredths of a pixel of one another, which is where edges are missed or counted twice.
For each surface and size: χ² of the seeds' diag F about their mean under their stated errors (the mean over
translation's three entries, 4 degrees of freedom each; 95 % of 12 lie in 0.37 to 1.94 if they were
independent), the ratio of the mean to finite differences with its combined error, and which share of F flow
itself left to finite differences. All numbers also go to benchmarks/scans.json.
"""

from __future__ import annotations

import argparse
import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from mitsuba_crb import pose_bound
from mitsuba_crb.noise import Gaussian
from mitsuba_crb.render.backend import use_mitsuba

use_mitsuba()

import mitsuba as mi  # noqa: E402  the variant comes first

SIZES = (64, 80, 96, 128, 160, 192, 256, 320, 416, 512)
SEEDS = 5
NOISE = Gaussian(0.01)
console = Console(width=120)


def sphere(rings: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and faces (F, 3) of a unit sphere."""
    theta = np.linspace(0.0, np.pi, rings + 1)[1:-1]
    phi = np.linspace(0.0, 2.0 * np.pi, 2 * rings, endpoint=False)
    t, p = np.meshgrid(theta, phi, indexing="ij")
    middle = np.stack([np.sin(t) * np.cos(p), np.cos(t), np.sin(t) * np.sin(p)], axis=-1).reshape(-1, 3)
    vertices = np.concatenate([middle, [[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]])
    n = len(phi)
    i = np.arange(n)
    faces = [
        np.stack([a[j], b[j], c[j]], axis=1)
        for row in range(rings - 2)
        for a, b, c, j in (
            (row * n + i, row * n + n + i, row * n + (i + 1) % n, slice(None)),
            (row * n + (i + 1) % n, row * n + n + i, row * n + n + (i + 1) % n, slice(None)),
        )
    ]
    top, bottom = len(vertices) - 2, len(vertices) - 1
    faces.append(np.stack([np.full(n, top), i, (i + 1) % n], axis=1))
    last = (rings - 2) * n
    faces.append(np.stack([np.full(n, bottom), last + (i + 1) % n, last + i], axis=1))
    return vertices, np.concatenate(faces)


def bumpy(radius: float = 1.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A ball whose vertices are off by 5e-4 of its radius."""
    vertices, faces = sphere(96)
    noise = np.random.default_rng(seed).normal(size=len(vertices))
    return vertices * (radius + 5e-4 * noise)[:, None], faces


def shell() -> tuple[np.ndarray, np.ndarray]:
    """Two balls, one within the other, 1e-3 apart."""
    (outer, faces), (inner, _) = bumpy(), bumpy(0.999, seed=1)
    return np.concatenate([outer, inner]), np.concatenate([faces, faces + len(outer)])


def sheet(cells: int = 96) -> tuple[np.ndarray, np.ndarray]:
    """A crumpled sheet, folded once, so that its halves touch where they are bumpy."""
    u, v = np.meshgrid(*2 * [np.linspace(-1.0, 1.0, cells + 1)], indexing="ij")
    bumps = 2e-3 * np.random.default_rng(0).normal(size=u.shape)
    z = 0.15 * np.sin(3.0 * v) * np.cos(2.0 * u) + bumps + np.where(u > 0.0, 2e-3, 0.0)
    vertices = np.stack([np.where(u > 0.0, -u, u) + 0.5, v, z], axis=-1).reshape(-1, 3)
    i, j = (x.ravel() for x in np.meshgrid(np.arange(cells), np.arange(cells), indexing="ij"))
    a = i * (cells + 1) + j
    right, below = a + cells + 1, a + 1
    faces = [np.stack([a, right, below], axis=1), np.stack([below, right, right + 1], axis=1)]
    return vertices, np.concatenate(faces)


SURFACES = {"bumpy ball": bumpy, "shell": shell, "crumpled sheet": sheet}


def scene(vertices: np.ndarray, faces: np.ndarray, size: int) -> mi.Scene:
    """A grey surface of side about 2, four units before the camera, and the sky."""
    mesh = mi.Mesh("scan", len(vertices), len(faces))
    parameters = mi.traverse(mesh)
    turn = mi.ScalarTransform4f().translate([0.05, 0.03, 4.0]).rotate([1, 0.3, 0.2], 17)
    matrix = np.array(turn.matrix, dtype=np.float64)
    world = vertices @ matrix[:3, :3].T + matrix[:3, 3]
    parameters["vertex_positions"] = world.astype(np.float32).ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters.update()
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2},
            "sensor": {
                "type": "perspective",
                "fov": 40.0,
                "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "gaussian"}},
            },
            "sky": {"type": "constant", "radiance": 1.0},
            "scan": mesh,
        }
    )


def compared(surface: str, size: int, spp: int) -> dict[str, Any]:
    """How far seeds are apart, and the mean from finite differences."""
    loaded = scene(*SURFACES[surface](), size)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = [pose_bound(loaded, NOISE, spp=spp, seed=seed) for seed in range(SEEDS)]
        reference = pose_bound(loaded, NOISE, spp=spp, seed=99, method="finite_difference").information
    F, error = (
        np.array([np.diag(getattr(bound.information, name))[:3] for bound in found])
        for name in ("matrix", "standard_error")
    )
    mean = F.mean(axis=0)
    chi = np.sum((F - mean) ** 2, axis=0) / np.mean(error**2, axis=0) / (SEEDS - 1)
    truth, its_error = np.diag(reference.matrix)[:3], np.diag(reference.standard_error)[:3]
    combined = np.hypot(np.sqrt(np.mean(error**2, axis=0) / SEEDS), its_error) / truth
    return {
        "surface": surface,
        "size": size,
        "spp": spp,
        "chi_squared_per_freedom": float(chi.mean()),
        "ratio": (mean / truth).tolist(),
        "error": combined.tolist(),
        "share": float(np.mean([bound.provenance["finite_differences"]["share"] for bound in found])),
    }


def main() -> None:
    """Compare, print and keep."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="two sizes")
    parser.add_argument("--spp", type=int, default=64, help="paths per pixel")
    parser.add_argument("--output", type=Path, default=Path(__file__).with_suffix(".json"))
    given = parser.parse_args()
    table = Table(title="flow on scanned surfaces", title_justify="left")
    for head in ("surface", "size", "χ²/4 of seeds", "F / finite differences, ρx ρy ρz", "by differences"):
        table.add_column(head, justify="left" if head == "surface" else "right")
    rows = []
    for surface in SURFACES:
        for size in (64, 96) if given.quick else SIZES:
            row = compared(surface, size, given.spp)
            rows.append(row)
            ratios = "  ".join(f"{r:.3f}±{e:.3f}" for r, e in zip(row["ratio"], row["error"], strict=True))
            table.add_row(
                surface,
                str(size),
                f"{row['chi_squared_per_freedom']:.2f}",
                ratios,
                f"{100 * row['share']:.1f} %",
            )
            given.output.write_text(json.dumps(rows, indent=1), encoding="utf-8")
    console.print(table)


if __name__ == "__main__":
    main()
