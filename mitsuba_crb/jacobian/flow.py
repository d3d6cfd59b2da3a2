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
edge-on, its mean there is taken.

Rotation of a pinhole is the filter term's alone and exact in every scene that no clip plane cuts. Translation
is left to finite differences, block by block, where there are no points to follow (participating media, the
ellipsoids of radiance fields) and where the flow of a constant picture does not close (`closure`).

Source: design section 4.1; Zhang et al. 2020, Path-Space Differentiable Rendering, for the material form.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Self

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..information.blocks import BLOCK
from ..render.paths import IntegratorTracer, Tracer, White, tracer
from ..render.random import EVEN, EvenNumbers, derived_seed, lane_sampler, seeding
from ..render.rays import Lanes, camera_ray, first_hits, opaque_transform
from ..render.recorded import join, split
from . import finite_difference
from .clip_planes import cut_speeds
from .closure import BATCHES, PATHS, FilmBlocks, breaches, matters, suspects
from .contours import Contours, ParallaxTerm, find_contours
from .depth_pilot import DepthPilot
from .film_flow import FilmFlow
from .method import Estimates, Paths
from .pair_sums import sum_pairs
from .pairs import BoxPairs, SmoothPairs, film_shift, filter_pairs
from .pilot import Black, Pilot
from .unfollowed import CLIPPED, Unfollowed
from .view_term import DepthTerm, ViewTerm, view_term

if TYPE_CHECKING:
    from collections.abc import Callable

    import mitsuba as mi

    from ..render.view import View

_DIMENSIONS = (4, 4)
"""What `EvenNumbers` are for: film offset and emitter, whose products are what edges of shadows show; and
direction at the first surface and lens point."""
CLOSURE = 0x434C4F53
"""Purpose of the random numbers that decide on closure."""
_TRACED = ("pairs", "view_term", "tracer", "transform", "focal", "film_flows")
"""What the kernel reads of `Prepared`."""


@dataclass(frozen=True)
class Prepared:
    """What all tiles of one view share."""

    pairs: SmoothPairs | BoxPairs
    view_term: ViewTerm | DepthTerm | None
    contours: Contours
    """Of the surfaces."""
    tracer: Tracer | White
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
    """
    camera_paths = tracer(view)
    # First, because the others wait for what runs in the background.
    contours = find_contours(view)
    return Prepared(
        filter_pairs(view.pixel_filter),
        view_term(view, camera_paths),
        contours,
        camera_paths,
        opaque_transform(view.pose),
        _film_slope(view),
        film_flows,
    )


def _film_slope(view: View) -> mi.Vector2f:
    """d(plain film point)/d(q_x/q_z, q_y/q_z) [pixel], as rays through the film's corners have it."""
    import mitsuba as mi

    if view.film_map is None:
        size = np.array(view.size, dtype=np.float64)
        film = mi.Point2f(*([0.0, side] for side in view.size))
        ray, _ = camera_ray(view, film, mi.Point2f(0.5, 0.5))
        tangent = np.array([ray.d.x / ray.d.z, ray.d.y / ray.d.z], dtype=np.float64)
        slope = size / (tangent[:, 1] - tangent[:, 0])
    else:
        slope = -view.camera.focal
    return mi.Vector2f(*(dr.opaque(mi.Float, float(value)) for value in slope))


class Flow:
    """The method, open for one view.

    Paths come in pairs, alternately along x and y, and share their random numbers out best by powers of two:
    4, 8, 16, … per batch. An odd last path of a batch is not traced, a batch of one path traces two. Blocks
    that the flow cannot follow trace six times as many besides, with a thin lens twelve times.
    """

    name: ClassVar[str] = "flow"
    follows_film: ClassVar[bool] = True
    step_pixels: ClassVar[None] = None
    block = BLOCK

    def __init__(
        self, view: View, mask: NDArray[np.bool_], seed: int, film_flows: tuple[FilmFlow, ...] = ()
    ) -> None:
        """See `open`."""
        self.view = view
        self._mask, self._seed = mask, seed
        self.prepared = prepare(view, film_flows)
        self.unfollowed = Unfollowed.of(view, self.prepared.tracer)

    @classmethod
    def open(
        cls,
        view: View,
        mask: NDArray[np.bool_],
        seed: int,
        *,
        step_pixels: float | None,
        film_flows: tuple[FilmFlow, ...] = (),
    ) -> Self:
        """See `Method.open`; errors and warnings as `prepare`."""
        return cls(view, mask, seed, film_flows)

    @classmethod
    def limits(cls, view: View) -> tuple[str, ...]:
        """Nothing: see `Method.limits`."""
        return ()

    def differenced(self, causes: NDArray[np.object_]) -> NDArray[np.int64]:
        """(n,) how many columns, from the first, are left to finite differences at pixels with these causes.

        A pinhole's rotation needs no points to follow, unless a plane turns with the camera.
        """
        whole = np.isin(causes, CLIPPED) | self.view.sensor.needs_aperture_sample()
        return np.where(causes == "", 0, np.where(whole, 6, 3))

    @functools.cached_property
    def _step_pixels(self) -> float:
        return finite_difference.step_for(self.view.pixel_filter)

    @functools.cached_property
    def _cut_speeds(self) -> NDArray[np.float64]:
        return cut_speeds(self.view, np.concatenate([self.unfollowed.near, self.unfollowed.far]))

    @functools.cached_property
    def step_bias(self) -> float:
        """Relative error that their step may leave in the information of finite differences."""
        return finite_difference.edge_bias(self.view.pixel_filter, self._step_pixels)

    def differences(self, pixels: NDArray[np.int64], count: int, paths: Paths) -> NDArray[np.float64]:
        """(batches, n, 3, count) the first columns at pixels (n, 2) by finite differences."""
        depth = first_hits(self.view, pixels)[1]
        cuts = self._cut_speeds if count == 6 else None
        steps = finite_difference.steps_of(self.view, self._step_pixels, depth[np.isfinite(depth)], cuts)
        columns = [
            finite_difference.column(self.view, pixels, axis, step, paths)[0]
            for axis, step in enumerate(steps[:count])
        ]
        return np.stack(columns, axis=-1)

    @functools.cached_property
    def pilot(self) -> Pilot | DepthPilot:
        """Ī_u of the pixels that will be asked for."""
        if self.view.measured.depth is not None:
            return DepthPilot.of(self.view)
        return Pilot.of(self.view, self._mask, self._seed)

    def prepare(self, pixels: NDArray[np.int64], paths: Paths) -> FlowTile:
        """See `Method.prepare`."""
        return FlowTile(self, pixels, paths)


class FlowTile:
    """Some pixels on their way, see `method.Tile`."""

    def __init__(self, method: Flow, pixels: NDArray[np.int64], paths: Paths) -> None:
        """Readies their paths."""
        self._method, self._pixels, self._paths = method, pixels, paths
        self._begin = filter_and_view_terms(method.view, method.prepared, pixels, method.pilot, paths)
        self._blocks = FilmBlocks.of(pixels)

    @functools.cached_property
    def _baseline(self) -> NDArray[np.float64]:
        """(n, 3) Ī_u; waits for the pilot."""
        return self._method.pilot.values(self._pixels)

    def launch(self) -> None:
        """Start the paths in the background, and those of the contours."""
        view, contours, pixels = self._method.view, self._method.prepared.contours, self._pixels
        # Looks at what it traces, so before there are paths to wait for.
        self._causes = self._method.unfollowed.causes(pixels, self._blocks)
        baseline = self._baseline if len(contours.piece) else np.empty((len(pixels), 3))
        pilot = self._method.pilot
        slopes = pilot.slopes(pixels) if isinstance(pilot, DepthPilot) else None
        self._parallax = ParallaxTerm(view, contours, pixels, baseline, self._paths, slopes=slopes)
        columns, image, self._shown, self._closing = self._begin()
        self._parallax.launch()
        self._colors = [*columns, image]

    def wait(self) -> None:
        """Until they are traced."""
        # Shares Dr.Jit's memory, but to look there later would be to wait for the next tile's paths.
        self._traced = [[np.asarray(channel) for channel in color] for color in self._colors]
        shape = (self._paths.batches, -1)
        self._sums = np.array([np.asarray(part).reshape(shape).mean(axis=0) for part in self._shown])
        self._residual = np.array([np.asarray(part).reshape(shape) for part in self._closing], dtype=float)
        self._parallax.wait()

    def settle(self) -> SettledFlow:
        """All terms together; blocks that may not close are on their way again."""
        jacobians, images = as_arrays(self._traced, self._paths.batches)
        rows, terms, closing = self._parallax.result()
        jacobians[:, rows, :, : terms.shape[-1]] += terms
        self._residual[..., rows] += closing
        # A few weights of a filter with negative lobes may add up to nothing: then the pilot is what is left.
        shown = self._baseline + (self._sums[:3] / np.maximum(self._sums[3], 0.5)).T
        blocks, causes = self._blocks, self._causes
        suspect = suspects(self._residual, jacobians[..., :3], shown, blocks)
        suspect &= causes == ""
        found = Estimates(jacobians, images, shown, causes[blocks.home])
        return SettledFlow(self._method, self._pixels, self._paths, found, suspect[blocks.home])


class SettledFlow:
    """What flow says of some pixels; whether it may is on its way, see `method.SettledTile`."""

    def __init__(
        self,
        method: Flow,
        pixels: NDArray[np.int64],
        paths: Paths,
        found: Estimates,
        suspect: NDArray[np.bool_],
    ) -> None:
        """Starts to measure again the closure of pixels (n,) that are suspect."""
        self._method, self._pixels, self._paths, self._found = method, pixels, paths, found
        self._again = np.flatnonzero(suspect)
        if not len(self._again):
            return
        seed = derived_seed(paths.seed, CLOSURE)
        again = Paths(BATCHES * max(PATHS, paths.spp // paths.batches), seed, BATCHES)
        white = replace(method.prepared, tracer=White(), view_term=None, film_flows=())
        own = pixels[self._again]
        start = filter_and_view_terms(method.view, white, own, Black(), again)
        nothing = np.zeros((len(own), 3))
        self._parallax = ParallaxTerm(method.view, method.prepared.contours, own, nothing, again)
        self._closing = start()[-1]
        self._parallax.launch()

    def wait(self) -> None:
        """Until it has been measured."""
        if len(self._again):
            parts = [np.asarray(part).reshape(BATCHES, -1) for part in self._closing]
            self._residual = np.array(parts, dtype=np.float64)
            self._parallax.wait()

    def result(self) -> Estimates:
        """With finite differences where the flow does not hold."""
        found, method = self._found, self._method
        assert found.causes is not None
        if len(self._again):
            found.causes[self._again] = self._breaches()
        columns = method.differenced(found.causes)
        for count in np.unique(columns[columns > 0]):
            rows = np.flatnonzero(columns == count)
            found.columns[:, rows, :, :count] = method.differences(self._pixels[rows], count, self._paths)
        return found._replace(step_bias=method.step_bias)

    def _breaches(self) -> NDArray[np.object_]:
        """Why the flow does not close at each of the suspects, "" where it does."""
        rows, _, closing = self._parallax.result()
        self._residual[..., rows] += closing
        blocks, contours = FilmBlocks.of(self._pixels[self._again]), self._method.prepared.contours
        column, row = blocks.number & 0xFFFFFFFF, blocks.number >> 32
        edges = contours.samples[row * contours.columns + column] > 0.0
        causes = np.where(edges, "stacked edges", "unknown").astype(object)
        columns, image = self._found.columns[:, self._again, :, :3], self._found.image[self._again]
        wrong = matters(self._residual, columns, image, blocks, breaches(self._residual, blocks))
        causes[~wrong] = ""
        return causes[blocks.home]


def filter_and_view_terms(
    view: View,
    prepared: Prepared,
    pixels: NDArray[np.int64],
    pilot: Pilot | DepthPilot | Black,
    paths: Paths,
) -> Callable[[], tuple[list[mi.Color3f], mi.Color3f, mi.Vector4f, mi.Vector3f]]:
    """What starts the paths of some pixels in the background, without the contours' part.

    Returns:
        A function that gives the columns, the image, and what else `sum_pairs` makes, of each lane.
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
        "film": view.film_arrays,
    }

    def body(arrays: dict[str, Any]) -> tuple[list[mi.Color3f], mi.Color3f, mi.Vector4f, mi.Vector3f]:
        lanes = Lanes(*arrays["lanes"])
        seeds, even_seeds = arrays["seeds"]
        given = dict(zip(_TRACED, join(parts, iter(arrays["parts"])), strict=True))
        columns, *others = sum_pairs(
            view.with_film_arrays(arrays["film"]),
            replace(prepared, **given),
            lane_sampler(lanes.pixel, lanes.batch, seeds),
            EvenNumbers.of(lanes, even_seeds, _DIMENSIONS),
            lanes.centre + film_shift(view.pixel_filter),
            pilot.baseline(arrays["pilot"], lanes),
            pilot.plane(arrays["pilot"], lanes) if isinstance(pilot, DepthPilot) else None,
            arrays["counts"],
            arrays["number"],
            arrays["starts"],
            arrays["most"],
        )
        return columns, *others

    own_integrator = isinstance(prepared.tracer, IntegratorTracer)
    return view.recorder.ready("pairs", body, view, arrays, None if own_integrator else key)


def as_arrays(colors: Any, batches: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Columns (batches, n, 3, q) and, of the last color, the image; the pixels' numbers beside each other."""
    values = np.empty((len(colors), 3, batches, len(colors[0][0]) // batches))
    for row, color in zip(values, colors, strict=True):
        for own, channel in zip(row, color, strict=True):
            own[...] = np.asarray(channel).reshape(own.shape)
    return values[:-1].transpose(2, 3, 1, 0), values[-1].transpose(1, 2, 0)
