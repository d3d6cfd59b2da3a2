"""The LLVM that Dr.Jit gets is one that works, and the abort of LLVM 15 and 16 cannot be reached.

Fake libraries answer like the real ones; where the machine has a real old LLVM, the refusal is proved on it.
"""

from __future__ import annotations

import importlib.metadata
import os
import platform
import shutil
import signal
import subprocess
import sys
from types import SimpleNamespace

import pytest

from mitsuba_crb.errors import LLVMError
from mitsuba_crb.render import llvm

pytestmark = pytest.mark.skipif(platform.system() != "Linux", reason="the libraries are named as on Linux")

RENDER = """
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
mi.render(mi.load_dict(mi.cornell_box()), spp=1)
"""
BOUND_FIRST = f"""
from mitsuba_crb.render import llvm
print(llvm.configure())
{RENDER}
print(llvm.configure())
"""
PACKAGE_FIRST = f"""
import mitsuba_crb
{RENDER}
from mitsuba_crb.render import llvm
print(llvm.configure())
"""
MITSUBA_FIRST = """
import mitsuba
from mitsuba_crb.render import llvm
print(llvm.configure())
"""


def run(code: str, path: str | None) -> subprocess.CompletedProcess[str]:
    """A fresh Python in which Dr.Jit has not been imported; `path` is DRJIT_LIBLLVM_PATH."""
    environment = {key: value for key, value in os.environ.items() if key != llvm.VARIABLE}
    if path is not None:
        environment[llvm.VARIABLE] = path
    code = f"import resource\nresource.setrlimit(resource.RLIMIT_CORE, (0, 0))\n{code}"
    return subprocess.run(
        [sys.executable, "-c", code],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )


@pytest.fixture(scope="session")
def fake(tmp_path_factory):
    """Builds a shared library that answers as LLVM does; version None is one too old to be asked."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler to build the fake libraries with")
    folder = tmp_path_factory.mktemp("llvm")

    def build(name: str, version: tuple[int, int, int] | None, marker: str = "LLVMDisposeMessage") -> str:
        answer = ""
        if version is not None:
            body = "".join(
                f"*{variable} = {number};" for variable, number in zip("abc", version, strict=True)
            )
            answer = f"void LLVMGetVersion(unsigned *a, unsigned *b, unsigned *c) {{ {body} }}"
        library = folder / str(len(list(folder.iterdir()))) / name
        library.parent.mkdir()
        command = [compiler, "-shared", "-fPIC", "-x", "c", "-", "-o", str(library)]
        subprocess.run(command, input=f"{answer}\nvoid {marker}(void) {{}}", text=True, check=True)
        return str(library)

    return build


@pytest.fixture
def places(monkeypatch):
    """Replaces what is installed on this machine, and hides a Dr.Jit that other tests have imported."""
    monkeypatch.delitem(sys.modules, "drjit", raising=False)
    # set before it is deleted, so that monkeypatch also takes back what configure() writes
    monkeypatch.setenv(llvm.VARIABLE, "")
    monkeypatch.delenv(llvm.VARIABLE)

    def install(*paths: str) -> None:
        monkeypatch.setattr(llvm, "_places", lambda: [(path, "system") for path in paths])

    return install


@pytest.mark.parametrize(
    ("name", "version"),
    [
        ("libLLVM.so.23.1", (23, 1)),
        ("libLLVM-17.so", (17,)),
        ("libLLVM-14.0.6.so.1", (14, 0, 6)),
        ("libLLVM-15.so.1", (15,)),
        ("libLLVM.20.1.dylib", (20, 1)),
        ("Cellar/llvm@19/19.1.7/lib/libLLVM.dylib", (19, 1, 7)),
        ("llvm-18/lib/libLLVM.so", (18,)),
        ("libLLVM.so", ()),
        ("LLVM-C.dll", ()),
    ],
)
def test_a_version_is_read_from_the_name(name, version, tmp_path):
    assert llvm._claim(str(tmp_path / name)) == version


@pytest.mark.parametrize(
    "name", ["libLLVMSPIRVLib.so.14", "libLLVM-C.a", "LLVMgold.so", "libLLVMTableGen.so"]
)
def test_related_libraries_are_not_candidates(name, fake, places):
    places(fake(name, (99, 0, 0)))
    assert llvm._candidates() == []


def test_a_link_and_its_target_are_one_candidate(fake, places, tmp_path):
    target = fake("libLLVM.so.21.1", (21, 1, 8))
    link = tmp_path / "libLLVM.so"
    link.symlink_to(target)
    places(str(link), target)
    assert [candidate.path for candidate in llvm._candidates()] == [target]


def test_the_newest_is_chosen_and_handed_to_drjit(fake, places):
    newest = fake("libLLVM.so.100.0", (100, 0, 1))
    places(fake("libLLVM-17.so", (17, 0, 6)), newest, fake("libLLVM.so.99.1", (99, 1, 0)))
    assert llvm.configure() == llvm.LLVMLibrary(newest, "100.0.1", "system")
    assert os.environ[llvm.VARIABLE] == newest
    assert llvm.configure() == llvm.LLVMLibrary(newest, "100.0.1", "system")


def test_the_library_is_believed_not_its_name(fake, places):
    works = fake("libLLVM.so.18.1", (18, 1, 8))
    broken = fake("libLLVM.so.22.1", (22, 1, 0))
    with open(broken, "wb") as file:
        file.write(b"not a library")
    places(fake("libLLVM.so.23.1", (16, 0, 6)), broken, works)
    assert llvm.configure().path == works


@pytest.mark.parametrize("version", [None, (16, 0, 6)])
def test_only_old_ones_are_refused_with_what_to_install(fake, places, version, monkeypatch):
    old = fake("libLLVM-15.so.1", version)
    places(old)
    monkeypatch.setattr(platform, "machine", lambda: "x86_64")
    with pytest.raises(LLVMError, match=r"LLVM 17 or newer.*pip install karellen-llvm-core") as refusal:
        llvm.configure()
    assert old in str(refusal.value)
    assert llvm.VARIABLE not in os.environ


def test_pips_library_without_its_links_names_the_cure(places, monkeypatch, tmp_path):
    half_installed = tmp_path / "libLLVM.so.23.1"
    half_installed.write_bytes(b"")
    places()
    monkeypatch.setattr(llvm, "_places", lambda: [(str(half_installed), "karellen-llvm-core")])
    with pytest.raises(LLVMError, match="start Python once as the user who installed it"):
        llvm.configure()


@pytest.mark.parametrize(
    ("system", "machine", "cure"),
    [
        ("Linux", "aarch64", "apt install libllvm"),
        ("Darwin", "arm64", "brew install llvm"),
        ("Windows", "AMD64", "winget install"),
        ("Plan9", "mips", llvm.VARIABLE),
    ],
)
def test_nothing_installed_names_the_platforms_cure(places, monkeypatch, system, machine, cure):
    places()
    monkeypatch.setattr(platform, "system", lambda: system)
    monkeypatch.setattr(platform, "machine", lambda: machine)
    with pytest.raises(LLVMError, match=cure):
        llvm.configure()


def test_the_variable_is_honoured_before_newer_ones(fake, places, monkeypatch):
    places(fake("libLLVM.so.99.1", (99, 1, 0)))
    named = fake("libLLVM.so", (17, 0, 6))
    monkeypatch.setenv(llvm.VARIABLE, named)
    assert llvm.configure() == llvm.LLVMLibrary(named, "17.0.6", llvm.VARIABLE)


@pytest.mark.parametrize(
    ("name", "version", "marker", "fault"),
    [
        ("libLLVM.so", (16, 0, 6), "LLVMDisposeMessage", r"LLVM 16\.0\.6"),
        ("libLLVM.so.23.1", None, "LLVMDisposeMessage", "LLVM 15 or older"),
        ("libLLVM.so.23.2", None, "something", "no LLVM library"),
    ],
)
def test_an_old_or_foreign_library_named_by_the_variable_is_refused(
    fake, places, monkeypatch, name, version, marker, fault
):
    usable = fake("libLLVM.so.19.1", (19, 1, 7))
    places(usable)
    monkeypatch.setenv(llvm.VARIABLE, fake(name, version, marker))
    with pytest.raises(LLVMError, match=f"{llvm.VARIABLE} names .*{fault}.* Unset it to use {usable}"):
        llvm.configure()


def test_a_missing_library_named_by_the_variable_is_refused(places, monkeypatch, tmp_path):
    places()
    monkeypatch.setenv(llvm.VARIABLE, str(tmp_path / "libLLVM.so.23.1"))
    with pytest.raises(LLVMError, match="cannot open shared object file"):
        llvm.configure()


@pytest.mark.parametrize(
    ("version", "got"), [((15, 0, 7), r"loaded LLVM 15\.0\.7"), ((-1, -1, -1), "found no usable LLVM")]
)
def test_what_an_earlier_import_of_drjit_loaded_is_refused_if_old(fake, places, monkeypatch, version, got):
    usable = fake("libLLVM.so.19.1", (19, 1, 7))
    places(usable)
    loaded = SimpleNamespace(detail=SimpleNamespace(llvm_version=lambda: version))
    monkeypatch.setitem(sys.modules, "drjit", loaded)
    with pytest.raises(LLVMError, match=f"Dr.Jit {got}.*{llvm.VARIABLE}={usable}"):
        llvm.configure()


def test_what_an_earlier_import_of_drjit_loaded_is_accepted_if_new(places, monkeypatch):
    places()
    loaded = SimpleNamespace(detail=SimpleNamespace(llvm_version=lambda: (19, 1, 7)))
    monkeypatch.setitem(sys.modules, "drjit", loaded)
    library = llvm.configure()
    assert (library.version, library.origin) == ("19.1.7", "Dr.Jit")


@pytest.mark.skipif(platform.machine() != "x86_64", reason="the package is for x86-64")
def test_pip_alone_brings_a_library():
    importlib.metadata.distribution("karellen-llvm-core")
    found = [candidate for candidate in llvm._candidates() if candidate.origin == "karellen-llvm-core"]
    assert found
    assert found[0].claim >= (llvm.MINIMUM,)


@pytest.mark.skipif(platform.machine() != "x86_64", reason="the package is for x86-64")
def test_importing_the_package_before_mitsuba_is_enough():
    done = run(PACKAGE_FIRST, None)
    assert done.returncode == 0, done.stderr
    assert "origin='karellen-llvm-core'" in done.stdout


def test_importing_the_package_is_cheap():
    """No subprocess, no metadata, nothing heavy: what `import mitsuba_crb` adds to a bare Python."""
    done = run(
        "import sys\nbefore = set(sys.modules)\nimport mitsuba_crb\nprint(*(set(sys.modules) - before))", None
    )
    added = set(done.stdout.split())
    assert "mitsuba_crb" in added
    heavy = {"numpy", "scipy", "mitsuba", "drjit", "subprocess", "dataclasses", "importlib.metadata", "email"}
    assert not added & heavy


@pytest.mark.parametrize("path", ["/nowhere/libLLVM.so", None])
def test_importing_the_package_leaves_the_users_choice_and_a_loaded_drjit_alone(path):
    code = f"import os, sys\n{{}}\nimport mitsuba_crb\nprint(os.environ.get({llvm.VARIABLE!r}))"
    loaded = "sys.modules['drjit'] = sys" if path is None else ""
    assert run(code.format(loaded), path).stdout.strip() == str(path)


@pytest.fixture
def pips(fake, places, monkeypatch):
    """Makes a library that answers so the one that pip installed, as `import mitsuba_crb` names it."""

    def install(version, *others):
        library = fake("libLLVM.so.23.1", version)
        monkeypatch.setattr(llvm, "_origins", {library: "karellen-llvm-core"})
        monkeypatch.setattr(
            llvm, "_places", lambda: [(library, "karellen-llvm-core"), *((path, "system") for path in others)]
        )
        monkeypatch.setenv(llvm.VARIABLE, library)
        return library

    return install


def test_pips_library_is_chosen_before_newer_ones_whoever_is_imported_first(fake, pips, monkeypatch):
    library = pips((23, 1, 4), fake("libLLVM.so.99.1", (99, 1, 0)))
    expected = llvm.LLVMLibrary(library, "23.1.4", "karellen-llvm-core")
    assert llvm.configure() == expected
    monkeypatch.delenv(llvm.VARIABLE)
    assert llvm.configure() == expected


def test_pips_library_that_does_not_work_gives_way(fake, pips):
    works = fake("libLLVM.so.19.1", (19, 1, 7))
    pips((16, 0, 6), works)
    assert llvm.configure() == llvm.LLVMLibrary(works, "19.1.7", "system")
    assert os.environ[llvm.VARIABLE] == works


def test_the_refusal_of_what_drjit_loaded_says_what_to_import_first(fake, pips, monkeypatch):
    pips((23, 1, 4))
    monkeypatch.delenv(llvm.VARIABLE)
    loaded = SimpleNamespace(detail=SimpleNamespace(llvm_version=lambda: (15, 0, 7)))
    monkeypatch.setitem(sys.modules, "drjit", loaded)
    with pytest.raises(LLVMError, match=r"Import mitsuba_crb before drjit and mitsuba.*isort: split"):
        llvm.configure()


def test_the_chosen_library_is_the_one_that_renders():
    done = run(BOUND_FIRST, None)
    assert done.returncode == 0, done.stderr
    before, after = done.stdout.splitlines()
    assert before == after


def real(major: int) -> str:
    """An old LLVM of this machine."""
    for candidate in llvm._candidates():
        if candidate.claim[:1] == (major,):
            return candidate.path
    pytest.skip(f"this machine has no LLVM {major}")


@pytest.mark.parametrize("major", [14, 15, 16])
@pytest.mark.parametrize("code", [BOUND_FIRST, MITSUBA_FIRST], ids=["bound_first", "mitsuba_first"])
def test_a_real_old_library_is_refused_and_ends_no_process(major, code):
    done = run(code, real(major))
    assert done.returncode == 1
    assert "mitsuba_crb.errors.LLVMError" in done.stderr
    assert "LLVM 17 or newer" in done.stderr


@pytest.mark.parametrize("major", [15, 16])
def test_without_the_refusal_the_process_ends(major):
    """The negative control; once it fails, MINIMUM can be lowered."""
    done = run(RENDER, real(major))
    assert done.returncode == -signal.SIGABRT
    assert "Cannot select" in done.stderr
