"""The pixels of many photographs: their central rays and what they show, held so that any can be drawn."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera, Intrinsics
from ..datasets.photographs import Capture, Photograph
from ..datasets.pictures import averaged
from ..errors import CameraError, CaptureError
from .field import Viewpoint
from .scene_space import SceneSpace

LONGEST = 480
"""Photographs of longer sides are halved until they are not, unless a size is asked for [pixel]."""
_BYTES = 5
"""Per pixel of a photograph."""


@dataclass(frozen=True, eq=False)
class Rays:
    """Some pixels."""

    origins: NDArray[np.float32]
    """(n, 3) [scale of the scene]."""
    directions: NDArray[np.float32]
    """(n, 3), unit, in the world."""
    colours: NDArray[np.float32]
    """(n, 3) [display-referred]."""
    opacity: NDArray[np.float32]
    """(n,) 0 where the photograph shows what is behind everything."""


@dataclass(frozen=True, eq=False)
class Pool:
    """All pixels of some photographs."""

    viewpoints: tuple[Viewpoint, ...]
    """Of the photographs, in their order."""
    values: NDArray[np.uint8]
    """(n, 4) red, green, blue, opacity of all pixels, a photograph after the other, by rows."""
    usable: NDArray[np.int64]
    """Which of them are not masked."""
    starts: NDArray[np.int64]
    """(photographs + 1,) where each begins."""
    camera: NDArray[np.int64]
    """(photographs,) which of `directions` is its own."""
    directions: tuple[NDArray[np.float32], ...]
    """Of different cameras: (pixels, 3), unit, in the camera's frame."""
    space: SceneSpace

    @staticmethod
    def of(photographs: Sequence[Photograph], space: SceneSpace, size: tuple[int, int] | None) -> Pool:
        """Read photographs, in the size asked for.

        Raises:
            CaptureError: an image cannot be read, is of another size than its camera's, or memory is short.
            CameraError: an image is of another shape than the size, or a lens cannot be used.
        """
        cameras = [_sized(photograph, size) for photograph in photographs]
        counts = [camera.size[0] * camera.size[1] for camera in cameras]
        _check_memory(sum(counts))
        different = list(dict.fromkeys(cameras))
        starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        values = np.empty((starts[-1], 4), dtype=np.uint8)
        masked = np.zeros(starts[-1], dtype=np.bool_)
        for k, (photograph, camera) in enumerate(zip(photographs, cameras, strict=True)):
            part = slice(starts[k], starts[k + 1])
            values[part], masked[part] = _read(photograph, camera.size)
        return Pool(
            tuple(Viewpoint(p.name, c, p.pose) for p, c in zip(photographs, cameras, strict=True)),
            values,
            np.flatnonzero(~masked),
            starts,
            np.array([different.index(camera) for camera in cameras], dtype=np.int64),
            tuple(_directions(camera) for camera in different),
            space,
        )

    @property
    def digest(self) -> str:
        """Of everything that training on them depends on."""
        found = hashlib.sha256(self.values.tobytes())
        for viewpoint in self.viewpoints:
            found.update(viewpoint.pose.tobytes())
            found.update(repr(viewpoint.intrinsics).encode())
        return found.hexdigest()[:16]

    @property
    def opaque(self) -> bool:
        """Whether nothing is seen through."""
        return bool((self.values[self.usable, 3] == 255).all())

    def draw(self, rng: np.random.Generator, count: int) -> Rays:
        """Some pixels by chance."""
        return self.rays(self.usable[rng.integers(len(self.usable), size=count)])

    def rays(self, index: NDArray[np.int64]) -> Rays:
        """Some pixels by their numbers."""
        view = np.searchsorted(self.starts, index, side="right") - 1
        within = index - self.starts[view]
        local = np.empty((len(index), 3), dtype=np.float32)
        for k, table in enumerate(self.directions):
            here = self.camera[view] == k
            local[here] = table[within[here]]
        poses = np.array([viewpoint.pose for viewpoint in self.viewpoints])
        turns = poses[:, :3, :3].astype(np.float32)
        origins = self.space.normalised(poses[:, :3, 3]).astype(np.float32)
        values = self.values[index].astype(np.float32) / np.float32(255.0)
        directions = np.einsum("nij,nj->ni", turns[view], local)
        return Rays(origins[view], directions, values[:, :3], values[:, 3])


def _sized(photograph: Photograph, size: tuple[int, int] | None) -> Intrinsics:
    camera = photograph.intrinsics
    if size is None:
        across, down = camera.size
        while max(across, down) > LONGEST:
            across, down = (across + 1) // 2, (down + 1) // 2
        size = across, down
    try:
        return camera.scaled(size)
    except CameraError as error:
        raise CameraError(f"{photograph.image}: {error}") from None


def _read(photograph: Photograph, size: tuple[int, int]) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Values (n, 4) in this size, and which pixels a mask hides (n,)."""
    colours = photograph.colours()
    alpha = replace(photograph, mask=None).opacity()
    kept = photograph.opacity() >= 0.5 * alpha  # everything, without a mask
    alpha_small = averaged(alpha, size).astype(np.float32)
    premultiplied = [averaged(colours[:, :, k] * alpha, size).astype(np.float32) for k in range(3)]
    over = np.maximum(alpha_small, 1e-6)
    values = np.stack([*(part / over for part in premultiplied), alpha_small], axis=-1)
    rounded = np.clip(np.rint(values * 255.0), 0.0, 255.0).astype(np.uint8)
    hidden = averaged(kept, size) < 0.5
    return rounded.reshape(-1, 4), hidden.ravel()


def _directions(intrinsics: Intrinsics) -> NDArray[np.float32]:
    """(pixels, 3) unit, by rows of the image."""
    width, height = intrinsics.size
    down, across = np.indices((height, width), dtype=np.float64) + 0.5
    d = Camera.of(intrinsics).directions(np.stack([across.ravel(), down.ravel()], axis=1))
    return np.asarray(d / np.linalg.norm(d, axis=1, keepdims=True), dtype=np.float32)


def _check_memory(pixels: int) -> None:
    """Refuses more pixels than half of the machine's memory holds."""
    if not hasattr(os, "sysconf"):
        return
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if pixels * _BYTES > memory // 2:
        raise CaptureError(
            f"{pixels / 1e6:.0f} million pixels do not fit into this machine's memory of {memory >> 30} GB: "
            "choose a smaller --size"
        )


def pools(capture: Capture, size: tuple[int, int] | None) -> tuple[Pool, Pool | None]:
    """What a capture's scene may be trained on, and what is held out; None if nothing is.

    Raises:
        CaptureError: there is nothing to train on.
    """
    if not len(capture.train):
        raise CaptureError(
            f"of {len(capture)} photographs {len(capture.test)} are held out ({capture.split}), which leaves "
            "none to train on; give a capture of more photographs"
        )
    space = SceneSpace.around(np.array([p.pose for p in capture.photographs]))
    train = Pool.of([capture.photographs[k] for k in capture.train], space, size)
    if not len(train.usable):
        raise CaptureError("masks hide all pixels of the photographs to train on; see to the masks")
    held = Pool.of([capture.photographs[k] for k in capture.test], space, size) if capture.test else None
    if not train.opaque:
        space = replace(space, scale=space.scale * _reach(train))
        train, held = replace(train, space=space), held and replace(held, space=space)
    return train, held


def _reach(pool: Pool) -> float:
    """How far from the centre what is not transparent may be: rays that see something pass no farther."""
    full = pool.usable[pool.values[pool.usable, 3] > 127]
    reach = 0.0
    for part in np.array_split(full, 1 + len(full) // 2**20):
        rays = pool.rays(part)
        across = np.cross(rays.origins, rays.directions)
        reach = max(reach, float(np.linalg.norm(across, axis=1).max(initial=0.0)))
    return 1.05 * min(reach, 1.0) or 1.0
