"""What an exported file says of itself, and what is said of what no covariance can hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..errors import OutputError
from .estimates import Estimate

UPPER = "upper triangle, row by row"


@dataclass(frozen=True)
class Heading:
    """Whence a file is, the same in all formats."""

    source: Path
    """The result's file."""
    kind: str
    """What the matrices are: the Cramér–Rao bound, or the misspecified covariance."""
    version: str
    """Of this package."""

    def lines(self, estimates: Sequence[Estimate], *more: str) -> list[str]:
        """A file's first lines, without signs of comments."""
        return [
            f"mitsuba-crb {self.version}, from {self.source.name}: {self.kind}",
            f"poses: world_from_body, the body is {estimates[0].body}; lengths in scene units, angles in rad",
            *more,
        ]


def blind(estimates: Sequence[Estimate]) -> list[Estimate]:
    """Those that have an unseen direction."""
    return [estimate for estimate in estimates if estimate.words]


def refuse_blind(estimates: Sequence[Estimate], what: str) -> None:
    """Raise `OutputError` if some estimate has an infinite variance, which `what` cannot say."""
    found = blind(estimates)
    if found:
        raise OutputError(
            f"{what}, and {found[0].name} has infinite ones: {'; '.join(found[0].words)}{_and_others(found)}"
            "; export --to g2o or npz, which keep that, or add a --prior"
        )


def said_blind(estimates: Sequence[Estimate]) -> list[str]:
    """In words, that a file has informations in place of covariances; nothing if it has not."""
    found = blind(estimates)
    if not found:
        return []
    return [
        f"{found[0].name} has infinite variances ({'; '.join(found[0].words)}){_and_others(found)}: the file "
        "has informations, zero there, in place of covariances"
    ]


def _and_others(found: Sequence[Estimate]) -> str:
    return f", and so have {len(found) - 1} others" if len(found) > 1 else ""
