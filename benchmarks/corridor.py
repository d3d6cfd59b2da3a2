"""Two corridors from A to B, the shorter one of plain walls: which way does a camera not get lost?

    python benchmarks/corridor.py               # about ten minutes on 2 idle cores, most of it the field
    python benchmarks/corridor.py --images 0    # without the localisers that align rendered images

A ring of corridors around a block. The southern leg, straight from A to B, has walls and floor of even
radiance; the other three, longer by two thirds, have texture. All surfaces are lights, so that nothing but
the film's filter is random. The field of views is measured on a grid of a metre with four directions; the
path is planned with odometry, with the limit on the position bound and without.

Then localisers go both ways many times. Truth follows the planned views; odometry has errors in small steps;
at each place the camera's image corrects the prediction:

- drawn: the image's pose estimate is drawn from its bound, on what it sees;
- images: the image is rendered with noise at the true pose, and aligned from the predicted one (`align`).

The filter is that of the plan; its errors' root mean square is compared with the plan's bound and the limit.
Writes benchmarks/figures/corridor.png.
"""

from __future__ import annotations

import argparse
import tempfile
import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from mitsuba_crb import se3
from mitsuba_crb.estimate.align import align
from mitsuba_crb.noise import Gaussian
from mitsuba_crb.planning.candidates import candidates_of, looking
from mitsuba_crb.planning.field_run import measure_field
from mitsuba_crb.planning.odometry import Odometry
from mitsuba_crb.planning.one_body import seen_roots
from mitsuba_crb.planning.path_search import PathPlan, plan_path
from mitsuba_crb.planning.view_field import ViewField, open_field
from mitsuba_crb.render.backend import use_mitsuba

use_mitsuba()

import mitsuba as mi  # noqa: E402  the variant comes first

LENGTH, WIDTH = 12.0, 4.0  # of the ring through the corridors' middles
HALF, TALL, EYE = 0.9, 2.5, 1.2
SIZE, SPP = (32, 32), 32
NOISE = Gaussian(0.05)
ODOMETRY = Odometry(0.02, 0.2)
LIMIT = 0.045
RUNS = 200
SUBSTEPS = 10


def light(radiance: Any) -> dict[str, Any]:
    """An even one, or a texture (rows, columns, 3)."""
    if np.ndim(radiance):
        bitmap = mi.Bitmap(np.asarray(radiance, dtype=np.float32))
        return {"type": "area", "radiance": {"type": "bitmap", "bitmap": bitmap, "raw": True}}
    return {"type": "area", "radiance": {"type": "rgb", "value": float(radiance)}}


def rectangle(centre: Any, normal: Any, up: Any, size: tuple[float, float], radiance: Any) -> dict[str, Any]:
    """One that shines to where its normal points."""
    target = np.add(centre, normal).tolist()
    place = mi.ScalarTransform4f().look_at(list(centre), target, list(up))
    return {
        "type": "rectangle",
        "to_world": place.scale([size[0] / 2, size[1] / 2, 1.0]),
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}},
        "emitter": light(radiance),
    }


def corridors(seed: int = 0) -> dict[str, Any]:
    """The scene: x to the east, y to the north, z up; A at the origin, B at (12, 0)."""
    rng = np.random.default_rng(seed)

    def texture(width: float, height: float) -> np.ndarray:
        return rng.uniform(0.2, 0.9, (max(2, round(8 * height)), max(2, round(8 * width)), 3))

    low, high, east = -HALF, WIDTH + HALF, LENGTH + HALF
    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "camera": {
            "type": "perspective",
            "id": "camera",
            "fov": 75,
            "to_world": mi.ScalarTransform4f().look_at([0, 0, EYE], [0, 1, EYE], [0, 0, 1]),
            "film": {"type": "hdrfilm", "width": SIZE[0], "height": SIZE[1], "pixel_format": "rgb"},
        },
    }

    def wall(name: str, a: tuple[float, float], b: tuple[float, float], radiance: float | None) -> None:
        """From a to b, seen from its left."""
        way = np.subtract(b, a)
        length = float(np.linalg.norm(way))
        normal = [-way[1] / length, way[0] / length, 0.0]
        colour = texture(length, TALL) if radiance is None else radiance
        centre = [*(0.5 * np.add(a, b)).tolist(), TALL / 2]
        scene[name] = rectangle(centre, normal, (0, 0, 1), (length, TALL), colour)

    def floor(name: str, x: tuple[float, float], y: tuple[float, float], radiance: float | None) -> None:
        size = (x[1] - x[0], y[1] - y[0])
        colour = texture(*size) if radiance is None else radiance
        for part, z, up in (("floor", 0.0, 1.0), ("ceiling", TALL, -1.0)):
            value = colour if part == "floor" or radiance is None else 0.9 * radiance
            centre = [sum(x) / 2, sum(y) / 2, z]
            scene[f"{part}_{name}"] = rectangle(centre, (0, 0, up), (0, 1, 0), size, value)

    # Plain: the southern leg from wall to wall.
    wall("south", (low, low), (east, low), 0.5)
    wall("block_south", (LENGTH - HALF, HALF), (HALF, HALF), 0.5)
    wall("west_end", (low, HALF), (low, low), 0.5)
    wall("east_end", (east, low), (east, HALF), 0.5)
    floor("south", (low, east), (low, HALF), 0.3)
    # Textured: the other three.
    wall("west", (low, high), (low, HALF), None)
    wall("east", (east, HALF), (east, high), None)
    wall("north", (east, high), (low, high), None)
    wall("block_west", (HALF, HALF), (HALF, WIDTH - HALF), None)
    wall("block_north", (HALF, WIDTH - HALF), (LENGTH - HALF, WIDTH - HALF), None)
    wall("block_east", (LENGTH - HALF, WIDTH - HALF), (LENGTH - HALF, HALF), None)
    floor("north", (low, east), (WIDTH - HALF, high), None)
    floor("west", (low, HALF), (HALF, WIDTH - HALF), None)
    floor("east", (LENGTH - HALF, east), (HALF, WIDTH - HALF), None)
    return scene


def poses() -> np.ndarray:
    """(n, 4, 4): along the middles, a metre apart, four directions each; A and B are the first two places."""
    ring = [(0.0, 0.0), (LENGTH, 0.0)]
    ring += [(float(x), y) for y in (0.0, WIDTH) for x in range(int(LENGTH) + 1)]
    ring += [(x, float(y)) for x in (0.0, LENGTH) for y in range(1, int(WIDTH))]
    found = []
    for x, y in dict.fromkeys(ring):
        for angle in np.pi / 2 * np.arange(4):
            pose = np.eye(4)
            pose[:3, :3] = looking(np.array([np.cos(angle), np.sin(angle), 0.0]), np.array([0.0, 0.0, 1.0]))
            pose[:3, 3] = x, y, EYE
            found.append(pose)
    return np.array(found)


@dataclass(frozen=True)
class Errors:
    """Of the position, by run and place [scene unit]."""

    before: np.ndarray
    after: np.ndarray


def localised(
    field: ViewField, plan: PathPlan, rng: np.random.Generator, runs: int, scene: Any = None
) -> Errors:
    """Errors of a localiser that goes along a plan; with a scene by images, else by drawn estimates."""
    views = np.array(plan.views)
    truth = field.poses[views]
    informations = [information(field, view) for view in views]
    errors = Errors(np.full((runs, len(views)), np.nan), np.full((runs, len(views)), np.nan))
    for run in range(runs):
        covariance = np.linalg.inv(informations[0])
        estimate = truth[0] @ se3.exp(np.linalg.cholesky(covariance) @ rng.normal(size=6))
        errors.after[run, 0] = np.linalg.norm(estimate[:3, 3] - truth[0, :3, 3])
        for k in range(1, len(views)):
            motion = se3.inverse(truth[k - 1]) @ truth[k]
            estimate = estimate @ measured_motion(motion, rng)
            covariance = predicted(covariance, truth[k - 1], truth[k])
            errors.before[run, k] = np.linalg.norm(estimate[:3, 3] - truth[k, :3, 3])
            F = informations[k]
            seen = (
                pose_estimate(F, truth[k], rng) if scene is None else aligned(scene, truth[k], estimate, rng)
            )
            covariance = np.linalg.inv(np.linalg.inv(covariance) + F)
            if seen is not None:
                estimate = estimate @ se3.exp(covariance @ F @ se3.log(se3.inverse(estimate) @ seen))
            errors.after[run, k] = np.linalg.norm(estimate[:3, 3] - truth[k, :3, 3])
    return errors


def information(field: ViewField, view: int) -> np.ndarray:
    """(6, 6), what a view sees of its own pose, camera frame."""
    (root,) = seen_roots(field, np.array([view]), field.poses[view])
    return root @ root.T


def measured_motion(motion: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A motion as odometry measures it: straight in small steps with an error each, then a turn."""
    length = float(np.linalg.norm(motion[:3, 3]))
    step = np.eye(4)
    step[:3, 3] = motion[:3, 3] / SUBSTEPS
    sigma = np.array([ODOMETRY.translation] * 3 + [np.radians(ODOMETRY.rotation_deg)] * 3)
    sigma *= np.sqrt(length / SUBSTEPS)
    found = np.eye(4)
    for error in rng.normal(size=(SUBSTEPS, 6)):
        found = found @ step @ se3.exp(sigma * error)
    turn = motion.copy()
    turn[:3, 3] = 0.0
    return found @ turn


def predicted(covariance: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Σ in the camera's frame after a motion."""
    there = se3.adjoint(se3.inverse(end) @ start)
    world = se3.adjoint(se3.inverse(end))
    moved = there @ covariance @ there.T
    return moved + world @ ODOMETRY.moved(start[:3, 3], end[:3, 3]) @ world.T


def pose_estimate(F: np.ndarray, truth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A pose with errors of covariance F⁺ in what is seen, none in the rest, which F does not weigh."""
    values, vectors = np.linalg.eigh(F)
    seen = values > 1e-9 * values[-1]
    return truth @ se3.exp(vectors[:, seen] @ (rng.normal(size=seen.sum()) / np.sqrt(values[seen])))


def aligned(scene: Any, truth: np.ndarray, start: np.ndarray, rng: np.random.Generator) -> np.ndarray | None:
    """The pose that a noisy image at the truth is aligned to from a start; None if the search fails."""
    seed = int(rng.integers(1 << 30))
    scene = mi.load_dict(scene) if isinstance(scene, dict) else scene
    params = mi.traverse(scene)
    params["camera.to_world"] = mi.Transform4f(truth.tolist())
    params.update()
    image = np.array(mi.render(scene, spp=256, seed=seed))
    image += NOISE.sigma * rng.normal(size=image.shape)
    found = align(scene, image, NOISE, pose=start, spp=SPP, seed=seed + 1, iterations=12)
    return found.pose if found.status == "converged" else None


def main() -> None:
    """Measure, plan, go both ways, print and draw."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--store", type=Path, help="keeps the field, or takes one that is there")
    parser.add_argument("--images", type=int, default=2, help="localisers by images, each way")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")  # of imprecision, in every other view of plain walls
    with tempfile.TemporaryDirectory() as folder:
        store = arguments.store or Path(folder) / "corridor.zarr"
        start = time.perf_counter()
        field = (
            open_field(store)
            if store.exists()
            else measure_field(
                corridors(), candidates_of(poses(), up=(0, 0, 1)), store, noise=NOISE, size=SIZE, spp=SPP
            )
        )
        print(f"field: {len(field)} views in {time.perf_counter() - start:.0f} s")
        compare(ViewField(field.dataset.load()), arguments.images)


def compare(field: ViewField, images: int) -> None:
    """Both ways, and who goes them."""
    plans = {
        "shortest": plan_path(field, 0, 1, limit=np.inf, odometry=ODOMETRY),
        "limited": plan_path(field, 0, 1, limit=LIMIT, odometry=ODOMETRY),
        "by themselves": plan_path(field, 0, 1, limit=LIMIT),
    }
    for name, plan in plans.items():
        heuristic = f", {plan.dropped} labels left out" if plan.dropped else ""
        print(f"{name}: {plan.length:.3g} m, largest bound {plan.smallest_limit:.3g} m{heuristic}")
    least = plan_path(field, 0, 1, limit=1e-9, odometry=ODOMETRY)
    print(f"smallest limit that has a path: {least.smallest_limit:.3g} m")
    ways = {name: plans[name] for name in ("shortest", "limited")}
    drawn = {name: localised(field, plan, np.random.default_rng(1), RUNS) for name, plan in ways.items()}
    scene = mi.load_dict(corridors())
    rendered = {
        name: localised(field, plan, np.random.default_rng(2), images, scene)
        for name, plan in ways.items()
        if images
    }
    print(
        f"\nlargest root mean square of the position's error on the way [m], limit {LIMIT}; by images, of few"
    )
    print("runs, that of error over bound after each image")
    print(f"  {'':<10}{'largest bound':>14}{'drawn':>10}{'images':>10}")
    for name, plan in ways.items():
        squares = np.concatenate([drawn[name].before[:, 1:], drawn[name].after], axis=1) ** 2
        worst = float(np.sqrt(squares.mean(axis=0)).max())
        by_images = ""
        if images:
            found = rendered[name].after / plan.after
            by_images = f"{np.sqrt((found**2).mean()):.2f}"
        print(f"  {name:<10}{plan.smallest_limit:>14.3f}{worst:>10.3f}{by_images:>10}")
    draw(field, ways, drawn, rendered)


def draw(field: ViewField, ways: Any, drawn: Any, rendered: Any) -> None:
    """The floor plan with both ways, and errors along them."""
    figure, axes = plt.subplots(1, 2, figsize=(13, 4.4), layout="constrained", width_ratios=(1.25, 1))
    colours = {"shortest": "#b2182b", "limited": "#2166ac"}
    ax = axes[0]
    outer = plt.Rectangle((-HALF, -HALF), LENGTH + 2 * HALF, WIDTH + 2 * HALF, fc="white", ec="black", lw=1.5)
    block = (LENGTH - 2 * HALF, WIDTH - 2 * HALF)
    ax.add_patch(outer)
    ax.add_patch(plt.Rectangle((HALF, HALF), *block, fc="#8f8f8f", ec="black", lw=1.5))
    places = [np.flatnonzero(field.place == place) for place in np.unique(field.place)]
    best = np.array([field.position_bound[views].min() for views in places])
    centres = np.array([field.poses[views[0], :2, 3] for views in places])
    seen = np.isfinite(best)
    dots = ax.scatter(*centres[seen].T, c=1e3 * best[seen], s=90, cmap="cividis_r", norm="log", zorder=2)
    ax.scatter(
        *centres[~seen].T, s=90, fc="white", ec="#b2182b", hatch="////", zorder=2, label="no view sees all"
    )
    figure.colorbar(dots, ax=ax, label="one view's position bound [mm]", shrink=0.8)
    for name, plan in ways.items():
        label = f"{name}: {plan.length:.3g} m, bound up to {plan.smallest_limit:.2g} m"
        ax.plot(*plan.poses[:, :2, 3].T, color=colours[name], lw=2.5, label=label, zorder=3)
    for point, name in (((0, 0), "A"), ((LENGTH, 0), "B")):
        ax.annotate(name, point, (point[0], point[1] - 0.62), ha="center", weight="bold")
    ax.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    ax.set_title("Plain walls below, texture elsewhere", loc="left", fontsize=11)
    ax.legend(frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=1, fontsize=9)
    ax = axes[1]
    ax.axhline(LIMIT, color="black", lw=1, ls="--", label="limit")
    for name, plan in ways.items():
        steps = np.linalg.norm(np.diff(plan.poses[:, :3, 3], axis=0), axis=1)
        gone = np.repeat(np.concatenate([[0.0], np.cumsum(steps)]), 2)[1:]
        ax.plot(gone, between(plan.before, plan.after), color=colours[name], lw=2, label=f"{name}: bound")
        rms = [np.sqrt((part**2).mean(axis=0)) for part in (drawn[name].before, drawn[name].after)]
        ax.plot(gone, between(*rms), ".", color=colours[name], label=f"{RUNS} drawn localisers, rms")
        if rendered:
            found = rendered[name]
            for before, after in zip(found.before, found.after, strict=True):
                ax.plot(gone, between(before, after), color=colours[name], lw=0.7, alpha=0.6)
            ax.plot([], [], color=colours[name], lw=0.7, label=f"{len(found.after)} by images, errors")
    ax.set(xlabel="gone [m]", ylabel="position [m]", yscale="log")
    ax.set_title("On arrival and after each image", loc="left", fontsize=11)
    ax.legend(frameon=False, fontsize=8, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.16))
    for ax in axes:
        ax.spines[["top", "right"]].set_visible(False)
    path = Path(__file__).parent / "figures" / "corridor.png"
    figure.savefig(path, dpi=110)
    print(f"\n{path}")


def between(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """One after the other, place by place, from the first image on."""
    return np.stack([before, after], axis=1).ravel()[1:]


if __name__ == "__main__":
    main()
