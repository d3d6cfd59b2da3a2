"""What a camera is told to measure, made into a `Measured`: options that only go with some of it are refused.

A depth camera's noise is that of depth: a standard deviation [scene unit], constant, against depth from a
table, or by the law of stereo; by default a hundredth of the depth.
"""

from __future__ import annotations

from difflib import get_close_matches
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import NoiseError, OptionError
from ..files import read_rows
from ..information.image_information import as_noise_model
from ..noise import Gaussian, NoiseModel, SigmaPower, SigmaTable, Stereo
from ..noise.measured import CHANNELS, DepthPixels, Measured, depth
from ..noise.parameters import positive

if TYPE_CHECKING:
    from .options import MeasurementOptions

COLOUR, DEPTH, RGBD = "colour", "depth", "rgbd"
MEASURES = (COLOUR, DEPTH, RGBD)
"""What may be measured."""
DEFAULT_DEPTH_NOISE = SigmaPower(0.01, 1.0)
"""Of a depth camera that nobody said more of."""
OF_DEPTH = ("depth_sigma", "depth_range", "depth_edges")
"""Options of a depth camera alone."""
_HERE = Path()
DepthSigma = float | Stereo | NoiseModel
"""Standard deviation of depth [scene unit], the law of a stereo camera, or a noise model of depth."""


def measured_by(options: MeasurementOptions) -> Measured | None:
    """What is measured; None: what the film does. Of "rgbd" it is the colour's.

    Raises:
        OptionError: an unknown name, an impossible range, or what does not go together.
    """
    _known("measure", options.measure, MEASURES)
    if options.channels is not None:
        _known("channels", options.channels, tuple(CHANNELS))
    if options.depth_sigma is not None:
        depth_noise(options.depth_sigma, 1.0)
    if options.measure == COLOUR:
        for option, value in {
            "--depth-sigma (depth_sigma=)": options.depth_sigma is not None,
            "--range (depth_range=)": options.depth_range is not None,
            "--depth-edges (depth_edges=)": options.depth_edges,
        }.items():
            if value:
                raise OptionError(f"{option} is of a depth camera: give --measure depth or rgbd (measure=)")
    pixels = DepthPixels(*_range(options.depth_range), edges=options.depth_edges)
    if options.measure != DEPTH:
        return None if options.channels is None else CHANNELS[options.channels]
    if options.channels is not None:
        raise OptionError("--channels (channels=) is of colour, and --measure depth has none; leave it out")
    return depth(pixels)


def depth_noise(sigma: DepthSigma | None, focal_length: float) -> tuple[NoiseModel, str]:
    """Noise of depth, and where it came from.

    Args:
        sigma: as `MeasurementOptions.depth_sigma`.
        focal_length: along the camera's x [pixel].

    Raises:
        NoiseError: a standard deviation that is not positive.
    """
    if sigma is None:
        return DEFAULT_DEPTH_NOISE, "0.01 of the depth"
    if isinstance(sigma, Stereo):
        return sigma.noise(focal_length), f"stereo, baseline {sigma.baseline:g}"
    if isinstance(sigma, Real):
        return Gaussian(positive(sigma, "sigma of depth", "scene unit")), "given"
    return as_noise_model(sigma), "given"


def noise_of_depth(
    options: MeasurementOptions, model: NoiseModel | None, focal_length: float
) -> tuple[NoiseModel, str]:
    """As `depth_noise`, of a camera that has no exposure, and of which `model` would be of colour.

    Raises:
        OptionError: something is said of colour.
    """
    if model is not None or options.exposure is not None or not options.clip:
        raise OptionError(
            "--sigma, --noise, --exposure and --no-clip (noise=, exposure=, clip=) are of colour; "
            "--depth-sigma (depth_sigma=) is of depth"
        )
    return depth_noise(options.depth_sigma, focal_length)


def parse_depth_sigma(
    text: str | None, option: str = "--depth-sigma", folder: Path = _HERE
) -> DepthSigma | None:
    """A number, "stereo:BASELINE,PIXELS", or a file with depths and standard deviations in two columns.

    Args:
        text: what was said.
        option: what errors call it.
        folder: where the file is.

    Raises:
        NoiseError: numbers that cannot be.
        OptionError: it is none of these.
    """
    if text is None:
        return None
    kind, _, numbers = text.partition(":")
    if kind.strip() == "stereo":
        try:
            baseline, pixels = map(float, numbers.split(","))
        except ValueError:
            raise OptionError(
                f"{option} {text!r}: stereo needs the baseline [scene unit] and the standard deviation "
                "of the disparity [pixel], such as stereo:0.05,0.1"
            ) from None
        return Stereo(baseline, pixels)
    try:
        number = float(text)
    except ValueError:
        pass
    else:
        return positive(number, option, "scene unit")
    file = folder / text
    if not file.exists():
        raise OptionError(
            f"{option} {text!r} is neither a number [scene unit], nor stereo:BASELINE,PIXELS, nor a "
            "file with depths and standard deviations in two columns"
        )
    rows = read_rows(file, OptionError)
    if rows.ndim != 2 or rows.shape[1] != 2:
        raise OptionError(f"{option} {file}: expected two columns, depth and sigma, got {rows.shape}")
    try:
        return SigmaTable(rows[:, 0], rows[:, 1])
    except NoiseError as error:
        raise NoiseError(f"{option} {file}: {error}") from error


def parse_range(text: str | None) -> tuple[float, float] | None:
    """Lowest and highest depth [scene unit] from "LO:HI", of which either may be left out."""
    if text is None:
        return None
    low, colon, high = text.partition(":")
    try:
        if not colon:
            raise ValueError
        return float(low or 0.0), float(high or "inf")
    except ValueError:
        raise OptionError(f"--range {text!r} is not LO:HI, two depths such as 0.4:5") from None


def _known(option: str, name: Any, known: tuple[str, ...]) -> None:
    if name not in known:
        near = get_close_matches(str(name), known, 1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise OptionError(f"--{option} ({option}=): unknown {name!r}; {hint}there are: {', '.join(known)}")


def _range(given: Any) -> tuple[float, float]:
    if given is None:
        return 0.0, float("inf")
    try:
        low, high = map(float, given)
    except (TypeError, ValueError):
        raise OptionError(f"--range (depth_range=) is two depths, not {given!r}") from None
    if not 0.0 <= low < high:
        raise OptionError(
            f"--range (depth_range=) {low:g}:{high:g} is empty: it must be LO:HI with 0 <= LO < HI"
        )
    return low, high
