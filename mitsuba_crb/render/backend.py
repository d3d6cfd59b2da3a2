"""What the library assumes of Mitsuba's variant and of the compiler behind Dr.Jit.

The variant that is set stays, if it is one of `VARIANTS`: both trace wavefronts, differentiate and see linear
RGB. `cuda_ad_rgb` takes the same code to an NVIDIA GPU and needs no LLVM.
"""

from __future__ import annotations

import ctypes
import functools
import sys
from collections.abc import Callable

from .. import processes
from ..errors import LLVMError, VariantError
from . import llvm

VARIANTS = ("llvm_ad_rgb", "cuda_ad_rgb")
"""Those that can be measured with; the first is the default."""


def current() -> str | None:
    """The variant that is set; None if none is. Imports nothing."""
    mitsuba = sys.modules.get("mitsuba")
    return None if mitsuba is None else mitsuba.variant()


def use_mitsuba(variant: str | None = None) -> str:
    """Import Mitsuba and set a variant if none is set; a worker process keeps to its cores.

    Args:
        variant: one of `VARIANTS`; None is the one that is set, or else the first.

    Returns:
        The variant.

    Raises:
        LLVMError: the variant needs an LLVM, and there is no usable one.
        VariantError: Mitsuba is not installed, another variant is set, or this one does not run here.
    """
    if variant is not None and variant not in VARIANTS:
        raise VariantError(f"the variant is {' or '.join(VARIANTS)}, not {variant!r}")
    wanted = variant or current() or VARIANTS[0]
    try:
        llvm.configure()  # before Dr.Jit is imported
    except LLVMError:
        if wanted == VARIANTS[0]:
            raise
    try:
        import mitsuba as mi
    except ImportError as error:
        raise VariantError(
            f"Mitsuba cannot be imported ({error}); install it with: pip install mitsuba"
        ) from error
    if mi.variant() is None:
        _set(wanted)
    elif mi.variant() != wanted or wanted not in VARIANTS:
        needed = wanted if wanted in VARIANTS else " or ".join(VARIANTS)
        raise VariantError(
            f"Mitsuba already runs in variant {mi.variant()}, and {needed} is needed: call "
            f"mitsuba.set_variant('{variant or VARIANTS[0]}') before loading scenes"
        )
    if processes.is_worker():
        import drjit as dr

        dr.set_thread_count(processes.cores())
    return wanted


def same_variant() -> Callable[[], str]:
    """What gives another process the variant of this one; picklable."""
    return functools.partial(use_mitsuba, current())


def give_back_memory() -> None:
    """Give the system back what Dr.Jit keeps for the next array, and what glibc's `malloc` does."""
    import drjit as dr

    dr.flush_malloc_cache()
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # other C libraries have none
        if trim is not None:
            trim(0)


def _set(variant: str) -> None:
    import mitsuba as mi

    try:
        mi.set_variant(variant)
    except ImportError as error:  # Mitsuba's, of a backend that did not start
        cure = "it needs an NVIDIA GPU and its driver" if "cuda" in variant else "run mitsuba-crb doctor"
        raise VariantError(f"variant {variant} does not run here; {cure}") from error
    mi.set_log_level(mi.LogLevel.Error)
