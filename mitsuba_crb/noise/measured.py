"""What a camera measures of each pixel: colour, one channel of it, or depth.

Renderers give three numbers a pixel, μ. A camera of one channel measures y = l·μ of them (`Luminance`); a
depth camera's three numbers are all z, the depth along the optical axis, of which it measures one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import NoiseError
from .colour import REC709, Luminance
from .protocol import Array, CoupledNoise, NoiseModel

RADIANCE, DISPLAY_REFERRED = "radiance", "display-referred"
"""Units of colour: linear, and as photographs show it, where 1 is white."""


@dataclass(frozen=True)
class DepthPixels:
    """Which pixels tell a depth: those that see surfaces in a range, and perhaps no edge."""

    lowest: float = 0.0
    """Depth [scene unit]."""
    highest: float = float("inf")
    """Depth [scene unit]."""
    edges: bool = False
    """Whether those tell, too, that see one surface end in front of another."""


@dataclass(frozen=True)
class Measured:
    """What a camera measures."""

    name: str
    """In words."""
    mix: tuple[float, float, float] | None = None
    """l of a camera with one channel; None: all three are measured."""
    depth: DepthPixels | None = None
    """Where there is a depth; None: what is measured is light."""
    unit: str = RADIANCE
    """Of the values and of σ."""

    @property
    def is_colour(self) -> bool:
        """Whether all three numbers are measured."""
        return self.mix is None

    def values(self, image: Array) -> Array:
        """(..., 1 or 3) what is measured of an image (..., 3)."""
        return image if self.mix is None else np.asarray(image @ np.array(self.mix))[..., None]

    def noise(self, model: NoiseModel) -> NoiseModel:
        """Noise of the measured values, as noise of the image's three numbers.

        Raises:
            NoiseError: it couples pixels, and there is one channel.
        """
        if self.mix is None or isinstance(model, Luminance):
            return model
        if isinstance(model, CoupledNoise):
            raise NoiseError(f"coupled noise needs an rgb camera; this one measures {self.name}")
        return Luminance(model, self.mix)


COLOUR = Measured("colour")
CHANNELS = {
    "rgb": COLOUR,
    "luminance": Measured("luminance", REC709),
    "red": Measured("red", (1.0, 0.0, 0.0)),
    "green": Measured("green", (0.0, 1.0, 0.0)),
    "blue": Measured("blue", (0.0, 0.0, 1.0)),
}
"""Cameras of radiance, by the name of what they measure."""


def depth(pixels: DepthPixels) -> Measured:
    """A depth camera."""
    return Measured("depth", (1.0, 0.0, 0.0), pixels, "scene unit")
