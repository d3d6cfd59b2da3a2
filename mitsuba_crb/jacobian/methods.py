"""Which methods there are for scenes, by name."""

from __future__ import annotations

from .finite_difference import FiniteDifference
from .flow import Flow
from .forward import Forward
from .method import Method, Reference

METHODS: dict[str, type[Method]] = {method.name: method for method in (Flow, Forward, FiniteDifference)}
"""The first is the default."""

REFERENCE: type[Reference] = FiniteDifference
"""What the others are checked against: slow, and almost free of assumptions."""
