"""The figures of README and documentation, into benchmarks/figures/.

    python benchmarks/figures.py [--only bound|columns|field]

bound.png: the page that `mitsuba-crb bound scenes/textured_room/textured_room.xml --plot` writes.
columns.png: the six columns of the Jacobian on a checkerboard, by `forward` and by `flow`.
field.png: where a camera is located well in the demo scene, what `mitsuba-crb field --plot` writes;
field_hall.png the same of a hall by others (sponza), if it is there.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
import warnings
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from mitsuba_crb import cramer_rao_bound, fisher_information, pose_jacobian
from mitsuba_crb.errors import BlindSpotWarning, SceneWarning
from mitsuba_crb.measure.pictures import pictures_of
from mitsuba_crb.noise import Gaussian
from mitsuba_crb.planning.candidates import parse_candidates
from mitsuba_crb.planning.field_run import measure_field
from mitsuba_crb.show.bound_page import bound_figure
from mitsuba_crb.show.field_page import field_figure, outlines_of
from mitsuba_crb.show.plot import column_limit, draw_column, draw_render

ROOT = Path(__file__).parents[1]
FOLDER = Path(__file__).parent / "figures"
HALL = ROOT.parent / "shared" / "data" / "mitsuba" / "sponza" / "scene_m39.xml"


def scene(name: str) -> Path:
    """A shipped scene's file."""
    return ROOT / "scenes" / name / f"{name}.xml"


def bound_page() -> None:
    """The whole story of the demo scene."""
    jacobian = pose_jacobian(scene("textured_room"), size=(384, 288), spp=64)
    noise = Gaussian(0.01 * float(np.percentile(jacobian.image, 99)))
    information = fisher_information(jacobian, noise)
    provenance = {**jacobian.provenance, "noise": noise.to_dict()}
    bound = dataclasses.replace(cramer_rao_bound(information), provenance=provenance)
    figure = bound_figure(bound, pictures_of(jacobian, information, noise))
    figure.savefig(FOLDER / "bound.png", dpi=80)


def columns() -> None:
    """Automatic differentiation sees nothing in a checkerboard; the material form sees all."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", BlindSpotWarning)
        both = {
            method: pose_jacobian(scene("checkerboard_wall"), method=method, size=(192, 144), spp=64)
            for method in ("forward", "flow")
        }
    noise = Gaussian(0.01)
    pictures = {m: pictures_of(j, fisher_information(j, noise), noise) for m, j in both.items()}
    figure, axes = plt.subplots(2, 7, figsize=(14, 3.4), layout="constrained")
    names = ("left", "up", "forward")
    for row, (method, picture) in enumerate(pictures.items()):
        draw_render(axes[row, 0], picture.image)
        axes[row, 0].set_ylabel(method, fontsize=12)
        for k in range(6):
            part = slice(0, 3) if k < 3 else slice(3, 6)
            limit = column_limit(pictures["flow"].columns[..., part])
            draw_column(axes[row, k + 1], picture.columns[..., k], limit=limit)
            if row == 0:
                axes[row, k + 1].set_title(f"{'move' if k < 3 else 'turn about'} {names[k % 3]}", fontsize=10)
    axes[0, 0].set_title("render", fontsize=10)
    figure.savefig(FOLDER / "columns.png", dpi=80)


def fields() -> None:
    """Where in a room a camera is located well, in two rooms."""
    places = {
        "field": (
            scene("textured_room"),
            "grid:x=-2.2:2.2,y=-1:3.6,spacing=0.55,headings=8",
            {"size": (48, 36), "spp": 32},
        ),
        "field_hall": (
            HALL,
            "grid:x=-12:12,y=1.7,z=-6:6,spacing=2.4,headings=4",
            {"size": (32, 24), "spp": 1024},
        ),
    }
    for name, (world, poses, options) in places.items():
        if not world.is_file():
            continue
        with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
            warnings.simplefilter("ignore", SceneWarning)
            candidates = parse_candidates(poses, world, **options)
            field = measure_field(world, candidates, Path(folder) / "field.zarr", workers=2, **options)
            figure = field_figure(field, outlines_of(field, world))
        figure.savefig(FOLDER / f"{name}.png", dpi=80)


DRAWN = {"bound": bound_page, "columns": columns, "field": fields}


def main() -> None:
    """Write all of them, or one."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", choices=DRAWN)
    only = parser.parse_args().only
    FOLDER.mkdir(exist_ok=True)
    for name, draw in DRAWN.items():
        if only in (None, name):
            draw()


if __name__ == "__main__":
    main()
