"""Small scenes as dictionaries, so that a test says what is in its picture."""

from __future__ import annotations

from typing import Any

import numpy as np

from mitsuba_crb.render.backend import use_mitsuba

use_mitsuba()

import mitsuba as mi  # noqa: E402  the variant comes first

T = mi.ScalarTransform4f


def camera(
    width: int = 32,
    height: int = 24,
    *,
    origin: Any = (0, 0, 0),
    target: Any = (0.1, 0.2, 3),
    fov: float = 45,
) -> dict[str, Any]:
    """A perspective camera that looks along z."""
    return {
        "type": "perspective",
        "id": "camera",
        "fov": fov,
        "to_world": T().look_at(list(origin), list(target), [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": width, "height": height, "pixel_format": "rgb"},
    }


def texture(seed: int = 0, cells: int = 32, filter_type: str = "bilinear") -> dict[str, Any]:
    """A random bitmap."""
    values = np.random.default_rng(seed).uniform(0.1, 0.9, (cells, cells, 3)).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True, "filter_type": filter_type}


def wall(reflectance: Any = None, *, depth: float = 3.0, half: float = 6.0) -> dict[str, Any]:
    """A square wall that faces the camera and fills its view."""
    return {
        "type": "rectangle",
        "to_world": T().translate([0, 0, depth]).scale(half).rotate([0, 1, 0], 180),
        "bsdf": {"type": "diffuse", "reflectance": reflectance or {"type": "rgb", "value": 0.5}},
    }


def scene(*, sensor: Any = None, **objects: Any) -> dict[str, Any]:
    """A scene of some objects under a constant light."""
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "light": {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}},
        "camera": sensor or camera(),
        **objects,
    }


def textured_wall(**options: Any) -> dict[str, Any]:
    """The smooth scene: everything is visible, and every method is right."""
    return scene(wall=wall(texture()), **options)


def torn_wall() -> Any:
    """The textured wall with a band of its texture that is not a number."""
    torn = mi.load_dict(textured_wall())
    params = mi.traverse(torn)
    (name,) = (name for name, _ in params if name.endswith("reflectance.data"))
    values = np.array(params[name])
    values[:, 17:19] = np.nan
    params[name] = mi.TensorXf(values)
    params.update()
    return torn
