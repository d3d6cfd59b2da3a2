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
from collections.abc import Callable, Iterator
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import lint, llvm, subset
from .bound import PoseBound, cramer_rao_bound
from .errors import BlindSpotWarning, NoiseError, OptionError, PrecisionWarning, RadianceError
from .information import BLOCK, ImageJacobian, InformationAccumulator, PixelSelection
from .jacobian.finite_difference import STEP_PIXELS
from .noise import Gaussian, NoiseModel
from .scene import View, open_view

DEFAULT_METHOD = "flow"
METHODS = ("flow", "forward", "finite_difference")
"""Each is a module of `jacobian` with the functions `prepare` and `jacobian`."""
RELATIVE_SIGMA = 0.01
"""Standard deviation of the default noise, as a fraction of the image's white."""

_PILOT_GRID = 96
_PILOT_SPP = 16

Progress = Callable[["TileJacobian", int, int], None]
"""Called after each tile with its Jacobian, the pixels done and the pixels in total."""


def pose_jacobian(
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
    tile: int = 128,
    drop_invalid: bool = False,
    on_tile: Progress | None = None,
    step_pixels: float = STEP_PIXELS,
) -> ImageJacobian:
    """The Jacobian dI/dξ of every selected pixel, in the camera frame.

    Args:
        scene: path of a Mitsuba XML file, dictionary, or `mi.Scene`.
        sensor: index or id.
        pose: `world_from_camera`, 4x4 or `RigidTransform`, in place of the sensor's own.
        method: one of `METHODS`.
        spp: paths per pixel over all batches; a multiple of `batches`. Finite differences trace 12 times
            that, "forward" 6 times.
        seed: of all random numbers; equal calls give equal bits.
        batches: independent estimates, at least 4.
        pixels: None, "random:f", "gradient:f", a boolean mask (H, W), or the path of a mask image.
        integrator: in place of the scene's: an `mi.Integrator`, a plugin's name or a dictionary.
        size: width and height [pixel] in place of the film's.
        tile: side of the tiles [pixel], a multiple of 16; bounds the memory, not the result.
        drop_invalid: leave out pixels whose radiance is not finite instead of raising.
        on_tile: called after each tile.
        step_pixels: image motion of a finite-difference step [pixel]; other methods have none.

    Returns:
        `ImageJacobian` in the camera frame; translation columns [radiance / scene unit], rotation columns
        [radiance / rad].

    Raises:
        MitsubaCRBError: one of its subclasses, in one line, with the cure.

    References:
        Muthukkumar 2025, section 3; design section 4.
    """
    with _measurement(
        scene,
        sensor=sensor,
        pose=pose,
        integrator=integrator,
        size=size,
        method=method,
        spp=spp,
        seed=seed,
        batches=batches,
        tile=tile,
        step_pixels=step_pixels,
    ) as run:
        mask = run.select(pixels)
        run.warn_of_limits()
        image = np.full((*mask.shape, 3), np.nan)
        parts = list(run.tiles(mask, drop_invalid, on_tile))
        for part in parts:
            image[part.pixels[:, 1], part.pixels[:, 0]] = part.mean
        return ImageJacobian(
            batch_values=np.concatenate([part.batch_values for part in parts], axis=1),
            pixels=np.concatenate([part.pixels for part in parts]),
            image=image,
            frame="camera",
            pose=run.view.pose,
            selection=run.selection,
            length_scale=run.length_scale,
            variable=run.view.variable,
            block=run.block,
            provenance=run.provenance(),
        )


def pose_bound(
    scene: Any,
    noise: NoiseModel | None = None,
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
    tile: int = 128,
    drop_invalid: bool = False,
    on_tile: Progress | None = None,
    prior: Any = None,
) -> PoseBound:
    """The Cramér–Rao bound on the camera's pose: streams tile by tile and never holds the Jacobian.

    Args:
        noise: noise model of the measured image; None is Gaussian with 0.01 of the image's white, the 99th
            percentile of a pilot render.
        prior: information known beforehand, see `cramer_rao_bound`.
        Others as `pose_jacobian`.

    Returns:
        `PoseBound`, matrices in the camera frame; `.provenance` says how it was made.

    Raises:
        NoiseError: the image is black and no noise was given.
        MitsubaCRBError: as `pose_jacobian`.
    """
    start = time.perf_counter()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with _measurement(
            scene,
            sensor=sensor,
            pose=pose,
            integrator=integrator,
            size=size,
            method=method,
            spp=spp,
            seed=seed,
            batches=batches,
            tile=tile,
            step_pixels=STEP_PIXELS,
        ) as run:
            mask = run.select(pixels)
            model, origin = run.noise(noise)
            model.check(mask.shape[0], mask.shape[1], 3)
            run.warn_of_limits()
            prepared = time.perf_counter()
            accumulator = InformationAccumulator(
                batches=batches, block=run.block, sampled=run.selection.kind == "random"
            )
            for part in run.tiles(mask, drop_invalid, on_tile):
                accumulator.add(part.batch_values, model.weights(part.pixels, part.mean), part.pixels)
            information = accumulator.information(
                frame="camera",
                variable=run.view.variable,
                pose=run.view.pose,
                length_scale=run.length_scale,
                selection=run.selection,
            )
        rendered = time.perf_counter()
        bound = cramer_rao_bound(information, prior=prior)
    for warning in caught:
        warnings.warn(warning.message, warning.category, stacklevel=2)
    provenance = {
        **run.provenance(),
        "noise": {**model.to_dict(), "origin": origin},
        "noise_inflation": information.noise_inflation,
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
    """(n, 3) the image there [radiance]."""


@dataclasses.dataclass
class _Measurement:
    """An opened view, its checked options and what the pilot renders said of it."""

    view: View
    method: str
    spp: int
    seed: int
    batches: int
    tile: int
    prepared: Any
    """What the method's `prepare` returned."""
    length_scale: float
    selection: PixelSelection

    @property
    def block(self) -> int:
        """Side of the film blocks whose errors are independent [pixel]."""
        return int(self.prepared.block)

    def provenance(self) -> dict[str, Any]:
        """How the numbers were made, JSON-able."""
        integrator = self.view.integrator
        python = type(integrator).__module__.startswith("mitsuba.python")
        return {
            "scene": self.view.label,
            "sensor": self.view.variable,
            "method": self.method,
            "spp": self.spp,
            "seed": self.seed,
            "batches": self.batches,
            "size": list(self.view.size),
            "pixels": dataclasses.asdict(self.selection),
            "integrator": type(integrator).__name__ if python else integrator.class_name(),
            "versions": versions(),
        }

    def select(self, pixels: Any) -> NDArray[np.bool_]:
        """The pixels to measure as a mask (H, W); sets `selection`."""
        mask, self.selection = subset.choose(pixels, self.view.size, self.seed, self._pilot_image)
        return mask

    def _pilot_image(self) -> NDArray[np.float64]:
        """(H, W, 3) a pilot render of every pixel."""
        width, height = self.view.size
        image = np.empty((height, width, 3))
        for part in subset.tiles(np.ones((height, width), dtype=bool), self.tile):
            image[part[:, 1], part[:, 0]] = self._pilot(part)
        return image

    def _pilot(self, pixels: NDArray[np.int64]) -> NDArray[np.float64]:
        from .jacobian.pixels import PILOT, render_pixels

        image = render_pixels(self.view, pixels, spp=_PILOT_SPP, seed=self.seed, purpose=PILOT)
        return np.asarray(image[0])

    def noise(self, model: NoiseModel | None) -> tuple[NoiseModel, str]:
        """The noise model and where it came from."""
        if model is not None:
            return model, "given"
        from .jacobian.pixels import coarse_grid

        pilot = self._pilot(coarse_grid(self.view.size, _PILOT_GRID).reshape(-1, 2))
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
        if self.method == "forward":
            for finding in lint.discontinuities(self.view):
                warnings.warn(
                    f"method 'forward' cannot see {finding}: its information is too small and its bound no "
                    "bound; use flow",
                    BlindSpotWarning,
                    stacklevel=4,
                )

    def tiles(
        self, mask: NDArray[np.bool_], drop_invalid: bool, on_tile: Progress | None
    ) -> Iterator[TileJacobian]:
        """The Jacobian, one tile after the other."""
        jacobian = _module(self.method).jacobian
        done, total, invalid = 0, int(mask.sum()), 0
        for part in subset.tiles(mask, self.tile):
            values, primal = jacobian(
                self.view,
                part,
                spp=self.spp,
                seed=self.seed,
                batches=self.batches,
                prepared=self.prepared,
            )
            done += len(part)
            good = np.isfinite(values).all(axis=(0, 2, 3)) & np.isfinite(primal).all(axis=1)
            invalid += int((~good).sum())
            tile = TileJacobian(values[:, good], part[good], primal[good])
            if on_tile is not None:
                on_tile(tile, done, total)
            if drop_invalid or not invalid:
                yield tile
        if invalid and not (drop_invalid and invalid < total):
            raise RadianceError(
                f"{invalid} of {total} pixels have radiance that is NaN or infinite; mend the scene or leave "
                "them out with --drop-invalid (drop_invalid=True)"
            )


@contextlib.contextmanager
def _measurement(
    scene: Any,
    *,
    sensor: int | str,
    pose: Any,
    integrator: Any,
    size: tuple[int, int] | None,
    method: str,
    spp: int,
    seed: int,
    batches: int,
    tile: int,
    step_pixels: float,
) -> Iterator[_Measurement]:
    _check_options(method, spp, seed, batches, tile)
    with open_view(scene, sensor=sensor, pose=pose, integrator=integrator, size=size) as view:
        from .jacobian.pixels import visible_depth

        visible = visible_depth(view)
        options = {"step_pixels": step_pixels} if method == "finite_difference" else {}
        yield _Measurement(
            view=view,
            method=method,
            spp=spp,
            seed=seed,
            batches=batches,
            tile=tile,
            prepared=_module(method).prepare(view, **options),
            length_scale=float(np.median(visible)) if visible.size else 1.0,
            selection=subset.everything(view.size),
        )


def _module(method: str) -> ModuleType:
    return importlib.import_module(f".jacobian.{method}", __package__)


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
    packages = ("mitsuba_crb", "mitsuba", "drjit", "numpy", "scipy")
    found = {name: importlib.metadata.version(name) for name in packages}
    return {**found, "llvm": llvm.configure().version}
