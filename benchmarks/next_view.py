"""Which views to take next in `textured_room`: the certified choice, exhaustive search, and simpler rules.

    python benchmarks/next_view.py                    # minutes on 2 idle cores, most of them the field
    python benchmarks/next_view.py --store ROOM.zarr  # keeps the field, or takes one that is there

The unknown is the common pose of one body that carries all the chosen views. Every rule picks up to eight of
the field's views, one after the other; what they are worth is measured by the field's informations:

- greedy: `next_views` by log det, as the command does it;
- exhaustive: all sets of some twenty views, against greedy with its certificate on the same ones;
- random: the mean over draws;
- farthest point: the view whose camera is farthest from those taken, a turn by 90 degrees as far as a metre;
- coverage: the view that sees most of what no other has seen, in cells of a quarter of a metre;
- landmarks: greedy by log det of what a map's points tell, known and seen with an error of one pixel, as a
  Fisher Information Field has it (Zhang and Scaramuzza, 2020): corners that `feature_tracks` finds in a few
  views, visible where no surface hides them.

Writes benchmarks/figures/next_view.png.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
import time
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from mitsuba_crb import load_scene, se3
from mitsuba_crb.agents.bundle import FEWEST_POINTS, PointView, point_information
from mitsuba_crb.camera import Camera
from mitsuba_crb.errors import PointsError
from mitsuba_crb.estimate.tracks import feature_tracks
from mitsuba_crb.planning.candidates import parse_candidates
from mitsuba_crb.planning.field_run import measure_field
from mitsuba_crb.planning.next_view import body_bound, next_views
from mitsuba_crb.planning.one_body import body_at, seen_blocks
from mitsuba_crb.planning.surface_hits import hits
from mitsuba_crb.planning.view_field import ViewField, open_field

ROOT = Path(__file__).parents[1]
SCENE = ROOT / "scenes" / "textured_room" / "textured_room.xml"
GRID = "grid:x=-2.1:2.1,y=-1:3.6,nx=5,ny=5,headings=6"
SIZE = (40, 30)
SPP = 32
MOST = 8
EXHAUSTIVE = (20, 4)
DRAWS = 50
CELL = 0.25
HALF = np.tan(np.radians(64.0) / 2) * np.array([1.0, SIZE[1] / SIZE[0]])
"""Where the film ends, at a depth of one."""


def field_in(store: Path) -> ViewField:
    """The field, measured if it is not there."""
    start = time.perf_counter()
    if store.exists():
        field = open_field(store)
    else:
        candidates = parse_candidates(GRID, SCENE, size=SIZE)
        field = measure_field(SCENE, candidates, store, size=SIZE, spp=SPP)
    print(f"field: {len(field)} views, {int(field.usable.sum())} usable, {time.perf_counter() - start:.0f} s")
    return field


def value_of(field: ViewField, views: np.ndarray, blocks: np.ndarray) -> np.ndarray:
    """(m,), log det of 1 + Σ of the blocks of some sets of views (m, k)."""
    return np.linalg.slogdet(np.eye(6) + blocks[views].sum(axis=1)).logabsdet


def scaled_blocks(field: ViewField) -> np.ndarray:
    """(n, 6, 6), what `next_views` adds up: about the usable views' centroid, in length scales."""
    known = field.usable & (field.rank > 0)
    body = body_at(field.poses[known, :3, 3].mean(axis=0))
    scale = np.array([float(np.median(field.dataset["length_scale"].values[known]))] * 3 + [1.0] * 3)
    blocks = np.zeros((len(field), 6, 6))
    blocks[known] = scale[:, None] * seen_blocks(field, np.flatnonzero(known), body) * scale
    return blocks


def greedily(blocks: np.ndarray, candidates: np.ndarray) -> list[int]:
    """The first views of plain greedy by log det."""
    chosen: list[int] = []
    for _ in range(MOST):
        left = np.setdiff1d(candidates, chosen)
        sums = np.eye(6) + blocks[chosen].sum(axis=0) + blocks[left]
        chosen.append(int(left[np.argmax(np.linalg.slogdet(sums).logabsdet)]))
    return chosen


def farthest_points(field: ViewField, candidates: np.ndarray) -> list[int]:
    """The view nearest to the middle, then always the one that is farthest from those taken."""
    centres, forward = field.poses[candidates, :3, 3], field.poses[candidates, :3, 2]
    first = int(np.argmin(np.linalg.norm(centres - centres.mean(axis=0), axis=1)))
    chosen, nearest = [first], np.full(len(candidates), np.inf)
    for _ in range(MOST - 1):
        turn = np.arccos(np.clip(forward @ forward[chosen[-1]], -1.0, 1.0)) / (np.pi / 2)
        apart = np.hypot(np.linalg.norm(centres - centres[chosen[-1]], axis=1), turn)
        nearest = np.minimum(nearest, apart)
        chosen.append(int(np.argmax(nearest)))
    return [int(candidates[place]) for place in chosen]


def pixel_directions(across: int) -> np.ndarray:
    """(p, 3), through the film, in the camera's frame."""
    edge = (np.arange(across) + 0.5) / across * 2 - 1
    x, y = np.meshgrid(HALF[0] * edge, HALF[1] * edge)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def coverage(field: ViewField, scene: object, candidates: np.ndarray) -> list[int]:
    """Always the view that sees most cells that none has seen."""
    rays = pixel_directions(16)
    seen: list[set[bytes]] = []
    for pose in field.poses[candidates]:
        directions = rays @ pose[:3, :3].T
        found = hits(scene, np.broadcast_to(pose[:3, 3], directions.shape), directions)
        points = pose[:3, 3] + found.distance[found.met, None] * directions[found.met]
        seen.append({cell.tobytes() for cell in np.floor(points / CELL).astype(np.int32)})
    covered: set[bytes] = set()
    chosen: list[int] = []
    for _ in range(MOST):
        gains = [-1 if k in chosen else len(cells - covered) for k, cells in enumerate(seen)]
        chosen.append(int(np.argmax(gains)))
        covered |= seen[chosen[-1]]
    return [int(candidates[place]) for place in chosen]


def landmarks(field: ViewField, candidates: np.ndarray) -> np.ndarray:
    """(m, 3), corners of some views far from each other, lifted to the surfaces that they lie on."""
    points = []
    for view in farthest_points(field, candidates):
        try:
            found = feature_tracks(SCENE, pose=field.poses[view], size=(144, 108), spp=SPP)
            points.append(found.points)
        except PointsError:
            continue
    return np.concatenate(points)


def landmark_blocks(field: ViewField, scene: object, points: np.ndarray) -> np.ndarray:
    """(n, 6, 6), what each view knows of the body from the points that it sees."""
    camera = Camera.pinhole(SIZE[0] / 2 / HALF[0], np.array(SIZE) / 2, SIZE)
    known = field.usable & (field.rank > 0)
    body = body_at(field.poses[known, :3, 3].mean(axis=0))
    length = float(np.median(field.dataset["length_scale"].values[known]))
    blocks = np.zeros((len(field), 6, 6))
    for view in np.flatnonzero(known):
        pose = field.poses[view]
        p = (points - pose[:3, 3]) @ pose[:3, :3]
        film = np.abs(p[:, :2]) < HALF * p[:, 2:]
        inside = np.flatnonzero(film.all(axis=1) & (p[:, 2] > 0.05))
        if not len(inside):
            continue
        away = points[inside] - pose[:3, 3]
        distance = np.linalg.norm(away, axis=1)
        met = hits(scene, np.broadcast_to(pose[:3, 3], away.shape), away / distance[:, None]).distance
        seen = inside[met > 0.99 * distance]
        if len(seen) < FEWEST_POINTS:
            continue
        F = point_information(points, PointView("camera", pose, camera, 1.0, seen)).matrix
        A = se3.adjoint(se3.inverse(pose) @ body) * ([length] * 3 + [1.0] * 3)
        blocks[view] = A.T @ F @ A
    return blocks


def beside_exhaustive(field: ViewField, candidates: np.ndarray, blocks: np.ndarray) -> None:
    """Greedy and its certificate on a few views of which all sets can be tried."""
    some, most = EXHAUSTIVE
    few = np.sort(np.random.default_rng(0).permutation(candidates)[:some])
    status = np.where(np.isin(np.arange(len(field)), few), field.status, 0)
    small = ViewField(field.dataset.assign(status=("view", status)))
    own = scaled_blocks(small)
    print(f"\n{some} views, all sets of k: share of the best gain in log det")
    print(f"  {'k':>2}{'sets':>8}{'greedy':>9}{'certified':>11}{'median set':>12}{'worst set':>11}")
    for k in range(1, most + 1):
        sets = np.array(list(itertools.combinations(few, k)))
        values = value_of(small, sets, own)
        found = next_views(small, budget=k)
        share = np.array([found.value, np.median(values), values.min()]) / values.max()
        others = f"{share[1]:>12.3f}{share[2]:>11.3f}"
        print(f"  {k:>2}{len(sets):>8}{share[0]:>9.4f}{found.certificate:>11.4f}{others}")
        assert found.value <= values.max() * (1 + 1e-9) <= found.upper_bound * (1 + 1e-9)


def main() -> None:
    """Measure, choose by every rule, print and draw."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--store", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        field = field_in(arguments.store or Path(folder) / "room.zarr")
        compare(ViewField(field.dataset.load()))


def compare(field: ViewField) -> None:
    """All rules on one field."""
    scene = load_scene(SCENE)
    candidates = np.flatnonzero(field.usable & (field.rank > 0))
    blocks = scaled_blocks(field)
    beside_exhaustive(field, candidates, blocks)
    points = landmarks(field, candidates)
    by_points = landmark_blocks(field, scene, points)
    rng = np.random.default_rng(1)
    nested = {
        "landmarks": greedily(by_points, candidates),
        "coverage": coverage(field, scene, candidates),
        "farthest point": farthest_points(field, candidates),
    }
    draws = [rng.permutation(candidates)[:MOST].tolist() for _ in range(DRAWS)]
    counts = range(1, MOST + 1)
    certified = [next_views(field, budget=k) for k in counts]
    sets = {"greedy": [list(found.chosen) for found in certified]}
    sets |= {name: [views[:k] for k in counts] for name, views in nested.items()}
    values = {
        name: [float(value_of(field, np.array([views]), blocks)[0]) for views in rows]
        for name, rows in sets.items()
    }
    positions = {
        name: [np.linalg.norm(body_bound(field, views).position_std) for views in rows]
        for name, rows in sets.items()
    }
    random_values = np.array(
        [[value_of(field, np.array([views[:k]]), blocks)[0] for k in counts] for views in draws]
    )
    random_positions = np.array(
        [[np.linalg.norm(body_bound(field, views[:k]).position_std) for k in counts] for views in draws]
    )
    values["random"] = random_values.mean(axis=0).tolist()
    positions["random"] = np.median(random_positions, axis=0).tolist()
    print(f"\n{len(candidates)} views, {len(points)} landmarks; log det (random: mean of {DRAWS} draws)")
    print(f"  {'k':>2}{'bound':>9}" + "".join(f"{name:>16}" for name in values) + f"{'certificate':>13}")
    for k, found in zip(counts, certified, strict=True):
        row = "".join(f"{rows[k - 1]:>16.2f}" for rows in values.values())
        print(f"  {k:>2}{found.upper_bound:>9.2f}{row}{found.certificate:>13.4f}")
    print("\nposition bound at the cameras' centroid [mm] (random: median)")
    for k in counts:
        print(f"  {k:>2}         " + "".join(f"{1e3 * rows[k - 1]:>16.2f}" for rows in positions.values()))
    draw(counts, positions, random_positions, values, certified)


def draw(counts, positions, random_positions, values, certified) -> None:
    """Bounds after k views, and the gain left out of what is possible."""
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    colours = dict(zip(positions, ("#d6006e", "#1b7837", "#2166ac", "#e08214", "#7f7f7f"), strict=True))
    low, high = np.percentile(random_positions, (10, 90), axis=0, method="nearest")
    axes[0].fill_between(counts, 1e3 * low, 1e3 * high, color="#7f7f7f", alpha=0.2, lw=0)
    for name, rows in positions.items():
        axes[0].plot(counts, 1e3 * np.array(rows), "o-", ms=4, color=colours[name], label=name)
        share = [value / found.upper_bound for found, value in zip(certified, values[name], strict=True)]
        axes[1].plot(counts, share, "o-", ms=4, color=colours[name])
    axes[0].set(yscale="log", xlabel="views", ylabel="1σ bound of position [mm]")
    axes[0].set_title("Position of the body, at its cameras' centroid", loc="left", fontsize=11)
    axes[1].set(xlabel="views", ylabel="gain in log det over its upper bound", ylim=(None, 1.01))
    axes[1].set_title("Share of what any choice could gain, at least", loc="left", fontsize=11)
    axes[0].legend(frameon=False, title="grey band: 80 % of random choices", title_fontsize=8)
    for ax in axes:
        ax.spines[["top", "right"]].set_visible(False)
        ax.grid(alpha=0.25)
    path = Path(__file__).parent / "figures" / "next_view.png"
    figure.savefig(path, dpi=110)
    print(f"\n{path}")


if __name__ == "__main__":
    main()
