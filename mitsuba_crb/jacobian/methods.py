"""Which methods there are, by name."""

from __future__ import annotations

from .finite_difference import FiniteDifference
from .flow import Flow
from .forward import Forward
from .method import Method

METHODS: dict[str, type[Method]] = {method.name: method for method in (Flow, Forward, FiniteDifference)}

REFERENCE = FiniteDifference
"""What the others are checked against: slow, and almost free of assumptions."""
