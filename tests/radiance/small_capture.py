"""A capture that is made in an instant: a coloured cloud before a striped sky, as PNG and transforms.json."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

Floats = NDArray[np.float64]

SIZE = (24, 24)
FOCAL = 30.0
_GL = np.diag([-1.0, 1.0, -1.0, 1.0])


def poses(count: int) -> Floats:
    """Cameras on an arc, 3 from the cloud, looking at it; x left, y up, z forward.

    Of an odd number of them the first and the ninth, which are held out, are not at its ends.
    """
    found = []
    for k in range(count):
        along = (2 * k + 3) % count / max(1, count - 1)
        angle, height = 1.2 * (along - 0.5), 0.4 * np.sin(7.0 * along)
        centre = 3.0 * np.array(
            [np.sin(angle) * np.cos(height), np.sin(height), -np.cos(angle) * np.cos(height)]
        )
        forward = -centre / 3.0
        left = np.cross([0.0, 1.0, 0.0], forward)
        left /= np.linalg.norm(left)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([left, np.cross(forward, left), forward], axis=1)
        pose[:3, 3] = centre
        found.append(pose)
    return np.array(found)


def shown(pose: Floats) -> tuple[Floats, Floats]:
    """Colours (H, W, 3) without the sky, and opacity (H, W), of the cloud."""
    width, height = SIZE
    down, across = np.indices((height, width)) + 0.5
    d = np.stack([-(across - width / 2) / FOCAL, -(down - height / 2) / FOCAL, np.ones_like(down)], axis=-1)
    d = (d / np.linalg.norm(d, axis=-1, keepdims=True)) @ pose[:3, :3].T
    t = np.linspace(1.5, 4.5, 96)
    x = pose[:3, 3] + d[..., None, :] * t[:, None]
    sigma = 20.0 / (1.0 + np.exp(24.0 * ((x**2).sum(axis=-1) ** 0.5 - 0.6)))
    colour = 0.5 + 0.4 * np.sin(4.0 * x + np.array([0.0, 1.0, 2.0]))
    tau = np.cumsum(sigma, axis=-1) * (t[1] - t[0])
    through = np.exp(-np.concatenate([np.zeros_like(tau[..., :1]), tau], axis=-1))
    w = through[..., :-1] - through[..., 1:]
    return (w[..., None] * colour).sum(axis=-2), 1.0 - through[..., -1]


def write_capture(folder: Path, count: int = 9, *, transparent: bool = False) -> Path:
    """The folder of a capture of `count` photographs; the sky is grey, or is not in the images' alpha."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for k, pose in enumerate(poses(count)):
        colours, opacity = shown(pose)
        image = colours + (1.0 - opacity[..., None]) * 0.4
        if transparent:
            straight = colours / np.maximum(opacity, 1e-6)[..., None]
            image = np.concatenate([straight, opacity[..., None]], axis=-1)
        Image.fromarray(np.rint(255.0 * np.clip(image, 0.0, 1.0)).astype(np.uint8)).save(
            folder / "images" / f"{k}.png"
        )
        frames.append({"file_path": f"images/{k}.png", "transform_matrix": (pose @ _GL).tolist()})
    document = {"fl_x": FOCAL, "w": SIZE[0], "h": SIZE[1], "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(document))
    return folder
