"""A Mitsuba scene seen by one of its cameras, as a `Measurable`."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from ..jacobian import lint
from ..jacobian.method import Method, Paths, Reference
from ..jacobian.methods import METHODS, REFERENCE
from ..render import visibility
from ..render.depth import DepthMap, depth_map
from ..render.pixels import start_pixels, summed
from ..render.view import View, open_view
from .nuisances import Nuisance, open_nuisances
from .options import MeasurementOptions


@dataclasses.dataclass(frozen=True)
class MitsubaView(View):
    """An open view with what a measurement asks of it, see `Measurable`."""

    methods: ClassVar[Mapping[str, type[Method]]] = METHODS
    reference: ClassVar[type[Reference]] = REFERENCE
    deterministic: ClassVar[bool] = False
    white: ClassVar[float | None] = None

    @functools.cached_property
    def depth_map(self) -> DepthMap | None:
        """What becomes of the pixels of a depth camera."""
        return None if self.measured.depth is None else depth_map(self, self.measured.depth)

    def telling(self) -> NDArray[np.bool_] | None:
        """See `Measurable.telling`."""
        return None if self.depth_map is None else self.depth_map.measured

    def at(self, pose: NDArray[np.float64]) -> Self:
        """The same camera at another pose (4, 4)."""
        return dataclasses.replace(self, pose=pose)

    def start_image(
        self,
        pixels: NDArray[np.int64],
        paths: Paths,
        *,
        purpose: int,
        pose: NDArray[np.float64] | None = None,
        even: bool = False,
    ) -> Callable[[], NDArray[np.float64]]:
        """See `Measurable.start_image`."""
        spp, batches = paths.spp // paths.batches, paths.batches
        total = start_pixels(
            self, pixels, spp=spp, seed=paths.seed, batches=batches, pose=pose, purpose=purpose, even=even
        )
        return lambda: summed(total, spp, batches, len(pixels))

    def open_nuisances(self, names: Sequence[str], method: type[Method]) -> tuple[Nuisance, ...]:
        """See `Measurable.open_nuisances`."""
        return open_nuisances(self, names, method)

    def precision_limits(self) -> Sequence[str]:
        """See `Measurable.precision_limits`."""
        return lint.precision_findings(self)

    def nothing_visible(self, *, black: bool = False) -> str:
        """See `Measurable.nothing_visible`."""
        return visibility.nothing_lit(self) if black else visibility.nothing_visible(self)

    def provenance(self) -> dict[str, Any]:
        """The integrator's name, the camera's angles [deg] and pixels, a calibration; what is measured."""
        python = type(self.integrator).__module__ != "mitsuba"
        name = type(self.integrator).__name__ if python else self.integrator.class_name()
        lens = {} if self.calibration is None else {"camera": self.calibration.intrinsics.to_dict()}
        measures: dict[str, Any] = {"what": self.measured.name, "unit": self.measured.unit}
        if self.depth_map is not None:
            measures["pixels"] = self.depth_map.counts()
        seen = {"fov_deg": self.camera.field_of_view_deg, "projection": self._projection}
        return {"measures": measures, "integrator": name, **seen, **lens}

    @property
    def _projection(self) -> dict[str, list[float]]:
        """Focal lengths and principal point [pixel]."""
        return {"focal": self.camera.focal.tolist(), "centre": self.camera.centre.tolist()}


@contextlib.contextmanager
def open_mitsuba_view(
    scene: Any, options: MeasurementOptions, *, apart: bool = False
) -> Iterator[MitsubaView]:
    """The view of a scene's camera that the options ask for; arguments and errors as `open_view`."""
    with open_view(
        scene,
        sensor=options.sensor,
        pose=options.pose,
        integrator=options.integrator,
        size=options.size,
        camera=options.camera,
        measured=options.measured,
        apart=apart,
    ) as view:
        yield MitsubaView(*(getattr(view, field.name) for field in dataclasses.fields(view)))
