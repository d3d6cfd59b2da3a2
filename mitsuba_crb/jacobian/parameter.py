"""The image's derivative in a scene parameter, by its name in `mi.traverse`.

    θ(t) = θ + t d                                      numbers, d one of the entries, or θ: all scaled
    to_world(t) = shift(c) exp(t ξ) shift(−c) to_world  a placement, c its origin

Forward mode differentiates the radiance of each camera path, and so misses what moves edges; central
differences of renders with common random numbers miss nothing. Source: design sections 4.2, 4.3 and 5.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..render.pixels import render_pixels, sensed
from ..render.rays import opaque_transform
from ..render.recorded import Recorder
from .forward import MAX_LANES, camera_paths, per_batch, per_path
from .method import Paths

if TYPE_CHECKING:
    import mitsuba as mi

    from ..render.view import View

Floats = NDArray[np.float64]
Pixels = NDArray[np.int64]

STEP_PIXELS = 0.15
"""Image motion of a step of what moves the image [pixel]."""


@dataclass(frozen=True)
class SceneParameter:
    """One parameter of a scene, and how the image is differentiated in it."""

    parameters: mi.SceneParameters
    key: str
    value: Any
    """As it was."""
    directions: tuple[Floats, ...]
    """d of each column, shaped like `value`; of a placement, twists (6,)."""
    steps: tuple[float, ...]
    """Of each column's finite difference, in units of t."""
    forward: bool = False
    """By forward mode; otherwise by finite differences."""

    @property
    def how(self) -> str:
        """In words, for provenance."""
        if self.forward:
            return "forward mode"
        return f"finite differences, step {', '.join(f'{step:.3g}' for step in dict.fromkeys(self.steps))}"

    def columns(self, view: View, pixels: Pixels, paths: Paths) -> Floats:
        """(batches, n, 3, q) ∂I/∂t [radiance per unit of t]."""
        column = self._forward if self.forward else self._difference
        return np.stack([column(view, pixels, k, paths) for k in range(len(self.directions))], axis=-1)

    def _difference(self, view: View, pixels: Pixels, k: int, paths: Paths) -> Floats:
        images = []
        for t in (self.steps[k], -self.steps[k]):
            with self.at(k, t):
                moved = replace(view, recorder=Recorder(None))
                spp = paths.spp // paths.batches
                images.append(render_pixels(moved, pixels, spp=spp, seed=paths.seed, batches=paths.batches))
        return np.asarray((images[0] - images[1]) / (2.0 * self.steps[k]))

    def _forward(self, view: View, pixels: Pixels, k: int, paths: Paths) -> Floats:
        count = max(1, MAX_LANES // paths.spp)
        parts = [
            per_batch(self._paths(view, pixels[start : start + count], k, paths), paths.batches)
            for start in range(0, len(pixels), count)
        ]
        return np.concatenate(parts, axis=1)

    def _paths(self, view: View, pixels: Pixels, k: int, paths: Paths) -> Floats:
        """∂L/∂t of every path (n, spp, 3), a lane each as in `forward`."""
        import mitsuba as mi

        sampler, ray, weight = camera_paths(view, pixels, paths.spp, paths.seed)
        transform = opaque_transform(view.pose)
        t = mi.Float(0.0)
        dr.enable_grad(t)
        # Evaluated loops: a symbolic one cannot be differentiated in what its body reads from outside.
        with self.at(k, t), dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, False):
            value = weight * sensed(view, sampler, ray, transform)
            dr.forward_from(t)
            return per_path(dr.grad(value), paths.spp)

    def _moved(self, k: int, t: Any) -> Any:
        """The parameter at t along direction k; t may be attached, but for a placement."""
        import mitsuba as mi

        kind, direction = type(self.value), self.directions[k]
        if is_placement(self.value):
            matrix = np.array(self.value.matrix, dtype=np.float64).reshape(4, 4)
            centre = np.eye(4)
            centre[:3, 3] = matrix[:3, 3]
            motion = centre @ se3.exp(t * direction) @ np.linalg.inv(centre)
            return kind(mi.Matrix4f((motion @ matrix).astype(np.float32)))
        base, along = np.array(self.value, dtype=np.float32), direction.astype(np.float32)
        if isinstance(self.value, mi.TensorXf):
            return kind(mi.Float(base.ravel()) + t * mi.Float(along.ravel()), base.shape)
        return kind(base) + t * kind(along)

    @contextlib.contextmanager
    def at(self, k: int, t: Any) -> Iterator[None]:
        """The scene with the parameter at t along direction k; as it was afterwards."""
        try:
            self._set(self._moved(k, t))
            yield
        finally:
            self._set(type(self.value)(self.value))

    def _set(self, value: Any) -> None:
        self.parameters[self.key] = value
        self.parameters.update()


def is_placement(value: Any) -> bool:
    """Whether a parameter is a transform."""
    import mitsuba as mi

    return isinstance(value, mi.Transform4f | mi.AffineTransform4f)


def motions(view: View, parameters: mi.SceneParameters, key: str, value: Any) -> SceneParameter:
    """The six motions of a placement: along the world's axes [scene unit], about its origin [rad]."""
    depth = view.visible_depth
    shift = STEP_PIXELS * (float(np.median(depth)) if depth.size else 1.0) / view.camera.focal_length
    turn = 2.0 * STEP_PIXELS / max(view.size)
    return SceneParameter(parameters, key, value, tuple(np.eye(6)), (shift,) * 3 + (turn,) * 3)
