"""What two tables of settings differ in: for a run that goes on with what an earlier one has left."""

from __future__ import annotations

from typing import Any


def changes(before: dict[str, Any], now: dict[str, Any], of: str = "") -> list[str]:
    """What differs between two tables of settings, in words."""
    found = []
    for name in dict.fromkeys((*now, *before)):
        old, new = before.get(name), now.get(name)
        if isinstance(old, dict) and isinstance(new, dict):
            found += changes(old, new, f"{of}{name}.")
        elif old != new:
            found.append(f"{of}{name} = {old!r}, not {new!r}")
    return found
