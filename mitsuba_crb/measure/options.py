"""What every measurement of a view can be told: one place for names, meanings, defaults and checks.

The command line and the teams' files read their defaults here; so nothing heavy is imported before an option
has to be checked.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any, Literal, TypedDict

from ..errors import OptionError

if TYPE_CHECKING:
    from ..camera import Intrinsics
    from ..noise import Measured
    from .adaptive import Round
    from .sensing import DepthSigma
    from .tile_jacobian import TileJacobian

Progress = Callable[["TileJacobian", int, int], None]
"""Called after each tile with its Jacobian, the pixels done and the pixels in total; of those with unequal
paths, each counts as often as it has the fewest."""


class MeasurementKeywords(TypedDict, total=False):
    """The fields of `MeasurementOptions`, for functions that take them as keywords."""

    sensor: int | str
    pose: Any
    method: str | None
    spp: int | None
    precision: float | None
    max_spp: int | None
    seed: int
    batches: int
    pixels: Any
    integrator: Any
    size: tuple[int, int] | None
    camera: Intrinsics | None
    tile: int
    drop_invalid: bool
    on_tile: Progress | None
    on_progress: Callable[[int, int], None] | None
    on_round: Callable[[Round], None] | None
    step_pixels: float | None
    exposure: float | Literal["auto"] | None
    clip: bool
    channels: str | None
    measure: str
    depth_sigma: DepthSigma | None
    depth_range: tuple[float, float] | None
    depth_edges: bool


@dataclass(frozen=True, eq=False)
class MeasurementOptions:
    """How a view is measured.

    Raises:
        OptionError: a value that cannot be used; what only the scene can tell is checked when it is opened.
    """

    sensor: int | str = 0
    """Index or id."""
    pose: Any = None
    """`world_from_camera`, 4x4 or `RigidTransform`, in place of the sensor's own."""
    method: str | None = None
    """A name in `jacobian.methods`, or of a field in `radiance.methods`; None is the first of them: flow, or
    exact."""
    spp: int | None = None
    """Paths per pixel over all batches, a multiple of `batches`; None is as many as `precision` takes, where
    they are needed, and `UNIFORM_SPP` where there is no bound to be precise. Finite differences trace 12
    times that, "forward" 6 times. Of a field, which has none, this, `precision` and `max_spp` say nothing."""
    precision: float | None = None
    """Relative standard error of every standard deviation that is seen; None is `PRECISION` if there is no
    `spp`."""
    max_spp: int | None = None
    """Most paths per pixel that a precision may take, over all rounds on average; None leaves it at
    `MAX_PATHS` in all."""
    seed: int = 0
    """Of all random numbers; equal calls give equal bits."""
    batches: int = 4
    """Independent estimates, at least 4."""
    pixels: Any = None
    """None (all), "random:f", "gradient:f", a boolean mask (H, W), or a mask image's path."""
    integrator: Any = None
    """In place of the scene's: an `mi.Integrator`, a plugin's name or a dictionary."""
    size: tuple[int, int] | None = None
    """Width and height [pixel] in place of the film's; removes a crop window."""
    camera: Intrinsics | None = None
    """In place of the sensor's focal length, principal point and film size, with the lens' distortion; where
    there is a `size`, too, scaled to it."""
    tile: int = 256
    """Side of the tiles [pixel], a multiple of 8; bounds the memory, not the result."""
    drop_invalid: bool = False
    """Leave out pixels whose radiance is not finite instead of raising."""
    on_tile: Progress | None = None
    """Called after each tile of the answer."""
    on_progress: Callable[[int, int], None] | None = None
    """Called after each tile of any round, with what is done and what is planned, in pixels' paths."""
    on_round: Callable[[Round], None] | None = None
    """Called after each round that a precision takes before the answer's."""
    step_pixels: float | None = None
    """Image motion of a finite-difference step [pixel]; other methods have none. None is the film's own
    (`finite_difference.step_for`): 0.15 with a Gaussian filter, 0.075 with a tent, 0.019 with a box."""
    exposure: float | Literal["auto"] | None = None
    """White of the default noise [radiance]; None sets it for all views of a run, "auto" for each."""
    clip: bool = True
    """Whether the default noise's camera saturates above white."""
    channels: str | None = None
    """Of colour: a name in `noise.measured.CHANNELS`; None is what the film measures."""
    measure: str = "colour"
    """A name in `sensing.MEASURES`; of "rgbd" colour and depth have independent noise."""
    depth_sigma: DepthSigma | None = None
    """Noise of depth: its standard deviation [scene unit], `Stereo`, or a model; None: 0.01 of the depth."""
    depth_range: tuple[float, float] | None = None
    """Lowest and highest depth that is measured [scene unit]; None: all that is seen."""
    depth_edges: bool = False
    """Whether depth is measured where one surface ends in front of another within a pixel's filter, too."""

    def __post_init__(self) -> None:
        from ..camera import Intrinsics, image_size
        from ..information.accumulate import MINIMUM_BATCHES
        from ..information.blocks import BLOCK

        for name in ("spp", "max_spp", "seed", "batches", "tile"):
            value = getattr(self, name)
            if value is None and name in ("spp", "max_spp"):
                continue
            if isinstance(value, bool) or not isinstance(value, Integral):
                raise OptionError(f"{name} must be a whole number; got {value!r}")
        if self.batches < MINIMUM_BATCHES:
            raise OptionError(
                f"batches must be at least {MINIMUM_BATCHES}, for standard errors without bias; got "
                f"{self.batches}"
            )
        self._check_paths()
        if not 0 <= self.seed < 1 << 64:
            raise OptionError(f"seed must lie in [0, 2^64); got {self.seed}")
        if self.tile <= 0 or self.tile % BLOCK:
            raise OptionError(f"tile must be a positive multiple of {BLOCK} pixels; got {self.tile}")
        step = self.step_pixels
        if step is not None and (not isinstance(step, Real) or not 0.0 < step < float("inf")):
            raise OptionError(f"step_pixels must be positive and finite, or None; got {step!r}")
        if self.exposure is not None and self.exposure != "auto":
            if not isinstance(self.exposure, Real) or not 0.0 < self.exposure < float("inf"):
                raise OptionError(
                    f"exposure must be a radiance, positive and finite, or 'auto'; got {self.exposure!r}"
                )
            object.__setattr__(self, "exposure", float(self.exposure))
        _ = self.measured
        if self.size is not None:
            object.__setattr__(self, "size", image_size(self.size))
        if self.camera is not None and not isinstance(self.camera, Intrinsics):
            raise OptionError(
                f"camera must be Intrinsics, as a calibration file is read into, or None; got {self.camera!r}"
            )

    def _check_paths(self) -> None:
        precision = self.precision
        if precision is not None and (not isinstance(precision, Real) or not 0.0 < precision < 1.0):
            raise OptionError(f"precision must lie between 0 and 1, such as 0.05 for 5 %; got {precision!r}")
        if self.spp is None:
            if self.max_spp is not None and self.max_spp < self.pilot_spp:
                raise OptionError(
                    f"max_spp {self.max_spp} is less than the {self.pilot_spp} paths of the first round; "
                    "raise it, or give spp for so few"
                )
            return
        for name in ("precision", "max_spp"):
            if getattr(self, name) is not None:
                raise OptionError(
                    f"spp gives every pixel as many paths, and {name} leaves that to the precision; leave "
                    "out one or the other"
                )
        if self.spp <= 0:
            raise OptionError(f"spp must be positive; got {self.spp}")
        if self.spp % self.batches:
            nearest = max(self.batches, round(self.spp / self.batches) * self.batches)
            raise OptionError(
                f"spp {self.spp} is not a multiple of batches {self.batches}; the nearest is {nearest}"
            )

    @property
    def measured(self) -> Measured | None:
        """What is measured; None: what the film does. Of "rgbd" it is the colour's."""
        from .sensing import measured_by

        return measured_by(self)

    @property
    def uniform_spp(self) -> int:
        """Paths per pixel where no precision decides on them."""
        return self.batches * max(1, round(UNIFORM_SPP / self.batches)) if self.spp is None else self.spp

    @property
    def goal(self) -> float:
        """The precision, where there is no `spp`."""
        return PRECISION if self.precision is None else self.precision

    @property
    def pilot_spp(self) -> int:
        """Paths per pixel of a precision's first round, and the least of any: a pair in each batch."""
        return 2 * self.batches


UNIFORM_SPP = 64
"""Default of `spp` where there is no bound that could be precise: Jacobians, images, estimators."""
PRECISION = 0.05
"""Default of `precision`."""
MAX_PATHS = 1 << 26
"""Default of what a precision may take, in all."""
CHECKING: MeasurementKeywords = {"batches": 8}
"""Defaults of `check_jacobian`: more batches than a bound's, for errors that are certain themselves."""
DISPLACING: MeasurementKeywords = {"tile": 64}
"""Defaults of `hcr_bound`: all displaced images of a tile are held at once."""
