"""The bounds of many poses as a table: one row of plain numbers and words a pose.

A row is what of a bound fits into a line of a spreadsheet. `PoseRow.columns` writes it so, and
`PoseRow.of_columns` reads it back to the last bit, so that a file of rows is as good as the measurement.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..bound.cramer_rao import PoseBound, Verdicts
from ..files import Record
from ..se3 import Array
from .likeness import UNKNOWN, Likeness

_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_POSITION = tuple(f"position_std_{axis}" for axis in ("x", "y", "z"))
_ROTATION = tuple(f"rotation_std_deg_{axis}" for axis in ("pitch", "yaw", "roll"))
_ELLIPSOID = tuple(f"ellipsoid_{k}" for k in (1, 2, 3))
_BREAK = " | "


@dataclass(frozen=True, eq=False)
class PoseRow(Record):
    """The bound at one of many poses."""

    name: str
    """Of the pose: its time stamp, its image, or its place in the list."""
    pose: Array
    """`world_from_camera`, (4, 4)."""
    position_std: Array
    """(3,), see `PoseBound`, as all that follows [scene unit]."""
    position_std_standard_error: Array
    """(3,) [scene unit]."""
    position_verdict: Verdicts
    """Of each axis."""
    position_std_lower_limit: Array
    """(3,) [scene unit]."""
    rotation_std_deg: Array
    """(3,) [deg]."""
    rotation_std_deg_standard_error: Array
    """(3,) [deg]."""
    rotation_verdict: Verdicts
    """Of each axis."""
    rotation_std_deg_lower_limit: Array
    """(3,) [deg]."""
    rank: int
    """Number of directions that are seen."""
    weakest: str
    """The direction that is seen worst, in words; empty at rank 0."""
    not_seen: str
    """The other directions, each with its verdict, in words; empty at rank 6."""
    length_scale: float
    """The median visible depth [scene unit]; 1 if nothing finite is visible."""
    size: tuple[int, ...]
    """Width and height of the image [pixel]; 0 where the bound does not tell, as the next."""
    fov_deg: tuple[float, ...]
    """Angles that it spans, across and down [deg]."""
    ellipsoid: Array
    """(3,), semi-axes of the position's 1σ ellipsoid, descending, infinite where unseen [scene unit]."""
    ellipsoid_axes: Array
    """(3, 3), their directions along the world's axes, in columns."""
    ellipsoid_verdict: Verdicts
    """Of each of them."""
    seconds: float
    """How long it took [s]."""
    no_bound: tuple[str, ...]
    """What the method cannot see, so that the numbers are no bounds."""
    notes: tuple[str, ...]
    """What else was warned of."""
    psnr_db: float = math.nan
    """Of the render at the pose against its photograph; NaN without one, see `likeness` [dB]."""
    even_psnr_db: float = math.nan
    """Of an even colour against it [dB]."""

    @staticmethod
    def of(name: str, bound: PoseBound, likeness: Likeness = UNKNOWN) -> PoseRow:
        """The row of a measured bound."""
        semi_axes, directions = bound.ellipsoid("position")
        facts = bound.provenance
        blind = facts.get("no_bound", ())
        return PoseRow(
            name=name,
            pose=bound.information.pose,
            position_std=bound.position_std,
            position_std_standard_error=bound.position_std_standard_error,
            position_verdict=bound.position_verdict,
            position_std_lower_limit=bound.position_std_lower_limit,
            rotation_std_deg=bound.rotation_std_deg,
            rotation_std_deg_standard_error=bound.rotation_std_deg_standard_error,
            rotation_verdict=bound.rotation_verdict,
            rotation_std_deg_lower_limit=bound.rotation_std_deg_lower_limit,
            rank=bound.rank,
            weakest="" if bound.weakest is None else bound.weakest.description,
            not_seen="; ".join(f"{u.description} ({u.verdict})" for u in bound.unobserved),
            length_scale=bound.length_scale,
            size=tuple(facts.get("size", (0, 0))),
            fov_deg=tuple(facts.get("fov_deg", (0.0, 0.0))),
            ellipsoid=semi_axes,
            ellipsoid_axes=directions,
            ellipsoid_verdict=bound.verdicts_along("position", directions),
            seconds=facts.get("seconds", {}).get("total", math.nan),
            no_bound=_lines(blind),
            notes=_lines([text for text in facts.get("warnings", ()) if text not in blind]),
            psnr_db=likeness.psnr_db,
            even_psnr_db=likeness.even_psnr_db,
        )

    @property
    def likeness(self) -> Likeness:
        """Of the render and the photograph."""
        return Likeness(self.psnr_db, self.even_psnr_db)

    @property
    def verdicts(self) -> tuple[str, ...]:
        """Of position and rotation, six."""
        return (*self.position_verdict, *self.rotation_verdict)

    @property
    def position(self) -> float:
        """Root of the position covariance's trace, infinite unless all of it is seen [scene unit]."""
        return float(np.linalg.norm(self.position_std))

    @property
    def rotation_deg(self) -> float:
        """Root of the rotation covariance's trace, infinite unless all of it is seen [deg]."""
        return float(np.linalg.norm(self.rotation_std_deg))

    @property
    def relative_standard_error(self) -> float:
        """The largest of the six standard deviations that are seen; NaN if none is."""
        errors = np.concatenate([self.position_std_standard_error, self.rotation_std_deg_standard_error])
        relative = errors / np.concatenate([self.position_std, self.rotation_std_deg])
        return float(np.nanmax(relative)) if np.isfinite(relative).any() else math.nan

    def columns(self) -> dict[str, str | int | float]:
        """Names and values, the same names for every row: `position_std_x`, `position_std_x_error`, …"""
        place = [*self.pose[:3, 3].tolist(), *Rotation.from_matrix(self.pose[:3, :3]).as_quat().tolist()]
        found: dict[str, str | int | float] = {
            "name": self.name,
            **dict(zip(_POSE, place, strict=True)),
            **_deviations(
                _POSITION,
                self.position_std,
                self.position_std_standard_error,
                self.position_verdict,
                self.position_std_lower_limit,
            ),
            **_deviations(
                _ROTATION,
                self.rotation_std_deg,
                self.rotation_std_deg_standard_error,
                self.rotation_verdict,
                self.rotation_std_deg_lower_limit,
            ),
            "rank": self.rank,
            "weakest": self.weakest,
            "not_seen": self.not_seen,
            "length_scale": self.length_scale,
            **dict(zip(_SIZE, self.size, strict=True)),
            **dict(zip(_FOV, self.fov_deg, strict=True)),
        }
        for k, name in enumerate(_ELLIPSOID):
            x, y, z = self.ellipsoid_axes[:, k].tolist()
            found |= {name: float(self.ellipsoid[k]), f"{name}_x": x, f"{name}_y": y, f"{name}_z": z}
            found[f"{name}_verdict"] = self.ellipsoid_verdict[k]
        words = {"no_bound": _BREAK.join(self.no_bound), "notes": _BREAK.join(self.notes)}
        found |= {"psnr_db": self.psnr_db, "even_psnr_db": self.even_psnr_db}
        return found | {"seconds": self.seconds, **words}

    @staticmethod
    def of_columns(values: Mapping[str, Any], pose: Array) -> PoseRow:
        """The row that `columns` wrote, also as texts, of a pose whose matrix is known.

        Raises:
            KeyError, ValueError: a column is missing, or holds something else.
        """

        def numbers(*names: str) -> Array:
            return np.array([math.nan if values[name] is None else float(values[name]) for name in names])

        position = [numbers(*(f"{name}{part}" for name in _POSITION)) for part in _PARTS]
        rotation = [numbers(*(f"{name}{part}" for name in _ROTATION)) for part in _PARTS]
        axes = [numbers(f"{name}_x", f"{name}_y", f"{name}_z") for name in _ELLIPSOID]
        return PoseRow(
            name=str(values["name"]),
            pose=pose,
            position_std=position[0],
            position_std_standard_error=position[1],
            position_verdict=_verdicts(values, _POSITION),
            position_std_lower_limit=position[2],
            rotation_std_deg=rotation[0],
            rotation_std_deg_standard_error=rotation[1],
            rotation_verdict=_verdicts(values, _ROTATION),
            rotation_std_deg_lower_limit=rotation[2],
            rank=int(values["rank"]),
            weakest=str(values["weakest"]),
            not_seen=str(values["not_seen"]),
            length_scale=float(values["length_scale"]),
            size=tuple(int(values[name]) for name in _SIZE),
            fov_deg=tuple(numbers(*_FOV).tolist()),
            ellipsoid=numbers(*_ELLIPSOID),
            ellipsoid_axes=np.stack(axes, axis=1),
            ellipsoid_verdict=_verdicts(values, _ELLIPSOID),
            seconds=float(numbers("seconds")[0]),
            no_bound=tuple(text for text in str(values["no_bound"]).split(_BREAK) if text),
            notes=tuple(text for text in str(values["notes"]).split(_BREAK) if text),
            psnr_db=float(numbers("psnr_db")[0]),
            even_psnr_db=float(numbers("even_psnr_db")[0]),
        )


def _lines(texts: Iterable[str]) -> tuple[str, ...]:
    return tuple(" ".join(text.split()) for text in texts)


_SIZE, _FOV = ("width", "height"), ("fov_x_deg", "fov_y_deg")
_PARTS = ("", "_error", "_lower_limit")


def _deviations(
    names: Sequence[str], values: Array, errors: Array, verdicts: Verdicts, limits: Array
) -> dict[str, str | int | float]:
    found: dict[str, str | int | float] = {}
    for name, value, error, verdict, limit in zip(
        names, values.tolist(), errors.tolist(), verdicts, limits.tolist(), strict=True
    ):
        found |= {name: value, f"{name}_error": error, f"{name}_verdict": verdict}
        found[f"{name}_lower_limit"] = limit
    return found


def _verdicts(values: Mapping[str, Any], names: Sequence[str]) -> Verdicts:
    x, y, z = (values[f"{name}_verdict"] for name in names)
    return x, y, z


@dataclass(frozen=True, eq=False)
class PoseTable(Record):
    """The bounds of many poses of one camera in one scene."""

    rows: tuple[PoseRow, ...]
    """In the order of the poses; those that were done."""
    places: tuple[int, ...]
    """Of each row among the poses, counted from 0."""
    asked: int
    """How many poses there are."""
    settings: dict[str, Any]
    """What the rows depend on, JSON-able."""

    @staticmethod
    def of(bounds: Sequence[PoseBound], names: Sequence[str] | None = None) -> PoseTable:
        """The table of some bounds; without names, they are called by their places, counted from 0."""
        called = [str(place) for place in range(len(bounds))] if names is None else names
        rows = tuple(PoseRow.of(name, bound) for name, bound in zip(called, bounds, strict=True))
        return PoseTable(rows, tuple(range(len(rows))), len(rows), {})

    @property
    def interrupted(self) -> bool:
        """Whether rows are missing."""
        return len(self.rows) < self.asked

    @property
    def lost(self) -> tuple[PoseRow, ...]:
        """Where not all six directions are seen."""
        return tuple(row for row in self.rows if row.rank < 6)

    def columns(self) -> dict[str, list[Any]]:
        """The rows' columns, for data frames: `pandas.DataFrame(table.columns())`."""
        rows = [row.columns() for row in self.rows]
        return {name: [row[name] for row in rows] for name in (rows[0] if rows else ())}

    def __str__(self) -> str:
        done = f"{len(self.rows)} of {self.asked}" if self.interrupted else str(self.asked)
        lines = [f"poses         {done}, rank {ranks(self.rows)}"]
        for name, unit, values in (
            ("position std", "scene unit", [row.position for row in self.rows]),
            ("rotation std", "deg", [row.rotation_deg for row in self.rows]),
        ):
            found = np.array([value for value in values if math.isfinite(value)])
            if found.size:
                low, middle, high = np.percentile(found, (0, 50, 100))
                lines.append(
                    f"{name}  {low:.3g} to {high:.3g}, median {middle:.3g} [{unit}], all three together"
                )
        return "\n".join(lines)


def ranks(rows: Sequence[PoseRow]) -> str:
    """How many rows have which rank, in words."""
    found = {rank: sum(row.rank == rank for row in rows) for rank in range(6, -1, -1)}
    return ", ".join(f"{rank} at {n}" for rank, n in found.items() if n) or "of none"
