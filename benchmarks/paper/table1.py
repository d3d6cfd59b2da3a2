"""The paper's Table 1 on our scenes: what an image tells of the camera's pose, and what estimators achieve.

    python benchmarks/paper/table1.py     # some minutes on 2 cores; writes CSV and PNG beside it

High texture is `textured_room`, low texture `plain_room`: the same geometry, light and camera in uniform
paint. The sensor's noise is Gaussian with sigma 0.01 [radiance] everywhere. Rows at 256 x 192 pixels:

- CRB: the photometric bound of all pixels.
- windows: the photometric bound of an estimator that sees only the corners' windows.
- BA: bundle adjustment with known points at those corners, each as precisely located as its window allows
  under the same noise.

Rows at 32 x 24 pixels, where a trial takes a second and not a minute (`calibration.py` says how):

- CRB: the bound of all pixels there.
- empirical: root mean square error of Gauss–Newton over 60 trials, so that its standard error is 9 %; the
  renderer's noise adds 2 %. It is 0.95 to 1.27 times the bound in both scenes, which share their noise.

The paper has its BA row below its own CRB. No function of the same image can be: here corners are 3 times
worse than all pixels where there is texture and 8 to 30 times where there is little, and tell what their
windows tell, to 5 %. A BA row whose pixel noise is assumed, not derived from the image, can lie anywhere.
The paper's numbers are not given beside ours: its table was not at hand when these were measured. They would
differ by its scenes, resolution and noise, so that only ratios of rows could be compared.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import NamedTuple

import numpy as np
from calibration import AXES, SCENES, TABLE, UNITS, axis_values
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mitsuba_crb import PoseBound, cramer_rao_bound, pose_bound
from mitsuba_crb.estimate.tracks import feature_tracks
from mitsuba_crb.noise import Gaussian

HERE = Path(__file__).parent
SIGMA = Gaussian(0.01)
SPP = 256
COLOURS = {"CRB": "#e6550d", "windows": "#fdae6b", "BA": "#2166ac", "empirical": "#92c5de"}
FIELDS = ("scene", "image", "row", "of", *(f"{a} [{u}]" for a, u in zip(AXES, UNITS, strict=True)))


class Row(NamedTuple):
    """One row of a scene's table."""

    image: str
    """Its size."""
    name: str
    """What it is."""
    of: str
    """How many corners or trials."""
    values: np.ndarray
    """(6,), standard deviations of the position along the world's axes [cm] and of the rotation [deg]."""


def of_corners(scene: str) -> list[Row]:
    """All pixels, the corners' windows, and the corners as points."""
    path = HERE.parents[1] / "scenes" / SCENES[scene] / f"{SCENES[scene]}.xml"
    tracks = feature_tracks(path, SIGMA, spp=SPP)
    corners = f"{len(tracks.points)} corners"
    return [
        Row("256x192", "CRB", "all pixels", numbers(cramer_rao_bound(tracks.image_information))),
        Row("256x192", "windows", corners, numbers(pose_bound(path, SIGMA, pixels=tracks.windows, spp=SPP))),
        Row("256x192", "BA", corners, numbers(cramer_rao_bound(tracks.information))),
    ]


def of_trials(scene: str) -> list[Row]:
    """The bound of a small image, and the errors of those who try."""
    run = next(run for run in TABLE if run.scene == scene)
    found = run.validation()
    errors = axis_values(found.errors, found.bound.information.pose)
    return [
        Row("32x24", "CRB", "all pixels", numbers(found.bound)),
        Row("32x24", "empirical", f"{len(errors)} trials", np.sqrt(np.mean(errors**2, axis=0))),
    ]


def numbers(bound: PoseBound) -> np.ndarray:
    """(6,), a bound's standard deviations."""
    return np.concatenate([100.0 * bound.position_std, bound.rotation_std_deg])


def draw(results: dict[str, list[Row]]) -> Figure:
    """Bars by axis, position beside rotation, a row of axes per scene."""
    figure = Figure(figsize=(9.0, 5.6), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(results), 2, sharey="col")
    for (scene, rows), pair in zip(results.items(), axes, strict=True):
        for ax, part, unit in zip(pair, (slice(0, 3), slice(3, 6)), ("cm", "deg"), strict=True):
            for k, row in enumerate(rows):
                place = np.arange(3) + 0.16 * (k - 2) + (0.05 if row.image == "32x24" else 0.0)
                small = {"hatch": "///", "edgecolor": "white"} if row.image == "32x24" else {}
                label = f"{row.name}, {row.image}, {row.of}"
                ax.bar(place, row.values[part], 0.15, color=COLOURS[row.name], label=label, **small)
            ax.set_xticks(range(3), AXES[part])
            ax.set(yscale="log", ylabel=f"standard deviation [{unit}]")
            ax.set_title(scene, fontsize=10)
            ax.grid(axis="y", alpha=0.25)
        pair[1].legend(fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def main() -> None:
    """Measure both scenes, write the CSV and the figure, print the table."""
    results = {scene: [*of_corners(scene), *of_trials(scene)] for scene in SCENES}
    with (HERE / "table1.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(FIELDS)
        for scene, rows in results.items():
            for row in rows:
                writer.writerow([scene, *row[:3], *(f"{value:.5g}" for value in row.values)])
    draw(results).savefig(HERE / "table1.png", dpi=110)
    print(f"{'scene':<14}{'image':<9}{'row':<11}" + "".join(f"{name:>13}" for name in FIELDS[4:]))
    for scene, rows in results.items():
        for row in rows:
            line = "".join(f"{value:>13.3g}" for value in row.values)
            print(f"{scene:<14}{row.image:<9}{row.name:<11}{line}")


if __name__ == "__main__":
    main()
