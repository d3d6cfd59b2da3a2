"""What `mitsuba-crb train` prints: how the field compares with photographs that it has not seen."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from rich.console import Console

from .terminal import new_table, print_facts, print_notes

if TYPE_CHECKING:
    from ..radiance.training import Trained


def print_training(console: Console, trained: Trained, warned: Iterable[str]) -> None:
    """A row per held-out photograph, their mean, and what was trained for how long."""
    facts = trained.field.facts
    if trained.held_out:
        table = new_table()
        table.add_column("held out")
        table.add_column("PSNR [dB]", justify="right")
        for name, psnr in trained.held_out:
            table.add_row(name, f"{psnr:.2f}")
        table.add_row("mean", f"{trained.psnr:.2f}", style="bold")
        console.print(table)
    print_facts(
        console,
        [
            ("field", trained.field.label),
            ("trained", f"{facts['steps']} steps in {facts['seconds'] / 60.0:.1f} min"),
            ("photographs", f"{facts['photographs']}, {facts['size']} pixels"),
            ("values", "display-referred, as the photographs; 1 is their white"),
        ],
    )
    notes = list(warned)
    if not trained.held_out:
        notes.append("no photograph is held out, so nothing is known of views it was not trained on")
    print_notes(console, notes)
