"""A field of views as it is read: the bounds at many poses, in one xarray dataset.

Informations here are of the twist in the world frame, ξ with exp(ξ) @ world_from_camera. If one rigid body
carries several cameras, moving it moves all of them by the same ξ, so that their informations add.
"""

from __future__ import annotations

import importlib
import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..errors import StoreError
from ..information.fisher import FisherInformation
from ..information.linearisation import Linearisation, PixelSelection
from ..se3 import Array
from .layout import DONE, MEASURED, SCHEMA, VARIABLES

_AGAIN = "measure it again, into another store"

BODY = "body"
"""What the informations are about."""


@dataclass(frozen=True, eq=False)
class ViewField:
    """The bounds at many poses of one camera in one world."""

    dataset: Any
    """The `xarray.Dataset` of the store, see `layout`."""

    @property
    def poses(self) -> Array:
        """`world_from_camera` of each view (n, 4, 4)."""
        return self.values("world_from_camera")

    @property
    def place(self) -> NDArray[np.int64]:
        """(n,) which position each is at."""
        return self.values("place").astype(np.int64)

    @property
    def heading(self) -> NDArray[np.int64]:
        """(n,) which direction there."""
        return self.values("heading").astype(np.int64)

    @property
    def status(self) -> NDArray[np.int8]:
        """(n,) what became of each, see `layout`."""
        return self.values("status").astype(np.int8)

    @property
    def done(self) -> NDArray[np.bool_]:
        """(n,) whether its values are there."""
        return self.values(DONE).astype(np.bool_)

    @property
    def usable(self) -> NDArray[np.bool_]:
        """(n,) whether there is a bound, if only an infinite one: measured, not inside nor blocked."""
        return np.asarray(self.done & (self.status == MEASURED), dtype=np.bool_)

    @property
    def interrupted(self) -> bool:
        """Whether views are missing."""
        return not bool(self.done.all())

    @property
    def position_bound(self) -> Array:
        """(n,) root of the position covariance's trace [scene unit]; infinite unless all of it is seen."""
        return self.values("position_bound")

    @property
    def rotation_bound_deg(self) -> Array:
        """(n,) the same of the rotation [deg]."""
        return self.values("rotation_bound_deg")

    @property
    def rank(self) -> NDArray[np.int64]:
        """(n,) number of directions that are seen."""
        return self.values("rank").astype(np.int64)

    @property
    def settings(self) -> dict[str, Any]:
        """What the numbers depend on."""
        return self._attribute("settings")

    @property
    def candidates(self) -> dict[str, Any]:
        """Where the poses come from."""
        return self._attribute("candidates")

    @property
    def up(self) -> Array:
        """(3,) the direction that is up."""
        return np.asarray(self.dataset.attrs["up"], dtype=np.float64)

    def information(self) -> list[FisherInformation]:
        """Of every view, as that of one body whose pose is the identity, in the world frame; they add.

        Where there is no bound it is zero.
        """
        return self._informations

    def values(self, name: str) -> NDArray[Any]:
        """(n, ...) of one of the store's variables, see `layout`.

        Raises:
            StoreError: its file is damaged.
        """
        try:
            return np.asarray(self.dataset[name].values)
        except (OSError, RuntimeError, ValueError) as error:  # of what decodes its chunks
            raise StoreError(f"the store is damaged: {name} cannot be read ({error}); {_AGAIN}") from error

    @cached_property
    def _informations(self) -> list[FisherInformation]:
        matrices = np.nan_to_num(self.values("information_camera"))
        covariances = np.nan_to_num(self.values("covariance_of_entries"))
        scales, pixels = self.values("length_scale"), self.values("pixels")
        return [
            FisherInformation(
                matrix=matrix,
                covariance_of_entries=covariance,
                linearisation=Linearisation(
                    variable=BODY,
                    frame="camera",
                    pose=pose,
                    length_scale=scale if np.isfinite(scale) else 1.0,
                    selection=PixelSelection("all", int(count), int(count), "all"),
                ),
            ).transform(se3.adjoint(se3.inverse(pose)), variable=BODY, frame="world", pose=np.eye(4))
            for pose, matrix, covariance, scale, count in zip(
                self.poses, matrices, covariances, scales, pixels, strict=True
            )
        ]

    def _attribute(self, name: str) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(self.dataset.attrs[name])
        return found

    def __len__(self) -> int:
        return int(self.dataset.sizes["view"])


def open_field(store: str | Path) -> ViewField:
    """What `measure_field` has written, be it all or the part of a run that was interrupted.

    Args:
        store: its folder.

    Raises:
        StoreError: it is missing, something else, or of another version of the layout.
    """
    xarray = field_library("xarray")
    path = Path(store)
    if not path.exists():
        raise StoreError(f"{path}: no such store; `mitsuba-crb field` writes one")
    try:
        dataset = xarray.open_zarr(path, consolidated=False, chunks=None, mask_and_scale=False)
    except (OSError, KeyError, ValueError) as error:
        raise StoreError(f"{path} is no store of views ({error})") from None
    schema = dataset.attrs.get("schema")
    if schema != SCHEMA:
        raise StoreError(
            f"{path} is no store of views of layout {SCHEMA}" + (f", but of {schema}" if schema else "")
        )
    _check_whole(path, dataset)
    return ViewField(dataset)


def _check_whole(path: Path, dataset: Any) -> None:
    """Refuse a store of which something is missing or is not what it has to be.

    Raises:
        StoreError: says what.
    """
    missing = [name for name in VARIABLES if name not in dataset.variables]
    if missing:
        raise StoreError(f"{path} is damaged: it has no {missing[0]}; {_AGAIN}")
    for name in ("settings", "candidates"):
        try:
            good = isinstance(json.loads(dataset.attrs[name]), dict)
        except (KeyError, TypeError, ValueError):
            good = False
        if not good:
            raise StoreError(f"{path} is damaged: its {name} cannot be read; {_AGAIN}")
    up = dataset.attrs.get("up")
    if np.shape(up) != (3,) or not all(isinstance(value, int | float) for value in up):
        raise StoreError(f"{path} is damaged: its up is no direction; {_AGAIN}")


def field_library(name: str) -> Any:
    """One of the packages of the extra `field`.

    Raises:
        StoreError: it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError:
        raise StoreError(f"fields of views need {name}: pip install 'mitsuba_crb[field]'") from None
