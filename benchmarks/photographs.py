"""Held-out photographs aligned in a trained field: how many searches end there, which covariance is right.

    python benchmarks/photographs.py FIELD.npz [CAPTURE]   # the fox of ../shared/data by default

Each photograph that the capture holds out is aligned from a start 5 degrees and a tenth of the median depth
away from its given pose in random directions. A search converged if it ends within 1 degree and a fiftieth of
the depth of it. For those: the errors over the ideal bound's standard deviations (of the residuals' noise as
if white), and over the misspecified covariance's (of residuals pooled over the held-out photographs), as
root mean squares over the six axes, camera frame; 1 if a covariance is right.
"""

from __future__ import annotations

import sys
import time
import warnings
from pathlib import Path

import numpy as np

from mitsuba_crb import load_capture, se3
from mitsuba_crb.camera import Camera
from mitsuba_crb.datasets.pictures import comparable, read_picture
from mitsuba_crb.errors import MitsubaCRBError
from mitsuba_crb.estimate.align import align
from mitsuba_crb.measure.held_out import held_out_residuals
from mitsuba_crb.radiance.field_file import load_field

FOX = Path(__file__).parents[2] / "shared" / "data" / "multiview" / "fox_270x480"
TURN, MOVE = np.radians(5.0), 0.1
NEAR_TURN, NEAR_MOVE = np.radians(1.0), 0.02
SIZE = (68, 120)
LEVELS = 2


def unit(rng: np.random.Generator) -> np.ndarray:
    """A random direction."""
    direction = rng.standard_normal(3)
    return np.asarray(direction / np.linalg.norm(direction))


def searches(file: Path, folder: Path) -> None:
    """Prints a row a photograph, and what all say."""
    capture, field, rng = load_capture(folder), load_field(file), np.random.default_rng(0)
    others = held_out_residuals(field, capture, longest=max(SIZE), tone="known", display=True)
    residuals = others.covariance()
    print(f"held out: residuals {others.rms}, {residuals.description}", flush=True)
    pixels = np.stack(np.meshgrid(*(np.arange(0, n, 4) for n in SIZE)), axis=-1).reshape(-1, 2)
    found = []
    for index in capture.test:
        photograph = capture.photographs[index]
        begin, camera = time.perf_counter(), Camera.of(photograph.intrinsics.scaled(SIZE))
        depth = float(np.nanmedian(field.show(camera, photograph.pose, pixels).depth))
        away = np.concatenate([MOVE * depth * unit(rng), TURN * unit(rng)])
        image = comparable(read_picture(Path(photograph.image)), SIZE, display=True).values
        try:
            result = align(
                field,
                image,
                others.noise.model,
                residuals=residuals,
                estimator="levenberg_marquardt",
                levels=LEVELS,
                camera=photograph.intrinsics,
                size=SIZE,
                pose=photograph.pose @ se3.exp(away),
            )
        except MitsubaCRBError as error:
            print(f"{photograph.name}: {error}", flush=True)
            continue
        error = se3.log(se3.inverse(photograph.pose) @ result.pose)
        angle, distance = np.linalg.norm(error[3:]), np.linalg.norm(error[:3]) / depth
        assert result.misspecified is not None
        covariances = result.bound.covariance, result.misspecified.covariance
        ratios = [error / np.sqrt(np.diagonal(covariance)) for covariance in covariances]
        ideal, real = (float(np.sqrt(np.mean(row**2))) for row in ratios)
        print(
            f"{photograph.name}: {result.status}, {np.degrees(angle):.3f} deg, {distance:.4f} of the depth; "
            f"errors over ideal {ideal:.2f}, over misspecified {real:.2f}; "
            f"{time.perf_counter() - begin:.0f} s",
            flush=True,
        )
        if angle < NEAR_TURN and distance < NEAR_MOVE:
            found.append(ratios)
    print(f"{len(found)} of {len(capture.test)} searches ended at the given pose")
    if found:
        ideal, real = np.sqrt(np.mean(np.square(found), axis=(0, 2)))
        print(f"root mean square of their errors over ideal {ideal:.2f}, over misspecified {real:.2f}")


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    searches(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) > 2 else FOX)
