"""The paper's Table 1 on our scenes: what an image tells of the camera's pose, by all pixels and by corners.

    python benchmarks/paper/table1.py     # a minute on 2 cores; writes CSV and PNG beside it

High texture is `textured_room`, low texture `plain_room`: the same geometry, light and camera in uniform
paint, at 256 x 192 pixels. The sensor's noise is Gaussian with sigma 0.01 [radiance] in both. Rows:

- CRB: the photometric bound of all pixels.
- windows: the photometric bound of an estimator that sees only the corners' windows.
- BA: bundle adjustment with known points at those corners, each as precisely located as its window allows
  under the same noise.

The paper has its BA row below its own CRB. No function of the same image can be: here corners are 3 times
worse than all pixels where there is texture and 6 to 10 times where there is little, and tell what their
windows tell, to 3 %. A BA row whose pixel noise is assumed, not derived from the image, can lie anywhere.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mitsuba_crb import PoseBound, cramer_rao_bound, pose_bound
from mitsuba_crb.noise import Gaussian
from mitsuba_crb.tracks import feature_tracks

HERE = Path(__file__).parent
SCENES = {"high texture": "textured_room", "low texture": "plain_room"}
SIGMA = Gaussian(0.01)
SPP = 256
ROWS = {"CRB": "#e6550d", "windows": "#fdae6b", "BA": "#2166ac"}
AXES = ("x", "y", "z", "pitch", "yaw", "roll")
FIELDS = ("scene", "corners", "row", *(f"{a} [cm]" for a in AXES[:3]), *(f"{a} [deg]" for a in AXES[3:]))


def bounds(scene: str) -> tuple[int, dict[str, PoseBound]]:
    """How many corners a scene has, and its rows."""
    path = HERE.parents[1] / "scenes" / scene / f"{scene}.xml"
    tracks = feature_tracks(path, SIGMA, spp=SPP)
    rows = {
        "CRB": cramer_rao_bound(tracks.image_information),
        "windows": pose_bound(path, SIGMA, pixels=tracks.windows, spp=SPP),
        "BA": cramer_rao_bound(tracks.information),
    }
    return len(tracks.points), rows


def numbers(bound: PoseBound) -> np.ndarray:
    """(6,), standard deviations of the position along the world's axes [cm] and of the rotation [deg]."""
    return np.concatenate([100.0 * bound.position_std, bound.rotation_std_deg])


def draw(results: dict[str, tuple[int, dict[str, PoseBound]]]) -> Figure:
    """Bars by axis, position beside rotation, a row of axes per scene."""
    figure = Figure(figsize=(8.0, 5.6), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(results), 2, sharey="col")
    for (scene, (corners, rows)), pair in zip(results.items(), axes, strict=True):
        for ax, part, unit in zip(pair, (slice(0, 3), slice(3, 6)), ("cm", "deg"), strict=True):
            for k, (name, bound) in enumerate(rows.items()):
                ax.bar(
                    np.arange(3) + 0.27 * (k - 1), numbers(bound)[part], 0.25, color=ROWS[name], label=name
                )
            ax.set_xticks(range(3), AXES[part])
            ax.set(yscale="log", ylabel=f"standard deviation [{unit}]")
            ax.set_title(f"{scene}, {corners} corners", fontsize=10)
            ax.grid(axis="y", alpha=0.25)
    axes[0, 0].legend(fontsize=8, frameon=False)
    return figure


def main() -> None:
    """Measure both scenes, write the CSV and the figure, print the table."""
    results = {name: bounds(scene) for name, scene in SCENES.items()}
    with (HERE / "table1.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(FIELDS)
        for scene, (corners, rows) in results.items():
            for name, bound in rows.items():
                writer.writerow([scene, corners, name, *(f"{value:.5g}" for value in numbers(bound))])
    draw(results).savefig(HERE / "table1.png", dpi=110)
    print(f"{'scene':<14}{'row':<10}" + "".join(f"{name:>14}" for name in FIELDS[3:]))
    for scene, (_, rows) in results.items():
        for name, bound in rows.items():
            print(f"{scene:<14}{name:<10}" + "".join(f"{value:>14.3g}" for value in numbers(bound)))


if __name__ == "__main__":
    main()
