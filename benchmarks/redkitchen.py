"""How well a depth camera's frames could be localised: 40 frames of 7-Scenes RedKitchen, each before itself.

    python benchmarks/redkitchen.py                 # all frames, 160x120; some minutes
    python benchmarks/redkitchen.py --every 10      # a short look

The world of a frame is a mesh of its own depth map: the inverse depth, which is linear on planes, smoothed
over 3 pixels but not across steps of 2 %, so that the sensor's noise is not taken for relief; a vertex for
every second pixel, and no triangle across such a step or a hole. Its depth is measured again from the frame's
pose, by the sensor's own noise: sigma = 1.43 mm z² (Khoshelham and Elberink 2012), which is a stereo camera
of baseline 75 mm with 0.0625 pixels of disparity; from 0.5 to 4 m, not at edges. Prints a row a frame; the
figure goes to benchmarks/figures/redkitchen.png.
"""

from __future__ import annotations

import argparse
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image
from rich.console import Console
from rich.table import Table
from scipy import ndimage

from mitsuba_crb import PoseBound, pose_bound
from mitsuba_crb.camera import Intrinsics
from mitsuba_crb.noise import Stereo
from mitsuba_crb.render.backend import use_mitsuba

use_mitsuba()

import mitsuba as mi  # noqa: E402  the variant comes first

ROOT = Path(__file__).parents[1]
DATA = ROOT.parent / "shared" / "data" / "multiview" / "7scenes_redkitchen_40"
FIGURE = ROOT / "benchmarks" / "figures" / "redkitchen.png"
SENSOR = Stereo(0.075, 0.0625)
RANGE = (0.5, 4.0)
STEP, SMOOTH, STRIDE = 0.02, 3.0, 2
console = Console(width=140)


def smoothed(depth: np.ndarray) -> np.ndarray:
    """(H, W) depth [m], NaN where there is none, its inverse averaged over what is alike."""
    w = np.where(depth > 0.0, 1.0 / np.maximum(depth, 1e-3), 0.0)
    total, weight = np.zeros_like(w), np.zeros_like(w)
    reach = int(2 * SMOOTH)
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            other = ndimage.shift(w, (dy, dx), order=0)
            alike = (other > 0.0) & (np.abs(other - w) < STEP * w)
            h = np.exp(-0.5 * (dx**2 + dy**2) / SMOOTH**2)
            total += h * alike * other
            weight += h * alike
    return np.where(w > 0.0, weight / np.maximum(total, 1e-9), np.nan)


def mesh(depth: np.ndarray, K: np.ndarray, pose: np.ndarray) -> mi.Mesh:
    """Triangles between neighbours that see one surface, in the world."""
    z = depth[::STRIDE, ::STRIDE]
    y, x = STRIDE * np.mgrid[: z.shape[0], : z.shape[1]]
    # Mitsuba's axes, x left and y up.
    points = np.stack([-(x - K[0, 2]) * z / K[0, 0], -(y - K[1, 2]) * z / K[1, 1], z], axis=-1)
    index = np.arange(z.size).reshape(z.shape)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
    faces = np.concatenate([np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)])
    corner = z.ravel()[faces]
    whole = np.ptp(corner, axis=1) < 2 * STEP * corner.min(axis=1)  # false of NaN
    used, faces = np.unique(faces[whole], return_inverse=True)
    vertices = points.reshape(-1, 3)[used] @ pose[:3, :3].T + pose[:3, 3]
    made = mi.Mesh("frame", len(vertices), faces.size // 3, has_vertex_normals=False)
    parameters = mi.traverse(made)
    parameters["vertex_positions"] = vertices.astype(np.float32).ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters.update()
    return made


def bound_of(folder: Path, name: str, size: tuple[int, int]) -> tuple[np.ndarray, PoseBound]:
    """A frame's smoothed depth map, and its bound."""
    K = np.loadtxt(folder / "camera-intrinsics.txt")
    pose = np.loadtxt(folder / f"{name}.pose.txt") @ np.diag([-1.0, -1.0, 1.0, 1.0])
    pose[:3, :3] = np.linalg.svd(pose[:3, :3])[0] @ np.linalg.svd(pose[:3, :3])[2]  # written with 8 digits
    raw = np.array(Image.open(folder / f"{name}.depth.png"), dtype=np.float64)
    depth = smoothed(np.where(raw < 65535, raw / 1000.0, 0.0))
    height, width = depth.shape
    world: dict[str, Any] = {
        "type": "scene",
        "frame": mesh(depth, K, pose),
        "sensor": {"type": "perspective", "to_world": mi.ScalarTransform4f(pose), "near_clip": 0.1},
    }
    # OpenCV counts from the middle of the first pixel.
    camera = Intrinsics((width, height), (K[0, 0], K[1, 1]), (K[0, 2] + 0.5, K[1, 2] + 0.5))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        bound = pose_bound(
            world, measure="depth", depth_sigma=SENSOR, depth_range=RANGE, camera=camera, size=size
        )
    return depth, bound


def draw(names: list[str], depths: list[np.ndarray], bounds: list[PoseBound]) -> Figure:
    """The bounds along the sequence, and the depth maps of the best and of the worst frame."""
    figure = Figure(figsize=(12, 7), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 2, height_ratios=[3, 2])
    number = [int(name[-6:]) for name in names]
    position = np.array([1000.0 * bound.position_std for bound in bounds])
    rotation = np.array([bound.rotation_std_deg for bound in bounds])
    for row, values, words, parts in (
        (grid[1, 0], position, "position, 1σ bound [mm]", "xyz"),
        (grid[1, 1], rotation, "rotation, 1σ bound [deg]", ("pitch", "yaw", "roll")),
    ):
        ax = figure.add_subplot(row)
        for column, part in zip(values.T, parts, strict=True):
            ax.plot(number, column, ".-", label=part, lw=1)
        ax.set_yscale("log")
        ax.set_xlabel("frame")
        ax.set_title(words, loc="left", fontsize=11)
        ax.legend(frameon=False, ncols=3, fontsize=9)
    spread = np.linalg.norm(np.where(np.isfinite(position), position, 1e9), axis=1)
    for column, (place, words) in enumerate(((np.argmin(spread), "best"), (np.argmax(spread), "worst"))):
        ax = figure.add_subplot(grid[0, column])
        shown = ax.imshow(depths[place], cmap="viridis_r", vmin=RANGE[0], vmax=RANGE[1])
        ax.set_axis_off()
        counts = bounds[place].provenance["measures"]["pixels"]
        share = counts["measured"] / sum(counts.values())
        title = f"{words}: frame {number[place]}, {spread[place]:.2g} mm, {share:.0%} measured"
        ax.set_title(title, loc="left", fontsize=11)
        figure.colorbar(shown, ax=ax, label="depth [m]", shrink=0.8)
    return figure


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--data", type=Path, default=DATA, help="Folder of the frames.")
    parser.add_argument("--every", type=int, default=1, help="Take every n-th frame.")
    parser.add_argument("--width", type=int, default=160, help="Of the measured image; 640 is the sensor's.")
    given = parser.parse_args()
    names = sorted(file.name.partition(".")[0] for file in given.data.glob("*.depth.png"))[:: given.every]
    if not names:
        parser.error(f"{given.data} has no frame-*.depth.png")
    size = given.width, given.width * 3 // 4
    table = Table(title=f"7-Scenes RedKitchen, {size[0]}x{size[1]}, sigma = 1.43 mm z²", title_justify="left")
    for head in (
        "frame",
        "depth m",
        "told",
        "rank",
        "x mm",
        "y mm",
        "z mm",
        "pitch°",
        "yaw°",
        "roll°",
        "s",
    ):
        table.add_column(head, justify="right")
    table.add_column("weakest seen")
    depths, bounds = [], []
    for name in names:
        start = time.perf_counter()
        depth, bound = bound_of(given.data, name, size)
        depths.append(depth)
        bounds.append(bound)
        counts = bound.provenance["measures"]["pixels"]
        table.add_row(
            name[-6:],
            f"{bound.length_scale:.2f}",
            f"{counts['measured'] / sum(counts.values()):.0%}",
            str(bound.rank),
            *(f"{1000.0 * value:.3g}" for value in bound.position_std),
            *(f"{value:.2g}" for value in bound.rotation_std_deg),
            f"{time.perf_counter() - start:.1f}",
            "" if bound.weakest is None else bound.weakest.description,
        )
    console.print(table)
    draw(names, depths, bounds).savefig(FIGURE, dpi=80)
    console.print(f"{FIGURE.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
