"""The ideal bound and the misspecified covariance beside each other, and which is which."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from rich.console import Console
from rich.text import Text

from .terminal import new_table, number_by_verdict, number_with_error, print_line

if TYPE_CHECKING:
    from ..bound.cramer_rao import PoseBound
    from ..bound.misspecified import MisspecifiedCovariance
    from ..se3 import Array

_AXES = ("position x, world", "position y, world", "position z, world", "pitch", "yaw", "roll")


def print_beside(
    console: Console,
    ideal: PoseBound,
    misspecified: MisspecifiedCovariance | None,
    pose: Array | None = None,
) -> None:
    """The six standard deviations, ideal and misspecified beside each other.

    Args:
        console: where to.
        ideal: the bound.
        misspecified: the other; None if it is not known.
        pose: (4, 4), to be shown beside its deviations.
    """
    table = new_table()
    heads = [*([] if pose is None else ["estimate"]), "1σ ideal", "± its error"]
    heads += [] if misspecified is None else ["1σ misspecified", "± its error", "/ ideal"]
    table.add_column("")
    for head in heads:
        table.add_column(head, justify="right")
    table.add_column("unit")
    std = [*ideal.position_std, *ideal.rotation_std_deg]
    errors = [*ideal.position_std_standard_error, *ideal.rotation_std_deg_standard_error]
    limits = [*ideal.position_std_lower_limit, *ideal.rotation_std_deg_lower_limit]
    for k, name in enumerate(_AXES):
        row = [] if pose is None else [f"{pose[k, 3]:.6g}" if k < 3 else ""]
        row += number_by_verdict(float(std[k]), float(errors[k]), ideal.verdicts[k], float(limits[k]))
        if misspecified is not None:
            row += _misspecified(misspecified, k)
        table.add_row(name, *row, "scene unit" if k < 3 else "deg")
        if k == 2:
            table.add_section()
    console.print(table)


def _misspecified(found: MisspecifiedCovariance, k: int) -> list[str]:
    value = float([*found.position_std, *found.rotation_std_deg][k])
    error = float([*found.position_std_standard_error, *found.rotation_std_deg_standard_error][k])
    ratio = float(found.ratios[k])
    return [*number_with_error(value, error), f"{ratio:.2f}" if math.isfinite(ratio) else ""]


def print_kinds(console: Console, misspecified: MisspecifiedCovariance | None) -> None:
    """What the two are, and what they differ by; None if only the ideal one is known."""
    print_line(
        console,
        Text("ideal: ", style="bold"),
        "the least that any unbiased estimator can have, if the map has no error and the noise is white",
    )
    if misspecified is None:
        what = (
            "not known, as an aligned photograph does not tell the map's error; give others at known poses "
            "(--photographs)"
        )
    else:
        what = "what least squares has with this map, by the residuals of photographs held out"
    print_line(console, Text("misspecified: ", style="bold"), what)
    if misspecified is not None:
        print_line(console, Text("gap: ", style="bold"), misspecified.gap)
