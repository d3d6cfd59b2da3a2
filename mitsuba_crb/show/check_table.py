"""A check of methods on the terminal."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

from rich.console import Console
from rich.text import Text

from ..se3 import TWIST_ORDER
from .terminal import new_table, print_line, print_notes

if TYPE_CHECKING:
    from ..measure.check import JacobianCheck


def print_check(console: Console, check: JacobianCheck, warnings: Iterable[str] = ()) -> None:
    """Each method's columns beside those of finite differences, the verdict, and warnings on the way."""
    from ..measure.check import AGREEMENT  # late: it imports Dr.Jit

    for row in check.rows:
        print_line(console, Text(row.method, style="bold"), " beside finite_difference, column by column:")
        table = new_table()
        table.add_column("")
        for head in ("F / F_fd", "‖J − J_fd‖ / ‖J_fd‖", "would have seen"):
            table.add_column(head, justify="right")
        table.add_column("")
        for axis, name in enumerate(TWIST_ORDER):
            if row.disagrees[axis]:
                verdict = Text("differs", style="bold red")
            elif math.isnan(row.detectable[axis]):
                verdict = Text("unseen", style="green")
            elif row.detectable[axis] <= AGREEMENT:
                verdict = Text("equal", style="green")
            else:
                verdict = Text("undecided", style="yellow")
            table.add_row(
                name,
                _pair(row.ratio[axis], row.ratio_standard_error[axis], "z.3f"),
                _pair(row.difference[axis], row.difference_standard_error[axis], ".1%"),
                "" if math.isinf(row.detectable[axis]) else _pair(row.detectable[axis], math.nan, ".1%"),
                verdict,
            )
        console.print(table)
    verb = "disagrees" if len(check.disagreeing) == 1 else "disagree"
    known = math.isfinite(check.detectable)
    seen = f"; a disagreement in information of {check.detectable:.1%} would have been seen" if known else ""
    sentence = {
        "agree": f"{' and '.join(row.method for row in check.rows)} and finite_difference agree{seen}",
        "disagree": f"{' and '.join(check.disagreeing)} {verb} with finite_difference{seen}",
        "inconclusive": f"inconclusive: {check.cure}{seen}",
    }[check.verdict] + ("" if check.spp is None else f", by {check.spp} paths per pixel")
    print_line(console, Text(sentence, style="green" if check.verdict == "agree" else "bold yellow"))
    print_notes(console, warnings)


def _pair(value: float, error: float, form: str) -> str:
    if math.isnan(value):
        return ""
    return f"{value:{form}}" + (f" ± {error:{form}}" if math.isfinite(error) else "")
