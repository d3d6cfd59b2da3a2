"""Noise models and sensor responses: what the camera does to each pixel's linear radiance.

`protocol` says what a model must offer; `schema` how one is written in TOML.
"""

from __future__ import annotations

from .clipped import Clipped as Clipped
from .colour import ColourBlocks as ColourBlocks
from .colour import Luminance as Luminance
from .curves import SRGB as SRGB
from .curves import Curve as Curve
from .curves import Linear as Linear
from .curves import Power as Power
from .curves import Tabulated as Tabulated
from .estimate import NoiseEstimate as NoiseEstimate
from .estimate import estimate_noise as estimate_noise
from .gaussian import Gaussian as Gaussian
from .gaussian import PerChannel as PerChannel
from .gaussian import PerPixel as PerPixel
from .heavy_tails import Laplace as Laplace
from .heavy_tails import StudentT as StudentT
from .heteroscedastic import Heteroscedastic as Heteroscedastic
from .low_rank import LowRankPlusDiagonal as LowRankPlusDiagonal
from .measured import Measured as Measured
from .poisson_gaussian import PoissonGaussian as PoissonGaussian
from .protocol import CoupledNoise as CoupledNoise
from .protocol import IndependentNoise as IndependentNoise
from .protocol import NoiseModel as NoiseModel
from .protocol import ScalarNoise as ScalarNoise
from .protocol import ThresholdNoise as ThresholdNoise
from .schema import from_dict as from_dict
from .schema import load as load
from .sensor import Quantisation as Quantisation
from .sensor import Sensor as Sensor
from .sigma_of_mean import SigmaPower as SigmaPower
from .sigma_of_mean import SigmaTable as SigmaTable
from .sigma_of_mean import Stereo as Stereo
from .sparse import SparsePrecision as SparsePrecision
from .stationary import Periodic as Periodic
from .stationary import Stationary as Stationary
