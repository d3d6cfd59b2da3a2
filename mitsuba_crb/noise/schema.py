"""Noise models in TOML: a table `[noise]` with `model = NAME` and the model's parameters.

`MODELS` and `CURVES` list the names, and the keys that go with each. For example:

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

import reprlib
from collections.abc import Callable, Mapping
from numbers import Real
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo, create_model

from ..errors import NoiseError
from ..files import Table, checked, expected, read_array, read_sparse, read_toml, refused
from .clipped import Clipped
from .colour import REC709, ColourBlocks, Luminance
from .curves import SRGB, Linear, Power, Tabulated
from .gaussian import Gaussian, PerChannel, PerPixel
from .heavy_tails import Laplace, StudentT
from .heteroscedastic import Heteroscedastic
from .low_rank import LowRankPlusDiagonal
from .poisson_gaussian import PoissonGaussian
from .protocol import NoiseModel
from .sensor import NoiseAt, Quantisation, Sensor
from .sigma_of_mean import SigmaPower, SigmaTable
from .sparse import SparsePrecision
from .stationary import Periodic, Stationary

T = TypeVar("T")
Makers = dict[str, tuple[Callable[..., Any], dict[str, Any]]]
"""By name: what makes an object, and its parameters with their types and, where one is optional, default."""


def _numbers(value: Any) -> Any:
    """What is a text, or holds nothing but numbers; truth values are none."""
    if not isinstance(value, str):
        for entry in np.array(value, dtype=object).ravel():
            if isinstance(entry, bool) or not isinstance(entry, Real):
                raise ValueError
    return value


def _unitless(value: Any) -> Any:
    """What is no text: codes, percents and decibels are of a scale that only the user knows."""
    if isinstance(value, str):
        raise refused(
            f" must be a number, not {reprlib.repr(value)}: radiance on the film's scale, where a percent of "
            "white 1 is 0.01; noise of codes 0 to 255 is model = 'sensor' with noise_at = 'after', its curve "
            "(srgb) and codes / 255"
        )
    return value


def _file_of(read: Callable[[Path, type[Exception]], Any]) -> AfterValidator:
    """Puts a file's contents in the place of its name."""

    def contents(value: Any, info: ValidationInfo) -> Any:
        folder: Any = info.context
        return _located(read, folder / value, NoiseError) if isinstance(value, str) else value

    return AfterValidator(contents)


def _located(make: Callable[..., T], *values: Any, **parameters: Any) -> T:
    """What is made; a refusal is named with its place in the document."""
    try:
        return make(*values, **parameters)
    except (NoiseError, ArithmeticError) as error:
        raise refused(f": {error}") from error


def _either(
    of_covariance: Callable[[Any], T], of_spectrum: Callable[[Any], T], covariance: Any, spectrum: Any
) -> T:
    if (covariance is None) == (spectrum is None):
        raise NoiseError("give either autocovariance or power_spectrum")
    return of_spectrum(spectrum) if covariance is None else of_covariance(covariance)


def _stationary(autocovariance: Any = None, power_spectrum: Any = None) -> Stationary:
    return _either(Stationary, Stationary.from_power_spectrum, autocovariance, power_spectrum)


def _periodic(autocovariance: Any = None, power_spectrum: Any = None) -> Periodic:
    return _either(Periodic.from_autocovariance, Periodic, autocovariance, power_spectrum)


def _one_of(key: str, known: Makers) -> Any:
    """The type of a table whose `key` names one of these, and whose other keys are its parameters."""

    def named(table: Any) -> Any:
        """A table without a name gets an unknown one, so that the message lists those that there are."""
        return {key: None, **table} if isinstance(table, Mapping) else table

    def made(table: Any) -> Any:
        """Where a parameter is left out, the maker's own default holds."""
        given = {name: getattr(table, name) for name in table.model_fields_set}
        return _located(known[given.pop(key)][0], **given)

    tables = tuple(
        create_model(name, __base__=Table, __module__=__name__, **{key: Literal[name], **parameters})
        for name, (_, parameters) in known.items()
    )
    return Annotated[
        Union[tables],  # noqa: UP007
        Field(discriminator=key),
        BeforeValidator(named),
        AfterValidator(made),
    ]


Array = Annotated[
    Any,
    AfterValidator(_numbers),
    expected("nested lists of numbers or the name of a .npy file"),
    _file_of(read_array),
]
"""Nested lists, or the name of a `.npy` file beside the TOML file."""
Matrix = Annotated[Any, _file_of(read_sparse)]
"""The name of a `.npz` file of `scipy.sparse.save_npz` beside the TOML file."""
Value = Annotated[float, BeforeValidator(_unitless)]
"""In units of the measured values."""
Values = list[Value]
Shape = Annotated[tuple[int, int], Field(strict=False), expected("height and width in whole pixels")]
Numbers = list[float]

CURVES: Makers = {
    "linear": (Linear, {}),
    "srgb": (lambda: SRGB, {}),
    "power": (
        Power,
        {"gamma": (float, Power.gamma), "toe": (float, Power.toe), "offset": (float, Power.offset)},
    ),
    "tabulated": (Tabulated, {"x": Numbers, "y": Numbers}),
}
"""Response curves, `curve = NAME`."""


class QuantisationTable(Table):
    """A table `quantisation`."""

    levels: int = Quantisation.levels
    black: float = Quantisation.black
    white: float = Quantisation.white

    def made(self) -> Quantisation:
        """What it describes."""
        return _located(Quantisation, **dict(self))


MODELS: Makers = {
    "gaussian": (Gaussian, {"sigma": Value}),
    "per_channel": (PerChannel, {"sigmas": Values}),
    "per_pixel": (PerPixel, {"variance": Array}),
    "clipped": (Clipped, {"sigma": float, "white": float}),
    "colour_blocks": (ColourBlocks, {"covariance": Array}),
    "heteroscedastic": (Heteroscedastic, {"coefficients": Values}),  # variance = c0 + c1 mean + ...
    "sigma_power": (SigmaPower, {"factor": float, "exponent": float}),  # sigma = factor mean^exponent
    "sigma_table": (SigmaTable, {"means": Numbers, "sigmas": Values}),
    "poisson_gaussian": (PoissonGaussian, {"gain": Value, "read_noise": Value}),
    "student_t": (StudentT, {"scale": Value, "nu": float}),
    "laplace": (Laplace, {"scale": Value}),
    "luminance": (Luminance, {"noise": "Noise", "coefficients": (Numbers, REC709)}),
    "sensor": (
        Sensor,
        {
            "noise": "Noise",
            "noise_at": NoiseAt,
            "curve": (_one_of("curve", CURVES), Linear()),
            "exposure": (float, Sensor.exposure),
            "quantisation": (Annotated[QuantisationTable, AfterValidator(QuantisationTable.made)], None),
        },
    ),
    "stationary": (_stationary, {"autocovariance": (Array, None), "power_spectrum": (Array, None)}),
    "periodic": (_periodic, {"autocovariance": (Array, None), "power_spectrum": (Array, None)}),
    "sparse_precision": (SparsePrecision, {"precision": Matrix, "shape": Shape}),
    "low_rank_plus_diagonal": (LowRankPlusDiagonal, {"variance": Array, "modes": Array}),
}
"""Noise models, `model = NAME`."""
Noise = _one_of("model", MODELS)


class NoiseFile(Table):
    """A file with a noise model."""

    noise: Noise  # type: ignore[valid-type]  # it is made at run time


def load(path: str | Path) -> NoiseModel:
    """The noise model of a TOML file's table `[noise]`.

    Raises:
        NoiseError: the file cannot be read, or a name or value in it cannot be used.
    """
    file = Path(path)
    document = {"noise": {}, **read_toml(file, NoiseError)}
    return _model(document, file.parent, str(file))


def from_dict(table: Mapping[str, Any], *, folder: str | Path = ".") -> NoiseModel:
    """The noise model of a table `[noise]`.

    Args:
        table: `model` and its parameters.
        folder: where the files that it names are.

    Raises:
        NoiseError: a name or value cannot be used; misspelt ones are named with their nearest.
    """
    return _model({"noise": table}, Path(folder), "")


def _model(document: dict[str, Any], folder: Path, where: str) -> NoiseModel:
    return checked(NoiseFile, document, NoiseError, where, context=folder).noise
