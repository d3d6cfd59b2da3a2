"""The material form of the image's derivative in the pose: follow what the rays hit, not the film.

A surface point p with geometric normal n, seen from the lens point a (camera frame; 0 for a pinhole), has the
film point v = π(q) + const, q = p − a. The twist moves it by ṗ = −ρ − φ×p, that is q̇ = −ρ_a − φ×q with
ρ_a = ρ + φ×a, its image by the flow f = (∂π/∂q) q̇. The film area of a surface element is |n·q|/q_z³ dA and
n·q changes by −n·ρ_a only, hence ∇·f = −(n·ρ_a)/(n·q) − 3 q̇_z/q_z, on the tangent plane as in pixels
(the map between them is affine). Written over material points, I_u = ∫ h(v(ξ)) L (film area) dA, so

    ∂I_u/∂ξ =  ∫ (L − Ī_u) ∇·(h_u f) dv       filter term,  ∇·(h f) = ∇h·f + h ∇·f
             + ∫ h_u (∂L/∂ξ at fixed p) dv      view term
             + parallax term                    at occluding contours (contours.py)

The filter term needs radiance only, not its derivative, so it is exact for edges, textures and shadows of any
kind and for every integrator. Rays that escape see points at infinity, ρ_a = 0. The constant Ī_u (from a
pilot render, the same for all batches) costs no bias: the three terms of L = 1 add up to zero. The pixels of
a block share out their random numbers evenly (`EvenNumbers`), so it is blocks whose errors are independent.
At rims ∇·f grows as 1/√distance: finite mean, no clamping; only where float32 decides how nearly a sphere is
edge-on, its mean there is taken. Participating media and the ellipsoids of radiance
fields have no points to follow: rotation needs none, translation is left to finite differences.

Source: design section 4.1; Zhang et al. 2020, Path-Space Differentiable Rendering, for the material form.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Self

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..errors import SensorError
from ..information.blocks import BLOCK
from ..render.paths import IntegratorTracer, PathTracer, tracer
from ..render.random import EVEN, EvenNumbers, lane_sampler, seeding
from ..render.rays import Lanes, camera_ray, opaque_transform
from ..render.recorded import join, split
from . import finite_difference, lint
from .contours import Contours, ParallaxTerm, find_contours
from .film_flow import FilmFlow
from .method import Estimates, Paths
from .pair_sums import sum_pairs
from .pairs import BoxPairs, SmoothPairs, filter_pairs
from .pilot import Pilot
from .view_term import ViewTerm

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    import mitsuba as mi

    from ..render.view import View

_DIMENSIONS = (4, 4)
"""What `EvenNumbers` are for: film offset and emitter, whose products are what edges of shadows show; and
direction at the first surface and lens point."""
_TRACED = ("pairs", "view_term", "tracer", "transform", "focal", "film_flows")
"""What the kernel reads of `Prepared`."""


@dataclass(frozen=True)
class Prepared:
    """What all tiles of one view share."""

    pairs: SmoothPairs | BoxPairs
    view_term: ViewTerm | None
    contours: Contours | NDArray[np.float64]
    """Of the surfaces; or, where the integrator sees volumes, the steps (6,) of finite differences."""
    tracer: PathTracer | IntegratorTracer
    transform: mi.Transform4f
    """World from camera."""
    focal: mi.Vector2f
    """d(film point)/d(q_x/q_z, q_y/q_z), the focal lengths with their signs [pixel]."""
    film_flows: tuple[FilmFlow, ...] = ()
    """Of parameters that act on the film alone; each adds a column after the twist's six."""


def prepare(view: View, film_flows: tuple[FilmFlow, ...] = ()) -> Prepared:
    """Tables of the filter, materials that need a view term, and contours.

    Args:
        film_flows: of parameters that act on the film alone, each for a further column.

    Raises:
        FilmError: the reconstruction filter is not known.
        SensorError: a thin lens among participating media or radiance fields.

    Warns:
        BlindSpotWarning: by name, of shapes whose contours are not known.
    """
    camera_paths = tracer(view)
    volumes = _sees_volumes(view, camera_paths)
    if volumes and view.sensor.needs_aperture_sample():
        raise SensorError(
            "a thin lens among participating media or radiance fields shows method 'flow' no surface points "
            "to follow: use method finite_difference, or a perspective sensor"
        )
    # First, because the others wait for what runs in the background.
    contours = finite_difference.steps_of(view) if volumes else find_contours(view)
    return Prepared(
        filter_pairs(view.pixel_filter),
        None if volumes else ViewTerm.of(view, camera_paths),
        contours,
        camera_paths,
        opaque_transform(view.pose),
        _film_slope(view),
        film_flows,
    )


def _sees_volumes(view: View, camera_paths: PathTracer | IntegratorTracer) -> bool:
    """Whether radiance may come from what is no surface; `path` and its like pass media by."""
    volumes = any(
        shape.is_medium_transition() or shape.class_name() in ("Ellipsoids", "EllipsoidsMesh")
        for shape in view.scene.shapes()
    )
    inside = view.sensor.get_medium() is not None
    return isinstance(camera_paths, IntegratorTracer) and (inside or volumes)


def _film_slope(view: View) -> mi.Vector2f:
    """d(film point)/d(q_x/q_z, q_y/q_z) [pixel], as the sensor's rays through the film's corners have it."""
    import mitsuba as mi

    size = np.array(view.size, dtype=np.float64)
    film = mi.Point2f(*([0.0, side] for side in view.size))
    ray, _ = camera_ray(view, film, mi.Point2f(0.5, 0.5))
    tangent = np.array([ray.d.x / ray.d.z, ray.d.y / ray.d.z], dtype=np.float64)
    slope = size / (tangent[:, 1] - tangent[:, 0])
    return mi.Vector2f(*(dr.opaque(mi.Float, float(value)) for value in slope))


class Flow:
    """The method, open for one view.

    Paths come in pairs, alternately along x and y, and share their random numbers out best by powers of two:
    4, 8, 16, … per batch. An odd last path of a batch is not traced, a batch of one path traces two. Where
    the integrator sees volumes, translation traces six times as many besides.
    """

    name: ClassVar[str] = "flow"
    follows_film: ClassVar[bool] = True
    steps_image: ClassVar[bool] = False
    block = BLOCK

    def __init__(
        self, view: View, mask: NDArray[np.bool_], paths: Paths, film_flows: tuple[FilmFlow, ...] = ()
    ) -> None:
        """See `open`."""
        self.view, self.paths = view, paths
        self._mask = mask
        self.prepared = prepare(view, film_flows)

    @classmethod
    def open(
        cls,
        view: View,
        mask: NDArray[np.bool_],
        paths: Paths,
        *,
        step_pixels: float,
        film_flows: tuple[FilmFlow, ...] = (),
    ) -> Self:
        """See `Method.open`; errors and warnings as `prepare`."""
        return cls(view, mask, paths, film_flows)

    @classmethod
    def limits(cls, view: View) -> Iterator[str]:
        """See `Method.limits`."""
        return lint.cut_surfaces(view, cls.name)

    @functools.cached_property
    def pilot(self) -> Pilot:
        """Ī_u of the pixels that will be asked for."""
        return Pilot.of(self.view, self._mask, self.paths.seed)

    def prepare(self, pixels: NDArray[np.int64]) -> FlowTile:
        """See `Method.prepare`."""
        return FlowTile(self, pixels)


class FlowTile:
    """Some pixels on their way, see `method.Tile`."""

    def __init__(self, method: Flow, pixels: NDArray[np.int64]) -> None:
        """Readies their paths."""
        self._method, self._pixels = method, pixels
        self._begin = filter_and_view_terms(method.view, method.prepared, pixels, method.pilot, method.paths)

    @functools.cached_property
    def _baseline(self) -> NDArray[np.float64]:
        """(n, 3) Ī_u; waits for the pilot."""
        return self._method.pilot.values(self._pixels)

    def launch(self) -> None:
        """Start the paths in the background, and those of the contours."""
        view, contours, pixels = self._method.view, self._method.prepared.contours, self._pixels
        paths = self._method.paths
        self._beside: ParallaxTerm | _Differences
        if isinstance(contours, Contours):
            baseline = self._baseline if len(contours.piece) else np.empty((len(pixels), 3))
            self._beside = ParallaxTerm(view, contours, pixels, baseline, paths)
        else:
            self._beside = _Differences(view, contours, pixels, paths)
        columns, image, self._shown = self._begin()
        self._beside.launch()
        self._colors = [*columns, image]

    def wait(self) -> None:
        """Until they are traced."""
        # Shares Dr.Jit's memory, but to look there later would be to wait for the next tile's paths.
        self._traced = [[np.asarray(channel) for channel in color] for color in self._colors]
        shape = (self._method.paths.batches, -1)
        self._sums = np.array([np.asarray(part).reshape(shape).mean(axis=0) for part in self._shown])
        self._beside.wait()

    def result(self) -> Estimates:
        """All terms together."""
        jacobians, images = as_arrays(self._traced, self._method.paths.batches)
        rows, terms = self._beside.result()
        if isinstance(self._beside, _Differences):
            jacobians[..., :3] = 0.0
        jacobians[:, rows, :, : terms.shape[-1]] += terms
        # A few weights of a filter with negative lobes may add up to nothing: then the pilot is what is left.
        shown = self._baseline + (self._sums[:3] / np.maximum(self._sums[3], 0.5)).T
        return Estimates(jacobians, images, shown)


@dataclass
class _Differences:
    """Translation's columns by finite differences, in the place of a `ParallaxTerm`."""

    view: View
    steps: NDArray[np.float64]
    """(6,), of which translation's are taken."""
    pixels: NDArray[np.int64]
    paths: Paths

    def launch(self) -> None:
        """All of the work."""
        self._columns = [
            finite_difference.column(self.view, self.pixels, axis, step, self.paths)[0]
            for axis, step in enumerate(self.steps[:3])
        ]

    def wait(self) -> None:
        """Nothing."""

    def result(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """All pixels, and (batches, n, 3, 3)."""
        return np.arange(len(self.pixels)), np.stack(self._columns, axis=-1)


def filter_and_view_terms(
    view: View,
    prepared: Prepared,
    pixels: NDArray[np.int64],
    pilot: Pilot,
    paths: Paths,
) -> Callable[[], tuple[list[mi.Color3f], mi.Color3f, mi.Vector4f]]:
    """What starts the paths of some pixels in the background, without the contours' part.

    Returns:
        A function that gives the columns, the image, and what `sum_pairs` makes to be shown, of each lane.
    """
    import mitsuba as mi

    pairs = prepared.pairs
    number = max(1, paths.spp // paths.batches // 2)
    # Fewer pairs than kinds: which kinds, a random number decides, and the expected counts are the weights.
    few = number < pairs.kinds
    counts = [
        number / pairs.kinds if few else (number - kind - 1) // pairs.kinds + 1 for kind in range(pairs.kinds)
    ]
    parts = [getattr(prepared, name) for name in _TRACED]
    own, key = split(parts)
    arrays = {
        "lanes": tuple(Lanes.of(view, pixels, paths.batches)),
        "seeds": [seeding(paths.seed), seeding(paths.seed, EVEN)],
        "pilot": pilot.arrays,
        "counts": [dr.opaque(mi.Float, count) for count in counts],
        "number": dr.opaque(mi.UInt32, number),
        "starts": dr.opaque(mi.UInt32, pairs.kinds if few else 1),
        "most": dr.opaque(mi.Float, np.sqrt(2 * number * paths.batches) / (2 * number)),
        "parts": own,
    }

    def body(arrays: dict[str, Any]) -> tuple[list[mi.Color3f], mi.Color3f, mi.Vector4f]:
        lanes = Lanes(*arrays["lanes"])
        seeds, even_seeds = arrays["seeds"]
        given = dict(zip(_TRACED, join(parts, iter(arrays["parts"])), strict=True))
        columns, image, shown = sum_pairs(
            view,
            replace(prepared, **given),
            lane_sampler(lanes.pixel, lanes.batch, seeds),
            EvenNumbers.of(lanes, even_seeds, _DIMENSIONS),
            lanes.centre,
            pilot.baseline(arrays["pilot"], lanes),
            arrays["counts"],
            arrays["number"],
            arrays["starts"],
            arrays["most"],
        )
        return columns, image, shown

    own_integrator = isinstance(prepared.tracer, IntegratorTracer)
    return view.recorder.ready("pairs", body, view, arrays, None if own_integrator else key)


def as_arrays(colors: Any, batches: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Columns (batches, n, 3, q) and, of the last color, the image; the pixels' numbers beside each other."""
    values = np.empty((len(colors), 3, batches, len(colors[0][0]) // batches))
    for row, color in zip(values, colors, strict=True):
        for own, channel in zip(row, color, strict=True):
            own[...] = np.asarray(channel).reshape(own.shape)
    return values[:-1].transpose(2, 3, 1, 0), values[-1].transpose(1, 2, 0)
