"""A diagnosis of the installation on the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.console import Console
from rich.text import Text

from .terminal import new_table, print_line

if TYPE_CHECKING:
    from ..measure.diagnosis import Diagnosis


def print_diagnosis(console: Console, diagnosis: Diagnosis) -> None:
    """What is installed and whether it works, a line each."""
    table = new_table()
    table.show_header = False
    for name, value, good in diagnosis.rows:
        mark = Text("ok", style="green") if good else Text("FAILS", style="bold red")
        table.add_row(name, Text(str(value)), mark)
    console.print(table)
    if diagnosis.ok:
        print_line(console, Text("everything needed works", style="green"))
    else:
        print_line(console, Text("something needed does not work; see the lines that fail", style="bold red"))
