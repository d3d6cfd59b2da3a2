"""The README repeats the conventions verbatim and shows what is there."""

from __future__ import annotations

import re
from pathlib import Path

from mitsuba_crb import se3

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_conventions_are_those_of_the_code() -> None:
    table = README.partition("<!-- conventions -->\n")[2].partition("<!-- /conventions -->")[0]
    assert table == se3.CONVENTIONS


def test_links_lead_somewhere() -> None:
    targets = [target for target in re.findall(r"\]\(([^)]+)\)", README) if "://" not in target]
    assert len(targets) >= 4
    assert all((ROOT / target).exists() for target in targets)


def test_named_modules_and_tests_exist() -> None:
    for path in re.findall(r"`((?:tests|benchmarks)/\w+\.py)`", README):
        assert (ROOT / path).is_file()
