"""An opened view and how it is measured: choose pixels, stream tiles, sum up.

Pixels are visited tile by tile; each tile's Jacobian is folded into the information and forgotten, so that
memory does not grow with the image. Everything decided before the Jacobian (length scale, white,
gradient-rich pixels) comes from pilot renders with random numbers of their own, the same for all batches:
batches that lent each other anything would bias the information (design 4.1).
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.metadata
import warnings
from collections.abc import Iterator, Mapping, Sequence
from difflib import get_close_matches
from functools import cache, cached_property
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from ..errors import BlindSpotWarning, NoiseError, OptionError, PrecisionWarning, RadianceError
from ..information import subset
from ..information.accumulate import Accumulator, as_noise_model
from ..information.fisher import FisherInformation
from ..information.image_jacobian import ImageJacobian
from ..information.joint import JointAccumulator, JointInformation, tile_side
from ..information.linearisation import Linearisation, PixelSelection
from ..jacobian.method import Estimates, Method, Paths, Tile
from ..noise import CoupledNoise, Gaussian, Luminance, NoiseModel
from ..noise.colour import REC709
from ..render import llvm
from ..render.backend import use_mitsuba
from ..render.random import PILOT
from ..render.rays import coarse_grid
from .differences import Differences
from .measurable import Measurable
from .mitsuba_view import open_measurable
from .nuisances import Nuisance, name_parameters, nuisance_columns
from .options import MeasurementKeywords, MeasurementOptions
from .tile_jacobian import TileJacobian

RELATIVE_SIGMA = 0.01
"""Standard deviation of the default noise, as a fraction of the image's white."""
PILOT_SPP = 16
"""Paths per pixel of a pilot render."""

_PILOT_GRID = 96


@dataclasses.dataclass(frozen=True)
class Measurement:
    """An opened view, how it is measured, and what the pilot renders said of it."""

    view: Measurable
    options: MeasurementOptions
    tile: int
    """Side of the tiles [pixel], a multiple of the nuisances' own."""
    nuisances: tuple[Nuisance, ...]
    """Parameters that are not known beside the pose."""
    length_scale: float
    """Median visible depth [scene unit]; 1 if nothing finite is visible."""
    mask: NDArray[np.bool_]
    """(H, W), the pixels to measure."""
    selection: PixelSelection
    """What they stand for."""
    differences: Differences = dataclasses.field(default_factory=Differences)
    """What finite differences have measured so far in the method's place."""

    @property
    def linearisation(self) -> Linearisation:
        """What is measured, in the camera frame."""
        return Linearisation(
            variable=self.view.variable,
            frame="camera",
            pose=self.view.pose,
            length_scale=self.length_scale,
            selection=self.selection,
        )

    @property
    def paths(self) -> Paths:
        """Of the Jacobian."""
        return Paths(self.options.spp, self.options.seed, self.options.batches)

    @cached_property
    def method(self) -> Method:
        """The method, open for this view and these pixels."""
        return method_of(self.view, self.options.method).open(
            self.view,
            self.mask,
            self.paths,
            step_pixels=self.options.step_pixels,
            film_flows=tuple(flow for nuisance in self.nuisances for flow in nuisance.film_flows),
        )

    @property
    def block(self) -> int:
        """Side of the film blocks whose errors are independent [pixel]."""
        return self.method.block

    @property
    def parameters(self) -> tuple[str, ...]:
        """The name of each nuisance column."""
        return tuple(nuisance.name for nuisance in self.nuisances for _ in range(nuisance.width))

    def provenance(self) -> dict[str, Any]:
        """How the numbers were made, JSON-able."""
        return {
            "scene": self.view.label,
            "sensor": self.view.variable,
            "method": self.options.method,
            "spp": self.options.spp,
            "seed": self.options.seed,
            "batches": self.options.batches,
            "size": list(self.view.size),
            "drop_invalid": self.options.drop_invalid,
            "step_pixels": self.method.step_pixels,
            "pixels": dataclasses.asdict(self.selection),
            "nuisances": {nuisance.name: nuisance.how for nuisance in self.nuisances},
            **self.view.provenance(),
            "versions": versions(),
        }

    def noise(self, model: NoiseModel | None) -> tuple[NoiseModel, str]:
        """The noise model, checked against the image, and where it came from."""
        found, origin = (as_noise_model(model), "given") if model is not None else self._default_noise()
        if self.view.luminance and not isinstance(found, Luminance):
            if isinstance(found, CoupledNoise):
                raise NoiseError("coupled noise needs pixel_format rgb; the film measures luminance")
            found = Luminance(found)
        found.check(self.mask.shape[0], self.mask.shape[1], 3)
        return found, origin

    def _default_noise(self) -> tuple[NoiseModel, str]:
        grid = coarse_grid(self.view.size, _PILOT_GRID).reshape(-1, 2)
        finish = self.view.start_image(grid, Paths(PILOT_SPP, self.options.seed, 1), purpose=PILOT)
        _ = self.method  # while these paths are traced
        pilot = finish()
        if self.view.luminance:
            pilot = pilot @ np.array(REC709)
        finite = pilot[np.isfinite(pilot)]
        white = float(np.percentile(finite, 99.0)) if finite.size else 0.0
        if not white > 0.0:
            raise NoiseError(
                f"the image is black ({self.view.nothing_visible(black=True)}), so no default noise follows "
                "from it: give --sigma X (noise.Gaussian(X))"
            )
        return Gaussian(RELATIVE_SIGMA * white), (
            f"{RELATIVE_SIGMA:g} of the image's white {white:.3g}, the 99th percentile of a pilot render"
        )

    def warn_of_limits(self) -> None:
        """Warn of what the arithmetic does not resolve, and by name of what the method cannot see here."""
        for text in self.view.precision_limits():
            warnings.warn(text, PrecisionWarning, stacklevel=4)
        for text in method_of(self.view, self.options.method).limits(self.view):
            warnings.warn(text, BlindSpotWarning, stacklevel=4)

    def at(self, pose: NDArray[np.float64], /, **options: Unpack[MeasurementKeywords]) -> Measurement:
        """The same measurement of the view from another pose (4, 4), perhaps with some other options."""
        return dataclasses.replace(
            self, view=self.view.at(pose), options=dataclasses.replace(self.options, **options)
        )

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
        if invalid and not (self.options.drop_invalid and invalid < total):
            raise RadianceError(
                f"{invalid} of {total} pixels have radiance that is NaN or infinite; mend the scene or leave "
                "them out with --drop-invalid (drop_invalid=True)"
            )

    def render(
        self,
        pixels: NDArray[np.int64],
        purpose: int,
        *,
        paths: Paths | None = None,
        pose: NDArray[np.float64] | None = None,
    ) -> NDArray[np.float64]:
        """(batches, n, 3) the image at some pixels (n, 2), by random numbers of a purpose of their own.

        Args:
            paths: those of the Jacobian by default.
            pose: the view's own by default.
        """
        return self.view.start_image(pixels, paths or self.paths, purpose=purpose, pose=pose)()

    def jacobian(self, *, pilot: bool = False) -> ImageJacobian:
        """The Jacobian of every selected pixel, held at once, row by row; `pilot` as for `tiles`."""
        image = np.full((*self.mask.shape, 3), np.nan)
        expected = np.full_like(image, np.nan)
        measured = np.zeros_like(self.mask)
        place = (np.cumsum(self.mask) - 1).reshape(self.mask.shape)
        values = np.empty((self.options.batches, int(self.mask.sum()), 3, 6 + len(self.parameters)))
        for part in self.tiles(pilot=pilot):
            x, y = part.pixels.T
            image[y, x], expected[y, x], measured[y, x] = part.mean, part.expected, True
            values[:, place[y, x]] = part.all_values
        return ImageJacobian(
            batch_values=values if measured[self.mask].all() else values[:, measured[self.mask]],
            pixels=subset.selected(measured),
            image=image,
            linearisation=self.linearisation,
            block=self.block,
            parameters=self.parameters,
            pilot=expected if pilot else None,
            provenance=self.provenance(),
        )

    def sum_into(self, accumulator: Accumulator, noise: NoiseModel) -> None:
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
            weights = noise.weights(part.pixels, part.expected)
            accumulator.add(part.all_values, weights, part.pixels, part.bias)
            self.differences.add(part, weights)

    def information(self, noise: NoiseModel) -> FisherInformation:
        """Of the pose, in the camera frame, with all nuisances known."""
        return self.joint_information(noise).fix().information

    def joint_information(self, noise: NoiseModel) -> JointInformation:
        """Of the pose and the nuisances, with nothing decided of any."""
        accumulator = JointAccumulator(
            self.parameters,
            batches=self.options.batches,
            block=self.block,
            sampled=self.selection.kind == "random",
            coupled=noise.couples_pixels,
        )
        self.sum_into(accumulator, noise)
        return accumulator.information(self.linearisation)

    def tiles(self, *, pilot: bool = False) -> Iterator[TileJacobian]:
        """The Jacobian, one tile after the other.

        Args:
            pilot: also render the image by other random numbers, for noise that depends on it: the Jacobian's
                own has its errors in common with it, which would bias the information.
        """
        done, total, invalid = 0, int(self.mask.sum()), 0
        for pixels, (columns, images, image, causes, step_bias) in self._in_turn():
            values, film = columns[..., :6], columns[..., 6:]
            others = None
            if self.nuisances:
                others = nuisance_columns(self.nuisances, self.view, pixels, images, film, self.paths)
            done += len(pixels)
            expected = self._expected(pixels, image) if pilot else None
            tile = TileJacobian(
                values, pixels, image, others, expected, self.view.luminance, causes, step_bias
            ).finite()
            invalid += len(pixels) - len(tile.pixels)
            if self.options.on_tile is not None:
                self.options.on_tile(tile, done, total)
            if self.options.drop_invalid or not invalid:
                yield tile
        self.check_valid(invalid, total)

    def _expected(self, pixels: NDArray[np.int64], mean: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, 3), the pilot; where it is not finite, the mean."""
        paths = Paths(max(PILOT_SPP, self.options.spp), self.options.seed, 1)
        image = _pilot(self.view, pixels, paths, even=True)
        return np.where(np.isfinite(image), image, mean)

    def _in_turn(self) -> Iterator[tuple[NDArray[np.int64], Estimates]]:
        """Each tile's pixels and what the method says of them.

        One tile is prepared, and the one before it summed up, while paths are traced.
        """
        running: tuple[NDArray[np.int64], Tile] | None = None
        for pixels in subset.tiles(self.mask, self.tile):
            tile = self.method.prepare(pixels)
            if running is not None:
                running[1].wait()
            tile.launch()
            if running is not None:
                yield running[0], running[1].result()
            running = pixels, tile
        if running is not None:
            running[1].wait()
            yield running[0], running[1].result()


@contextlib.contextmanager
def measurement(
    scene: Any, *, nuisances: Sequence[str] = (), **options: Unpack[MeasurementKeywords]
) -> Iterator[Measurement]:
    """A view, opened as `MeasurementOptions` and `pose_bound` say; unchanged afterwards."""
    given = MeasurementOptions(**options)
    with open_measurable(scene, given, apart=name_parameters(nuisances)) as view:
        method = method_of(view, given.method)
        mask, selection = subset.choose(
            given.pixels, view.size, given.seed, lambda: _pilot_image(view, given.seed, given.tile)
        )
        side = tile_side(tuple(nuisances), sampled=selection.kind == "random")
        visible = view.visible_depth
        yield Measurement(
            view=view,
            options=given,
            tile=given.tile if side is None else side * max(1, given.tile // side),
            nuisances=view.open_nuisances(nuisances, method),
            length_scale=float(np.median(visible)) if visible.size else 1.0,
            mask=mask,
            selection=selection,
        )


def method_of(view: Measurable, name: str) -> type[Method]:
    """The way to measure a view that users call so.

    Raises:
        OptionError: there is none; names the near one.
    """
    if name not in view.methods:
        near = get_close_matches(str(name), view.methods, 1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise OptionError(f"unknown method {name!r}; {hint}methods: {', '.join(view.methods)}")
    return view.methods[name]


def _pilot_image(view: Measurable, seed: int, tile: int) -> NDArray[np.float64]:
    """(H, W, 3) a pilot render of every pixel."""
    width, height = view.size
    image = np.empty((height, width, 3))
    for part in subset.tiles(np.ones((height, width), dtype=bool), tile):
        image[part[:, 1], part[:, 0]] = _pilot(view, part, Paths(PILOT_SPP, seed, 1))
    return image


def _pilot(
    view: Measurable, pixels: NDArray[np.int64], paths: Paths, *, even: bool = False
) -> NDArray[np.float64]:
    return np.asarray(view.start_image(pixels, paths, purpose=PILOT, even=even)()[0])


def versions() -> dict[str, str]:
    """Versions of everything that the numbers depend on, and Mitsuba's variant."""
    return dict(_versions(use_mitsuba()))


@cache
def _versions(variant: str) -> Mapping[str, str]:
    packages = ("mitsuba_crb", "mitsuba", "drjit", "numpy", "scipy")
    found = {name: importlib.metadata.version(name) for name in packages}
    return {**found, "variant": variant, **({"llvm": llvm.configure().version} if "llvm" in variant else {})}
