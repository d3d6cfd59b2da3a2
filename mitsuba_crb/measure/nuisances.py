"""Nuisance parameters by name: what the image depends on beside the pose, and its derivative in each.

    gain             ∂I = I, per relative change of exposure; every batch's column is its own image
    black            ∂I = 1 [radiance], a common offset of all values
    fx, fy, cx, cy   focal lengths and principal point [pixel]; by the filter term inside `flow`, by finite
                     differences of renders with other methods
    k1, p1, ...      a coefficient of the lens model that the camera was given; likewise
    fov              horizontal field of view [deg], fx and fy in proportion; likewise
    principal_point  cx and cy
    NAME             a differentiable parameter of `mi.traverse(scene)`, a column for each entry; of a
                     `to_world` the six motions. NAME:scale is a common scale of all entries. Of scenes only
    gain:32          with a value of its own in every tile of 32 x 32 pixels; likewise black:32; not of a
                     random subset of the pixels (`joint`)

A scene parameter is differentiated by forward mode if it moves no edges, and otherwise, or if forward mode
fails or sees nothing on a few pixels, by finite differences. Columns of one batch never depend on another's
random numbers, so that their noise is not taken for information (`ustatistic`).
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..camera import LENS_MODELS
from ..errors import NuisanceError
from ..jacobian.intrinsic_parameter import IntrinsicParameter
from ..jacobian.method import Method, Paths
from ..jacobian.parameter import STEP_PIXELS

if TYPE_CHECKING:
    import mitsuba as mi

    from ..jacobian.film_flow import FilmFlow
    from ..jacobian.parameter import SceneParameter
    from ..render.view import View

FILM_NAMES = ("fov", "principal_point", "fx", "fy", "cx", "cy")
"""Nuisances of every camera."""
COEFFICIENTS = tuple(dict.fromkeys(name for names in LENS_MODELS.values() for name in names))
"""Nuisances of cameras with a lens model that has them."""
NAMES = ("gain", "black", *FILM_NAMES, *COEFFICIENTS)
"""Nuisances that are no parameters of the scene."""

LARGEST = 12
"""Entries that a parameter may have, each a nuisance."""

RELATIVE_STEP = 0.01
"""Step of a finite difference over the number's size, or over 1 for a zero."""

_PROBE = 24
"""Side of the grid of pixels on which forward mode is tried."""

Floats = NDArray[np.float64]
Pixels = NDArray[np.int64]


@dataclass(frozen=True)
class Nuisance:
    """One of a name, with as many columns as it has entries."""

    name: str
    """As the user gave it."""
    how: str
    """How the image is differentiated in it, in words."""
    width: int
    """Number of its columns."""
    film_flows: tuple[FilmFlow, ...] = ()
    """What the method has to follow beside the pose."""
    rendered: tuple[SceneParameter | IntrinsicParameter, ...] = ()
    """What needs renders of its own."""
    lost: Callable[[Pixels, Floats], Floats] | None = None
    """Of one without columns: what not knowing it takes of the pose's information (6, 6), of pixels (n, 2)
    and their weights (n, 3)."""

    def columns(self, view: Any, pixels: Pixels, images: Floats, film: Floats, paths: Paths) -> list[Floats]:
        """(batches, n, 3, ·) each, `width` columns in all; arguments as of `nuisance_columns`."""
        if self.lost is not None:
            return []
        if self.film_flows:
            return [film]
        if self.rendered:
            return [parameter.columns(view, pixels, paths) for parameter in self.rendered]
        return [images[..., None] if self.name.startswith("gain") else np.ones((*images.shape, 1))]


def name_parameters(names: Sequence[str]) -> bool:
    """Whether one of these is a parameter of the scene itself."""
    return any(name.partition(":")[0] not in NAMES for name in names)


def open_nuisances(view: View, names: Sequence[str], method: type[Method]) -> tuple[Nuisance, ...]:
    """The nuisances of these names in a view of a scene.

    Raises:
        NuisanceError: no such parameter, no derivative in it, too many entries, or a name given twice.
    """
    from ..jacobian.film_flow import film_flows

    def film(name: str) -> Nuisance:
        if not method.follows_film:
            return by_renders(view, name)
        flows = film_flows(view, name)
        return Nuisance(name, "filter term", len(flows), film_flows=flows)

    return opened(view, names, film=film, own=partial(_of_scene, view))


def opened(
    view: Any,
    names: Sequence[str],
    *,
    film: Callable[[str], Nuisance],
    own: Callable[[str], Nuisance],
) -> tuple[Nuisance, ...]:
    """The nuisances of these names in whatever is measured.

    Args:
        film: opens what acts on the film alone, by name.
        own: opens what is neither that nor of every camera.

    Raises:
        NuisanceError: no such coefficient, or a name given twice; and as `film` and `own`.
    """
    if isinstance(names, str):
        raise NuisanceError(f"nuisances are a sequence of names, such as [{names!r}], not one text")
    twice = sorted({name for name in names if list(names).count(name) > 1})
    if twice:
        raise NuisanceError(f"nuisance {', '.join(twice)} was given twice")
    return tuple(_open(view, name, film, own) for name in names)


def by_renders(view: Any, name: str, step_pixels: float = STEP_PIXELS) -> Nuisance:
    """What acts on the film alone, by renders through other cameras."""
    rendered = IntrinsicParameter.of(view, name, step_pixels)
    return Nuisance(name, rendered[0].how, len(rendered), rendered=rendered)


def nuisance_columns(
    nuisances: Sequence[Nuisance],
    view: Any,
    pixels: Pixels,
    images: Floats,
    film: Floats,
    paths: Paths,
) -> Floats:
    """The columns of all nuisances at some pixels.

    Args:
        images: (batches, n, 3) each batch's own image [radiance].
        film: (batches, n, 3, q) what the method measured of all `film_flows`.
        paths: those of the pose's columns.

    Returns:
        (batches, n, 3, m) [radiance per unit of the parameter].
    """
    found, start = [np.empty((*images.shape, 0))], 0
    for nuisance in nuisances:
        stop = start + len(nuisance.film_flows)
        own = film[..., start:stop]
        found += nuisance.columns(view, pixels, images, own, paths)
        start = stop
    return np.concatenate(found, axis=-1)


def _open(view: Any, name: str, film: Callable[[str], Nuisance], own: Callable[[str], Nuisance]) -> Nuisance:
    base, _, suffix = name.partition(":")
    if base in ("gain", "black") and (not suffix or suffix.isdigit()):
        return Nuisance(name, "the image itself" if base == "gain" else "exact", 1)
    if name in COEFFICIENTS and name not in view.intrinsics.parameters:
        having = " or ".join(model for model, names in LENS_MODELS.items() if name in names)
        raise NuisanceError(
            f"{name} is a coefficient of the lens model {having}, and the camera's is a "
            f"{view.intrinsics.model}: give a calibration of such a model, which may have zeros"
        )
    return film(name) if name in NAMES else own(name)


def _of_scene(view: View, name: str) -> Nuisance:
    """A parameter of `mi.traverse`."""
    import mitsuba as mi

    parameters, suffix = mi.traverse(view.scene), name.partition(":")[2]
    scale = name not in parameters and suffix == "scale"
    parameter = _scene_parameter(view, parameters, name.removesuffix(":scale") if scale else name, scale)
    return Nuisance(name, parameter.how, len(parameter.directions), rendered=(parameter,))


def _scene_parameter(view: View, parameters: mi.SceneParameters, key: str, scale: bool) -> SceneParameter:
    """A parameter of `mi.traverse`, each entry a direction, or its own value the only one."""
    import drjit as dr
    import mitsuba as mi

    from ..jacobian.parameter import SceneParameter, is_placement, motions

    if key not in parameters:
        raise NuisanceError(_no_such(key, parameters))
    flags, value = int(parameters.flags(key)), parameters[key]
    if flags & int(mi.ParamFlags.NonDifferentiable) or not (is_placement(value) or dr.is_diff_v(value)):
        instead = {"x_fov": "fov", "principal_point_offset_x": "principal_point"}
        cure = instead.get(key.rpartition(".")[2])
        raise NuisanceError(
            f"Mitsuba has no derivative in {key}" + (f"; use the nuisance {cure}" if cure else "")
        )
    value = type(value)(value)
    if is_placement(value):
        if scale:
            raise NuisanceError(f"{key} is a placement: its six motions have no common scale")

        return motions(view, parameters, key, value)
    numbers = np.array(value, dtype=np.float64)
    if not scale and numbers.size > LARGEST:
        raise NuisanceError(
            f"{key} has {numbers.size} entries, and no more than {LARGEST} can be nuisances one by one; "
            f"{key}:scale is a common scale of all"
        )
    directions = [numbers] if scale else list(np.eye(numbers.size).reshape(-1, *numbers.shape))
    sizes = [1.0] if scale else [abs(float(number)) or 1.0 for number in numbers.ravel()]
    moves_edges = bool(flags & int(mi.ParamFlags.Discontinuous))
    step = min(RELATIVE_STEP, 2.0 * STEP_PIXELS / max(view.size)) if moves_edges else RELATIVE_STEP
    found = SceneParameter(parameters, key, value, tuple(directions), tuple(step * size for size in sizes))
    forward = replace(found, forward=True)
    return found if moves_edges or not _works(forward, view) else forward


def _works(parameter: SceneParameter, view: View) -> bool:
    """Whether forward mode gives derivatives that are finite and not all zero, on a few pixels."""
    from mitsuba.python.ad.integrators.common import ADIntegrator

    from ..render.rays import coarse_grid

    if isinstance(view.integrator, ADIntegrator):
        return False  # its primal mode detaches all parameters
    pixels = coarse_grid(view.size, _PROBE).reshape(-1, 2)
    try:
        values = parameter.columns(view, pixels, Paths(4, 0, 1))
    except Exception:  # Dr.Jit raises RuntimeError, TypeError and others for what it cannot differentiate
        return False
    return bool(np.isfinite(values).all() and values.any(axis=(0, 1, 2)).all())


def _no_such(name: str, parameters: mi.SceneParameters) -> str:
    """What may have been meant."""
    import mitsuba as mi

    usable = [
        key
        for key in parameters.keys()  # noqa: SIM118  iterating over the object itself gives pairs
        if not int(parameters.flags(key)) & int(mi.ParamFlags.NonDifferentiable)
        # Mitsuba calls what has no id by its address, which is another one the next time.
        and not re.search(r"(object|_unnamed)_(0x)?[0-9a-f]{6,}", key)
    ]
    near = difflib.get_close_matches(name, [*NAMES, *usable], n=4, cutoff=0.5)
    listed = ", ".join(near or ["gain", "black", *FILM_NAMES, *usable[:8]])
    merged = "; equal meshes and materials of an mi.Scene may be merged: give its file" if "." in name else ""
    return (
        f"no nuisance or scene parameter is named {name}; {'near ones' if near else 'there are'}: {listed}"
        f"{merged}"
    )
