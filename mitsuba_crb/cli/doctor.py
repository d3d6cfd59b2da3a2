"""`mitsuba-crb doctor`: whether what is installed works."""

from __future__ import annotations

from .options import Debug, Variant
from .outcome import console, foreseen


def doctor(variant: Variant = None, debug: Debug = False) -> int:
    """Does it run here?

    Versions, LLVM, cores, and whether a 16x16 bound runs.
    """
    with foreseen(debug):
        from ..measure.diagnosis import diagnose
        from ..render.backend import VARIANTS
        from ..show.diagnosis_table import print_diagnosis

        diagnosis = diagnose(variant or VARIANTS[0])
        print_diagnosis(console(), diagnosis)
        return 0 if diagnosis.ok else 1
