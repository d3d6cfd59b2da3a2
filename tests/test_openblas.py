"""The environment decides whose kernels OpenBLAS runs, and the tests can do without Mitsuba under any."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from openblas import INSTRUCTIONS, in_use, lacking

TESTS = Path(__file__).parent


def _run(*arguments: str, core: str = "") -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"OPENBLAS_CORETYPE": core}
    return subprocess.run(
        [sys.executable, *arguments], cwd=TESTS, env=environment, capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize("core", INSTRUCTIONS)
def test_numpy_and_scipy_run_the_kernels_that_are_asked_for(core: str) -> None:
    if lacking(core):
        pytest.skip(lacking(core))
    if not in_use():
        pytest.skip("NumPy and SciPy run no OpenBLAS")
    run = _run("-c", "import openblas; print(*openblas.in_use().values())", core=core)
    assert run.returncode == 0, run.stderr
    found = run.stdout.split()
    # The wheels build none for Zen, which runs Haswell's.
    assert set(found) <= ({core, "Haswell"} if core == "Zen" else {core})
    assert len(found) == len(in_use())


def test_kernels_that_the_processor_cannot_run_are_skipped_by_name(tmp_path: Path) -> None:
    absent = "import openblas; openblas.INSTRUCTIONS['Haswell'] = 'avx4096'; import pytest; "
    run = _run("-c", f"{absent} raise SystemExit(pytest.main(['-q', 'test_se3.py']))", core="Haswell")
    assert run.returncode == 0, run.stdout + run.stderr
    assert "skipped: Haswell needs avx4096" in run.stdout + run.stderr
    assert "passed" not in run.stdout


@pytest.mark.slow
def test_what_imports_mitsuba_is_skipped_where_that_is_asked_for() -> None:
    files = ("test_se3.py", "render/test_sobol.py")
    run = _run("-m", "pytest", "-q", "-rs", "--without-mitsuba", *files)
    assert run.returncode == 0, run.stdout + run.stderr
    assert "imports mitsuba" in run.stdout
    assert "test_sobol" not in run.stdout
    assert " passed" in run.stdout
