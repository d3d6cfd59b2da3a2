"""Informations of many views as informations about one body, whose axes are the world's.

A body at world_from_body carries the views, their relative poses exactly known; a view's twist is A ξ with
A = Ad(camera_from_body), so that its information about the body is AᵀFA, and those of several views add. The
twist is a right one at the body's origin: far from the world's origin no digits are lost.

What decides (a choice of views, a filter) is not linear in F and takes the part of F that is seen, as
`significance` says: the `rank` leading eigenvectors in the camera's frame, translation in length scales.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import se3
from ..errors import PlanError
from ..information.fisher import FisherInformation
from ..information.linearisation import Linearisation, PixelSelection
from ..se3 import Array
from .view_field import BODY, ViewField


def refuse_prior(field: ViewField) -> None:
    """Refuse a field whose ranks have a prior in them, so that they do not say what the views see.

    Raises:
        PlanError: it has.
    """
    if field.settings.get("prior"):
        raise PlanError(
            "the field was measured with a prior, which would count again with every view: measure it "
            "without, and say what is known to the plan"
        )


def body_at(point: ArrayLike) -> Array:
    """The pose, 4 x 4, of a body at a point, with the world's axes."""
    pose = np.eye(4)
    pose[:3, 3] = point
    return pose


def seen_roots(field: ViewField, views: NDArray[np.intp], body: Array) -> Array:
    """R (m, 6, 6) with R Rᵀ what is seen of the information of some views, about a body; unscaled."""
    data = field.dataset
    scale = np.ones((len(views), 6))
    scale[:, :3] = data["length_scale"].values[views][:, None]
    F = scale[:, :, None] * data["information_camera"].values[views] * scale[:, None, :]
    values, vectors = np.linalg.eigh(F)
    seen = np.arange(6) >= 6 - field.rank[views][:, None]
    roots = vectors * np.sqrt(np.where(seen, np.maximum(values, 0.0), 0.0))[:, None, :] / scale[:, :, None]
    moved = np.array([se3.adjoint(se3.inverse(pose) @ body) for pose in field.poses[views]]).reshape(-1, 6, 6)
    found: Array = moved.mT @ roots
    return found


def seen_blocks(field: ViewField, views: NDArray[np.intp], body: Array) -> Array:
    """(m, 6, 6), R Rᵀ of the same."""
    roots = seen_roots(field, views, body)
    blocks: Array = roots @ roots.mT
    return blocks


def information_about(field: ViewField, view: int, body: Array) -> FisherInformation:
    """One view's whole information, with its uncertainty, about a body, in the body's frame."""
    data = field.dataset.isel(view=view)
    pose = np.asarray(data["world_from_camera"].values, dtype=np.float64)
    pixels = int(data["pixels"])
    information = FisherInformation(
        matrix=data["information_camera"].values,
        covariance_of_entries=data["covariance_of_entries"].values,
        linearisation=Linearisation(
            variable=BODY,
            frame="camera",
            pose=pose,
            length_scale=float(data["length_scale"]),
            selection=PixelSelection("all", pixels, pixels, "all"),
        ),
    )
    return information.transform(
        se3.adjoint(se3.inverse(pose) @ body), variable=BODY, frame="camera", pose=body
    )
