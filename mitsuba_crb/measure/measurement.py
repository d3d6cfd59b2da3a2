"""An opened view and how it is measured: choose pixels, stream tiles, sum up.

Pixels are visited tile by tile; each tile's Jacobian is folded into the information and forgotten: what is
kept of a pixel is some ten bytes of what its block contributed. Everything decided before the Jacobian
(length scale, white, gradient-rich pixels) comes from pilot renders with random numbers of their own, the
same for all batches: batches that lent each other anything would bias the information (design 4.1).
"""

from __future__ import annotations

import contextlib
import dataclasses
import warnings
from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from ..errors import BlindSpotWarning, NoiseError, OptionError, PrecisionWarning, RadianceError
from ..information import subset
from ..information.block_variance import BlockProducts
from ..information.fisher import FisherInformation
from ..information.image_information import Accumulator, as_noise_model
from ..information.image_jacobian import ImageJacobian
from ..information.joint import JointAccumulator, JointInformation, tile_side
from ..information.linearisation import Linearisation, PixelSelection
from ..jacobian.method import Method, Paths, tile_by_tile
from ..noise import CoupledNoise, IndependentNoise, NoiseModel
from .differences import Differences
from .expected import PILOT_SPP, ExpectedImage, whole_pilot
from .exposure import Exposure, Saturation, exposed, start_metering
from .measurable import Measurable, method_of
from .nuisances import Nuisance, name_parameters, nuisance_columns
from .opening import open_measurable
from .options import MeasurementKeywords, MeasurementOptions
from .plan import Plan
from .sensing import RGBD, noise_of_depth
from .tile_jacobian import TileJacobian
from .unknown_map import with_unknown_map
from .versions import versions


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
    told: NDArray[np.bool_] | None = None
    """(H, W) which pixels tell anything; None: all. The mask is of such, or of one if there are none."""
    plan: Plan | None = None
    """Where how many paths go; None: as many to every pixel."""
    differences: Differences = dataclasses.field(default_factory=Differences, init=False)
    """What finite differences have measured so far in the method's place."""
    saturation: Saturation = dataclasses.field(default_factory=Saturation, init=False)
    """How much of what has been measured so far lies above white."""

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
        return Paths(self.options.uniform_spp, self.options.seed, self.options.batches)

    @cached_property
    def method(self) -> Method:
        """The method, open for this view and these pixels."""
        return method_of(self.view.methods, self.options.method).open(
            self.view,
            self.mask,
            self.options.seed,
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
        camera, scaled = self.options.camera, {}
        if camera is not None and camera.size != self.view.size:
            scaled = {"camera_scaled_from": list(camera.size)}
        return {
            "scene": self.view.label,
            "sensor": self.view.variable,
            "method": self.method.name,
            "spp": self._mean_spp,
            "seed": self.options.seed,
            "batches": self.options.batches,
            "size": list(self.view.size),
            "drop_invalid": self.options.drop_invalid,
            "step_pixels": self.method.step_pixels,
            "pixels": dataclasses.asdict(self.selection),
            "nuisances": {nuisance.name: nuisance.how for nuisance in self.nuisances},
            **self.view.provenance(),
            **scaled,
            "versions": versions(),
        }

    @property
    def _mean_spp(self) -> float:
        """Paths per pixel; none where none is random."""
        if self.view.deterministic:
            return 0
        return self.paths.spp if self.plan is None else self.plan.mean_spp(self.mask)

    def noise(self, model: NoiseModel | None) -> tuple[NoiseModel, str]:
        """The noise model, checked against the image, and where it came from."""
        found: NoiseModel
        if self.view.measured.depth is not None:
            found, origin = noise_of_depth(self.options, model, float(abs(self.view.camera.focal[0])))
        elif model is None:
            exposure = self.exposure
            found = exposure.noise(clip=self.options.clip)
            origin = exposure.origin
        else:
            found, origin = as_noise_model(model), "given"
            if self.options.exposure is not None or not self.options.clip:
                raise OptionError(
                    "--exposure and --no-clip (exposure=, clip=) are of the default noise, and --sigma and "
                    "--noise (noise=, sigma=) of another; leave out one or the other"
                )
        found = self.view.measured.noise(found)
        found.check(self.mask.shape[0], self.mask.shape[1], 3)
        return found, origin

    @cached_property
    def exposure(self) -> Exposure:
        """That of the default camera.

        Raises:
            NoiseError: the image is black, and no exposure is given.
        """
        if isinstance(self.options.exposure, float):
            return Exposure(self.options.exposure, "given")
        if self.view.white is not None:
            return Exposure(self.view.white, self.view.measured.unit)
        finish = start_metering(self.view, self.options.seed)
        _ = self.method  # while these paths are traced
        found = exposed(*finish())
        if found is None:
            raise NoiseError(
                f"the image is black ({self.view.nothing_visible(black=True)}), so no default noise follows "
                "from it: give --sigma X (noise.Gaussian(X))"
            )
        return found

    @cached_property
    def expected(self) -> ExpectedImage:
        """What noise may depend on."""
        return ExpectedImage(self.view, self.options.seed, self.options.tile)

    def warn_of_limits(self) -> None:
        """Warn of what the arithmetic does not resolve, and by name of what the method cannot see here."""
        for text in self.view.precision_limits():
            warnings.warn(text, PrecisionWarning, stacklevel=4)
        for text in method_of(self.view.methods, self.options.method).limits(self.view):
            warnings.warn(text, BlindSpotWarning, stacklevel=4)

    def at(self, pose: NDArray[np.float64], /, **options: Unpack[MeasurementKeywords]) -> Measurement:
        """The same measurement of the view from another pose (4, 4), perhaps with some other options."""
        return dataclasses.replace(
            self, view=self.view.at(pose), options=dataclasses.replace(self.options, **options)
        )

    def planned(self, plan: Plan, *, final: bool = True) -> Measurement:
        """The same with paths where a plan says, by its random numbers; what has been prepared is shared.

        Args:
            plan: for these pixels.
            final: whether what comes of it is the answer, of which `on_tile` is told.
        """
        options = self.options if final else dataclasses.replace(self.options, on_tile=None)
        following = dataclasses.replace(self, plan=plan, options=options)
        _ = self.expected  # else each would render it anew
        prepared = ("method", "exposure", "expected")
        vars(following).update({name: value for name, value in vars(self).items() if name in prepared})
        return following

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
        even: bool = False,
    ) -> NDArray[np.float64]:
        """(batches, n, 3) the image at some pixels (n, 2), by random numbers of a purpose of their own.

        Args:
            paths: those of the Jacobian by default.
            pose: the view's own by default.
            even: see `Measurable.start_image`.
        """
        start = self.view.start_image
        return start(pixels, paths or self.paths, purpose=purpose, pose=pose, even=even)()

    def jacobian(self, *, pilot: bool = False) -> ImageJacobian:
        """The Jacobian of every selected pixel, held at once, row by row; `pilot` as for `tiles`."""
        image = np.full((*self.mask.shape, 3), np.nan)
        expected, error = np.full_like(image, np.nan), np.zeros_like(image)
        measured = np.zeros_like(self.mask)
        place = (np.cumsum(self.mask) - 1).reshape(self.mask.shape)
        values = np.empty((self.options.batches, int(self.mask.sum()), 3, 6 + len(self.parameters)))
        bias = np.zeros(values.shape[1])
        for part in self.tiles(pilot=pilot):
            x, y = part.pixels.T
            image[y, x], expected[y, x], measured[y, x] = part.mean, part.expected, True
            error[y, x] = 0.0 if part.pilot_error is None else part.pilot_error
            values[:, place[y, x]] = part.all_values
            bias[place[y, x]] = part.bias
        kept = measured[self.mask]
        return ImageJacobian(
            batch_values=values if kept.all() else values[:, kept],
            pixels=subset.selected(measured),
            image=image,
            linearisation=self.linearisation,
            block=self.block,
            parameters=self.parameters,
            pilot=expected if pilot else None,
            pilot_error=error if pilot else None,
            bias=bias[kept] if bias.any() else None,
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
            pixels = np.concatenate([part.pixels for part in parts])
            accumulator.add_coupled(values, noise, pixels, np.concatenate([part.bias for part in parts]))
            for part in parts:
                self.differences.add(part)
            return
        for part, weights in self.weighted_tiles(noise):
            accumulator.add(part.all_values, weights, part.pixels, part.bias, part.weight_bias)
            self.differences.add(part)

    def information(self, noise: NoiseModel) -> FisherInformation:
        """Of the pose, in the camera frame, with all nuisances known."""
        return self.joint_information(noise).fix().information

    def joint_information(self, noise: NoiseModel) -> JointInformation:
        """Of the pose and the nuisances, with nothing decided of any."""
        return self.summed(noise)[0]

    def summed(self, noise: NoiseModel) -> tuple[JointInformation, BlockProducts]:
        """The joint information, and what each unit of pixels contributed."""
        accumulator = JointAccumulator(
            self.parameters,
            batches=self.options.batches,
            block=self.block,
            sampled=self.selection.kind == "random",
            coupled=noise.couples_pixels,
        )
        self.sum_into(accumulator, noise)
        return with_unknown_map(accumulator.information(self.linearisation), self, noise), accumulator.kept

    def weighted_tiles(self, noise: IndependentNoise) -> Iterator[tuple[TileJacobian, NDArray[np.float64]]]:
        """The Jacobian, one tile after the other, and a noise model's weights there."""
        for part in self.tiles(noise):
            assert part.weights is not None
            self.saturation.add(part.expected, noise)
            yield part, part.weights

    def tiles(self, noise: IndependentNoise | None = None, *, pilot: bool = False) -> Iterator[TileJacobian]:
        """The Jacobian, one tile after the other.

        Args:
            noise: gives the tiles its weights, and a pilot if it depends on the image.
            pilot: also render the image by other random numbers, for any noise that depends on it: the
                Jacobian's own has its errors in common with it, which would bias the information.
        """
        efforts = list(self._efforts())
        least = min(paths.spp for paths, _ in efforts)
        total = sum(int(mask.sum()) * (paths.spp // least) for paths, mask in efforts)
        done, measured, invalid = 0, 0, 0
        parts = [(pixels, paths) for paths, mask in efforts for pixels in subset.tiles(mask, self.tile)]
        for (pixels, paths), (columns, images, image, causes, step_bias) in tile_by_tile(self.method, parts):
            if self.told is not None:
                columns *= self.told[pixels[:, 1], pixels[:, 0], None, None]
            values, film = columns[..., :6], columns[..., 6:]
            others = None
            if self.nuisances:
                others = nuisance_columns(self.nuisances, self.view, pixels, images, film, paths)
            done += len(pixels) * (paths.spp // least)
            measured += len(pixels)
            # An image without noise is its own pilot.
            needed = not self.view.deterministic and (pilot or (noise is not None and noise.depends_on_mean))
            expected, error = self.expected.of(pixels, image, noise, paths.spp) if needed else (None, None)
            tile = TileJacobian(
                values, pixels, image, others, expected, error, causes, step_bias, spp=paths.spp
            ).finite()
            if noise is not None:
                tile = tile.weighed(noise, self.told)
            invalid += len(pixels) - len(tile.pixels)
            if self.options.on_tile is not None:
                self.options.on_tile(tile, done, total)
            if self.options.on_progress is not None:
                before = 0 if self.plan is None else self.plan.before // least
                self.options.on_progress(before + done, before + total)
            if self.options.drop_invalid or not invalid:
                yield tile
        self.check_valid(invalid, measured)

    def _efforts(self) -> Iterator[tuple[Paths, NDArray[np.bool_]]]:
        """Which paths which pixels (H, W) get."""
        if self.plan is None:
            yield self.paths, self.mask
        else:
            yield from self.plan.efforts(self.mask, self.options.batches)


@contextlib.contextmanager
def measurement(
    scene: Any, *, nuisances: Sequence[str] = (), **options: Unpack[MeasurementKeywords]
) -> Iterator[Measurement]:
    """A view, opened as `MeasurementOptions` and `pose_bound` say; unchanged afterwards."""
    given = MeasurementOptions(**options)
    if given.measure == RGBD:
        raise OptionError(
            "rgbd is two measurements, of which a bound is the sum; here give --measure colour or depth "
            "(measure=)"
        )
    with open_measurable(scene, given, apart=name_parameters(nuisances)) as view:
        method = method_of(view.methods, given.method)
        told = view.telling()
        mask, selection = subset.choose(
            given.pixels,
            view.size,
            given.seed,
            lambda: whole_pilot(view, Paths(PILOT_SPP, given.seed, 1), given.tile),
            told,
        )
        side = tile_side(tuple(nuisances), sampled=selection.kind == "random")
        visible = view.visible_depth
        yield Measurement(
            view=view,
            options=given,
            tile=given.tile if side is None else side * max(1, given.tile // side),
            nuisances=view.open_nuisances(nuisances, method),
            length_scale=float(np.median(visible)) if visible.size else 1.0,
            mask=mask if told is None else subset.telling(mask, told),
            selection=selection,
            told=told,
        )
