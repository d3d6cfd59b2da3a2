"""What the package imports is what an installation brings."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]

DISTRIBUTIONS = {
    "PIL": "pillow",
    "skimage": "scikit-image",
    "mpl_toolkits": "matplotlib",
    "pydantic_core": "pydantic",
    "yaml": "pyyaml",
}
"""Of modules that are called otherwise."""


def _imported(source: str) -> set[str]:
    """The top-level modules that a file imports, anywhere in it; none of the package itself."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level:
            names.add(str(node.module))
    return {name.partition(".")[0] for name in names}


def test_every_import_of_others_is_declared() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = project["dependencies"] + project["optional-dependencies"]["worlds"]
    declared = {re.split(r"[^\w-]", line, maxsplit=1)[0].lower() for line in lines}
    files = list((ROOT / "mitsuba_crb").rglob("*.py"))
    assert len(files) > 50
    imported = set().union(*(_imported(file.read_text(encoding="utf-8")) for file in files))
    others = imported - set(sys.stdlib_module_names) - {"mitsuba_crb"}
    assert {"mitsuba", "numpy", "PIL"} <= others
    assert {DISTRIBUTIONS.get(name, name).lower() for name in others} <= declared
