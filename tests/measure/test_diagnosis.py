"""The diagnosis tells what works, and survives whatever does not."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import subprocess
import sys

import pytest

from mitsuba_crb.errors import LLVMError
from mitsuba_crb.measure import diagnosis as doctor
from mitsuba_crb.render import llvm

REPORT = "from mitsuba_crb.measure.diagnosis import _report;"


def named(diagnosis: doctor.Diagnosis) -> dict[str, doctor.Row]:
    return {row.name: row for row in diagnosis.rows}


def usable() -> llvm.LLVMLibrary:
    return llvm.LLVMLibrary("/lib/libLLVM.so", "19.1.7", "system")


def unusable() -> llvm.LLVMLibrary:
    raise LLVMError("LLVM is too old. Install one: like this")


@pytest.mark.slow
def test_everything_works_where_the_tests_run():
    diagnosis = doctor.diagnose()
    assert diagnosis.ok, str(diagnosis)
    rows = named(diagnosis)
    assert list(rows) == [
        "Python",
        "platform",
        "cores",
        "mitsuba_crb",
        "mitsuba",
        "drjit",
        "numpy",
        "scipy",
        "OpenEXR",
        "LLVM",
        "Mitsuba loads",
        "float type",
        "16x16 bound",
    ]
    assert rows["mitsuba"].value == importlib.metadata.version("mitsuba") == rows["Mitsuba loads"].value
    assert rows["float type"].value == "float32 (llvm_ad_rgb)"
    assert rows["16x16 bound"].value.startswith("runs (")
    assert int(rows["cores"].value) <= (os.cpu_count() or 1)


def test_without_a_usable_llvm_it_says_so_and_tries_nothing(monkeypatch):
    platform.platform()  # asks a process of its own, once
    monkeypatch.setattr(llvm, "configure", unusable)
    monkeypatch.setattr(subprocess, "run", None)
    diagnosis = doctor.diagnose()
    rows = named(diagnosis)
    assert not diagnosis.ok
    assert rows["LLVM"] == ("LLVM", "LLVM is too old. Install one: like this", False)
    assert rows["16x16 bound"].value == "not tried without a usable LLVM"
    assert "FAILS: LLVM is too old" in str(diagnosis)


def test_a_missing_package_names_its_cure(monkeypatch):
    monkeypatch.setattr(doctor, "_PACKAGES", ("no-such-package-anywhere",))
    monkeypatch.setattr(llvm, "configure", unusable)
    row = named(doctor.diagnose())["no-such-package-anywhere"]
    assert (row.ok, row.value) == (False, "not installed: pip install no-such-package-anywhere")


def test_mitsuba_that_does_not_load_is_a_finding(monkeypatch):
    monkeypatch.setattr(llvm, "configure", usable)
    monkeypatch.setattr(doctor, "_TRIAL", f"import sys; sys.modules['mitsuba'] = None; {doctor._TRIAL}")
    rows = named(doctor.diagnose())
    assert not rows["Mitsuba loads"].ok
    assert "VariantError: Mitsuba cannot be imported" in rows["Mitsuba loads"].value
    assert rows["float type"] == ("float type", "not reached", False)
    assert rows["LLVM"].ok


@pytest.mark.skipif(sys.platform == "win32", reason="no signals")
def test_an_abort_is_reported_not_suffered():
    die = "import os, sys, resource; resource.setrlimit(resource.RLIMIT_CORE, (0, 0));"
    code = (
        f"{REPORT} _report('3.9'); {die} sys.stderr.write('LLVM ERROR: Cannot select\\nmore\\n'); os.abort()"
    )
    loads, float_type, bound = doctor._try(code, patience=60)
    assert loads == ("Mitsuba loads", "3.9", True)
    assert not float_type.ok
    assert float_type.value == "the process ended by signal 6 (Aborted): LLVM ERROR: Cannot select"
    assert bound == ("16x16 bound", "not reached", False)


def test_an_end_after_the_last_report_still_fails():
    code = f"{REPORT} import sys; [_report(text) for text in 'abc']; sys.exit('at the end')"
    rows = doctor._try(code, patience=60)
    assert [row.ok for row in rows] == [True, True, False]
    assert rows[-1].value == "at the end"


@pytest.mark.slow
def test_a_trial_that_hangs_is_given_up():
    rows = doctor._try(f"{REPORT} import time; _report('3.9'); time.sleep(60)", patience=3)
    assert [row.ok for row in rows] == [True, False, False]
    assert rows[1].value == "no answer within 3 s"
