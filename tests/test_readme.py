"""The README names what is there, and its snippets run; commands are tested with the pages of `docs/`."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from typer.main import get_group

from mitsuba_crb.cli.app import app
from mitsuba_crb.render import llvm

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
SNIPPETS = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
READY = "from mitsuba_crb.render.scene import use_mitsuba\nuse_mitsuba()\n"


def test_links_lead_somewhere() -> None:
    targets = [target for target in re.findall(r"\]\(([^)]+)\)", README) if "://" not in target]
    assert len(targets) >= 4
    assert all((ROOT / target).exists() for target in targets)


def test_named_files_exist() -> None:
    named = re.findall(r"(?<![\w/])(?:tests|benchmarks|scenes)/[\w./]+", README)
    assert len(named) >= 5
    assert all((ROOT / path).exists() for path in named)


def test_named_options_exist() -> None:
    named = set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", README))
    commands = {parameter for command in get_group(app).commands.values() for parameter in command.params}
    known = {option for parameter in commands for option in (*parameter.opts, *parameter.secondary_opts)}
    assert {"--camera", "--poses"} <= named
    assert named <= known


def _sorted(code: str) -> str:
    """With sorted imports, as in a script of a user."""
    ruff = [sys.executable, "-m", "ruff", "check", "--isolated", "--select", "I", "--fix", "--quiet", "-"]
    return subprocess.run(ruff, input=code, capture_output=True, text=True, check=True).stdout


def _imports(code: str) -> str:
    """Its import statements."""
    body = ast.parse(code).body
    return "".join(f"{ast.unparse(line)}\n" for line in body if isinstance(line, ast.Import | ast.ImportFrom))


def _run(code: str) -> subprocess.CompletedProcess[str]:
    """In a fresh Python, for which nobody has named an LLVM."""
    environment = {key: value for key, value in os.environ.items() if key != llvm.VARIABLE}
    return subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )


@pytest.mark.slow
@pytest.mark.parametrize("snippet", SNIPPETS)
def test_snippets_with_sorted_imports_get_an_llvm(snippet: str) -> None:
    done = _run(_imports(_sorted(snippet)) + READY)
    assert done.returncode == 0, done.stderr


def test_mitsuba_imported_first_gets_an_llvm_that_works_or_an_error_that_names_the_cure() -> None:
    """As sorted imports have it where nothing keeps them apart."""
    code = _sorted("import mitsuba_crb\nimport mitsuba as mi\n")
    assert code.startswith("import mitsuba as mi\n")
    done = _run(code + READY)
    assert done.returncode == 0 or re.search(r"LLVMError: .*(Import|call) mitsuba_crb", done.stderr)


@pytest.mark.slow
@pytest.mark.parametrize("snippet", SNIPPETS)
def test_snippets_run(snippet: str) -> None:
    done = _run(_sorted(snippet))
    assert done.returncode == 0, done.stderr
