"""From a scene to its Jacobian and its bound: choose pixels, stream tiles, assemble.

Pixels are visited tile by tile; each tile yields an `ImageJacobian` of its own, which `pose_bound` folds into
the Fisher information and forgets, so that its memory does not grow with the image. Everything decided before
the Jacobian (length scale, white, gradient-rich pixels) comes from pilot renders with random numbers of their
own, the same for all batches: batches that lent each other anything would bias the information (design 4.1).
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import importlib.metadata
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, cached_property, partial
from types import ModuleType
from typing import Any, TypedDict, Unpack

import numpy as np
from numpy.typing import NDArray

from ..bound.cramer_rao import PoseBound, joint_bound
from ..errors import BlindSpotWarning, NoiseError, OptionError, PrecisionWarning, RadianceError
from ..information import subset
from ..information.fisher import BLOCK, Accumulator, ImageJacobian, PixelSelection, as_noise_model
from ..information.joint import JointAccumulator, tile_side
from ..jacobian.finite_difference import STEP_PIXELS
from ..noise import CoupledNoise, Gaussian, NoiseModel
from ..render import llvm
from ..render.lending import in_turn
from ..render.scene import View, open_view
from . import lint
from .nuisances import Nuisance, nuisance_columns, open_nuisances

DEFAULT_METHOD = "flow"
METHODS = ("flow", "forward", "finite_difference")
"""Each is a module of `jacobian` with the functions `prepare` and `jacobian`."""
RELATIVE_SIGMA = 0.01
"""Standard deviation of the default noise, as a fraction of the image's white."""

_PILOT_GRID = 96
_PILOT_SPP = 16

Progress = Callable[["TileJacobian", int, int], None]
"""Called after each tile with its Jacobian, the pixels done and the pixels in total."""


class MeasurementOptions(TypedDict, total=False):
    """What every measurement of a view can be told, by keyword."""

    sensor: int | str
    """Index or id; default 0."""
    pose: Any
    """`world_from_camera`, 4x4 or `RigidTransform`, in place of the sensor's own."""
    method: str
    """One of `METHODS`; default "flow"."""
    spp: int
    """Paths per pixel over all batches, a multiple of `batches`; default 64. Finite differences trace 12
    times that, "forward" 6 times."""
    seed: int
    """Of all random numbers; equal calls give equal bits. Default 0."""
    batches: int
    """Independent estimates, at least 4, the default."""
    pixels: Any
    """None (all, the default), "random:f", "gradient:f", a boolean mask (H, W), or a mask image's path."""
    integrator: Any
    """In place of the scene's: an `mi.Integrator`, a plugin's name or a dictionary."""
    size: tuple[int, int] | None
    """Width and height [pixel] in place of the film's."""
    tile: int
    """Side of the tiles [pixel], a multiple of 8; bounds the memory, not the result. Default 256."""
    drop_invalid: bool
    """Leave out pixels whose radiance is not finite instead of raising; default False."""
    on_tile: Progress | None
    """Called after each tile."""
    step_pixels: float
    """Image motion of a finite-difference step [pixel]; other methods have none."""


@in_turn
def pose_jacobian(
    scene: Any, *, nuisances: Sequence[str] = (), **options: Unpack[MeasurementOptions]
) -> ImageJacobian:
    """The Jacobian dI/dξ of every selected pixel, in the camera frame.

    Args:
        scene: path of a Mitsuba XML file, dictionary, or `mi.Scene`.
        nuisances: names of further parameters for further columns, see `nuisance`.
        options: see `MeasurementOptions`.

    Returns:
        `ImageJacobian` in the camera frame; translation columns [radiance / scene unit], rotation columns
        [radiance / rad]. Its pilot makes `fisher_information` under any noise that of `pose_bound`; for flow
        it costs up to as much again as the derivatives, which `pose_bound` pays for only where needed.

    Raises:
        MitsubaCRBError: one of its subclasses, in one line, with the cure.

    References:
        Muthukkumar 2025, section 3; design section 4.
    """
    with measurement(scene, nuisances=nuisances, **options) as run:
        run.warn_of_limits()
        return run.jacobian(pilot=True)


@in_turn
def pose_bound(
    scene: Any,
    noise: NoiseModel | None = None,
    *,
    prior: Any = None,
    nuisances: Sequence[str] = (),
    **options: Unpack[MeasurementOptions],
) -> PoseBound:
    """The Cramér–Rao bound on the camera's pose, tile by tile; correlated noise needs the whole Jacobian.

    Args:
        scene: path of a Mitsuba XML file, dictionary, or `mi.Scene`; the last such scene is kept, and traced
            but once as long as its parameters stay.
        noise: noise model of the measured image; None is Gaussian with 0.01 of the image's white, the 99th
            percentile of a pilot render.
        prior: information known beforehand, see `cramer_rao_bound`.
        nuisances: names of parameters that are not known either, see `nuisance`. The bound's `joint` can
            undo that, and its `if_known` says what each costs.
        options: see `MeasurementOptions`.

    Returns:
        `PoseBound`, matrices in the camera frame; `.provenance` says how it was made.

    Raises:
        NoiseError: the image is black and no noise was given.
        MitsubaCRBError: as `pose_jacobian`.

    Warns:
        NuisanceWarning: the image does not see a nuisance.
    """
    start = time.perf_counter()
    caught: list[warnings.WarningMessage] = []
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            with measurement(scene, nuisances=nuisances, **options) as run:
                model, origin = run.noise(noise)
                model.check(run.mask.shape[0], run.mask.shape[1], 3)
                run.warn_of_limits()
                prepared = time.perf_counter()
                accumulator = JointAccumulator(
                    run.parameters,
                    batches=run.batches,
                    block=run.block,
                    sampled=run.selection.kind == "random",
                    coupled=model.couples_pixels,
                )
                run.feed(accumulator, model)
                joint = accumulator.information(
                    variable=run.view.variable,
                    pose=run.view.pose,
                    length_scale=run.length_scale,
                    selection=run.selection,
                )
            rendered = time.perf_counter()
            alone = joint.marginalize()
            bound = joint_bound(alone, prior=prior)
    finally:
        for warning in caught:
            warnings.warn(warning.message, warning.category, stacklevel=3)
    provenance = {
        **run.provenance(),
        "noise": {**model.to_dict(), "description": model.description, "origin": origin},
        "noise_inflation": alone.information.noise_inflation,
        "warnings": list(dict.fromkeys(str(warning.message) for warning in caught)),
        "seconds": {
            "prepare": prepared - start,
            "render": rendered - prepared,
            "total": time.perf_counter() - start,
        },
    }
    return dataclasses.replace(bound, provenance=provenance)


@dataclasses.dataclass(frozen=True)
class TileJacobian:
    """What one tile contributes, before it is folded into the information."""

    batch_values: NDArray[np.float64]
    """(K, n, 3, 6) estimates of dI/dξ in the camera frame."""
    pixels: NDArray[np.int64]
    """(n, 2) columns and rows."""
    mean: NDArray[np.float64]
    """(n, 3) the image there, by the derivative's own paths [radiance]."""
    nuisance_values: NDArray[np.float64] | None = None
    """(K, n, 3, m) estimates of the derivatives in the nuisance parameters; None without any."""
    pilot: NDArray[np.float64] | None = None
    """(n, 3) the image there by other random numbers; None where no noise depends on it."""

    def finite(self) -> TileJacobian:
        """Without the pixels at which anything is NaN or infinite."""
        found = [self.batch_values, self.mean[None]]
        if self.nuisance_values is not None:
            found.append(self.nuisance_values)
        if all(np.isfinite(values.sum()) for values in found):
            return self
        good = np.logical_and.reduce(
            [np.isfinite(values).all(axis=(0, *range(2, values.ndim))) for values in found]
        )
        others = None if self.nuisance_values is None else self.nuisance_values[:, good]
        pilot = None if self.pilot is None else self.pilot[good]
        return TileJacobian(self.batch_values[:, good], self.pixels[good], self.mean[good], others, pilot)

    @property
    def expected(self) -> NDArray[np.float64]:
        """(n, 3), what noise may depend on: the pilot, or the image where there is none."""
        return self.mean if self.pilot is None else self.pilot

    @property
    def all_values(self) -> NDArray[np.float64]:
        """(K, n, 3, 6 + m), the pose's and the nuisances' columns."""
        if self.nuisance_values is None:
            return self.batch_values
        return np.concatenate([self.batch_values, self.nuisance_values], axis=-1)


@dataclasses.dataclass
class Measurement:
    """An opened view, its checked options and what the pilot renders said of it."""

    view: View
    method: str
    spp: int
    seed: int
    batches: int
    tile: int
    drop_invalid: bool
    on_tile: Progress | None
    nuisances: tuple[Nuisance, ...]
    """Parameters that are not known beside the pose."""
    step: dict[str, Any]
    """What the method's `prepare` takes beside the view."""
    length_scale: float
    mask: NDArray[np.bool_]
    """(H, W), the pixels to measure."""
    selection: PixelSelection
    """What they stand for."""

    @cached_property
    def prepared(self) -> Any:
        """What the method's `prepare` returned."""
        return _module(self.method).prepare(self.view, **self.step)

    @property
    def block(self) -> int:
        """Side of the film blocks whose errors are independent [pixel]."""
        return int(self.prepared.block)

    @property
    def parameters(self) -> tuple[str, ...]:
        """The name of each nuisance column."""
        return tuple(nuisance.name for nuisance in self.nuisances for _ in range(nuisance.width))

    def provenance(self) -> dict[str, Any]:
        """How the numbers were made, JSON-able."""
        integrator = self.view.integrator
        python = type(integrator).__module__ != "mitsuba"
        return {
            "scene": self.view.label,
            "sensor": self.view.variable,
            "method": self.method,
            "spp": self.spp,
            "seed": self.seed,
            "batches": self.batches,
            "size": list(self.view.size),
            "pixels": dataclasses.asdict(self.selection),
            "drop_invalid": self.drop_invalid,
            "step_pixels": self.step.get("step_pixels"),
            "nuisances": {nuisance.name: nuisance.how for nuisance in self.nuisances},
            "integrator": type(integrator).__name__ if python else integrator.class_name(),
            "versions": versions(),
        }

    def noise(self, model: NoiseModel | None) -> tuple[NoiseModel, str]:
        """The noise model and where it came from."""
        if model is not None:
            return as_noise_model(model), "given"
        from ..render.pixels import PILOT, coarse_grid, download, start_pixels

        grid = coarse_grid(self.view.size, _PILOT_GRID).reshape(-1, 2)
        total = start_pixels(self.view, grid, spp=_PILOT_SPP, seed=self.seed, purpose=PILOT)
        _ = self.prepared  # while these paths are traced
        pilot = download(total) / _PILOT_SPP
        finite = pilot[np.isfinite(pilot)]
        white = float(np.percentile(finite, 99.0)) if finite.size else 0.0
        if not white > 0.0:
            raise NoiseError(
                "the image is black, so no default noise follows from it: give --sigma X (noise.Gaussian(X))"
            )
        return Gaussian(RELATIVE_SIGMA * white), (
            f"{RELATIVE_SIGMA:g} of the image's white {white:.3g}, the 99th percentile of a pilot render"
        )

    def warn_of_limits(self) -> None:
        """Warn of float32, and by name of what the method cannot see here."""
        for text in lint.precision_findings(self.view):
            warnings.warn(text, PrecisionWarning, stacklevel=4)
        if self.method != "finite_difference" and lint.is_cut_by_near_plane(self.view):
            warnings.warn(
                f"the near plane at {self.view.near_clip:g} cuts surfaces in view, and method "
                f"{self.method!r} misses that the cut moves with the camera: any direction may be "
                "under-informed; lower near_clip or use finite_difference",
                BlindSpotWarning,
                stacklevel=4,
            )
        if self.method == "forward":
            for finding in lint.discontinuities(self.view):
                warnings.warn(
                    f"method 'forward' cannot see {finding}: its information is too small and its bound no "
                    "bound; use flow",
                    BlindSpotWarning,
                    stacklevel=4,
                )

    def at(self, pose: NDArray[np.float64]) -> Measurement:
        """The same measurement of the view from another pose (4, 4)."""
        return dataclasses.replace(self, view=dataclasses.replace(self.view, pose=pose))

    def only(self, mask: NDArray[np.bool_] | None = None, description: str | None = None) -> Measurement:
        """The same measurement for an estimator that has its pixels and no others; of a mask (H, W), those.

        A random subset does not stand for the whole image then.
        """
        mask = self.mask if mask is None else self.mask & mask
        selection = self.selection.only(int(mask.sum()), description)
        return dataclasses.replace(self, mask=mask, selection=selection)

    def check_valid(self, invalid: int, total: int) -> None:
        """Refuse so many pixels of some whose radiance is not finite, unless they may be left out.

        Raises:
            RadianceError: they may not, or nothing would be left.
        """
        if invalid and not (self.drop_invalid and invalid < total):
            raise RadianceError(
                f"{invalid} of {total} pixels have radiance that is NaN or infinite; mend the scene or leave "
                "them out with --drop-invalid (drop_invalid=True)"
            )

    def jacobian(self, *, pilot: bool = False) -> ImageJacobian:
        """The Jacobian of every selected pixel, held at once, row by row; `pilot` as for `tiles`."""
        image = np.full((*self.mask.shape, 3), np.nan)
        expected = np.full_like(image, np.nan)
        measured = np.zeros_like(self.mask)
        place = (np.cumsum(self.mask) - 1).reshape(self.mask.shape)
        values = np.empty((self.batches, int(self.mask.sum()), 3, 6 + len(self.parameters)))
        for part in self.tiles(pilot=pilot):
            x, y = part.pixels.T
            image[y, x], expected[y, x], measured[y, x] = part.mean, part.expected, True
            values[:, place[y, x]] = part.all_values
        return ImageJacobian(
            batch_values=values if measured[self.mask].all() else values[:, measured[self.mask]],
            pixels=subset.selected(measured),
            image=image,
            frame="camera",
            pose=self.view.pose,
            selection=self.selection,
            length_scale=self.length_scale,
            variable=self.view.variable,
            block=self.block,
            parameters=self.parameters,
            pilot=expected if pilot else None,
            provenance=self.provenance(),
        )

    def feed(self, accumulator: Accumulator, noise: NoiseModel) -> None:
        """Add the selected pixels under a noise model: tile by tile, or whole if it couples them.

        Raises:
            NoiseError: the image does not suit the model.
            RadianceError: as `tiles`.
        """
        if isinstance(noise, CoupledNoise):
            parts = list(self.tiles())
            values = np.concatenate([part.all_values for part in parts], axis=1)
            accumulator.add_coupled(values, noise, np.concatenate([part.pixels for part in parts]))
            return
        for part in self.tiles(pilot=noise.depends_on_mean):
            accumulator.add(part.all_values, noise.weights(part.pixels, part.expected), part.pixels)

    def tiles(self, *, pilot: bool = False) -> Iterator[TileJacobian]:
        """The Jacobian, one tile after the other.

        Args:
            pilot: also render the image by other random numbers, for noise that depends on it: the Jacobian's
                own has its errors in common with it, which would bias the information.
        """
        paths = {"spp": self.spp, "seed": self.seed, "batches": self.batches}
        done, total, invalid = 0, int(self.mask.sum()), 0
        for part, (values, images, image) in self._in_turn(paths):
            values, film = values[..., :6], values[..., 6:]
            others = None
            if self.nuisances:
                others = nuisance_columns(self.nuisances, self.view, part, images, film, **paths)
            done += len(part)
            expected = self._expected(part, image) if pilot else None
            tile = TileJacobian(values, part, image, others, expected).finite()
            invalid += len(part) - len(tile.pixels)
            if self.on_tile is not None:
                self.on_tile(tile, done, total)
            if self.drop_invalid or not invalid:
                yield tile
        self.check_valid(invalid, total)

    def _expected(self, pixels: NDArray[np.int64], mean: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, 3), the pilot; where it is not finite, the mean."""
        image = _pilot(self.view, pixels, self.seed, max(_PILOT_SPP, self.spp), even=True)
        return np.where(np.isfinite(image), image, mean)

    def _in_turn(self, paths: dict[str, int]) -> Iterator[tuple[NDArray[np.int64], Any]]:
        """Each tile's pixels and what the method says of them; flow takes its steps as `flow.steps` says."""
        module, running = _module(self.method), None
        options = {"prepared": self.prepared, **paths}
        if self.method == "flow":
            pilot = module.Pilot.of(self.view, self.mask, self.seed)
            begin = partial(module.steps, self.view, pilot=pilot, **options)
        else:
            begin = partial(_at_once, module.jacobian, self.view, **options)
        for part in subset.tiles(self.mask, self.tile):
            steps = begin(part)
            next(steps)
            if running is not None:
                next(running[1])
            next(steps)
            if running is not None:
                yield running[0], next(running[1])
            running = part, steps
        if running is not None:
            next(running[1])
            yield running[0], next(running[1])


def _at_once(
    jacobian: Callable[..., Any], view: View, part: NDArray[np.int64], **options: Any
) -> Iterator[Any]:
    """A tile's Jacobian in the last of four steps."""
    yield from (None, None, None)
    values, images = jacobian(view, part, **options)
    yield values, images, images.mean(axis=0)


@contextlib.contextmanager
def measurement(
    scene: Any,
    *,
    sensor: int | str = 0,
    pose: Any = None,
    method: str = DEFAULT_METHOD,
    spp: int = 64,
    seed: int = 0,
    batches: int = 4,
    pixels: Any = None,
    integrator: Any = None,
    size: tuple[int, int] | None = None,
    tile: int = 256,
    drop_invalid: bool = False,
    on_tile: Progress | None = None,
    step_pixels: float = STEP_PIXELS,
    nuisances: Sequence[str] = (),
) -> Iterator[Measurement]:
    """A view, opened as `MeasurementOptions` and `pose_bound` say; unchanged afterwards."""
    _check_options(method, spp, seed, batches, tile)
    with open_view(scene, sensor=sensor, pose=pose, integrator=integrator, size=size) as view:
        mask, selection = subset.choose(pixels, view.size, seed, lambda: _pilot_image(view, seed, tile))
        side = tile_side(tuple(nuisances), sampled=selection.kind == "random")
        visible = view.visible_depth
        unknown = open_nuisances(view, nuisances, method)
        step: dict[str, Any] = {"step_pixels": step_pixels} if method == "finite_difference" else {}
        if method == "flow":
            step["film_flows"] = tuple(flow for each in unknown for flow in each.film_flows)
        yield Measurement(
            view=view,
            method=method,
            spp=spp,
            seed=seed,
            batches=batches,
            tile=tile if side is None else side * max(1, tile // side),
            drop_invalid=drop_invalid,
            on_tile=on_tile,
            nuisances=unknown,
            step=step,
            length_scale=float(np.median(visible)) if visible.size else 1.0,
            mask=mask,
            selection=selection,
        )


def _pilot_image(view: View, seed: int, tile: int) -> NDArray[np.float64]:
    """(H, W, 3) a pilot render of every pixel."""
    width, height = view.size
    image = np.empty((height, width, 3))
    for part in subset.tiles(np.ones((height, width), dtype=bool), tile):
        image[part[:, 1], part[:, 0]] = _pilot(view, part, seed)
    return image


def _pilot(
    view: View, pixels: NDArray[np.int64], seed: int, spp: int = _PILOT_SPP, even: bool = False
) -> NDArray[np.float64]:
    from ..render.pixels import PILOT, render_pixels

    image = render_pixels(view, pixels, spp=spp, seed=seed, purpose=PILOT, even=even)
    return np.asarray(image[0])


def _module(method: str) -> ModuleType:
    return importlib.import_module(f"..jacobian.{method}", __package__)


def _check_options(method: str, spp: int, seed: int, batches: int, tile: int) -> None:
    if method not in METHODS:
        raise OptionError(f"unknown method {method!r}; methods: {', '.join(METHODS)}")
    for name, value in (("spp", spp), ("seed", seed), ("batches", batches), ("tile", tile)):
        if isinstance(value, bool) or not isinstance(value, int | np.integer):
            raise OptionError(f"{name} must be a whole number; got {value!r}")
    if batches < 4:
        raise OptionError(f"batches must be at least 4, for standard errors without bias; got {batches}")
    if spp <= 0:
        raise OptionError(f"spp must be positive; got {spp}")
    if spp % batches:
        nearest = max(batches, round(spp / batches) * batches)
        raise OptionError(f"spp {spp} is not a multiple of batches {batches}; the nearest is {nearest}")
    if not 0 <= seed < 1 << 64:
        raise OptionError(f"seed must lie in [0, 2^64); got {seed}")
    if tile <= 0 or tile % BLOCK:
        raise OptionError(f"tile must be a positive multiple of {BLOCK} pixels; got {tile}")


def versions() -> dict[str, str]:
    """Versions of everything that the numbers depend on."""
    return dict(_versions())


@cache
def _versions() -> Mapping[str, str]:
    packages = ("mitsuba_crb", "mitsuba", "drjit", "numpy", "scipy")
    found = {name: importlib.metadata.version(name) for name in packages}
    return {**found, "llvm": llvm.configure().version}
