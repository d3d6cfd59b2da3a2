"""Says what is installed and whether it works, also where Mitsuba or LLVM cannot even load.

Versions come from the packages' metadata. Mitsuba is imported, and a 16x16 bound computed, in a process of
its own that reports stage by stage, so that even its sudden end is a finding.
"""

from __future__ import annotations

import importlib.metadata
import platform
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from typing import NamedTuple

from ..errors import LLVMError
from ..files import Record
from ..processes import cores
from ..render import llvm
from ..render.backend import VARIANTS, use_mitsuba

_PACKAGES = ("mitsuba", "drjit", "numpy", "scipy", "OpenEXR")
_STAGES = ("Mitsuba loads", "float type", "16x16 bound")
_TRIAL = "from mitsuba_crb.measure.diagnosis import trial; trial({variant!r})"
_PATIENCE = 300.0  # seconds; a first bound compiles its kernels in a few
_MARK = "mitsuba-crb doctor\t"


class Row(NamedTuple):
    """One finding."""

    name: str
    value: str
    """What was found, or what is wrong and how to cure it."""
    ok: bool


@dataclass(frozen=True)
class Diagnosis(Record):
    """What `mitsuba-crb doctor` found."""

    rows: tuple[Row, ...]

    @property
    def ok(self) -> bool:
        """Whether everything needed works."""
        return all(row.ok for row in self.rows)

    def __str__(self) -> str:
        width = max(len(row.name) for row in self.rows)
        return "\n".join(
            f"{row.name:<{width}}  {'' if row.ok else 'FAILS: '}{row.value}" for row in self.rows
        )


def diagnose(variant: str = VARIANTS[0]) -> Diagnosis:
    """Versions, LLVM in use, cores, float type, and whether a 16x16 bound runs; raises nothing.

    Args:
        variant: Mitsuba's; without LLVM in its name it needs none.
    """
    rows = [
        Row("Python", f"{platform.python_version()} ({sys.executable})", True),
        Row("platform", platform.platform(), True),
        Row("cores", str(cores()), True),
        _package("mitsuba_crb"),
        *map(_package, _PACKAGES),
    ]
    trial = _TRIAL.format(variant=variant)
    if "llvm" not in variant:
        return Diagnosis((*rows, *_try(trial, _PATIENCE)))
    try:
        library = llvm.configure()
    except LLVMError as error:
        tried = [Row(stage, "not tried without a usable LLVM", False) for stage in _STAGES]
        return Diagnosis((*rows, Row("LLVM", str(error), False), *tried))
    found = Row("LLVM", f"{library.version} ({library.path or 'unknown path'}, by {library.origin})", True)
    return Diagnosis((*rows, found, *_try(trial, _PATIENCE)))


def trial(variant: str) -> None:
    """What the process of its own does: reports each stage on standard output; not meant to be called."""
    use_mitsuba(variant)
    import drjit as dr
    import mitsuba as mi

    _report(str(mi.__version__))
    _report(f"{str(dr.type_v(mi.Float).name).lower()} ({variant})")

    import numpy as np

    from ..noise import Gaussian
    from .pose import pose_bound

    transform = mi.ScalarTransform4f()
    blotches = mi.TensorXf(np.random.default_rng(0).random((8, 8, 3)))
    texture = {"type": "bitmap", "data": blotches, "raw": True}
    scene = {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "to_world": transform.look_at(origin=[0, 0, 3], target=[0, 0, 0], up=[0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 16, "height": 16},
        },
        "wall": {
            "type": "rectangle",
            "to_world": transform.scale(2),
            "bsdf": {"type": "diffuse", "reflectance": texture},
        },
        "light": {"type": "constant"},
    }
    start = time.perf_counter()
    bound = pose_bound(scene, Gaussian(0.01), spp=64)
    seconds = time.perf_counter() - start
    if not np.all(np.isfinite([*bound.position_std, *bound.rotation_std_deg])):
        raise ArithmeticError(f"six finite standard deviations expected, got rank {bound.rank}")
    _report(f"runs ({seconds:.1f} s)")


def _report(value: str) -> None:
    sys.stdout.write(f"{_MARK}{value}\n")
    sys.stdout.flush()


def _try(code: str, patience: float) -> list[Row]:
    """A row per stage: what the process reported, and why it stopped where it did."""
    command = [sys.executable, "-c", code]
    try:
        done = subprocess.run(command, capture_output=True, timeout=patience, check=False)
    except subprocess.TimeoutExpired as expired:
        output, fault = expired.stdout or b"", f"no answer within {patience:g} s"
    else:
        output, fault = done.stdout, _fault(done.returncode, done.stderr)
    lines = output.decode(errors="replace").splitlines()
    findings = [(line.removeprefix(_MARK), True) for line in lines if line.startswith(_MARK)]
    if fault:
        # a process that dies after its last report has not worked either
        findings[len(_STAGES) - 1 :] = []
        findings += [(fault, False), *[("not reached", False)] * len(_STAGES)]
    return [Row(stage, *finding) for stage, finding in zip(_STAGES, findings, strict=False)]


def _fault(code: int, errors: bytes) -> str:
    """Why a process ended; empty if it ended well."""
    if code == 0:
        return ""
    lines = errors.decode(errors="replace").strip().splitlines() or ["without a word"]
    if code < 0:
        # what ends a process speaks first; a traceback says it last
        return f"the process ended by signal {-code} ({signal.strsignal(-code)}): {lines[0]}"
    return lines[-1].removeprefix("mitsuba_crb.errors.")


def _package(name: str) -> Row:
    try:
        return Row(name, importlib.metadata.version(name), True)
    except importlib.metadata.PackageNotFoundError:
        return Row(name, f"not installed: pip install {name}", False)
