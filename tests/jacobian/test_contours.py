"""The parallax term: which curves are contours, how long they are, and what they do to the image.

Main oracle: for L = 1 the image does not change, so filter and parallax term add up to zero in every pixel,
whatever the geometry. A missing contour, one listed twice, a wrong side or a wrong visibility breaks it.
Second oracle: finite differences of a scene whose information is in its silhouettes.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np
import pytest
from one_go import measured
from scipy.integrate import quad
from scipy.special import ellipe
from small_scenes import T

from mitsuba_crb.camera import Camera
from mitsuba_crb.jacobian import finite_difference, flow, surfaces
from mitsuba_crb.jacobian.closure import FilmBlocks
from mitsuba_crb.jacobian.contours import ParallaxTerm, find_contours
from mitsuba_crb.jacobian.curves import CIRCLE, RIM, TANGENT, Curves, cut, place
from mitsuba_crb.jacobian.edges import EdgeTable, _grouped
from mitsuba_crb.jacobian.method import Paths
from mitsuba_crb.jacobian.silhouettes import Contours
from mitsuba_crb.jacobian.surfaces import edge_table
from mitsuba_crb.jacobian.unfollowed import Unfollowed
from mitsuba_crb.render.paths import tracer
from mitsuba_crb.render.pixels import render_pixels
from mitsuba_crb.render.rays import first_hits
from mitsuba_crb.render.view import View, open_view

WIDTH, HEIGHT, BATCHES = 40, 28, 8
TILT = T().rotate([0, 0, 1], 30).rotate([1, 0, 0], 20)
THIN = {"type": "thinlens", "aperture_radius": 0.15, "focus_distance": 2.5}
SIDES = [([1, 0, 0], angle) for angle in (0, 90, 180, 270)] + [([0, 1, 0], angle) for angle in (90, 270)]


# Edge table


def cube() -> tuple[np.ndarray, np.ndarray]:
    """Eight shared vertices and twelve faces, consistently wound."""
    vertices = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float32)
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    return vertices, np.array([[q[i] for i in t] for q in quads for t in ((0, 1, 2), (0, 2, 3))])


def silhouette(vertices: np.ndarray, faces: np.ndarray, centre: Any) -> tuple[EdgeTable, set[Any], float]:
    """Contour edges from a point, as pairs of end points, and their total length."""
    table = EdgeTable.of(vertices, np.asarray(faces))
    edges = table.candidates(np.array(centre, dtype=float), np.array([0.0, 0.0, 1.0]), 0.0)
    ends = table.ends[edges]
    found = {frozenset(map(tuple, pair)) for pair in ends.tolist()}
    return table, found, float(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).sum())


def test_cubes_outline_is_six_edges_from_a_corner_and_four_from_a_face() -> None:
    vertices, faces = cube()
    for centre, count in ((5, 4, 3), 6), ((0.2, 0.1, 9), 4):
        table, edges, length = silhouette(vertices, faces, centre)
        assert (len(edges), length) == (count, 2.0 * count)
        assert len(table.ends) == 18  # 12 edges and 6 diagonals


def test_split_vertices_and_inconsistent_winding_give_the_same_contours() -> None:
    vertices, faces = cube()
    expected = silhouette(vertices, faces, (5, 4, 3))[1]
    split = vertices[faces].reshape(-1, 3)
    assert silhouette(split, np.arange(36).reshape(-1, 3), (5, 4, 3))[1] == expected
    split[::2][split[::2] == 0.0] = -0.0  # −0 and 0 are one position
    flipped = faces.copy()
    flipped[::3] = flipped[::3, ::-1]
    assert silhouette(vertices, flipped, (5, 4, 3))[1] == expected


def test_open_mesh_has_its_border_as_contour() -> None:
    vertices, faces = cube()
    _, edges, _ = silhouette(vertices, faces[:2], (5, 4, 3))
    assert len(edges) == 4


def test_an_edge_of_three_faces_is_a_contour_only_if_all_lie_on_one_side() -> None:
    edge = [[0, 0, -1], [0, 0, 1]]
    for others, count in (([1, 0, 0], [2, 1, 0], [3, -1, 0]), 1), (([1, 0, 0], [2, 1, 0], [-1, 0, 0]), 0):
        vertices = np.array([*edge, *others], dtype=np.float32)
        _, edges, _ = silhouette(vertices, np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]]), (0, -5, 0.1))
        assert (frozenset(map(tuple, edge)) in edges) == bool(count)


def test_faces_without_area_and_not_finite_are_dropped_and_counted() -> None:
    vertices, faces = cube()
    extra = np.array([[0, 0, 0], [np.nan, 0, 0], [np.inf, 1, 0], [2, 2, 2]], dtype=np.float32)
    bad = np.array([[0, 1, 9], [0, 1, 10], [0, 0, 1], [8, 7, 11]])  # the last one is a line
    table, edges, _ = silhouette(np.concatenate([vertices, extra]), np.concatenate([faces, bad]), (5, 4, 3))
    assert table.dropped == 4
    assert edges == silhouette(vertices, faces, (5, 4, 3))[1]


@pytest.mark.parametrize("most", [50, 1 << 62])
def test_keys_are_grouped_in_the_order_in_which_they_come(most: int) -> None:
    """Of meshes so large that key and place have more than 63 bits, too."""
    key = np.random.default_rng(0).integers(0, 50, 400)
    order, begins = _grouped(key, most)
    np.testing.assert_array_equal(order, np.argsort(key, kind="stable"))
    groups = np.split(key[order], begins[1:-1])
    assert [set(group.tolist()) for group in groups] == [{k} for k in np.unique(key)]
    assert begins[-1] == len(key)


def test_scene_without_meshes_has_no_edges() -> None:
    table = EdgeTable.of(np.empty((0, 3), np.float32), np.empty((0, 3), np.int64))
    assert len(table.candidates(np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.1)) == 0


# Curves on the film


def film_length(*curves: Curves, size: float = 4000.0) -> float:
    """Total length [pixel] of curves seen by a pinhole of focal length 1000 pixels."""
    scale = np.array([-1e-3, -1e-3])
    lens = Camera(scale, -scale * size / 2, (int(size), int(size)), 1e-2)
    pieces = cut(Curves.join(list(curves)), lens, np.array([0.0, 0.0, size, size]))
    n, total = len(pieces), 0.0
    everywhere = np.broadcast_to([-np.inf, -np.inf, np.inf, np.inf], (n, 4))
    for u in (0.5 - 0.5 / np.sqrt(3.0), 0.5 + 0.5 / np.sqrt(3.0)):  # Gauss' two points
        placed = place(
            pieces, np.full(n, u), np.zeros((n, 3)), everywhere, lens, lambda e, _: np.ones(len(e))
        )
        total += float(placed.length.sum()) / 2.0
    return total


@pytest.mark.parametrize("angle", [0.0, 0.5])
def test_spheres_contour_is_the_ellipse_of_its_tangent_cone(angle: float) -> None:
    centre = 5.0 * np.array([[np.sin(angle), 0.0, np.cos(angle)]])
    sine = 0.8 / 5.0
    room = np.cos(angle) ** 2 - sine**2
    a, b = sine * np.sqrt(1.0 - sine**2) / room, sine / np.sqrt(room)
    perimeter = 4.0 * a * ellipe(1.0 - (b / a) ** 2)
    length = film_length(Curves.of(CIRCLE, centre, np.array([[0.8, 0.0, 0.0]])))
    assert length == pytest.approx(1000.0 * perimeter, rel=1e-6)


def test_disks_contour_is_its_rim() -> None:
    disk = Curves.of(RIM, np.array([[0.1, 0.2, 4.0]]), np.array([[0.5, 0, 0]]), np.array([[0, 0.5, 0]]))
    assert film_length(disk) == pytest.approx(1000.0 * 2.0 * np.pi * 0.5 / 4.0, rel=1e-6)


def test_cylinders_contour_is_two_tangent_lines() -> None:
    base, axis, radius = np.array([[-1.0, 0, 5]]), np.array([[2.0, 0, 0]]), np.array([[0, 0.6, 0]])
    lines = [Curves.of(TANGENT, base, axis, radius, np.array([sign])) for sign in (1, -1)]
    depth = 5.0 * (1.0 - (0.6 / 5.0) ** 2)
    assert film_length(*lines) == pytest.approx(2.0 * 1000.0 * 2.0 / depth, rel=1e-9)


def test_what_lies_behind_the_camera_is_left_out() -> None:
    # A level ring around the camera, half a unit below: a hyperbola, y = √(1 + x²)/2, out to x = ±2.
    ring = Curves.of(RIM, np.array([[0.0, -0.5, 0.0]]), np.array([[0, 0, 1.0]]), np.array([[1.0, 0, 0]]))
    length, _ = quad(lambda x: np.sqrt(1.0 + 0.25 * x * x / (1.0 + x * x)), -2.0, 2.0)
    assert film_length(ring) == pytest.approx(
        1000.0 * length, rel=0.005
    )  # the last pieces reach over the edge
    sphere = Curves.of(CIRCLE, np.array([[0, 0, 0.5]]), np.array([[1.0, 0, 0]]))
    assert film_length(sphere) == 0.0  # the camera is inside
    assert film_length(Curves.of(CIRCLE, np.zeros((1, 3)), np.array([[9.0, 0, 0]]))) == 0.0  # at its centre


@pytest.mark.parametrize("near", [1e-2, 1e-5])
def test_what_runs_beside_the_film_to_the_cameras_plane_has_no_piece_on_it(near: float) -> None:
    """A rim and a ball that begin behind the camera: their last pieces' rectangles hold the whole film."""
    scale = np.array([-1e-3, -1e-3])
    lens = Camera(scale, -scale * 2000.0, (4000, 4000), near)
    rim = Curves.of(RIM, np.array([[0.2, -3.0, 0.0]]), np.array([[0, 0, 0.5]]), np.array([[0.5, 0, 0]]))
    ball = Curves.of(CIRCLE, np.array([[-2.0, 0.3, 0.1]]), np.array([[0.5, 0, 0]]))
    for curve in (rim, ball):
        assert len(cut(curve, lens, np.array([0.0, 0.0, 4000.0, 4000.0]))) == 0


# In scenes


class White(mi.SamplingIntegrator):
    """L = 1 everywhere."""

    def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True) -> Any:
        del scene, sampler, medium, active
        return mi.Color3f(1.0) + 0.0 * ray.d.x, mi.Bool(True), []

    def to_string(self) -> str:
        return "White"


def mesh(vertices: np.ndarray, faces: np.ndarray) -> mi.Mesh:
    """A mesh from arrays, nothing checked and nothing computed."""
    made = mi.Mesh("mesh", len(vertices), len(faces))
    params = mi.traverse(made)
    params["vertex_positions"] = np.ravel(vertices).astype(np.float32)
    params["faces"] = np.ravel(faces).astype(np.uint32)
    params.update()
    return made


def glow(*color: float) -> dict[str, Any]:
    """An emission of equal radiance in all directions."""
    return {"type": "area", "radiance": {"type": "rgb", "value": list(color)}}


def box(world: Any = TILT) -> dict[str, Any]:
    return {"type": "cube", "to_world": world.scale(0.6), "emitter": glow(0.2, 0.4, 0.9)}


def sphere() -> dict[str, Any]:
    return {"type": "sphere", "radius": 0.8, "emitter": glow(0.8, 0.3, 0.1)}


def cylinder() -> dict[str, Any]:
    ends = {"p0": [-0.5, -0.5, 0.0], "p1": [0.5, 0.5, 0.3]}
    return {"type": "cylinder", **ends, "radius": 0.4, "emitter": glow(0.1, 0.6, 0.3)}


def disk() -> dict[str, Any]:
    return {
        "type": "disk",
        "to_world": T().rotate([0.8, 0.6, 0], 160).scale([0.9, 0.6, 1]),
        "emitter": glow(1, 0, 1),
    }


def loose_box(parts: int) -> dict[str, Any]:
    """A box of six rectangles that share no vertices, or with four of them in two parts."""
    faces: dict[str, Any] = {}
    for i, (axis, angle) in enumerate(SIDES):
        side = TILT.scale(0.6).rotate(axis, angle)
        for j in range(parts if i % 2 else 1):
            whole = parts == 1 or i % 2 == 0
            place = T().translate([0, 0, 1]) if whole else T().translate([j - 0.5, 0, 1]).scale([0.5, 1, 1])
            faces[f"face{i}{j}"] = {
                "type": "rectangle",
                "to_world": side @ place,
                "emitter": glow(0.2, 0.4, 0.9),
            }
    return faces


def scene(rfilter: str = "gaussian", sensor: dict[str, Any] | None = None, **objects: Any) -> dict[str, Any]:
    """Objects before a wall, all of which glow: no noise but that of the geometry."""
    return {
        "type": "scene",
        "integrator": {"type": "direct"},
        "sensor": {
            "type": "perspective",
            "fov": 45,
            "near_clip": 0.01,
            "far_clip": 1000.0,
            "to_world": T().look_at([0.9, 0.6, -3.4], [0, 0, 0], [0, 1, 0.1]),
            "film": {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "rfilter": {"type": rfilter}},
            **(sensor or {}),
        },
        "wall": {
            "type": "rectangle",
            "to_world": T().translate([0, 0, 3]).scale(20).rotate([0, 1, 0], 180),
            "emitter": glow(0.7, 0.6, 0.5),
        },
        **objects,
    }


def all_pixels() -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), axis=-1).reshape(-1, 2)


def parallax_term(
    view: View, contours: Contours, pixels: np.ndarray, baseline: np.ndarray, *, batches: int, **options: int
) -> np.ndarray:
    """Of every pixel (batches, n, 3, 6)."""
    terms = np.zeros((batches, len(pixels), 3, 6))
    term = ParallaxTerm(view, contours, pixels, baseline, Paths(batches=batches, **options))
    term.launch()
    term.wait()
    rows, found, _ = term.result()
    terms[:, rows, :, : found.shape[-1]] = found
    return terms


class Given(NamedTuple):
    """Baselines of lanes in the place of a `Pilot`."""

    arrays: list[Any]

    @staticmethod
    def baseline(arrays: list[Any], _lanes: Any) -> Any:
        return arrays[0]


def without_contours(
    view: View, prepared: flow.Prepared, pixels: np.ndarray, baseline: np.ndarray, **options: int
) -> np.ndarray:
    """Filter and view terms (batches, n, 3, 6)."""
    given = Given([mi.Color3f(np.tile(baseline, (options["batches"], 1)).T)])
    columns, image, *_ = flow.filter_and_view_terms(view, prepared, pixels, given, Paths(**options))()
    return flow.as_arrays([*columns, image], options["batches"])[0]


def closure(
    description: dict[str, Any], *, spp: int = 512, columns: int = 3
) -> tuple[np.ndarray, np.ndarray]:
    """What the parallax term must be multiplied by to cancel the filter term, and its standard error."""
    pixels = all_pixels()
    zero = np.zeros((len(pixels), 3))
    with open_view(description, integrator=White(mi.Properties())) as view:
        prepared = flow.prepare(view)
        options = {"seed": 1, "batches": BATCHES}
        inner = without_contours(view, prepared, pixels, zero, spp=spp, **options)
        edge = parallax_term(view, prepared.contours, pixels, zero, spp=4 * spp, **options)
    inner, edge = inner[:, :, 0, :columns], edge[:, :, 0, :columns]
    mean = edge.mean(axis=0)
    # Between different batches, because the edge term's own noise would add to its square.
    square = (BATCHES * np.sum(mean**2, axis=0) - np.mean(np.sum(edge**2, axis=1), axis=0)) / (BATCHES - 1)
    products = -np.einsum("knj,nj->kj", inner, mean) / square
    return products.mean(axis=0), products.std(axis=0, ddof=1) / np.sqrt(BATCHES)


def sheet(depth: float, larger: float) -> dict[str, Any]:
    """As the camera sees it but for so much, one and the same rectangle."""
    half = depth / 4.0 * np.array([0.8, 0.6, 1.0]) + [larger, larger, 0.0]
    centre = depth / 4.0 * np.array([0.03, -0.02, 4.0]) - [0.0, 0.0, 4.0]
    place = T().translate(centre.tolist()).scale(half.tolist()).rotate([0, 1, 0], 180)
    return {"type": "rectangle", "to_world": place, "emitter": glow(1, 1, 1)}


def lid(height: float, angle: float) -> dict[str, Any]:
    place = T().translate([0, height, 0]).rotate([1, 0, 0], angle).scale(0.5)
    return {"type": "disk", "to_world": place, "emitter": glow(1, 0, 1)}


def instances(**shapes: Any) -> dict[str, Any]:
    """A group that stands in the scene twice, moved, turned and scaled; another that nobody shows."""
    first = T().translate([-0.7, 0.2, 0.3]) @ TILT.scale(0.7)
    second = T().translate([0.6, -0.3, -0.4]).rotate([0, 1, 0], 70).scale(0.8)
    return {
        "group": {"type": "shapegroup", **shapes},
        "other": {"type": "shapegroup", "ball": {"type": "sphere"}},
        **{
            f"place{i}": {"type": "instance", "group": {"type": "ref", "id": "group"}, "to_world": world}
            for i, world in enumerate((first, second))
        },
    }


def bars() -> dict[str, Any]:
    """A window frame of four thin boxes that run into each other at its corners."""
    places = ([-0.7, 0, 0.05, 0.6], [0.7, 0, 0.05, 0.6], [0, 0.6, 0.75, 0.05], [0, -0.6, 0.75, 0.05])
    return {
        f"bar{i}": {"type": "cube", "to_world": T().translate([x, y, 0]).scale([wide, high, 0.002])}
        for i, (x, y, wide, high) in enumerate(places)
    }


LEVEL = {"to_world": T().look_at([0, 0, -4], [0, 0, 0], [0, 1, 0])}

SCENES: dict[str, dict[str, Any]] = {
    "box": scene(box=box()),
    "sphere": scene(sphere=sphere()),
    "cylinder": scene(cylinder=cylinder()),
    "disk": scene(disk=disk()),
    "open cylinder from above": scene(
        pot={
            "type": "cylinder",
            "p0": [0, -1.5, 0],
            "p1": [0, 0.1, 0],
            "radius": 0.6,
            "emitter": glow(1, 1, 1),
        }
    ),
    "objects that hide one another": scene(
        sphere=sphere(), box=box(T().translate([0.4, 0.3, -1.2]).scale(0.6)), cylinder=cylinder()
    ),
    "box of six rectangles": scene(**loose_box(1)),
    "long edges along short ones": scene(**loose_box(2)),
    # A hundredth of a pixel is 0.0008 at the depth of 4.
    "sheet hidden by a nearer one": scene(sensor=LEVEL, a=sheet(4.0, 0.0), b=sheet(4.01, -1e-4)),
    "sheet exactly hidden by a nearer one": scene(sensor=LEVEL, a=sheet(4.0, 0.0), b=sheet(4.01, 0.0)),
    "sheet that stands out behind a nearer one": scene(sensor=LEVEL, a=sheet(4.0, 0.0), b=sheet(4.01, 1e-4)),
    "three sheets": scene(sensor=LEVEL, a=sheet(4.0, 0.0), b=sheet(4.01, -1e-4), c=sheet(4.02, 1e-4)),
    "double sheet": scene(sensor=LEVEL, a=sheet(4.0, 0.0), b=sheet(4.001, -1e-6)),
    "sphere within another": scene(outer=sphere(), inner={**sphere(), "radius": 0.8 * (1.0 - 1e-4)}),
    "capped cylinder": scene(
        side={
            "type": "cylinder",
            "p0": [0, -0.5, 0],
            "p1": [0, 0.4, 0],
            "radius": 0.5,
            "emitter": glow(1, 1, 1),
        },
        top=lid(0.4, -90),
        bottom=lid(-0.5, 90),
    ),
    "window frame": scene(sensor=LEVEL, **bars()),
    "instances": scene(
        **instances(
            box={"type": "cube", "to_world": T().scale(0.6)},
            ball={"type": "sphere", "center": [0, 1, 0], "radius": 0.4},
            plate={
                "type": "rectangle",
                "to_world": T().translate([0.9, 0, 0]).rotate([1, 1, 0], 40).scale(0.4),
            },
        )
    ),
    "box filter": scene("box", box=box(), sphere=sphere()),
    "mitchell filter": scene("mitchell", box=box(), cylinder=cylinder()),
    "thin lens": scene(sensor=THIN, box=box()),
    "thin lens and smooth shapes": scene(sensor=THIN, sphere=sphere(), disk=disk()),
}


@pytest.mark.parametrize("name", SCENES)
def test_filter_and_parallax_term_of_constant_radiance_cancel(name: str) -> None:
    factor, error = closure(SCENES[name])
    # 36 numbers at four standard errors, each estimated from eight batches: fails for one seed in ten.
    assert np.all(error < 0.02)
    assert np.all(np.abs(factor - 1.0) < np.maximum(0.01, 4.0 * error))


def test_a_floor_seen_at_a_grazing_angle_has_no_clamping_bias() -> None:
    """Camera 1/30 of its distance above a floor, where ∇·f is 30 times what it is from the front."""
    level = T().translate([0, -0.3, 0]).rotate([1, 0, 0], -90).scale(0.8)
    sensor = {"to_world": T().look_at([0.1, -0.2, -3.4], [0, -0.2, 0], [0, 1, 0.1])}
    factor, error = closure(scene(sensor=sensor, floor={"type": "rectangle", "to_world": level}), spp=2048)
    assert np.all(error < 0.02)
    assert np.all(np.abs(factor - 1.0) < np.maximum(0.01, 4.0 * error))


@pytest.mark.parametrize("kind", ["split vertices", "wound both ways", "open"])
def test_meshes_need_no_shared_vertices_winding_or_closedness(kind: str) -> None:
    vertices, faces = cube()
    vertices = vertices @ np.array(TILT.matrix, dtype=np.float32)[:3, :3].T * np.float32(0.6)
    if kind == "split vertices":
        vertices, faces = vertices[faces].reshape(-1, 3), np.arange(36).reshape(-1, 3)
    elif kind == "wound both ways":
        faces[::3] = faces[::3, ::-1]
    else:
        faces = faces[:6]
    factor, error = closure(scene(mesh=mesh(vertices, faces)))
    assert np.all(error < 0.02)
    assert np.all(np.abs(factor - 1.0) < np.maximum(0.01, 4.0 * error))


def test_a_scanned_ball_has_each_of_its_silhouettes_once() -> None:
    """Noise of 5e-4 of its radius makes folds all along its rim, most of them behind others."""
    n, radius = 100, 0.8
    polar, around = np.meshgrid(
        np.linspace(0.0, np.pi, n + 1)[1:-1],
        np.linspace(0.0, 2.0 * np.pi, 2 * n, endpoint=False),
        indexing="ij",
    )
    r = radius * (1.0 + 5e-4 * np.random.default_rng(1).standard_normal(polar.shape))
    x, y = r * np.sin(polar) * np.cos(around), r * np.sin(polar) * np.sin(around)
    vertices = np.stack([x, r * np.cos(polar), y], axis=-1).reshape(-1, 3)
    i, j = (k.ravel() for k in np.meshgrid(np.arange(n - 2), np.arange(2 * n), indexing="ij"))
    a, b = 2 * n * i + j, 2 * n * i + (j + 1) % (2 * n)
    faces = np.concatenate([np.stack([a, b, b + 2 * n], axis=1), np.stack([a, b + 2 * n, a + 2 * n], axis=1)])
    factor, error = closure(scene(ball=mesh(vertices @ np.array(TILT.matrix)[:3, :3].T, faces)))
    assert np.all(error < 0.02)
    assert np.all(np.abs(factor - 1.0) < np.maximum(0.01, 4.0 * error))


def test_thin_lens_has_parallax_in_rotation() -> None:
    wide = THIN | {"aperture_radius": 0.4, "focus_distance": 2.0}
    factor, error = closure(scene(sensor=wide, box=box()), columns=6)
    assert np.all(error < 0.15)
    assert np.all(np.abs(factor - 1.0) < np.maximum(0.02, 4.0 * error))


def test_closure_fails_when_an_edge_counts_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    for owner, name in ((EdgeTable, "repeats"), (Contours, "_hidden")):
        monkeypatch.setattr(owner, name, lambda self, edges, *_: np.zeros(len(edges), dtype=bool))
    factor, _ = closure(SCENES["box of six rectangles"], spp=64)
    assert factor == pytest.approx([0.5, 0.5, 0.5], abs=0.05)


def test_hidden_emitters_have_no_contours() -> None:
    lamp = {"type": "sphere", "center": [0.2, 0.2, -1.5], "radius": 0.2, "emitter": glow(9, 9, 9)}
    solid = {**box(), "emitter": None}
    solid.pop("emitter")
    description = scene(box=solid, lamp=lamp)
    description["wall"].pop("emitter")
    pixels = all_pixels()
    terms = []
    for objects in (description, {k: v for k, v in description.items() if k != "lamp"}):
        props = mi.Properties()
        props["hide_emitters"] = True
        with open_view(objects, integrator=White(props)) as view:
            contours = find_contours(view)
            zero = np.zeros((len(pixels), 3))
            terms.append(
                parallax_term(view, contours, pixels, zero, spp=4096, seed=1, batches=4).mean(axis=0)
            )
    scale = np.abs(terms[1]).max()
    assert scale > 0.0
    assert np.abs(terms[0] - terms[1]).max() < 0.01 * scale


def information(values: np.ndarray) -> np.ndarray:
    """Diagonal of the unbiased JᵀJ of independent batches."""
    sums = values.sum(axis=0)
    diagonal = np.sum(sums**2, axis=(0, 1)) - np.sum(values**2, axis=(0, 1, 2))
    return np.asarray(diagonal / (len(values) * (len(values) - 1)))


@pytest.mark.slow
def test_jacobian_of_silhouettes_agrees_with_finite_differences() -> None:
    objects = {
        "box": box(T().translate([0.9, 0.5, 0]) @ TILT),
        "sphere": {**sphere(), "center": [-1.0, 0.3, 0.5]},
        "pot": {**cylinder(), "to_world": T().translate([-0.3, -0.9, -0.4])},
        "disk": {**disk(), "to_world": T().translate([0.4, -0.7, 0.3]).rotate([0.8, 0.6, 0], 160).scale(0.5)},
    }
    pixels = all_pixels()
    with open_view(scene(**objects)) as view:
        prepared = flow.prepare(view)
        options = {"seed": 1, "batches": BATCHES}
        ours, _ = measured(flow.Flow, view, pixels, spp=512, **options)
        theirs, _ = measured(
            finite_difference.FiniteDifference, view, pixels, spp=2048, step_pixels=0.1, **options
        )
        image = render_pixels(view, pixels, spp=16, seed=2)[0]
        without = without_contours(view, prepared, pixels, image, spp=512, **options)
    # Finite differences: bias about −0.7 % at steps of 0.1 pixels, standard error about 1 %; flow's is 0.5 %.
    assert information(ours) == pytest.approx(information(theirs), rel=0.04)
    # Negative control: without the contours translation is wrong.
    ratio = information(without)[:3] / information(theirs)[:3]
    assert np.all(np.abs(ratio - 1.0) > 0.2)


def term(
    view: View, contours: Contours, pixels: np.ndarray, baseline: np.ndarray, seed: int = 1
) -> np.ndarray:
    return parallax_term(view, contours, pixels, baseline, spp=32, seed=seed, batches=4)


@pytest.mark.parametrize("sensor", [{}, THIN])
def test_pixels_values_depend_on_no_other_pixel_and_repeat_bit_for_bit(sensor: dict[str, Any]) -> None:
    rng = np.random.default_rng(0)
    pixels = all_pixels()
    baseline = rng.random((len(pixels), 3))
    with open_view(scene(sensor=sensor, box=box(), sphere=sphere())) as view:
        contours = find_contours(view)
        whole = term(view, contours, pixels, baseline)
        assert np.array_equal(whole, term(view, find_contours(view), pixels, baseline))
        assert not np.array_equal(whole, term(view, contours, pixels, baseline, seed=2))
        assert np.any(whole[0] != whole[1])
        shuffled = rng.permutation(len(pixels))
        few = np.sort(shuffled[:40])
        left = np.flatnonzero(pixels[:, 0] < 16)
        for subset in (shuffled, few, left):
            assert np.array_equal(whole[:, subset], term(view, contours, pixels[subset], baseline[subset]))


def test_edge_table_follows_the_geometry_not_the_scene_object() -> None:
    loaded = mi.load_dict(scene(box=box()))
    table = edge_table(loaded)
    assert edge_table(mi.load_dict(scene(box=box()))) is table
    assert edge_table(mi.load_dict(scene(box=box(T())))) is not table


def test_nobody_can_change_the_edge_table_that_the_next_scene_gets() -> None:
    table = edge_table(mi.load_dict(scene(box=box())))
    arrays = [value for value in vars(table).values() if isinstance(value, np.ndarray)]
    assert arrays
    assert not any(array.flags.writeable for array in arrays)


ASIDE_OF_BOX = T().translate([0.5, 0.2, 2.5]).scale(0.15)
UNKNOWN: dict[str, dict[str, Any]] = {
    "instances": {
        "group": {"type": "shapegroup", "block": {"type": "cube"}},
        "first": {"type": "instance", "group": {"type": "ref", "id": "group"}, "to_world": ASIDE_OF_BOX},
    },
    "cylinders scaled unevenly of an instance": {
        "group": {
            "type": "shapegroup",
            "tube": {"type": "cylinder", "to_world": T().scale([1, 2, 1])},
        },
        "first": {"type": "instance", "group": {"type": "ref", "id": "group"}, "to_world": ASIDE_OF_BOX},
    },
    "curves": {"curve": {"type": "linearcurve"}},
    "curves of cubic splines": {"curve": {"type": "bsplinecurve"}},
    "signed distance fields": {
        "field": {"type": "sdfgrid", "grid": mi.TensorXf(np.linspace(-1, 1, 8).reshape(2, 2, 2, 1))}
    },
    "radiance fields": {
        "blobs": {
            "type": "ellipsoids",
            "centers": mi.TensorXf(np.array([[0.5, 0.2, 2.5]])),
            "scales": mi.TensorXf(np.full((1, 3), 0.2)),
            "quaternions": mi.TensorXf(np.array([[0.0, 0.0, 0.0, 1.0]])),
        }
    },
    "spheres scaled unevenly": {"ball": {"type": "sphere", "to_world": ASIDE_OF_BOX @ T().scale([1, 2, 1])}},
    "cylinders scaled unevenly": {
        "tube": {"type": "cylinder", "to_world": ASIDE_OF_BOX @ T().scale([1, 2, 1])}
    },
}


@pytest.mark.parametrize("name", UNKNOWN)
def test_blocks_that_show_shapes_without_contours_are_found(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    objects = UNKNOWN[name]
    if name == "instances":  # of more faces than are listed
        monkeypatch.setattr(surfaces, "_MOST", 1)
    if "curve" in objects:
        points = tmp_path / "curve.txt"
        points.write_text("-1 0 0 0.1\n0 0.5 0 0.1\n1 0.5 0 0.1\n2 0 0 0.1\n")
        objects = {"curve": objects["curve"] | {"filename": str(points)}}
    pixels = all_pixels()
    blocks = FilmBlocks.of(pixels)
    # The box's contours are looked for among the others' hits.
    with open_view(scene(box=box(), **objects)) as view:
        find_contours(view)
        causes = Unfollowed.of(view, tracer(view)).causes(pixels, blocks)
        _, depth = first_hits(view, pixels)
    with open_view(scene(box=box())) as view:
        assert not Unfollowed.of(view, tracer(view)).causes(pixels, blocks).any()
        changed = first_hits(view, pixels)[1] != depth
    assert set(causes[blocks.any(changed)]) == {name.partition(" of ")[0]}
    assert (causes == "").any()


def test_view_without_contours_has_no_parallax() -> None:
    pixels = all_pixels()
    with open_view(scene()) as view:
        value = term(view, find_contours(view), pixels, np.zeros((len(pixels), 3)))
    assert not value.any()
