"""A radiance field seen by a camera, as a `Measurable`: display-referred, and without random numbers."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..camera import Camera, Intrinsics
from ..errors import FieldError, FieldWarning, NuisanceError, OptionError, SensorError
from ..jacobian.lint import precision_findings
from ..jacobian.method import Method, Paths, Reference
from ..noise import Measured
from ..noise.measured import COLOUR, DISPLAY_REFERRED
from ..radiance.beside import beside
from ..radiance.exact import FIELD_METHODS, FIELD_REFERENCE, STEP_PIXELS
from ..radiance.field import Field, Viewpoint
from ..radiance.map_nuisance import UNKNOWNS
from ..render.fit import find
from ..render.lending import turns
from ..render.rays import coarse_grid
from .likeness import Likeness, compared, unlike
from .nuisances import FILM_NAMES, Nuisance, by_renders, opened
from .options import MeasurementOptions
from .unknown_map import map_nuisance

_GRID = 96
"""Pixels across and down through which depth is looked at."""
_SOLID = 0.5
"""Opacity of what has a depth worth the name, where there is any."""
_FAINT = 1.0 / 255.0
"""Opacity below which nothing is seen."""
_NAMED = 6
"""Cameras that a message names."""


@dataclass(frozen=True, eq=False)
class FieldView:
    """One camera in one field; see `Measurable`."""

    methods: ClassVar[Mapping[str, type[Method]]] = FIELD_METHODS
    reference: ClassVar[type[Reference]] = FIELD_REFERENCE
    deterministic: ClassVar[bool] = True
    white: ClassVar[float | None] = 1.0

    field: Field
    intrinsics: Intrinsics
    pose: NDArray[np.float64]
    """(4, 4) `world_from_camera`, rigid."""
    variable: str
    """The camera's name."""
    measured: Measured
    """What the camera measures."""
    photograph: tuple[str, Likeness] | None = None
    """That was taken from here, and how like it the field is; None if there is none."""

    @property
    def label(self) -> str:
        """See `Measurable.label`."""
        return self.field.label

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image [pixel]."""
        return self.intrinsics.size

    @functools.cached_property
    def camera(self) -> Camera:
        """See `Measurable.camera`."""
        return Camera.of(self.intrinsics)

    @property
    def plain_fov_deg(self) -> float:
        """See `Intrinsics.plain_fov_deg`."""
        return self.intrinsics.plain_fov_deg

    @functools.cached_property
    def visible_depth(self) -> NDArray[np.float64]:
        """Depths along the optical axis of what is at least half opaque, if anything is [unit of the field].

        Through a coarse grid of pixels.
        """
        depth, opacity = self._looked_at
        seen = np.isfinite(depth) & (depth > 0.0)
        solid = seen & (opacity >= _SOLID)
        return depth[solid if solid.any() else seen]

    @functools.cached_property
    def _looked_at(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Depth and opacity at a coarse grid of pixels."""
        shown = self.field.show(self.camera, self.pose, coarse_grid(self.size, _GRID).reshape(-1, 2))
        return shown.depth, shown.opacity

    def telling(self) -> None:
        """All pixels: see `Measurable.telling`."""

    def at(self, pose: NDArray[np.float64]) -> Self:
        """The same camera at another pose (4, 4)."""
        return dataclasses.replace(self, pose=pose, photograph=None)

    def seen_through(self, intrinsics: Intrinsics) -> Self:
        """The same field through another camera.

        Raises:
            FieldError: as `Field.refuse`.
        """
        other = dataclasses.replace(self, intrinsics=intrinsics, photograph=None)
        other.field.refuse(other.camera)
        return other

    def start_image(
        self,
        pixels: NDArray[np.int64],
        paths: Paths,
        *,
        purpose: int,
        pose: NDArray[np.float64] | None = None,
        even: bool = False,
    ) -> Callable[[], NDArray[np.float64]]:
        """The same image for every batch; see `Measurable.start_image`."""
        where = self.pose if pose is None else pose

        def image() -> NDArray[np.float64]:
            values = self.field.show(self.camera, where, pixels).values
            return np.broadcast_to(values, (paths.batches, *values.shape))

        return image

    def open_nuisances(self, names: Sequence[str], method: type[Method]) -> tuple[Nuisance, ...]:
        """See `Measurable.open_nuisances`."""
        film = functools.partial(by_renders, self, step_pixels=STEP_PIXELS)
        return opened(self, names, film=film, own=self._own_nuisance)

    def _own_nuisance(self, name: str) -> Nuisance:
        """A map's unknowns.

        Raises:
            NuisanceError: it is none of them, with what may have been meant; or as `map_nuisance`.
        """
        if name in UNKNOWNS:
            return map_nuisance(self.field, name, self.camera, self.pose, cameras_of(self.field)[0])
        known = ("gain", "black", *FILM_NAMES, *UNKNOWNS)
        near = get_close_matches(name.partition(":")[0], known, 4, 0.5)
        raise NuisanceError(
            f"no nuisance of a radiance field is named {name}; {'near ones' if near else 'there are'}: "
            f"{', '.join(near or known)}"
        )

    def precision_limits(self) -> Sequence[str]:
        """See `Measurable.precision_limits`."""
        return precision_findings(self)

    def nothing_visible(self, *, black: bool = False) -> str:
        """See `Measurable.nothing_visible`."""
        if not black and self._looked_at[1].max(initial=0.0) > _FAINT:
            return ""
        return (
            f"nothing of {self.label} is visible: the camera looks away from it (it looks along its own z, "
            "see --pose), or its pose is in another frame than the field's"
        )

    def provenance(self) -> dict[str, Any]:
        """What is measured, the field of view [deg] along x and y, the camera, and what the field says."""
        name, likeness = self.photograph or ("", None)
        taken = {} if likeness is None else {"photograph": {"file": name, **likeness._asdict()}}
        return {
            "measures": {"what": self.measured.name, "unit": self.measured.unit},
            "field": dict(self.field.provenance()),
            "fov_deg": self.camera.field_of_view_deg,
            "camera": self.intrinsics.to_dict(),
            "deterministic": True,
            **taken,
        }


@contextlib.contextmanager
def open_field_view(field: Field, options: MeasurementOptions) -> Iterator[FieldView]:
    """A field through the camera that the options ask for, or one of those that it comes with.

    Raises:
        OptionError: the options ask for what a field has not.
        FieldError: it comes with no camera where one is needed, or the camera cannot see it.
        SensorError: it comes with no camera of that name or index.
        CameraError: the image is of another shape than the camera's.
        PoseError: the pose is no rigid motion.

    Warns:
        FieldWarning: it does not look like the photograph that was taken by the camera.
    """
    if options.integrator is not None:
        raise OptionError(
            f"{field.label} is a radiance field, which has no integrator: leave out --integrator "
            "(integrator=)"
        )
    measured = options.measured or COLOUR
    if measured.depth is not None:
        raise OptionError(
            f"{field.label} is a radiance field, whose depth is not measured; leave out --measure (measure=)"
        )
    with turns:
        intrinsics, pose, variable, photograph = options.camera, options.pose, "camera", None
        if intrinsics is None or pose is None:
            viewpoint, taken = _viewpoint(field, options.sensor)
            photograph = taken if intrinsics is None and pose is None else None
            intrinsics = viewpoint.intrinsics if intrinsics is None else intrinsics
            pose = viewpoint.pose if pose is None else pose
            variable = viewpoint.name
        if options.size is not None:
            intrinsics = intrinsics.scaled(options.size)
        view = FieldView(
            field,
            intrinsics,
            se3.as_pose(pose),
            variable,
            dataclasses.replace(measured, unit=DISPLAY_REFERRED),
        )
        field.refuse(view.camera)
        yield view if photograph is None else _beside_its(photograph, view)


def cameras_of(field: Field) -> tuple[Sequence[Viewpoint], Sequence[Path | None]]:
    """The cameras that a field comes with, and the photographs that were taken by them.

    Raises:
        FieldError: it comes with none.
    """
    if field.viewpoints:
        return field.viewpoints, [None] * len(field.viewpoints)
    found = beside(Path(field.label))
    if found is None:
        raise FieldError(
            f"{field.label} comes with no camera: say what sees it (--camera FILE, camera=) and from where "
            "(--pose, pose=)"
        )
    return found.viewpoints, found.photographs


def _viewpoint(field: Field, which: int | str) -> tuple[Viewpoint, Path | None]:
    """A camera that a field comes with, and the photograph that was taken by it."""
    viewpoints, photographs = cameras_of(field)
    names = [viewpoint.name for viewpoint in viewpoints]
    index = find(names, which)
    if index is None or not -len(names) <= index < len(names):
        near = get_close_matches(str(which), names, _NAMED, 0.3) or names[:_NAMED]
        raise SensorError(
            f"{field.label} comes with {len(names)} cameras, none of which is {which}: --sensor is an index "
            f"or a name, such as {', '.join(near)}"
        )
    return viewpoints[index], photographs[index]


def _beside_its(photograph: Path, view: FieldView) -> FieldView:
    """The view with what comparing it with its photograph says, and a warning if that is not its own."""
    found = compared(view, photograph, 0)
    if unlike([found]):
        warnings.warn(
            f"{view.label} seen by {view.variable} is unlike {photograph.name} (PSNR {found.psnr_db:.1f} dB, "
            f"an even colour's {found.even_psnr_db:.1f}): its cameras are probably of another frame",
            FieldWarning,
            stacklevel=2,
        )
    return dataclasses.replace(view, photograph=(photograph.name, found))
