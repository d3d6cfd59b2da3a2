"""Splats: what image and columns cost, up to a million of them, and what a rasteriser's cuts do to F.

    python benchmarks/splats.py                  # all of it; ten minutes on 2 cores
    python benchmarks/splats.py --only cost      # image and columns beside the image alone
    python benchmarks/splats.py --only million   # one million splats; time against their number and pixels
    python benchmarks/splats.py --only cuts      # the uncut picture beside the cut one, and F of both
    python benchmarks/splats.py --only rotation  # rotation columns beside the filter term
    python benchmarks/splats.py --only maps      # what not knowing colours or opacities costs

Needs ../shared/data/gaussians. Times are medians of warm calls that take turns, each from a pose of its own:
projection, sorting and blending, to NumPy arrays. `cuts` has INRIA's and gsplat's threshold (opacity below
1/255, transmittance below 1e-4), and a cut at 3 σ; differences are central ones of 0.02 pixels, at the order
of depth of the middle pose or sorted anew.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests" / "radiance"))

from splat_views import (  # noqa: E402  which live with the tests
    REAL,
    pixels_of,
    real_camera,
    real_splats,
    real_views,
    sized_splats,
    turned_by_flow,
)

from mitsuba_crb import se3  # noqa: E402
from mitsuba_crb.camera import Camera  # noqa: E402
from mitsuba_crb.datasets.splats import Splats  # noqa: E402
from mitsuba_crb.radiance import splat_blending  # noqa: E402
from mitsuba_crb.radiance.gaussians import Gaussians, load_gaussians  # noqa: E402
from mitsuba_crb.radiance.map_nuisance import UNKNOWNS, map_cost, map_information  # noqa: E402

DATA = ROOT.parent / "shared" / "data" / "gaussians"
ROUNDS = 5
console = Console(width=120)


def turns(tasks: list[Callable[[np.ndarray], object]], pose: np.ndarray, rounds: int) -> list[float]:
    """Median seconds of each task, which take turns; every call from another pose."""
    seconds: list[list[float]] = [[] for _ in tasks]
    count = 0
    for turn in range(rounds + 1):
        for task, own in zip(tasks, seconds, strict=True):
            count += 1
            moved = pose @ se3.exp([0.0, 0.0, 0.0, 0.0, 1e-3 * count, 0.0])
            start = time.perf_counter()
            task(moved)
            if turn > 0:  # the first one compiles
                own.append(time.perf_counter() - start)
    return [statistics.median(own) for own in seconds]


def both(field: Gaussians, camera: Camera) -> list[Callable[[np.ndarray], object]]:
    """The image, and the image with its columns."""
    pixels = pixels_of(camera)
    return [
        lambda pose: field.show(camera, pose, pixels),
        lambda pose: field.columns(camera, pose, pixels),
    ]


def cost() -> None:
    """Image and six columns beside the image alone."""
    table = Table("splats", "pixels", "image (s)", "with columns (s)", "times", title="cost, warm")
    for name in REAL:
        field = Gaussians(real_splats(name, DATA))
        for width in (256, 512):
            image, columns = turns(both(field, real_camera(width)), real_views(name)[0], ROUNDS)
            table.add_row(
                f"{name}, {len(field.splats)}",
                f"{width}²",
                f"{image:.3f}",
                f"{columns:.3f}",
                f"{columns / image:.2f}",
            )
    console.print(table)


def multiplied(splats: Splats, count: int) -> Splats:
    """As many splats, each split into smaller ones within it, which cover about what it did."""
    rng = np.random.default_rng(0)
    times = -(-count // len(splats))
    which = np.repeat(np.arange(len(splats)), times)[:count]
    normal = rng.normal(size=(count, 3))
    split = replace(
        splats,
        means=splats.means[which] + np.einsum("nij,nj->ni", splats.factors[which], normal),
        rotations=splats.rotations[which],
        scales=splats.scales[which] / times ** (1.0 / 3.0),
        opacities=splats.opacities[which],
        coefficients=splats.coefficients[which],
    )
    return split


def million() -> None:
    """Time against the number of splats and of pixels."""
    guitar, pose = real_splats("guitar", DATA), real_views("guitar")[0]
    table = Table(
        "splats", "pixels", "image (s)", "with columns (s)", "listed pairs", title="a million, warm"
    )
    found = []
    for count, width in [(125_000, 512), (250_000, 512), (500_000, 512), (1_000_000, 512)] + [
        (1_000_000, width) for width in (128, 256, 1024)
    ]:
        field, camera = Gaussians(multiplied(guitar, count)), real_camera(width)
        image, columns = turns(both(field, camera), pose, 3)
        pairs = field._seen(camera, pose, None).pairs
        table.add_row(f"{count}", f"{width}²", f"{image:.2f}", f"{columns:.2f}", f"{pairs}")
        found.append((count, width**2, columns))
    console.print(table)
    by_count, by_pixels = found[:4], sorted([*found[4:], found[3]], key=lambda row: row[1])
    for what, rows, k in (("splats", by_count, 0), ("pixels", by_pixels, 1)):
        x, y = np.log([row[k] for row in rows]), np.log([row[2] for row in rows])
        console.print(f"time grows as the number of {what} to the power {np.polyfit(x, y, 1)[0]:.2f}")


def central(shown: Callable[[np.ndarray], np.ndarray], camera: Camera, depth: float) -> np.ndarray:
    """(6,) what differences of a picture have of F, of 0.02 pixels; `shown` takes a twist."""
    turn = camera.angles(0.02)
    found = []
    for twist in np.diag([*(turn[[1, 0]] * depth), 0.02 / max(camera.size) * depth, *turn]):
        found.append((shown(twist) - shown(-twist)) / (2.0 * twist.max()))
    return information(np.stack(found, axis=-1))


def information(J: np.ndarray) -> np.ndarray:
    """(6,) the diagonal of JᵀJ."""
    return np.sum(J**2, axis=(0, 1))


@contextmanager
def cut(least: float, sigmas: float) -> Iterator[None]:
    """Within, the kernel leaves out what rasterisers do; the library has no such option."""
    import drjit as dr

    laid, opaque = splat_blending._laid, splat_blending._OPAQUE

    def cutting(drawing: Any, place: Any, film: Any) -> Any:
        one = laid(drawing, place, film)
        shown = (one.alpha >= least) & (dr.dot(one.d, one.w) <= sigmas**2)
        kept = [dr.select(shown, value, 0.0) for value in (one.alpha, one.movable)]
        return one._replace(alpha=kept[0], movable=kept[1])

    splat_blending._laid, splat_blending._OPAQUE = cutting, 1e-4
    try:
        yield
    finally:
        splat_blending._laid, splat_blending._OPAQUE = laid, opaque


def cuts() -> None:
    """The picture without cuts beside that with them, and F of both."""
    camera = real_camera(256)
    pixels = pixels_of(camera)
    table = Table(
        *("view", "cut", "PSNR (dB)", "F cut / F uncut", "analytic / differences: uncut", "cut"),
        "re-sorting adds",
        title="cuts, 256²",
    )
    for name in REAL:
        field = Gaussians(real_splats(name, DATA))
        for number, pose in enumerate(real_views(name)):
            for what, how in (("opacity < 1/255", (1.0 / 255.0, np.inf)), ("beyond 3 σ", (0.0, 3.0))):
                table.add_row(f"{name} {number}", what, *cut_row(field, camera, pose, pixels, how))
    console.print(table)


def cut_row(
    field: Gaussians, camera: Camera, pose: np.ndarray, pixels: np.ndarray, how: tuple[float, float]
) -> list[str]:
    """Of one view and one cut, what `cuts` shows."""
    depth = float(np.nanmedian(field.show(camera, pose, pixels).depth))

    def shown(twist: np.ndarray, kept: np.ndarray | None = pose) -> np.ndarray:
        return field.show(camera, pose @ se3.exp(twist), pixels, kept=kept).values

    values, columns = field.columns(camera, pose, pixels)
    frozen, sorted_anew = (
        central(lambda twist, kept=kept: shown(twist, kept), camera, depth) for kept in (pose, None)
    )
    with cut(*how):
        cut_values, cut_columns = field.columns(camera, pose, pixels)
        jumping = central(shown, camera, depth)
    error = np.mean((np.clip(values, 0.0, 1.0) - np.clip(cut_values, 0.0, 1.0)) ** 2)
    return [
        f"{-10.0 * np.log10(error):.1f}",
        between(information(cut_columns) / information(columns)),
        between(information(columns) / frozen),
        between(information(cut_columns) / jumping),
        between(sorted_anew / frozen - 1.0),
    ]


def rotation() -> None:
    """Rotation columns beside the filter term of the same picture, which holds for what turns rigidly."""
    table = Table(
        "std on the film (pixel)", "F / filter term's", "worst column's difference", title="rotation"
    )
    camera, pose = Camera.pinhole(240.0, (128.0, 128.0), (256, 256)), np.eye(4)
    pixels = pixels_of(camera)
    for std in (1.0, 2.0, 5.0, 13.0, 38.0):
        field = Gaussians(sized_splats(camera, pose, std))
        columns = field.columns(camera, pose, pixels)[1][..., 3:]
        expected = turned_by_flow(field, camera, pose, pixels)
        size = np.linalg.norm(expected, axis=(0, 1))
        table.add_row(
            f"{std:.0f}",
            between((np.linalg.norm(columns, axis=(0, 1)) / size) ** 2),
            f"{100 * (np.linalg.norm(columns - expected, axis=(0, 1)) / size).max():.2f} %",
        )
    console.print(table)


def maps() -> None:
    """What not knowing a map exactly costs a pose's standard deviations, at σ = 0.02 in a 96² image."""
    table = Table(
        *(
            "splat",
            "unknown",
            "known from",
            "std / std with the map known",
            "least eigenvalue by the diagonal",
        ),
        *("rounds", "(s)"),
        title="maps",
    )
    camera, weight = real_camera(96), 1.0 / 0.02**2
    pixels = pixels_of(camera)
    for name, file in (("playbot, 3000", "playbot_lod/playbot_lod5_3000.ply"), ("hall, 9080", REAL["hall"])):
        field, views = load_gaussians(DATA / file), real_views(name.partition(",")[0])
        for unknowns in UNKNOWNS:
            seen = sum(
                map_information(field, camera, pose, pixels, weight, unknowns=unknowns) for pose in views
            )
            for source, prior in (("0.05 each", 1.0 / 0.05**2), ("three views", seen + 1.0)):
                start = time.perf_counter()
                cost = map_cost(field, camera, views[0], pixels, weight, unknowns=unknowns, prior=prior)
                seconds = time.perf_counter() - start
                std = [np.sqrt(np.diag(np.linalg.inv(F))) for F in (cost.information, cost.known)]
                size = np.sqrt(np.diag(cost.known))
                left = (cost.known - cost.lost_by_diagonal) / np.outer(size, size)
                table.add_row(
                    *(name, unknowns, source, between(std[0] / std[1])),
                    *(f"{np.linalg.eigvalsh(left)[0]:.3f}", f"{cost.rounds}", f"{seconds:.1f}"),
                )
    console.print(table)


def between(values: np.ndarray) -> str:
    """The least and the largest of six."""
    return f"{values.min():.3f} to {values.max():.3f}"


SECTIONS = {"cost": cost, "million": million, "cuts": cuts, "rotation": rotation, "maps": maps}


def main() -> None:
    """Run what was asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", choices=SECTIONS, action="append")
    if not DATA.is_dir():
        raise SystemExit(f"needs {DATA}")
    for name in parser.parse_args().only or SECTIONS:
        SECTIONS[name]()


if __name__ == "__main__":
    main()
