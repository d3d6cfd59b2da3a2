"""What is built is what is needed: the wheel of the source distribution runs from any folder, with demos."""

from __future__ import annotations

import os
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def run(*command: str | Path, folder: Path, **environment: str) -> str:
    env = {**os.environ, **environment}
    done = subprocess.run(
        [*map(str, command)], cwd=folder, env=env, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
def test_the_wheel_of_the_source_distribution_runs_from_any_folder(tmp_path: Path) -> None:
    built, sources, site, elsewhere = (tmp_path / name for name in ("built", "sources", "site", "elsewhere"))
    elsewhere.mkdir()
    run(sys.executable, "-m", "hatchling", "build", "-t", "sdist", "-d", built, folder=ROOT)
    with tarfile.open(next(built.glob("*.tar.gz"))) as archive:
        archive.extractall(sources, filter="data")
    (unpacked,) = sources.iterdir()
    assert {"LICENSE", "README.md", "CHANGELOG.md", "tests", "scenes"} <= {
        file.name for file in unpacked.iterdir()
    }
    run(sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", built, folder=unpacked)
    wheel = next(built.glob("*.whl"))
    names = zipfile.ZipFile(wheel).namelist()
    assert "mitsuba_crb/py.typed" in names
    assert not [name for name in names if name.endswith(".pyc") or name.startswith(("tests/", "scenes/"))]
    # What it depends on is installed here.
    run(sys.executable, "-m", "pip", "install", "--no-deps", "--target", site, wheel, folder=elsewhere)
    command = [sys.executable, site / "bin" / "mitsuba-crb"]
    where = {"PYTHONPATH": str(site)}
    package = run(
        sys.executable, "-c", "import mitsuba_crb as m; print(m.__file__)", folder=elsewhere, **where
    )
    assert Path(package.strip()).is_relative_to(site)
    said = run(
        *command, "bound", "demo:boxes", "--size", "48x36", "--json", "a.json", folder=elsewhere, **where
    )
    assert "6 of 6" in said
    run(*command, "fuse", "demo:warehouse", folder=elsewhere, **where)
    run(*command, "export", "a.json", "--to", "ros", folder=elsewhere, **where)
    assert sorted(file.name for file in elsewhere.iterdir()) == ["a.json", "a.ros.yaml"]
