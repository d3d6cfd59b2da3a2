"""Symmetric models have their seams exactly on the borders of pixels, where rays slip through them."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from matrices import misfit
from one_go import measured
from small_scenes import T, camera

from mitsuba_crb.jacobian.flow import Flow
from mitsuba_crb.render.view import open_view


def vase() -> mi.Mesh:
    """A closed body of revolution about y, one of whose meridians lies in x = 0 towards the camera."""
    radius = np.array([0.3, 0.5, 0.62, 0.66, 0.6, 0.45, 0.3, 0.26, 0.34])
    around = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    ring = np.stack([np.sin(around), np.zeros(24), -np.cos(around)], axis=1)
    ring[0, 0] = ring[12, 0] = 0.0
    height = np.linspace(-0.8, 0.8, len(radius))
    vertices = np.concatenate([r * ring + [0.0, y, 0.0] for r, y in zip(radius, height, strict=True)])
    vertices = np.concatenate([vertices, [[0.0, -0.8, 0.0], [0.0, 0.8, 0.0]]])
    i, j = (k.ravel() for k in np.meshgrid(np.arange(len(radius) - 1), np.arange(24), indexing="ij"))
    a, b = 24 * i + j, 24 * i + (j + 1) % 24
    k = np.arange(24)
    top, low = 24 * len(radius) - 24, 24 * len(radius)
    faces = np.concatenate(
        [
            np.stack([a, b, b + 24], axis=1),
            np.stack([a, b + 24, a + 24], axis=1),
            np.stack([np.full(24, low), (k + 1) % 24, k], axis=1),
            np.stack([np.full(24, low + 1), top + k, top + (k + 1) % 24], axis=1),
        ]
    )
    props = mi.Properties()
    props["material"] = mi.load_dict({"type": "twosided", "bsdf": {"type": "diffuse"}})
    faces = np.roll(faces, 2, axis=1)  # rays through a seam slip through only with some orders
    made = mi.Mesh("vase", len(vertices), len(faces), props)
    params = mi.traverse(made)
    params["vertex_positions"] = vertices.ravel().astype(np.float32)
    params["faces"] = faces.ravel().astype(np.uint32)
    params.update()
    return made


def information(aside: float, origin: Any, **objects: Any) -> Any:
    """Through a box film with an even number of columns, from a camera that is moved a little to the side."""
    x, y, z = origin
    sensor = camera(16, 24, fov=26)
    sensor["film"]["rfilter"] = {"type": "box"}
    sensor["to_world"] = T().look_at([x + aside, y, z], [x + aside, 0.0, 0.0], [0, 1, 0])
    integrator = {"type": "path", "max_depth": 2}
    described = {"type": "scene", "integrator": integrator, "camera": sensor, **objects}
    with open_view(mi.load_dict(described)) as view:
        pixels = np.stack(np.meshgrid(np.arange(16), np.arange(24)), axis=-1).reshape(-1, 2)
        columns, _ = measured(Flow, view, pixels, spp=512, seed=1, batches=4)
    total = columns.sum(axis=0).reshape(-1, 6)
    return (total.T @ total - sum(b.T @ b for b in columns.reshape(4, -1, 6))) / 12


def test_a_seam_on_a_border_of_pixels_tells_nothing() -> None:
    """The camera a hundredth of a pixel aside sees the same."""
    lamp = {"type": "point", "position": [1.5, 3.0, -4.0], "intensity": {"type": "rgb", "value": 50.0}}
    on, aside = (information(x, (0.0, 2.5, -4.5), lamp=lamp, vase=vase()) for x in (0.0, 1e-3))
    assert misfit(on, aside) < 0.05


@pytest.mark.slow
def test_a_silhouette_on_a_border_of_pixels_counts_in_one_of_them() -> None:
    board = {
        "type": "rectangle",
        "to_world": T().translate([0.5, 0.1, 0]).scale([0.5, 0.4, 1]).rotate([0, 1, 0], 180),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 1.0}},
    }
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": 0.2}}
    on, aside = (information(x, (0.0, 0.0, -4.5), sky=sky, board=board) for x in (0.0, 1e-3))
    assert misfit(on, aside) < 0.1
