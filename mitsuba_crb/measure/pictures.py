"""The image, its Jacobian and its information, pixel by pixel, for those who look at them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from .. import se3
from ..files import Record
from ..information.identifiability import PoseDirection, weakest_direction
from ..information.pixel_information import along, pixel_information
from ..information.significance import identified
from ..information.symmetric import pack

if TYPE_CHECKING:
    from ..information.fisher import FisherInformation
    from ..information.image_jacobian import ImageJacobian
    from ..noise import IndependentNoise


@dataclass(frozen=True)
class Pictures(Record):
    """The image, its Jacobian and its information density; NaN where a pixel was not measured."""

    image: npt.NDArray[np.float32]
    """(H, W, C) linear RGB [radiance]."""
    columns: npt.NDArray[np.float32]
    """(H, W, C, 6) dI/dξ in `frame` [radiance / scene unit], then [radiance / rad]."""
    information: npt.NDArray[np.float64]
    """(H, W) each pixel's unbiased share of the trace of the Fisher information in the camera frame with
    translation scaled by the length scale; negative by chance where there is hardly any."""
    weakest_share: npt.NDArray[np.float64]
    """(H, W) each pixel's share of the information about `weakest`, without bias; NaN if nothing is seen."""
    weakest: PoseDirection | None
    """The direction that the image sees worst but does see."""
    frame: Literal["camera", "world"]
    """Frame of `columns`."""
    pose: npt.NDArray[np.float64]
    """`world_from_camera`, 4x4, the linearisation point."""
    length_scale: float
    """Median visible depth [scene unit]."""
    paths: npt.NDArray[np.float32] | None = None
    """(H, W) how many paths each pixel had; None where there are none, or nobody said."""


class Gathering:
    """Takes tiles as they are measured, keeps of each what `Pictures` need, and composes them."""

    def __init__(self) -> None:
        self._tiles: list[tuple[Any, ...]] = []

    def add(
        self,
        pixels: npt.NDArray[np.integer],
        mean: npt.NDArray[np.float64],
        batch_values: npt.NDArray[np.float64],
        weights: npt.NDArray[np.float64] | None = None,
        spp: int = 0,
    ) -> None:
        """Take over some pixels.

        Args:
            pixels: (n, 2) columns and rows.
            mean: (n, C) the image there.
            batch_values: (K, n, C, 6) independent estimates of dI/dξ in the camera frame.
            weights: (n, C) or (n, C, C), of the noise [1 / radiance²]; None: unit variance.
            spp: paths of each of them; 0: there are none.
        """
        weights = np.ones_like(mean) if weights is None else weights
        values = np.mean(batch_values, axis=0).astype(np.float32)
        own = pixel_information(batch_values, weights)
        self._tiles.append((np.array(pixels), mean.astype(np.float32), values, own, np.float32(spp)))

    def pictures(
        self,
        information: FisherInformation,
        size: tuple[int, int],
        *,
        frame: Literal["camera", "world"] = "camera",
    ) -> Pictures:
        """Compose what was gathered.

        Args:
            information: what became of the same pixels: its pose, length scale and selection.
            size: width and height of the image [pixel].
            frame: of the columns.
        """
        width, height = size
        channels = self._tiles[0][1].shape[1] if self._tiles else 3
        image = np.full((height, width, channels), np.nan, np.float32)
        columns = np.full((height, width, channels, 6), np.nan, np.float32)
        density, share = np.full((2, height, width), np.nan)
        paths = np.full((height, width), np.nan, np.float32)
        found = identified(information)
        weakest = weakest_direction(found, information.pose, information.length_scale)
        selection, length = information.selection, information.length_scale
        diagonal = pack(np.diag(information.scale**2))
        scale = selection.total / selection.selected if selection.kind == "random" else 1.0
        turn = np.eye(6) if frame == "camera" else se3.adjoint(se3.inverse(information.pose))
        for pixels, mean, values, own, spp in self._tiles:
            x, y = pixels.T
            image[y, x] = mean
            paths[y, x] = spp
            columns[y, x] = values @ turn  # dI/dξ_world = dI/dξ_camera · Ad(camera_from_world)
            density[y, x] = scale * (own @ diagonal)
            if weakest is not None:
                share[y, x] = along(own, weakest.direction * information.scale)
        if weakest is not None:
            share /= np.nansum(share)
        return Pictures(
            image,
            columns,
            density,
            share,
            weakest,
            frame,
            information.pose,
            length,
            paths if np.nansum(paths) > 0.0 else None,
        )


def pictures_of(
    jacobian: ImageJacobian, information: FisherInformation, noise: IndependentNoise | None = None
) -> Pictures:
    """The pictures of a Jacobian held whole, its columns in the camera frame."""
    jacobian = jacobian.to_frame("camera")
    gathering = Gathering()
    weights = None if noise is None else noise.weights(jacobian.pixels, jacobian.expected)
    gathering.add(jacobian.pixels, jacobian.mean, jacobian.batch_values, weights)
    height, width = jacobian.image.shape[:2]
    return gathering.pictures(information, (width, height))
