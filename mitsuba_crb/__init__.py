"""How precisely could any algorithm estimate this camera's pose from this image of this scene?

The public API, loaded on first use (PEP 562), so that the NumPy half imports without Mitsuba. If Mitsuba is
imported after this package, Dr.Jit finds an LLVM.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from . import pip_llvm

if TYPE_CHECKING:
    from . import errors as errors
    from . import message as message
    from . import noise as noise
    from . import se3 as se3
    from .bayesian import van_trees as van_trees
    from .bound import PoseBound as PoseBound
    from .bound import cramer_rao_bound as cramer_rao_bound
    from .coordinates import to_coordinates as to_coordinates
    from .fusion import Agent as Agent
    from .fusion import fuse as fuse
    from .information import FisherInformation as FisherInformation
    from .information import ImageJacobian as ImageJacobian
    from .information import fisher_information as fisher_information
    from .information_filter import InformationFilter as InformationFilter
    from .joint import JointInformation as JointInformation
    from .joint import joint_information as joint_information
    from .measure import pose_bound as pose_bound
    from .measure import pose_jacobian as pose_jacobian
    from .measure_displaced import hcr_bound as hcr_bound
    from .measure_tiles import tile_information as tile_information
    from .prior import PosePrior as PosePrior
    from .prior import load_prior as load_prior
    from .scene import load_scene as load_scene
    from .selection import select_tiles as select_tiles
    from .tiles import Budget as Budget
    from .trials import validate as validate
    from .validation import check_jacobian as check_jacobian

pip_llvm.name_to_drjit()

__version__ = "0.1.0"

_HOME = {
    "van_trees": "bayesian",
    "PoseBound": "bound",
    "cramer_rao_bound": "bound",
    "Agent": "fusion",
    "fuse": "fusion",
    "to_coordinates": "coordinates",
    "FisherInformation": "information",
    "ImageJacobian": "information",
    "fisher_information": "information",
    "JointInformation": "joint",
    "joint_information": "joint",
    "hcr_bound": "measure_displaced",
    "pose_bound": "measure",
    "pose_jacobian": "measure",
    "InformationFilter": "information_filter",
    "tile_information": "measure_tiles",
    "PosePrior": "prior",
    "load_prior": "prior",
    "load_scene": "scene",
    "select_tiles": "selection",
    "Budget": "tiles",
    "validate": "trials",
    "check_jacobian": "validation",
}
_MODULES = ("errors", "message", "noise", "se3")

__all__ = [*_HOME, *_MODULES, "__version__"]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(f".{_HOME[name]}", __name__), name)
    if name in _MODULES:
        return importlib.import_module(f".{name}", __name__)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
