"""How long a bound under correlated noise takes: Σ⁻¹ of a 512x512 image times the columns of a Jacobian.

    python benchmarks/correlated.py               # 24 columns, four batches of six; a minute or two
    python benchmarks/correlated.py --size 256

Prints elapsed and processor seconds of `noise.Stationary.solve` and the peak memory of the process; three
channels. Periodic noise, which one Fourier transform solves, stands beside it.
"""

from __future__ import annotations

import argparse
import resource
import time

import numpy as np

from mitsuba_crb import noise


def main() -> None:
    """Solve, and say what it took."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--columns", type=int, default=24)
    options = parser.parse_args()
    side = options.size
    tent = 1.0 - np.abs(np.arange(-4, 5)) / 5.0
    autocovariance = 0.01 * np.outer(tent, tent)
    autocovariance[4, 4] += 0.003  # white noise beside it, as every sensor has
    spectrum = np.abs(np.fft.fft2(np.eye(1, side * side).reshape(side, side))) * 0.01
    rows, columns = np.divmod(np.arange(side * side), side)
    pixels = np.stack([columns, rows], axis=1)
    values = np.random.default_rng(0).normal(size=(side * side, 3, options.columns))
    for model in (noise.Periodic(spectrum), noise.Stationary(autocovariance)):
        start, cpu = time.perf_counter(), time.process_time()
        model.solve(pixels, values)
        elapsed, used = time.perf_counter() - start, time.process_time() - cpu
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(
            f"{type(model).__name__}: {side}x{side} pixels, 3 channels, {options.columns} columns: "
            f"{elapsed:.1f} s, {used:.1f} s of processor time, peak {peak:.0f} MiB"
        )


if __name__ == "__main__":
    main()
