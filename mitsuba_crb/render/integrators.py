"""The integrator that gives radiance for a view's rays: the scene's, what it wraps, or a path tracer."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from ..errors import IntegratorError, SceneWarning
from .cures import cured, innermost
from .fit import replaced
from .scene import contents

if TYPE_CHECKING:
    import mitsuba as mi

_WRAPPERS = {"AOVIntegrator": "aov", "MomentIntegrator": "moment"}
_NO_RADIANCE = {
    **_WRAPPERS,
    "DepthIntegrator": "depth",
    "StokesIntegrator": "stokes",
    "ParticleTracerIntegrator": "ptracer",
}


def find_integrator(scene: mi.Scene, sensor: mi.Sensor, given: Any) -> mi.SamplingIntegrator:
    """What traces the rays of a sensor; warns if that is not what the scene says.

    Args:
        scene: whose integrator is taken.
        sensor: whose medium the integrator has to know.
        given: an `mi.Integrator`, a plugin's name or a dictionary, in place of the scene's.

    Raises:
        IntegratorError: the one that was given cannot be made, or returns no radiance for a ray.
    """
    import mitsuba as mi

    volumes = any(isinstance(part, mi.Medium) for part in contents(scene))
    other = "volpath" if volumes else "path"
    found = _made(given) if given is not None else scene.integrator()
    if found is None:
        return mi.load_dict({"type": other})
    found = _wrapped(found)
    name = _name(found)
    if type(found).__name__ == "PRBVolpathIntegrator" and sensor.get_medium() is not None:
        warnings.warn(
            f"integrator {name} ignores the sensor's medium: volpath is used in its place",
            SceneWarning,
            stacklevel=4,
        )
        return mi.load_dict({"type": "volpath", **_depths(found)})
    if sensor.get_medium() is not None and not re.search("vol", name):
        warnings.warn(
            f"integrator {name} ignores the medium that the sensor stands in, and all others: use volpath",
            SceneWarning,
            stacklevel=4,
        )
    if found.class_name() not in _NO_RADIANCE and isinstance(found, mi.SamplingIntegrator):
        if _loses_light(scene, found):
            warnings.warn(
                "integrator path loses light on masked surfaces where nothing lies behind them, and method "
                "'flow' does not: methods may differ; use volpath or prb",
                SceneWarning,
                stacklevel=4,
            )
        return found
    if given is not None:
        raise IntegratorError(
            f"integrator {name} returns no radiance for a ray; use path, direct, volpath or another "
            "that does (integrator='path')"
        )
    warnings.warn(replaced(name, other), SceneWarning, stacklevel=4)
    return mi.load_dict({"type": other, **_depths(found)})


def _loses_light(scene: mi.Scene, integrator: mi.SamplingIntegrator) -> bool:
    """Whether light may be lost that surfaces reflect and let pass.

    Mitsuba 3.9's `path` returns nothing along a path that only passed surfaces and left a scene without an
    environment, not even what emitters sent to them.
    """
    import mitsuba as mi

    if integrator.class_name() != "PathIntegrator" or scene.environment() is not None:
        return False
    # Hair has both flags, too, but samples no passing.
    veils = (part for part in contents(scene) if part.class_name() in ("MaskBSDF", "BlendBSDF"))
    both = (mi.BSDFFlags.Null, mi.BSDFFlags.Smooth)
    return any(all(mi.has_flag(veil.flags(), flag) for flag in both) for veil in veils)


def _made(given: Any) -> mi.Integrator:
    import mitsuba as mi

    if not isinstance(given, str | Mapping):
        return given
    config = {"type": given} if isinstance(given, str) else dict(given)
    try:
        return mi.load_dict(config)
    except Exception as error:  # Mitsuba raises RuntimeError and others for a bad dictionary
        raise IntegratorError(f"integrator: {cured(innermost(error)[1])}") from error


def _wrapped(integrator: mi.Integrator) -> mi.Integrator:
    """What an integrator wraps that adds channels and leaves the radiance as it is."""
    import mitsuba as mi

    if integrator.class_name() not in _WRAPPERS:
        return integrator
    inside = [part for part in contents(integrator) if isinstance(part, mi.SamplingIntegrator)]
    inside = [part for part in inside if part.class_name() not in _WRAPPERS]
    return inside[0] if len(inside) == 1 else integrator


def _name(integrator: mi.Integrator) -> str:
    python = type(integrator).__module__ != "mitsuba"
    name = type(integrator).__name__ if python else integrator.class_name()
    return _NO_RADIANCE.get(name, name.removesuffix("Integrator").lower())


def _depths(integrator: mi.Integrator) -> dict[str, int]:
    """The limits of its paths that a path tracer has as well."""
    found = re.findall(r"\b(max_depth|rr_depth) = (-?\d+)", str(integrator))
    python = {key: getattr(integrator, key, None) for key in ("max_depth", "rr_depth")}
    depths = {key: int(value) for key, value in python.items() if isinstance(value, int)}
    depths |= {key: int(value) for key, value in found}
    # 2^32 - 1 stands for no limit.
    return {key: value if value < 1 << 31 else -1 for key, value in depths.items()}
