"""A multi-channel OpenEXR image of a view: radiance, six Jacobian columns, information."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import OutputError
from ..files import atomic
from ..measure.pictures import Pictures

COLUMN_NAMES = ("dI_drho_x", "dI_drho_y", "dI_drho_z", "dI_dphi_x", "dI_dphi_y", "dI_dphi_z")
"""EXR layers of the six Jacobian columns, in twist order: translation [radiance / scene unit], then
rotation [radiance / rad]. The channels of a layer are `R`, `G`, `B`, as in `dI_drho_x.R`."""


SHARE_NAME = "weakest_share"
"""EXR layer of each pixel's share of the information about the weakest direction, with channel `Y`."""


def write_exr(
    path: Path, pictures: Pictures, attributes: Mapping[str, str | int | float] | None = None
) -> None:
    """Write the image (`R`, `G`, `B`) and the six columns (`dI_drho_x.R` ... `dI_dphi_z.B`) in float32.

    The channel `weakest_share.Y` is each pixel's share of the information about the weakest direction that is
    seen; the header entries `weakest` and `weakest_direction` say which one that is.

    Args:
        path: the file to write.
        pictures: what to write; pixels that were not measured are NaN in every channel.
        attributes: further header entries beside frame, twist order, units, pose and length scale.
    """
    import OpenEXR

    channels = dict(zip("RGB", np.moveaxis(pictures.image, -1, 0), strict=True))
    for axis, name in enumerate(COLUMN_NAMES):
        for channel, plane in zip("RGB", np.moveaxis(pictures.columns[..., axis], -1, 0), strict=True):
            channels[f"{name}.{channel}"] = plane
    header: dict[str, Any] = {}
    if pictures.weakest is not None:
        channels[f"{SHARE_NAME}.Y"] = pictures.weakest_share.astype(np.float32)
        header["weakest"] = pictures.weakest.description
        header["weakest_direction"] = " ".join(f"{v:.9g}" for v in pictures.weakest.direction)
    header |= {
        **(attributes or {}),
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "frame": pictures.frame,
        "twist_order": " ".join(name.removeprefix("dI_d") for name in COLUMN_NAMES),
        "units": "radiance, radiance / scene unit (rho), radiance / rad (phi)",
        "world_from_camera": np.asarray(pictures.pose, np.float64),
        "length_scale": float(pictures.length_scale),
    }
    planes = {name: np.ascontiguousarray(plane) for name, plane in channels.items()}
    with atomic(path) as temporary:
        try:
            OpenEXR.File(header, planes).write(str(temporary))
        except RuntimeError as error:  # how OpenEXR reports a full disk
            raise OutputError(f"cannot write {path}: {error}") from error
