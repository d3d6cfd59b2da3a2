"""The scenes in which flow is compared with references: one picture for each thing that can go wrong.

What is no part of the question is free of noise (point lights, two bounces, textured lamps that reflect
nothing), so that few samples resolve what is. Where it costs nothing, all six directions are seen.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from small_scenes import T, camera, mi, scene, texture, wall

from mitsuba_crb.camera import Intrinsics

SHIPPED = Path(__file__).parents[1] / "scenes"
OTHERS = Path(__file__).parents[2] / "shared" / "data" / "mitsuba"
NONE = (0.0,) * 4
SIZE = (24, 18)
"""Width and height [pixel]."""

GREY = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.8}}
POINT_LIGHT = {"type": "point", "position": [0.8, 1.2, -1.0], "intensity": {"type": "rgb", "value": 20.0}}
THIN_LENS = {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 2.5}


def lit(*, light: dict[str, Any] = POINT_LIGHT, depth: int = 2, **objects: Any) -> dict[str, Any]:
    """Objects under one light."""
    return scene(light=light, integrator={"type": "path", "max_depth": depth}, **objects)


def before_wall(**objects: Any) -> dict[str, Any]:
    """Objects before a textured wall."""
    return lit(wall=wall(texture()), **objects)


def filtered(name: str) -> dict[str, Any]:
    """A textured wall by another reconstruction filter."""
    sensor = camera()
    sensor["film"]["rfilter"] = {"type": name}
    return lit(wall=wall(texture()), sensor=sensor)


def mesh(
    vertices: Any, faces: Any, bsdf: dict[str, Any], normals: Any = None, to_world: Any = None
) -> mi.Mesh:
    """A mesh of (V, 3) vertices and (F, 3) faces; without normals it is flat."""
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf)
    properties["face_normals"] = normals is None
    vertices, faces = np.asarray(vertices, dtype=np.float32), np.asarray(faces, dtype=np.uint32)
    matrix = np.array((to_world or T()).matrix, dtype=np.float32)
    shape = mi.Mesh("mesh", len(vertices), len(faces), properties, normals is not None)
    parameters = mi.traverse(shape)
    parameters["vertex_positions"] = (vertices @ matrix[:3, :3].T + matrix[:3, 3]).ravel()
    parameters["faces"] = faces.ravel()
    if normals is not None:
        turned = np.asarray(normals, dtype=np.float32) @ np.linalg.inv(matrix[:3, :3])
        parameters["vertex_normals"] = (turned / np.linalg.norm(turned, axis=1, keepdims=True)).ravel()
    parameters.update()
    return shape


def cube_mesh() -> tuple[np.ndarray, np.ndarray]:
    """Eight vertices that twelve faces share."""
    vertices = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    return vertices, np.array([[q[i] for i in t] for q in quads for t in ((0, 1, 2), (0, 2, 3))])


def ball_mesh(around: int, down: int) -> tuple[np.ndarray, np.ndarray]:
    """The unit sphere by longitude and latitude; its vertices are its normals, too."""
    theta = np.linspace(0.0, np.pi, down + 1)[:, None]
    phi = 2.0 * np.pi * np.arange(around) / around
    grid = np.stack(
        np.broadcast_arrays(np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)), -1
    )
    vertices = np.concatenate([[[0, 1, 0]], grid[1:-1].reshape(-1, 3), [[0, -1, 0]]])
    j, south = np.arange(around), len(vertices) - 1
    k = (j + 1) % around
    faces = [
        np.stack([0 * j, 1 + k, 1 + j], 1),
        np.stack([0 * j + south, south - around + j, south - around + k], 1),
    ]
    for row in range(down - 2):
        a, b = 1 + row * around, 1 + (row + 1) * around
        faces += [np.stack([a + j, a + k, b + j], 1), np.stack([a + k, b + k, b + j], 1)]
    return vertices, np.concatenate(faces)


def lamp(to_world: Any, radiance: Any) -> dict[str, Any]:
    """A rectangle that shines and reflects nothing."""
    return {
        "type": "rectangle",
        "to_world": to_world,
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}},
        "emitter": {"type": "area", "radiance": radiance},
    }


def between_lamps(bsdf: dict[str, Any], **options: Any) -> dict[str, Any]:
    """A plane of some material that fills the view, between textured lamps."""
    behind = lamp(T().translate([0, 0, -4]).scale(9), texture(3, 16))
    beyond = lamp(T().translate([0, 0, 5]).scale(9).rotate([0, 1, 0], 180), texture(5, 16))
    which = scene(wall=wall() | {"bsdf": bsdf}, behind=behind, beyond=beyond, **options)
    del which["light"]
    return which | {"integrator": {"type": "path", "max_depth": 4}}


def sloping(bsdf: dict[str, Any]) -> dict[str, Any]:
    """A floor so nearly edge-on that shading normals turn away from the camera, before a textured wall."""
    slope = T().translate([0, -0.25, 1.8]).rotate([1, 0, 0], -90).scale([3, 1.1, 1])
    return before_wall(floor={"type": "rectangle", "to_world": slope, "bsdf": bsdf})


REAL = {
    "staircase2": "scene.xml",
    "sponza": "scene_m39.xml",
    "matpreview": "matpreview.xml",
    "cornell-picture": "scene_picture.xml",
}
"""Scenes by others, by folder."""


SMALL = (96, 72)


def relit(name: str) -> dict[str, Any]:
    """Shapes and camera of a scene by others under one point light beside the camera.

    Raises:
        FileNotFoundError: the data of others is not beside this repository.
    """
    loaded = mi.load_file(str(OTHERS / name / REAL[name]))
    sensor = loaded.sensors()[0]
    # The references' films, under the field of view that the object has along x.
    parameters = mi.traverse(sensor)
    parameters["film.size"] = mi.ScalarVector2u(*SMALL)
    parameters.update()
    depth = float(loaded.ray_intersect(sensor.sample_ray(0.0, 0.5, [0.5, 0.5], [0.5, 0.5])[0]).t[0])
    beside = sensor.world_transform() @ mi.Point3f(0.15 * depth, 0.15 * depth, 0.0)
    shapes = {f"shape{i}": shape for i, shape in enumerate(loaded.shapes()) if not shape.is_emitter()}
    light = {
        "type": "point",
        "position": np.array(beside).ravel().tolist(),
        "intensity": {"type": "rgb", "value": 4.0 * depth**2},
    }
    return lit(light=light, sensor=sensor, **shapes)


def bitmap(values: np.ndarray) -> dict[str, Any]:
    """Raw values as a texture."""
    return {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(values.astype(np.float32))}


ROOM = T().translate([0.1, 0.2, 2.0])
NORMALS = bitmap(
    np.concatenate([np.random.default_rng(6).normal(0.5, 0.08, (8, 8, 2)), np.ones((8, 8, 1))], axis=-1)
)
HEIGHTS = bitmap(np.random.default_rng(7).uniform(0.0, 1.0, (12, 12, 1)))
FLOOR = {"type": "diffuse", "reflectance": texture(1, 24)}
NORMAL_MAP = {"type": "normalmap", "normalmap": NORMALS, "bsdf": FLOOR}
BUMP_MAP = {"type": "bumpmap", "arbitrary": HEIGHTS, "scale": 0.3, "bsdf": FLOOR}
BOX = ROOM.rotate([1, 1, 0], 35).scale(0.3)
BALL = {"type": "sphere", "center": [-0.1, 0.15, 2.0], "radius": 0.45, "bsdf": GREY}
BIG_BALL = {"type": "sphere", "center": [-0.7, -0.4, 1.6], "radius": 0.9, "bsdf": GREY}
POLE = {"type": "cylinder", "p0": [0.7, -2, 1.5], "p1": [0.3, 2, 1.7], "radius": 0.3, "bsdf": GREY}
CYLINDER = {"type": "cylinder", "p0": [-0.3, -0.2, 2], "p1": [0.4, 0.5, 2], "radius": 0.2, "bsdf": GREY}
DISK = {"type": "disk", "to_world": ROOM.rotate([1, 0, 0], 150).scale(0.4), "bsdf": GREY}
OCCLUDER = {
    "type": "rectangle",
    "to_world": T().translate([0.65, 0.85, 0.9]).rotate([0, 0, 1], 30).scale(0.2),
}
OCCLUDERS = {
    "right": OCCLUDER,
    "above": {
        "type": "rectangle",
        "to_world": T().translate([0.1, 0.9, 1.2]).rotate([0, 0, 1], 10).scale(0.2),
    },
    "left": {
        "type": "rectangle",
        "to_world": T().translate([-0.65, 0.75, 1.2]).rotate([0, 0, 1], 10).scale(0.25),
    },
}
"""Outside the view; their shadows are in it."""
SMALL_LAMP = lamp(T().translate([0.8, 1.2, -1.0]).scale(0.12), {"type": "rgb", "value": 350.0})
"""Its penumbras are some two pixels wide: the wider they are, the more noise and the less information."""
LAMP = lamp(T().translate([0, 1.5, -0.5]).scale([0.5, 0.3, 1]), {"type": "rgb", "value": 8.0})
HIDDEN_LAMP = {
    "type": "sphere",
    "center": [-0.25, 0.1, 1.3],
    "radius": 0.12,
    "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 60.0}},
}
"""Before the edge of the box: who counts its contour is wrong by 10 %, who follows its surface by 80 %."""
SKY = {
    "type": "envmap",
    "bitmap": mi.Bitmap(np.random.default_rng(9).uniform(0.1, 2.0, (16, 32, 3)).astype(np.float32)),
}
DARK = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.25}}
"""Light that it reflects is the noise of its rim, which stands out from the sky all the more."""
CHECKERS = {"type": "checkerboard", "to_uv": T().scale(12)}


@dataclass(frozen=True)
class Row:
    """One scene, and how closely flow meets its reference."""

    which: Any
    """A dictionary, a path, or a function that gives one."""
    spp: int = 4096
    """Paths per pixel of flow."""
    tolerance: float = 0.01
    """Relative, of the diagonal entries of F."""
    error: float = 0.005
    """Largest combined standard error, relative."""
    size: tuple[int, int] = SIZE
    """Width and height [pixel]."""
    lens: Intrinsics | None = None
    """In place of the scene's camera, and of that size."""

    def scene(self) -> Any:
        """What can be measured."""
        return self.which() if callable(self.which) else self.which

    @property
    def options(self) -> dict[str, Any]:
        """What a measurement is told besides."""
        return {"size": self.size, "camera": self.lens}

    def digest(self) -> str:
        """What is measured, in twelve letters; equal for equal scenes and lenses."""
        return digest(self.scene() if self.lens is None else [self.scene(), self.lens.to_dict()])


def digest(value: Any) -> str:
    """What a scene is, in twelve letters; equal for equal scenes."""
    return hashlib.sha256(repr(_plain(value)).encode()).hexdigest()[:12]


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if isinstance(value, mi.Bitmap):
        return hashlib.sha256(np.array(value).tobytes()).hexdigest()
    if isinstance(value, mi.Mesh):
        positions = np.array(value.vertex_positions_buffer(), dtype=np.float64)
        return hashlib.sha256(np.round(positions, 4).tobytes()).hexdigest()
    if isinstance(value, mi.Object):
        return value.class_name()
    if isinstance(value, mi.ScalarTransform4f):
        return (np.round(np.array(value.matrix), 4) + 0.0).tolist()
    return value.read_text(encoding="utf-8") if isinstance(value, Path) else value


LENSES = {
    "barrel": Intrinsics((48, 36), (45.0, 44.0), (24.7, 17.2), "opencv", (-0.3, 0.08, 4e-3, -3e-3, *NONE)),
    "pincushion": Intrinsics((48, 36), (40.0, 39.0), (23.2, 18.7), "opencv", (0.3, 0.05, -3e-3, 4e-3, *NONE)),
    "fisheye": Intrinsics((48, 36), (23.4, 23.4), (24.0, 18.0), "fisheye", (-0.02, 0.01, -0.004, 0.0005)),
}
"""The fisheye sees 150° from corner to corner."""
SMALL_LENSES = {
    name: replace(lens.scaled((24, 18)), focal=(width * lens.focal[0], width * lens.focal[1]))
    for (name, lens), width in zip(LENSES.items(), (0.6, 0.4, 0.6), strict=True)
}
"""Of few pixels, beyond which filters reach farther: so the fisheye sees less, and the pincushion more."""

ROWS: dict[str, Row] = {
    "bilinear": Row(before_wall()),
    "nearest": Row(lit(wall=wall(texture(filter_type="nearest")))),
    "checkerboard": Row(lit(wall=wall(CHECKERS))),
    "normal_map": Row(sloping(NORMAL_MAP)),
    "bump_map": Row(sloping(BUMP_MAP), spp=262144),
    "smooth_mesh": Row(
        before_wall(
            ball=mesh(*ball_mesh(8, 6), GREY, ball_mesh(8, 6)[0], T().translate([-0.1, 0.15, 2.0]).scale(0.5))
        )
    ),
    "split_box": Row(before_wall(box={"type": "cube", "to_world": BOX, "bsdf": GREY}), error=0.006),
    "shared_box": Row(before_wall(box=mesh(*cube_mesh(), GREY, to_world=BOX))),
    "sphere": Row(before_wall(ball=BALL)),
    "cylinder": Row(before_wall(cylinder=CYLINDER)),
    "disk": Row(before_wall(disk=DISK)),
    "soft_shadow": Row(lit(wall=wall(), light=SMALL_LAMP, **OCCLUDERS), spp=65536),
    "hard_shadow": Row(lit(wall=wall(), occluder=OCCLUDER), spp=16384),
    "rough_conductor": Row(
        scene(wall=wall() | {"bsdf": {"type": "roughconductor", "alpha": 0.15}}, light=LAMP), spp=16384
    ),
    "rough_plastic": Row(
        lit(wall=wall() | {"bsdf": {"type": "roughplastic", "alpha": 0.2, "diffuse_reflectance": texture(2)}})
    ),
    "blend": Row(
        lit(
            wall=wall()
            | {
                "bsdf": {
                    "type": "blendbsdf",
                    "weight": texture(8, 12),
                    "first": {"type": "roughconductor", "alpha": 0.4},
                    "second": GREY,
                }
            }
        )
    ),
    "mirror": Row(between_lamps({"type": "conductor"}), tolerance=0.03, error=0.01),
    "dielectric": Row(between_lamps({"type": "dielectric"}), tolerance=0.03, error=0.01),
    "glass_pane": Row(between_lamps({"type": "thindielectric"}), tolerance=0.03, error=0.01),
    "thin_lens_mirror": Row(
        between_lamps({"type": "conductor"}, sensor=camera() | THIN_LENS),
        spp=16384,
        tolerance=0.03,
        error=0.01,
    ),
    "mask": Row(
        between_lamps({"type": "mask", "opacity": texture(8, 12), "bsdf": {"type": "conductor"}}),
        spp=8192,
        tolerance=0.03,
        error=0.01,
    ),
    "area_light": Row(lit(light=lamp(T().translate([0, 0, 3]).scale(6).rotate([0, 1, 0], 180), texture(4)))),
    "environment": Row(scene(light=SKY, ball=BALL | {"bsdf": DARK}), spp=8192),
    "thin_lens": Row(before_wall(ball=BALL, sensor=camera() | THIN_LENS), spp=8192),
    "hidden_emitter": Row(
        before_wall(box={"type": "cube", "to_world": BOX, "bsdf": GREY}, light=HIDDEN_LAMP)
        | {"integrator": {"type": "path", "max_depth": 2, "hide_emitters": True}},
        spp=16384,
    ),
    "box_filter": Row(filtered("box")),
    "tent_filter": Row(filtered("tent")),
    "mitchell_filter": Row(filtered("mitchell")),
    "rims": Row(before_wall(ball=BIG_BALL, pole=POLE)),
    "shipped_boxes": Row(SHIPPED / "boxes" / "boxes.xml", size=(32, 24)),
    **{
        f"{lens}_{name}": Row(SHIPPED / name / f"{name}.xml", error=error, size=(48, 36), lens=LENSES[lens])
        for lens in LENSES
        for name, error in (("boxes", 0.018), ("checkerboard_wall", 0.008), ("textured_room", 0.02))
    },
    **{
        f"real_{name}": Row(partial(relit, name), spp=1024, tolerance=0.03, error=0.015, size=SMALL)
        for name in REAL
    },
}
