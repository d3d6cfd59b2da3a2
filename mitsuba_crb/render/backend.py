"""What the library assumes of Mitsuba's variant and of the compiler behind Dr.Jit."""

from __future__ import annotations

from .. import processes
from ..errors import VariantError
from . import llvm

VARIANT = "llvm_ad_rgb"


def use_mitsuba() -> None:
    """Find an LLVM, import Mitsuba, select `llvm_ad_rgb` if no variant is set; a worker keeps to its cores.

    Raises:
        LLVMError: no usable LLVM.
        VariantError: Mitsuba is not installed, or another variant is already set.
    """
    llvm.configure()
    try:
        import mitsuba as mi
    except ImportError as error:
        raise VariantError(
            f"Mitsuba cannot be imported ({error}); install it with: pip install mitsuba"
        ) from error
    if mi.variant() is None:
        mi.set_variant(VARIANT)
        mi.set_log_level(mi.LogLevel.Error)
    elif mi.variant() != VARIANT:
        raise VariantError(
            f"Mitsuba already runs in variant {mi.variant()}, and {VARIANT} is needed: call "
            f"mitsuba.set_variant('{VARIANT}') before loading scenes"
        )
    if processes.is_worker():
        import drjit as dr

        dr.set_thread_count(processes.cores())
