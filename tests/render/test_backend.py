"""Which variant Mitsuba runs in: the one that is set if it is one of two, named by every result."""

from __future__ import annotations

import subprocess
import sys

import mitsuba as mi
import pytest

from mitsuba_crb import errors
from mitsuba_crb.measure.versions import versions
from mitsuba_crb.processes import in_processes
from mitsuba_crb.render import backend, llvm

SMALL = """
import mitsuba as mi
import numpy as np
from mitsuba_crb import errors, pose_bound
from mitsuba_crb.noise import Gaussian
from mitsuba_crb.render.backend import use_mitsuba
SCENE = {
    "type": "scene",
    "sensor": {
        "type": "perspective",
        "to_world": mi.ScalarTransform4f().look_at(origin=[0, 0, 3], target=[0, 0, 0], up=[0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 8, "height": 8},
    },
    "wall": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": {"type": "checkerboard"}}},
    "light": {"type": "constant"},
}
"""


def in_a_process(code: str) -> str:
    """What Python code prints; `SMALL` needs a variant before it."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def can_cuda() -> bool:
    code = "import mitsuba as mi; mi.set_variant('cuda_ad_rgb'); print(mi.Float(1) + 1)"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, check=False).returncode == 0


def test_the_variant_that_is_set_stays():
    assert backend.use_mitsuba() == backend.use_mitsuba("llvm_ad_rgb") == backend.current() == mi.variant()


@pytest.mark.parametrize("other", ["scalar_rgb", "llvm_ad_spectral"])
def test_another_variant_is_refused_with_the_cure(other):
    code = (
        "import mitsuba_crb, mitsuba as mi\n"
        f"mi.set_variant('{other}')\n"
        "from mitsuba_crb.render.backend import use_mitsuba\n"
        "try: use_mitsuba()\n"
        "except mitsuba_crb.errors.VariantError as error: print(error)"
    )
    assert in_a_process(code) == (
        f"Mitsuba already runs in variant {other}, and llvm_ad_rgb or cuda_ad_rgb is needed: call "
        "mitsuba.set_variant('llvm_ad_rgb') before loading scenes"
    )


def test_unknown_variants_and_those_beside_the_one_that_is_set_are_refused():
    with pytest.raises(errors.VariantError, match="llvm_ad_rgb or cuda_ad_rgb, not 'cuda'"):
        backend.use_mitsuba("cuda")
    with pytest.raises(errors.VariantError, match="runs in variant llvm_ad_rgb, and cuda_ad_rgb is needed"):
        backend.use_mitsuba("cuda_ad_rgb")


@pytest.mark.slow
def test_a_scene_loaded_under_another_variant_is_named():
    code = (
        "import mitsuba_crb, mitsuba as mi\nmi.set_variant('scalar_rgb')\n"
        + SMALL
        + "scene = mi.load_dict(SCENE)\n"
        "mi.set_variant('llvm_ad_rgb')\n"
        "try: pose_bound(scene, Gaussian(0.1))\n"
        "except errors.SceneError as error: print(error)"
    )
    assert in_a_process(code) == (
        "this scene was loaded under variant scalar_rgb, and llvm_ad_rgb is set now: load it again"
    )


def test_where_no_gpu_is_the_variant_that_needs_one_says_so():
    if can_cuda():
        pytest.skip("there is a GPU")
    code = (
        "from mitsuba_crb import errors\nfrom mitsuba_crb.render.backend import use_mitsuba\n"
        "try: use_mitsuba('cuda_ad_rgb')\nexcept errors.VariantError as error: print(error)"
    )
    assert (
        in_a_process(code) == "variant cuda_ad_rgb does not run here; it needs an NVIDIA GPU and its driver"
    )


@pytest.mark.slow
def test_results_name_the_variant_and_workers_have_it():
    assert versions()["variant"] == "llvm_ad_rgb"
    prepare = backend.same_variant()
    assert prepare.args == ("llvm_ad_rgb",)
    assert [seen for _, seen in in_processes(_variant, [0, 1], 2, prepare=prepare)] == ["llvm_ad_rgb"] * 2


def test_without_llvm_the_other_variant_is_still_tried(monkeypatch):
    def none() -> llvm.LLVMLibrary:
        raise errors.LLVMError("there is none")

    monkeypatch.setattr(llvm, "configure", none)
    with pytest.raises(errors.LLVMError, match="there is none"):
        backend.use_mitsuba()
    with pytest.raises(errors.VariantError, match="cuda_ad_rgb is needed"):
        backend.use_mitsuba("cuda_ad_rgb")


@pytest.mark.gpu
def test_both_variants_measure_the_same_information():
    if not can_cuda():
        pytest.skip("needs an NVIDIA GPU")
    code = SMALL + (
        "bound = pose_bound(SCENE, Gaussian(0.01), spp=1024)\n"
        "print(*bound.position_std, *bound.position_std_standard_error)"
    )
    lines = [
        in_a_process(f"from mitsuba_crb.render.backend import use_mitsuba\nuse_mitsuba('{variant}')\n" + code)
        for variant in backend.VARIANTS
    ]
    (llvm_std, llvm_error), (cuda_std, cuda_error) = (
        (numbers[:3], numbers[3:]) for numbers in ([float(x) for x in line.split()] for line in lines)
    )
    for a, b, da, db in zip(llvm_std, cuda_std, llvm_error, cuda_error, strict=True):
        assert abs(a - b) < 4.0 * (da**2 + db**2) ** 0.5 + 1e-3 * a


def _variant(_job: int) -> str | None:
    return backend.current()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="says how much a process holds in /proc")
def test_freed_memory_goes_back_to_the_system():
    """Arrays of Dr.Jit, and small blocks between others that stay; negative control: without the call."""
    code = (
        "import mitsuba_crb, resource, drjit as dr\n"
        "from mitsuba_crb.render.backend import give_back_memory, use_mitsuba\n"
        "use_mitsuba()\n"
        "import mitsuba as mi\n"
        "def held():\n"
        "    pages = int(open('/proc/self/statm').read().split()[1])\n"
        "    return pages * resource.getpagesize() / 2**20\n"
        "for k in range(2):\n"
        "    if k: give_back_memory()\n"
        "    before = held()\n"
        "    blocks = [bytes([1]) * 100_000 for _ in range(1000)]\n"
        "    array = dr.arange(mi.Float, 25_000_000)\n"
        "    dr.eval(array); dr.sync_thread()\n"
        "    blocks = blocks[::50]\n"
        "    del array\n"
        "    if k: give_back_memory()\n"
        "    print(held() - before, end=' ')\n"
    )
    kept, given_back = map(float, in_a_process(code).split())
    assert kept > 150.0
    assert given_back < 20.0
