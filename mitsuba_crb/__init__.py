"""How precisely could any algorithm estimate this camera's pose from this image of this scene?

The public API, loaded on first use (PEP 562), so that the NumPy half imports without Mitsuba. If Mitsuba is
imported after this package, Dr.Jit finds an LLVM.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from .render import pip_llvm

if TYPE_CHECKING:
    from . import errors as errors
    from . import noise as noise
    from . import se3 as se3
    from .agents import message as message
    from .agents.fusion import Agent as Agent
    from .agents.fusion import fuse as fuse
    from .agents.information_filter import InformationFilter as InformationFilter
    from .agents.selection import select_tiles as select_tiles
    from .agents.tiles import Budget as Budget
    from .bound.coordinates import to_coordinates as to_coordinates
    from .bound.cramer_rao import PoseBound as PoseBound
    from .bound.cramer_rao import cramer_rao_bound as cramer_rao_bound
    from .bound.prior import PosePrior as PosePrior
    from .bound.prior import load_prior as load_prior
    from .camera import Intrinsics as Intrinsics
    from .datasets.captures import load_capture as load_capture
    from .datasets.intrinsics import load_camera as load_camera
    from .datasets.photographs import Capture as Capture
    from .datasets.pose_list import Poses as Poses
    from .datasets.poses import load_poses as load_poses
    from .estimate.trials import validate as validate
    from .information.fisher import FisherInformation as FisherInformation
    from .information.image_information import fisher_information as fisher_information
    from .information.image_jacobian import ImageJacobian as ImageJacobian
    from .information.joint import JointInformation as JointInformation
    from .information.joint import joint_information as joint_information
    from .information.linearisation import Linearisation as Linearisation
    from .information.linearisation import PixelSelection as PixelSelection
    from .measure.bayesian import van_trees as van_trees
    from .measure.check import check_jacobian as check_jacobian
    from .measure.displaced import hcr_bound as hcr_bound
    from .measure.pose import pose_bound as pose_bound
    from .measure.pose import pose_jacobian as pose_jacobian
    from .measure.pose_table import PoseTable as PoseTable
    from .measure.poses import pose_bounds as pose_bounds
    from .measure.poses import pose_table as pose_table
    from .measure.tiles import tile_information as tile_information
    from .planning.candidates import parse_candidates as parse_candidates
    from .planning.field_run import measure_field as measure_field
    from .planning.view_field import open_field as open_field
    from .render.scene import SceneFile as SceneFile
    from .render.scene import load_scene as load_scene
    from .render.world import load_world as load_world

pip_llvm.name_to_drjit()

__version__ = "0.2.0"

_HOME = {
    "van_trees": "measure.bayesian",
    "PoseBound": "bound.cramer_rao",
    "cramer_rao_bound": "bound.cramer_rao",
    "Agent": "agents.fusion",
    "fuse": "agents.fusion",
    "to_coordinates": "bound.coordinates",
    "FisherInformation": "information.fisher",
    "ImageJacobian": "information.image_jacobian",
    "fisher_information": "information.image_information",
    "JointInformation": "information.joint",
    "joint_information": "information.joint",
    "Linearisation": "information.linearisation",
    "PixelSelection": "information.linearisation",
    "hcr_bound": "measure.displaced",
    "pose_bound": "measure.pose",
    "pose_jacobian": "measure.pose",
    "PoseTable": "measure.pose_table",
    "pose_bounds": "measure.poses",
    "pose_table": "measure.poses",
    "InformationFilter": "agents.information_filter",
    "measure_field": "planning.field_run",
    "open_field": "planning.view_field",
    "parse_candidates": "planning.candidates",
    "tile_information": "measure.tiles",
    "PosePrior": "bound.prior",
    "load_prior": "bound.prior",
    "SceneFile": "render.scene",
    "load_scene": "render.scene",
    "Intrinsics": "camera",
    "load_camera": "datasets.intrinsics",
    "Capture": "datasets.photographs",
    "load_capture": "datasets.captures",
    "Poses": "datasets.pose_list",
    "load_poses": "datasets.poses",
    "load_world": "render.world",
    "select_tiles": "agents.selection",
    "Budget": "agents.tiles",
    "validate": "estimate.trials",
    "check_jacobian": "measure.check",
}
_MODULES = {"errors": "errors", "message": "agents.message", "noise": "noise", "se3": "se3"}

__all__ = [*_HOME, *_MODULES, "__version__"]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(f".{_HOME[name]}", __name__), name)
    if name in _MODULES:
        return importlib.import_module(f".{_MODULES[name]}", __name__)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
