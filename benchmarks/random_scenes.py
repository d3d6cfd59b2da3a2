"""Random scenes, flow beside finite differences: what nobody thought of writing down in a gallery.

    python benchmarks/random_scenes.py 0 200            # the scenes of these seeds; two to five seconds each
    python benchmarks/random_scenes.py 22 23 --spp 8192 # one of them, with more paths

Each has a wall, up to three shapes, instances, a lamp, materials and textures of many kinds, any filter,
field of view, axis of it, near and far plane, thin or distorting lens, and measures colour, a channel of it,
depth or both. They are judged as in `gallery.py`: `differs` is what is 2 % and four combined standard errors
apart, which of so many entries one in some hundred scenes is by chance. A difference that more paths do not
make smaller is a wrong number of one of the two: finite differences with a shorter `--step-pixels` say whose.
"""

from __future__ import annotations

import argparse
import functools
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from gallery import answered, beside, line

from mitsuba_crb import Intrinsics, pose_bound
from mitsuba_crb.noise import Gaussian
from mitsuba_crb.render.backend import use_mitsuba

use_mitsuba()

import mitsuba as mi  # noqa: E402  the variant comes first

T = mi.ScalarTransform4f
SIGMA = Gaussian(0.02)
SIZES = ((20, 15), (16, 16), (15, 20))
BATCHES = 8
FISHEYE = (-0.02, 0.01, -0.004, 0.0005)


class Maker:
    """Draws scenes."""

    def __init__(self, seed: int, folder: Path) -> None:
        self.rng, self.folder = np.random.default_rng(seed), folder

    def between(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def often(self, share: float) -> bool:
        return bool(self.rng.random() < share)

    def one_of(self, *choices: Any) -> Any:
        return choices[self.rng.integers(len(choices))]

    def bitmap(self, side: int, low: float, high: float) -> Any:
        return mi.Bitmap(self.rng.uniform(low, high, (side, side, 3)).astype(np.float32))

    def texture(self) -> dict[str, Any]:
        scale = [self.between(0.5, 6.0), self.between(0.5, 6.0), 1.0]
        placed = T().rotate([0, 0, 1], self.between(0.0, 90.0)).scale(scale)
        kind = self.one_of("checkerboard", "nearest", "bilinear", "bilinear", "rgb")
        if kind == "rgb":
            return {"type": "rgb", "value": [self.between(0.2, 0.9) for _ in range(3)]}
        if kind == "checkerboard":
            dark, light = ({"type": "rgb", "value": self.between(*pair)} for pair in ((0.1, 0.3), (0.6, 0.9)))
            return {"type": kind, "color0": dark, "color1": light, "to_uv": placed}
        side, wrap = self.one_of(2, 4, 8, 16), self.one_of("repeat", "mirror", "clamp")
        values = {"bitmap": self.bitmap(side, 0.1, 0.9), "raw": True, "filter_type": kind}
        return {"type": "bitmap", "to_uv": placed, "wrap_mode": wrap, **values}

    def material(self, *, plain: bool = False) -> dict[str, Any]:
        if plain:
            return {"type": "diffuse", "reflectance": self.texture()}
        inner = {"inner": self.material(plain=True)}
        height = {"type": "bitmap", "bitmap": self.bitmap(8, 0.0, 1.0), "raw": True}
        rough = {"type": "roughconductor", "alpha": self.between(0.1, 0.4)}
        other = {**rough, "alpha": 0.3}
        return self.one_of(
            {"type": "diffuse", "reflectance": self.texture()},
            {"type": "diffuse", "reflectance": self.texture()},
            rough,
            {"type": "plastic", "diffuse_reflectance": self.texture()},
            {"type": "roughplastic", "alpha": 0.2, "diffuse_reflectance": self.texture()},
            {"type": "principled", "base_color": self.texture(), "roughness": self.between(0.2, 0.8)},
            {"type": "conductor", "material": "Ag"},
            {"type": "dielectric"},
            {"type": "thindielectric"},
            {"type": "roughdielectric", "alpha": 0.3},
            {"type": "twosided", **inner},
            {"type": "blendbsdf", "weight": self.texture(), **inner, "other": other},
            {"type": "bumpmap", "height": height, "scale": self.between(0.05, 0.4), **inner},
            {"type": "mask", "opacity": self.texture(), **inner},
        )

    def place(self) -> Any:
        axis = self.rng.standard_normal(3)
        axis /= np.linalg.norm(axis)
        where = [self.between(-0.8, 0.8), self.between(-0.6, 0.6), self.between(1.4, 2.5)]
        return T().translate(where).rotate(axis.tolist(), self.between(0.0, 180.0))

    def mesh(self) -> dict[str, Any]:
        ball = trimesh.creation.icosphere(subdivisions=self.one_of(1, 2, 3), radius=self.between(0.2, 0.45))
        rough = 1.0 + self.one_of(0.0, 0.1, 0.3) * self.rng.standard_normal((len(ball.vertices), 1))
        file = self.folder / f"{self.rng.integers(1 << 40)}.ply"
        smooth = self.often(0.5)
        trimesh.Trimesh(ball.vertices * rough, ball.faces, process=False).export(file, vertex_normal=smooth)
        return {"type": "ply", "filename": str(file), "face_normals": self.often(0.4)}

    def shape(self) -> dict[str, Any]:
        size, kind = (
            self.between(0.15, 0.5),
            self.one_of("sphere", "cylinder", "disk", "rectangle", "cube", "ply"),
        )
        sides = [size, size * self.between(0.3, 1.5), size * self.between(0.3, 1.5)]
        found: dict[str, Any] = {"type": kind, "to_world": self.place().scale(size)}
        if kind in ("rectangle", "cube"):
            found["to_world"] = self.place().scale(sides)
        elif kind == "ply":
            found = {**self.mesh(), "to_world": self.place()}
        if self.often(0.15):
            found["flip_normals"] = True
        if self.often(0.12):
            found["emitter"] = {"type": "area", "radiance": {"type": "rgb", "value": self.between(0.5, 3.0)}}
        return {**found, "bsdf": self.material()}

    def camera(self, size: tuple[int, int]) -> dict[str, Any]:
        names = ("gaussian", "gaussian", "box", "tent", "mitchell", "catmullrom")
        film = {"type": "hdrfilm", "width": size[0], "height": size[1]}
        film |= {"pixel_format": self.one_of("rgb", "rgba", "luminance"), "component_format": "float32"}
        eye = [self.between(-0.3, 0.3) for _ in range(3)]
        target = [self.between(-0.4, 0.4), self.between(-0.4, 0.4), 2.5]
        towards = T().look_at(eye, target, [self.between(-0.4, 0.4), 1.0, 0.0])
        found = {"type": "perspective", "fov": self.between(25.0, 90.0), "to_world": towards}
        found["fov_axis"] = self.one_of("x", "y", "diagonal", "smaller", "larger")
        if self.often(0.25):
            found["near_clip"] = self.between(0.3, 1.8)
        if self.often(0.25):
            found["far_clip"] = self.between(2.0, 4.5)
        if self.often(0.15):
            found |= {"type": "thinlens", "aperture_radius": self.between(0.01, 0.1)}
            found["focus_distance"] = self.between(1.0, 3.0)
        elif self.often(0.3):
            found |= {f"principal_point_offset_{axis}": self.between(-0.2, 0.2) for axis in "xy"}
        return {**found, "film": {**film, "filter": {"type": self.one_of(*names)}}}

    def lamp(self) -> dict[str, Any]:
        down = T().translate([0.5, 1.6, 1.0]).rotate([1, 0, 0], 90).scale(0.5)
        aimed = T().look_at([0.5, 0.8, -0.5], [0, 0, 3], [0, 1, 0])
        turned = T().rotate([0, 1, 0], self.between(0.0, 360.0))
        bright = {"type": "area", "radiance": {"type": "rgb", "value": 6.0}}
        return self.one_of(
            {"type": "point", "position": [0.8, 1.2, -0.5], "intensity": {"type": "rgb", "value": 8.0}},
            {"type": "constant", "radiance": {"type": "rgb", "value": 0.7}},
            {"type": "envmap", "bitmap": self.bitmap(8, 0.1, 2.0), "to_world": turned},
            {"type": "rectangle", "to_world": down, "emitter": bright},
            {"type": "spot", "to_world": aimed, "intensity": {"type": "rgb", "value": 15.0}},
            {"type": "directional", "direction": [-0.3, -0.4, 1.0]},
        )

    def scene(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """A scene, and how it is measured."""
        size = self.one_of(*SIZES)
        traced = {"type": self.one_of("path", "path", "direct", "volpath", "prb")}
        if traced["type"] != "direct":
            traced["max_depth"] = self.one_of(2, 3, 4)
        if self.often(0.25):
            traced["hide_emitters"] = True
        found = {"type": "scene", "integrator": traced, "sensor": self.camera(size), "lamp": self.lamp()}
        if self.often(0.75):
            turned = T().translate([0, 0, 3]).rotate([0, 1, 0], 180 + self.between(-25.0, 25.0))
            wall = {"type": "twosided", "inner": self.material(plain=True)}
            placed = turned.scale(self.one_of(2.0, 6.0))
            found["wall"] = {"type": "rectangle", "to_world": placed, "bsdf": wall}
        found |= {f"shape{k}": self.shape() for k in range(self.rng.integers(4))}
        if self.often(0.15):
            cube = {"type": "cube", "to_world": T().scale(0.2), "bsdf": self.material()}
            ball = {"type": "sphere", "center": [0.3, 0.0, 0.0], "radius": 0.15, "bsdf": self.material()}
            found["group"] = {"type": "shapegroup", "cube": cube, "ball": ball}
            same = {"type": "ref", "id": "group"}
            for k in range(2):
                found[f"instance{k}"] = {"type": "instance", "to_world": self.place(), "same": same}
        return found, self.options(size, found["sensor"])

    def options(self, size: tuple[int, int], sensor: dict[str, Any]) -> dict[str, Any]:
        found: dict[str, Any] = {}
        middle, focal = (0.5 * size[0] + self.between(-2.0, 2.0), 0.5 * size[1]), self.between(0.6, 1.4)
        if self.often(0.3) and sensor["type"] == "perspective":
            for axis in "xy":
                sensor.pop(f"principal_point_offset_{axis}", None)
            pinched = (self.between(-0.15, 0.15), 0.02, self.between(-3e-3, 3e-3), *[0.0] * 5)
            model, numbers = self.one_of(("opencv", pinched), ("fisheye", FISHEYE))
            pixels = focal * max(size)
            found["camera"] = Intrinsics(size, (pixels, 1.03 * pixels), middle, model, numbers)
        if self.often(0.2):
            found["measure"] = self.one_of("depth", "rgbd")
        elif self.often(0.2):
            found["channels"] = self.one_of("luminance", "red")
        return found


def compared(seed: int, spp: int, step: float | None, folder: Path) -> dict[str, Any]:
    """Flow and finite differences of a seed's scene."""
    scene, options = Maker(seed, folder).scene()
    noise = None if options.get("measure") == "depth" else SIGMA
    given = {**options, "spp": spp, "batches": BATCHES}
    flow = pose_bound(scene, noise, seed=2 * seed, **given)
    method = "finite_difference"
    other = pose_bound(scene, noise, seed=2 * seed + 1, method=method, step_pixels=step, **given)
    if not np.diagonal(other.information.matrix).max() > 0.0:
        return {"verdict": "nothing", "says": "is seen"}
    return beside(flow, other)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("first", type=int)
    parser.add_argument("end", type=int)
    parser.add_argument("--spp", type=int, default=512)
    parser.add_argument("--step-pixels", type=float, default=None, help="of finite differences")
    arguments = parser.parse_args()
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(arguments.first, arguments.end):
            compare = functools.partial(compared, seed, arguments.spp, arguments.step_pixels, Path(folder))
            result = answered(compare)
            counts[result["verdict"]] += 1
            print(f"{seed}: {line(result)}", flush=True)
    print(", ".join(f"{number} {verdict}" for verdict, number in counts.most_common()))


if __name__ == "__main__":
    main()
