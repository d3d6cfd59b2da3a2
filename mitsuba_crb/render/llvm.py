"""Finds a usable LLVM library before Dr.Jit loads one.

Dr.Jit loads LLVM on its first import, from `DRJIT_LIBLLVM_PATH` or else from wherever the system has one,
and never looks again. With LLVM 14 it switches itself off; with 15 and 16 it starts, and the first kernel
that takes a minimum ends the process ("LLVM ERROR: Cannot select: fminimum", x86-64). So the choice is made
here; what `import mitsuba_crb` has named before, by `pip_llvm`, is asked here whether it works.

A library's version is asked of the library itself, in a short process of its own: file names may carry none
or a wrong one, some libraries do not load at all, and two LLVMs in one process can clash.
"""

from __future__ import annotations

import functools
import glob
import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from ..errors import LLVMError
from .pip_llvm import PACKAGE, VARIABLE, libraries

MINIMUM = 17
"""The oldest LLVM that works: with Mitsuba 3.9 and Dr.Jit 1.5, 17 to 23 render and differentiate alike."""

_NEED = f"Dr.Jit needs LLVM {MINIMUM} or newer"

_PIP_PLATFORM = ("Linux", "x86_64")

_NAME = re.compile(
    r"libLLVM(?:[-.](?P<before>\d+(?:\.\d+)*))?\.(?:so|dylib|dll)(?:\.(?P<after>\d+(?:\.\d+)*))?|LLVM-C\.dll"
)
_FOLDER = re.compile(r"/llvm(?:@\d+)?[/-](\d+(?:\.\d+)*)/")
_FOLDERS = {
    "Linux": (
        "/usr/lib/llvm-*/lib",
        "/usr/lib/*-linux-gnu",
        "/usr/lib64/llvm*/lib*",
        "/usr/lib64",
        "/usr/lib",
        "/usr/local/lib",
    ),
    "Darwin": (
        "/opt/homebrew/opt/llvm*/lib",
        "/usr/local/opt/llvm*/lib",
        "/opt/local/libexec/llvm-*/lib",
    ),
    "Windows": (r"C:\Program Files\LLVM\bin",),
}
_HOW_TO_INSTALL = {
    _PIP_PLATFORM: f"pip install {PACKAGE}",
    ("Linux", "aarch64"): "apt install libllvm19, or your distribution's LLVM",
    ("Darwin", "arm64"): "brew install llvm",
    ("Darwin", "x86_64"): "brew install llvm",
    ("Windows", "AMD64"): "winget install LLVM.LLVM",
}

_ASK = """
import ctypes, sys
library = ctypes.CDLL(sys.argv[1])
if not hasattr(library, "LLVMGetVersion"):  # new in LLVM 16
    sys.exit("it is LLVM 15 or older" if hasattr(library, "LLVMDisposeMessage") else "it is no LLVM library")
version = [ctypes.c_uint() for _ in range(3)]
library.LLVMGetVersion(*map(ctypes.byref, version))
sys.stdout.write(".".join(str(number.value) for number in version))
"""

_origins = dict.fromkeys(libraries(), PACKAGE)
"""Where the paths come from that this package writes into the environment."""


@dataclass(frozen=True)
class LLVMLibrary:
    """The LLVM library that Dr.Jit uses, or will use once it is imported."""

    path: str
    """Empty if Dr.Jit found it by itself and the platform does not tell where."""
    version: str
    """As in "23.1.4"."""
    origin: str
    """One of "DRJIT_LIBLLVM_PATH" (named by the user), "karellen-llvm-core" (pip), "Python environment",
    "system", and "Dr.Jit" (loaded before this module could choose)."""


@dataclass(frozen=True)
class _Candidate:
    path: str
    origin: str
    claim: tuple[int, ...]
    """The version in its name, empty if there is none."""


def configure() -> LLVMLibrary:
    """Choose the LLVM library that Dr.Jit is to load, before the first `import drjit` or `import mitsuba`.

    Honours `DRJIT_LIBLLVM_PATH`; else takes pip's library, or the newest of those that the Python environment
    and the system have, and writes its path there. If Dr.Jit is imported already, checks what it has loaded.
    Further calls cost next to nothing.

    Raises:
        LLVMError: nothing usable was found, or what the user or Dr.Jit chose is older than `MINIMUM`; says
            what to install.
    """
    drjit = sys.modules.get("drjit")
    if drjit is not None:
        return _loaded_by(drjit)
    named = os.environ.get(VARIABLE)
    by_user = named and _origins.get(named) != PACKAGE
    if named and (by_user or not _ask(named)[1]):
        return _named(named)
    library, rejected = _newest()
    if library is None:
        raise LLVMError(f"{_NEED}, and none was found{_because(rejected)}. Install one: {how_to_install()}")
    os.environ[VARIABLE] = library.path
    _origins[library.path] = library.origin
    return library


def how_to_install() -> str:
    """The command that brings a usable LLVM to this platform."""
    here = (platform.system(), platform.machine())
    return _HOW_TO_INSTALL.get(here, f"LLVM {MINIMUM} or newer, and set {VARIABLE} to its shared library")


def _named(path: str) -> LLVMLibrary:
    version, fault = _ask(path)
    if fault:
        raise LLVMError(f"{VARIABLE} names {path}: {fault}; {_NEED}. {_cure('Unset it to use ')}")
    return LLVMLibrary(path, version, _origins.get(path, VARIABLE))


def _loaded_by(drjit: Any) -> LLVMLibrary:
    """What Dr.Jit has loaded: it decides on import, so that nothing but a refusal can follow."""
    numbers = tuple(drjit.detail.llvm_version())
    version = ".".join(map(str, numbers))
    path = _mapped(numbers)
    if numbers[0] < MINIMUM:
        got = (
            f"loaded LLVM {version} ({path or 'unknown path'})"
            if numbers[0] > 0
            else "found no usable LLVM (its warning on import says why)"
        )
        first = (
            "Import mitsuba_crb before drjit and mitsuba ('import mitsuba_crb  # isort: split')"
            if PACKAGE in _origins.values()
            else "Before importing drjit or mitsuba call mitsuba_crb.render.llvm.configure()"
        )
        cure = _cure(f"{first}, or start Python with {VARIABLE}=")
        raise LLVMError(f"Dr.Jit {got}; {_NEED}. {cure}")
    origin = VARIABLE if path == os.environ.get(VARIABLE) else "Dr.Jit"
    return LLVMLibrary(path, version, _origins.get(path, origin))


def _cure(use: str) -> str:
    """What to do: use the library that `configure` would choose by itself, or install one."""
    better, rejected = _newest()
    return f"{use}{better.path}" if better else f"Install one{_because(rejected)}: {how_to_install()}"


def _newest() -> tuple[LLVMLibrary | None, list[str]]:
    """The newest library that loads, and why the newer or only other ones were rejected."""
    rejected: list[str] = []
    for candidate in _candidates():
        version, fault = _ask(candidate.path)
        if not fault:
            return LLVMLibrary(candidate.path, version, candidate.origin), rejected
        if not version and candidate.origin == PACKAGE:
            # its links are made by the first Python that starts after pip, if that may write there
            fault += " (start Python once as the user who installed it)"
        rejected.append(f"{candidate.path}: {fault}")
    return None, rejected


@functools.cache
def _ask(path: str) -> tuple[str, str]:
    """The version that the library at `path` states, and what speaks against it (empty: nothing)."""
    command = [sys.executable, "-I", "-S", "-c", _ASK, path]
    answer = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
    if answer.returncode:
        lines = answer.stderr.strip().splitlines() or [f"its process ended with code {answer.returncode}"]
        return "", lines[-1].removeprefix("OSError: ").removeprefix(f"{path}: ")
    version = answer.stdout.strip()
    return version, f"it is LLVM {version}" if _numbers(version)[0] < MINIMUM else ""


def _candidates() -> list[_Candidate]:
    """Every LLVM library in the usual places, once each, pip's first, then the newest name first.

    A library whose name tells no version comes last: it is usually a link to one whose name does.
    """
    found: dict[str, _Candidate] = {}
    for path, origin in _places():
        real = os.path.realpath(path)
        if os.path.isfile(real) and _NAME.fullmatch(os.path.basename(path)):
            found.setdefault(real, _Candidate(real, origin, _claim(path)))
    return sorted(found.values(), key=lambda found: (found.origin == PACKAGE, found.claim), reverse=True)


def _places() -> Iterator[tuple[str, str]]:
    """Paths that may be LLVM libraries, and who put them there."""
    for path in libraries():
        yield path, PACKAGE
    for folder in ("lib", os.path.join("Library", "bin")):
        for path in glob.glob(os.path.join(glob.escape(sys.prefix), folder, "*LLVM*")):
            yield path, "Python environment"
    for path in _ldconfig():
        yield path, "system"
    for folder in _FOLDERS.get(platform.system(), ()):
        for path in glob.glob(os.path.join(folder, "*LLVM*")):
            yield path, "system"


def _ldconfig() -> list[str]:
    """Libraries that the dynamic linker knows (Linux)."""
    ldconfig = shutil.which("ldconfig", path=f"{os.environ.get('PATH', '')}:/sbin:/usr/sbin")
    if platform.system() != "Linux" or ldconfig is None:
        return []
    listed = subprocess.run([ldconfig, "-p"], capture_output=True, text=True, check=False).stdout
    return [line.rpartition(" => ")[2].strip() for line in listed.splitlines() if "libLLVM" in line]


def _claim(path: str) -> tuple[int, ...]:
    """The version in a library's name or its target's, or in its folder: llvm-19/, llvm/19.1.7/, llvm@19/."""
    real = os.path.realpath(path)
    for name in (os.path.basename(real), os.path.basename(path)):
        match = _NAME.fullmatch(name)
        number = match and (match["before"] or match["after"])
        if number:
            return _numbers(number)
    match = _FOLDER.search(real)
    return _numbers(match[1]) if match else ()


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in version.split("."))


@functools.cache
def _mapped(version: tuple[int, ...]) -> str:
    """Path of the LLVM of this version in this process; other packages may have loaded others."""
    named = os.environ.get(VARIABLE, "")
    try:
        with open("/proc/self/maps", encoding="utf-8", errors="replace") as maps:
            mapped = {line.split(maxsplit=5)[-1].strip() for line in maps if "libLLVM" in line}
    except OSError:
        return named
    if os.path.realpath(named) in mapped:
        return named
    return next((path for path in sorted(mapped) if _claim(path)[:1] == version[:1]), "")


def _because(rejected: list[str]) -> str:
    return f" ({'; '.join(rejected)})" if rejected else ""
