"""Noise models in TOML: a table `[noise]` with `model = NAME` and the model's parameters.

    gaussian                sigma
    per_channel             sigmas
    per_pixel               variance*
    colour_blocks           covariance*
    heteroscedastic         coefficients          c0, c1, ...: variance = c0 + c1 mean + ...
    poisson_gaussian        gain, read_noise
    student_t               scale, nu
    laplace                 scale
    luminance               noise (a table), coefficients (optional)
    sensor                  noise (a table), noise_at ("before" or "after" the curve), and optionally
                            curve (a table), exposure, quantisation (a table: levels, black, white)
    stationary              autocovariance* or power_spectrum*
    periodic                autocovariance* or power_spectrum*
    sparse_precision        precision (a .npz file of `scipy.sparse.save_npz`), shape
    low_rank_plus_diagonal  variance*, modes*

    curve = "linear" · "srgb" · "power" (gamma, toe, offset) · "tabulated" (x, y)

Arrays (*) are nested lists, or the name of a `.npy` file beside the TOML file. For example:

    [noise]
    model = "sensor"
    noise_at = "before"
    exposure = 2.0
    noise = { model = "poisson_gaussian", gain = 0.001, read_noise = 0.002 }
    curve = { curve = "srgb" }
    quantisation = { levels = 256 }

`from_dict` reads what `to_dict` of a model wrote, except of models that are too large to write.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar

from ..errors import NoiseError
from ..files import read_array, read_sparse, read_toml
from .colour import ColourBlocks, Luminance
from .curves import SRGB, Curve, Linear, Power, Tabulated
from .gaussian import Gaussian, PerChannel, PerPixel
from .heavy_tails import Laplace, StudentT
from .heteroscedastic import Heteroscedastic
from .low_rank import LowRankPlusDiagonal
from .poisson_gaussian import PoissonGaussian
from .protocol import NoiseModel
from .sensor import Quantisation, Sensor
from .sparse import SparsePrecision
from .stationary import Periodic, Stationary

T = TypeVar("T")


def _stationary(autocovariance: Any = None, power_spectrum: Any = None) -> Stationary:
    return _either(Stationary, Stationary.from_power_spectrum, autocovariance, power_spectrum)


def _periodic(autocovariance: Any = None, power_spectrum: Any = None) -> Periodic:
    return _either(Periodic.from_autocovariance, Periodic, autocovariance, power_spectrum)


def _either(
    of_covariance: Callable[[Any], T], of_spectrum: Callable[[Any], T], covariance: Any, spectrum: Any
) -> T:
    if (covariance is None) == (spectrum is None):
        raise NoiseError("give either autocovariance or power_spectrum")
    return of_spectrum(spectrum) if covariance is None else of_covariance(covariance)


_MODELS: dict[str, Callable[..., NoiseModel]] = {
    "gaussian": Gaussian,
    "per_channel": PerChannel,
    "per_pixel": PerPixel,
    "colour_blocks": ColourBlocks,
    "heteroscedastic": Heteroscedastic,
    "poisson_gaussian": PoissonGaussian,
    "student_t": StudentT,
    "laplace": Laplace,
    "luminance": Luminance,
    "sensor": Sensor,
    "stationary": _stationary,
    "periodic": _periodic,
    "sparse_precision": SparsePrecision,
    "low_rank_plus_diagonal": LowRankPlusDiagonal,
}
_CURVES: dict[str, Callable[..., Curve]] = {
    "linear": Linear,
    "srgb": lambda: SRGB,
    "power": Power,
    "tabulated": Tabulated,
}
_ARRAYS = ("variance", "covariance", "autocovariance", "power_spectrum", "modes")


def load(path: str | Path) -> NoiseModel:
    """The noise model of a TOML file's table `[noise]`.

    Raises:
        NoiseError: the file cannot be read, or a name or value in it cannot be used.
    """
    file = Path(path)
    document = read_toml(file, NoiseError)
    _check_keys(document, ["noise"], f"{file}")
    if not isinstance(document.get("noise"), dict):
        raise NoiseError(f'{file} has no table [noise], with model = "gaussian" or another')
    try:
        return from_dict(document["noise"], folder=file.parent)
    except NoiseError as error:
        raise NoiseError(f"{file}: {error}") from error


def from_dict(table: Mapping[str, Any], *, folder: str | Path = ".") -> NoiseModel:
    """The noise model of a table, see the module's docstring.

    Args:
        table: `model` and its parameters.
        folder: where the files that it names are.

    Raises:
        NoiseError: a name or value cannot be used; misspelt ones are named with their nearest.
    """
    name, make, parameters = _chosen(table, "model", _MODELS, "a noise model")
    place = Path(folder)
    for key, value in parameters.items():
        if key == "noise":
            parameters[key] = from_dict(_table(value, key), folder=place)
        elif key == "curve":
            _, curve, of_curve = _chosen(_table(value, key), "curve", _CURVES, "a response curve")
            parameters[key] = _made(curve, of_curve, "the curve")
        elif key == "quantisation":
            parameters[key] = _made(Quantisation, dict(_table(value, key)), "quantisation")
        elif key in _ARRAYS and isinstance(value, str):
            parameters[key] = read_array(place / value, NoiseError)
        elif key == "precision" and isinstance(value, str):
            parameters[key] = read_sparse(place / value, NoiseError)
    return _made(make, parameters, f"the noise model {name!r}")


def _chosen(
    table: Mapping[str, Any], key: str, known: Mapping[str, Callable[..., T]], what: str
) -> tuple[str, Callable[..., T], dict[str, Any]]:
    """The name under `key`, what makes it, and the other entries, whose names are its parameters'."""
    parameters = dict(table)
    if key not in parameters:
        near = [name for name in parameters if get_close_matches(name, [key])]
        got = f", not {near[0]}" if near else ""
        raise NoiseError(f"{what} needs {key}{got} = one of {', '.join(known)}")
    name = parameters.pop(key)
    if not isinstance(name, str) or name not in known:
        raise NoiseError(
            f"unknown {key} {name!r}{_near(str(name), list(known))}; there are {', '.join(known)}"
        )
    _check_keys(parameters, list(inspect.signature(known[name]).parameters), f"the {key} {name!r}")
    return name, known[name], parameters


def _made(make: Callable[..., T], parameters: dict[str, Any], what: str) -> T:
    expected = inspect.signature(make).parameters
    _check_keys(parameters, list(expected), what)
    missing = [n for n, p in expected.items() if p.default is inspect.Parameter.empty and n not in parameters]
    if missing:
        raise NoiseError(f"{what} lacks {', '.join(missing)}")
    try:
        return make(**parameters)
    except (ArithmeticError, TypeError, ValueError) as error:
        raise NoiseError(f"{what} has a value of the wrong kind: {error}") from error


def _table(value: Any, key: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise NoiseError(f"{key} must be a table, not {value!r}")
    return value


def _check_keys(table: Mapping[str, Any], known: list[str], what: str) -> None:
    for key in table:
        if key not in known:
            have = ", ".join(known) or "no parameters"
            raise NoiseError(f"{what} has no {key!r}{_near(key, known)}; it has {have}")


def _near(name: str, known: list[str]) -> str:
    close = get_close_matches(name, known, n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""
