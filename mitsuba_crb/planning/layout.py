"""What the store of a field of views has in it: variables, dimensions, units, flags.

One Zarr group of format 3, one dimension `view` in chunks of a batch of views each; what xarray opens as it
is. Attributes of the group say what the numbers depend on. All of a view's values are there, or `done` is 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

SCHEMA = 1
"""Of the layout; a store of another one is refused."""

VERDICTS = ("seen", "unseen", "not resolved")
"""By their flags."""

TO_DO, MEASURED, INSIDE, BLOCKED, OUTSIDE = range(5)
"""Of `status`: nothing yet; a bound; the camera is inside a solid; it sees nothing but what is too near or
faces away; it sees nothing at all. The last three are not measured: rank 0, infinite bounds."""

SIZES = {
    "row": 4,
    "column": 4,
    "twist": 6,
    "twist_": 6,
    "entry": 21,
    "entry_": 21,
    "axis": 3,
}
"""Of all dimensions but `view`. A twist is (ρ, φ); entries are in the order of `numpy.triu_indices(6)`."""


@dataclass(frozen=True)
class Variable:
    """One of the store's arrays, along `view` and further dimensions."""

    dtype: str
    dims: tuple[str, ...]
    """After `view`."""
    long_name: str
    units: str = ""
    flags: tuple[str, ...] = ()
    """What the values 0, 1, … mean."""
    unseen: float = float("inf")
    """Its value where a view is not measured because it shows nothing."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Of one view's values."""
        return tuple(SIZES[dim] for dim in self.dims)

    @property
    def fill(self) -> float | int:
        """Where nothing has been written."""
        return float("nan") if self.dtype.startswith("f") else 0

    @property
    def attributes(self) -> dict[str, Any]:
        """Names, units and flags as the CF conventions have them."""
        found: dict[str, Any] = {"long_name": self.long_name}
        if self.units:
            found["units"] = self.units
        if self.flags:
            found["flag_values"] = list(range(len(self.flags)))
            found["flag_meanings"] = " ".join(flag.replace(" ", "_") for flag in self.flags)
        return found


_NAN = float("nan")
_POSITION, _ROTATION = "scene_unit", "degree"
_LOWER = "what the true value exceeds at a confidence of 99 %"

CANDIDATES = {
    "world_from_camera": Variable("f8", ("row", "column"), "pose of the camera"),
    "place": Variable("i4", (), "number of the position; equal at equal positions"),
    "heading": Variable("i4", (), "number of the direction at its place"),
}
"""Known beforehand."""

MEASUREMENTS = {
    "information": Variable(
        "f8",
        ("twist", "twist_"),
        "Fisher information, world frame: of cameras on one rigid body they add",
        "",
        (),
        0,
    ),
    "information_camera": Variable("f8", ("twist", "twist_"), "Fisher information, camera frame", "", (), 0),
    "covariance_of_entries": Variable(
        "f8", ("entry", "entry_"), "covariance of the entries of information_camera", "", (), 0
    ),
    "length_scale": Variable("f8", (), "median visible depth", _POSITION, (), 1),
    "position_std": Variable("f8", ("axis",), "bound along the world's axes x, y, z", _POSITION),
    "position_std_standard_error": Variable("f8", ("axis",), "its standard error", _POSITION, (), _NAN),
    "position_std_lower_limit": Variable("f8", ("axis",), _LOWER, _POSITION),
    "position_verdict": Variable("i1", ("axis",), "whether it is seen", "", VERDICTS, 1),
    "rotation_std_deg": Variable(
        "f8", ("axis",), "bound about the camera's axes: pitch, yaw, roll", _ROTATION
    ),
    "rotation_std_deg_standard_error": Variable("f8", ("axis",), "its standard error", _ROTATION, (), _NAN),
    "rotation_std_deg_lower_limit": Variable("f8", ("axis",), _LOWER, _ROTATION),
    "rotation_verdict": Variable("i1", ("axis",), "whether it is seen", "", VERDICTS, 1),
    "position_bound": Variable("f8", (), "root of the position covariance's trace", _POSITION),
    "rotation_bound_deg": Variable("f8", (), "root of the rotation covariance's trace", _ROTATION),
    "rank": Variable("i1", (), "number of directions that are seen", "", (), 0),
    "weakest": Variable(
        "f8", ("twist",), "direction seen worst, camera frame, translation in length scales", "", (), _NAN
    ),
    "eigenvalues": Variable(
        "f8", ("twist",), "of the information, descending, translation in length scales", "", (), 0
    ),
    "pixels": Variable("i8", (), "pixels that were measured", "1", (), 0),
    "paths": Variable("i8", (), "paths that were drawn; of fields none", "1", (), 0),
    "no_bound": Variable(
        "i1", (), "whether the method cannot see something, so that this is no bound", "", ("no", "yes"), 0
    ),
    "seconds": Variable("f8", (), "time that it took; alone differs between equal runs", "s", (), 0),
    "status": Variable(
        "i1", (), "what became of the view", "", ("to do", "measured", "inside", "blocked", "outside")
    ),
}
"""Of each view, written together."""

DONE = "done"
FLAG = Variable("i1", (), "whether all values of the view are there; written last", "", ("no", "yes"))
VARIABLES = {**CANDIDATES, **MEASUREMENTS, DONE: FLAG}
