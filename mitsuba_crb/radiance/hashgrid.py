"""A radiance field that was trained here on photographs: a multiresolution hash grid with a small network.

Its image is a deterministic sum along each pixel's central ray (`march`), display-referred as the photographs
were; its derivative in the camera's motion is that of the same sum, from three gradients at each place and
the direction's. Nothing about a pose is a discrete choice: the places along a ray move with the camera, and
where cells are empty a smooth window has made density 0 (`occupancy`).

Source: Müller et al., "Instant Neural Graphics Primitives", SIGGRAPH 2022.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..errors import FieldError
from ..render.arrays import download, upload, widened
from ..render.backend import use_mitsuba
from .field import Floats, Pixels, Shown, Viewpoint
from .network import Design, Network, Weights
from .occupancy import Cells, Vertices
from .scene_space import SceneSpace

if TYPE_CHECKING:
    import mitsuba as mi

    from ..camera import Camera
    from .march import Matter

FINER = 2
"""Places along a ray for each that it has in training. Where surfaces are cut moves with the camera: of the
fox, F_ii on ρz is 1.02 times as large with 1 as with 4, and 1.01 with 2; but 1.75 times with 1 and cells
finer than what a pixel sees."""
_NOTHING = 1e-3
"""Opacity below which nothing is seen that could have a depth."""


@dataclass(frozen=True, eq=False)
class HashGrid:
    """A trained field."""

    label: str
    """Its file, or what it was trained on."""
    design: Design
    space: SceneSpace
    entries: NDArray[np.float32] = field(repr=False)
    """Of the hash grid, all levels."""
    weights: Weights = field(repr=False)
    """Of the network."""
    vertices: Vertices = field(repr=False)
    """Of the occupancy."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Behind everything [display-referred]."""
    viewpoints: tuple[Viewpoint, ...] = ()
    """Cameras of the photographs it was trained on, and of those held out."""
    facts: Mapping[str, Any] = field(default_factory=dict)
    """Of its training, JSON-able."""

    def refuse(self, camera: Camera) -> None:
        """Pinholes and lenses that distort are fine.

        Raises:
            FieldError: the camera has an aperture.
        """
        if camera.radius > 0.0:
            raise FieldError(
                f"a hash grid is seen through a pinhole, and this camera's aperture has the radius "
                f"{camera.radius:.4g}; give a camera without one"
            )

    def show(
        self,
        camera: Camera,
        pose: Floats,
        pixels: Pixels,
        *,
        order: int = 0,
        kept: Floats | None = None,
    ) -> Shown:
        """The image at the centres of some pixels; see `Field`. `kept` is no matter: nothing is chosen."""
        film = np.asarray(pixels, dtype=np.float64) + 0.5
        return self.at(camera, pose, film, order=order)

    def at(self, camera: Camera, pose: Floats, film: Floats, *, order: int = 0) -> Shown:
        """The image at film points (n, 2) [pixel]."""
        import mitsuba as mi

        from .march import look

        if len(film) == 0:
            return Shown(np.zeros((0, 3)), np.zeros(0), np.zeros(0))
        rays = self._rays(camera, pose, film)
        total, distance, through = look(
            self._matter(order), rays.origin, rays.ahead, rays.direction, self._behind(), order == 1
        )
        dr.eval(total, distance, through)  # at once: each for itself would march again
        values, (far, clear) = download(total).T[: len(film)], download(mi.Vector2f(distance, through))
        opacity = 1.0 - clear[: len(film)]
        seen = opacity > _NOTHING
        depth = np.full(len(film), np.nan)
        along = rays.seen[: len(film), 2]
        depth[seen] = (self.space.scale * along * far[: len(film)])[seen] / opacity[seen]
        return Shown(values, depth, opacity)

    def columns(
        self, camera: Camera, pose: Floats, pixels: Pixels, *, order: int = 0
    ) -> tuple[Floats, Floats]:
        """Values and their derivatives in the camera frame; see `Field`."""
        import mitsuba as mi

        from .march import look_and_differentiate

        if len(pixels) == 0:
            return np.zeros((0, 3)), np.zeros((0, 3, 6))
        count = len(pixels)
        rays = self._rays(camera, pose, np.asarray(pixels, dtype=np.float64) + 0.5)
        turn = np.asarray(pose, dtype=np.float64)[:3, :3]
        total, slopes = look_and_differentiate(
            self._matter(order),
            rays.origin,
            rays.ahead,
            rays.direction,
            mi.Vector3f(*(upload(mi.Float, rays.seen[:, k]) for k in range(3))),
            _opaque_matrix(turn.T),
            self._behind(),
            order == 1,
        )
        dr.eval(total, slopes)  # at once, as above
        values = download(total).T[:count]
        found = [np.concatenate([download(motion) / self.space.scale, download(by)]) for motion, by in slopes]
        return values, np.stack(found).transpose(2, 0, 1)[:count]

    def provenance(self) -> Mapping[str, Any]:
        """Its training and design."""
        return {
            "kind": "hash grid",
            "design": asdict(self.design),
            "background": list(self.background),
            "training": dict(self.facts),
        }

    def _rays(self, camera: Camera, pose: Floats, film: Floats) -> _Rays:
        import mitsuba as mi

        self.refuse(camera)
        use_mitsuba()
        pose = np.asarray(pose, dtype=np.float64)
        seen = widened(camera.directions(film))
        seen = seen / np.linalg.norm(seen, axis=1, keepdims=True)
        d = seen @ pose[:3, :3].T
        o = self.space.normalised(pose[:3, 3])
        return _Rays(
            _opaque_vector(o),
            mi.Vector3f(*(upload(mi.Float, column) for column in (o + d).T)),
            mi.Vector3f(*(upload(mi.Float, column) for column in d.T)),
            seen,
        )

    def _behind(self) -> mi.Color3f:
        import mitsuba as mi

        return mi.Color3f(_opaque_vector(np.asarray(self.background)))

    def _matter(self, order: int) -> Matter:
        made: dict[int, Matter] = self._made
        if order not in made:
            network = Network(self.design, self._encoding, self.weights, turned=order == 1)
            made[order] = matter_of(self.design, network, Cells(self.vertices), FINER)
        return made[order]

    @functools.cached_property
    def _made(self) -> dict[int, Matter]:
        """By order, once it is needed."""
        return {}

    @functools.cached_property
    def _encoding(self) -> Any:
        import mitsuba as mi

        use_mitsuba()
        encoding = self.design.encoding(0)
        encoding.set_params(upload(mi.Float, self.entries))
        return encoding


@dataclass(frozen=True, eq=False)
class _Rays:
    """Central rays of film points."""

    origin: mi.Vector3f
    """[scale of the scene]."""
    ahead: mi.Vector3f
    """Origin + direction."""
    direction: mi.Vector3f
    seen: Floats
    """(n, 3) the direction in the camera's frame."""


def matter_of(design: Design, network: Network, cells: Cells, finer: int = 1) -> Matter:
    """What rays march through, in a field of this design, at so many times as many places as in training."""
    import mitsuba as mi

    from .march import Matter

    ratio = design.ratio(finer)
    places = design.near * ratio ** (np.arange(finer * design.steps) + 0.5)
    width = ratio**0.5 - ratio**-0.5
    return Matter(network, cells, upload(mi.Float, places), mi.Float(_opaque(width)))


def _opaque(value: float) -> Any:
    import mitsuba as mi

    return dr.opaque(mi.Float, float(value))


def _opaque_vector(values: Floats) -> mi.Vector3f:
    import mitsuba as mi

    return mi.Vector3f(*(_opaque(value) for value in values))


def _opaque_matrix(values: Floats) -> mi.Matrix3f:
    import mitsuba as mi

    return mi.Matrix3f(*(_opaque(value) for value in values.ravel()))
