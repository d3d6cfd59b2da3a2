"""Cameras: what a calibration says of one, what its lens does, and where points land on its film."""

from __future__ import annotations

from .distortion import Distortion as Distortion
from .intrinsics import LENS_MODELS as LENS_MODELS
from .intrinsics import Intrinsics as Intrinsics
from .intrinsics import image_size as image_size
from .projection import Camera as Camera
